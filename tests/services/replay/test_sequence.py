"""What sequence numbers say about chunks."""

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from mrcdrl.services.replay.sequence import Arrival, SequenceBook


@pytest.mark.parametrize(
    ("stored", "arriving", "expected"),
    [
        ([], 0, Arrival.NEXT),
        ([], 3, Arrival.GAP),
        ([0], 0, Arrival.REPEATED),
        ([0], 1, Arrival.NEXT),
        ([0, 1, 2], 1, Arrival.REPEATED),
        ([0], 2, Arrival.GAP),
        ([0, 5], 6, Arrival.NEXT),
        ([0, 5], 3, Arrival.REPEATED),
    ],
)
def test_a_stream(stored: list[int], arriving: int, expected: Arrival) -> None:
    book = SequenceBook()
    for sequence in stored:
        book.record("actor-0", 1, sequence)
    assert book.classify("actor-0", 1, arriving) is expected


def test_each_actor_and_incarnation_has_its_own_stream() -> None:
    book = SequenceBook()
    book.record("actor-0", 1, 4)
    assert book.classify("actor-0", 2, 0) is Arrival.NEXT
    assert book.classify("actor-0", 0, 0) is Arrival.NEXT  # its clock was set back meanwhile
    assert book.classify("actor-1", 1, 0) is Arrival.NEXT


def test_classifying_stores_nothing() -> None:
    book = SequenceBook()
    assert book.classify("a", 1, 0) is Arrival.NEXT
    assert book.classify("a", 1, 0) is Arrival.NEXT


def test_the_stream_heard_from_least_recently_is_forgotten() -> None:
    book = SequenceBook(max_streams=2)
    book.record("a", 1, 0)
    book.record("b", 1, 0)
    book.record("a", 1, 1)
    book.record("c", 1, 0)
    assert book.classify("a", 1, 1) is Arrival.REPEATED
    assert book.classify("c", 1, 0) is Arrival.REPEATED
    assert book.classify("b", 1, 0) is Arrival.NEXT


class BookAgainstList(RuleBasedStateMachine):
    """Lists every stored chunk of the streams that are not forgotten."""

    @initialize(max_streams=st.integers(1, 4))
    def make(self, max_streams: int) -> None:
        self.book = SequenceBook(max_streams)
        self.max_streams = max_streams
        self.stored: list[tuple[tuple[str, int], int]] = []

    @rule(
        actor=st.sampled_from("ab"),
        incarnation=st.integers(1, 3),
        sequence=st.integers(0, 5),
        ahead=st.booleans(),
    )
    def arrive(self, actor: str, incarnation: int, sequence: int, ahead: bool) -> None:
        """Store new chunks and skip repeated ones, as the service does."""
        stream = (actor, incarnation)
        known = [n for of, n in self.stored if of == stream]
        newest = max(known, default=-1)
        sequence += newest + 1 if ahead else 0
        arrival = self.book.classify(actor, incarnation, sequence)
        if sequence <= newest:
            assert arrival is Arrival.REPEATED
            return
        assert arrival is (Arrival.NEXT if sequence == newest + 1 else Arrival.GAP)
        self.book.record(actor, incarnation, sequence)
        self.stored.append((stream, sequence))
        latest = list(dict.fromkeys(of for of, _ in reversed(self.stored)))[: self.max_streams]
        self.stored = [(of, n) for of, n in self.stored if of in latest]

    @invariant()
    def remembers_no_more_than_it_may(self) -> None:
        assert len(self.book._last) == len({of for of, _ in self.stored}) <= self.max_streams


TestBookAgainstList = BookAgainstList.TestCase
TestBookAgainstList.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
