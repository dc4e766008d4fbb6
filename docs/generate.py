"""Writes docs/configuration.md, and the tables of docs/scaling.md: `python docs/generate.py`.

Invariants: the schema's docstrings are the only place where a setting is described; a setting
without a source, in brackets at the end of its description, is refused; no figure of the tables is
written by hand.
"""

import json
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from mrcdrl.common.config import Config, load_config, preset_names, sections, to_toml
from mrcdrl.services.tools.simulate import scaling
from mrcdrl.services.tools.simulate.scaling import Pace

TARGET = Path(__file__).with_name("configuration.md")
SCALING = Path(__file__).with_name("scaling.md")
TRIALS = Path(__file__).parents[1] / "benchmarks" / "results" / "simulate"
_TABLE = re.compile(r"(<!-- table: (\w+) -->\n).*?(<!-- end -->)", re.S)
_RATE = 4300.0  # robot steps per second of an actor with a core of its own: docs/profile.md
_UPDATES = 81.4  # per second of a learner on two cores: benchmarks/results/learner
_ACTORS = (10, 100, 1000)
_SOURCE = re.compile(r"^(?P<text>.*?)\s*\((?P<source>[^()]*)\)$")
_BOUNDS = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}

_HEAD = """# Configuration

<!-- Written by docs/generate.py from common/config/ and configs/: change those, then run it. -->

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


# -- scaling.md --------------------------------------------------------------------------


def render_scaling(text: str) -> str:
    """The page with its tables written anew."""
    tables = {"flows": _flows, "needs": _needs, "trials": _trials}
    return _TABLE.sub(lambda m: "".join([m[1], *tables[m[2]](), m[3]]), text)


def _row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |\n"


def _head(*cells: str) -> str:
    return _row(*cells) + "|---" * len(cells) + "|\n"


def _records() -> dict[str, Config]:
    """The preset quick with each kind of records."""
    return {c: load_config("quick", {"arena.codec": c}, environ={}) for c in ("scene", "frames")}


def _flows() -> Iterator[str]:
    """What one actor adds."""
    scene, frames = (scaling.flows(c, Pace.free(1, _RATE)) for c in _records().values())
    yield _head(
        *("flow", "way", "bytes, `scene`", "bytes, `frames`", "messages/s"),
        "processor, ms a message",
    )
    for small, large in zip(scene, frames, strict=True):
        sizes = (f"{flow.message_bytes:,.0f}" for flow in (small, large))
        per_s = "1 a publication" if small.name == "weights" else f"{small.per_s:,.1f}"
        whose = small.processor
        cost = "" if whose is None else f"{1000 * whose[1]:.2f}, {whose[0]}'s"
        yield _row(small.name, small.way, *sizes, per_s, cost)


def _needs() -> Iterator[str]:
    """What is there to be for many."""
    yield _head(
        *("records, pace", "actors", "transitions/s", "replay, cores", "router, cores"),
        *("router, MB/s", "shards", "routers", "first full"),
    )
    for codec, config in _records().items():
        for pace in ("held", "free"):
            for actors in _ACTORS:
                given = (
                    Pace.throttled(config, actors, _RATE, _UPDATES)
                    if pace == "held"
                    else Pace.free(actors, _RATE)
                )
                yield _need(f"`{codec}`, {pace}", config, given)
    spared = load_config(
        "quick",
        {"learner.publish_precision": "bfloat16", "learner.publish_period": "500"},
        environ={},
    )
    yield _need(
        "`scene`, held, weights spared", spared, Pace.throttled(spared, 1000, _RATE, _UPDATES)
    )


def _need(title: str, config: Config, pace: Pace) -> str:
    need = scaling.need(config, pace)
    return _row(
        title,
        pace.actors,
        f"{pace.transitions_per_s:,.0f}",
        f"{need.replay_cores:.2f}",
        f"{need.relay_cores:.2f}",
        f"{need.relay_bytes_per_s / 1e6:,.0f}",
        need.shards,
        need.routers,
        need.first,
    )


def _trials() -> Iterator[str]:
    """What was measured, beside what the model says of replay's process."""
    yield _head(
        *("trial", "actors", "transitions/s", "inserts/s", "insert p50, p99, ms", "held"),
        *("weights, MB/s", "replay, cores", "by the model", "replay, MiB"),
    )
    for path in sorted(TRIALS.glob("*.json")):
        figures = json.loads(path.read_text("utf-8"))
        replay, latency = figures["processes"]["replay-0"], figures["insert_ms"]
        yield _row(
            f"`{path.stem}`",
            figures["actors"],
            f"{figures['transitions_per_s']:,.0f}",
            f"{figures['inserts_per_s']:,.0f}",
            f"{latency['p50']:,.1f}, {latency['p99']:,.0f}",
            f"{figures['held']:,}",
            f"{figures['weights_bytes_per_s'] / 1e6:,.0f}",
            f"{replay['cores']:.2f}",
            f"{scaling.expected(figures):.2f}",
            f"{replay['memory_mib']:,.0f}",
        )


if __name__ == "__main__":
    TARGET.write_text(render(), "utf-8")
    SCALING.write_text(render_scaling(SCALING.read_text("utf-8")), "utf-8")
    sys.stdout.write(f"{TARGET} and {SCALING} written\n")
