"""The rule by which many processes that were refused together do not come back together."""

import random
from collections.abc import Iterator

_FIRST_S = 0.5
_LONGEST_S = 4.0


def random_pauses() -> Iterator[float]:
    """Seconds before each further attempt: drawn at random, up to 0.5, 1, 2 and then 4."""
    longest_s = _FIRST_S
    while True:
        yield random.uniform(0, longest_s)
        longest_s = min(2 * longest_s, _LONGEST_S)
