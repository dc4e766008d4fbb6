"""The latest lines of a run's logs, of all its processes in the order of their times.

Invariants: what is read and returned is bounded; the text is as processes wrote it, with what is
not printable replaced, and is escaped by whoever shows it.
"""

import re
from pathlib import Path

from mrcdrl.common.runtime.names import MAX_TEXT, printable

MAX_LINES = 300
_MAX_LOGS = 64
_TAIL_BYTES = 1 << 15
_LINE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d),\d+ (\w+) ([\w.]+): (.*)")


def log_lines(run_dir: Path) -> list[dict[str, str]]:
    """The lines with their time, level, worker and text, oldest first."""
    try:
        paths = sorted((run_dir / "logs").glob("*.log"), key=lambda path: -path.stat().st_mtime)
    except OSError:
        return []
    lines = [line for path in paths[:_MAX_LOGS] for line in _lines_of(path)]
    return sorted(lines, key=lambda line: line["time"])[-MAX_LINES:]


def _lines_of(path: Path) -> list[dict[str, str]]:
    try:
        if path.resolve().parent != path.parent:
            return []
        with path.open("rb") as log:
            log.seek(max(0, path.stat().st_size - _TAIL_BYTES))
            text = log.read(_TAIL_BYTES).decode("utf-8", "replace")
    except OSError:
        return []
    matches = (_LINE.match(line) for line in text.splitlines())
    return [
        {
            "time": found[1],
            "level": found[2],
            "worker": printable(path.stem),
            "text": printable(found[4])[:MAX_TEXT],
        }
        for found in matches
        if found
    ]
