"""A page in a real browser, and all that its console said."""

from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page

from tests.patience import PATIENCE_S

AXE = Path(__file__).with_name("axe.min.js")
PATIENCE_MS = 1000 * PATIENCE_S


class Watched:
    """A page, and all that its console said."""

    def __init__(self, browser: Browser, **context: Any) -> None:
        self._context = browser.new_context(**context)
        self._context.set_default_timeout(PATIENCE_MS)
        self.page: Page = self._context.new_page()
        self.said: list[str] = []
        self.asked: set[str] = set()
        self.page.on("console", lambda m: m.type in ("error", "warning") and self.say(m.text))
        self.page.on("pageerror", lambda error: self.say(str(error)))
        self.page.on("dialog", lambda dialog: (self.say(dialog.message), dialog.dismiss()))
        self.page.on("request", lambda request: self.asked.add(request.url.split("/")[2]))

    def say(self, text: str) -> None:
        self.said.append(text)

    def violations(self) -> list[str]:
        """Of the page, as `violations` finds them."""
        return violations(self.page)

    def close(self) -> None:
        self._context.close()


def violations(page: Page) -> list[str]:
    """What axe-core finds, by all its rules for WCAG 2.2 A and AA and for good practice."""
    page.evaluate(AXE.read_text("utf-8"))
    found = page.evaluate("axe.run()")
    return [
        f"{v['id']}: {node['html'][:120]} ({node['failureSummary'][:200]})"
        for v in found["violations"]
        for node in v["nodes"]
    ]
