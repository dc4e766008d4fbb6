"""A real run and its page in a real browser, from the start to the end; and the run without it."""

import os
import re
import signal
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    SMALL,
    Command,
    end_all,
    processes_of,
    run_name,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(4 * PATIENCE_S)]
expect.set_options(1000 * PATIENCE_S)


def test_a_run_is_watched_from_its_start_to_its_end(browser: Browser, tmp_path: Path) -> None:
    name = run_name("watched")
    words = ["train", "--config", "smoke", "--run-dir", tmp_path, "--name", name, *SMALL]
    said: list[str] = []
    try:
        with Command([*words, "--learner-steps", "100000000"], tmp_path) as train:
            told = eventually(lambda: re.search(r"watch it at (\S+)", train.err), "the address")
            page = browser.new_page()
            page.set_default_timeout(1000 * PATIENCE_S)
            page.on("console", lambda m: m.type == "error" and said.append(m.text))
            page.on("pageerror", lambda error: said.append(str(error)))
            page.goto(told[1])
            expect(page.locator("#state")).to_have_text("running")
            expect(page.locator("#moment")).to_contain_text("actor actor-0")
            expect(page.locator("#robots .robot")).to_have_count(2)
            page.locator("#worker").select_option("evaluator/evaluator-0")
            expect(page.locator("#moment")).to_contain_text("evaluator evaluator-0")
            expect(page.locator("#tests")).to_contain_text("%")
            expect(page.locator("#charts .now").nth(2)).to_contain_text("loss")
            assert said == []
            (server,) = processes_of(str(tmp_path / name), " web ")
            os.kill(server, signal.SIGKILL)
            expect(page.locator("#message")).to_contain_text("trying again", ignore_case=True)
            eventually(lambda: "the page has ended" in train.err, "the launcher says so")
            with Command(
                ["web", tmp_path / name, "--port", told[1].split(":")[2].split("/")[0]], tmp_path
            ):
                expect(page.locator("#message")).to_be_hidden()
                expect(page.locator("#moment")).to_contain_text("evaluator evaluator-0")
                train.signal(signal.SIGINT)
                expect(page.locator("#state")).to_have_text("stopped")
                expect(page.locator("#lead")).to_contain_text("The run has ended")
                page.close()
            train.signal(signal.SIGINT)
            assert train.wait() == 0, train.err
        assert processes_of(name) == {}
    finally:
        end_all(name)
