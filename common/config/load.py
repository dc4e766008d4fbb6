"""Where a configuration comes from: a preset or a file, the environment, and flags.

Precedence: a flag beats an environment variable, which beats the file, which beats the default.
Invariant: an unknown name is refused with the nearest known one.
"""

import difflib
import os
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from mrcdrl.common.config.schema import Config, TransportConfig, sections
from mrcdrl.common.errors import ConfigError

ENV_PREFIX = "MRCDRL_"
EXTENDS = "extends"


def preset_names() -> list[str]:
    """Names that `--config` takes besides a path."""
    files = resources.files("mrcdrl.configs").iterdir()
    return sorted(f.name.removesuffix(".toml") for f in files if f.name.endswith(".toml"))


def _unknown(name: str, known: Sequence[str], what: str, where: str) -> ConfigError:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"; did you mean {near[0]}?" if near else f"; known: {', '.join(known)}"
    return ConfigError(f"{where}: unknown {what} {name!r}{hint}")


def _read_toml(source: str, above: tuple[str, ...] = ()) -> dict[str, Any]:
    """The table of a preset or file, with what it extends merged below it.

    above: the files that extend this one.
    """
    path = Path(source)
    if source in preset_names():
        text = (resources.files("mrcdrl.configs") / f"{source}.toml").read_text("utf-8")
    else:
        try:
            text = path.read_text("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            presets = ", ".join(preset_names())
            reason = getattr(error, "strerror", None) or str(error)
            raise ConfigError(
                f"config {source!r}: {reason}; give a file or a preset: {presets}"
            ) from error
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"config {source!r} is not TOML: {error}") from error
    base = table.pop(EXTENDS, None)
    _check_names(table, f"config {source!r}")
    if base is None:
        return table
    if base not in preset_names():
        base = str(path.parent / str(base))
    if base in (*above, source):
        raise ConfigError(f"config {source!r} extends itself, by {', '.join((*above, source))}")
    below = _read_toml(base, (*above, source))
    return below | {name: {**below.get(name, {}), **values} for name, values in table.items()}


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
    """A value from a flag or the environment: TOML if it is, else the plain string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _merge_text(table: dict[str, Any], dotted: str, text: str, where: str) -> None:
    section, _, name = dotted.partition(".")
    value = {section: {name: _parse_value(text)}} if name else {section: {}}
    if not name:
        raise ConfigError(f"{where}: {dotted!r} is no setting; write SECTION.FIELD")
    _check_names(value, where)
    table[section] = {**table.get(section, {}), **value[section]}


def environment_overrides(environ: Mapping[str, str]) -> dict[str, str]:
    """`MRCDRL_LEARNER__BATCH_SIZE=64` as {"learner.batch_size": "64"}."""
    return {
        key.removeprefix(ENV_PREFIX).lower().replace("__", ".", 1): value
        for key, value in environ.items()
        if key.startswith(ENV_PREFIX) and "__" in key
    }


def load_config(
    source: str | None = None,
    overrides: Mapping[str, str] | None = None,
    environ: Mapping[str, str] | None = None,
) -> Config:
    """The resolved configuration.

    source: a preset's name or a TOML file; None: the defaults. overrides: "section.field" to
    text, as flags give them. environ: the process's environment unless given.

    Raises ConfigError, one line, naming the setting, what is wrong and what is right.
    """
    table = {} if source is None else _read_toml(source)
    return apply_overrides(table, overrides or {}, environ)


def load_transport(
    overrides: Mapping[str, str], environ: Mapping[str, str] | None = None
) -> TransportConfig:
    """How to reach a run whose other settings are not known yet; arguments as of load_config.

    Raises ConfigError as load_config.
    """
    table = _overridden({}, overrides, environ)
    with _one_line("transport"):
        return TransportConfig.model_validate(table.get("transport", {}))


def _overridden(
    table: dict[str, Any], overrides: Mapping[str, str], environ: Mapping[str, str] | None
) -> dict[str, Any]:
    """The table with the environment's settings, and the flags' above them."""
    env = environment_overrides(os.environ if environ is None else environ)
    for dotted, text in env.items():
        _merge_text(table, dotted, text, "environment")
    for dotted, text in overrides.items():
        _merge_text(table, dotted, text, "flag")
    return table


def apply_overrides(
    table: dict[str, Any], overrides: Mapping[str, str], environ: Mapping[str, str] | None = None
) -> Config:
    """The configuration of a table, under the environment's settings and the flags'.

    Arguments and errors as of load_config.
    """
    return validate_config(_overridden(table, overrides, environ))


def validate_config(table: Mapping[str, Any]) -> Config:
    """A Config from its table; raises ConfigError naming the first setting that is wrong."""
    with _one_line():
        return Config.model_validate(table)


@contextmanager
def _one_line(*above: str) -> Iterator[None]:
    """A ValidationError as a ConfigError that names the first setting that is wrong.

    above: what its name begins with.
    """
    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, (*above, *first["loc"]))) or "configuration"
        message = first["msg"].removeprefix("Value error, ")
        given = first.get("input")
        shown = "" if isinstance(given, (dict, BaseModel)) else f" (given {given!r})"
        raise ConfigError(f"{where}: {message}{shown}") from None
