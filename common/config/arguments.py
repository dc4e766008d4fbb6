"""The parser of all commands, and the flags that every command with a configuration takes.

Invariants: `--section.field VALUE` exists for every setting; its values are checked by the schema,
not here. A short spelling means the same in every command. A number that a flag of a command takes
is checked as it is parsed.
"""

import argparse
import difflib
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NoReturn

from mrcdrl.common.config.help import help_text
from mrcdrl.common.config.load import DEFAULT_PRESET, preset_names
from mrcdrl.common.config.schema import LARGEST
from mrcdrl.common.config.settings import Setting, all_settings, listed
from mrcdrl.common.runtime.completion import completed_by

SEEDS = ("run.seed", "learner.seed", "replay.seed")  # of training
_SHORT = {
    "arena.num_robots": "--robots",
    "arena.env": "--env",
    "run.minutes": "--minutes",
    "run.learner_steps": "--learner-steps",
    "run.actors": "--actors",
    "transport.metrics_port": "--metrics-port",
    "transport.metrics_address": "--metrics-address",
}
_DEST = "config:"
_HELP = ("-h", "--help")
_HELP_ALL = "--help-all"


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that accepts no abbreviations and suggests the nearest flag.

    Flags may stand among positional arguments.
    """

    def __init__(self, *args: object, **kwargs: object) -> None:
        self.settings: dict[str, Setting] = {}  # by where their flags store them
        self.shown: tuple[str, ...] = ()  # settings that the short help has
        self.takes_config = False
        self.default_config: str | None = None  # what holds without --config and without a run
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse; help is shown wherever its flag stands, and whatever else is missing or wrong."""
        words = list(sys.argv[1:] if args is None else args)
        if {*_HELP, _HELP_ALL} & set(words):
            sys.stdout.write(help_text(self, words, everything=_HELP_ALL in words))
            raise SystemExit(0)
        parsed, unknown = self.parse_known_intermixed_args(words, namespace)
        if unknown:
            self._refuse(unknown[0])
        return parsed

    def format_help(self) -> str:
        """The help that fits a screen."""
        return help_text(self, [], everything=False)

    def _refuse(self, argument: str) -> NoReturn:
        name = argument.split("=")[0]
        near = nearest_flags(name, [o for action in self._actions for o in action.option_strings])
        self.error(f"unknown argument {name}" + (f"; did you mean {listed(near)}?" if near else ""))

    def error(self, message: str) -> NoReturn:
        """Write one line and exit with code 2."""
        sys.stderr.write(f"mrcdrl: {message} (see {self.prog} --help)\n")
        raise SystemExit(2)


def nearest_flags(name: str, known: Iterable[str]) -> list[str]:
    """The flags that may be meant: settings of that name in any section, or else the nearest."""
    flags = list(known)
    bare = name.lstrip("-").replace("-", "_")
    named = [flag for flag in flags if flag.endswith(f".{bare}")] if name.startswith("--") else []
    return named or difflib.get_close_matches(name, flags, n=1, cutoff=0.5)


def whole_number(least: int, most: int = LARGEST) -> Callable[[str], int]:
    """An argparse type: whole numbers between these, both included."""

    def parsed(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
        if not least <= number <= most:
            limits = f"at least {least}" if number < least else f"at most {most}"
            raise argparse.ArgumentTypeError(f"{number} must be {limits}")
        return number

    return parsed


def add_transport_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag of a process that has settings of its own in [transport] only."""
    parser.add_argument(
        "--transport", metavar="FILE", help="TOML file whose [transport] this process uses"
    )


def add_config_flag(
    parser: Parser, default: str | None = DEFAULT_PRESET, *, of_run: bool = False
) -> None:
    """Add --config.

    default: what the command reads without it; None: the schema's own defaults. of_run: where the
    command's run has a configuration, the command reads that first.
    """
    parser.takes_config, parser.default_config = True, default
    holds = f"the run's, or else {default or 'no preset'}" if of_run else default
    presets = preset_names()
    action = parser.add_argument(
        "--config",
        metavar="PRESET",
        help=f"{listed(presets)}, or a TOML file (default: {holds})",
    )
    completed_by(action, lambda typed: [*presets, *_toml_files(typed)])


def _toml_files(typed: str) -> list[str]:
    """Paths of TOML files, and of folders, beside what is typed."""
    folder = Path(f"{typed}_").parent
    found = sorted(p for p in folder.glob("*") if p.suffix == ".toml" or p.is_dir())
    return [f"{path}/" if path.is_dir() else str(path) for path in found]


def add_config_flags(
    parser: Parser,
    shown: Sequence[str] = (),
    *,
    only: Sequence[str] = (),
    seeds: Sequence[str] = SEEDS,
) -> None:
    """Add a flag for every setting, and short spellings of the usual ones.

    Call it after a command's own flags, which keep a short spelling of the same name.

    shown: the settings that the short help has; all are in that of --help-all. only: these
    sections. seeds: what --seed sets.
    """
    parser.shown = tuple(shown)
    own = {word for action in parser._actions for word in action.option_strings}
    for setting in all_settings():
        if only and setting.section not in only:
            continue
        flag = f"--{setting.key}"
        spellings = [_SHORT.get(setting.key, flag), flag, flag.replace("_", "-")]
        action = parser.add_argument(
            *dict.fromkeys(word for word in spellings if word not in own),
            dest=f"{_DEST}{setting.key}",
            metavar=setting.metavar,
            help=setting.meaning.replace("%", "%%"),
        )
        parser.settings[action.dest] = setting
        completed_by(action, setting.choices)
    if "--seed" not in own and not only:
        parser.add_argument(
            "--seed",
            action=_SetAll,
            const=[f"{_DEST}{key}" for key in seeds],
            default=argparse.SUPPRESS,
            metavar="N",
            help=f"sets {listed(seeds, 'and')}",
        )
    parser.add_argument(_HELP_ALL, action="store_true", help="show every setting and exit")


class _SetAll(argparse.Action):
    """A flag that sets several settings, except those that have flags of their own."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: object,
        option_string: str | None = None,
    ) -> None:
        for dest in self.const:
            if getattr(namespace, dest) is None:
                setattr(namespace, dest, values)


def overrides(namespace: argparse.Namespace) -> dict[str, str]:
    """The configuration flags that were given, as "section.field" to text."""
    return {
        key.removeprefix(_DEST): value
        for key, value in vars(namespace).items()
        if key.startswith(_DEST) and value is not None
    }
