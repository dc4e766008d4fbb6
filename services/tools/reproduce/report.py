"""The report on a reproduction, `report.md` and `report.html`, for a reader of the paper alone.

Invariants: it is made from results, whatever is missing, and says what that is; every number stands
beside the number of seeds behind it.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.runtime.files import atomic_write
from mrcdrl.services.tools.experiment.cell import CellFiles
from mrcdrl.services.tools.reproduce import prose, tables
from mrcdrl.services.tools.reproduce.claims import Claim, judge
from mrcdrl.services.tools.reproduce.drawing import FOLDER
from mrcdrl.services.tools.reproduce.page import page
from mrcdrl.services.tools.reproduce.protocol import SMOKE, Scale
from mrcdrl.services.tools.reproduce.runs import Result, Runs, success
from mrcdrl.services.tools.reproduce.statistics import Verdict

_COMPARED = ("arena", "agent", "exploration", "replay", "learner")  # sections that matter

_FIGURES = {
    "fig1": "Fig. 1: arenas at a start of the test.",
    "fig3": "Fig. 3: how a robot's image is made, and what all robots see: four images each.",
    "fig5": "Fig. 5: successes in training for each weight p, DQN with 2 robots; a line and a dot "
    "are a seed, bars are means.",
    "fig6": "Fig. 6: training of Duel with 4 robots, the seed whose final weights have the median "
    "success.",
    "fig7": "Fig. 7: action values, scores and successes in training. Thick: the median seed; "
    "thin: all others.",
    "overestimation": "What Fig. 7 a–c cannot show: values of first states minus the discounted "
    "returns that followed. A dot is a seed, bars are means.",
    "fig8": "Fig. 8: episodes of Duel in the test that succeeded, the first ones in the order of "
    "the starts.",
    "fig9": "Fig. 9: successes of the test with 4 robots, the median seed of each kind. Dark: each "
    "hundred starts; light: any hundred in a row.",
    "fig10": "Fig. 10: the kinds from the same starts, the first two at which their outcomes "
    "differ, and the first two of the rest. Each panel's title is its outcome.",
}


def write_report(runs: Runs, files: Sequence[CellFiles], out: Path) -> list[Claim]:
    """Write report.md and report.html; return the claims with their verdicts."""
    claims = judge(runs)
    text = "\n".join(_sections(runs, claims, files, out))
    atomic_write(out / "report.md", text.encode())
    atomic_write(out / "report.html", page(text, out).encode())
    return claims


def _sections(
    runs: Runs, claims: Sequence[Claim], files: Sequence[CellFiles], out: Path
) -> Iterator[str]:
    scale = runs.plan.scale
    yield "# MRCDRL, reproduced: what became of each claim\n"
    yield _summary(runs, claims, len(files))
    yield "## Each claim\n"
    yield tables.claims_table(claims)
    yield prose.HOW_TO_READ
    yield _missing(runs, files)
    yield "## Scope\n"
    yield prose.SCOPE
    yield "## Methodology\n"
    yield prose.METHODOLOGY
    yield f"Scale `{scale.name}`: {scale.text}.\n"
    yield _budget(scale)
    yield "### Settings that differ from the paper's\n"
    yield _deviations(runs)
    yield "### Machines and time\n"
    yield _compute(runs)
    yield "## Results\n"
    yield from _results(runs, out)
    yield "## What the paper cannot tell\n"
    yield prose.CANNOT_TELL
    yield "## What was easy, what was difficult\n"
    yield prose.EASY_DIFFICULT
    yield "## Every run\n"
    yield _every_run(runs, files)


def _summary(runs: Runs, claims: Sequence[Claim], num: int) -> str:
    """The answer in a few lines."""
    counts = Counter(claim.verdict for claim in claims)
    told = ", ".join(f"{counts[verdict]} {verdict}" for verdict in Verdict if counts[verdict])
    lines = [
        "The paper: D. Wang, H. Deng, Z. Pan, *MRCDRL: Multi-robot coordination with deep "
        "reinforcement learning*, Neurocomputing 406 (2020). It trains robots that share a network "
        "by DQN, DDQN and Duel, and says that Duel is best.\n",
        "**Is it?** In the test with 4 robots, of final weights, over seeds:\n",
        *(f"- {claim.text}: **{claim.answer}**. {claim.ours}." for claim in claims[:4]),
        f"\nOf all {len(claims)} claims: {told}. {len(runs.results)} of {num} runs are done.\n",
    ]
    if runs.plan.scale is SMOKE:
        lines.insert(0, "**A smoke test: a few learner steps each. Its numbers mean nothing.**\n")
    return "\n".join(lines)


def _missing(runs: Runs, files: Sequence[CellFiles]) -> str:
    """Runs without a result, by name and state; empty if there is none."""
    missing = [each for each in files if each.cell.name not in runs.results]
    if not missing:
        return ""
    lines = [f"## Missing: {len(missing)} runs\n"]
    for each in missing:
        failure = f", {each.failure}" if each.failure else ""
        lines.append(f"- `{each.cell.name}`: {each.state}{failure}")
    lines.append("\nA cell of a table counts those that are there: n.\n")
    return "\n".join(lines)


def _budget(scale: Scale) -> str:
    rows = [
        (str(robots), f"{steps:_}".replace("_", " "), ", ".join(map(str, scale.seeds[robots])))
        for robots, steps in scale.budget.items()
    ]
    return tables.markdown(("robots", "learner steps, every kind", "seeds"), rows)


def _deviations(runs: Runs) -> str:
    """Settings of the Duel runs that differ from the preset `paper`'s."""
    robots = max(robots for _, robots in runs.plan.kinds)
    used = runs.plan.kinds["duel", robots][0].config
    rows = list(_differences(load_config("paper", environ={}), used))
    text = (
        "The preset `paper` keeps to the paper wherever it speaks; where it is silent, "
        "docs/paper.md lists what was chosen and why. These runs differ from that preset in:\n\n"
    )
    return text + tables.markdown(("setting", "preset `paper`", "here"), rows)


