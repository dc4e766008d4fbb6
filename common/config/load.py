"""Loading a configuration from a preset or file, the environment, and flags.

Precedence: a flag beats an environment variable, which beats the file, which beats the default.
Invariant: an unknown name is refused, and the nearest known one suggested.
"""

import difflib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from mrcdrl.common.config.schema import Config, TransportConfig, sections
from mrcdrl.common.config.settings import limits
from mrcdrl.common.config.toml import from_toml
from mrcdrl.common.errors import ConfigError

DEFAULT_PRESET = "quick"  # of commands that get no --config
ENV_PREFIX = "MRCDRL_"
EXTENDS = "extends"
_SHOWN = 200  # characters of a wrong value
_SPELLINGS = {"num_robots", "robots"}  # of how many robots there are
_TYPES = {
    "int": "must be a whole number",
    "float": "must be a number",
    "finite": "must be a finite number",
    "bool": "must be true or false",
    "string": "must be text",
}


def preset_names() -> list[str]:
    """Names that `--config` accepts besides a path."""
    files = resources.files("mrcdrl.configs").iterdir()
    return sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml"))


def _unknown(name: str, known: Sequence[str], what: str, where: str) -> ConfigError:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]}?" if near else f"; known: {', '.join(known)}"
    return ConfigError(f"{where}: unknown {what} {name!r}{hint}")


def _read_toml(source: str) -> dict[str, Any]:
    """The table of a preset or file, merged over those that it extends."""
    merged: dict[str, Any] = {}
    for _, table in _layers(source):
        for section, values in table.items():
            merged[section] = _merged(merged.get(section, {}), values)
    return merged


def _layers(source: str, above: tuple[str, ...] = ()) -> list[tuple[str, dict[str, Any]]]:
    """The names and tables of a preset or file and of those that it extends, the lowest first.

    above: the files that extend this one.
    """
    path = Path(source)
    if source in preset_names():
        text = (resources.files("mrcdrl.configs") / f"{source}.toml").read_text("utf-8")
    else:
        try:
            text = path.read_text("utf-8-sig")  # some editors begin a file with a mark
        except (OSError, UnicodeDecodeError) as error:
            presets = ", ".join(preset_names())
            reason = getattr(error, "strerror", None) or str(error)
            raise ConfigError(
                f"config {source!r}: {reason}; give a file or a preset: {presets}"
            ) from error
    try:
        table = from_toml(text)
    except ConfigError as error:
        raise ConfigError(f"config {source!r} is {error}") from error
    base = table.pop(EXTENDS, None)
    _check_names(table, f"config {source!r}")
    if base is None:
        return [(source, table)]
    if base not in preset_names():
        base = str(path.parent / str(base))
    if base in (*above, source):
        raise ConfigError(f"config {source!r} extends itself via {', '.join((*above, source))}")
    return [*_layers(base, (*above, source)), (source, table)]


