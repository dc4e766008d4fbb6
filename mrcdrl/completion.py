"""Completes a command line for a shell, which asks by environment variables.

Imported only then: argcomplete has no part in running a command.
"""

import os
from collections.abc import Callable, Sequence

import argcomplete
from argcomplete.lexers import split_line

from mrcdrl.cli import COMMANDS, split
from mrcdrl.common.config.arguments import Parser
from mrcdrl.common.runtime.completion import completed_by

Completer = Callable[[str], list[str]]
_SKIPPED = "_ARGCOMPLETE"  # words before a parser's own, plus one; the shell's function sets it


def complete() -> None:
    """Write the words that may stand where the cursor is, and end the process."""
    _, typed, _, words, _ = split_line(os.environ["COMP_LINE"], int(os.environ["COMP_POINT"]))
    name, rest = split(words[1:])
    if name in COMMANDS:
        parser = COMMANDS[name].parser()
        os.environ[_SKIPPED] = str(int(os.environ[_SKIPPED]) + len(name.split()))
        if not rest:
            _add_words(parser, [n.split()[1] for n in COMMANDS if n.startswith(f"{name} ")])
    else:
        parser = Parser(prog="mrcdrl")
        parser.add_argument("--version", action="store_true", help="print the version")
        _add_words(parser, [n for n in COMMANDS if " " not in n])
    argcomplete.autocomplete(parser, exclude=_rare(parser, typed))


def _add_words(parser: Parser, words: Sequence[str]) -> None:
    """Complete the first argument by these words too."""
    if words:
        arguments = [action for action in parser._actions if not action.option_strings]
        first = arguments[0] if arguments else parser.add_argument("word", nargs="?")
        own: Completer = getattr(first, "completer", lambda _: [])
        completed_by(first, lambda typed: [*words, *own(typed)])


def _rare(parser: Parser, typed: str) -> list[str]:
    """Flags of settings that the short help leaves out, unless they are what is being typed.

    Spellings with dashes in place of underscores are always left out.
    """
    rare = []
    for action in parser._actions:
        setting = parser.settings.get(action.dest)
        if setting is not None:
            usual = (action.option_strings[0], f"--{setting.key}")
            shown = setting.key in parser.shown or typed.strip("-")
            rare += [word for word in action.option_strings if not shown or word not in usual]
    return rare
