"""What the policy sees is what replay gets, told from images that count."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from mrcdrl.common.arena import (
    ArenaBatch,
    CountingBatch,
    counting_frames,
    counting_outcome,
    counting_reward,
    decode_counters,
    make_codec,
)
from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import (
    BoolArray,
    Chunk,
    EpisodeSummary,
    Float32Array,
    Outcome,
    UInt8Array,
    Weights,
)
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.model.policy import Policy, Selection
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.sync.broadcast import Broadcast, Moment
from mrcdrl.services.actor.chunker import ChunkerConfig
from mrcdrl.services.actor.collector import Collector

VIEW_PX, ROBOTS, ARENAS, STACK, N_STEP = 32, 2, 3, 4, 3
STEPS = 60
CONFIG = Config.model_validate(
    {
        "arena": {
            "kind": "counting",
            "codec": "frames",
            "num_robots": ROBOTS,
            "view_px": VIEW_PX,
            "stack": STACK,
        },
        "agent": {"n_step": N_STEP},
    }
)
EPSILONS = np.array([0.0, 0.5, 1.0], np.float32)


@dataclass
class WatchedPolicy:
    """A policy that notes what it was shown and what it chose."""

    policy: Policy
    seen: list[UInt8Array] = field(default_factory=list)
    epsilons: list[Float32Array] = field(default_factory=list)
    selections: list[Selection] = field(default_factory=list)

    @property
    def weights_version(self) -> int:
        return self.policy.weights_version

    @property
    def learner_step(self) -> int:
        return self.policy.learner_step

    def select_actions(
        self, observations: UInt8Array, epsilon: Float32Array, rng: np.random.Generator
    ) -> Selection:
        selection = self.policy.select_actions(observations, epsilon, rng)
        self.seen.append(observations.copy())
        self.epsilons.append(epsilon)
        self.selections.append(selection)
        return selection


@dataclass
class Collected:
    """A collector after some steps, and all that came out of it."""

    collector: Collector
    policy: WatchedPolicy
    chunks: list[Chunk]
    summaries: list[EpisodeSummary]


def make_network() -> QNetwork:
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return QNetwork("dqn", view_px=VIEW_PX)


def collect(
    steps: int, *, prioritized: bool = False, broadcast: Broadcast | None = None
) -> Collected:
    policy = WatchedPolicy(Policy(make_network()))
    chunking = ChunkerConfig("actor-0", 5, 0.99, N_STEP, STACK, 7, prioritized, reward_scale=0.1)
    arenas = CountingBatch(CONFIG.arena, range(ARENAS))
    collector = Collector(
        CONFIG,
        chunking,
        arenas,
        make_codec(CONFIG.arena),
        policy,  # type: ignore[arg-type]
        np.random.default_rng(0),
        broadcast,
    )
    chunks: list[Chunk] = []
    summaries: list[EpisodeSummary] = []
    for step in range(steps):
        if step == 5:
            payload = weights_to_bytes(make_network())
            policy.policy.adopt(Weights.of(0, version=8, learner_step=80, payload=payload))
        new_chunks, new_summaries = collector.step(EPSILONS)
        chunks += new_chunks
        summaries += new_summaries
    return Collected(collector, policy, chunks, summaries)


def test_a_step_that_truncates_leaves_nothing_behind() -> None:
    collected = collect(9)
    chunks, summaries = collected.collector.step(EPSILONS, truncate=True)
    num_robots = collected.collector.num_robots
    assert num_robots == ARENAS * ROBOTS
    assert sum(map(len, collected.chunks + chunks)) == 10 * num_robots
    lasts = [chunk for chunk in chunks if chunk.discounts[-1] == np.float32(0.99)]
    assert len(lasts) == num_robots - ROBOTS * len(summaries), "as if truncated: bootstrapped"


@pytest.fixture(scope="module")
def collected() -> Collected:
    return collect(STEPS)


def test_the_policy_sees_the_last_images_of_each_robot(collected: Collected) -> None:
    for observations in collected.policy.seen:
        assert observations.shape == (ARENAS * ROBOTS, STACK, VIEW_PX, VIEW_PX)
        counters = decode_counters(observations)
        newest = counters.step[:, -1:]
        ages = np.arange(STACK - 1, -1, -1)
        np.testing.assert_array_equal(counters.step, np.maximum(newest - ages, 0))
        assert (counters.episode == counters.episode[:, :1]).all()
        assert counters.identity[:, 0].tolist() == [0, 0, 1, 1, 2, 2]
        assert counters.robot[:, 0].tolist() == [0, 1] * ARENAS


def test_the_records_are_the_images_the_policy_acted_on(collected: Collected) -> None:
    shown: dict[tuple[int, ...], tuple[UInt8Array, int]] = {}
    for observations, selection in zip(
        collected.policy.seen, collected.policy.selections, strict=True
    ):
        counters = decode_counters(observations[:, -1])
        for state, action in enumerate(selection.actions.tolist()):
            name = tuple(
                int(numbers[state])
                for numbers in (counters.identity, counters.robot, counters.episode, counters.step)
            )
            shown[name] = (observations[state], action)
    transitions = 0
    for chunk in collected.chunks:
        images = chunk.records.reshape(-1, VIEW_PX, VIEW_PX)
        counters = decode_counters(images)
        for t in range(len(chunk)):
            newest = t + STACK - 1
            name = tuple(
                int(numbers[newest])
                for numbers in (counters.identity, counters.robot, counters.episode, counters.step)
            )
            stack, action = shown.pop(name)
            np.testing.assert_array_equal(images[t : t + STACK], stack)
            assert chunk.actions[t] == action
            transitions += 1
    assert transitions > ROBOTS * ARENAS * (STEPS - 12)


def test_rewards_and_discounts_are_the_arenas(collected: Collected) -> None:
    for chunk in collected.chunks:
        counters = decode_counters(chunk.records.reshape(-1, VIEW_PX, VIEW_PX))
        identity, episode = int(counters.identity[0]), int(counters.episode[0])
        frames = counting_frames(identity, episode)
        for t in range(len(chunk)):
            step = int(counters.step[t + STACK - 1])
            offset = min(N_STEP, frames - step)
            rewards = [counting_reward(episode, step + 1 + i) for i in range(offset)]
            discounts = [0.99**i for i in range(offset)]
            assert chunk.bootstrap_offsets[t] == offset
            assert chunk.rewards[t] == pytest.approx(np.dot(rewards, discounts), rel=1e-6)
            ends_well = (
                step + offset == frames and counting_outcome(identity, episode) is Outcome.SUCCESS
            )
            assert chunk.discounts[t] == pytest.approx(0.0 if ends_well else 0.99**offset)


def test_chunks_are_numbered_over_all_arenas_and_bear_the_weights(collected: Collected) -> None:
    assert [chunk.sequence for chunk in collected.chunks] == list(range(len(collected.chunks)))
    assert {(chunk.actor, chunk.incarnation) for chunk in collected.chunks} == {("actor-0", 5)}
    versions = [chunk.weights_version for chunk in collected.chunks]
    assert set(versions) == {0, 8}
    assert versions[-1] == 8


def test_each_arena_explores_with_its_own_epsilon(collected: Collected) -> None:
    assert collected.policy.epsilons[0].tolist() == [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]
    greedy = [s.q_values.argmax(axis=1)[:ROBOTS] for s in collected.policy.selections]
    taken = [s.actions[:ROBOTS] for s in collected.policy.selections]
    np.testing.assert_array_equal(taken, greedy)


def test_summaries_sum_the_episodes(collected: Collected) -> None:
    assert [summary.episode for summary in collected.summaries] == list(
        range(1, len(collected.summaries) + 1)
    )
    for arena in range(ARENAS):
        mine = [summary for summary in collected.summaries if summary.arena == arena]
        began = 0
        for episode, summary in enumerate(mine):
            frames = counting_frames(arena, episode)
            rewards = [counting_reward(episode, step + 1) for step in range(frames)]
            selections = collected.policy.selections[began : began + frames]
            robots = slice(arena * ROBOTS, (arena + 1) * ROBOTS)
            assert summary.frames == frames
            assert summary.score == pytest.approx(sum(rewards))
            assert summary.outcome is counting_outcome(arena, episode)
            assert summary.epsilon == EPSILONS[arena]
            assert summary.weights_version == (0 if began < 5 else 8)
            assert summary.mean_q == pytest.approx(
                np.mean([s.greedy_q[robots].mean() for s in selections]), rel=1e-5
            )
            assert (summary.actor, summary.collisions) == ("actor-0", 0)
            began += frames
        assert began <= STEPS


def test_counters(collected: Collected) -> None:
    collector = collected.collector
    assert collector.env_steps == STEPS * ARENAS
    assert collector.robot_steps == STEPS * ARENAS * ROBOTS
    assert collector.num_episodes == len(collected.summaries) > ARENAS
    seconds = collector.seconds
    assert min(seconds.inference, seconds.arena, seconds.draw, seconds.chunk) > 0


def test_the_same_seeds_give_the_same_chunks(collected: Collected) -> None:
    for ours, theirs in zip(collect(20).chunks, collected.chunks, strict=False):
        np.testing.assert_array_equal(ours.records, theirs.records)
        np.testing.assert_array_equal(ours.actions, theirs.actions)


def test_priorities_are_the_td_errors_of_the_values_acted_by(collected: Collected) -> None:
    """Known from evaluating the sent states again; the weights adopted meanwhile are the same."""
    network = Policy(make_network())
    prioritized = collect(STEPS, prioritized=True).chunks
    assert sum(map(len, prioritized)) > ROBOTS * ARENAS * (STEPS - 12)
    for chunk in prioritized:
        images = chunk.records.reshape(-1, VIEW_PX, VIEW_PX)
        counters = decode_counters(images)
        frames = counting_frames(int(counters.identity[0]), int(counters.episode[0]))
        for t, offset in enumerate(chunk.bootstrap_offsets.tolist()):
            now = network.q_values(images[np.newaxis, t : t + STACK])[0]
            # nobody acted in an episode's last state: the one before stands for it
            step = int(counters.step[t + STACK - 1])
            ahead = min(offset, frames - 1 - step)
            later = network.q_values(images[np.newaxis, t + ahead : t + ahead + STACK])[0]
            target = 0.1 * chunk.rewards[t] + chunk.discounts[t] * later.max()
            error = abs(target - now[chunk.actions[t]])
            assert chunk.priorities[t] == pytest.approx(error, rel=1e-4, abs=1e-5)
    assert {len(chunk.priorities) for chunk in collected.chunks} == {0}


def test_absent_robots_bear_no_transitions() -> None:
    all_rewards_are_1 = dict.fromkeys(("success_reward", "collision_reward", "step_reward"), 1.0)
    all_rewards_are_1 |= {"proximity_weight": 0, "f_max": 10**9}
    config = Config.model_validate(
        {
            "arena": {"robots": [1, 3], "max_frames": 12, "view_px": VIEW_PX, **all_rewards_are_1},
            "curriculum": {"schedule": [[0, 1, 9]]},
        }
    )
    policy = WatchedPolicy(Policy(make_network()))
    chunking = ChunkerConfig("actor-0", 5, 0.99, 1, STACK, 5)
    arenas = ArenaBatch(config.arena, [np.random.default_rng(i) for i in range(ARENAS)])
    collector = Collector(
        config,
        chunking,
        arenas,
        make_codec(config.arena),
        policy,  # type: ignore[arg-type]
        np.random.default_rng(0),
    )
    transitions, expected, numbers = 0, 0, set()
    for step in range(60):
        present = arenas.present.copy()
        numbers |= set(present.tolist())
        expected += int(present.sum())
        chunks, summaries = collector.step(EPSILONS, truncate=step == 59)
        assert len(policy.seen[-1]) == present.sum(), "only those that are there are acted for"
        assert all(policy.seen[-1].reshape(present.sum(), -1).any(axis=1))
        transitions += sum(map(len, chunks))
        for chunk in chunks:
            assert np.isfinite(chunk.records.view("<f4")[:, :3]).all()
        for summary in summaries:
            assert summary.score == pytest.approx(summary.frames), "a mean over those there"
            assert summary.num_robots == present[summary.arena]
    assert numbers == {1, 3}
    assert transitions == expected == collector.robot_steps < 60 * collector.num_robots


def test_who_is_watched_collects_the_same() -> None:
    """What is shown are the frames that were played, and they have no effect."""
    shown: list[tuple[int, bytes, bytes, str]] = []

    class Shown(Broadcast):
        """Keeps what a worker would show."""

        watched = True

        def __init__(self) -> None:
            pass

        def acts(self, moment: Moment, q_values: Float32Array, actions: UInt8Array) -> None:
            assert q_values.shape == (ROBOTS, 3)
            shown.append((moment.frame, moment.images.tobytes(), actions.tobytes(), ""))

        def stepped(
            self, collided: BoolArray, last: Moment | None, outcome: Outcome | None
        ) -> None:
            assert collided.shape == (ROBOTS,)
            assert (last is None) == (outcome is None)
            if last is not None and outcome is not None:
                shown.append((last.frame, last.images.tobytes(), b"", outcome))

    alone, watched = collect(STEPS), collect(STEPS, broadcast=Shown())
    assert [encode(chunk) for chunk in watched.chunks] == [encode(c) for c in alone.chunks]
    assert watched.summaries == alone.summaries
    ends = [i for i, frame in enumerate(shown) if frame[3]]
    assert len(ends) >= 2
    lengths = [counting_frames(0, episode) for episode in range(len(ends))]
    frames = [frame for frame, *_ in shown]
    expected = [f for length in lengths for f in range(length + 1)]
    assert frames[: len(expected)] == expected
    for frame, images, _, outcome in shown[: ends[1] + 1]:
        counters = decode_counters(
            np.frombuffer(images, np.uint8).reshape(ROBOTS, VIEW_PX, VIEW_PX)
        )
        assert counters.step.tolist() == [frame] * ROBOTS
        assert outcome in ("", "success", "timeout")
