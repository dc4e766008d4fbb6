"""Who may import what: rooms stand on floors, and a library is imported in its place only.

Read off the source of every file, imports within functions included. docs/architecture.md draws
the same floors.
"""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(
    path.relative_to(ROOT)
    for top in ("common", "services", "configs", "mrcdrl")
    for path in (ROOT / top).rglob("*.py")
)

# From the ground up. A room may import itself and what stands on floors below its own.
FLOORS = (
    ("common/errors.py",),
    ("common/runtime",),
    ("common/config",),
    ("common/messages",),
    ("common/transport", "common/arena"),
    ("common/model",),
    ("common/sync",),
    # the processes of the ring; of one another they import the client only
    (
        "services/replay",
        "services/actor",
        "services/learner",
        "services/evaluator",
        "services/router",
    ),
    ("services/monitor",),
    ("services/plots",),
    ("services/web",),
    ("services/train", "services/status", "services/tools"),
    ("mrcdrl",),
)
HANDED_OUT = "client"  # the module of a process that others on its floor and above may import
RING = FLOORS[7]

# Where a library may be imported: a folder with all in it, or one file.
PLACES = {
    "zenoh": ("common/transport",),
    "lz4": ("common/transport",),
    "msgpack": ("common/messages/wire.py",),
    "zlib_ng": ("services/replay/log.py",),
    "pymunk": ("common/arena/world",),
    "cv2": ("common/arena/images",),
    "numba": ("common/runtime/compiled.py", "common/model/kernels"),
    "llvmlite": ("common/model/kernels",),
    "scipy": ("common/arena/controllers",),
    "pettingzoo": ("common/arena/envs",),
    "gymnasium": ("common/arena/envs",),
    "stable_baselines3": ("common/arena/envs",),
    "pydantic": ("common/config",),
    "torch": (
        "common/model",
        "services/learner",
        "services/actor",
        "services/evaluator",
        "services/tools",
    ),
    "argcomplete": ("mrcdrl/completion.py", "services/tools/completion.py"),
    "cuda": ("common/model/kernels/cuda.py",),
    "safetensors": ("common/model", "services/learner"),
    "cryptography": ("services/tools/certificates.py",),
    "matplotlib": ("services/plots",),
    "av": ("services/plots",),
    "tensorboardX": ("services/monitor",),
    "prometheus_client": ("common/sync", "services/monitor", "services/web/scraping.py"),
    "starlette": ("services/web", "services/tools/demo"),
    "uvicorn": ("services/web",),
    "sse_starlette": ("services/web", "services/tools/demo"),
    "anyio": ("services/web", "services/tools/demo"),
    "onnxruntime": ("services/tools/export.py",),
    "markdown_it": ("services/tools/reproduce/page.py",),
    "rerun": ("services/tools/rerun_recording.py",),
    "rich": (
        "services/monitor",
        "services/status",
        "services/tools",
        "services/replay/inspect",
    ),
}


def path_of(name: str) -> str:
    """`mrcdrl.common.errors.X` as common/errors.py; a package as its folder."""
    parts = name.split(".")[1:]
    while parts:
        path = Path(*parts)
        if (ROOT / path).with_suffix(".py").is_file():
            return path.with_suffix(".py").as_posix()
        if (ROOT / path).is_dir():
            return path.as_posix()
        parts.pop()
    return "mrcdrl"


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
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(names)


def ours(path: Path) -> set[str]:
    """Files and folders of ours that the file imports."""
    return {path_of(name) for name in imports_of(path) if name.split(".")[0] == "mrcdrl"}


def under(path: str | Path, places: tuple[str, ...]) -> bool:
    return any(Path(path) == Path(place) or Path(place) in Path(path).parents for place in places)


def room_and_floor(path: str | Path) -> tuple[str, int]:
    for floor, rooms in enumerate(FLOORS):
        for room in rooms:
            if under(path, (room,)):
                return room, floor
    return "a package's face", -1  # common/, services/ and configs/ themselves hold docstrings only


def by_name(path: Path) -> str:
    return path.as_posix()


