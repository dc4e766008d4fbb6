"""Shaping pays for nothing but the start of an episode; collisions cost what is scheduled."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.arena import make_arenas, make_codec
from mrcdrl.common.config import Config
from mrcdrl.common.config.returns import largest_n_step_return
from mrcdrl.common.messages.trajectory import (
    BoolArray,
    Chunk,
    EpisodeSummary,
    Float64Array,
    Int64Array,
    Outcome,
    TimeSteps,
    Weights,
)
from mrcdrl.common.model.policy import Policy
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.services.actor.chunker import Chunker, ChunkerConfig
from mrcdrl.services.actor.collector import Collector
from mrcdrl.services.actor.training_rewards import TrainingRewards

PER_PX = 0.25


def config_of(gamma: float = 0.9, **agent: object) -> Config:
    arena = {"num_robots": 1}
    given = {"gamma": gamma, "shaping_per_px": PER_PX} | agent
    return Config.model_validate({"arena": arena, "agent": given})


@dataclass
class Told:
    """An arena of one robot, whose distance is what a test says."""

    distance_px: float = 0.0
    occupied: bool = False
    asked: int = 0

    def __len__(self) -> int:
        return 1

    def assigned_distances_px(self, arenas: Int64Array) -> Float64Array:
        self.asked += 1
        return np.full((len(arenas), 1), self.distance_px)

    def drawn_to_occupied(self, arenas: Int64Array) -> BoolArray:
        self.asked += 1
        return np.full((len(arenas), 1), self.occupied)


def step_of(reward: float, outcome: Outcome | None = None, *, collided: bool = False) -> TimeSteps:
    return TimeSteps(
        records=np.zeros((1, 1, 1), np.uint8),
        rewards=np.array([[reward]], np.float32),
        collided=np.array([[collided]]),
        hit_wall=np.array([[False]]),
        outcomes=(outcome,),
    )


@dataclass(frozen=True)
class Episode:
    """Distances in its states, one more than rewards; how it ends; learner steps of its states."""

    distances_px: list[float]
    rewards: list[float]
    outcome: Outcome
    learner_steps: list[int]

    @property
    def truncated(self) -> bool:
        return self.outcome is Outcome.TIMEOUT


@st.composite
def episodes(draw: st.DrawFn) -> Episode:
    length = draw(st.integers(1, 12))

    def some(of: st.SearchStrategy[int], num: int) -> list[int]:
        return draw(st.lists(of, min_size=num, max_size=num))

    return Episode(
        list(map(float, some(st.integers(0, 800), length + 1))),
        list(map(float, some(st.integers(-8, 8), length))),
        draw(st.sampled_from(Outcome)),
        some(st.integers(0, 30), length + 1),
    )


def shaped(config: Config, played: Episode) -> list[float]:
    """The rewards of an episode as they are learned from."""
    arena = Told(played.distances_px[0])
    rewards = TrainingRewards(config, arena)  # type: ignore[arg-type]
    rewards.start([0], played.learner_steps[0])
    found = []
    for i, reward in enumerate(played.rewards, start=1):
        arena.distance_px = played.distances_px[i]
        outcome = played.outcome if i == len(played.rewards) else None
        found.append(float(rewards.after(step_of(reward, outcome), played.learner_steps[i])[0, 0]))
    return found


def potentials(config: Config, played: Episode) -> list[float]:
    """Phi of the episode's states, as the definition has it; 0 where it terminated."""
    factors = np.interp(played.learner_steps, *zip(*config.agent.shaping_schedule, strict=True))
    found: list[float] = (-PER_PX * factors * played.distances_px).tolist()
    return found if played.truncated else [*found[:-1], 0.0]


def n_step_returns(config: Config, rewards: list[float], n_step: int) -> Chunk:
    """One chunk with all returns of an episode that is truncated."""
    gamma = config.agent.gamma
    chunker = Chunker(ChunkerConfig("a", 0, gamma, n_step, 1, len(rewards)))
    chunker.start(np.zeros(1, np.uint8))
    for i, reward in enumerate(rewards, start=1):
        chunks = chunker.add(
            0,
            reward,
            np.zeros(1, np.uint8),
            taken_q=0.0,
            greedy_q=0.0,
            weights_version=0,
            last=i == len(rewards),
            discount=1.0,
            sequence=iter(range(9)),
        )
    (chunk,) = chunks
    return chunk


SCHEDULES = [((0, 1.0),), ((0, 1.0), (20, 0.0)), ((0, 0.5), (9, 1.0), (10, 0.0))]


