"""Fixtures for all tests, and settings for cores that tests share."""

import datetime
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from mrcdrl.common.runtime.cores import available_cores
from mrcdrl.services.tools.certs import HOSTS, ROLES

if TYPE_CHECKING:
    from playwright.sync_api import Browser

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SLOW = ("compose", "chaos", "system", "packaging")  # folders of tests that start runs
MAX_WORKERS = 4  # each may start a run, whose processes fill several cores

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when torch is first imported
settings.register_profile("shared cores", deadline=None)  # waiting for a core is not a slow example
settings.load_profile("shared cores")


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_xdist_auto_num_workers() -> int:
    """Workers of `--numprocesses auto`: one more than cores, as tests of processes wait a lot."""
    return min(available_cores() + 1, MAX_WORKERS)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the slowest files, so that at the end no worker waits long for another one."""
    order = {folder: place for place, folder in enumerate(SLOW)}
    items.sort(key=lambda item: order.get(item.path.parent.name, len(SLOW)))


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Run PyTorch on one thread: threads on busy cores wait for each other, 100 times slower."""
    import torch  # not at the top: most tests do without it

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def cpp_compiler() -> str:
    """The machine's C++ compiler, for the GPU kernels' source, which is C++ as well."""
    found = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if found is None:
        pytest.skip("NO C++ COMPILER: GPU KERNELS ARE NOT TESTED")
    return found


@pytest.fixture(scope="session")
def promtool() -> str:
    """Prometheus' own check of metrics, rules and configurations."""
    found = shutil.which("promtool")
    if found is None:
        pytest.skip("NO PROMTOOL: WHAT PROMETHEUS IS GIVEN IS NOT CHECKED (apt install prometheus)")
    return found


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with an authority and all roles, as `mrcdrl certs` makes it."""
    from mrcdrl.services.tools.certificates import make  # only here is cryptography needed

    folder = tmp_path_factory.mktemp("certificates")
    make(folder, ROLES, HOSTS, datetime.timedelta(days=1))
    return folder


@pytest.fixture(scope="session")
def browser() -> Iterator["Browser"]:
    """Chromium, without windows, one for all tests: Playwright cannot start twice in a process."""
    path = next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        pytest.skip("NO CHROMIUM: THE PAGE IS NOT TESTED IN A BROWSER (apt-get install chromium)")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield started
        started.close()
