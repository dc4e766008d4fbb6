"""Recordings for rerun: what is in the file, and what is said where rerun is missing."""

import importlib.util
from pathlib import Path

import pytest

from mrcdrl.common.errors import ConfigError, MrcdrlError
from mrcdrl.services.tools.render import main

FLAGS = ["--controller", "greedy", "--robots", "2", "--episodes", "2"]
needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="recording is NOT tested: no rerun"
)


@needs_rerun
def test_every_frame_is_in_the_recording(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    out = tmp_path / "two.rrd"
    assert main([*FLAGS, "--out", str(out)]) == 0
    rows: dict[str, int] = {}
    for chunk in RrdReader(out).stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    assert rows["/arena/walls"] == 1
    assert rows["/outcome"] == 2
    frames = rows["/arena/robots"]
    assert frames > 20
    for path in ("/arena/targets", "/arena/headings", "/views/robot_1", "/views/robot_2"):
        assert rows[path] == frames


@needs_rerun
def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(MrcdrlError, match=r"recording .*two.rrd cannot be written"):
        main([*FLAGS, "--out", str(tmp_path / "missing" / "two.rrd")])


def test_without_rerun_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match=r"pip install 'mrcdrl\[rerun\]'"):
        main([*FLAGS, "--out", str(tmp_path / "two.rrd")])
