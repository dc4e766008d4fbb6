"""The nouns of the data path: all messages between actors, replay, learner and watchers.

Invariants: every array's dtype and shape is declared here and nowhere else; instances are
frozen; no clock, lock or transport appears here.

Shapes: H = frames stacked in one state - 1, T = transitions of a chunk, n = longest n-step
return, W = H + 1 + n records that one transition may touch, B = transitions of a batch,
K = robots of an arena, A = arenas, R = bytes of one observation record.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Any, Self

import numpy as np

from mrcdrl.common.runtime.files import sha256

# Spelled out because numpy.typing.NDArray, an alias from 2.5 on, hides its dtype.
UInt8Array = np.ndarray[tuple[Any, ...], np.dtype[np.uint8]]
Float32Array = np.ndarray[tuple[Any, ...], np.dtype[np.float32]]
Float64Array = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
Int64Array = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
BoolArray = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]

NUM_ACTIONS = 3  # left, straight, right (paper section 3); a custom world has its own number
NO_SLOT = -1  # an actor without an exploration slot
DOING = "doing"  # a text in Stats: what keeps a service from its work
COMPILING = "compiling"  # its functions, once


class StepType(IntEnum):
    """Position of a time step in its episode (dm_env's terms)."""

    FIRST = 0
    MID = 1
    LAST = 2


class Outcome(StrEnum):
    """How an episode ended; a custom world's failures of any kind count as collisions."""

    SUCCESS = "success"
    COLLISION = "collision"
    TIMEOUT = "timeout"


@dataclass(frozen=True, slots=True)
class TimeStep:
    """An arena's result for all of its robots, after a reset or a step."""

    step_type: StepType
    records: UInt8Array  # [K, R], one observation record for each robot
    rewards: Float32Array  # [K], zero at FIRST
    discount: float  # 0 after a termination (success, failure), else 1; gamma is the agent's
    collided: BoolArray  # [K], the robot's move was undone in this frame
    hit_wall: BoolArray  # [K], it collided with a wall or obstacle
    outcome: Outcome | None = None  # set at LAST

    @property
    def first(self) -> bool:
        return self.step_type is StepType.FIRST

    @property
    def last(self) -> bool:
        return self.step_type is StepType.LAST


@dataclass(frozen=True, slots=True)
class TimeSteps:
    """Time steps of A arenas stepped together, after a step."""

    records: UInt8Array  # [A, K, R]
    rewards: Float32Array  # [A, K]
    collided: BoolArray  # [A, K]
    hit_wall: BoolArray  # [A, K]
    outcomes: tuple[Outcome | None, ...]  # A, set at LAST

    def __iter__(self) -> Iterator[TimeStep]:
        return (self[arena] for arena in range(len(self.outcomes)))

    @property
    def terminated(self) -> BoolArray:
        """The arenas [A] whose episodes ended, and not by the time limit."""
        return np.array([_terminates(outcome) for outcome in self.outcomes])

    def __getitem__(self, arena: int) -> TimeStep:
        """The time step of one arena."""
        outcome = self.outcomes[arena]
        return TimeStep(
            step_type=StepType.MID if outcome is None else StepType.LAST,
            records=self.records[arena],
            rewards=self.rewards[arena],
            discount=0.0 if _terminates(outcome) else 1.0,
            collided=self.collided[arena],
            hit_wall=self.hit_wall[arena],
            outcome=outcome,
        )


def _terminates(outcome: Outcome | None) -> bool:
    return outcome is not None and outcome is not Outcome.TIMEOUT


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive transitions of one robot, with the history before and the bootstrap after.

    Transition t (0 <= t < T) has state records[t : t + H + 1], action actions[t], n-step return
    rewards[t], and bootstraps with discounts[t] from the state
    records[t + k : t + k + H + 1], k = bootstrap_offsets[t]. The first record of an episode is
    repeated before its start, the last one after its end, to fill the window.
    """

    actor: str
    incarnation: int  # differs for every start of the same actor
    sequence: int  # 0, 1, 2, … without gaps within an incarnation
    weights_version: int  # the oldest that chose one of these actions
    records: UInt8Array  # [H + T + n, R]
    actions: UInt8Array  # [T]
    rewards: Float32Array  # [T], sum of k discounted rewards
    discounts: Float32Array  # [T], gamma**k, or 0 where the episode terminated
    bootstrap_offsets: UInt8Array  # [T], k, 1..n
    priorities: Float32Array  # [T], initial priorities (absolute TD errors), or [0]

    def __len__(self) -> int:
        return len(self.actions)


@dataclass(frozen=True, slots=True)
class Samples:
    """Transitions sampled from the table, as records."""

    keys: Int64Array  # [B], identify the transitions in a priority update
    probabilities: Float64Array  # [B], of being sampled
    table_size: int  # transitions in the table when sampled
    total_priority: float  # sum of scaled priorities in the table; its size if sampling is uniform
    actions: UInt8Array  # [B]
    rewards: Float32Array  # [B]
    discounts: Float32Array  # [B]
    bootstrap_offsets: UInt8Array  # [B]
    weights_versions: Int64Array  # [B], of the transitions' chunks
    records: UInt8Array  # [B, W, R]; last, so that a message can be built around it

    def __len__(self) -> int:
        return len(self.actions)


@dataclass(frozen=True, slots=True)
class InsertReply:
    """Replay's acknowledgement: the chunk is stored (or was before)."""

    sequence: int
    duplicate: bool
    inserts: int  # transitions accepted since the run began


@dataclass(frozen=True, slots=True)
class Priorities:
    """New priorities of sampled transitions; the last one counts for a repeated key."""

    keys: Int64Array  # [B], from Samples
    priorities: Float32Array  # [B], absolute TD errors


@dataclass(frozen=True, slots=True)
class PrioritiesReply:
    """Replay's acknowledgement of priorities."""

    updated: int
    ignored: int  # of transitions evicted meanwhile; all of them if sampling is uniform


@dataclass(frozen=True, slots=True)
class LeaseRequest:
    """An actor's request to get, to renew or to return an exploration slot."""

    actor: str
    incarnation: int  # differs for every start of the actor
    slot: int  # the last one it had; NO_SLOT if none
    holds: bool  # by its own clock, the lease of that slot still runs
    ends: bool  # it needs no slot any more


@dataclass(frozen=True, slots=True)
class LeaseReply:
    """Replay's answer: a slot leased to the actor for `lease_s` from when it asked."""

    slot: int  # NO_SLOT: none now, ask again
    rank: int  # exploration rank: its place on the ladder
    num_places: int  # on the ladder
    lease_s: float


@dataclass(frozen=True, slots=True)
class Weights:
    """The network's parameters as published; newer means a larger (epoch, version).

    `of` computes the digest. Weights whose digest does not match are torn; the wire refuses them.
    """

    epoch: int  # rises when a run's learner starts from new parameters
    version: int  # rises with every publication, even across restarts
    learner_step: int
    payload: bytes  # safetensors: arrays by parameter name, all of one precision
    digest: str  # SHA-256 of the payload, hexadecimal

    @classmethod
    def of(cls, epoch: int, version: int, learner_step: int, payload: bytes) -> Self:
        """Make weights with the digest of the payload."""
        return cls(epoch, version, learner_step, payload, sha256(payload))

    @property
    def order(self) -> tuple[int, int]:
        return (self.epoch, self.version)


@dataclass(frozen=True, slots=True)
class WeightsNotice:
    """Says that there are new weights, and where to get them without asking the learner."""

    epoch: int  # these three as in Weights
    version: int
    learner_step: int
    digest: str  # SHA-256 of the payload, hexadecimal
    num_bytes: int  # length of the payload
    address: str  # of the payload in sealed memory of the learner's host; "" if it shares none

    @property
    def order(self) -> tuple[int, int]:
        return (self.epoch, self.version)


@dataclass(frozen=True, slots=True)
class EpisodeSummary:
    """One finished training episode."""

    actor: str
    arena: int
    episode: int  # counter of this actor
    outcome: Outcome
    frames: int  # env steps of the episode
    score: float  # sum of rewards, mean over robots (Fig. 6a)
    collisions: int
    epsilon: float
    weights_version: int
    mean_q: float  # value of the greedy action, mean over the episode (Fig. 7a-c)
    num_robots: int  # of the episode


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Result of the paper's test (section 5.3) for one version of the weights."""

    worker: str
    weights_epoch: int
    weights_version: int
    learner_step: int
    num_robots: int
    episodes: int
    success_rate: float
    collision_rate: float
    timeout_rate: float
    success_interval: tuple[float, float]  # 95 % Wilson interval of success_rate
    max_per_100: float
    mean_per_100: float
    variance_per_100: float
    mean_frames: float  # to success
    mean_score: float
    seed: int
    wall_s: float


@dataclass(frozen=True, slots=True)
class ArenaFrame:
    """One frame of an episode, for people to watch; K, M and O count what is there.

    The values, actions and images are those of the robots in this scene. The last frame of an
    episode has an outcome, and neither values nor actions. In a custom world robots are its agents,
    and stand at the origin.
    """

    role: str
    worker: str
    arena: int  # index among the worker's arenas
    episode: int  # counter of what this worker has shown
    frame: int  # 0 at the start
    weights_version: int  # that chose the actions; -1: initial parameters
    epsilon: float
    robots: Float32Array  # [K, 3], x px, y px, heading rad
    targets: Float32Array  # [M, 2], x px, y px
    obstacles: Float32Array  # [O, 3], x px, y px, radius px
    q_values: Float32Array  # [K, A], A actions, or [0, A]
    actions: UInt8Array  # [K], or [0]
    collided: UInt8Array  # [K], 1 if the move to this frame was undone
    outcome: str  # in the last frame, else empty
    view_px: int  # V
    images: bytes  # the robots' newest images, uint8 [K, V, V], as zlib data; or none


@dataclass(frozen=True, slots=True)
class Stats:
    """A service's statistics, once a second; docs/metrics.md lists the metrics."""

    role: str
    id: str
    metrics: dict[str, float]
    text: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SampleRequest:
    """A learner's request for mini-batches."""

    batch_size: int
    learner_step: int = -1  # in lockstep, the steps made before the one that it samples for
