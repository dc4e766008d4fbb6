"""What a receiver checks in a message beyond its types: ranges, lengths, names; docs/wire.md.

Invariants: pure; a check returns the reason for which a message is refused, or None; nothing that
a process of ours sends is refused. What has passed needs no guard behind `decode`.
"""

import math
import re
import zlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.config.schema import MOST_ACTIONS
from mrcdrl.common.messages.metrics import SCHEMAS, DiagnosticMetrics, kinds
from mrcdrl.common.messages.trajectory import (
    NO_SLOT,
    ArenaFrame,
    Chunk,
    EpisodeSummary,
    Evaluation,
    Float32Array,
    InsertReply,
    LeaseReply,
    LeaseRequest,
    Outcome,
    Priorities,
    PrioritiesReply,
    SampleRequest,
    Samples,
    Stats,
    Weights,
    WeightsNotice,
)
from mrcdrl.common.runtime.files import sha256
from mrcdrl.common.runtime.names import MAX_NAME, is_name, printable

Range = tuple[float, float]

MAX_REPORT_BYTES = 1 << 16  # of Stats, EpisodeSummary and Evaluation: twice what the rest allows
MAX_FRAME_BYTES = 1 << 18  # of an ArenaFrame
MAX_METRICS = 256  # of one service
MAX_TEXTS = 32
MAX_TEXT = 256  # characters
_MOST = 2**53  # the largest count that a float64 holds exactly
_LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
_RATES_SUM = 1e-3  # rates rounded by a sender may miss 1 by this
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MAX_ADDRESS = 128  # characters
_COUNT: Range = (0, _MOST)
_NUMBER: Range = (-_MOST, _MOST)
_FRACTION: Range = (0, 1)
_TIME_NS: Range = (0, 2**63)
_KINDS = {role: kinds(schema) for role, schema in SCHEMAS.items()}
_MAY_DIVERGE = frozenset(kinds(DiagnosticMetrics))  # these show that learning has diverged


def _range_of_num_robots() -> Range:
    schema = ArenaConfig.model_json_schema()["properties"]["num_robots"]
    return schema["minimum"], schema["maximum"]


_NUM_ROBOTS = _range_of_num_robots()  # made once: a schema takes milliseconds

RANGES: dict[type, dict[str, Range]] = {
    InsertReply: {"sequence": _TIME_NS, "inserts": _COUNT},
    SampleRequest: {"learner_step": (-1, _MOST)},
    Samples: {"table_size": (1, _MOST)},
    PrioritiesReply: {"updated": _COUNT, "ignored": _COUNT},
    Weights: {"epoch": _TIME_NS, "version": _COUNT, "learner_step": _COUNT},
    WeightsNotice: {
        "epoch": _TIME_NS,
        "version": _COUNT,
        "learner_step": _COUNT,
        "num_bytes": (1, 2**30),
    },
    EpisodeSummary: {
        "arena": _COUNT,
        "episode": _COUNT,
        "frames": _COUNT,
        "score": _NUMBER,
        "collisions": _COUNT,
        "epsilon": _FRACTION,
        "weights_version": _COUNT,
        "num_robots": _NUM_ROBOTS,
    },
    Evaluation: {
        "weights_epoch": _TIME_NS,
        "weights_version": _COUNT,
        "learner_step": _COUNT,
        "num_robots": _NUM_ROBOTS,
        "episodes": (1, _MOST),
        "success_rate": _FRACTION,
        "collision_rate": _FRACTION,
        "timeout_rate": _FRACTION,
        "max_per_100": (0, 100),
        "mean_per_100": (0, 100),
        "variance_per_100": (0, 2500),
        "mean_frames": _COUNT,
        "mean_score": _NUMBER,
        "wall_s": _COUNT,
    },
    ArenaFrame: {
        "arena": _COUNT,
        "episode": _COUNT,
        "frame": _COUNT,
        "weights_version": (-1, _MOST),
        "epsilon": _FRACTION,
        "view_px": (1, 1024),
    },
}
"""The least and the greatest value of a message's fields; NaN is in no range."""

SENDERS: dict[type, tuple[str, ...]] = {
    Chunk: ("actor",),
    LeaseRequest: ("actor",),
    EpisodeSummary: ("actor",),
    Evaluation: ("worker",),
    Stats: ("role", "id"),
    ArenaFrame: ("role", "worker"),
}
"""The fields that name who sent a message; a publication's key ends with them."""


