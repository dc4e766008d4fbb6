"""Writes docs/configuration.md from the schema: `python docs/generate.py`.

Invariants: the schema's docstrings are the only place where a setting is described; a setting
without a source, in brackets at the end of its description, is refused.
"""

import re
import sys
import tomllib
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from common.config import Config, load_config, preset_names, sections, to_toml

TARGET = Path(__file__).with_name("configuration.md")
_SOURCE = re.compile(r"^(?P<text>.*?)\s*\((?P<source>[^()]*)\)$")
_BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}

_HEAD = """# Configuration

<!-- Written by docs/generate.py from common/config.py and configs/: change those, then run it. -->

One configuration serves all processes of a run. A flag beats an environment variable, which beats
the file, which beats the default below:

| way | example |
|---|---|
| file | `[learner]` and below it `batch_size = 64`, given as `--config FILE` |
| environment | `MRCDRL_LEARNER__BATCH_SIZE=64` |
| flag | `--learner.batch_size 64` |

- `--config` takes a preset's name or a TOML file. A file may begin with `extends = "quick"` (a
  preset or another file) and say only what differs.
- Values of flags and variables are TOML; a word that is no TOML is taken as a string.
- An unknown name is refused with the nearest right one, an impossible value with the reason.
- `mrcdrl config` takes the same flags and prints what comes of them. A run keeps its own in
  `runs/NAME/config.toml`; `--resume` reads it there.
- A process that joins a run takes the run's configuration from the replay service, and over it
  its own flags. `[transport]` is the exception: it is about one process, and a process that joins
  takes it from its own environment and flags. Those that `mrcdrl train` starts, replay apart, run
  with its defaults.

*Source* says where a default comes from: *paper* (the publication, docs/paper.md), *ancestor* (the
pymunk car game that the paper's environment descends from), *Ape-X* or *dueling paper* (those
publications), *ours*.
"""


def render() -> str:
    """The whole page."""
    defaults = tomllib.loads(to_toml(Config()))
    shown = _shown(to_toml(Config()))
    parts = [_HEAD]
    for section, model in sections().items():
        title = re.sub(r"\s+", " ", model.__doc__ or "").strip()
        parts.append(f"\n## [{section}]\n\n{title}\n\n")
        parts.append("| setting | default | allowed | meaning | source |\n|---|---|---|---|---|\n")
        for name, info in model.model_fields.items():
            text, source = described(f"{section}.{name}", info)
            cells = (f"`{name}`", f"`{shown[section, name]}`", _allowed(info), text, source)
            parts.append("| " + " | ".join(cells) + " |\n")
    parts.append(_presets(defaults))
    return "".join(parts)


def described(name: str, info: FieldInfo) -> tuple[str, str]:
    """A setting's meaning and source; raises ValueError where it lacks the source."""
    flat = re.sub(r"\s+", " ", info.description or "").strip()
    match = _SOURCE.match(flat)
    if match is None:
        raise ValueError(f"{name}: its description ends without a source in brackets: {flat!r}")
    return _cell(match["text"]) or "–", _cell(match["source"])


def _shown(toml: str) -> dict[tuple[str, str], str]:
    """(section, field) to its value as TOML text."""
    values: dict[tuple[str, str], str] = {}
    section = ""
    for line in toml.splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line:
            name, _, value = line.partition(" = ")
            values[section, name] = value
    return values


def _allowed(info: FieldInfo) -> str:
    """Type and limits, or the words to choose from."""
    kind = info.annotation
    if get_origin(kind) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(kind))
    limits = [
        f"{sign} {getattr(bound, name):g}"
        for bound in info.metadata
        for name, sign in _BOUNDS.items()
        if hasattr(bound, name)
    ]
    return ", ".join([_type_name(kind), *limits])


def _type_name(kind: Any) -> str:
    if get_origin(kind) is tuple:
        inner = [a for a in get_args(kind) if a is not Ellipsis]
        names = ", ".join(_type_name(a) for a in inner)
        return f"list of {names}" if Ellipsis in get_args(kind) else f"[{names}]"
    return {int: "integer", float: "number", str: "text", bool: "`true`, `false`"}[kind]


def _presets(defaults: dict[str, dict[str, Any]]) -> str:
    """What each preset changes of the defaults."""
    tables = {name: load_config(name, environ={}) for name in preset_names()}
    values = {name: tomllib.loads(to_toml(config)) for name, config in tables.items()}
    shown = {name: _shown(to_toml(config)) for name, config in tables.items()}
    lines = [
        "\n## Presets\n\nWhat the files in `configs/` change; an empty cell is the default.\n\n",
        f"| setting | default | {' | '.join(values)} |\n|---|---|{'---|' * len(values)}\n",
    ]
    for (section, field), default in _shown(to_toml(Config())).items():
        before = defaults[section][field]
        cells = [
            f"`{shown[name][section, field]}`" if table[section][field] != before else ""
            for name, table in values.items()
        ]
        if any(cells):
            lines.append(f"| `{section}.{field}` | `{default}` | {' | '.join(cells)} |\n")
    return "".join(lines)


def _cell(text: str) -> str:
    """Text that may stand in a table."""
    return text.replace("|", "\\|")


if __name__ == "__main__":
    TARGET.write_text(render(), "utf-8")
    sys.stdout.write(f"{TARGET} written\n")
