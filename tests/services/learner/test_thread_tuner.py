"""The number of threads is the one with which steps are fastest, again and again."""

import pytest

from mrcdrl.services.learner.accelerate.thread_tuner import ThreadTuner, thread_counts


class Machine:
    """Steps that take as long as a table says, and a clock that they move."""

    def __init__(self, seconds: dict[int, float]) -> None:
        self.seconds = seconds
        self.now = 0.0
        self.tuner = ThreadTuner(list(seconds), lambda: self.now)

    def run(self, until_s: float) -> dict[int, float]:
        """Time spent with each count."""
        spent = dict.fromkeys(self.seconds, 0.0)
        while self.now < until_s:
            count = self.tuner.count
            self.now += self.seconds[count]
            spent[count] += self.seconds[count]
            self.tuner.took(self.seconds[count])
        return spent


@pytest.mark.parametrize("best", [1, 2, 4])
def test_the_fastest_count_is_held(best: int) -> None:
    machine = Machine({count: 0.01 if count == best else 0.02 for count in (1, 2, 4)})
    spent = machine.run(120.0)
    assert machine.tuner.count == best
    assert spent[best] > 0.9 * sum(spent.values())


def test_a_machine_that_changes_is_measured_again() -> None:
    machine = Machine({1: 0.02, 2: 0.01})
    machine.run(30.0)
    assert machine.tuner.count == 2
    machine.seconds = {1: 0.02, 2: 0.03}  # a neighbour came
    machine.run(machine.now + 70.0)
    assert machine.tuner.count == 1


def test_a_choice_at_the_start_is_soon_tried_again() -> None:
    """Kernels compile at the start, in whichever block is the first."""
    machine = Machine({1: 0.02, 2: 0.04})
    machine.run(3.0)
    machine.seconds = {1: 0.04, 2: 0.02}
    machine.run(25.0)
    assert machine.tuner.count == 2
    before = machine.run(25.0 + 600.0)
    assert before[2] > 0.9 * sum(before.values()), "later choices hold longer"


def test_one_slow_step_decides_nothing() -> None:
    machine = Machine({1: 0.02, 2: 0.01})
    machine.tuner.took(30.0)
    machine.run(6.0)
    assert machine.tuner.count == 2


def test_every_number_of_cores_has_counts_to_try() -> None:
    found = {cores: thread_counts(cores) for cores in (1, 2, 3, 6, 8)}
    assert found == {1: [1], 2: [1, 2], 3: [1, 2, 3], 6: [1, 2, 4, 6], 8: [1, 2, 4, 8]}
