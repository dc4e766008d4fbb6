"""Reading TOML from anyone, and writing a configuration as TOML."""

import json
import tomllib
from typing import Any

from mrcdrl.common.config.schema import Config
from mrcdrl.common.errors import ConfigError


def from_toml(text: str) -> dict[str, Any]:
    """The table that a TOML text holds; raises ConfigError, with the reason, if it holds none."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also of numbers too long, and too many brackets
        raise ConfigError(f"not TOML: {error}") from error


def to_toml(config: Config) -> str:
    """TOML text that reads back to the same configuration."""
    lines: list[str] = []
    for section, values in config.model_dump().items():
        lines.append(f"[{section}]")
        lines += [f"{name} = {toml_value(value)}" for name, value in values.items()]
        lines.append("")
    return "\n".join(lines)


def toml_value(value: Any) -> str:
    """TOML text of one value."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    return repr(value)
