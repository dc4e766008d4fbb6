"""RunState folds messages; the bottleneck is read from it."""

import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.trajectory import (
    COMPILING,
    DOING,
    EpisodeSummary,
    Evaluation,
    Outcome,
    Stats,
)
from mrcdrl.services.monitor.bottleneck import bottleneck
from mrcdrl.services.monitor.recorder import flat_metrics
from mrcdrl.services.monitor.state import MAX_SERVICES, RunState


def config(**overrides: str) -> Config:
    named = {name.replace("__", "."): value for name, value in overrides.items()}
    return load_config("quick", named, environ={})


def episode(outcome: Outcome = Outcome.SUCCESS, number: int = 0) -> EpisodeSummary:
    return EpisodeSummary("actor-0", 0, number, outcome, 100, 150.0, 1, 0.1, 5, 2.0, 2)


def evaluation(rate: float, version: int = 1) -> Evaluation:
    return Evaluation(
        "0", 1, version, 100 * version, 2, 100, rate, 1 - rate, 0.0, (rate, rate),
        100.0, 90.0, 4.0, 110.0, 150.0, 1, 20.0,
    )  # fmt: skip


def actor(steps: float, who: str = "actor-0", **more: float) -> Stats:
    return Stats("actor", who, {"robot_steps": 2 * steps, "env_steps": steps, **more})


def learner(steps: float, **more: float) -> Stats:
    return Stats("learner", "0", {"learner_steps": steps, **more})


def replay(**metrics: float) -> Stats:
    return Stats("replay", "0", metrics)


def test_rates_are_sums_that_leave_out_what_was_counted_before() -> None:
    state = RunState(config())
    for second in range(21):
        state.observe_stats(actor(1_000 + 30 * second, "actor-0"), second)
        state.observe_stats(actor(70 * second, "actor-1"), second)
    assert state.per_second("env_steps", 20) == pytest.approx(100)
    assert state.per_second("robot_steps", 20) == pytest.approx(200)
    assert state.env_steps == 1_000 + 20 * 100


def test_a_rate_is_right_from_the_second_report_and_falls_to_zero_when_reports_stop() -> None:
    state = RunState(config())
    state.observe_stats(actor(0), 0)
    assert state.per_second("env_steps", 0) == 0
    state.observe_stats(actor(50), 1)
    assert state.per_second("env_steps", 1) == pytest.approx(50)
    assert state.per_second("env_steps", 30) == 0


def test_an_actor_that_restarted_counts_on_from_what_it_had() -> None:
    state = RunState(config())
    for second, steps in enumerate((100, 200, 5, 25)):
        state.observe_stats(actor(steps), second)
    assert state.env_steps == 225
    assert state.per_second("env_steps", 3) == pytest.approx(125 / 3)


def test_of_two_processes_with_one_name_the_newer_is_counted_and_it_is_said_once() -> None:
    state = RunState(Config())
    for second in range(100):
        for incarnation, steps in (("1", 1000 + second), ("2", 10 * second)):
            text = {"incarnation": incarnation}
            state.observe_stats(Stats("actor", "a", {"robot_steps": steps}, text), second)
    assert state.robot_steps == 1000 + 990
    (said,) = state.log
    assert said.startswith("two processes of the role actor are named a: only the newer one")


def test_a_new_incarnation_is_a_restart_even_if_the_counter_rose() -> None:
    state = RunState(config())
    state.observe_stats(Stats("actor", "0", {"env_steps": 10}, {"incarnation": "1"}), 0)
    state.observe_stats(Stats("actor", "0", {"env_steps": 40}, {"incarnation": "2"}), 1)
    assert state.env_steps == 50


def test_a_learner_back_at_its_checkpoint_has_that_step_and_no_negative_rate() -> None:
    state = RunState(config())
    for second, steps in enumerate((1_000, 1_100, 900, 950)):
        state.observe_stats(learner(steps), second)
    assert state.learner_steps == 950
    assert state.per_second("learner_steps", 3) == pytest.approx(150 / 3)


