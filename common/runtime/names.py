"""Names of runs, workers and roles: they stand in key expressions and in file names."""

import re

from mrcdrl.common.errors import ConfigError

MAX_NAME = 64  # characters
_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME - 1}}}")


def check_name(name: str, what: str) -> str:
    """`name`, or ConfigError where it would not stand in a key expression and a file name."""
    if not _NAME.fullmatch(name):
        raise ConfigError(
            f"{what} {name!r}: up to 64 letters, digits, '.', '_' and '-', a letter or digit first"
        )
    return name
