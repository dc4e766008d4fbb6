"""The playground of `mrcdrl demo`: what is played, what may be changed, and what is refused."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from mrcdrl.common.errors import ConfigError, MrcdrlError, RunDirectoryError
from mrcdrl.common.model.saved_policy import load_policy
from mrcdrl.common.runtime.pretrained import (
    PREFIX,
    pretrained_for,
    pretrained_names,
    pretrained_path,
)
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.demo.app import CHANGE, DemoPage
from mrcdrl.services.tools.demo.main import Casting
from mrcdrl.services.tools.demo.playground import MAX_CHANGES, PAUSE_FRAMES, Playground
from mrcdrl.services.tools.kept_weights import manifest_of
from mrcdrl.services.web.guard import Guard
from tests.patience import PATIENCE_S
from tests.services.web.web_server import Served, serving


def playground(*argv: str, seed: int = 0) -> Playground:
    casting = Casting(flags.demo().parse_args(list(argv)))
    return Playground(casting, casting.num_robots, seed)


def events(played: Playground, frames: int = 1) -> list[tuple[str, dict[str, Any]]]:
    return [event for _ in range(frames) for event in played._advance()]


def frames(played: Playground, count: int) -> list[dict[str, Any]]:
    return [values for name, values in events(played, count) if name == "frame"]


def about(played: Playground, count: int = 1) -> dict[str, Any]:
    told = [values for name, values in events(played, count) if name == "about"]
    return told[-1]


def test_episodes_follow_one_another_and_are_counted() -> None:
    played = playground("pretrained:2robots")
    seen = events(played, 1200)
    shown = [values for name, values in seen if name == "frame"]
    ended = [frame for frame in shown if frame["outcome"]]
    assert len(ended) >= 2
    assert ended[0]["q_values"] == []
    following = shown[shown.index(ended[0]) + 1]
    assert (following["episode"], following["frame"]) == (ended[0]["episode"] + 1, 0)
    told = [values for name, values in seen if name == "about"][-1]
    assert told["episodes"] == len(ended)
    assert told["successes"] == sum(frame["outcome"] == "success" for frame in ended)


def test_pretrained_weights_succeed_from_most_starts() -> None:
    played = playground("pretrained:2robots")
    ended = [frame["outcome"] for frame in frames(played, 1500) if frame["outcome"]]
    assert ended.count("success") > 0.7 * len(ended)


def test_a_target_is_put_where_it_is_wanted_and_the_episode_does_not_count() -> None:
    played = playground()
    before = frames(played, 5)[-1]
    played.move("target", 2, 300.0, 310.0)
    (after,) = frames(played, 1)
    assert after["targets"][2] == [300.0, 310.0]
    assert (after["frame"], after["episode"]) == (0, before["episode"] + 1)
    moved = np.array(after["robots"]) - np.array(before["robots"])
    assert np.abs(moved[:, :2]).max() < 10  # the robots stand where they were
    ending = next(f for f in frames(played, 1100) if f["outcome"])
    assert ending["episode"] == after["episode"]
    assert about(playground(), 1)["episodes"] == 0


def test_what_is_put_outside_is_put_at_the_wall() -> None:
    played = playground()
    events(played)
    played.move("robot", 0, -1e5, 1e5)
    (after,) = frames(played, 1)
    x, y, _ = after["robots"][0]
    assert 25 < x < 60
    assert 540 < y < 575


def test_a_robot_on_a_robot_is_refused_and_nothing_moves() -> None:
    played = playground()
    (first,) = frames(played, 1)
    x, y, _ = first["robots"][1]
    before = frames(played, 1)[0]["robots"]
    played.move("robot", 0, x, y)
    seen = dict(events(played))
    assert "overlaps another" in seen["refused"]["why"]
    assert np.abs(np.array(seen["frame"]["robots"]) - np.array(before)).max() < 20


@pytest.mark.parametrize(("thing", "index"), [("robot", 4), ("target", -1), ("target", 99)])
def test_what_is_not_there_cannot_be_moved(thing: str, index: int) -> None:
    played = playground()
    events(played)
    played.move(thing, index, 100.0, 100.0)
    assert f"there is no {thing}" in dict(events(played))["refused"]["why"]


def test_the_number_of_robots_changes_with_the_weights_that_suit_it() -> None:
    played = playground()
    assert about(played)["weights"] == "pretrained:4robots"
    played.set_robots(2)
    told = about(played)
    assert (told["robots"], told["weights"]) == (2, "pretrained:2robots")
    played.set_robots(7)
    told = about(played)
    assert (told["robots"], told["weights"]) == (7, PREFIX + pretrained_for(7))
    assert len(frames(played, 1)[0]["targets"]) == 7
    for number in (0, 11):
        played.set_robots(number)
        assert "1 to 10 robots" in dict(events(played))["refused"]["why"]


def test_named_weights_stay_whatever_the_number() -> None:
    played = playground("pretrained:2robots", "--robots", "3")
    told = about(played)
    assert (told["robots"], told["weights"], told["trained_with"]) == (3, "pretrained:2robots", [2])
    played.set_robots(4)
    assert about(played)["weights"] == "pretrained:2robots"


def test_a_layout_of_given_targets_is_for_that_many_robots() -> None:
    played = playground("--robots", "2", "--arena.targets_px", "[[200, 200], [400, 400]]")
    events(played)
    played.set_robots(3)
    assert "too few for 3 robots" in dict(events(played))["refused"]["why"]


def test_a_new_start_is_another_one() -> None:
    played = playground()
    (first,) = frames(played, 1)
    played.restart()
    (second,) = frames(played, 1)
    assert second["robots"] != first["robots"]
    assert second["targets"] == first["targets"]


def test_what_waits_is_bounded() -> None:
    played = playground()
    for _ in range(10 * MAX_CHANGES):
        played.restart()
    assert len(played._changes) == MAX_CHANGES


def test_after_an_end_the_last_frame_stands_for_a_while() -> None:
    played = playground("pretrained:2robots")
    while not any(frame["outcome"] for frame in frames(played, 1)):
        pass
    assert frames(played, PAUSE_FRAMES - 1) == []
    assert frames(played, 2)[0]["frame"] == 0


def test_weights_that_are_not_there_are_refused() -> None:
    with pytest.raises(
        RunDirectoryError, match="no pretrained weights '5cars'; there are: 2robots"
    ):
        playground("pretrained:5cars")
    with pytest.raises(MrcdrlError):
        playground("no-such-run")
    with pytest.raises(ConfigError):
        playground("--robots", "many")


@pytest.mark.parametrize("name", pretrained_names())
def test_pretrained_weights_have_a_card_and_act(name: str) -> None:
    folder = pretrained_path(name)
    manifest = manifest_of(folder)
    assert manifest is not None
    assert manifest["precision"] == "float16"
    card = (folder / "README.md").read_text("utf-8")
    assert f"{100 * manifest['success_rate'][-1]:.1f} % of 1100 starts" in card
    policy = load_policy(PREFIX + name)
    assert repr(policy) == repr(load_policy(name))  # where no run is called so
    assert policy.q_values(np.zeros((1, 4, 60, 60), np.uint8)).shape == (1, 3)
    assert sum(path.stat().st_size for path in folder.iterdir()) < 2.5e6


def test_the_papers_numbers_of_robots_are_there() -> None:
    assert {"2robots", "3robots", "4robots"} <= set(pretrained_names())


@contextmanager
def demo() -> Iterator[Served]:
    played = playground()
    page = DemoPage(played)
    app = Guard(page.app(), [], None, [CHANGE])

    async def end() -> None:
        played.channel.end()

    with serving(app, page.check, end) as up:
        yield up


GOOD = [{"move": "target", "index": 0, "x": 100, "y": 200.5}, {"robots": 3}, {"restart": True}]
BAD = [
    '{"move": "moon", "index": 0, "x": 1, "y": 2}',
    '{"move": "robot", "index": 0, "x": NaN, "y": 2}',
    '{"move": "robot", "index": 0, "x": 1e300, "y": 2}',
    '{"move": "robot", "index": 0, "x": "1", "y": 2}',
    '{"move": "robot", "index": 0.5, "x": 1, "y": 2}',
    '{"robots": true}',
    '{"robots": "3"}',
    '{"restart": 1.5}',
    "[]",
    "{",
    "",
    "\xff",
    "[" * 900,
]


@pytest.mark.timeout(3 * PATIENCE_S)
def test_a_page_asks_for_changes_and_is_refused_what_is_none() -> None:
    with demo() as up:
        for change in GOOD:
            assert up.post(CHANGE, change)[0] == 204
        for text in BAD:
            status, _, body = up.post(CHANGE, text)
            assert (status, body.count(b"\n")) == (400, 1), text
        assert up.post(CHANGE, " " * 5000)[0] == 413
        assert up.post(CHANGE, "{}", content_type="text/plain")[0] == 415
        assert up.post(CHANGE, {"robots": 2}, Sec_Fetch_Site="cross-site")[0] == 403
        assert up.post(CHANGE, {"robots": 2}, Host="evil.example")[0] == 421
        assert up.get(CHANGE)[0] == 405
        assert up.post("/live", {"robots": 2})[0] == 405
        assert up.get("/")[0] == 200
