"""Which symmetries a transition may undergo: those of the layout that it is from."""

from collections import defaultdict

import numpy as np
import pytest

from mrcdrl.common.arena import Scene, Symmetry, layout_symmetries, make_codec
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import UInt8Array
from mrcdrl.services.learner.symmetries import LayoutSymmetries

NUMBERS = (1, 2, 3, 4)
EACH = 200


def records(config: ArenaConfig, numbers: list[int]) -> UInt8Array:
    """Records [B, 2, R] of the first robot, with so many robots in each transition."""
    robots = np.full((len(numbers), config.num_robots, 3), np.nan)
    for row, number in enumerate(numbers):
        robots[row, :number] = (100.0, 200.0, 0.5)
    targets = np.full((len(numbers), config.target_count, 2), 300.0)
    encoded = make_codec(config).encode(Scene(robots, targets, np.empty((len(numbers), 0, 3))))
    return np.stack([encoded[:, 0]] * 2, axis=1)


def drawn(config: ArenaConfig, numbers: list[int]) -> dict[int, set[Symmetry]]:
    """The symmetries that were drawn for transitions of each number of robots."""
    found: dict[int, set[Symmetry]] = defaultdict(set)
    times = np.zeros(len(numbers), np.int64)
    rows_of = LayoutSymmetries(config).draw(records(config, numbers), np.random.default_rng(0))
    for symmetry, rows in rows_of:
        times[rows] += 1
        for row in rows:
            found[numbers[row]].add(symmetry)
    known = np.isin(numbers, config.numbers)
    assert (times[known] == 1).all(), "each transition undergoes one"
    assert (times[~known] == 0).all()
    return found


def test_each_number_of_robots_has_the_symmetries_of_its_own_layout() -> None:
    config = ArenaConfig(robots=NUMBERS)
    found = drawn(config, [*NUMBERS] * EACH + [0] * 5)
    own = {number: set(layout_symmetries(config.with_robots(number))) for number in NUMBERS}
    assert found == own
    assert [len(own[number]) for number in NUMBERS] == [8, 4, 2, 8], "the paper's layouts differ"


def test_pictures_do_not_tell_their_number() -> None:
    config = ArenaConfig(robots=NUMBERS, codec="frames", view_px=31)
    shared = set(layout_symmetries(config))
    assert drawn(config, [*NUMBERS] * EACH) == dict.fromkeys(NUMBERS, shared)
    assert len(shared) == 2


@pytest.mark.parametrize("number", NUMBERS)
def test_a_single_number_draws_once_for_all(number: int) -> None:
    config = ArenaConfig(num_robots=number)
    rows = LayoutSymmetries(config).draw(records(config, [number] * EACH), np.random.default_rng(3))
    kept = layout_symmetries(config)
    expected = np.random.default_rng(3).integers(len(kept), size=EACH)
    assert [symmetry for symmetry, _ in rows] == list(kept)
    for place, (_, of) in enumerate(rows):
        np.testing.assert_array_equal(of, np.flatnonzero(expected == place))