@given(episodes(), st.sampled_from(SCHEDULES), st.integers(1, 15))
def test_n_step_returns_change_by_the_potentials_at_both_ends_alone(
    played: Episode, schedule: tuple[tuple[int, float], ...], n_step: int
) -> None:
    """An n of the whole episode: the return less Phi of the start, whatever lay between."""
    config = config_of(shaping_schedule=schedule, n_step=n_step)
    found = n_step_returns(config, shaped(config, played), n_step)
    plain = n_step_returns(config, played.rewards, n_step)
    phi = np.array(potentials(config, played))
    starts = np.arange(len(plain))
    ends = phi[starts + plain.bootstrap_offsets]
    expected = plain.rewards + plain.discounts * ends - phi[starts]
    np.testing.assert_allclose(found.rewards, expected, rtol=1e-5, atol=1e-4)
    if n_step >= len(played.rewards) and not played.truncated:
        assert found.rewards[0] == pytest.approx(plain.rewards[0] - phi[0], rel=1e-5, abs=1e-4)
    change = np.abs(found.rewards - plain.rewards).max()
    assert change <= largest_n_step_return(config) - largest_n_step_return(
        config_of(shaping_per_px=0.0, n_step=n_step)
    )


def test_a_step_that_nears_the_target_pays_by_hand() -> None:
    """0.9 x -0.25 x 90 + 0.25 x 100, then a success, then a start that owes nothing to it."""
    config, arena = config_of(), Told(100.0)
    rewards = TrainingRewards(config, arena)  # type: ignore[arg-type]
    rewards.start([0], 0)
    arena.distance_px = 90.0
    assert rewards.after(step_of(1.0), 0)[0, 0] == pytest.approx(1.0 - 20.25 + 25.0)
    arena.distance_px = 10.0
    assert rewards.after(step_of(200.0, Outcome.SUCCESS), 0)[0, 0] == pytest.approx(200.0 + 22.5)
    arena.distance_px = 40.0
    rewards.start([0], 0)
    assert rewards.after(step_of(0.0, Outcome.TIMEOUT), 0)[0, 0] == pytest.approx(-9.0 + 10.0)


def test_the_price_of_a_collision_follows_its_schedule() -> None:
    config = config_of(shaping_per_px=0.0, collision_schedule=((0, 1.0), (10, 5.0)))
    arena = Told(100.0)
    rewards = TrainingRewards(config, arena)  # type: ignore[arg-type]
    rewards.start([0], 0)
    prices = [rewards.after(step_of(-5.0, collided=True), step)[0, 0] for step in (0, 5, 10, 99)]
    assert prices == [-5.0, -15.0, -25.0, -25.0]
    assert rewards.after(step_of(-5.0), 99)[0, 0] == -5.0
    assert not arena.asked, "without shaping nobody assigns targets"


@pytest.mark.parametrize(
    ("occupied", "reward", "outcome", "collided", "expected"),
    [
        (True, 0.8, None, False, 0.03),
        (True, 0.8, Outcome.TIMEOUT, False, 0.03),
        (True, 0.03, None, False, 0.03),  # too far to be paid
        (False, 0.8, None, False, 0.8),
        (True, -5.0, None, True, -5.0),
        (True, -5.0, Outcome.COLLISION, True, -5.0),
        (True, 200.0, Outcome.SUCCESS, False, 200.0),
    ],
)
def test_a_target_of_another_robot_need_not_pay(
    occupied: bool, reward: float, outcome: Outcome | None, collided: bool, expected: float
) -> None:
    for pays in (True, False):
        config = config_of(shaping_per_px=0.0, occupied_targets_pay=pays)
        arena = Told(occupied=occupied)
        rewards = TrainingRewards(config, arena)  # type: ignore[arg-type]
        rewards.start([0], 0)
        found = rewards.after(step_of(reward, outcome, collided=collided), 0)[0, 0]
        assert found == pytest.approx(reward if pays else expected)
        assert bool(arena.asked) is not pays, "nobody looks where it does not matter"


def optimal_values(config: Config, distances_px: list[float], *, plain: bool) -> Float64Array:
    """Q* [S, A] of a walk: left, stay or right; reaching the last place pays 3 and ends.

    Each transition's reward is what TrainingRewards makes of it.
    """
    places = len(distances_px)
    rewards, following = np.zeros((places - 1, 3)), np.zeros((places - 1, 3), np.int64)
    for place in range(places - 1):
        for action in range(3):
            to = max(place + action - 1, 0)
            ends = to == places - 1
            outcome = Outcome.SUCCESS if ends else None
            arena = Told(distances_px[place])
            made = TrainingRewards(config, arena)  # type: ignore[arg-type]
            made.start([0], 0)
            arena.distance_px = distances_px[to]
            reward = 3.0 if ends else -0.1 * action
            shaped_reward = float(made.after(step_of(reward, outcome), 0)[0, 0])
            rewards[place, action] = np.float32(reward) if plain else shaped_reward
            following[place, action] = to
    values = np.zeros((places, 3))
    for _ in range(300):
        values[:-1] = rewards + config.agent.gamma * values.max(axis=1)[following]
    return values[:-1]


