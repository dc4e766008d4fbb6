"""Fuzz `decode` for all messages, guided by coverage: it may raise nothing but WireError.

`python -m benchmarks.fuzz_wire --minutes 10` runs libFuzzer (Atheris, `pip install atheris`) in its
own process, starting from a valid message of each class, and prints one line of JSON: executions,
executions/s, coverage (edges of the bytecode of wire.py and framing.py, and features), findings.
Sets of messages are split too. A decoded message must also encode to the same bytes again. Exits
with 1 if there is a finding.
"""

import argparse
import random
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any
from unittest import mock

import msgpack
import numpy as np

from benchmarks.machine import emit
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.framing import join_map, join_set, split_map

_DONE = re.compile(r"cov: (\d+) ft: (\d+) corp: (\d+)")
_STAT = re.compile(r"^stat::(\w+):\s+(\d+)", re.M)
_ERROR = re.compile(r"Uncaught Python exception: ===\n(.*)")
_SHAPES = (
    [],
    [0],
    [1],
    [2],
    [3],
    [0, 0],
    [2, 3],
    [2, 4, 5],
    [-1],
    [2**63],
    [2**32, 2**32],
    [1] * 9,
)
_ODD = (
    None,
    True,
    0,
    1,
    -1,
    2**63,
    -(2**63),
    0.5,
    float("nan"),
    "",
    "a" * 65,
    b"",
    [],
    {},
    [[], b"\0"],
)

