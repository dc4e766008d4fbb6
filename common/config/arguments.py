"""Command-line flags from the configuration's schema; an unknown flag gets a suggestion.

Invariants: `--section.field VALUE` exists for every field, with its description; values are
checked by the schema, not here. A number that a flag of a command takes is checked as it is parsed.
"""

import argparse
import difflib
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

from mrcdrl.common.config import sections
from mrcdrl.common.config.schema import LARGEST

_DEST = "config:"


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that accepts no abbreviations and suggests the nearest flag.

    Flags may stand among positional arguments.
    """

    def __init__(self, *args: object, **kwargs: object) -> None:
        kwargs.setdefault("allow_abbrev", False)
        kwargs.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        parsed, unknown = self.parse_known_intermixed_args(args, namespace)
        if unknown:
            self._refuse(unknown[0])
        return parsed

    def _refuse(self, argument: str) -> NoReturn:
        name = argument.split("=")[0]
        known = [option for action in self._actions for option in action.option_strings]
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
        self.error(f"unknown argument {name}" + (f"; did you mean {near[0]}?" if near else ""))

    def error(self, message: str) -> NoReturn:
        """Write one line and exit with code 2."""
        sys.stderr.write(f"mrcdrl: {message} (see {self.prog} --help)\n")
        raise SystemExit(2)


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
        "--transport", metavar="FILE", help="a TOML file whose [transport] this process takes"
    )


def add_config_flags(
    parser: argparse.ArgumentParser,
    short: Mapping[str, str] | None = None,
    *,
    only: Sequence[str] = (),
) -> None:
    """Add a flag for every field of the configuration.

    short: shorter spellings, such as {"arena.num_robots": "--robots"}. only: these sections.
    """
    shorter = short or {}
    for section, model in sections().items():
        if only and section not in only:
            continue
        group = parser.add_argument_group(f"[{section}]")
        for name, info in model.model_fields.items():
            text = re.sub(r"\s+", " ", info.description or "").replace("%", "%%")
            default = re.sub(r"\s+", "", str(info.default)).replace("%", "%%")
            field = f"{section}.{name}"
            spellings = dict.fromkeys((f"--{field}", f"--{field}".replace("_", "-")))
            if field in shorter:
                spellings[shorter[field]] = None
            group.add_argument(
                *spellings,
                dest=f"{_DEST}{field}",
                metavar="X",
                help=f"{text} Default: {default}",
            )


def overrides(namespace: argparse.Namespace) -> dict[str, str]:
    """The configuration flags that were given, as "section.field" to text."""
    return {
        key.removeprefix(_DEST): value
        for key, value in vars(namespace).items()
        if key.startswith(_DEST) and value is not None
    }