def test_what_earlier_processes_collected_is_added() -> None:
    state = RunState(config())
    state.restore_counted({"env_steps": 1_000, "robot_steps": 2_000})
    state.observe_stats(actor(5), 0)
    assert (state.env_steps, state.robot_steps) == (1_005, 2_010)


def test_the_learners_step_is_known_before_it_reports_again() -> None:
    state = RunState(config())
    state.restore_counted({"learner_steps": 700})
    assert state.learner_steps == 700
    state.observe_stats(learner(650), 0)  # back at its checkpoint
    assert state.learner_steps == 650


def test_an_actor_that_outlived_the_recorder_is_not_counted_twice() -> None:
    state = RunState(config())
    state.restore_counted(
        {"env_steps": 1_000, "robot_steps": 2_000},
        {("0", "env_steps"): 400, ("1", "env_steps"): 600},
    )
    state.observe_stats(Stats("actor", "0", {"env_steps": 450}, {}), 0)
    state.observe_stats(Stats("actor", "1", {"env_steps": 7}, {}), 0)  # itself new
    assert state.env_steps == 1_057


def test_successes_need_a_hundred_episodes_and_keep_their_maximum() -> None:
    state = RunState(config())
    for number in range(99):
        state.observe_episode(episode(number=number))
    assert state.successes_per_100 is None
    assert state.recent_successes == (99, 99)
    state.observe_episode(episode())
    assert state.successes_per_100 == 100
    for _ in range(100):
        state.observe_episode(episode(Outcome.COLLISION))
    assert (state.successes_per_100, state.max_successes) == (0, 100)
    assert state.hundreds == [100, 0]
    assert state.success_history[0] == 100
    assert state.success_history[-1] == 0


def test_the_best_evaluation_is_the_first_of_the_highest() -> None:
    state = RunState(config())
    for version, rate in enumerate((0.2, 0.9, 0.9, 0.5)):
        state.observe_evaluation(evaluation(rate, version), 10.0 * version)
    assert state.best_evaluation is not None
    assert state.last_evaluation is not None
    assert state.best_evaluation.evaluation.weights_version == 1
    assert state.best_evaluation.time_s == 10.0
    assert state.last_evaluation.evaluation.success_rate == 0.5


def test_staleness_epsilon_and_presence_follow_the_actors_that_are_up() -> None:
    state = RunState(config())
    state.observe_stats(learner(10, weights_version=30), 0)
    state.observe_stats(
        actor(1, "a", weights_version=28, weights_age_s=1.5, epsilon_min=0.1, epsilon_max=0.2), 0
    )
    state.observe_stats(
        actor(1, "b", weights_version=10, weights_age_s=9.0, epsilon_min=0.05, epsilon_max=0.9), 0
    )
    assert state.max_staleness == (20, 9.0)
    assert state.epsilons == (0.05, 0.9)
    state.observe_presence("actor", "b", alive=False)
    assert state.max_staleness == (2, 1.5)
    assert state.epsilons == (0.1, 0.2)
    assert [service.alive for service in state.services] == [True, False, True]
    assert state.env_steps == 2


def test_an_actors_staleness_is_spread_over_its_last_ten_minutes() -> None:
    state = RunState(config())
    state.observe_stats(actor(1, "early", weights_version=0, weights_age_s=1.0), 0)
    assert state.staleness_spreads == {}, "no learner has reported"
    for second in range(1000):
        state.observe_stats(learner(10, weights_version=5000), second)
        behind = 50 if second == 990 else 1000 if second < 400 else second % 2
        age = {"weights_version": 5000 - behind, "weights_age_s": 0.5 * behind}
        state.observe_stats(actor(1, "a", **age), second)
    assert flat_metrics(state, 999.0)["actor/a/staleness_versions_p99"] == 1
    state.observe_presence("actor", "a", alive=False)
    assert "actor/a/staleness_versions_p99" not in flat_metrics(state, 999.0)
    found = state.staleness_spreads
    assert list(found) == ["a"]
    versions, seconds = found["a"]["versions"], found["a"]["s"]
    assert (versions.min, versions.p99) == (0, 1)
    assert versions.mean == pytest.approx((300 + 50) / 600)
    assert (seconds.min, seconds.mean, seconds.p99) == pytest.approx((0, 0.5 * 350 / 600, 0.5))


