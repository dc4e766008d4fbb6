"""The page of `mrcdrl demo` in a real browser: targets dragged, by pointer and by keyboard."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from mrcdrl.services.tools import flags
from mrcdrl.services.tools.demo.app import CHANGE, DemoPage
from mrcdrl.services.tools.demo.main import Casting
from mrcdrl.services.tools.demo.playground import Playground
from mrcdrl.services.web.guard import Guard
from tests.patience import PATIENCE_S, eventually
from tests.services.web.watched import PATIENCE_MS, Watched
from tests.services.web.web_server import serving

pytestmark = pytest.mark.timeout(3 * PATIENCE_S)
expect.set_options(PATIENCE_MS)


class Shown(Playground):
    """Remembers what it was asked to move."""

    moves: list[tuple[str, int, float, float]]

    def move(self, thing: str, index: int, x: float, y: float) -> None:
        self.moves.append((thing, index, x, y))
        super().move(thing, index, x, y)


@contextmanager
def shown(watched: Watched) -> Iterator[tuple[Page, Shown]]:
    casting = Casting(flags.demo().parse_args([]))
    played = Shown(casting, casting.num_robots, 0)
    played.moves = []
    page = DemoPage(played)

    async def end() -> None:
        played.channel.end()

    with serving(Guard(page.app(), [], None, [CHANGE]), page.check, end) as up:
        watched.page.goto(f"http://127.0.0.1:{up.port}/")
        expect(watched.page.locator("#moment")).to_contain_text("episode")
        yield watched.page, played
        watched.page.goto("about:blank")


def at(page: Page, x: float, y: float) -> tuple[float, float]:
    """A place of the arena in the window."""
    box: Any = page.locator("#arena-canvas").bounding_box()
    scale = box["width"] / 600
    return box["x"] + x * scale, box["y"] + y * scale


def free_target(played: Shown) -> tuple[int, float, float] | None:
    """A target on which no robot stands, and its place."""
    scene = played._game._arenas.scene(0)  # type: ignore[union-attr]
    for index, (x, y) in enumerate(scene.targets.tolist()):
        if ((scene.robots[:, :2] - (x, y)) ** 2).sum(axis=1).min() > 60**2:
            return index, x, y
    return None


def drag(page: Page, played: Shown) -> bool:
    """Drag a free target; whether it was in time: robots move meanwhile."""

    def dragged(x: float, y: float) -> None:
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(*at(page, 300, 250), steps=5)
        page.mouse.move(*at(page, 300, 310), steps=5)
        page.mouse.up()

    return _point(page, played, dragged, (300, 310))


def click(page: Page, played: Shown) -> bool:
    """Click a free target and then a place; whether it was in time."""

    def clicked(x: float, y: float) -> None:
        page.mouse.click(x, y)
        page.mouse.click(*at(page, 300, 300))

    return _point(page, played, clicked, (300, 300))


def _point(
    page: Page, played: Shown, move: Callable[[float, float], None], to: tuple[float, float]
) -> bool:
    """Move a free target from its place on the screen; whether it is asked to go there."""
    found = free_target(played)
    if found is None:
        return False
    index, x, y = found
    move(*at(page, x, y))
    return _comes(played, ("target", index, *to))


def press(page: Page, played: Shown) -> bool:
    """Move the second target up by its button; whether it was where it had been shown."""
    x, y = played._game._arenas.scene(0).targets[1].tolist()  # type: ignore[union-attr]
    page.locator("#thing").select_option("target 2")
    page.get_by_role("button", name="up", exact=True).press("Enter")
    return _comes(played, ("target", 1, x, y - 25))


def _comes(played: Shown, wanted: tuple[str, int, float, float]) -> bool:
    """Whether this is asked within a few seconds."""
    with suppress(AssertionError):
        return eventually(lambda: _is_last(played, wanted), timeout_s=5)
    return False


def _is_last(played: Shown, wanted: tuple[str, int, float, float]) -> bool:
    """Whether this is what was asked last, to the pixel of the screen."""
    if not played.moves:
        return False
    asked = played.moves[-1]
    near = np.abs(np.subtract(asked[2:], wanted[2:])).max() < 3
    return asked[:2] == wanted[:2] and bool(near)


@pytest.mark.parametrize("by", [drag, click, press])
def test_a_target_is_moved(watched: Watched, by: Callable[[Page, Shown], bool]) -> None:
    with shown(watched) as (page, played):
        expect(page.locator("#message")).to_be_empty()
        expect(page.locator("#number")).to_have_text("4 robots")
        eventually(lambda: by(page, played))
        assert by is not drag or len(played.moves) > 1  # it follows the pointer
        assert watched.said == []


def test_the_number_of_robots_is_chosen(watched: Watched) -> None:
    with shown(watched) as (page, _):
        page.get_by_role("button", name="One robot more").click()
        expect(page.locator("#number")).to_have_text("5 robots")
        expect(page.locator(".robot")).to_have_count(5)
        for number in (4, 3, 2, 1):
            page.get_by_role("button", name="One robot fewer").click()
            expect(page.locator("#number")).to_have_text(re.compile(f"^{number} robot"))
        expect(page.get_by_role("button", name="One robot fewer")).to_be_disabled()


def test_what_is_refused_is_told(watched: Watched) -> None:
    with shown(watched) as (page, played):
        scene = played._game._arenas.scene(0)  # type: ignore[union-attr]
        x, y, _ = scene.robots[1].tolist()
        played.move("robot", 0, x, y)
        expect(page.locator("#message")).to_contain_text("overlaps another")


@pytest.mark.parametrize("colors", ["light", "dark"])
def test_everybody_can_use_it(browser: Browser, colors: str) -> None:
    opened = Watched(browser, viewport={"width": 400, "height": 800}, color_scheme=colors)
    try:
        with shown(opened) as (page, _):
            assert opened.violations() == []
            width = page.evaluate("document.documentElement.scrollWidth")
            assert width <= 400, json.dumps(width)
    finally:
        opened.close()
