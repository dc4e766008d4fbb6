"""One message of each schema, as bytes and as JSON, for peers in other languages.

`python -m tests.common.messages.golden_messages` writes `golden/`. It is written anew only with a
new version of a schema: bytes that were golden once are in logs, and on the wire.
"""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mrcdrl.common.messages.framing import join_set
from mrcdrl.common.messages.trajectory import (
    ArenaFrame,
    Chunk,
    EpisodeSummary,
    Evaluation,
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
from mrcdrl.common.messages.wire import encode, encode_parts
from mrcdrl.common.runtime.files import sha256

GOLDEN = Path(__file__).parent / "golden"
STARTED_NS = 1_700_000_000_123_456_789


def floats(*values: float) -> np.ndarray[Any, Any]:
    return np.array(values, np.float32)


def octets(*values: int) -> np.ndarray[Any, Any]:
    return np.array(values, np.uint8)


def chunk(record_bytes: int = 5, sequence: int = 7) -> Chunk:
    """Two transitions with a history of one record, n = 2."""
    return Chunk(
        actor="actor-0",
        incarnation=STARTED_NS,
        sequence=sequence,
        weights_version=41,
        records=np.arange(5 * record_bytes).astype(np.uint8).reshape(5, record_bytes),
        actions=octets(0, 2),
        rewards=floats(0.059699997, 200.0),
        discounts=floats(0.9801, 0.0),
        bootstrap_offsets=octets(2, 1),
        priorities=floats(0.5, 12.25),
    )


# 5 x 1640 bytes: the records follow the map.
MESSAGES: dict[str, Any] = {
    "chunk": chunk(),
    "chunk-without-priorities": dataclasses.replace(chunk(), priorities=floats()),
    "chunk-whose-records-follow": chunk(record_bytes=1640),
    "insert_reply": InsertReply(7, False, 300),
    "sample_request": SampleRequest(32, -1),
    "samples": Samples(
        keys=np.array([0, 2**40], np.int64),
        probabilities=np.array([0.25, 1e-6]),
        table_size=300,
        total_priority=75.5,
        actions=octets(1, 2),
        rewards=floats(-5.0, 0.03),
        discounts=floats(0.9801, 0.99),
        bootstrap_offsets=octets(2, 1),
        weights_versions=np.array([41, 0], np.int64),
        records=np.arange(2 * 4 * 3).astype(np.uint8).reshape(2, 4, 3),
    ),
    "priorities": Priorities(np.array([0, 2**40], np.int64), floats(0.0, 3.5)),
    "priorities_reply": PrioritiesReply(1, 1),
    "lease_request": LeaseRequest("actor-0", STARTED_NS, -1, False, False),
    "lease_reply": LeaseReply(2, 2, 8, 15.0),
    "weights": Weights.of(STARTED_NS, 42, 4_200, b"a safetensors file"),
    "weights_notice": WeightsNotice(
        *(STARTED_NS, 42, 4_200, sha256(b"a safetensors file"), 18),
        "01234567-89ab-cdef-0123-456789abcdef 7 11 00112233445566778899aabbccddeeff",
    ),
    "episode": EpisodeSummary("actor-0", 3, 1, Outcome.TIMEOUT, 1000, 12.5, 2, 0.1, 41, 3.75, 2),
    "evaluation": Evaluation(
        worker="evaluator-0",
        weights_epoch=STARTED_NS,
        weights_version=42,
        learner_step=4_200,
        num_robots=2,
        episodes=100,
        success_rate=0.93,
        collision_rate=0.05,
        timeout_rate=0.02,
        success_interval=(0.8625, 0.9657),
        max_per_100=93.0,
        mean_per_100=93.0,
        variance_per_100=0.0,
        mean_frames=171.5,
        mean_score=188.25,
        seed=1,
        wall_s=20.5,
    ),
    "arena_frame": ArenaFrame(
        role="actor",
        worker="actor-0",
        arena=3,
        episode=2,
        frame=17,
        weights_version=41,
        epsilon=0.1,
        robots=floats(100.0, 200.0, 0.5, 300.0, 400.0, -1.5).reshape(2, 3),
        targets=floats(50.0, 60.0, 70.0, 80.0).reshape(2, 2),
        obstacles=floats().reshape(0, 3),
        q_values=floats(0.1, 0.2, 0.3, -0.1, 0.0, 0.1).reshape(2, 3),
        actions=octets(2, 1),
        collided=octets(0, 1),
        outcome="",
        view_px=2,
        images=bytes.fromhex("780163606462666165630700005c001d"),  # 0 ... 7
    ),
    "stats": Stats(
        "actor", "actor-0", {"env_steps": 8_000.0, "epsilon": 0.1}, {"incarnation": str(STARTED_NS)}
    ),
}
SETS = {"set-of-two-chunks": (chunk(), chunk(sequence=8))}


def as_json(value: Any) -> Any:
    """A message or a field: arrays as dtype, shape and numbers, bytes as hex."""
    if dataclasses.is_dataclass(value):
        return {f.name: as_json(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, np.ndarray):
        numbers = value.ravel().tolist()
        return {"dtype": value.dtype.name, "shape": list(value.shape), "numbers": numbers}
    if isinstance(value, bytes):
        return {"hex": value.hex()}
    return list(value) if isinstance(value, tuple) else value


def contents() -> Iterator[tuple[str, bytes, Any]]:
    """Name, bytes and JSON of each."""
    for name, message in MESSAGES.items():
        yield name, encode(message), as_json(message)
    for name, chunks in SETS.items():
        whole = b"".join(join_set([encode_parts(each) for each in chunks]))
        yield name, whole, [as_json(each) for each in chunks]


def main() -> None:
    GOLDEN.mkdir(exist_ok=True)
    for name, encoded, values in contents():
        (GOLDEN / f"{name}.hex").write_text(encoded.hex() + "\n", "utf-8")
        (GOLDEN / f"{name}.json").write_text(json.dumps(values) + "\n", "utf-8")


if __name__ == "__main__":
    main()
