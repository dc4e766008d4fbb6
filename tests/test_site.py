"""The documentation as a site, where `make docs` has built it: for everybody, without a network."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, expect

from tests.patience import PATIENCE_S
from tests.services.web.watched import PATIENCE_MS, violations

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "build" / "docs"
PAGES = (
    "README",
    "docs/api",
    "docs/architecture",
    "docs/benchmarks",
    "docs/commands",
    "docs/index",
    "docs/notebooks/values",
    "docs/tutorials/first-run",
)
MOST_BYTES = 20e6
pytestmark = [
    pytest.mark.timeout(2 * PATIENCE_S),
    pytest.mark.skipif(not (SITE / "docs" / "index.html").exists(), reason="run: make docs"),
]


@pytest.fixture(params=["light", "dark"])
def reader(browser: Browser, request: pytest.FixtureRequest) -> Iterator[BrowserContext]:
    """A browser that reaches no network."""
    context = browser.new_context(color_scheme=request.param, offline=True)
    context.set_default_timeout(PATIENCE_MS)
    yield context
    context.close()


@pytest.mark.parametrize("name", PAGES)
def test_everybody_can_read_it(reader: BrowserContext, name: str) -> None:
    page = reader.new_page()
    page.goto((SITE / f"{name}.html").as_uri())
    assert violations(page) == []


def test_it_can_be_searched_without_a_network(reader: BrowserContext) -> None:
    page = reader.new_page()
    page.goto((SITE / "search.html").as_uri() + "?q=safe_circle")
    expect(page.locator("#search-results")).to_contain_text("The arena", timeout=PATIENCE_MS)


def test_notebooks_are_run_as_it_is_built() -> None:
    for name in ("arena", "values", "compare"):
        text = (SITE / "docs" / "notebooks" / f"{name}.html").read_text("utf-8")
        assert 'class="cell_output' in text
        assert "<img" in text


def test_it_is_small() -> None:
    assert sum(path.stat().st_size for path in SITE.rglob("*") if path.is_file()) < MOST_BYTES
