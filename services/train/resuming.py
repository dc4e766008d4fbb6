"""Whether a run that is resumed has anything left to do; reads its records and writes nothing."""

from collections.abc import Mapping
from pathlib import Path

from mrcdrl.common.config import Config
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.services.monitor.recorder import restore
from mrcdrl.services.monitor.state import RunState
from mrcdrl.services.monitor.stopping import StoppingRule

_LIMITS = (
    "minutes",
    "learner_steps",
    "target_success_rate",
    "patience_episodes",
    "patience_floor",
)


def check_unfinished(path: Path, before: Config, now: Config, given: Mapping[str, str]) -> None:
    """Raise RunDirectoryError, naming the limit, if a run that reached it is to go on without more.

    before, now: what the run was made with, and is resumed with. given: flags. A new limit, or the
    same given again, lets the run go on; but nothing lets it go beyond its learner steps.
    """
    state, rule = RunState(now), StoppingRule(now.run, now.arena.numbers)
    restore(path, state, rule)
    if new_limit(before, now, given):
        rule.go_on()
    reason = rule.reason(state.learner_steps, 0.0, published=None)
    if reason is not None:
        other = "--minutes 30"
        if 0 < now.run.learner_steps <= state.learner_steps:
            other += " --learner-steps 0"
        raise RunDirectoryError(
            f"{path} has ended: {reason}; to go on, give another limit, such as {other}"
        )


def new_limit(before: Config, now: Config, given: Mapping[str, str]) -> bool:
    """Whether a limit of the run has changed, or is given again by a flag."""
    return any(
        f"run.{name}" in given or getattr(before.run, name) != getattr(now.run, name)
        for name in _LIMITS
    )
