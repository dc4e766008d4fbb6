"""The report's figures, each as PNG and SVG, in the paper's layout and under its number.

Invariants: each figure is made, whatever is missing; those that play episodes, from weights kept,
say by a missing file that there are no weights yet.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mrcdrl.common.messages.trajectory import Outcome
from mrcdrl.services.evaluator.trial import EpisodeResult
from mrcdrl.services.plots import reproduction
from mrcdrl.services.plots.paper import SUFFIXES, Contender, comparison
from mrcdrl.services.plots.reproduction import Group, Training
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.experiment.grid import FINAL
from mrcdrl.services.tools.figure import draw_arenas, draw_views, paths_of
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.reproduce.keeping import is_kept, kept
from mrcdrl.services.tools.reproduce.printed import KINDS, NAMES
from mrcdrl.services.tools.reproduce.protocol import TEST_SEED, TESTED_ROBOTS
from mrcdrl.services.tools.reproduce.runs import Result, Runs, overestimation
from mrcdrl.services.tools.subject import Subject, subject

FOLDER = "figures"
_FRAME = 40  # of Fig. 3
_COLUMNS = 5  # of Fig. 8
_STARTS = 12  # of which Fig. 8 shows successes
_COMPARED = 24  # starts of which Fig. 10 shows four
_SHOWN = 4


class Figures:
    """Draws the figures of some runs to a folder."""

    def __init__(self, runs: Runs, out: Path, progress: Progress) -> None:
        self._runs, self._out, self._progress = runs, out, progress
        (out / FOLDER).mkdir(parents=True, exist_ok=True)

    def draw(self) -> None:
        """Draw all of them."""
        runs = self._runs
        numbers = sorted({robots for _, robots in runs.plan.kinds})
        self._progress.stage("figures")
        configs = [runs.plan.kinds["duel", robots][0].config.arena for robots in numbers]
        draw_arenas(configs, TEST_SEED, *self._files("fig1"))
        by_weight = {p: _trainings(runs.of(cells)) for p, cells in runs.plan.weights.items()}
        reproduction.weights(by_weight, *self._files("fig5"))
        median = runs.median("duel", TESTED_ROBOTS)
        name = "Duel, 4 robots" + (f", median seed {median['seed']}" if median else "")
        run = _training(median) if median else None
        reproduction.training(run, name, *self._files("fig6"))
        panels = {robots: [self._group(kind, robots) for kind in KINDS] for robots in numbers}
        reproduction.kinds(panels, *self._files("fig7"))
        reproduction.test(self._outcomes(), *self._files("fig9"))
        excess = {
            robots: {
                NAMES[kind]: [overestimation(r) for r in runs.kind(kind, robots)] for kind in KINDS
            }
            for robots in numbers
        }
        reproduction.overestimation(excess, *self._files("overestimation"))
        self._play(numbers)

    def _play(self, numbers: Sequence[int]) -> None:
        """Draw what takes episodes: Figs. 3, 8 and 10; without weights, older ones are removed."""
        for name in ("fig3", "fig8", "fig10"):
            for file in self._files(name):
                file.unlink(missing_ok=True)
        tested = self._subject("duel", TESTED_ROBOTS)
        if tested is not None:
            report = self._progress.stage("the episode of Fig. 3")
            draw_views(tested, TEST_SEED, _FRAME, report, *self._files("fig3"))
        rows = []
        for robots in numbers:
            shown = self._subject("duel", robots)
            if shown is not None:
                report = self._progress.stage(f"episodes of {robots} robots", _STARTS)
                episodes = shown.episodes(_STARTS, TEST_SEED, report)
                won = [e for e in episodes if e.outcome is Outcome.SUCCESS] or episodes
                rows.append(Contender(f"{robots} robots", paths_of(won[:_COLUMNS])))
        if rows and tested is not None:
            comparison(rows, tested.config.arena, *self._files("fig8"))
        subjects = {kind: self._subject(kind, TESTED_ROBOTS) for kind in KINDS}
        played = {
            kind: shown.episodes(
                _COMPARED, TEST_SEED, self._progress.stage(f"episodes of {NAMES[kind]}", _COMPARED)
            )
            for kind, shown in subjects.items()
            if shown is not None
        }
        if played and tested is not None:
            chosen = columns(list(played.values()))
            contenders = [
                Contender(NAMES[kind], paths_of([episodes[column] for column in chosen]))
                for kind, episodes in played.items()
            ]
            comparison(contenders, tested.config.arena, *self._files("fig10"))

    def _files(self, name: str) -> list[Path]:
        return [self._out / FOLDER / f"{name}{suffix}" for suffix in SUFFIXES]

    def _subject(self, kind: str, robots: int) -> Subject | None:
        """The weights kept of the median seed; None if they are not there."""
        median, folder = self._runs.median(kind, robots), kept(self._out, kind, robots)
        if median is None or not is_kept(folder, median):
            return None
        return subject(flags.evaluate().parse_args([str(folder)]))

    def _group(self, kind: str, robots: int) -> Group:
        """The runs of a kind, the median one first."""
        median = self._runs.median(kind, robots)
        others = [r for r in self._runs.kind(kind, robots) if r is not median]
        return Group(NAMES[kind], _trainings([*([median] if median else []), *others]))

    def _outcomes(self) -> dict[str, list[bool]]:
        """Whether each start of the test succeeded, for the median seed of each kind."""
        medians = {kind: self._runs.median(kind, TESTED_ROBOTS) for kind in KINDS}
        return {
            NAMES[kind]: [letter == "s" for letter in run["evaluate"][FINAL]["outcomes"]]
            for kind, run in medians.items()
            if run is not None
        }


def columns(played: Sequence[Sequence[EpisodeResult]]) -> list[int]:
    """The starts that Fig. 10 shows: the first two at which the kinds' outcomes differ, then the
    first ones of the rest."""
    won = np.array([[e.outcome is Outcome.SUCCESS for e in episodes] for episodes in played])
    differ = np.flatnonzero(won.any(axis=0) & ~won.all(axis=0))[:2].tolist()
    others = [start for start in range(won.shape[1]) if start not in differ]
    return sorted([*differ, *others[: _SHOWN - len(differ)]])


def _training(result: Result) -> Training:
    told = result["training"]
    names = ("successes", "score", "mean_q")
    return Training(*(np.array(told[name], np.float64) for name in names))


def _trainings(results: Sequence[Result]) -> list[Training]:
    return [_training(result) for result in results]
