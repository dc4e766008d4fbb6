"""A grid of runs, from TOML: variants of a base configuration × numbers of robots × seeds.

Invariants: a cell's name depends on what its run learns by and is judged by, and on nothing else:
neither on the environment nor on the commit. All cells are checked before the first one begins.
"""

import itertools
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mrcdrl.common.config import Config, from_toml, load_config, preset_names
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime.files import sha256
from mrcdrl.common.runtime.names import check_name

PROTOCOL = 2
"""Version of how the software learns and judges, raised by hand when either changes: the cells of
all grids are then new ones. A refactoring leaves it alone, and with it the results."""

FINAL, BEST = "final", "best"  # weights: of the last checkpoint; kept by the run's evaluator
_ENDS = ("learner_steps", "minutes", "target_success_rate", "patience_episodes")
_SEEDED = ("run.seed", "learner.seed", "replay.seed")  # not the evaluator's: all have one test
_KEYS = {"base": str, "robots": list, "seeds": list, "budget": dict, "evaluate": dict}
_EVALUATE = {"episodes": int, "seed": int, "weights": list, "values": bool}
_KINDS = {
    str: "text",
    list: "a list",
    dict: "a table",
    int: "a whole number",
    bool: "true or false",
}


@dataclass(frozen=True, slots=True)
class Trial:
    """The evaluations that follow a cell's training, each of the paper's test."""

    episodes: int = 1100
    seed: int = 0  # of the starts; unlike the run's own evaluator.seed
    weights: tuple[str, ...] = ()  # FINAL, BEST
    values: bool = False  # of FINAL: also compare action values with returns


@dataclass(frozen=True, slots=True)
class Cell:
    """One run of a grid."""

    variant: str
    robots: int
    seed: int
    settings: Mapping[str, Any]  # of the variant, by "section.field"
    config: Config
    trial: Trial

    @property
    def digest(self) -> str:
        """Hash of the protocol and of each setting that is not at its default.

        A setting that is new, and by default changes nothing, leaves the hash as it was.
        """
        values = self.config.model_dump(
            mode="json", exclude_defaults=True, exclude={"transport": True}
        )
        text = json.dumps([PROTOCOL, values], sort_keys=True, separators=(",", ":"))
        return sha256(text.encode())

    @property
    def name(self) -> str:
        return f"{self.variant}-{self.robots}robots-seed{self.seed}-{self.digest[:8]}"


def read_grid(path: Path) -> list[Cell]:
    """Read the cells of a grid, in the order of the file.

    Raises ConfigError with one line for anything that is wrong.
    """
    try:
        table = from_toml(path.read_text("utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"grid {str(path)!r}: {error.strerror}; give a TOML file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"grid {str(path)!r} is not TOML: {error}") from error
    except ConfigError as error:
        raise ConfigError(f"grid {str(path)!r} is {error}") from error
    try:
        return grid_cells(table, path.parent)
    except ConfigError as error:
        raise ConfigError(f"grid {str(path)!r}: {error}") from error


def grid_cells(table: Mapping[str, Any], folder: Path = Path()) -> list[Cell]:
    """Cells of a grid that is given as a table, as its TOML file would hold it.

    folder: of the base, if that is a file. Raises ConfigError with one line for what is wrong.
    """
    return list(_cells(dict(table), folder))


def _cells(table: dict[str, Any], folder: Path) -> Iterator[Cell]:
    variants = table.pop("variants", None)
    if not isinstance(variants, dict) or not variants:
        raise ConfigError("it has no variants; write [variants.NAME], with settings below it")
    _check_types(table, _KEYS, "")
    base = _base(table, folder)
    seeds = _naturals(table, "seeds")
    budget, trial = _budget(table), _trial(table)
    robots = _naturals(table, "robots") if "robots" in table else [None]
    for (variant, settings), number, seed in itertools.product(variants.items(), robots, seeds):
        where = f"variant {check_name(variant, 'variant')!r}"
        chosen = _flat(settings, where)
        fixed = {**budget, **dict.fromkeys(_SEEDED, seed)}
        if number is not None:
            fixed["arena.num_robots"] = number
        also = {"arena.robots"} if number is not None else set()
        for name in chosen.keys() & (fixed.keys() | also):
            raise ConfigError(f"{where} sets {name}, which robots, seeds and [budget] set for all")
        try:
            texts = {name: json.dumps(value) for name, value in {**chosen, **fixed}.items()}
            config = load_config(base, texts, environ={})
        except ConfigError as error:
            raise ConfigError(f"{where}: {str(error).removeprefix('flag: ')}") from error
        if trial.weights and trial.seed == config.evaluator.seed:
            raise ConfigError(
                f"evaluate.seed {trial.seed} is evaluator.seed, by whose starts the best weights "
                "were chosen; give another"
            )
        cell = Cell(variant, config.arena.num_robots, seed, chosen, config, trial)
        check_name(cell.name, "the name of a cell,")
        yield cell


def _check_types(table: Mapping[str, Any], known: Mapping[str, type], above: str) -> None:
    for name, value in table.items():
        if name not in known:
            raise ConfigError(f"unknown key {above + name!r}; known: {', '.join(known)}")
        if type(value) is not known[name]:
            raise ConfigError(f"{above}{name} must be {_KINDS[known[name]]} (given {value!r})")


def _base(table: Mapping[str, Any], folder: Path) -> str:
    base: str = table.get("base", "")
    if not base:
        raise ConfigError(f"it has no base: name a file or a preset: {', '.join(preset_names())}")
    return base if base in preset_names() else str(folder / base)


def _naturals(table: Mapping[str, Any], name: str) -> list[Any]:
    values: list[Any] = table.get(name, [])
    if not values or len(set(map(repr, values))) < len(values):
        raise ConfigError(f"{name} must be a list of different numbers, at least one")
    if any(type(value) is not int or value < 0 for value in values):
        raise ConfigError(f"{name} must be whole numbers, not below 0 (given {values})")
    return values


def _budget(table: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of [run] that end a cell; what the grid does not name never ends one."""
    given = table.get("budget", {})
    for name in given:
        if name not in _ENDS:
            raise ConfigError(f"unknown key 'budget.{name}'; known: {', '.join(_ENDS)}")
    if not (given.get("learner_steps") or given.get("minutes")):
        raise ConfigError("[budget] needs learner_steps or minutes: a cell would never end")
    return {f"run.{name}": given.get(name, 0) for name in _ENDS}


def _trial(table: Mapping[str, Any]) -> Trial:
    if "evaluate" not in table:
        return Trial()
    given = {"weights": [FINAL, BEST], **table["evaluate"]}
    _check_types(given, _EVALUATE, "evaluate.")
    if not set(given["weights"]) <= {FINAL, BEST}:
        raise ConfigError(f"evaluate.weights holds {FINAL!r} or {BEST!r} (not {given['weights']})")
    trial = Trial(**{**given, "weights": tuple(given["weights"])})
    if trial.values and FINAL not in trial.weights:
        raise ConfigError(f"evaluate.values needs {FINAL!r} in evaluate.weights")
    if trial.episodes < 1 or trial.seed < 0:
        raise ConfigError("evaluate.episodes must be at least 1, and evaluate.seed not below 0")
    return trial


def _flat(settings: Any, where: str) -> dict[str, Any]:
    """Settings by "section.field", from tables of sections."""
    if not isinstance(settings, dict) or not all(isinstance(s, dict) for s in settings.values()):
        raise ConfigError(f"{where}: write SECTION.FIELD = VALUE")
    return {f"{s}.{name}": value for s, table in settings.items() for name, value in table.items()}
