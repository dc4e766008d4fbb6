"""Names of runs and workers, which become part of key expressions and file names."""

import re

from mrcdrl.common.errors import ConfigError

MAX_NAME = 64  # characters
_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME - 1}}}")


def check_name(name: str, what: str) -> str:
    """Return `name`; raises ConfigError if it does not fit key expressions and file names."""
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{what} {name!r}: use up to {MAX_NAME} ASCII letters, digits, '.', '_' and '-', "
            "beginning with a letter or digit"
        )
    return name
