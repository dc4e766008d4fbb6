"""A message that is compressed comes back as it was; anything else so marked is refused."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mrcdrl.common.errors import WireError
from mrcdrl.common.transport.compression import compressed, expanded

LIMIT = 10_000
BLOCK = compressed([b"abc" * 100])


@given(st.lists(st.binary(max_size=500), max_size=4))
def test_a_message_comes_back_as_it_was(parts: list[bytes]) -> None:
    assert expanded(compressed(parts), LIMIT) == b"".join(parts)


@given(st.binary(max_size=100))
def test_what_is_not_marked_is_itself(message: bytes) -> None:
    if not message.startswith(b"\xc1lz4"):
        assert expanded(message, LIMIT) is message


DAMAGED = {
    "head alone": (BLOCK[:6], "ends within its head"),
    "too large": (compressed([bytes(LIMIT + 1)]), "10001 bytes exceed the limit of 10000"),
    "cut off": (BLOCK[:-1], "damaged"),
    "noise": (BLOCK[:8] + b"\xff" * 20, "damaged"),
    "longer than it says": (BLOCK[:4] + (299).to_bytes(4, "little") + BLOCK[8:], "damaged"),
    "shorter than it says": (BLOCK[:4] + (301).to_bytes(4, "little") + BLOCK[8:], "300 bytes, not"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_the_damaged_is_refused_with_its_reason(name: str) -> None:
    payload, reason = DAMAGED[name]
    with pytest.raises(WireError, match=reason):
        expanded(payload, LIMIT)


@given(st.binary(max_size=200))
def test_noise_raises_nothing_else(noise: bytes) -> None:
    with contextlib.suppress(WireError):
        assert len(expanded(b"\xc1lz4" + noise, LIMIT)) <= LIMIT
