"""The protocol as data: which runs stand for which table and figure, at each scale.

docs/reproduction.md says it in words. Invariants: all that a scale trains differs only in what is
compared; budgets, seeds and rates stand here and nowhere else.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mrcdrl.common.config import load_config
from mrcdrl.services.tools.experiment.grid import BEST, FINAL, Cell, grid_cells
from mrcdrl.services.tools.reproduce.printed import BEST_WEIGHT, KINDS

TEST_SEED = 0  # of the starts of all tests; a run's own evaluator has another
WEIGHTS = (0.1, 0.3, 0.5, BEST_WEIGHT, 0.9)  # p of Fig. 5
FIG5_ROBOTS = 2
TESTED_ROBOTS = 4  # of Table 2
RATE_FACTORS = (0.5, 1.0, 2.0)  # of the sweep, times the base's learning rate
SWEEP_ROBOTS = 2
# The test and the weights are the paper's, whatever the base has.
AS_PRINTED = {
    "agent.symmetric_views": 1,
    "learner.average_decay": 0.0,
    "learner.average_for": "all",
}
RATES = dict.fromkeys(KINDS, 1.0)
"""Factor of each kind's learning rate in all runs but the sweep's; set by the sweep's rule."""


@dataclass(frozen=True, slots=True)
class Scale:
    """How much is trained for the tables and figures."""

    name: str
    text: str  # what it is, for the report
    base: str  # preset
    budget: Mapping[int, int]  # learner steps by number of robots: those of Tables 1 and 2
    seeds: Mapping[int, Sequence[int]]  # by number of robots
    settings: Mapping[str, Any] = field(default_factory=dict)  # of every run, over AS_PRINTED
    rate_fits: bool = False  # the learning rate falls over each budget as over that of 4 robots
    weights: Sequence[float] = ()  # p of Fig. 5 beside that of all other runs
    fig5_seeds: Sequence[int] = ()
    sweep_seeds: Sequence[int] = ()
    factors: Sequence[float] = RATE_FACTORS
    episodes: int = 1100  # of each test


_OTHER_WEIGHTS = tuple(p for p in WEIGHTS if p != BEST_WEIGHT)
_CPU_BUDGET = {2: 10_000, 3: 20_000, 4: 30_000}  # of `quick`: batches of 128
_EIGHTH = 8  # part of the paper's 800 000 steps
_PAPER = {
    "arena.renderer": "analytic",  # what the literal one shows, several times as fast
    "evaluator.episodes": 100,  # it only chooses the best weights; the test has its own starts
}