def _differences(paper: Config, used: Config) -> Iterator[tuple[str, str, str]]:
    here: dict[str, Any] = used.model_dump(mode="json")
    there: dict[str, Any] = paper.model_dump(mode="json")
    for section in _COMPARED:
        for name, value in here[section].items():
            key = f"{section}.{name}"
            if value != there[section][name] and name not in ("seed", "num_robots", "kind"):
                yield f"`{key}`", f"`{there[section][name]}`", f"`{value}`"


def _compute(runs: Runs) -> str:
    """Machines, and time that training took."""
    if not runs.results:
        return "No runs yet.\n"
    results = runs.results.values()
    machines = Counter(
        f"{r['machine'].get('cpu')}, {r['machine'].get('cores')} cores" for r in results
    )
    hours = sum(r["wall_s"] for r in results) / 3600
    steps = sum(r["learner_steps"] for r in results)
    versions = next(iter(results))["versions"]
    lines = [f"- {name}: {count} runs" for name, count in machines.items()]
    lines.append(
        f"- Training took {hours:.1f} hours and {steps:_} learner steps in all; runs that shared "
        "a machine are counted each.".replace("_", " ")
    )
    lines.append("- " + ", ".join(f"{name} {version}" for name, version in versions.items()))
    return "\n".join(lines) + "\n"


def _results(runs: Runs, out: Path) -> Iterator[str]:
    yield "### Table 2: the test with 4 robots\n"
    yield prose.CELLS
    yield tables.table2(runs)
    yield _rerun(runs, "table2")
    yield tables.comparisons(runs)
    yield _figure(out, "fig9")
    yield _figure(out, "fig10")
    yield "### Table 1: training\n"
    yield tables.table1(runs)
    yield _rerun(runs, "table1")
    yield _figure(out, "fig6")
    yield _figure(out, "fig7")
    yield "### Overestimation\n"
    yield prose.OVERESTIMATION
    yield tables.values_table(runs)
    yield _figure(out, "overestimation")
    if runs.plan.weights:
        yield "### Fig. 5: the weight p\n"
        yield tables.weights_table(runs)
        yield _rerun(runs, "fig5")
        yield _figure(out, "fig5")
    if runs.plan.sweep:
        yield "### The learning rate, on other seeds\n"
        yield prose.SWEEP
        yield tables.sweep_table(runs)
        yield _rerun(runs, "sweep")
    yield "### The arena, what robots see, and what they do\n"
    for name in ("fig1", "fig3", "fig8"):
        yield _figure(out, name)


def _rerun(runs: Runs, part: str) -> str:
    name = runs.plan.scale.name
    scale = "--smoke" if runs.plan.scale is SMOKE else f"--scale {name}"
    return f"Rerun: `mrcdrl reproduce {part} {scale} --out again`\n"


def _figure(out: Path, name: str) -> str:
    path = f"{FOLDER}/{name}.png"
    if not (out / path).exists():
        return f"*{_FIGURES[name]} Missing: no weights are kept yet.*\n"
    return f"![{_FIGURES[name]}]({path})\n\n*{_FIGURES[name]}*\n"


def _every_run(runs: Runs, files: Sequence[CellFiles]) -> str:
    """Each cell with its result and the command that runs it."""
    scale = "--smoke" if runs.plan.scale is SMOKE else f"--scale {runs.plan.scale.name}"
    rows = []
    for each in files:
        name = each.cell.name
        result: Result | None = runs.results.get(name)
        told = ("–", "–", "–")
        if result is not None:
            told = (
                f"{success(result):.2f}",
                f"{result['learner_steps']}",
                f"{result['wall_s'] / 60:.0f}",
            )
        rows.append((f"`mrcdrl reproduce {scale} --out again --only {name}`", *told))
    head = ("command that runs it", "test, %", "learner steps", "minutes")
    return tables.markdown(head, rows)
