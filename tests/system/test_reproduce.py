"""`mrcdrl reproduce all --smoke`, killed in its middle and called again, and what it leaves."""

import json
import os
import re
import signal
from pathlib import Path

import pytest
from PIL import Image

from mrcdrl.common.model.saved_policy import load_policy
from mrcdrl.services.tools.reproduce.printed import KINDS
from mrcdrl.services.tools.reproduce.protocol import SMOKE, plan
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    Command,
    end_all,
    processes_of,
    run_name,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(12 * PATIENCE_S)]

NAMES = [cell.name for cell in plan(SMOKE).part("all")]
FIGURES = ("fig1", "fig3", "fig5", "fig6", "fig7", "fig8", "fig9", "fig10", "overestimation")


def test_a_killed_reproduction_goes_on_and_reports(tmp_path: Path) -> None:
    out = tmp_path / run_name("reproduction")
    command = ["reproduce", "all", "--smoke", "--jobs", "2", "--out", out]

    def done() -> dict[str, bytes]:
        return {path.stem: path.read_bytes() for path in out.glob("cells/*.done")}

    def begun() -> set[str]:
        return {path.stem for path in out.glob("cells/*.toml")} - done().keys()

    try:
        with Command(command, tmp_path) as first:
            eventually(
                lambda: done() and begun(), "a run is done, another one has begun", 3 * PATIENCE_S
            )
            first.signal(signal.SIGKILL)
            first.wait()
            for pid in processes_of(str(out)):
                os.kill(pid, signal.SIGKILL)
        eventually(lambda: not processes_of(str(out)), "all have ended")
        before = done()
        with Command(["reproduce", "report", "--smoke", "--out", out], tmp_path) as partial:
            assert partial.wait(2 * PATIENCE_S) == 0, partial.err
        report = (out / "report.md").read_text("utf-8")
        missing = [name for name in NAMES if name not in before]
        assert f"## Missing: {len(missing)} runs" in report
        assert re.findall(r"^- `(\S+)`: (?:missing|stopped)$", report, re.M) == missing
        with Command(command, tmp_path) as second:
            assert second.wait(5 * PATIENCE_S) == 0, second.err
    finally:
        end_all(str(out))
    assert {name: done()[name] for name in before} == before, "a done run was made again"
    lines = (out / "results.jsonl").read_text("utf-8").splitlines()
    assert [json.loads(line)["cell"] for line in lines] == NAMES
    assert "inconclusive" in second.out
    check_report(out)
    check_weights(out, tmp_path)


def check_report(out: Path) -> None:
    """Every figure is there twice, and the page of HTML holds all of them."""
    for name in FIGURES:
        with Image.open(out / "figures" / f"{name}.png") as image:
            assert image.width > 300
        assert "<svg" in (out / "figures" / f"{name}.svg").read_text("utf-8")
    report = (out / "report.md").read_text("utf-8")
    assert "Missing" not in report
    page = (out / "report.html").read_text("utf-8")
    assert page.count("data:image/png;base64,") == len(FIGURES)
    assert 'src="figures' not in page


def check_weights(out: Path, folder: Path) -> None:
    """The weights kept are read, and `mrcdrl evaluate` plays them in their own arena."""
    for kind in KINDS:
        for robots in (2, 4):
            kept = out / "weights" / f"{kind}-{robots}robots"
            assert load_policy(kept).network.kind == kind
            assert f"{robots} robots" in (kept / "README.md").read_text("utf-8")
    words = ["evaluate", kept, "--episodes", "3", "--json"]
    with Command(words, folder) as evaluated:
        assert evaluated.wait() == 0, evaluated.err
    told = json.loads(evaluated.out)
    assert (told["num_robots"], told["episodes"]) == (4, 3)
    assert told["learner_step"] >= SMOKE.budget[4]
