"""A dry run says what the run would be and take, refuses what the run would, and writes nothing."""

import re
from pathlib import Path

import pytest

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.services.train.main import main


def told(capsys: pytest.CaptureFixture[str], folder: Path, *argv: str) -> str:
    assert main([*argv, "--dry-run", "--run-dir", str(folder)]) == 0
    return capsys.readouterr().out


def test_it_lists_what_differs_from_the_preset_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MRCDRL_LEARNER__BATCH_SIZE", "64")
    said = told(capsys, tmp_path / "runs", "four", "--config", "quick", "--robots", "4")
    assert re.search(r"^run +.*runs/four$", said, re.M)
    assert "quick, with 2 settings changed" in said
    assert "arena.num_robots = 4 (there: 2)" in said
    assert "learner.batch_size = 64 (there: 128)" in said
    assert "25 learner steps a second" in said
    assert "95.0% success, or 90 minutes" in said
    assert list(tmp_path.iterdir()) == []


def test_replays_log_grows_by_what_is_collected_until_the_table_is_full(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = ["--config", "smoke", "--replay.segment_bytes", "1_000_000"]
    said = told(capsys, tmp_path, *flags, "--replay.capacity", "100_000")
    each, at_most = re.findall(r"by (\d+) bytes a transition|to (\d+) MB at most", said)
    assert int(at_most[1]) == round((100_000 * int(each[0]) + 2_000_000) / 1e6)
    assert "no replay log" in told(capsys, tmp_path, *flags, "--replay.fsync", "off")


def test_it_says_how_long_a_number_of_steps_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = told(capsys, tmp_path, "--learner.batch_size", "32", "--learner-steps", "41_896")
    assert "estimate: 14 minutes to 41896" in said  # as the run did from which it is estimated


def test_a_resumption_is_compared_with_the_run_and_leaves_it_as_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "four").mkdir()
    config = tmp_path / "four" / "config.toml"
    config.write_text(to_toml(load_config("smoke", environ={})))
    before = config.stat()
    said = told(capsys, tmp_path, "--resume", "four", "--minutes", "7")
    assert "four, with 1 setting changed" in said
    assert "run.minutes = 7.0 (there: 90.0)" in said
    after = config.stat()
    assert (after.st_mtime_ns, after.st_ino) == (before.st_mtime_ns, before.st_ino)
    assert [path.name for path in (tmp_path / "four").iterdir()] == ["config.toml"]
    with pytest.raises(MrcdrlError, match=r"agent\.gamma is 0\.5 here"):
        main(["--resume", "four", "--run-dir", str(tmp_path), "--agent.gamma", "0.5", "--dry-run"])
