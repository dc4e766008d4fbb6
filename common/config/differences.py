"""How a configuration differs from another, and from the presets."""

from functools import cache
from typing import Any

from mrcdrl.common.config.load import load_config, preset_names
from mrcdrl.common.config.schema import Config

Differences = dict[str, tuple[Any, Any]]  # "section.field": its value there and here
_OF_EVERY_RUN = ("run.", "transport.", "arena.num_robots")  # no preset is meant by these


def differences(there: Config, here: Config) -> Differences:
    """The settings that differ between two configurations, in the order of the file."""
    old, new = there.model_dump(), here.model_dump()
    return {
        f"{section}.{name}": (old[section][name], value)
        for section, values in new.items()
        for name, value in values.items()
        if old[section][name] != value
    }


def nearest_preset(config: Config) -> tuple[str, int]:
    """The preset from which the fewest settings differ, and their number.

    The number of robots, seeds, limits and connections do not count.
    """
    counts = {
        name: sum(
            not (key.startswith(_OF_EVERY_RUN) or key.endswith(".seed"))
            for key in differences(_preset(name), config)
        )
        for name in preset_names()
    }
    name = min(counts, key=lambda name: counts[name])
    return name, counts[name]


@cache
def _preset(name: str) -> Config:
    return load_config(name, environ={})
