"""A peer of a run that shares no code with it: docs/wire.md, with zenoh, msgpack and numpy alone.

    python examples/foreign_client.py tcp/127.0.0.1:41873 NAME           weights and evaluations
    python examples/foreign_client.py tcp/127.0.0.1:41873 NAME sample    a batch, and its priorities
    python examples/foreign_client.py tcp/127.0.0.1:41873 NAME insert    an episode, made up

What is inserted is learned from, so insert into a run that is made for it. A sample counts as one
of the learner's.
"""

import json
import struct
import sys
import time
import tomllib
from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import zenoh
from foreign_images import q_values, record_bytes, weights_of

Message = dict[str, Any]

DTYPES = {  # of the arrays in the messages that come back
    "keys": "<i8",
    "probabilities": "<f8",
    "actions": "u1",
    "rewards": "<f4",
    "discounts": "<f4",
    "bootstrap_offsets": "u1",
    "weights_versions": "<i8",
    "records": "u1",
}


def pack(schema: str, **fields: Any) -> bytes:
    """One message; its arrays stand in the map."""
    pairs = {
        name: [list(value.shape), value.tobytes()] if isinstance(value, np.ndarray) else value
        for name, value in fields.items()
    }
    return msgpack.packb({"schema": schema, **pairs})


def unpack(data: bytes) -> Message:
    """The fields of a message, with arrays that stand in the map or follow it."""
    arrays = b""
    if data[:4] == b"\xc1map":
        (length,) = struct.unpack_from("<I", data, 4)
        arrays = data[-(-(8 + length) // 64) * 64 :]
        data = data[8 : 8 + length]
    message = msgpack.unpackb(data)
    for name in DTYPES.keys() & message.keys():
        (shape, held), dtype = message[name], np.dtype(DTYPES[name])
        size = int(np.prod(shape)) * dtype.itemsize
        held = arrays[held : held + size] if isinstance(held, int) else held
        message[name] = np.frombuffer(held, dtype).reshape(shape)
    return message


def pack_set(messages: list[bytes]) -> bytes:
    """Several messages in one, each at a multiple of 64 bytes."""
    lengths = [len(message) for message in messages]
    line = b"\xc1set" + struct.pack(f"<{1 + len(lengths)}I", len(lengths), *lengths)
    for message in messages:
        line += bytes(-len(line) % 64) + message
    return line


class Run:
    """A session with one run."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self._session = session
        self._prefix = f"mrcdrl/{name}"
        self.config = tomllib.loads(self.ask("config").decode())

    def ask(self, key: str, payload: bytes = b"") -> bytes:
        """The reply to a query, asked again for as long as it is held back."""
        timeout_s = 10.0
        whole_key = f"{self._prefix}/{key}"
        while True:
            replies = self._session.get(
                whole_key,
                payload=payload,
                target=zenoh.QueryTarget.BEST_MATCHING,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=timeout_s,
            )
            for reply in replies:
                if reply.ok is not None and str(reply.ok.key_expr) == whole_key:
                    return reply.ok.payload.to_bytes()
                if reply.err is not None:
                    text = reply.err.payload.to_bytes().decode()
                    if text != "Timeout" and not text.startswith("held: "):
                        raise RuntimeError(f"{key} refused: {text}")
            time.sleep(0.2)

    def newest_weights(self) -> Message:
        return msgpack.unpackb(self.ask("weights"))

    def events(self) -> Iterator[Message]:
        """Weights and evaluations as they arrive."""
        channel = zenoh.handlers.FifoChannel(64)
        subscriber = self._session.declare_subscriber(f"{self._prefix}/**", channel)
        for sample in subscriber:  # which ends with its last reference
            if str(sample.key_expr).split("/")[2] in ("weights", "evaluation"):
                yield msgpack.unpackb(sample.payload.to_bytes())


def shown(weights: Message) -> str:
    """What weights are of, and what they think of a black state."""
    metadata, arrays = weights_of(weights["payload"])
    state = np.zeros((metadata["stack"], metadata["view_px"], metadata["view_px"]), np.uint8)
    values = ", ".join(f"{value:.2f}" for value in q_values(state, arrays))
    return f"weights {weights['version']} {metadata['kind']} [{values}]"


def watch(run: Run) -> None:
    print(shown(run.newest_weights()), flush=True)
    for message in run.events():
        if message["schema"] == "weights/2":
            print(shown(message), flush=True)
        elif message["schema"] == "evaluation/1":
            print("evaluation", message["weights_version"], message["success_rate"], flush=True)


def sample(run: Run) -> None:
    """Ask for one batch of each shard, and give its transitions priority 1."""
    size = run.config["learner"]["batch_size"]
    for shard in range(run.config["replay"]["shards"]):
        request = pack("sample_request/2", batch_size=size, learner_step=-1)
        batch = unpack(run.ask(f"replay/{shard}/sample", request))
        print("sampled", *batch["records"].shape, "of", batch["table_size"])
        ones = np.ones(len(batch["keys"]), "<f4")
        update = pack("priorities/1", keys=batch["keys"], priorities=ones)
        reply = unpack(run.ask(f"replay/{shard}/priorities", update))
        print("priorities", reply["updated"], "updated", reply["ignored"], "ignored")


def insert(run: Run) -> None:
    """Insert an episode of one robot that stands still until its time is over."""
    arena, agent = run.config["arena"], run.config["agent"]
    length, steps = run.config["actor"]["chunk_length"], agent["n_step"]
    rows = arena["stack"] - 1 + length + steps
    started_ns = time.time_ns()
    chunks = [
        pack(
            "chunk/1",
            actor="foreign",
            incarnation=started_ns,
            sequence=sequence,
            weights_version=0,
            records=np.zeros((rows, record_bytes(arena)), "u1"),
            actions=np.ones(length, "u1"),
            rewards=np.zeros(length, "<f4"),
            discounts=np.full(length, agent["gamma"] ** steps, "<f4"),
            bootstrap_offsets=np.full(length, steps, "u1"),
            priorities=np.ones(length, "<f4"),
        )
        for sequence in range(max(1, arena["max_frames"] // length))
    ]
    shard = 0  # ours insert where the hash of their name says; any shard takes a chunk
    reply = unpack(run.ask(f"replay/{shard}/insert", pack_set(chunks)))
    print("inserted", reply["inserts"], "transitions in all, duplicate:", reply["duplicate"])


def main(endpoint: str, name: str, what: str = "watch") -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        {"watch": watch, "sample": sample, "insert": insert}[what](Run(session, name))


if __name__ == "__main__":
    main(*sys.argv[1:])