def test_there_are_files_to_read() -> None:
    assert Path("common/messages/wire.py") in FILES
    assert "zenoh" in imports_of(Path("common/transport/session.py"))
    assert "services/learner/checkpoint.py" in ours(Path("services/learner/weights_publisher.py"))


@pytest.mark.parametrize("path", FILES, ids=by_name)
def test_imports_lead_to_the_floors_below(path: Path) -> None:
    room, floor = room_and_floor(path)
    for target in ours(path):
        other, below = room_and_floor(target)
        if other == room:
            continue
        client = other in RING and Path(target).stem == HANDED_OUT
        assert below < floor or (client and room in RING), f"{path} imports {target}"


@pytest.mark.parametrize("path", FILES, ids=by_name)
def test_every_file_stands_in_a_room(path: Path) -> None:
    if room_and_floor(path)[1] < 0:
        assert path.name == "__init__.py"
        assert not imports_of(path), f"{path} stands on no floor and imports something"


@pytest.mark.parametrize("path", FILES, ids=by_name)
def test_no_module_imports_a_main_or_a_bare_name(path: Path) -> None:
    for name in imports_of(path):
        assert "__main__" not in name.split("."), f"{path} imports {name}"
        assert name.split(".")[0] not in ("common", "services", "configs"), f"{path}: {name}"


def test_the_architecture_draws_the_floors() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    drawing = page.split("\n## Imports\n")[1].split("```")[1]
    drawn: list[set[str]] = []
    for line in drawing.strip("\n").splitlines():
        if line[:2].strip():
            assert int(line[:2]) == len(FLOORS) - 1 - len(drawn)
            drawn.append(set())
        drawn[-1] |= set(re.findall(r"(?:common|services)/[\w.]+|\bmrcdrl\b", line[:60]))
    assert drawn[::-1] == [set(rooms) for rooms in FLOORS]


def test_the_command_imports_no_service_until_it_is_called() -> None:
    imported = ours(Path("mrcdrl/cli.py")) - {"mrcdrl", "mrcdrl/completion.py"}
    assert {room_and_floor(path)[0] for path in imported} == {"common/config", "common/runtime"}
    assert modules_after("import mrcdrl.cli") & LIGHT == set()


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
        timeout=PATIENCE_S,
        check=True,
    )
    return set(result.stdout.split())


HEAVY = {"torch", "cv2", "numba", "pymunk", "matplotlib", "av", "safetensors", "rich"}
ARENA_ONLY = {"cv2", "pymunk"}  # of the extra `arena`; with `learn` alone, policies act
LIGHT = {*HEAVY, "zenoh", "numpy", "pydantic", "msgpack", "prometheus_client"}


@pytest.mark.parametrize(
    ("module", "absent"),
    [
        ("mrcdrl", LIGHT),
        ("mrcdrl.services.train.flags", {*HEAVY, "zenoh", "numpy"}),
        ("mrcdrl.services.tools.flags", {*HEAVY, "zenoh", "numpy"}),
        ("mrcdrl.common.runtime.heartbeat", LIGHT),
        ("mrcdrl.services.replay.main", {*HEAVY, "prometheus_client"}),
        ("mrcdrl.services.replay.client", HEAVY),
        ("mrcdrl.services.train.main", {"torch", "safetensors"}),
        ("mrcdrl.common.model.saved_policy", {*ARENA_ONLY, "zenoh"}),
        ("mrcdrl.common.sync.live_policy", ARENA_ONLY),
        ("mrcdrl.services.status.main", HEAVY - {"rich"}),
        ("mrcdrl.services.web.main", HEAVY - {"rich"}),
        ("mrcdrl.services.web.flags", {*HEAVY, "zenoh", "numpy", "starlette"}),
        ("mrcdrl.services.tools.simulate.main", HEAVY - {"rich"}),
        ("mrcdrl.services.tools.doctor.main", HEAVY - {"rich"}),
    ],
)
def test_what_a_module_brings_with_it(module: str, absent: set[str]) -> None:
    assert modules_after(f"import {module}") & absent == set()
