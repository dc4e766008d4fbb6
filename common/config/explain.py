"""What there is to say of one setting, for a reader and for a program."""

from collections.abc import Mapping
from typing import Any

from mrcdrl.common.config.load import load_config, origin, variable
from mrcdrl.common.config.schema import kept_settings
from mrcdrl.common.config.settings import find_setting
from mrcdrl.common.config.toml import toml_value


def explain(key: str, source: str | None, overrides: Mapping[str, str]) -> dict[str, Any]:
    """All facts of a setting, with its value in a configuration and where that comes from.

    source, overrides, errors: as of `load_config`; also ConfigError for an unknown setting.
    """
    setting = find_setting(key)
    values = load_config(source, overrides).model_dump()
    name = (setting.section, setting.name)
    always, lockstep = (name in kept_settings(lockstep=lockstep) for lockstep in (False, True))
    return {
        "setting": setting.key,
        "meaning": setting.meaning,
        "allowed": setting.allowed,
        "unit": setting.unit or None,
        "default": setting.default,
        "source": setting.source,
        "value": values[setting.section][setting.name],
        "from": origin(key, source, overrides),
        "flag": f"--{setting.key}",
        "variable": variable(setting.section, setting.name),
        "kept": "always" if always else "in lockstep" if lockstep else "no",
    }


def explained(facts: Mapping[str, Any]) -> str:
    """The facts as lines of text."""
    kept = {
        "always": "cannot change",
        "in lockstep": "cannot change with run.turn_size, and can otherwise",
        "no": "can change",
    }
    rows = {
        "meaning": facts["meaning"],
        "allowed": facts["allowed"],
        "unit": facts["unit"],
        "default": f"{toml_value(facts['default'])} ({facts['source']})",
        "in force": f"{toml_value(facts['value'])}, from {facts['from']}",
        "flag": facts["flag"],
        "variable": facts["variable"],
        "on resume": kept[facts["kept"]],
    }
    lines = [f"  {name:<10} {text}" for name, text in rows.items() if text is not None]
    return "\n".join([facts["setting"], *lines])
