"""Facts of each setting, read off the schema: what it means, which values it takes, its unit."""

import difflib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from mrcdrl.common.config.schema import sections
from mrcdrl.common.errors import ConfigError

_SOURCE = re.compile(r"^(?P<text>.*?)\s*\((?P<source>[^()]*)\)$")
_LIMITS = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
_LONGEST_HINT = 24  # characters; longer limits are there against overflow
_TYPES = {int: "integer", float: "number", str: "text"}
_UNITS = {  # by the last word of a name
    "px": "px",
    "deg": "degrees",
    "s": "seconds",
    "minutes": "minutes",
    "bytes": "bytes",
    "frames": "frames",
    "episodes": "episodes",
    "steps": "steps",
}


@dataclass(frozen=True, slots=True)
class Setting:
    """A setting, as the schema declares it."""

    section: str
    name: str
    meaning: str
    source: str  # of the default: the paper, ours …
    choices: tuple[str, ...]  # the only values; empty if there are others
    kind: str  # integer, number, text or list of …; empty for choices
    limits: str  # such as "between 1 and 10", or empty
    unit: str  # or empty
    default: Any

    @property
    def key(self) -> str:
        return f"{self.section}.{self.name}"

    @property
    def allowed(self) -> str:
        """The values that it takes, in words."""
        return listed(self.choices) or f"{self.kind} {self.limits}".strip()

    @property
    def hint(self) -> str:
        """The values that it takes, unless its type, unit or meaning tells them already."""
        if self.choices:
            return "" if "`" in self.meaning else listed(self.choices)
        told = self.limits.startswith("between") and len(self.limits) <= _LONGEST_HINT
        return self.limits if told else ""

    @property
    def metavar(self) -> str:
        """What stands for a value in help."""
        if self.choices:
            return "WORD"
        if self.kind.startswith("list"):
            return "LIST"
        return self.unit.upper() or {"integer": "N", "number": "X"}.get(self.kind, "TEXT")


def all_settings() -> Iterator[Setting]:
    """Every setting, in the order of the file."""
    for section, model in sections().items():
        for name, info in model.model_fields.items():
            yield _setting(section, name, info)


def find_setting(key: str) -> Setting:
    """The setting of this name, such as learner.seed; raises ConfigError, naming the nearest."""
    known = {setting.key: setting for setting in all_settings()}
    if key in known:
        return known[key]
    name = key.rpartition(".")[2]
    near = [known_key for known_key in known if known_key.endswith(f".{name}")]
    near = near or difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    hint = f"did you mean {listed(near)}?" if near else "`mrcdrl config` lists all"
    raise ConfigError(f"no setting {key!r}; {hint}")


def limits(info: FieldInfo) -> str:
    """The limits of a field in words, such as "between 1 and 10"; empty if it has none."""
    bounds = [
        f"{words} {_number(getattr(bound, name))}"
        for bound in info.metadata
        for name, words in _LIMITS.items()
        if hasattr(bound, name)
    ]
    return re.sub("at least (.*) and at most", r"between \1 and", " and ".join(bounds))


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _setting(section: str, name: str, info: FieldInfo) -> Setting:
    described = re.sub(r"\s+", " ", info.description or "").strip()
    match = _SOURCE.match(described)
    words = get_args(info.annotation) if get_origin(info.annotation) is Literal else ()
    choices = ("true", "false") if info.annotation is bool else words
    return Setting(
        section,
        name,
        match["text"] if match else described,
        match["source"] if match else "",
        choices,
        "" if choices else _type_name(info.annotation),
        limits(info),
        _UNITS.get(name.rpartition("_")[2], ""),
        info.default,
    )


def _type_name(kind: Any) -> str:
    if get_origin(kind) is tuple:
        inner = [a for a in get_args(kind) if a is not Ellipsis]
        names = ", ".join(_type_name(a) for a in inner)
        return f"list of {names}" if Ellipsis in get_args(kind) else f"[{names}]"
    return _TYPES[kind]


def listed(words: Sequence[str], last: str = "or") -> str:
    """Words as "a, b or c"."""
    return f" {last} ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))