def problem(message: Any) -> str | None:
    """Why a message of the right types is refused; None if it is sound."""
    cls = type(message)
    for name in SENDERS.get(cls, ()):
        if not is_name(getattr(message, name)):
            return f"{name} is not a name of up to {MAX_NAME} letters, digits, '.', '_' and '-'"
    for name, (low, high) in RANGES.get(cls, {}).items():
        value = getattr(message, name)
        if not low <= value <= high:
            return f"{name} {value:g} is outside {low:g} ... {high:g}"
    check = _CHECKS.get(cls)
    return None if check is None else check(message)


def _check_chunk(chunk: Chunk) -> str | None:
    arrays = (chunk.rewards, chunk.discounts, chunk.bootstrap_offsets)
    if any(a.ndim != 1 for a in (chunk.actions, *arrays, chunk.priorities)):
        return "actions, rewards, discounts, bootstrap_offsets and priorities are vectors"
    length = len(chunk.actions)
    if length == 0 or any(len(a) != length for a in arrays):
        return "actions, rewards, discounts and bootstrap_offsets differ in length, or are empty"
    if len(chunk.priorities) not in (0, length):
        return "priorities is neither empty nor as long as actions"
    if chunk.records.ndim != 2 or chunk.records.shape[0] <= length:
        return "records is not a matrix with more rows than there are transitions"
    if not _may_be_errors(chunk.priorities):
        return "a priority is negative or not finite"
    if chunk.sequence < 0 or chunk.weights_version < 0:
        return "sequence or weights_version is negative"
    return _check_transitions(chunk)


def _check_samples(samples: Samples) -> str | None:
    vectors = (
        samples.keys,
        samples.probabilities,
        samples.actions,
        samples.rewards,
        samples.discounts,
        samples.bootstrap_offsets,
        samples.weights_versions,
    )
    if samples.records.ndim != 3 or any(v.ndim != 1 for v in vectors):
        return "records does not have 3 dimensions, or another array is not a vector"
    if any(len(v) != len(samples.records) for v in vectors):
        return "arrays differ in length"
    if not ((samples.probabilities > 0).all() and (samples.probabilities <= 1).all()):
        return "a probability is not above 0 and at most 1"
    if not 0 < samples.total_priority < math.inf:
        return "total_priority is not above 0 and finite"
    return _check_transitions(samples)


def _check_transitions(message: Chunk | Samples) -> str | None:
    rewards, discounts = message.rewards, message.discounts
    if not np.isfinite(rewards).all():
        return "a reward is not finite"
    if not ((discounts >= 0).all() and (discounts <= 1).all()):
        return "a discount is outside 0 ... 1, or not finite"
    if (message.actions >= MOST_ACTIONS).any():
        return f"an action is not below {MOST_ACTIONS}"
    if (message.bootstrap_offsets < 1).any():
        return "a bootstrap offset is 0"
    return None


def _check_priorities(message: Priorities) -> str | None:
    if message.keys.ndim != 1 or message.keys.shape != message.priorities.shape:
        return "keys and priorities are not vectors of one length"
    if not _may_be_errors(message.priorities):
        return "a priority is negative or not finite"
    return None


def _check_lease_request(request: LeaseRequest) -> str | None:
    if request.slot < NO_SLOT:
        return f"slot is below {NO_SLOT}"
    if request.holds and request.slot == NO_SLOT:
        return "holds is true, but slot names none"
    return None


def _check_lease_reply(reply: LeaseReply) -> str | None:
    if reply.slot < NO_SLOT:
        return f"slot is below {NO_SLOT}"
    if not 0 <= reply.rank < reply.num_places:
        return f"rank {reply.rank} is not among {reply.num_places} places"
    if not 0 < reply.lease_s < math.inf:
        return "lease_s is not above 0 and finite"
    return None


def _check_weights(weights: Weights) -> str | None:
    if sha256(weights.payload) != weights.digest:
        return "the payload does not match its digest: torn or altered"
    return None


def _check_weights_notice(notice: WeightsNotice) -> str | None:
    if not _DIGEST.fullmatch(notice.digest):
        return "digest is not a SHA-256 in hexadecimal digits"
    if len(notice.address) > _MAX_ADDRESS:
        return f"an address of {len(notice.address)} characters"
    return None


