"""Whether a file can be written is known before the work for it begins."""

from pathlib import Path

import pytest

from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime.files import prepare_output


def test_the_folder_is_made_and_nothing_is_left_in_it(tmp_path: Path) -> None:
    prepare_output(tmp_path / "a" / "b" / "film.mp4")
    assert list((tmp_path / "a" / "b").iterdir()) == []


def test_a_file_that_exists_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_text("old")
    prepare_output(tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").read_text() == "old"


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        ("{folder}", "Is a directory"),
        ("{folder}/file/film.mp4", "File exists|Not a directory"),
        ("/proc/film.mp4", "No such file"),
        ("{folder}/" + 300 * "x", "File name too long"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path: Path, path: str, reason: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=f"cannot be written: ({reason})"):
        prepare_output(Path(path.format(folder=tmp_path)))
