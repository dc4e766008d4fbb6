"""The flags of every command that trains cells."""

from pathlib import Path

from mrcdrl.common.config.arguments import Parser, whole_number


def add_cell_flags(made: Parser, noun: str, *, out: str, example: str, printed: str) -> None:
    """Add --out, --jobs, --only, --list and --json.

    noun: what a cell is called. out: the default folder. example: of a pattern. printed: by --json.
    """
    made.add_argument("--out", type=Path, metavar="DIR", help=f"folder of results; default: {out}")
    made.add_argument(
        "--jobs", type=whole_number(1), metavar="N", default=1, help=f"{noun}s at once; default: 1"
    )
    made.add_argument(
        "--only", metavar="PATTERN", default="*", help=f"{noun}s whose names match, as {example!r}"
    )
    made.add_argument("--list", action="store_true", help=f"print each {noun}'s state, do nothing")
    made.add_argument("--json", action="store_true", help=f"print {printed} as JSON, one a line")
