"""The words by which a shell completes the value of a flag or argument."""

import argparse
from collections.abc import Callable, Iterable


def completed_by(
    action: argparse.Action, words: Iterable[str] | Callable[[str], Iterable[str]]
) -> None:
    """Have a shell complete the values of a flag or argument by these words.

    words: if callable, called with what is typed already. Without any, file names complete it.
    """

    def completer(prefix: str, **_: object) -> list[str]:
        every = words(prefix) if callable(words) else words
        return [word for word in every if word.startswith(prefix)]

    if words:
        action.completer = completer  # type: ignore[attr-defined]
