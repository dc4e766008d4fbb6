"""The page beside a run: started if it can be, and never missed."""

import http.client
import json
import logging
import os
import signal
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.errors import ConfigError
from mrcdrl.services.monitor.run_directory import RunDirectory
from mrcdrl.services.train import page as module
from mrcdrl.services.train.page import Page
from tests.patience import PATIENCE_S, eventually

CONFIG = load_config("smoke", {}, environ={})


def listed(address: str) -> list[str] | None:
    """The runs that the page at this address lists; None while it does not answer."""
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=PATIENCE_S)
    try:
        connection.request("GET", "/api/runs")
        return [run["name"] for run in json.loads(connection.getresponse().read())["runs"]]
    except OSError:
        return None
    finally:
        connection.close()


def test_a_run_has_a_page_while_it_lasts(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with RunDirectory.create(tmp_path / "mine", CONFIG) as run:
        with Page(run) as page:
            address = page.address
            assert address.endswith("/run?name=mine")
            assert eventually(lambda: listed(address), "the page") == ["mine"]
            with Page(run) as other:
                assert urlsplit(other.address).port != urlsplit(address).port
            page.check()
            page.check()
            assert page.address == address
        assert listed(address) is None
        page.close()
    said = [record.getMessage() for record in caplog.records]
    assert said == [f"watch it at {address}"]


def test_a_page_that_ends_is_told_once_and_missed_by_nobody(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with RunDirectory.create(tmp_path / "mine", CONFIG) as run, Page(run) as page:
        assert page._process is not None
        os.kill(page._process.pid, signal.SIGKILL)
        page._process.wait(PATIENCE_S)
        for _ in range(3):
            page.check()
        assert page.address == ""
    assert caplog.text.count("the page has ended") == 1


def test_without_its_packages_or_unwanted_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def missing(*_: str) -> None:
        raise ConfigError("needs starlette, which is not installed: pip install 'mrcdrl[web]'")

    monkeypatch.setattr(module, "require", missing)
    with RunDirectory.create(tmp_path / "mine", CONFIG) as run:
        with Page(run, wanted=False) as page:
            assert page.address == ""
        assert caplog.text == ""
        with Page(run) as page:
            assert page.address == ""
            page.check()
    assert "no page to watch the run by: needs starlette" in caplog.text
