"""Pauses between attempts: random, longer and longer, and bounded."""

from itertools import islice

from mrcdrl.common.runtime.pauses import random_pauses


def test_pauses_are_random_and_bounded() -> None:
    drawn = [list(islice(random_pauses(), 8)) for _ in range(50)]
    for place, longest_s in enumerate([0.5, 1.0, 2.0, 4.0, 4.0, 4.0, 4.0, 4.0]):
        pauses = [pauses[place] for pauses in drawn]
        assert 0.0 <= min(pauses) < 0.3 * longest_s < 0.7 * longest_s < max(pauses) <= longest_s
