"""Help that fits a screen: what people use, with the values that hold; or every setting."""

import argparse
import contextlib
import copy
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from mrcdrl.common.config.load import load_config, source_name
from mrcdrl.common.config.settings import Setting
from mrcdrl.common.config.toml import toml_value
from mrcdrl.common.errors import ConfigError, MrcdrlError
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.runs import run_path

if TYPE_CHECKING:
    from mrcdrl.common.config.arguments import Parser

_WIDEST = 100  # columns
_HELP_COLUMN = 26
Values = Mapping[str, Mapping[str, Any]]  # of settings, by section and name


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Writes a flag's spellings first and then, once, what stands for its value."""

    def __init__(self, prog: str) -> None:
        width = min(shutil.get_terminal_size().columns, _WIDEST)
        super().__init__(prog, max_help_position=_HELP_COLUMN, width=width)

    def _format_action_invocation(self, action: argparse.Action) -> str:
        if not action.option_strings:
            return super()._format_action_invocation(action)
        value = self._format_args(action, self._get_default_metavar_for_optional(action))
        return f"{', '.join(action.option_strings)} {value}".rstrip()


def help_text(parser: "Parser", words: Sequence[str], *, everything: bool) -> str:
    """The help of a command: what people use, or every setting.

    words: its command line, whose --config or run says which values hold.
    """
    formatter = _Formatter(parser.prog)
    arguments = [action for action in parser._actions if not action.option_strings]
    flags = [a for a in parser._actions if a.option_strings and a.dest not in parser.settings]
    formatter.add_text(f"usage: {_usage(parser.prog, arguments, flags)}")
    formatter.add_text(parser.description)
    _add(formatter, "arguments", arguments)
    _add(formatter, "flags", flags)
    if parser.settings:
        values, title = _in_force(parser, words)
        rows = [
            (action, parser.settings[action.dest])
            for action in parser._actions
            if action.dest in parser.settings
        ]
        if everything:
            for section in dict.fromkeys(setting.section for _, setting in rows):
                members = [_row(a, s, values) for a, s in rows if s.section == section]
                _add(formatter, f"[{section}] {title}", members)
        else:
            usual = {s.key: _row(a, s, values, spellings=1) for a, s in rows}
            _add(formatter, title, [usual[key] for key in parser.shown])
    formatter.add_text(parser.epilog)
    return formatter.format_help()


def _usage(
    prog: str, arguments: Iterable[argparse.Action], flags: Iterable[argparse.Action]
) -> str:
    """One line: the arguments, and the flags that must be given."""
    words = [prog]
    for action in arguments:
        name = str(action.metavar or action.dest.upper())
        many = " …" if action.nargs in ("*", "+") else ""
        words.append(f"[{name}{many}]" if action.nargs in ("?", "*") else f"{name}{many}")
    words += [f"{a.option_strings[0]} {a.metavar or 'X'}" for a in flags if a.required]
    return " ".join([*words, "[flags]"])


def _add(formatter: argparse.HelpFormatter, title: str, actions: Sequence[argparse.Action]) -> None:
    formatter.start_section(title)
    formatter.add_arguments(actions)
    formatter.end_section()


def _row(
    action: argparse.Action, setting: Setting, values: Values | None, spellings: int = 2
) -> argparse.Action:
    """The flag of a setting as help shows it: its first spellings, and the value that holds."""
    row = copy.copy(action)
    own = dict.fromkeys((action.option_strings[0], f"--{setting.key}"))
    row.option_strings = list(own)[:spellings]
    told = [setting.hint] if setting.hint else []
    if values is not None:
        told.append(f"default: {_shown(values[setting.section][setting.name])}")
    brackets = f" ({'; '.join(told)})" if told else ""
    row.help = f"{setting.meaning.rstrip('.')}{brackets}".replace("%", "%%")
    return row


def _shown(value: object) -> str:
    """A value without the quotes and the zero that TOML needs."""
    return value or "none" if isinstance(value, str) else toml_value(value).removesuffix(".0")


def _in_force(parser: "Parser", words: Sequence[str]) -> tuple[Values | None, str]:
    """The values that hold without further flags, and the title of what is listed with them.

    None: a run that is elsewhere decides them.
    """
    arguments, rest = _scan(parser, words)
    given = getattr(arguments, "config", None) if parser.takes_config else None
    source = given or _config_of_run(arguments, rest) or parser.default_config
    if source is None and not parser.takes_config:
        return None, "settings"
    title = f"settings (defaults of {source_name(source)})" if source else "settings"
    try:
        return load_config(source).model_dump(), title
    except ConfigError as error:
        sys.stderr.write(f"mrcdrl: {error}\n")
        return None, "settings"


def _scan(parser: "Parser", words: Sequence[str]) -> tuple[argparse.Namespace, list[str]]:
    """The flags on a command line that may be incomplete or wrong, and the words that are none."""
    scan = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for action in parser._actions:
        if action.option_strings and action.dest != "help":
            optional = copy.copy(action)
            optional.required = False
            scan._add_action(optional)
    try:
        arguments, rest = scan.parse_known_args(words)
    except argparse.ArgumentError:
        return argparse.Namespace(), []
    return arguments, [word for word in rest if not word.startswith("-")]


def _config_of_run(arguments: argparse.Namespace, words: Sequence[str]) -> str | None:
    """The configuration of the run that is named, if it is here."""
    named = [getattr(arguments, flag, None) for flag in ("resume", "run")]
    for word in filter(None, [*named, *words]):
        with contextlib.suppress(MrcdrlError):
            file = run_path(word, getattr(arguments, "run_dir", None)) / RUN_CONFIG
            if file.is_file():
                return str(file)
    return None