def _merged(below: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """A section's values over those below; of two spellings of one setting the last counts."""
    kept = dict(below)
    if len(_SPELLINGS & values.keys()) == 1:
        for spelling in _SPELLINGS:
            kept.pop(spelling, None)
    return {**kept, **values}


def _check_names(table: Mapping[str, Any], where: str) -> None:
    known = sections()
    for section, values in table.items():
        if section not in known:
            raise _unknown(section, list(known), "section", where)
        if not isinstance(values, Mapping):
            raise ConfigError(f"{where}: {section} is a section, not a value")
        fields = list(known[section].model_fields)
        for name in values:
            if name not in fields:
                every = [f"{s}.{f}" for s, c in known.items() for f in c.model_fields]
                candidates = [f"{section}.{f}" for f in fields] + every
                raise _unknown(f"{section}.{name}", candidates, "setting", where)


def _parse_value(text: str) -> Any:
    """Parse a value of a flag or variable: as TOML if it is TOML, else as a plain string."""
    try:
        table = from_toml(f"value = {text}")
    except ConfigError:
        return text
    return table["value"] if len(table) == 1 else text


def _merge_text(table: dict[str, Any], dotted: str, text: str, where: str) -> None:
    section, _, name = dotted.partition(".")
    if not name:
        raise ConfigError(f"{where}: {dotted!r} is not a setting; write SECTION.FIELD")
    value = {name: _parse_value(text)}
    _check_names({section: value}, where)
    table[section] = _merged(table.get(section, {}), value)


def environment_overrides(environ: Mapping[str, str]) -> dict[str, str]:
    """The environment's settings: MRCDRL_LEARNER__SEED=6 as {"learner.seed": "6"}.

    Raises ConfigError for a variable that looks like a setting with one underscore too few.
    """
    named = {key: value for key, value in environ.items() if key.startswith(ENV_PREFIX)}
    for key in named:
        if "__" not in key and (meant := _setting_meant(key)):
            raise ConfigError(f"environment: {key} is not a setting; did you mean {meant}?")
    return {
        key.removeprefix(ENV_PREFIX).lower().replace("__", ".", 1): value
        for key, value in named.items()
        if "__" in key
    }


def variable(section: str, name: str) -> str:
    """The environment variable of a setting."""
    return f"{ENV_PREFIX}{section}__{name}".upper()


def _setting_meant(key: str) -> str | None:
    """The variable that one with single underscores resembles; None if it resembles none of them.

    Others begin with a section too: Kubernetes names the port of a service MRCDRL_REPLAY_PORT.
    """
    words = key.removeprefix(ENV_PREFIX).lower()
    for section, model in sections().items():
        if words.startswith(f"{section}_"):
            name = words.removeprefix(f"{section}_")
            for near in difflib.get_close_matches(name, model.model_fields, n=1, cutoff=0.8):
                return variable(section, near)
    return None


def resolved_environment() -> dict[str, str]:
    """This process's environment without settings: for processes whose configuration is a file
    that holds them already, and where a flag may have overridden them."""
    return {
        name: value
        for name, value in os.environ.items()
        if not (name.startswith(ENV_PREFIX) and "__" in name)
    }


def load_config(
    source: str | None = None,
    overrides: Mapping[str, str] | None = None,
    environ: Mapping[str, str] | None = None,
) -> Config:
    """Load and check the configuration.

    source: a preset's name or a TOML file; None: the defaults. overrides: "section.field" to
    text, as flags give them. environ: by default the process's environment.

    Raises ConfigError with one line that names the setting, the value and what it must be.
    """
    table = {} if source is None else _read_toml(source)
    return apply_overrides(table, overrides or {}, environ)


def origin(
    key: str,
    source: str | None = None,
    overrides: Mapping[str, str] | None = None,
    environ: Mapping[str, str] | None = None,
) -> str:
    """Where `load_config` gets the value of a setting from: a flag, a variable, a file.

    Arguments besides the setting's name, and errors, are those of `load_config`.
    """
    section, name = key.split(".")
    names = _SPELLINGS if section == "arena" and name in _SPELLINGS else {name}
    keys = {f"{section}.{spelling}" for spelling in names}
    if keys & (overrides or {}).keys():
        return "a flag"
    environment = environment_overrides(os.environ if environ is None else environ)
    for found in keys & environment.keys():
        return f"the environment, {variable(*found.split('.'))}"
    for layer, table in reversed([] if source is None else _layers(source)):
        if names & table.get(section, {}).keys():
            return source_name(layer)
    return "its default"


def source_name(source: str) -> str:
    """A preset or file, as help and messages call it."""
    return f"preset {source}" if source in preset_names() else source


def load_transport(
    overrides: Mapping[str, str],
    environ: Mapping[str, str] | None = None,
    source: str | None = None,
) -> TransportConfig:
    """Load only [transport], which a process needs before it knows the run's other settings.

    Arguments and errors are those of `load_config`.
    """
    table = _overridden({} if source is None else _read_toml(source), overrides, environ)
    with _one_line("transport"):
        return TransportConfig.model_validate(table.get("transport", {}))


def _overridden(
    table: dict[str, Any], overrides: Mapping[str, str], environ: Mapping[str, str] | None
) -> dict[str, Any]:
    """The table with settings of the environment over it, and flags over those."""
    env = environment_overrides(os.environ if environ is None else environ)
    for dotted, text in env.items():
        _merge_text(table, dotted, text, "environment")
    for dotted, text in overrides.items():
        _merge_text(table, dotted, text, "flag")
    return table


def apply_overrides(
    table: dict[str, Any], overrides: Mapping[str, str], environ: Mapping[str, str] | None = None
) -> Config:
    """The configuration of a table with settings of the environment over it, and flags over those.

    Arguments and errors are those of `load_config`.
    """
    return validate_config(_overridden(table, overrides, environ))


def validate_config(table: Mapping[str, Any]) -> Config:
    """Make a Config from its table; raises ConfigError naming the first setting that is wrong."""
    with _one_line():
        return Config.model_validate(table)


@contextmanager
def _one_line(*above: str) -> Iterator[None]:
    """Turn a ValidationError into a ConfigError that names the first setting that is wrong.

    above: the beginning of the setting's name.
    """
    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        path = (*above, *first["loc"])
        where = ".".join(map(str, path)) or "configuration"
        given = first.get("input")
        text = repr(given)
        text = f"{text[:_SHOWN]}…" if len(text) > _SHOWN else text
        shown = "" if isinstance(given, (dict, BaseModel)) else f" (given {text})"
        raise ConfigError(f"{where}: {_requirement(path, first)}{shown}") from None


def _list_form(path: Sequence[str | int], given: Any) -> str:
    """Say that a list is needed, and how this one is written: of the given text if it is one."""
    if len(path) > 2:
        return "must be a list"
    info = sections()[str(path[0])].model_fields[str(path[1])]
    if get_args(info.annotation)[0] is str and isinstance(given, str):
        items = [item.strip(" \"'") for item in given.strip("[] ").split(",")]
        form = json.dumps(items, ensure_ascii=False)
        return f"must be a list: {form}, quoted in a shell: '{form}'"
    return f"must be a list, such as {json.dumps(info.default or _example(info.annotation))}"


def _example(annotation: Any) -> Any:
    """A value of a list setting's type."""
    inner = [kind for kind in get_args(annotation) if kind is not Ellipsis]
    return [_example(kind) for kind in inner] if inner else annotation(1)


def _requirement(path: Sequence[str | int], error: Mapping[str, Any]) -> str:
    """Describe the values allowed, in our words for the common kinds of error."""
    kind = error["type"].partition("_")[0]
    if kind == "tuple":
        return _list_form(path, error.get("input"))
    if kind not in ("greater", "less"):
        message: str = error["msg"].removeprefix("Value error, ")
        return _TYPES.get(kind) or message.replace("Input should be", "must be")
    return f"must be {limits(sections()[str(path[0])].model_fields[str(path[1])])}"
