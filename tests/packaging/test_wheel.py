"""The wheel, installed outside the clone, holds `mrcdrl` alone and trains from any directory."""

import hashlib
import json
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from tests.system.system_processes import SMALL, environment

pytestmark = [pytest.mark.system, pytest.mark.timeout(900)]

ROOT = Path(__file__).resolve().parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
PACKAGES = (
    "common",
    "services",
    "configs",
    "pretrained",
)  # links of these names in mrcdrl/ lead to them
FOLDERS = (*PACKAGES, "mrcdrl", "tests", "docs", "examples", "experiments")
FILES = (
    *("pyproject.toml", "MANIFEST.in", "constraints.txt", "Makefile"),
    *("README.md", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md", "LICENSE"),
)
BROKEN = "raise SystemExit('imported from the working directory')\n"


def run(*command: str | Path, cwd: Path) -> str:
    """Output of a command that must succeed; PYTHONPATH does not lead it to the clone."""
    variables = environment(PIP_NO_INDEX="1")
    variables.pop("PYTHONPATH", None)
    result = subprocess.run(
        list(map(str, command)),
        cwd=cwd,
        env=variables,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


def contents(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources, to build in."""
    copy = tmp_path_factory.mktemp("tree")
    for name in FOLDERS:
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, copy / name, symlinks=True, ignore=ignore)
    for name in FILES:
        shutil.copy(ROOT / name, copy)
    return copy


@pytest.fixture(scope="module")
def built(tree: Path) -> tuple[Path, Path]:
    """The sdist and the wheel built from it, as `make wheel` builds them."""
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", "dist", cwd=tree)
    return tree / f"dist/mrcdrl-{VERSION}.tar.gz", tree / f"dist/mrcdrl-{VERSION}-py3-none-any.whl"


@pytest.fixture(scope="module")
def bin_dir(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Commands of a new environment with the wheel, and this environment's other packages.

    The directory of those packages is on its path; their .pth files, by which the clone is
    installed here, are not read.
    """
    venv = tmp_path_factory.mktemp("clean") / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", venv, cwd=venv.parent)
    python = venv / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install")
    run(*pip, "--no-deps", "--no-compile", built[1], cwd=venv.parent)
    (site,) = venv.glob("lib/python*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib"))
    reuse_compiled(site / "mrcdrl")
    return python.parent


def reuse_compiled(package: Path) -> None:
    """Give the package the machine code that numba has compiled in the clone: 40 s less to wait.

    numba takes it for a source file of the same size and time.
    """
    indexes = [path for name in PACKAGES for path in (ROOT / name).rglob("*.nbi")]
    for index in indexes:
        source = index.parents[1] / f"{index.name.split('.')[0]}.py"
        shutil.copystat(source, package / source.relative_to(ROOT))
    for cache in {index.parent for index in indexes}:
        unfinished = shutil.ignore_patterns("*.tmp.*")  # of tests that compile meanwhile
        shutil.copytree(cache, package / cache.relative_to(ROOT), ignore=unfinished)


def test_the_wheel_holds_mrcdrl_alone(built: tuple[Path, Path]) -> None:
    files = contents(built[1])
    assert {name.split("/")[0] for name in files} == {"mrcdrl", f"mrcdrl-{VERSION}.dist-info"}
    assert f"\nVersion: {VERSION}\n" in files[f"mrcdrl-{VERSION}.dist-info/METADATA"].decode()


def test_the_wheel_holds_every_source_file(tree: Path, built: tuple[Path, Path]) -> None:
    files = [path for path in (tree / "mrcdrl").iterdir() if path.is_file()]
    expected = {f"mrcdrl/{path.name}": path.read_bytes() for path in files}
    for name in PACKAGES:
        files = [path for path in (tree / name).rglob("*") if path.is_file()]
        expected |= {f"mrcdrl/{path.relative_to(tree)}": path.read_bytes() for path in files}
    packed = {name: data for name, data in contents(built[1]).items() if "dist-info" not in name}
    assert packed == expected


def test_the_wheel_of_the_sdist_is_the_wheel_of_the_tree(
    tree: Path, built: tuple[Path, Path]
) -> None:
    command = (sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", "direct")
    run(*command, cwd=tree)
    (direct,) = (tree / "direct").iterdir()
    assert direct.name == built[1].name
    assert contents(direct) == contents(built[1])


def test_a_release_has_the_same_bytes_wherever_it_is_built(
    tree: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    digests = []
    for place in ("here", "else/where"):
        copy = tmp_path / place
        ignore = shutil.ignore_patterns("dist", "direct", "build", "*.egg-info")
        shutil.copytree(tree, copy, symlinks=True, ignore=ignore)
        for path in copy.rglob("*"):
            if path.is_file():
                path.touch()  # of another time
        # -o: what is installed here is what builds
        run("make", "-o", "install", f"BIN={Path(sys.executable).parent}", "wheel", cwd=copy)
        files = sorted((copy / "dist").iterdir())
        assert [file.suffix for file in files] == [".whl", ".gz"]
        digests.append([hashlib.sha256(file.read_bytes()).hexdigest() for file in files])
    assert digests[0] == digests[1]


def test_the_sdist_holds_tests_docs_grids_and_licence(built: tuple[Path, Path]) -> None:
    with tarfile.open(built[0]) as archive:
        names = {member.name.partition("/")[2]: member for member in archive.getmembers()}
    assert not [name for name, member in names.items() if member.issym() or member.islnk()]
    assert names.keys() >= {
        "CHANGELOG.md",
        "CITATION.cff",
        "CONTRIBUTING.md",
        "LICENSE",
        "README.md",
        "constraints.txt",
        "docs/architecture.md",
        "experiments/smoke.toml",
        "mrcdrl/common/errors.py",
        "tests/packaging/test_wheel.py",
    }


def test_the_wheel_is_imported_not_the_clone(bin_dir: Path, tmp_path: Path) -> None:
    show = "import mrcdrl; print(mrcdrl.__file__, mrcdrl.__version__)"
    file, version = run(bin_dir / "python", "-c", show, cwd=tmp_path).split()
    assert Path(file).is_relative_to(bin_dir.parent)
    assert version == VERSION
    assert "usage: mrcdrl" in run(bin_dir / "python", "-m", "mrcdrl", "--help", cwd=tmp_path)


def test_it_trains_from_any_directory(bin_dir: Path, tmp_path: Path) -> None:
    """Neither packages named like ours nor a file named like a library's may matter."""
    for name in ("common", "services", "configs", "mrcdrl"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text(BROKEN)
    (tmp_path / "random.py").write_text(BROKEN)
    brief = ("--learner-steps", "10", "--evaluator.period_s=5", *SMALL)
    train = ("train", "--config", "smoke", "--name", "first", *brief)
    run(bin_dir / "mrcdrl", *train, cwd=tmp_path)
    summary = json.loads((tmp_path / "runs" / "first" / "summary.json").read_bytes())
    assert summary["learner_steps"] == 10
    assert summary["versions"]["mrcdrl"] == VERSION
