"""A run that is up, and a server that shows it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.services.web.live_run import SMOKE, LiveRun
from tests.services.web.web_server import Served, served


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveRun]:
    with LiveRun(tmp_path / "runs" / "live", SMOKE) as run:
        yield run


@pytest.fixture
def server(live: LiveRun) -> Iterator[Served]:
    with served(live.path.parent) as up:
        yield up
