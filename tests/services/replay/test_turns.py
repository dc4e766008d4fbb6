"""The line of requests that wait to be stored."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.services.replay.turns import Turns, Waiting
from tests.services.replay.harness import FakeRequest, make_chunk

HOLD_S = 5.0
AGAIN_S = 0.01  # from "ask again" to the next request


def asks(turns: Turns, actor: str, now_s: float, sequence: int = 0) -> Waiting:
    request = FakeRequest(b"x" * 10, now_s)
    waiting = Waiting(request, [], make_chunk(sequence, actor=actor))
    turns.join(waiting)
    return waiting


def first_actor(turns: Turns) -> str:
    waiting = turns.first()
    assert waiting is not None
    return waiting.first.actor


def test_an_actor_that_asks_again_keeps_its_place() -> None:
    turns = Turns(HOLD_S)
    early = asks(turns, "early", 0.0)
    asks(turns, "late", 1.0)
    assert list(turns.overdue(4.9)) == []
    assert list(turns.overdue(5.0)) == [early]
    turns.ask_again(early, "not now", 5.0)
    assert early.request.answer() == ("throttle", "not now")  # type: ignore[attr-defined]
    assert first_actor(turns) == "late"
    asks(turns, "early", 5.0 + AGAIN_S)
    assert first_actor(turns) == "early"


def test_a_place_is_given_up_with_the_acknowledgement() -> None:
    turns = Turns(HOLD_S)
    early = asks(turns, "a", 0.0)
    turns.ask_again(early, "not now", 5.0)
    again = asks(turns, "a", 5.1)
    turns.leave(again)
    asks(turns, "b", 6.0)
    asks(turns, "a", 7.0, sequence=1)
    assert first_actor(turns) == "b"


def test_an_actor_that_stays_away_loses_its_place() -> None:
    turns = Turns(HOLD_S)
    turns.ask_again(asks(turns, "gone", 0.0), "not now", 5.0)
    turns.ask_again(asks(turns, "b", 34.0), "not now", 36.0)
    asks(turns, "c", 36.5)
    asks(turns, "gone", 37.0)
    assert first_actor(turns) == "c"
    asks(turns, "b", 38.0)
    assert first_actor(turns) == "b"


def test_places_and_answered_requests_are_bounded() -> None:
    turns = Turns(HOLD_S)
    head = asks(turns, "head", 0.0)
    for index in range(10_000):
        turns.ask_again(asks(turns, f"a{index}", 0.1), "not now", 0.2)
    assert len(turns._places) <= 4096
    assert len(turns._line) < 100
    assert turns.held_bytes == 10
    assert turns.all() == [head]
    turns.leave(head)
    assert (bool(turns), turns.held_bytes) == (False, 0)


@settings(max_examples=30)
@given(
    actors=st.integers(2, 30),
    per_turn_s=st.floats(0.1, 1.5),
    again_s=st.floats(0.0, 0.15),
    seed=st.integers(0, 2**16),
)
def test_no_actor_waits_twice_its_fair_turn(
    actors: int, per_turn_s: float, again_s: float, seed: int
) -> None:
    """All actors ask all the time, and one request is admitted every `per_turn_s`."""
    turns, rng = Turns(HOLD_S), np.random.default_rng(seed)
    first_asked = {f"a{i}": float(rng.uniform(0, per_turn_s)) for i in range(actors)}
    asking = dict(first_asked)  # actors that are about to ask, and when
    waited: list[float] = []
    now_s, turn_s = 0.0, per_turn_s
    while len(waited) < 4 * actors:
        now_s += 0.05
        for actor in [actor for actor, at_s in asking.items() if at_s <= now_s]:
            asks(turns, actor, asking.pop(actor))
        served = turns.first()
        if now_s >= turn_s and served is not None:
            turn_s += per_turn_s
            turns.leave(served)
            actor = served.first.actor
            waited.append(now_s - first_asked[actor])
            first_asked[actor] = asking[actor] = now_s
        for waiting in turns.overdue(now_s):
            turns.ask_again(waiting, "not now", now_s)
            asking[waiting.first.actor] = now_s + again_s
    assert max(waited) <= 1.5 * actors * per_turn_s + 2 * per_turn_s + again_s


def test_arrival_order_rules_among_those_who_never_asked() -> None:
    turns = Turns(HOLD_S)
    waiting = [asks(turns, f"a{i}", 0.0) for i in range(5)]
    for each in waiting:
        assert turns.first() is each
        turns.leave(each)
    assert turns.next_answer_s() is None


@pytest.mark.parametrize("kind", [bytes, memoryview])
def test_only_payloads_that_lie_here_count_as_held(kind: type) -> None:
    turns = Turns(HOLD_S)
    request = FakeRequest(kind(b"x" * 10), 0.0)
    turns.join(Waiting(request, [], make_chunk(0)))
    assert turns.held_bytes == (10 if kind is bytes else 0)
