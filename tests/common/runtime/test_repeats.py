"""Which of many equal events are logged."""

from mrcdrl.common.runtime.repeats import is_logged


def test_ever_fewer_of_many_events_are_logged() -> None:
    assert [count for count in range(1, 20) if is_logged(count)] == [1, 2, 4, 8, 16]
