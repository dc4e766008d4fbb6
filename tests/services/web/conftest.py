"""A run that is up, a server that shows it, and a page in a browser."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from tests.services.web.live_run import SMOKE, LiveRun
from tests.services.web.watched import Watched
from tests.services.web.web_server import Served, served


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveRun]:
    with LiveRun(tmp_path / "runs" / "live", SMOKE) as run:
        yield run


@pytest.fixture
def server(live: LiveRun) -> Iterator[Served]:
    with served(live.path.parent) as up:
        yield up


@pytest.fixture
def watched(browser: Browser) -> Iterator[Watched]:
    opened = Watched(browser, viewport={"width": 1300, "height": 900})
    yield opened
    opened.close()