def _check_evaluation(evaluation: Evaluation) -> str | None:
    rates = evaluation.success_rate + evaluation.collision_rate + evaluation.timeout_rate
    if abs(rates - 1) > _RATES_SUM:
        return f"success_rate, collision_rate and timeout_rate sum to {rates:g}, not 1"
    low, high = evaluation.success_interval
    if not 0 <= low <= high <= 1:
        return f"success_interval {low:g}, {high:g} does not rise within 0 ... 1"
    return None


def _check_stats(stats: Stats) -> str | None:
    if len(stats.metrics) > MAX_METRICS or len(stats.text) > MAX_TEXTS:
        return (
            f"{len(stats.metrics)} metrics and {len(stats.text)} texts, "
            f"more than {MAX_METRICS} or {MAX_TEXTS}"
        )
    if odd := _no_name((*stats.metrics, *stats.text)):
        return f"a metric or text is called {printable(odd)[:MAX_NAME]!r}, which is not a name"
    for name, text in stats.text.items():
        if len(text) > MAX_TEXT or not text.isprintable():
            return f"text {name} is not printable, or longer than {MAX_TEXT} characters"
    return _check_metrics(_KINDS.get(stats.role, {}), stats.metrics)


def _check_arena_frame(frame: ArenaFrame) -> str | None:
    rows = {"robots": 3, "targets": 2, "obstacles": 3}
    for name, width in rows.items():
        array = getattr(frame, name)
        if array.ndim != 2 or array.shape[1] != width or not np.isfinite(array).all():
            return f"{name} is not a matrix of {width} columns, or not finite"
    num_robots, num_acting = len(frame.robots), len(frame.actions)
    if not 1 <= num_robots <= _NUM_ROBOTS[1]:
        return f"{num_robots} robots"
    if num_acting not in (0, num_robots) or frame.actions.ndim != 1:
        return "actions is neither empty nor one for each robot"
    if frame.q_values.ndim != 2 or len(frame.q_values) != num_acting:
        return "q_values is not a row for each action"
    num_actions = frame.q_values.shape[1]
    if not 2 <= num_actions <= MOST_ACTIONS or (frame.actions >= num_actions).any():
        return f"q_values has not 2 to {MOST_ACTIONS} values for each action, or an action is none"
    if frame.collided.shape != (num_robots,):
        return "collided is not one for each robot"
    if frame.outcome and frame.outcome not in set(Outcome):
        return "outcome is none"
    if frame.images and not _inflates_to(frame.images, num_robots * frame.view_px**2):
        return "images is not zlib data of one image for each robot"
    return None


def _inflates_to(packed: bytes, size: int) -> bool:
    """Whether zlib data is whole and holds so many bytes; no more are unpacked."""
    unpacking = zlib.decompressobj()
    try:
        unpacked = unpacking.decompress(packed, size + 1)
    except zlib.error:
        return False
    return len(unpacked) == size and unpacking.eof


def _no_name(names: Iterable[str]) -> str:
    return next((name or "(empty)" for name in names if not is_name(name)), "")


def _check_metrics(known: Mapping[str, str], metrics: Mapping[str, float]) -> str | None:
    """Check metrics by their kinds; one that is not known is a gauge."""
    for name, value in metrics.items():
        if name in _MAY_DIVERGE and not _LARGEST_FLOAT32 < abs(value) < math.inf:
            continue
        low, high = _NUMBER_OF_KIND[known.get(name, "gauge")]
        if not low <= value <= high:
            return f"metric {name} {value:g} is outside {low:g} ... {high:g}"
    return None


def _may_be_errors(priorities: Float32Array) -> bool:
    """Whether these are absolute TD errors."""
    return bool(np.isfinite(priorities).all() and (priorities >= 0).all())


_NUMBER_OF_KIND: dict[str, Range] = {
    "counter": _COUNT,
    "pace": _COUNT,
    "share": _COUNT,
    "histogram": _COUNT,
    "gauge": (-(2.0**63), 2.0**63),  # weights_epoch is a time in ns
}
_CHECKS: dict[type, Callable[[Any], str | None]] = {
    Chunk: _check_chunk,
    Samples: _check_samples,
    Priorities: _check_priorities,
    LeaseRequest: _check_lease_request,
    LeaseReply: _check_lease_reply,
    Weights: _check_weights,
    WeightsNotice: _check_weights_notice,
    Evaluation: _check_evaluation,
    Stats: _check_stats,
    ArenaFrame: _check_arena_frame,
}
