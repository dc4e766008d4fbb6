"""Names of runs and workers, which become part of key expressions and file names; text to show."""

import re

from mrcdrl.common.errors import ConfigError

MAX_NAME = 64  # characters
MAX_TEXT = 300  # characters shown of what a peer says
_NAME = re.compile(rf"[A-Za-z0-9][A-Za-z0-9._-]{{0,{MAX_NAME - 1}}}")


def is_name(name: str) -> bool:
    """Whether `name` fits key expressions and file names."""
    return _NAME.fullmatch(name) is not None


def check_name(name: str, what: str) -> str:
    """Return `name`; raises ConfigError if it does not fit key expressions and file names."""
    if not is_name(name):
        raise ConfigError(
            f"{what} {name!r}: use up to {MAX_NAME} ASCII letters, digits, '.', '_' and '-', "
            "beginning with a letter or digit"
        )
    return name


def printable(text: str) -> str:
    """What a peer says, fit for a terminal and a log: bounded, control characters escaped."""
    shown = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text[:MAX_TEXT])
    return shown + "…" * (len(text) > MAX_TEXT)
