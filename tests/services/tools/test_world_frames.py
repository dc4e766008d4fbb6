"""Films of custom worlds: every frame is there, whether or not the world renders itself."""

from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Outcome, Weights
from mrcdrl.common.model.policy import make_policy
from mrcdrl.services.tools.progress import Progress
from mrcdrl.services.tools.render import write_world
from mrcdrl.services.tools.subject import Subject
from mrcdrl.services.tools.world_frames import world_frames
from tests.common.arena.test_custom import Counting, config

FRAMES = 5 + 20  # the first, four steps, and the last one repeated


def shown(monkeypatch: pytest.MonkeyPatch, **changed: object) -> Subject:
    settings = config(monkeypatch, lambda: Counting(**changed), num_robots="2", num_actions="5")
    return Subject(settings, make_policy(settings), None, Weights.of(0, 0, 0, b""))


def test_each_episode_is_shown_from_its_first_frame_to_its_outcome(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    outcomes: list[Outcome] = []
    subject = shown(monkeypatch, infos={"success": True})
    images = list(world_frames(subject, 2, 0, outcomes.append))
    assert len(images) == 2 * FRAMES
    assert len({image.shape for image in images}) == 1
    assert outcomes == 2 * [Outcome.SUCCESS]
    changes = [not np.array_equal(a, b) for a, b in pairwise(images)]
    assert changes[:5] == 5 * [True]
    assert not any(changes[5:24])


def test_the_worlds_own_picture_stands_beside_what_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    picture = np.zeros((20, 30, 3), np.uint8)
    picture[:, :, 0] = 255  # red in RGB
    with_picture = next(world_frames(shown(monkeypatch, render=lambda: picture), 1, 0, print))
    without = next(world_frames(shown(monkeypatch, render_mode=None), 1, 0, print))
    assert with_picture[0, 0].tolist() == [0, 0, 255]  # in BGR
    assert with_picture.shape[1] == without.shape[1] + 30 * 24
    assert with_picture.shape[0] == without.shape[0] == 520


def test_a_film_of_it_plays(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "world.mp4"
    with Progress() as progress:
        assert write_world(path, shown(monkeypatch), 1, 0, progress) == [Outcome.COLLISION]
    with av.open(str(path)) as film:
        assert sum(1 for _ in film.decode(video=0)) == FRAMES


def test_a_wrong_picture_is_one_clear_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    subject = shown(monkeypatch, render=lambda: np.zeros((20, 30)))
    with Progress() as progress, pytest.raises(ConfigError, match=r"render\(\) returns float64"):
        write_world(tmp_path / "world.mp4", subject, 1, 0, progress)
