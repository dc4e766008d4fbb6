"""Each check of the machine, when all is well and when not."""

import resource
import subprocess
from pathlib import Path
from unittest import mock

import pytest

from mrcdrl.common.config import Config, load_config
from mrcdrl.common.runtime.process import ALLOCATOR
from mrcdrl.common.runtime.versions import installed, versions
from mrcdrl.services.replay.client import table_bytes
from mrcdrl.services.tools.doctor.machine import (
    CONSTRAINTS,
    allocator,
    clock,
    cores,
    disk,
    extras,
    free_memory,
    memory,
    of_this_machine,
    pins,
    python_and_packages,
    requirements,
    shared_memory,
)

SMOKE = load_config("smoke", {}, environ={})
GIB = 1 << 30


def test_this_machine_is_checked_whole(tmp_path: Path) -> None:
    found = list(of_this_machine(SMOKE, tmp_path, running=False))
    checks = [
        "versions",
        "extras",
        "clock",
        "cores",
        "memory",
        "shared memory",
        "allocator",
        "disk",
    ]
    assert [finding.check for finding in found] == checks
    for finding in found:
        assert finding.said
        assert bool(finding.fix) == (finding.verdict != "ok"), finding


def test_versions_as_required_and_as_tested() -> None:
    assert {"eclipse-zenoh", "numpy", "pydantic"} <= set(requirements())
    assert pins(CONSTRAINTS)["eclipse-zenoh"]
    assert pins(CONSTRAINTS.with_name("of no checkout")) == {}
    ours = {name: installed(name) or "" for name in requirements()}
    assert python_and_packages(requirements(), ours).verdict == "ok"
    old = python_and_packages({"numpy": "99.1"}, {})
    assert (old.verdict, "numpy" in old.said) == ("failed", True)
    assert python_and_packages({"no-such-package": "1"}, {}).verdict == "failed"
    other = python_and_packages(requirements(), {"numpy": "1.0"})
    assert (other.verdict, "tested: 1.0" in other.said) == ("warning", True)


def test_versions_are_known_without_torch() -> None:
    with mock.patch(
        "mrcdrl.common.runtime.versions.PACKAGES", {"zenoh": "eclipse-zenoh", "torch": "no-torch"}
    ):
        assert set(versions()) == {"python", "zenoh"}


def test_the_clock() -> None:
    assert clock().verdict == "ok"
    assert clock(now_s=0.0).verdict == "failed"
    coarse = mock.Mock(monotonic=True, resolution=0.01)
    with mock.patch("time.get_clock_info", return_value=coarse):
        assert clock().verdict == "warning"


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ({}, "all installed: arena, learn"),
        ({"certs": ["cryptography"]}, "not installed: certs (lacks cryptography)"),
        (
            {"arena": ["cv2", "pymunk"], "learn": ["torch"]},
            "not installed: arena (lacks cv2, pymunk); learn (lacks torch); to train here: "
            "pip install 'mrcdrl[all]'",
        ),
    ],
)
def test_extras_that_are_missing_are_named(missing: dict[str, list[str]], said: str) -> None:
    assert extras(missing).said.startswith(said)


@pytest.mark.parametrize(
    ("num", "quota", "threads", "environ", "verdict"),
    [
        (8, None, 0, {}, "ok"),
        (8, None, 8, {}, "ok"),
        (8, 7.5, 0, {}, "ok"),
        (8, None, 9, {}, "warning"),
        (8, None, 0, {"OMP_NUM_THREADS": "16"}, "warning"),
        (8, None, 0, {"OMP_NUM_THREADS": "4,2"}, "ok"),
        (8, 2.0, 0, {}, "ok"),
        (8, 2.0, 2, {}, "ok"),
        (8, 2.0, 3, {}, "warning"),
        (8, 1.5, 0, {}, "warning"),
        (1, None, 0, {}, "warning"),
    ],
)
def test_cores(
    num: int, quota: float | None, threads: int, environ: dict[str, str], verdict: str
) -> None:
    config = load_config("smoke", {"learner.threads": str(threads)}, environ={})
    assert cores(config, num, quota, environ).verdict == verdict


def test_memory(tmp_path: Path) -> None:
    assert free_memory(tmp_path) > 0
    (tmp_path / "memory.current").write_text("4000\n")
    (tmp_path / "memory.max").write_text("10000\n")
    assert free_memory(tmp_path) == 6000
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory(tmp_path) > 6000
    assert memory(GIB, 4 * GIB).verdict == "ok"
    assert memory(0, 4 * GIB).verdict == "ok"
    assert memory(3 * GIB, 3 * GIB).verdict == "warning"
    assert memory(0, 100 << 20).verdict == "warning"
    assert memory(4 * GIB, 3 * GIB).verdict == "failed"


def test_the_table_is_as_large_as_stated() -> None:
    from mrcdrl.services.replay.table import Table

    table = Table.from_config(SMOKE)
    assert table_bytes(SMOKE) == pytest.approx(table.nbytes, rel=0.1)


def test_memory_can_be_shared() -> None:
    found = shared_memory()
    assert found.verdict == "ok", found
    assert "memlock" in found.said


def test_no_memory_to_share() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))  # no file more may be opened
    try:
        found = shared_memory()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert (found.verdict, bool(found.fix)) == ("warning", True)


def test_shared_memory_that_nobody_can_open() -> None:
    refused = subprocess.CompletedProcess(
        [], 1, "", "SharedMemoryError: another container or user\n"
    )
    with mock.patch("subprocess.run", return_value=refused):
        found = shared_memory()
    assert found.verdict == "warning"
    assert "another container or user" in found.said


def test_the_allocator() -> None:
    assert allocator(ALLOCATOR, learns=True).verdict == "ok"
    assert allocator({}, learns=True).verdict == "ok", "mrcdrl train sets it"
    assert allocator({}, learns=False).verdict == "ok"
    one = {"MALLOC_MMAP_MAX_": "0"}
    assert allocator(one, learns=True).verdict == "warning"
    assert allocator(one, learns=False).verdict == "ok"


def test_the_disk(tmp_path: Path) -> None:
    assert disk(SMOKE, tmp_path / "not" / "there").verdict == "ok"
    assert not (tmp_path / "not").exists()
    vast = load_config(None, {"replay.capacity": str(10**12)}, environ={})
    assert disk(vast, tmp_path).verdict == "failed"
    no_log = load_config(None, {"replay.capacity": str(10**12), "replay.fsync": "off"}, environ={})
    assert disk(no_log, tmp_path).verdict == "ok"
    found = disk(Config(), Path("/proc/runs"))
    assert (found.verdict, "cannot be written" in found.said) == ("failed", True)