@pytest.mark.parametrize(
    "distances_px", [[40.0, 30.0, 20.0, 10.0, 0.0], [3.0, 90.0, 0.0, 55.0, 7.0]]
)
def test_the_best_actions_stay_the_best(distances_px: list[float]) -> None:
    """Values fall by Phi of their state (Ng et al. 1999), also where Phi misleads."""
    config = config_of()
    plain = optimal_values(config, distances_px, plain=True)
    found = optimal_values(config, distances_px, plain=False)
    phi = -PER_PX * np.array(distances_px[:-1])
    np.testing.assert_allclose(found, plain - phi[:, None], atol=1e-9)
    assert (found.argmax(axis=1) == plain.argmax(axis=1)).all()


@dataclass
class Played:
    """What a collector made of some frames."""

    chunks: list[list[Chunk]] = field(default_factory=list)  # by frame
    summaries: list[list[EpisodeSummary]] = field(default_factory=list)  # by frame
    distances_px: list[Float64Array] = field(default_factory=list)  # [A, K], before each and after


def collect(**agent: object) -> Played:
    """Random play in small arenas, where episodes soon end in each of the three ways."""
    arena = {
        "size_px": 300,
        "num_robots": 2,
        "view_px": 31,
        "success_radius_px": 45,
        "max_collisions": 2,
        "max_frames": 25,
    }
    config = Config.model_validate({"arena": arena, "agent": {"gamma": 0.9} | agent})
    rngs = [np.random.default_rng(seed) for seed in range(3)]
    arenas = make_arenas(config.arena, rngs, range(3))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = QNetwork("dqn", view_px=31)
    policy = Policy(network)
    policy.adopt(Weights.of(0, 1, learner_step=10, payload=weights_to_bytes(network)))
    collector = Collector(
        config,
        ChunkerConfig.from_config(config, "a", 0),
        arenas,
        make_codec(config.arena),
        policy,
        np.random.default_rng(0),
    )
    played, every = Played(), np.arange(3)
    played.distances_px.append(arenas.assigned_distances_px(every))
    for frame in range(FRAMES):
        last = frame == FRAMES - 1
        chunks, summaries = collector.step(np.ones(3, np.float32), truncate=last)
        played.chunks.append(chunks)
        played.summaries.append(summaries)
        played.distances_px.append(arenas.assigned_distances_px(every))
    return played


FRAMES = 80


def test_an_actors_episodes_are_shaped_from_start_to_end() -> None:
    """Each chunk is a robot's whole episode; distances are those that the arenas tell."""
    plain = collect()
    found = collect(shaping_per_px=1.0, shaping_schedule=((0, 1.0), (20, 0.0)))
    assert found.summaries == plain.summaries, "scores know nothing of it"
    phi = -0.5 * np.array(plain.distances_px)  # [F + 1, A, K], at learner step 10
    began, outcomes = [0, 0, 0], set()
    for frame, summaries in enumerate(plain.summaries):
        ended = [summary.arena for summary in summaries] if frame < FRAMES - 1 else [0, 1, 2]
        terminated = [s.arena for s in summaries if s.outcome is not Outcome.TIMEOUT]
        outcomes |= {summary.outcome for summary in summaries}
        owners = [(arena, robot) for arena in ended for robot in range(2)]
        pairs = zip(plain.chunks[frame], found.chunks[frame], strict=True)
        for (arena, robot), (one, other) in zip(owners, pairs, strict=True):
            np.testing.assert_array_equal(one.records, other.records)
            np.testing.assert_array_equal(one.discounts, other.discounts)
            own = phi[began[arena] : frame + 2, arena, robot].copy()
            assert len(one) == len(own) - 1
            gains = other.rewards.astype(np.float64) - one.rewards
            if arena in terminated:
                own[-1] = 0.0
            elif frame < FRAMES - 1:  # timed out: the arenas tell the next start already
                own[-1] = (gains[-1] + own[-2]) / 0.9
                assert 0 < -own[-1] < 300
            np.testing.assert_allclose(gains, 0.9 * own[1:] - own[:-1], atol=1e-4)
        for arena in ended:
            began[arena] = frame + 1
    assert outcomes == set(Outcome)
