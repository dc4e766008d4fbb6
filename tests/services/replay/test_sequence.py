"""What sequence numbers say of chunks."""

import pytest

from services.replay.sequence import Arrival, SequenceBook


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


def test_actors_and_incarnations_have_streams_of_their_own() -> None:
    book = SequenceBook()
    book.record("actor-0", 1, 4)
    assert book.classify("actor-0", 2, 0) is Arrival.NEXT
    assert book.classify("actor-1", 1, 0) is Arrival.NEXT


def test_to_classify_stores_nothing() -> None:
    book = SequenceBook()
    assert book.classify("a", 1, 0) is Arrival.NEXT
    assert book.classify("a", 1, 0) is Arrival.NEXT


def test_the_stream_heard_of_least_recently_is_forgotten() -> None:
    book = SequenceBook(max_streams=2)
    book.record("a", 1, 0)
    book.record("b", 1, 0)
    book.record("a", 1, 1)
    book.record("c", 1, 0)
    assert book.classify("a", 1, 1) is Arrival.REPEATED
    assert book.classify("c", 1, 0) is Arrival.REPEATED
    assert book.classify("b", 1, 0) is Arrival.NEXT
