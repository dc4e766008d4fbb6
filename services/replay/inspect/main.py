"""`mrcdrl replay inspect RUN`: show what the log of a run holds, read from its files."""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.config.arguments import (
    Parser,
    add_config_flag,
    add_config_flags,
    overrides,
    whole_number,
)
from mrcdrl.common.runtime.files import RUN_CONFIG, prepare_output
from mrcdrl.common.runtime.runs import add_run, find_run
from mrcdrl.services.replay.inspect.contents import log_directory, read_contents
from mrcdrl.services.replay.inspect.export import write_export
from mrcdrl.services.replay.inspect.summary import summarize

_BAR = 32


def main(argv: Sequence[str]) -> int:
    """Read the log and show it; return the exit code."""
    arguments = parser().parse_args(argv)
    run = find_run(arguments.run, arguments.run_dir)
    if arguments.export is not None:
        prepare_output(arguments.export)
    directory = log_directory(run, arguments.shard)
    config = _config(run, arguments.config, overrides(arguments))
    contents = read_contents(directory, config, records=arguments.export is not None)
    found = {"log": str(directory), **summarize(contents)}
    if arguments.export is not None:
        count = write_export(arguments.export, contents)
        found["export"] = {"file": str(arguments.export), "transitions": count}
    if arguments.json:
        print(json.dumps(found))
        return 0
    show(found, Console(file=sys.stdout))
    if arguments.export is not None:
        print(f"\n{arguments.export}: {count} transitions")
    return 0


def parser() -> Parser:
    """The command's flags."""
    description = "Show what the replay log of a run holds."
    made = Parser(prog="mrcdrl replay inspect", description=description)
    add_run(made)
    made.add_argument(
        "--shard", metavar="N", type=whole_number(0), default=0, help="the replay shard; default: 0"
    )
    add_config_flag(made, None, of_run=True)
    made.add_argument("--json", action="store_true", help="print JSON")
    made.add_argument("--export", type=Path, metavar="FILE.npz", help="write the transitions")
    add_config_flags(made)
    return made


def _config(run: Path, source: str | None, given: dict[str, str]) -> Config | None:
    """The run's configuration; None if it has none, because its services were started by hand."""
    own = run / RUN_CONFIG
    if source is None and not given and not own.is_file():
        return None
    return load_config(source or (str(own) if own.is_file() else None), given)


def show(found: dict[str, Any], console: Console) -> None:
    """Print the summary for a reader."""
    console.print(found["log"], highlight=False, soft_wrap=True)
    console.print(_facts(found))
    if found["actors"]:
        console.print()
        console.print(_actors(found["actors"]))
    source = found["priorities"]["source"]
    weights = found["weights"] or {"staleness": None}
    for title, spread in (
        (f"priorities of the table, from the {source}", found["priorities"]["spread"]),
        ("rewards (n-step returns)", found["rewards"]),
        ("staleness: versions behind the newest weights", weights["staleness"]),
    ):
        if spread is not None:
            numbers = (f"{n} {spread[n]:.4g}" for n in ("min", "median", "mean", "max"))
            console.print(f"\n{title}: {', '.join(numbers)}", highlight=False, soft_wrap=True)
            console.print(_bars(spread))


def _facts(found: dict[str, Any]) -> Table:
    grid = Table.grid(padding=(0, 2))
    for name, text in _lines(found):
        grid.add_row(name, text)
    return grid


def _lines(found: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the name and text of each line."""
    files, table, weights = found["files"], found["table"], found["weights"]
    yield "log", f"{found['transitions']} transitions in {found['chunks']} chunks"
    yield (
        "files",
        f"{files['segments']} segments, {files['bytes'] / 1e6:.1f} MB, last written "
        f"{_ago(files['oldest_s'])} (oldest) to {_ago(files['newest_s'])} ago",
    )
    for count, what in (
        (files["torn_bytes"], "bytes after the last whole record: torn, or being written"),
        (files["corrupt_records"], "corrupt records"),
        (files["left_out_chunks"], "chunks of another schema, arena or agent"),
        (files["duplicate_chunks"], "duplicate chunks"),
    ):
        if count:
            yield "damage", f"{count} {what}"
    if found["first_key"] is not None:
        yield "keys", f"{found['first_key']} to {found['last_key']}"
    if table is None:
        yield "table", "unknown: the run has no config.toml; give --config"
    else:
        samples = "" if table["samples"] is None else f", {table['samples']} samples"
        yield "table", f"{table['size']} of {table['capacity']} transitions after a start"
        yield "counted", f"{table['inserts']} inserts{samples}"
    if weights is not None:
        yield "weights", f"versions {weights['oldest']} to {weights['newest']}"
        left, straight, right = found["actions"]
        yield "actions", f"{left} left, {straight} straight, {right} right"
        fraction = found["terminations"] / max(found["transitions"], 1)
        yield "ends", f"{found['terminations']} transitions reach a termination ({fraction:.2%})"


def _ago(seconds: float) -> str:
    minutes, left = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {left} s"


def _actors(actors: Sequence[dict[str, Any]]) -> Table:
    table = Table(box=None)
    for name in actors[0]:
        table.add_column(name.replace("_", " "), justify="left" if name == "actor" else "right")
    for actor in actors:
        table.add_row(*(str(value) for value in actor.values()))
    return table


def _bars(spread: dict[str, Any]) -> Table:
    """A histogram with one line per bin."""
    table = Table.grid(padding=(0, 2))
    highest = max(spread["counts"])
    for low, high, count in zip(
        spread["edges"][:-1], spread["edges"][1:], spread["counts"], strict=True
    ):
        bar = "█" * round(_BAR * count / highest) or ("▏" if count else "")
        table.add_row(f"{low:.4g}", f"… {high:.4g}", bar, str(count))
    return table
