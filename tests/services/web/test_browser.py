"""The page in a real browser, over a run that is up: live, by keyboard, on a phone, in the dark."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import Stats
from tests.patience import PATIENCE_S, eventually
from tests.services.web.live_run import SMOKE, WORLD, LiveRun
from tests.services.web.watched import PATIENCE_MS, Watched
from tests.services.web.web_server import Served, record_run, served

pytestmark = pytest.mark.timeout(3 * PATIENCE_S)
CODE = "<img src=x onerror=alert(1)><script>alert(2)</script>"
expect.set_options(PATIENCE_MS)


def open_run(watched: Watched, server: Served, name: str = "live") -> Page:
    watched.page.goto(f"http://127.0.0.1:{server.port}/run?name={name}")
    return watched.page


def frame_shown(page: Page) -> tuple[int, int]:
    """Episode and frame that the arena shows; (0, -1) before the first."""
    text = page.locator("#moment").text_content() or ""
    found = re.search(r"episode (\d+) · frame (\d+)", text)
    return (int(found[1]), int(found[2])) if found else (0, -1)


def test_a_run_is_watched_from_its_page(watched: Watched, server: Served, live: LiveRun) -> None:
    page = open_run(watched, server)
    expect(page.locator("#state")).to_have_text("running")
    expect(page.locator("#lead")).to_contain_text("robots learn to reach a target each")
    expect(page.locator("#services")).to_contain_text("learner-0")
    expect(page.locator("#charts canvas")).to_have_count(10)
    eventually(lambda: frame_shown(page)[1] >= 0, "a picture of the arena")
    expect(page.locator("#robots .robot")).to_have_count(2)
    expect(page.locator("#robots .robot").nth(0)).to_contain_text("goes right, the best")
    expect(page.locator("#robots .robot").nth(1)).to_contain_text("goes left, at random")
    first = frame_shown(page)
    eventually(lambda: frame_shown(page) > first, "frames that go on")
    expect(page.locator("#ending")).to_contain_text("success: every robot is on a target")
    expect(page.locator("#arena-canvas")).to_have_attribute("aria-label", re.compile("2 robots"))
    live.evaluate(0.9)
    expect(page.locator("#tests")).to_contain_text("90.0 % ★ best")
    before = page.locator("#charts .now").nth(8).text_content()
    assert before is not None
    assert "samples per insert 4" in before
    assert watched.said == []
    assert watched.asked == {f"127.0.0.1:{server.port}"}


def test_a_custom_world_is_watched_by_what_its_agents_see(watched: Watched, tmp_path: Path) -> None:
    with LiveRun(tmp_path / "runs" / "live", WORLD) as run, served(run.path.parent) as up:
        page = open_run(watched, up)
        eventually(lambda: frame_shown(page)[1] >= 0, "a picture of the world")
        agents = page.locator("#robots .robot")
        expect(agents.nth(0)).to_contain_text("takes action 2, the best")
        expect(agents.nth(1)).to_contain_text("takes action 0, at random")
        expect(agents.nth(0).locator(".track")).to_have_count(5)
        expect(page.locator("#legend")).to_contain_text("as its agents see it")
        label = page.locator("#arena-canvas").get_attribute("aria-label") or ""
        assert label.startswith("The world, as its 2 agents see it")
        expect(page.locator("#ending")).to_contain_text("success.")
        shades = "c => new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size"
        assert page.locator("#arena-canvas").evaluate(shades) > 2, "nothing is drawn"
        expect(page.locator("#trails")).to_be_hidden()
    assert watched.said == []


def test_a_page_watches_by_one_stream(watched: Watched, server: Served) -> None:
    asked: list[str] = []
    watched.page.on("request", lambda request: asked.append(request.url.partition("/live/")[2]))
    page = open_run(watched, server)
    eventually(lambda: frame_shown(page)[1] >= 0, "a picture of the arena")
    expect(page.locator("#charts canvas")).to_have_count(10)
    streams = [path for path in asked if path.startswith("live")]
    assert streams == ["live?role=actor"]
    expect(page.locator("#worker")).to_have_value("actor/actor-0")


def test_curves_grow_while_a_run_goes_on(watched: Watched, server: Served) -> None:
    page = open_run(watched, server)

    def steps() -> float:
        text = page.locator("#tiles dd.figure").nth(4).text_content() or "0"
        return float(re.sub(r"[^\d.]", "", text) or 0)

    first = eventually(steps, "learner steps")
    eventually(lambda: steps() > first, "more learner steps")
    points = "document.querySelectorAll('#charts .u-over').length"
    assert page.evaluate(points) == 10
    assert watched.said == []


def test_frames_are_paused_stepped_and_slowed(watched: Watched, server: Served) -> None:
    page = open_run(watched, server)
    eventually(lambda: frame_shown(page)[1] >= 5, "some frames")
    page.locator("#arena-canvas").focus()
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_text("Play")
    held = frame_shown(page)
    page.keyboard.press("ArrowLeft")
    eventually(lambda: frame_shown(page) == (held[0], held[1] - 1), "one frame back")
    page.locator("#forward").click()
    eventually(lambda: frame_shown(page) == held, "one frame forward")
    page.locator("#speed").select_option("0.1")
    page.locator("#play").click()
    eventually(lambda: frame_shown(page) > held, "slow motion")
    page.locator("#newest").click()
    assert watched.said == []


def test_a_worker_publishes_while_it_is_watched_only(
    watched: Watched, server: Served, live: LiveRun
) -> None:
    assert not live.publisher.watched
    page = open_run(watched, server)
    eventually(lambda: live.publisher.watched, "the actor is watched")
    page.goto(f"http://127.0.0.1:{server.port}/guide")
    eventually(lambda: not live.publisher.watched, "nobody watches")


def test_a_page_finds_its_server_again(watched: Watched, live: LiveRun) -> None:
    with served(live.path.parent) as server:
        page, port = open_run(watched, server), server.port
        eventually(lambda: frame_shown(page)[1] >= 0, "a picture of the arena")
    expect(page.locator("#message")).to_contain_text("trying again", ignore_case=True)
    last = frame_shown(page)
    with served(live.path.parent, port=port):
        expect(page.locator("#message")).to_be_hidden()
        eventually(lambda: frame_shown(page) > last, "frames that go on")
        page.goto("about:blank")


def test_a_run_is_followed_to_its_end(watched: Watched, tmp_path: Path) -> None:
    with LiveRun(tmp_path / "runs" / "live", SMOKE) as live, served(live.path.parent) as server:
        page = open_run(watched, server)
        expect(page.locator("#state")).to_have_text("running")
        live.close()
        expect(page.locator("#state")).to_have_text("stopped")
        expect(page.locator("#live")).to_be_hidden()
        expect(page.locator("#lead")).to_contain_text("The run has ended: stopped (Ctrl-C)")
        assert watched.said == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(390, 844), (1300, 900), (3840, 2160)], ids=str)
def test_every_page_is_accessible_and_fits(
    browser: Browser, server: Served, live: LiveRun, size: tuple[int, int], scheme: str
) -> None:
    record_run(live.path.parent / "other", Config(), seconds=20)
    width, height = size
    opened = Watched(browser, viewport={"width": width, "height": height}, color_scheme=scheme)
    for path in ("/run?name=live", "/run?name=other", "/", "/compare?runs=live,other", "/guide"):
        opened.page.goto(f"http://127.0.0.1:{server.port}{path}")
        opened.page.wait_for_load_state("load")
        if path.startswith("/run"):
            expect(opened.page.locator("#charts canvas")).to_have_count(10)
        if path == "/run?name=live":
            eventually(lambda: frame_shown(opened.page)[1] >= 0, "a picture of the arena")
        assert opened.violations() == [], path
        overflow = "document.documentElement.scrollWidth - innerWidth"
        assert opened.page.evaluate(overflow) <= 0, path
    assert opened.said == []
    opened.close()


def test_everything_is_reached_by_keyboard(watched: Watched, server: Served) -> None:
    page = open_run(watched, server)
    eventually(lambda: frame_shown(page)[1] >= 0, "a picture of the arena")
    names = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        names.add(page.evaluate("document.activeElement.id || document.activeElement.textContent"))
    assert {"worker", "play", "back", "forward", "speed", "newest", "arena-canvas"} <= names
    assert {"over time", "over learner steps", "zoom in", "log", "warnings"} <= names
    page.keyboard.press("Shift+Tab")
    assert watched.said == []


def test_curves_zoom_by_dragging_and_by_buttons(watched: Watched, server: Served) -> None:
    page = open_run(watched, server)
    told = page.locator("#axis [role=status]")
    expect(told).to_have_text("the whole run")
    page.get_by_role("button", name="zoom in").click()
    expect(told).not_to_have_text("the whole run")
    page.get_by_role("button", name="whole run").click()
    expect(told).to_have_text("the whole run")
    plot = page.locator("#charts .u-over").nth(2)
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], middle, steps=5)
    page.mouse.up()
    expect(told).to_have_text(re.compile(r"0:00:\d\d to 0:00:\d\d"))
    page.get_by_role("button", name="over learner steps").click()
    assert watched.said == []


def test_runs_are_chosen_and_compared(watched: Watched, server: Served, live: LiveRun) -> None:
    record_run(live.path.parent / "other", replace_seed(SMOKE), seconds=20)
    page = watched.page
    page.goto(f"http://127.0.0.1:{server.port}/")
    page.get_by_label("compare live").check()
    expect(page.get_by_role("button", name="Compare the chosen runs")).to_be_disabled()
    page.get_by_label("compare other").check()
    page.get_by_role("button", name="Compare the chosen runs").click()
    expect(page.locator("#results")).to_contain_text("other")
    expect(page.locator("#differences")).to_contain_text("run.seed")
    expect(page.locator("#differences")).not_to_contain_text("agent.n_step")
    expect(page.locator("#charts canvas")).to_have_count(6)
    assert watched.said == []


def replace_seed(config: Config) -> Config:
    return config.model_copy(update={"run": config.run.model_copy(update={"seed": 77})})


def test_what_peers_and_files_say_is_text(watched: Watched, server: Served, live: LiveRun) -> None:
    """Names are refused where they are no names; all else is shown as it is."""
    logs = live.path / "logs"
    logs.mkdir()
    (logs / f"{'<b>x'}.log").write_text(f"2026-01-01 10:00:00,000 WARNING actor: {CODE}\n")
    live.worker.announce(f"mrcdrl/{live.keys.run}/live/actor/<script>")
    live.worker.announce(live.keys.live("x-role", "x"))
    absurd = {"loss": 1e308, "mean_q": float("nan"), "q_max": float("inf"), "td_error_p50": -1e300}
    learner = Stats("learner", "learner-0", absurd, {"incarnation": CODE, "python": CODE})
    live.extra = lambda run: run.publish(replace(learner))
    page = open_run(watched, server)
    expect(page.locator("#log")).to_contain_text(CODE)
    expect(page.locator("#services")).to_contain_text("x-role x")
    expect(page.locator("#services")).not_to_contain_text("script")
    eventually(lambda: frame_shown(page)[1] >= 0, "a picture of the arena")
    assert page.locator("img[src=x], #log script").count() == 0
    assert watched.said == []


def test_a_reason_and_a_record_that_are_code_are_text(watched: Watched, tmp_path: Path) -> None:
    record_run(tmp_path / "ended", SMOKE)
    summary = {"stop_reason": f"failed ({CODE})", "wall_s": 1e9}
    (tmp_path / "ended" / "summary.json").write_text(json.dumps(summary))
    with served(tmp_path) as server:
        page = open_run(watched, server, "ended")
        expect(page.locator("#about")).to_contain_text(CODE)
        expect(page.locator("#state")).to_have_text("failed")
        page.goto(f"http://127.0.0.1:{server.port}/run?name={CODE}")
        expect(page.locator("#message")).to_contain_text("Trying again")
        assert page.locator("img").count() == 0
        assert [said for said in watched.said if "404" not in said] == []