def test_time_left_is_the_nearer_of_minutes_and_learner_steps() -> None:
    state = RunState(config(run__minutes="10", run__learner_steps="1000"))
    assert state.time_left_s(60) == pytest.approx(540)
    state.observe_stats(learner(0), 60)
    state.observe_stats(learner(100), 61)
    assert state.time_left_s(61) == pytest.approx(9)
    assert RunState(config(run__minutes="0")).time_left_s(5) is None


HELD_BY_ACTORS = {"sample_held": 1.0, "insert_held": 0.0, "size": 9_000}
HELD_BY_LEARNER = {"sample_held": 0.0, "insert_held": 1.0, "size": 9_000}
FREE = {"sample_held": 0.0, "insert_held": 0.0, "size": 9_000}


@pytest.mark.parametrize(
    ("table", "shares", "waits", "expected"),
    [
        ({"size": 3_200}, {}, {}, "waiting for replay to fill (3 200 of 5 000)"),
        (HELD_BY_ACTORS, {"inference_share": 0.6}, {}, "collection: actor inference"),
        (HELD_BY_ACTORS, {"arena_share": 0.6}, {}, "collection: arenas"),
        (HELD_BY_ACTORS, {"wait_share": 0.6}, {}, "actors → replay transfer"),
        (HELD_BY_LEARNER, {}, {"step_share": 0.9}, "learner computation"),
        (HELD_BY_LEARNER, {}, {"decode_share": 0.9}, "learner decoding of batches"),
        (FREE, {"draw_share": 0.6}, {"data_wait_share": 0.8}, "collection: rendering"),
        (FREE, {}, {"data_wait_share": 0.3, "step_share": 0.6}, "learner computation"),
    ],
)
def test_the_bottleneck_is_named(
    table: dict[str, float], shares: dict[str, float], waits: dict[str, float], expected: str
) -> None:
    state = RunState(config())
    state.observe_stats(actor(1, **shares), 0)
    state.observe_stats(learner(1, **waits), 0)
    state.observe_stats(replay(**table), 0)
    assert expected in bottleneck(state).replace("\N{NO-BREAK SPACE}", " ")


def test_the_run_waits_for_a_missing_role() -> None:
    state = RunState(config())
    assert bottleneck(state) == "waiting for replay to start"
    state.observe_stats(replay(size=0), 0)
    state.observe_stats(actor(1), 0)
    assert bottleneck(state) == "waiting for the learner to start"


def test_a_peer_that_claims_many_names_does_not_fill_the_memory() -> None:
    state = RunState(config())
    state.observe_stats(learner(10), 0)
    for number in range(MAX_SERVICES + 100):
        state.observe_stats(actor(1, f"x{number}"), 0)
        state.observe_presence("actor", f"y{number}", True)
    assert len(state.services) == MAX_SERVICES
    state.observe_stats(learner(20), 1)
    assert state.learner_steps == 20


def test_a_service_that_restarts_and_compiles_first_keeps_the_runs_counters() -> None:
    state = RunState(config())
    first, second = {"incarnation": "1"}, {"incarnation": "2"}
    state.observe_stats(Stats("actor", "a", {"env_steps": 100.0}, first), 0)
    state.observe_stats(Stats("learner", "l", {"learner_steps": 70.0}, first), 0)
    state.observe_presence("learner", "l", alive=False)
    for role, name in (("actor", "a"), ("learner", "l")):
        state.observe_stats(Stats(role, name, {}, {**second, DOING: COMPILING}), 1)
    assert [service.compiling for service in state.services] == [True, True]
    assert (state.env_steps, state.learner_steps) == (100, 70)
    state.observe_stats(Stats("actor", "a", {"env_steps": 130.0}, second), 2)
    assert state.env_steps == 230
    assert [service.compiling for service in state.services] == [False, True]
