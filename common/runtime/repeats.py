"""The rule by which many equal events are logged ever more rarely."""


def is_logged(count: int) -> bool:
    """Whether to log the count-th of many equal events: the 1st, 2nd, 4th, 8th …

    count: 1 or more.
    """
    return count.bit_count() == 1
