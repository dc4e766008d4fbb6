"""Golden messages: these bytes are written for these values, and read as these values.

A peer in another language tests itself by the same files. One is read here as such a peer would,
by examples/foreign_client.py.
"""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from mrcdrl.common.messages.framing import split_set
from mrcdrl.common.messages.trajectory import Chunk
from mrcdrl.common.messages.wire import _SCHEMAS, decode
from tests.common.messages.golden_messages import GOLDEN, MESSAGES, SETS, as_json, contents

EXAMPLES = Path(__file__).parents[3] / "examples"
FILES = sorted(path.stem for path in GOLDEN.glob("*.hex"))


def golden(name: str) -> tuple[bytes, Any]:
    """The bytes and the values of a file."""
    encoded = bytes.fromhex((GOLDEN / f"{name}.hex").read_text("utf-8"))
    return encoded, json.loads((GOLDEN / f"{name}.json").read_text("utf-8"))


def test_each_schema_has_a_golden_message() -> None:
    assert sorted([*MESSAGES, *SETS]) == FILES
    assert {type(message) for message in MESSAGES.values()} == set(_SCHEMAS)


@pytest.mark.parametrize(("name", "encoded", "values"), [*contents()], ids=[*MESSAGES, *SETS])
def test_what_is_written_is_golden(name: str, encoded: bytes, values: Any) -> None:
    assert golden(name) == (encoded, values)


@pytest.mark.parametrize("name", MESSAGES)
def test_what_is_golden_is_read(name: str) -> None:
    encoded, values = golden(name)
    assert as_json(decode(type(MESSAGES[name]), encoded)) == values


@pytest.mark.parametrize("name", SETS)
def test_a_golden_set_is_read(name: str) -> None:
    encoded, values = golden(name)
    assert [as_json(decode(Chunk, message)) for message in split_set(encoded)] == values


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The client that imports nothing of ours."""
    monkeypatch.syspath_prepend(EXAMPLES)
    for name in ("foreign_client", "foreign_images"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    spec = importlib.util.spec_from_file_location("foreign", EXAMPLES / "foreign_client.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def arrays_of(values: dict[str, Any]) -> dict[str, Any]:
    """The golden values with numpy's arrays."""
    return {
        name: np.array(value["numbers"], value["dtype"]).reshape(value["shape"])
        if isinstance(value, dict) and "dtype" in value
        else value
        for name, value in values.items()
    }


@pytest.mark.parametrize("name", ["chunk", "chunk-without-priorities", "priorities"])
def test_a_foreign_peer_writes_what_is_golden(name: str, foreign: ModuleType) -> None:
    encoded, values = golden(name)
    assert foreign.pack(_SCHEMAS[type(MESSAGES[name])], **arrays_of(values)) == encoded


def test_a_foreign_peer_writes_a_golden_set(foreign: ModuleType) -> None:
    encoded, values = golden("set-of-two-chunks")
    assert foreign.pack_set([foreign.pack("chunk/1", **arrays_of(v)) for v in values]) == encoded


@pytest.mark.parametrize("name", ["samples", "chunk-whose-records-follow", "insert_reply"])
def test_a_foreign_peer_reads_what_is_golden(name: str, foreign: ModuleType) -> None:
    encoded, values = golden(name)
    read = foreign.unpack(encoded)
    assert read.pop("schema") == _SCHEMAS[type(MESSAGES[name])]
    expected = arrays_of(values)
    priorities = read.pop("priorities", None)  # of a chunk, which comes from nobody
    if priorities is not None:
        read["priorities"] = np.frombuffer(priorities[1], "<f4")
    assert read.keys() == expected.keys()
    for field, value in read.items():
        np.testing.assert_array_equal(value, expected[field])
