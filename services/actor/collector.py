"""Steps many arenas together, with one batched inference for all of their robots.

Invariants: the policy sees images rendered from the very records that go to replay; no threads, no
transport, no decisions by the clock; each arena explores independently. Robots that are absent from
an episode are not acted for and bear no transitions.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrcdrl.common.arena import Arenas, ObservationCodec
from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import (
    NUM_ACTIONS,
    Chunk,
    EpisodeSummary,
    Float32Array,
    Float64Array,
    Int64Array,
    TimeStep,
    TimeSteps,
    UInt8Array,
)
from mrcdrl.common.model.policy import FrameStack, Policy
from mrcdrl.common.sync.broadcast import ARENA, Broadcast, Moment
from mrcdrl.services.actor.chunker import Chunker, ChunkerConfig
from mrcdrl.services.actor.curriculum import Curriculum
from mrcdrl.services.actor.training_rewards import TrainingRewards


@dataclass(slots=True)
class Seconds:
    """Seconds that a collector has spent on each stage, since the start."""

    inference: float = 0.0
    arena: float = 0.0
    draw: float = 0.0
    chunk: float = 0.0


@dataclass(slots=True)
class _Episode:
    """Sums over an episode in progress."""

    rewards: float = 0.0
    greedy_q: float = 0.0
    frames: int = 0
    collisions: int = 0
    versions: list[int] = field(default_factory=list)


class Collector:
    """Steps arenas by a policy; `step` returns the completed chunks and episodes."""

    def __init__(
        self,
        config: Config,
        chunking: ChunkerConfig,
        arenas: Arenas,
        codec: ObservationCodec,
        policy: Policy,
        rng: np.random.Generator,
        broadcast: Broadcast | None = None,
    ) -> None:
        """broadcast: is shown one of the arenas, while anybody watches."""
        self._broadcast = broadcast
        self._shown_frames = 0  # of the episode that is shown
        self._q_values: Float32Array = np.zeros((0, NUM_ACTIONS), np.float32)  # as chosen by
        self._actor = chunking.actor
        self._arenas = arenas
        self._codec = codec
        self._policy = policy
        self._rng = rng
        self._num_robots = config.arena.num_robots
        self._mixes_numbers = config.arena.mixes_numbers
        self.curriculum = Curriculum(config.curriculum, config.arena)
        self._chunkers = [
            [Chunker(chunking) for _ in range(self._num_robots)] for _ in range(len(arenas))
        ]
        self._frames = FrameStack(self.num_robots, config.arena.stack, config.arena.view_px)
        self._sequence: Iterator[int] = iter(range(2**62))
        self._episodes = [_Episode() for _ in range(len(arenas))]
        self._rewards = TrainingRewards(config, arenas)
        self.seconds = Seconds()
        self.env_steps = 0
        self.robot_steps = 0  # transitions collected so far
        self.num_episodes = 0
        self._reset(range(len(arenas)))

    @property
    def num_robots(self) -> int:
        """Robots in all arenas, and so the most transitions of a step."""
        return len(self._arenas) * self._num_robots

    def step(
        self, epsilons: Float32Array, *, truncate: bool = False
    ) -> tuple[list[Chunk], list[EpisodeSummary]]:
        """Step every arena once, arena e exploring with epsilons[e].

        truncate: this is the last step; the episodes are chunked to here, as if truncated.
        """
        started = time.perf_counter()
        present = self._arenas.present.copy()
        actions, taken_q, greedy_q = self._select_actions(epsilons, present)
        inferred = time.perf_counter()
        self._show(actions, float(epsilons[ARENA]))
        time_steps = self._arenas.step(actions)
        stepped = time.perf_counter()
        rewards = self._rewards.after(time_steps, self._policy.learner_step)
        chunks = [
            chunk
            for index, time_step in enumerate(time_steps)
            for chunk in self._add(
                index,
                actions[index],
                rewards[index],
                taken_q[index],
                greedy_q[index],
                time_step,
                truncate,
            )
        ]
        mean_q = greedy_q.sum(axis=1) / present.astype(np.float32)
        for episode, time_step, q, number in zip(
            self._episodes, time_steps, mean_q, present.tolist(), strict=True
        ):
            episode.frames += 1
            episode.rewards += float(time_step.rewards[:number].mean())
            episode.collisions += int(time_step.collided.sum())
            episode.greedy_q += float(q)
            episode.versions.append(self._policy.weights_version)
        ended = [index for index, time_step in enumerate(time_steps) if time_step.last]
        summaries = [self._summary(i, time_steps[i], float(epsilons[i])) for i in ended]
        chunked = time.perf_counter()
        records = time_steps.records.reshape(self.num_robots, -1)
        self._frames.push(self._codec.decode(records))
        self._show_step(time_steps, float(epsilons[ARENA]))
        self._reset(ended)
        self.env_steps += len(self._arenas)
        self.robot_steps += int(present.sum())
        self.seconds.inference += inferred - started
        self.seconds.arena += stepped - inferred
        self.seconds.chunk += chunked - stepped
        self.seconds.draw += time.perf_counter() - chunked
        return chunks, summaries

    def continue_counts(self, before: "Collector") -> None:
        """Continue the counters of a previous collector."""
        self.seconds = before.seconds
        self.env_steps, self.num_episodes = before.env_steps, before.num_episodes
        self.robot_steps = before.robot_steps

    def _select_actions(
        self, epsilons: Float32Array, present: Int64Array
    ) -> tuple[UInt8Array, Float32Array, Float32Array]:
        """Actions, their values and those of the best ones, each [A, K]; 0 for absent robots."""
        shape = (len(self._arenas), self._num_robots)
        per_robot, stacks = np.repeat(epsilons, self._num_robots), self._frames.stacks
        if not self._mixes_numbers:
            chosen = self._policy.select_actions(stacks, per_robot, self._rng)
            self._q_values = chosen.q_values
            columns = (chosen.actions, chosen.taken_q, chosen.greedy_q)
            return columns[0].reshape(shape), columns[1].reshape(shape), columns[2].reshape(shape)
        there = (np.arange(self._num_robots) < present[:, None]).reshape(-1)
        chosen = self._policy.select_actions(stacks[there], per_robot[there], self._rng)
        self._q_values = chosen.q_values
        actions, taken_q = np.zeros(shape, np.uint8), np.zeros(shape, np.float32)
        greedy_q = np.zeros(shape, np.float32)
        actions.reshape(-1)[there] = chosen.actions
        taken_q.reshape(-1)[there] = chosen.taken_q
        greedy_q.reshape(-1)[there] = chosen.greedy_q
        return actions, taken_q, greedy_q

    def _show(self, actions: UInt8Array, epsilon: float) -> None:
        """Show the scene of one arena and what was chosen in it, if anybody watches."""
        if self._broadcast is not None and self._broadcast.watched:
            number = int(self._arenas.present[ARENA])
            moment = self._moment(self._episodes[ARENA].frames, epsilon)
            self._broadcast.acts(moment, self._q_values[:number], actions[ARENA, :number])

    def _show_step(self, time_steps: TimeSteps, epsilon: float) -> None:
        """Show what the step has come to in that arena."""
        if self._broadcast is not None and self._broadcast.watched:
            number, outcome = int(self._arenas.present[ARENA]), time_steps.outcomes[ARENA]
            # an episode that has ended is summed up, and its frames are counted from 0 again
            last = None if outcome is None else self._moment(self._shown_frames, epsilon)
            self._broadcast.stepped(time_steps.collided[ARENA, :number], last, outcome)

    def _moment(self, frame: int, epsilon: float) -> Moment:
        number = int(self._arenas.present[ARENA])
        images = self._frames.stacks[:number, -1].copy()
        scene = self._arenas.scene(ARENA)
        self._shown_frames = frame + 1
        return Moment(frame, scene, images, self._policy.weights_version, epsilon)

    def _add(
        self,
        index: int,
        actions: UInt8Array,
        rewards: Float64Array,
        taken_q: Float32Array,
        greedy_q: Float32Array,
        time_step: TimeStep,
        truncate: bool,
    ) -> Iterator[Chunk]:
        for robot, chunker in enumerate(self._chunkers[index][: self._arenas.present[index]]):
            yield from chunker.add(
                int(actions[robot]),
                float(rewards[robot]),
                time_step.records[robot],
                taken_q=float(taken_q[robot]),
                greedy_q=float(greedy_q[robot]),
                weights_version=max(self._policy.weights_version, 0),
                last=time_step.last or truncate,
                discount=time_step.discount,
                sequence=self._sequence,
            )

    def _reset(self, indices: Sequence[int]) -> None:
        """Start new episodes in these arenas."""
        if indices and self._mixes_numbers:
            self._arenas.chances = self.curriculum.chances(self._policy.learner_step)
        for index in indices:
            time_step = self._arenas.reset(index)
            for robot in range(self._arenas.present[index]):
                self._chunkers[index][robot].start(time_step.records[robot])
            first = index * self._num_robots
            states = slice(first, first + self._num_robots)
            self._frames.reset(states, self._codec.decode(time_step.records))
        self._rewards.start(indices, self._policy.learner_step)

    def _summary(self, index: int, time_step: TimeStep, epsilon: float) -> EpisodeSummary:
        episode = self._episodes[index]
        if time_step.outcome is None:
            raise ValueError("an arena ended an episode without an outcome")
        self._episodes[index] = _Episode()
        self.num_episodes += 1
        number = int(self._arenas.present[index])
        self.curriculum.add(number, time_step.outcome, episode.frames)
        return EpisodeSummary(
            actor=self._actor,
            arena=index,
            episode=self.num_episodes,
            outcome=time_step.outcome,
            frames=episode.frames,
            score=episode.rewards,
            collisions=episode.collisions,
            epsilon=epsilon,
            weights_version=max(min(episode.versions), 0),
            mean_q=episode.greedy_q / episode.frames,
            num_robots=number,
        )
