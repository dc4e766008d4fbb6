"""Turn sizes of a run in lockstep."""

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.sync.lockstep import Lockstep

OVERRIDES = {
    "run.turn_size": "64",
    "run.learner_steps": "0",
    "replay.min_size": "201",
    "replay.capacity": "300",
}


def test_a_turn_has_its_transitions_and_the_steps_that_sample_them() -> None:
    lockstep = Lockstep.from_config(load_config("smoke", OVERRIDES, environ={}))
    assert lockstep == Lockstep(
        first=208, size=64, steps=8
    )  # whole frames of 8 robots; 4 samples each
    assert [lockstep.turn(step) for step in (0, 7, 8, 16)] == [0, 0, 1, 2]
    assert [lockstep.transitions(turn) for turn in (0, 1, 2)] == [272, 64, 64]
    assert [lockstep.inserts(step) for step in (0, 7, 8, 16)] == [272, 272, 336, 400]


def test_by_default_nothing_is_in_lockstep() -> None:
    assert Lockstep.from_config(Config()) is None