_PLACES = (0, 64, 128, 1, -64, 2**32, 2**64 - 1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--corpus", help=argparse.SUPPRESS)
    arguments, for_libfuzzer = parser.parse_known_args()
    if arguments.corpus is not None:
        return fuzz([arguments.corpus, *for_libfuzzer])
    with tempfile.TemporaryDirectory() as folder:
        result = watch(Path(folder), arguments.minutes, arguments.seed)
    emit(result)
    return 1 if result["findings"] else 0


def watch(folder: Path, minutes: float, seed: int) -> dict[str, Any]:
    """Run the fuzzer and return its figures."""
    corpus = folder / "corpus"
    corpus.mkdir()
    for number, message in enumerate(examples()):
        (corpus / f"seed-{number}").write_bytes(message)
    flags = {"max_total_time": round(60 * minutes), "seed": seed, "max_len": 4096, "timeout": 20}
    command = [sys.executable, "-m", "benchmarks.fuzz_wire", "--corpus", str(corpus)]
    ended = subprocess.run(
        [*command, *(f"-{k}={v}" for k, v in flags.items()), "-print_final_stats=1",
         f"-artifact_prefix={folder}/finding-"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    output = ended.stdout + ended.stderr
    stats = dict(_STAT.findall(output))
    if not stats:
        raise SystemExit(output)
    edges, features, corpus_size = (int(n) for n in _DONE.findall(output)[-1])
    findings = [path.read_bytes().hex() for path in sorted(folder.glob("finding-*"))]
    return {
        "bench": "fuzz_wire",
        "minutes": minutes,
        "seed": seed,
        "executions": int(stats["number_of_executed_units"]),
        "executions_per_s": int(stats["average_exec_per_sec"]),
        "edges": edges,
        "features": features,
        "corpus": corpus_size,
        "peak_rss_mb": int(stats["peak_rss_mb"]),
        "errors": _ERROR.findall(output),
        "findings": findings,
    }


def examples() -> list[bytes]:
    """A valid message of every class, after its class's number, and sets of chunks.

    Each appears once with its arrays in the map and once with them after it.
    """
    from mrcdrl.common.messages import wire
    from mrcdrl.common.messages.trajectory import Chunk

    found = []
    for large_bytes in (wire._LARGE_BYTES, 1):
        with mock.patch.object(wire, "_LARGE_BYTES", large_bytes):
            for number, cls in enumerate(wire._SCHEMAS):
                found.append(bytes([number]) + wire.encode(example(cls)))
            chunks = [wire.encode_parts(example(Chunk))] * 2
            found.append(bytes([len(wire._SCHEMAS)]) + b"".join(join_set(chunks)))
    return found


def example(cls: type) -> Any:
    """A message of a class, of ones in arrays of two."""
    from dataclasses import fields
    from typing import get_args, get_origin, get_type_hints

    from mrcdrl.common.messages.trajectory import Outcome

    plain = {
        int: 1,
        float: 0.5,
        str: "name",
        bool: True,
        bytes: b"payload",
        Outcome: Outcome.SUCCESS,
    }

    def of(name: str, hint: Any) -> Any:
        if hint in plain:
            return plain[hint]
        if get_origin(hint) is tuple:
            return tuple(of(name, inner) for inner in get_args(hint))
        if get_origin(hint) is dict:
            return {"name": plain[get_args(hint)[1]]}
        shape = {"Chunk": (4, 3), "Samples": (2, 4, 3)}[cls.__name__] if name == "records" else (2,)
        return np.ones(shape, np.dtype(get_args(get_args(hint)[1])[0]))

    hints = get_type_hints(cls)
    return cls(**{field.name: of(field.name, hints[field.name]) for field in fields(cls)})


def fuzz(arguments: list[str]) -> int:
    """Run libFuzzer's loop, which ends the process."""
    try:
        import atheris
    except ImportError:
        raise SystemExit("fuzz_wire needs Atheris: pip install atheris") from None
    names = ["mrcdrl.common.messages.framing", "mrcdrl.common.messages.wire"]
    for name in names:  # imported again below, instrumented to count edges
        sys.modules.pop(name, None)
    with atheris.instrument_imports(include=names):
        from mrcdrl.common.messages import framing, wire
    from mrcdrl.common.messages.trajectory import Chunk

    classes = list(wire._SCHEMAS)

    def one(data: bytes) -> None:
        if not data:
            return
        number = data[0] % (len(classes) + 1)
        cls = Chunk if number == len(classes) else classes[number]
        try:
            parts = framing.split_set(data[1:]) if number == len(classes) else [data[1:]]
            messages = [wire.decode(cls, part) for part in parts]
        except WireError:
            return
        for message in messages:
            again = wire.encode(message)
            if wire.encode(wire.decode(cls, again)) != again:
                raise AssertionError(f"a {cls.__name__} does not encode to the same bytes again")

    def mutate(data: bytes, max_size: int, seed: int) -> bytes:
        rng = random.Random(seed)
        changed = structured(data, rng) if rng.random() < 0.5 else None
        return changed or atheris.Mutate(data, max_size)

    atheris.Setup([sys.argv[0], *arguments], one, custom_mutator=mutate)
    atheris.Fuzz()
    return 0


def structured(data: bytes, rng: random.Random) -> bytes | None:
    """A message with one odd value in its map; None if the bytes are not a map."""
    try:
        in_map, arrays = split_map(memoryview(data[1:]))
        table = msgpack.unpackb(in_map, strict_map_key=False)
        if not isinstance(table, dict) or not table:
            return None
        key = rng.choice(list(table))
        value, kind = table[key], rng.randrange(5)
        if kind == 0:
            table[key] = rng.choice(_ODD)
        elif kind == 1 and isinstance(value, list) and len(value) == 2:
            table[key] = [rng.choice(_SHAPES), value[1]]
        elif kind == 2 and isinstance(value, list) and len(value) == 2:
            table[key] = [value[0], rng.randbytes(rng.choice((0, 1, 2, 4, 8, 12, 16)))]
        elif kind == 3 and isinstance(value, list) and len(value) == 2:
            table[key] = [value[0], rng.choice(_PLACES)]
        else:
            table.pop(key)
        parts = join_map(msgpack.packb(table), [arrays] if len(arrays) else [])
    except (ValueError, TypeError, OverflowError, IndexError, msgpack.UnpackException, WireError):
        return None
    return data[:1] + b"".join(parts)


if __name__ == "__main__":
    sys.exit(main())
