"""Benchmarks print one line of JSON with the promised fields; no figure in it is judged."""

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks import arena, learner, renderer_error, summary


@pytest.fixture(autouse=True)
def _stay_on_all_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_setaffinity", lambda *_: None)


def printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], module: Any, *argv: object
) -> dict[str, Any]:
    monkeypatch.setattr(sys, "argv", [module.__file__, *map(str, argv)])
    module.main()
    (line,) = capsys.readouterr().out.splitlines()
    result: dict[str, Any] = json.loads(line)
    assert {"machine", "cores", "versions", "command"} <= set(result)
    return result


def program(path: Path, text: str) -> Path:
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)
    return path


BRIEF = ("--robots", 2, "--arenas", 2, "--seconds", 0.01, "--repeats", 2)


def test_arena_measures_every_part_and_the_rival(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    rival = program(tmp_path / "python", "while read seconds; do echo 768; done")
    result = printed(monkeypatch, capsys, arena, *BRIEF, "--pusht-python", rival)
    parts = ("physics", "pymunk_physics", "drawing", "both", "literal_drawing", "literal_both")
    names = {f"{part}_2_robot_steps_per_s" for part in parts} | {"pusht_pictures_per_s"}
    assert set(result["rates"]) == names
    assert all(rate["min"] > 0 for rate in result["rates"].values())
    assert result["rates"]["pusht_pictures_per_s"]["median"] == 768
    (collecting,) = result["collecting"]
    assert sum(s for name, s in collecting.items() if name.endswith("_share")) == pytest.approx(
        1, abs=1e-3
    )


def test_learner_measures_updates(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    brief = ("--seconds", 0.01, "--reps", 2, "--threads", 1, "--precision", "float32")
    result = printed(monkeypatch, capsys, learner, "--batches", 2, 4, *brief)
    assert result["dtype"] == "torch.float32"
    assert all(learner.figure(result, size) > 0 for size in (2, 4))


def test_learner_and_its_peer_alternate(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    peer = "import json, sys; print(json.dumps({'b2_updates_per_s': 32.5, 'argv': sys.argv}))"
    (tmp_path / "bench_learner.py").write_text(peer)
    cores = ",".join(map(str, os.sched_getaffinity(0)))
    brief = ["--batches", "2", "--seconds", "0.01", "--reps", "2", "--threads", "1"]
    argv = ["learner", "--peers", str(tmp_path), "--cores", cores, "--rounds", "1", *brief]
    monkeypatch.setattr(sys, "argv", argv)
    learner.main()
    printed_text = capsys.readouterr()
    results = {line["system"]: line for line in map(json.loads, printed_text.out.splitlines())}
    assert list(results) == ["CleanRL, plain", "CleanRL, tuned", *learner.OURS]
    assert "--fused" in results["CleanRL, tuned"]["argv"]
    assert "--fused" not in results["CleanRL, plain"]["argv"]
    assert all(learner.figure(result, 2) > 0 for result in results.values())
    assert "CleanRL, plain          b2     32.5" in printed_text.err


def test_a_rival_that_exits_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rival = program(tmp_path / "python", "exit 3")
    monkeypatch.setattr(sys, "argv", ["arena", *map(str, BRIEF), "--pusht-python", str(rival)])
    with pytest.raises(RuntimeError, match="did not answer: exit code 3"):
        arena.main()


def test_renderer_error_knows_every_size_and_orientation(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    image = tmp_path / "both.png"
    result = printed(
        monkeypatch, capsys, renderer_error,
        "--scenes", 3, "--crops", 150, 600, "--image", image,
    )  # fmt: skip
    errors = {(e["orientation"], e["crop_px"]): e for e in result["errors"]}
    assert set(errors) == {(o, c) for o in ("unrotated", "heading_up") for c in (150, 600)}
    for error in errors.values():
        worst = error["worst_pixel"]
        assert error["worst"] == abs(worst["analytic"] - worst["literal"])
        assert error["mean_abs"] <= error["mean_abs_where_not_black"] <= error["worst"]
        above = f"{error['orientation']} {error['crop_px']:g}" in result["above_limit"]
        assert above == (error["mean_abs"] > 0.5)
    assert image.stat().st_size > 10_000


def test_the_page_of_benchmarks_is_made_of_the_raw_lines() -> None:
    page = (summary.PAGE).read_text("utf-8")
    assert page == summary.text(summary.Lines()), "run: python -m benchmarks.summary"
    for table in summary.TABLES:
        assert f"## {table.title}" in page


def test_lines_measured_here_stand_before_the_committed_ones(tmp_path: Path) -> None:
    (found,) = summary.Lines()("arena/arena.jsonl")
    rates = {name: {"median": 1000.0} for name in found["rates"]}
    here = tmp_path / "arena" / "arena.jsonl"
    here.parent.mkdir()
    line = {**found, "rates": rates, "machine": {"cpu": "Abacus", "cores": 3}}
    here.write_text(json.dumps(line) + "\n")
    lines = summary.Lines(tmp_path)
    assert lines("arena/arena.jsonl")[0]["machine"]["cpu"] == "Abacus"
    assert {row.times for row in summary.arena(lines)} == {1.0}
    assert "3 cores of Abacus" in summary.text(lines)
    assert summary.replay(lines) == summary.replay(summary.Lines())


def test_where_a_peer_is_better_it_is_said(tmp_path: Path) -> None:
    page = summary.text(summary.Lines())
    worse = [
        row
        for table in summary.TABLES
        for row in table.rows(summary.Lines())
        if row.times is not None and row.times < 1
    ]
    assert worse
    said = next(part for part in page.split("\n\n") if part.startswith("A peer is better in"))
    assert all(row.what in said for row in worse)
    assert all(f"**{row.times:.2f}**" in page for row in worse)
