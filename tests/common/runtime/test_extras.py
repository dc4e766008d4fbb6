"""Without its optional packages, every command works or ends with one line that names the extra."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from mrcdrl import cli
from mrcdrl.common.config import load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.runtime import extras
from mrcdrl.common.runtime.extras import PACKAGES, TRAINING, missing_extras, named_extras, require
from mrcdrl.services.train.launcher import check_possible

ROOT = Path(__file__).parents[3]
DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "markdown_it": "markdown-it-py",
    "rerun": "rerun-sdk",
    "sse_starlette": "sse-starlette",
}  # of other names
NEEDING = {  # command lines that need an extra; the others need none
    "train": ["new"],
    "evaluate": ["nowhere"],
    "render": ["nowhere"],
    "report": ["nowhere"],
    "figure": ["arena", "--out", "x.svg"],
    "export": ["nowhere", "--out", "x.onnx"],
    "actor": ["nowhere"],
    "learner": ["nowhere"],
    "evaluator": ["nowhere"],
    "web": ["nowhere"],
}
_WITHOUT = """
import sys
ABSENT = {absent!r}
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ABSENT:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
from mrcdrl.cli import main
sys.argv = ["mrcdrl", *{argv!r}]
sys.exit(main())
"""


def without(absent: set[str], *argv: str) -> subprocess.CompletedProcess[str]:
    """Run a command where these packages are not installed."""
    code = _WITHOUT.format(absent=sorted(absent), argv=argv)
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )


OPTIONAL = {package for packages in PACKAGES.values() for package in packages}


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_a_command_without_extras_works_or_names_the_extra(command: str) -> None:
    words = NEEDING.get(command)
    told = without(OPTIONAL, *command.split(), *(words or ["--help"]))
    if words is None:
        assert (told.returncode, told.stderr) == (0, "")
        return
    line = r"mrcdrl: needs \w+, which is not installed: pip install 'mrcdrl\[(\w+)\]'"
    found = re.match(line, told.stderr)
    assert found, told.stderr
    assert found[1] in PACKAGES
    assert (told.returncode, told.stderr.count("\n")) == (2, 1)


def test_doctor_without_extras_says_what_is_missing() -> None:
    told = without(OPTIONAL, "doctor", "--json")
    assert "not installed: arena (lacks numba, cv2" in told.stdout, told.stderr
    assert "learn (lacks torch" in told.stdout


def test_a_package_that_a_command_imports_late_is_named_too() -> None:
    told = without({"matplotlib"}, "report", "nowhere")
    assert told.stderr.startswith("mrcdrl: needs matplotlib, which is not installed"), told.stderr


def test_extras_are_those_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    listed = project["optional-dependencies"]
    for extra, packages in PACKAGES.items():
        named = {re.split("[>=<]", line)[0] for line in listed[extra]}
        named = {name for name in named if not name.startswith("mrcdrl[")}
        assert {DISTRIBUTIONS.get(package, package) for package in packages} == named, extra
    assert listed["all"] == [f"mrcdrl[{','.join(TRAINING)}]"]
    assert set(listed) - set(PACKAGES) == {"all", "dev", "docs", "fuzz"}


def test_a_module_of_ours_that_is_missing_is_a_bug() -> None:
    with pytest.raises(ModuleNotFoundError), named_extras():
        raise ModuleNotFoundError("No module named 'mrcdrl.gone'", name="mrcdrl.gone")


def test_training_is_refused_before_anything_is_written_without_torch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(extras, "is_installed", lambda package: package != "torch")
    assert missing_extras() == {"learn": ["torch"]}
    require("numba")
    with pytest.raises(ConfigError, match=r"torch, which .*pip install 'mrcdrl\[learn\]'"):
        check_possible(load_config("smoke", {}, environ={}))
