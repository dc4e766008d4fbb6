"""The settings that a run keeps for as long as it lasts, however often it is resumed."""

from pathlib import Path

from mrcdrl.common.config.load import variable
from mrcdrl.common.config.schema import Config, kept_settings
from mrcdrl.common.errors import RunDirectoryError


def refuse_changes(run_dir: Path, before: Config, now: Config) -> None:
    """Raise RunDirectoryError if a setting differs that the run's weights or records depend on.

    before, now: what the run was made with, and is to go on with.
    """
    for section, name in kept_settings(lockstep=bool(before.run.turn_size)):
        old, new = (getattr(getattr(config, section), name) for config in (before, now))
        if old != new:
            raise RunDirectoryError(
                f"{section}.{name} is {new} here and {old} in {run_dir}, whose weights or "
                f"transitions need it; leave out its flag or {variable(section, name)}, or start a "
                "new run"
            )
