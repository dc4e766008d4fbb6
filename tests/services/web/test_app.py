"""What the page is told of runs that have ended: all of it from their files."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.services.web.app import STATIC
from mrcdrl.services.web.history import CURVES
from tests.services.web.web_server import Served, record_run, served

SMOKE = load_config("smoke", {"agent.n_step": "2"}, environ={})


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("runs")
    record_run(made / "one", SMOKE)
    record_run(made / "two", Config(), seconds=10)
    (made / "one" / "training.png").write_bytes(b"\x89PNG")
    return made


@pytest.fixture
def server(folder: Path) -> Iterator[Served]:
    with served(folder) as up:
        yield up


def test_the_list_has_every_run(server: Served, folder: Path) -> None:
    told = server.json("/api/runs")
    assert told["folder"] == str(folder)
    by_name = {run["name"]: run for run in told["runs"]}
    assert set(by_name) == {"one", "two"}
    one = by_name["one"]
    assert (one["preset"], one["changed"], one["best_success"]) == ("smoke", 1, 0.5)
    assert "path" not in one


def test_a_run_is_told_by_the_model_of_the_screen(server: Served) -> None:
    told = server.json("/api/runs/one")
    state = told["state"]
    assert state["best"]["success_interval"] == [0.2, 0.8]
    assert state["recent_successes"] == [50, 100]
    assert state["point"]["learner_steps"] == 290
    assert state["point"]["env_steps"] == 580
    assert state["point"]["learner_steps_per_s"] == pytest.approx(10)
    assert state["histograms"]["q_bin"] == [0.1] * 10
    assert [s["id"] for s in state["services"]] == ["actor-0", "learner-0"]
    differing = {s["key"] for s in told["settings"]["settings"] if s["there"] is not None}
    assert differing == {"agent.n_step"}
    assert set(told["files"]) == {"training.png", "config.toml", "summary.json"}


def test_curves_have_both_axes_and_end_where_they_are_asked_to(server: Served) -> None:
    told = server.json("/api/runs/one/history?points=10&from=5&to=25")
    assert set(told) == set(CURVES)
    assert (len(told["time_s"]), told["time_s"][0], told["time_s"][-1]) == (10, 5, 25)
    assert told["learner_steps"] == [10 * t for t in told["time_s"]]
    assert told["loss"][0] == pytest.approx(1 / 6)
    assert told["replay_size"] == [None] * 10
    scores = server.json("/api/runs/one/episodes?points=5")
    assert len(scores["score"]) <= 5
    assert scores["success"] == pytest.approx([0.5] * len(scores["score"]))
    assert [e["success_rate"] for e in server.json("/api/runs/one/evaluations")] == [0.5]


def test_a_run_of_another_version_still_has_its_curves(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder / "one", tmp_path / "old")
    (tmp_path / "old" / "config.toml").write_text("[arena]\nnot_yet = 1\n", "utf-8")
    with served(tmp_path) as server:
        told = server.json("/api/runs/old")
        assert (told["settings"], told["state"]) == (None, None)
        assert len(server.json("/api/runs/old/history")["time_s"]) == 30


def test_a_run_that_has_just_begun_is_told_without_records(tmp_path: Path) -> None:
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / "config.toml").write_text("", "utf-8")
    with served(tmp_path) as server:
        assert server.json("/api/runs/new")["state"]["best"] is None
        assert server.json("/api/runs/new/history")["time_s"] == []
        assert server.json("/api/runs/new/episodes")["score"] == []
        assert server.json("/api/runs/new/log") == []


def test_log_lines_of_all_processes_are_in_the_order_of_their_times(
    folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder / "one", tmp_path / "one")
    logs = tmp_path / "one" / "logs"
    logs.mkdir()
    (logs / "actor-0.log").write_text(
        "2026-01-01 10:00:00,000 INFO actor: first\n"
        "2026-01-01 10:00:02,000 WARNING actor: <script>alert(1)</script>\x1b[31m\n"
        "no line of ours\n"
    )
    (logs / "learner-0.log").write_text("2026-01-01 10:00:01,000 ERROR learner: between\n")
    with served(tmp_path) as server:
        lines = server.json("/api/runs/one/log")
    assert [line["worker"] for line in lines] == ["actor-0", "learner-0", "actor-0"]
    assert lines[2]["text"] == "<script>alert(1)</script>\\x1b[31m"


def test_files_are_sent_as_what_they_are(server: Served) -> None:
    status, headers, body = server.get("/files/one/training.png")
    assert (status, headers["content-type"], body) == (200, "image/png", b"\x89PNG")
    status, headers, body = server.get("/files/one/summary.json", Range="bytes=0-0")
    assert (status, body) == (206, b"{")
    assert json.loads(server.get("/files/one/summary.json")[2])["stop_reason"]


@pytest.mark.parametrize("page", ["/", "/run?name=one", "/compare?runs=one,two", "/guide"])
def test_pages_name_only_files_that_this_server_has(server: Served, page: str) -> None:
    status, headers, body = server.get(page)
    assert (status, headers["content-type"]) == (200, "text/html; charset=utf-8")
    text = body.decode()
    assert "//" not in text.replace("<!doctype", "")
    for attribute in ("src=", "href="):
        for named in text.split(attribute)[1:]:
            path = named[1:].partition('"')[0]
            if not path.startswith("#"):
                assert server.get(path)[0] == 200, path


def test_the_guide_is_the_page_of_the_docs(server: Served) -> None:
    docs = Path(__file__).resolve().parents[3] / "docs" / "metrics.md"
    assert server.get("/metrics.md")[2] == docs.read_bytes()
    assert (STATIC / "vendor" / "uplot.LICENSE").read_text("utf-8").startswith("The MIT License")
