"""Where PyTorch is installed from: the build for CPUs by default, pip's index as the way out."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]
INDEX = "https://download.pytorch.org/whl/cpu"
(TORCH,) = re.findall(r"^torch==\S+", (ROOT / "constraints.txt").read_text("utf-8"), re.M)
# In place of python and pip: writes down how it is called, and reaches no index when told so.
STUB = """#!/bin/sh
echo "$*" >> "$CALLS"
case "$*" in
  *"-m venv"*) mkdir -p "$3/bin" && cp "$0" "$3/bin/python" ;;
  *--index-url*) test -z "$UNREACHABLE" ;;
esac
"""


def calls(folder: Path, command: list[str], stub: str, **variables: str) -> tuple[list[str], str]:
    """How pip is called to install PyTorch by a command, and what the command says."""
    tools = folder / "tools"
    tools.mkdir()
    for name in ("Makefile", "constraints.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, folder / name)
    (tools / stub).write_text(STUB, "utf-8")
    (tools / stub).chmod(0o755)
    called = folder / "calls"
    environment = {"PATH": f"{tools}:{os.environ['PATH']}", "CALLS": str(called), **variables}
    result = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    lines = called.read_text("utf-8").splitlines()
    return [line for line in lines if TORCH in line], result.stdout


def made(folder: Path, gpu: bool = False, **variables: str) -> tuple[list[str], str]:
    (folder / "nvidia-smi").write_text(f"#!/bin/sh\nexit {int(not gpu)}\n", "utf-8")
    (folder / "nvidia-smi").chmod(0o755)
    path = {"PATH": f"{folder}:{folder / 'tools'}:{os.environ['PATH']}"}
    return calls(
        folder,
        ["make", "--silent", "PYTHON=python-stub", "install"],
        "python-stub",
        **path,
        **variables,
    )


def built(folder: Path, index: str, **variables: str) -> tuple[list[str], str]:
    """The command of the Dockerfile, run by a shell."""
    dockerfile = (ROOT / "Dockerfile").read_text("utf-8")
    (command,) = re.findall(r"RUN --mount=\S+ \\\n(    torch=(?:.*\\\n)*.*\n)", dockerfile)
    return calls(folder, ["sh", "-ec", command], "pip", TORCH_INDEX=index, **variables)


def from_index(line: str) -> bool:
    """Whether pip asks PyTorch's index; if so, for a few seconds only."""
    if "--index-url" not in line:
        return False
    assert f"--index-url {INDEX} --retries 0 --timeout 5" in line
    return True


def test_make_takes_the_build_for_cpus_where_there_is_no_gpu(tmp_path: Path) -> None:
    (line,), _ = made(tmp_path)
    assert from_index(line)


@pytest.mark.parametrize("how", ["a GPU", "no index"])
def test_make_takes_pips_build(how: str, tmp_path: Path) -> None:
    variables = {"TORCH_INDEX": ""} if how == "no index" else {}
    (line,), said = made(tmp_path, gpu=how == "a GPU", **variables)
    assert not from_index(line)
    assert INDEX not in said


def test_make_takes_pips_build_where_the_index_cannot_be_reached(tmp_path: Path) -> None:
    (first, second), said = made(tmp_path, UNREACHABLE="1")
    assert (from_index(first), from_index(second)) == (True, False)
    assert said.count("\n") == 1
    assert said.startswith(f"{INDEX} has no PyTorch for this machine, or cannot be reached")


def test_the_image_takes_the_build_for_cpus_and_the_folder_of_wheels(tmp_path: Path) -> None:
    assert f"ARG TORCH_INDEX={INDEX}\n" in (ROOT / "Dockerfile").read_text("utf-8")
    (line,), _ = built(tmp_path, INDEX)
    assert from_index(line)
    assert "--find-links /wheels" in line


def test_the_image_takes_pips_build_where_no_index_is_given(tmp_path: Path) -> None:
    (line,), _ = built(tmp_path, "")
    assert not from_index(line)


def test_the_image_takes_pips_build_where_the_index_cannot_be_reached(tmp_path: Path) -> None:
    (first, second), said = built(tmp_path, INDEX, UNREACHABLE="1")
    assert (from_index(first), from_index(second)) == (True, False)
    assert said.count("\n") == 1


def test_no_other_host_of_packages_stands_in_the_repository() -> None:
    files = [ROOT / name for name in ("Makefile", "Dockerfile", "pyproject.toml", "README.md")]
    for pattern in ("*.yml", "constraints*", "deploy/*", "docs/**/*.md", "tests/**/*.py"):
        files += [path for path in ROOT.glob(pattern) if path.is_file()]
    url = re.compile(
        r"https?://([\w.-]+)[\w./-]*/(?:simple|whl)\b|index-url[= ]+https?://([\w.-]+)"
    )
    hosts = {
        host
        for path in files
        for match in url.finditer(path.read_text("utf-8"))
        for host in match.groups()
        if host
    }
    assert hosts == {"download.pytorch.org"}