SCALES = {
    scale.name: scale
    for scale in (
        Scale(
            name="cpu",
            text="the preset `quick`: the paper's arena, network and agent, our learner settings",
            base="quick",
            rate_fits=True,
            budget=_CPU_BUDGET,
            seeds=dict.fromkeys(_CPU_BUDGET, range(5)),
            weights=_OTHER_WEIGHTS,
            fig5_seeds=range(3),
            sweep_seeds=(100, 101),
        ),
        Scale(
            name="gpu",
            text="as `cpu`, with ten seeds for the test with 4 robots",
            base="quick",
            rate_fits=True,
            budget=_CPU_BUDGET,
            seeds={2: range(5), 3: range(5), 4: range(10)},
            weights=_OTHER_WEIGHTS,
            fig5_seeds=range(3),
            sweep_seeds=(100, 101),
        ),
        Scale(
            name="compressed",
            text="the preset `paper` with an eighth of its steps, all schedules compressed alike, "
            "and the analytic renderer",
            base="paper",
            budget={4: 800_000 // _EIGHTH},
            seeds={4: range(3)},
            settings={
                **_PAPER,
                "exploration.schedule": [[0, 1.0], [800_000 // _EIGHTH, 0.1]],
                "replay.capacity": 400_000 // _EIGHTH,
                "replay.min_size": 50_000 // _EIGHTH,
                "agent.target_period": 2_500 // _EIGHTH,
            },
        ),
        Scale(
            name="paper",
            text="the preset `paper` with the analytic renderer, until its exploration has come to "
            "0.1; needs a GPU",
            base="paper",
            budget=dict.fromkeys((2, 3, 4), 800_000),
            seeds=dict.fromkeys((2, 3, 4), range(3)),
            settings=_PAPER,
        ),
    )
}
SMOKE = Scale(
    name="smoke",
    text="a few learner steps: do the parts work? Its numbers mean nothing",
    base="smoke",
    budget={2: 30, 4: 30},
    seeds={2: (0,), 4: (0,)},
    settings={"arena.view_px": 32, "arena.max_frames": 40, "learner.precision": "float32"},
    weights=(0.1,),
    fig5_seeds=(0,),
    sweep_seeds=(0,),
    factors=(1.0,),
    episodes=6,
)

PARTS = ("table1", "table2", "fig5", "fig6", "fig7", "fig9", "sweep")


@dataclass(frozen=True, slots=True)
class Plan:
    """The runs of a scale."""

    scale: Scale
    kinds: Mapping[tuple[str, int], Sequence[Cell]]  # by kind and number of robots; a cell a seed
    weights: Mapping[float, Sequence[Cell]]  # by p
    sweep: Mapping[tuple[str, float], Sequence[Cell]]  # by kind and factor of the learning rate

    def part(self, name: str) -> list[Cell]:
        """The runs that a part needs, those of Table 2 first; `all` has every run once."""
        return list({cell.name: cell for cell in self._parts(name)}.values())

    def _parts(self, name: str) -> Iterator[Cell]:
        for (kind, robots), cells in sorted(self.kinds.items(), key=lambda item: -item[0][1]):
            tested = robots == TESTED_ROBOTS
            if (
                name in ("all", "table1", "fig7")
                or (name in ("table2", "fig9") and tested)
                or (name == "fig6" and tested and kind == "duel")
            ):
                yield from cells
        for group in self.weights.values() if name in ("all", "fig5") else ():
            yield from group
        for group in self.sweep.values() if name in ("all", "sweep") else ():
            yield from group


def plan(scale: Scale) -> Plan:
    """Make the runs of a scale."""
    rate = load_config(scale.base, environ={}).agent.learning_rate

    def cells(
        variant: str, kind: str, robots: int, seeds: Sequence[int], factor: float, **settings: Any
    ) -> list[Cell]:
        chosen = {**AS_PRINTED, **scale.settings, "agent.kind": kind, **settings}
        if factor != 1.0:
            chosen["agent.learning_rate"] = factor * rate
        return _cells(scale, variant, robots, seeds, chosen)

    kinds = {
        (kind, robots): cells(kind, kind, robots, seeds, RATES[kind])
        for robots, seeds in scale.seeds.items()
        for kind in KINDS
    }
    weights = {
        p: cells(
            f"dqn-p{100 * p:.0f}", "dqn", FIG5_ROBOTS, scale.fig5_seeds, RATES["dqn"],
            **{"arena.proximity_weight": p},
        )
        for p in scale.weights
    }  # fmt: skip
    if weights:
        shared = [c for c in kinds["dqn", FIG5_ROBOTS] if c.seed in scale.fig5_seeds]
        weights = dict(sorted({**weights, BEST_WEIGHT: shared}.items()))
    sweep = {
        (kind, factor): cells(
            kind if factor == RATES[kind] else f"{kind}-rate{100 * factor:.0f}",
            kind, SWEEP_ROBOTS, scale.sweep_seeds, factor,
        )
        for kind, factor in itertools.product(KINDS, scale.factors)
        if scale.sweep_seeds
    }  # fmt: skip
    return Plan(scale, kinds, weights, sweep)


def _falling(budget: int) -> list[list[float]]:
    """Factors of the learning rate: 1, and from two fifths of the budget on down to a tenth."""
    return [[0, 1.0], [2 * budget // 5, 1.0], [budget, 0.1]]


def _cells(
    scale: Scale, variant: str, robots: int, seeds: Sequence[int], settings: Mapping[str, Any]
) -> list[Cell]:
    sections: dict[str, dict[str, Any]] = {}
    if scale.rate_fits:
        settings = {**settings, "agent.learning_rate_schedule": _falling(scale.budget[robots])}
    for key, value in settings.items():
        section, name = key.split(".")
        sections.setdefault(section, {})[name] = value
    return grid_cells(
        {
            "base": scale.base,
            "robots": [robots],
            "seeds": list(seeds),
            "budget": {"learner_steps": scale.budget[robots]},
            "evaluate": {
                "episodes": scale.episodes,
                "seed": TEST_SEED,
                "weights": [FINAL, BEST],
                "values": True,
            },
            "variants": {variant: sections},
        }
    )
