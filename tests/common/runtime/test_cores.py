"""Cores by affinity and by the quota of either version of cgroups, at whatever level it is set."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.runtime import cores
from mrcdrl.common.runtime.cores import allowed_cores, available_cores, cpu_quota
from mrcdrl.services.train import launcher


def quota_of(folder: Path, membership: str, files: dict[str, str]) -> float | None:
    """The quota that a process of this membership has, given these files of cgroups."""
    (folder / "self").write_text(membership)
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return cpu_quota(folder, folder / "self")


V1 = "4:memory:/m\n2:cpu,cpuacct:/docker/abc\n1:name=systemd:/\n"


@pytest.mark.parametrize(
    ("membership", "files", "quota"),
    [
        ("0::/\n", {}, None),
        ("0::/\n", {"cpu.max": "max 100000\n"}, None),
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 1.5),
        ("0::/\n", {"cpu.max": "odd"}, None),
        ("0::/a/b\n", {"a/b/cpu.max": "200000 100000"}, 2.0),
        ("0::/a/b\n", {"a/cpu.max": "300000 100000", "a/b/cpu.max": "max 100000"}, 3.0),
        ("0::/a/b\n", {"a/cpu.max": "100000 100000", "a/b/cpu.max": "900000 100000"}, 1.0),
        ("0::/../c\n", {"cpu.max": "400000 100000"}, 4.0),
        (V1, {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, None),
        (V1, {"cpu/cpu.cfs_quota_us": "250000", "cpu/cpu.cfs_period_us": "100000"}, 2.5),
        (
            V1,
            {
                "cpu/docker/abc/cpu.cfs_quota_us": "50000",
                "cpu/docker/abc/cpu.cfs_period_us": "100000",
            },
            0.5,
        ),
    ],
)
def test_the_smallest_quota_counts(
    tmp_path: Path, membership: str, files: dict[str, str], quota: float | None
) -> None:
    assert quota_of(tmp_path, membership, files) == quota


def test_a_system_without_cgroups_has_no_quota(tmp_path: Path) -> None:
    assert cpu_quota(tmp_path, tmp_path / "missing") is None


@pytest.mark.parametrize(
    ("allowed", "quota", "expected"),
    [(8, None, 8), (8, 2.0, 2), (8, 2.9, 2), (8, 0.5, 1), (2, 6.0, 2)],
)
def test_whole_cores_within_affinity_and_quota(
    allowed: int, quota: float | None, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cores, "allowed_cores", lambda: allowed)
    monkeypatch.setattr(cores, "cpu_quota", lambda: quota)
    assert available_cores() == expected
    actors = launcher.num_actors(load_config("smoke", {"run.actors": "0"}, environ={}))
    assert actors == max(1, expected // 2)


def test_affinity_counts() -> None:
    core = min(os.sched_getaffinity(0))
    code = (
        f"import os; os.sched_setaffinity(0, [{core}]); "
        "from mrcdrl.common.runtime.cores import available_cores; print(available_cores())"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout == "1\n"
    assert allowed_cores() == len(os.sched_getaffinity(0))
