"""Who may import what: common no service, a service no other's inside, a library its place.

Read off the source of every file, imports within functions included.
"""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(
    path.relative_to(ROOT) for top in ("common", "services") for path in (ROOT / top).rglob("*.py")
)

# Where a library may be imported: a folder with all in it, or one file.
PLACES = {
    "zenoh": ("common/transport",),
    "lz4": ("common/transport",),
    "msgpack": ("common/wire.py",),
    "zlib_ng": ("services/replay/log.py",),
    "pymunk": ("common/arena",),
    "cv2": ("common/arena",),
    "numba": ("common/arena", "common/lit_kernels.py"),
    "llvmlite": ("common/lit_kernels.py",),
    "scipy": ("common/arena/controllers",),
    "pettingzoo": ("common/arena/parallel_env.py",),
    "gymnasium": ("common/arena/parallel_env.py", "common/arena/vector_env.py"),
    "stable_baselines3": ("common/arena/sb3.py",),
    "pydantic": ("common/config.py",),
    "torch": (
        "common/first_layer.py",
        "common/first_layer_cuda.py",
        "common/kernels.py",
        "common/network.py",
        "common/policy.py",
        "common/precompile.py",
        "services/learner",
        "services/actor",
        "services/evaluator",
    ),
    "cuda": ("common/kernels.py",),
    "safetensors": ("common/network.py", "services/learner"),
    "matplotlib": ("services/dashboard",),
    "av": ("services/dashboard",),
    "tensorboardX": ("services/dashboard",),
    "onnxruntime": ("services/evaluator/export.py",),
    "rerun": ("services/evaluator/recording.py",),
    "rich": (
        "services/dashboard",
        "services/train",
        "services/doctor/__main__.py",
        "services/evaluator",
        "services/replay/inspect.py",
    ),
}

# The dashboard is no process: the launcher shows and records a run by its modules, the evaluator's
# commands draw by them, and simulate names the machine as a run's summary does.
DRAWN_BY_DASHBOARD = {
    "services/actor": {"summary"},
    "services/train": {"limiting", "recorder", "screen", "state", "stopping"},
    "services/evaluator": {"figures", "film", "paper"},
}


@cache
def imports_of(path: Path) -> frozenset[str]:
    """Dotted names of all that the file imports."""
    names = set()
    for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            assert node.module is not None
            names.add(node.module)
            # `from services.learner import checkpoint` imports a module
            names.update(
                f"{node.module}.{alias.name}"
                for alias in node.names
                if (ROOT / node.module.replace(".", "/") / f"{alias.name}.py").is_file()
            )
    return frozenset(names)


def under(path: Path, places: tuple[str, ...]) -> bool:
    return any(path == Path(place) or Path(place) in path.parents for place in places)


def by_name(path: Path) -> str:
    return path.as_posix()


def test_there_are_files_to_read() -> None:
    assert Path("common/wire.py") in FILES
    assert Path("services/train/__main__.py") in FILES
    assert "zenoh" in imports_of(Path("common/transport/session.py"))
    assert "services.learner.checkpoint" in imports_of(Path("services/learner/keeper.py"))


@pytest.mark.parametrize("path", [p for p in FILES if p.parts[0] == "common"], ids=by_name)
def test_common_imports_no_service(path: Path) -> None:
    assert {name for name in imports_of(path) if name.split(".")[0] == "services"} == set()


@pytest.mark.parametrize("path", [p for p in FILES if len(p.parts) > 2], ids=by_name)
def test_a_service_imports_of_another_its_client_only(path: Path) -> None:
    if path.parts[0] != "services":
        return
    own = path.parts[1]
    allowed = DRAWN_BY_DASHBOARD.get(f"services/{own}", set())
    for name in imports_of(path):
        parts = name.split(".")
        if parts[0] != "services" or parts[1] == own:
            continue
        assert parts[2:] == ["client"] or (parts[1] == "dashboard" and parts[2] in allowed), (
            f"{path} imports {name}"
        )


def test_the_command_imports_no_service_until_it_is_called() -> None:
    ours = {
        name
        for name in imports_of(Path("services/cli.py"))
        if name.split(".")[0] in ("common", "services")
    }
    assert ours == {"common.process"}


@pytest.mark.parametrize("library", PLACES)
def test_a_library_is_imported_in_its_place_only(library: str) -> None:
    importers = {path for path in FILES for n in imports_of(path) if n.split(".")[0] == library}
    assert importers, f"nobody imports {library}: the rule is out of date"
    assert {path for path in importers if not under(path, PLACES[library])} == set()


def modules_after(statement: str) -> set[str]:
    """Top names of the modules that a fresh interpreter has after the statement."""
    code = f"{statement}\nimport sys\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return set(result.stdout.split())


HEAVY = {"torch", "cv2", "numba", "pymunk", "matplotlib", "av", "safetensors", "rich"}


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("services.replay.__main__", HEAVY),
        ("services.cli", HEAVY),
        ("services.replay.client", HEAVY),
        ("services.train.__main__", {"torch", "safetensors"}),
        ("services.train.status", HEAVY - {"rich"}),
        ("services.actor.simulate.__main__", HEAVY),
        ("services.doctor.__main__", HEAVY - {"rich"}),
        ("common.heartbeat", {*HEAVY, "zenoh", "numpy", "pydantic", "msgpack"}),
    ],
)
def test_what_a_module_brings_with_it(module: str, absent: set[str]) -> None:
    assert modules_after(f"import {module}") & absent == set()
