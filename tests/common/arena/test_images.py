"""Images: the analytic renderer against OpenCV, symmetries, and records of any bytes."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.arena import SYMMETRIES, Scene, Symmetry, literal_views, make_codec, render_arena
from mrcdrl.common.arena.world import starts
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import UInt8Array

OBSTRUCTED = {
    "num_robots": 4,
    "target_layout": "random",
    "num_obstacles": 2,
    "obstacles_px": ((300, 120, 35),),
    "inner_walls_px": ((250, 300, 350, 300), (420, 330, 500, 460)),
}


def scenes(config: ArenaConfig, num: int, seed: int = 0) -> list[Scene]:
    return [Scene(s.robots, s.targets, s.obstacles) for s in starts.test_starts(config, num, seed)]


def views(config: ArenaConfig, scene: Scene) -> UInt8Array:
    codec = make_codec(config)
    return codec.decode(codec.encode(scene))


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
@pytest.mark.parametrize("crop_px", [60, 149, 150, 200, 300, 600, 1200])
def test_the_analytic_renderer_agrees_with_opencv(crop_px: int, orientation: str) -> None:
    config = ArenaConfig.model_validate(
        {
            "num_robots": 4,
            "num_targets": 5,
            "target_layout": "random",
            "crop_px": crop_px,
            "orientation": orientation,
        }
    )
    errors = [
        views(config, scene).astype(int) - literal_views(scene, config)
        for scene in scenes(config, 100)
    ]
    assert np.abs(errors).mean() < (0.1 if crop_px >= 600 else 0.5)
    assert abs(np.mean(errors)) < 0.02


@pytest.mark.parametrize("crop_px", [150, 201, 330])
def test_an_unrotated_window_crops_whole_pixels(crop_px: int) -> None:
    """Checks that walls and targets, which fill whole pixels, equal the literal steps."""
    config = ArenaConfig(num_robots=1, crop_px=crop_px)
    rng = np.random.default_rng(0)
    across = (np.arange(60) + 0.5) * crop_px / 60 - crop_px / 2
    beside = np.hypot(across, across[:, None]) > config.robot_radius_px + 6
    for _ in range(20):
        places = rng.uniform((40, 250), (100, 350), (2, 2))  # beside one wall, far from its ends
        scene = Scene(np.array([[*places[0], 1.0]]), places[1:])
        gaps = views(config, scene)[0].astype(int) - literal_views(scene, config)[0]
        assert np.abs(gaps[beside]).max() <= 1


@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
def test_the_analytic_renderer_agrees_with_opencv_on_obstacles(orientation: str) -> None:
    config = ArenaConfig.model_validate({**OBSTRUCTED, "orientation": orientation})
    pairs = [(views(config, s), literal_views(s, config)) for s in scenes(config, 60)]
    errors = np.array([one.astype(int) - other for one, other in pairs])
    assert np.abs(errors).mean() < 0.3
    assert abs(errors.mean()) < 0.1


def test_an_obstacle_has_its_own_intensity() -> None:
    config = ArenaConfig(num_robots=1, obstacles_px=((300, 200, 30),))
    scene = Scene(
        np.array([[300.0, 300, 0]]), np.array([[500.0, 500]]), np.array([[300.0, 200, 30]])
    )
    view = views(config, scene)[0]
    assert view[20, 30] == 150
    assert literal_views(scene, config)[0, 20, 30] == 150
    assert view[15:25, 25:35].sum() == pytest.approx(150 * np.pi * 9, rel=0.15)
    image = render_arena(scene, config)
    assert (image == (0, 255, 0)).all(axis=2).sum() == pytest.approx(np.pi * 900, rel=0.02)


def test_an_inner_wall_covers_its_area() -> None:
    config = ArenaConfig(num_robots=1, inner_walls_px=((200, 150, 300, 225),), renderer="literal")
    scene = Scene(np.array([[300.0, 400, 0]]), np.array([[500.0, 500]]))
    image = render_arena(scene, config)[100:250, 150:350]
    assert (image == (0, 0, 255)).all(axis=2).sum() == pytest.approx(2 * 125, rel=0.15)


def test_an_image_by_hand() -> None:
    """Compares a robot in the middle that heads east with numbers by hand; a pixel is 10 px."""
    config = ArenaConfig(num_robots=1, targets_px=((455, 305),), robot_radius_px=30)
    view = views(config, Scene(np.array([[300.0, 300.0, 0.0]]), np.array([[455.0, 305.0]])))[0]
    assert view[0].max() == 0
    np.testing.assert_array_equal(view[1, 2:58], [15] * 56)  # 2 of 10 px of intensity 76
    np.testing.assert_array_equal(view[2:58, 58], [15] * 56)
    np.testing.assert_array_equal(view[29:32, 44:47], np.full((3, 3), 29))
    assert view[28:33, 43:48].sum() == 9 * 29
    np.testing.assert_array_equal(view[28, 28:32], [255] * 4)
    # the heading's upper half: 1.475 of 10 px, from 1 px before the middle on
    np.testing.assert_allclose(view[29, 28:32], [255, 251.2, 217.4, 217.4], atol=0.5)
    white = np.pi * 2.996**2 - 3.096 * 0.295
    assert view[27:33, 27:33].sum() == pytest.approx(255 * white, rel=2e-3)


def test_heading_up_shows_what_is_ahead_at_the_top() -> None:
    config = ArenaConfig(num_robots=1, targets_px=((300, 400),), orientation="heading_up")
    for heading, where in [(np.pi / 2, (20, 30)), (0.0, (30, 40)), (np.pi, (30, 20))]:
        robots = np.array([[300.0, 300.0, heading]])
        view = views(config, Scene(robots, np.array([[300.0, 400.0]])))[0]
        assert view[where] == 29
        assert (view == 29).sum() >= 1


@pytest.mark.parametrize("num_obstacles", [0, 3])
@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_the_mapped_scene_gives_the_mapped_image(symmetry: Symmetry, num_obstacles: int) -> None:
    config = ArenaConfig(num_robots=4, target_layout="random", num_obstacles=num_obstacles)
    for scene in scenes(config, 40):
        mapped = views(config, symmetry.apply_to_scene(scene, config.size_px)).astype(int)
        gaps = np.abs(mapped - symmetry.apply_to_images(views(config, scene)))
        assert gaps.mean() < 0.03
        if not symmetry.transpose:
            assert gaps.max() <= 1
        else:  # discs are exact along x and sampled along y
            assert np.quantile(gaps, 0.999) <= 3
            assert gaps.max() <= 7


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_heading_up_maps_only_mirrors(symmetry: Symmetry) -> None:
    config = ArenaConfig(num_robots=4, target_layout="random", orientation="heading_up")
    mirror = Symmetry(transpose=False, flip_x=symmetry.mirrors, flip_y=False)
    for scene in scenes(config, 20):
        mapped = views(config, symmetry.apply_to_scene(scene, config.size_px)).astype(int)
        gaps = np.abs(mapped - mirror.apply_to_images(views(config, scene)))
        assert gaps.max() <= 3


def test_actions_are_swapped_by_mirrors_only() -> None:
    actions = np.array([[0, 1, 2]], np.uint8)
    for symmetry in SYMMETRIES:
        expected = [[2, 1, 0]] if symmetry.mirrors else [[0, 1, 2]]
        assert symmetry.apply_to_actions(actions).tolist() == expected
    assert sum(s.mirrors for s in SYMMETRIES) == 4


@pytest.mark.parametrize("renderer", ["analytic", "literal"])
@pytest.mark.parametrize("orientation", ["unrotated", "heading_up"])
@pytest.mark.parametrize(("world", "record_bytes"), [({"num_robots": 3}, 60), (OBSTRUCTED, 116)])
def test_codecs_give_the_same_pixels(
    renderer: str, orientation: str, world: dict[str, Any], record_bytes: int
) -> None:
    base = {**world, "renderer": renderer, "orientation": orientation}
    config = ArenaConfig.model_validate({**base, "codec": "scene"})
    by_scene = make_codec(config)
    by_frame = make_codec(ArenaConfig.model_validate({**base, "codec": "frames"}))
    assert (by_scene.record_bytes, by_frame.record_bytes) == (record_bytes, 3600)
    assert config.record_bytes == record_bytes
    for scene in scenes(config, 5):
        one, other = (c.decode(c.encode(scene)) for c in (by_scene, by_frame))
        np.testing.assert_array_equal(one, other)


def test_literal_views_are_what_the_literal_codec_decodes() -> None:
    config = ArenaConfig(num_robots=4, renderer="literal")
    scene = scenes(config, 1)[0]
    rounded = Scene(scene.robots.astype(np.float32).astype(np.float64), scene.targets)
    np.testing.assert_array_equal(views(config, scene), literal_views(rounded, config))


def test_records_are_the_scene_as_each_robot_lists_it() -> None:
    config = ArenaConfig(num_robots=2)
    codec = make_codec(config)
    records = codec.encode(Scene(np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([[7.0, 8], [9, 10]])))
    assert records.dtype == np.uint8
    assert codec.record_bytes == 40
    assert records.view("<f4").tolist() == [
        [1, 2, 3, 4, 5, 6, 7, 8, 9, 10],
        [4, 5, 6, 1, 2, 3, 7, 8, 9, 10],
    ]


@pytest.mark.parametrize("kind", ["scene", "frames"])
def test_decode_keeps_leading_axes_and_fills_out(kind: str) -> None:
    config = ArenaConfig.model_validate({"codec": kind, "view_px": 32})
    codec = make_codec(config)
    records = codec.encode(scenes(config, 1)[0])
    expected = codec.decode(records)
    many = np.broadcast_to(records, (3, 5, *records.shape))  # read-only, and not contiguous
    out = np.full((3, 5, 2, 32, 32), 9, np.uint8)
    assert codec.decode(many, out) is out
    np.testing.assert_array_equal(out, np.broadcast_to(expected, out.shape))
    assert codec.decode(records[:0]).shape == (0, 32, 32)
    packed = np.frombuffer(b"x" + records.tobytes(), np.uint8)[1:].reshape(records.shape)
    np.testing.assert_array_equal(codec.decode(packed), expected)


@pytest.mark.parametrize("kind", ["scene", "frames"])
def test_decode_refuses_what_does_not_fit(kind: str) -> None:
    codec = make_codec(ArenaConfig.model_validate({"codec": kind}))
    records = np.zeros((2, codec.record_bytes), np.uint8)
    frozen = np.zeros((2, 60, 60), np.uint8)
    frozen.flags.writeable = False
    bad: Any
    for bad in (records[:, 1:], records.astype(np.float32)):
        with pytest.raises(ValueError, match="records are"):
            codec.decode(bad)
    for bad in (
        np.zeros((1, 60, 60), np.uint8),
        np.zeros((2, 60, 60), np.float32),
        np.zeros((2, 60, 120), np.uint8)[..., ::2],
        frozen,
    ):
        with pytest.raises(ValueError, match="out is"):
            codec.decode(records, bad)


@settings(max_examples=200, deadline=None)
@given(
    numbers=st.lists(st.floats(width=32), min_size=13, max_size=13),
    orientation=st.sampled_from(["unrotated", "heading_up"]),
)
def test_any_record_gives_some_image(numbers: list[float], orientation: str) -> None:
    config = ArenaConfig.model_validate({"orientation": orientation, "num_obstacles": 1})
    codec = make_codec(config)
    records = np.array(numbers, "<f4").view(np.uint8)
    assert codec.decode(records).shape == (60, 60)


@pytest.mark.parametrize("view_px", [31, 60, 255])
@pytest.mark.parametrize("crop_px", [50.0, 333.3, 5000.0])
def test_any_size_of_image(view_px: int, crop_px: float) -> None:
    for orientation in ("unrotated", "heading_up"):
        config = ArenaConfig.model_validate(
            {"view_px": view_px, "crop_px": crop_px, "orientation": orientation}
        )
        for scene in scenes(config, 3):
            assert views(config, scene).shape == (2, view_px, view_px)


def test_render_arena_uses_the_paper_colours() -> None:
    scene = Scene(np.array([[300.0, 300.0, 0.0]]), np.array([[100.0, 200.0]]))
    image = render_arena(scene, ArenaConfig(num_robots=1))
    assert image.shape == (600, 600, 3)
    assert image[11, 300].tolist() == [0, 0, 255]
    assert image[9, 300].tolist() == image[12, 300].tolist() == [0, 0, 0]
    assert image[200, 100].tolist() == [255, 0, 0]
    assert (image == (255, 0, 0)).all(axis=2).sum() == 900
    assert image[310, 300].tolist() == [255, 255, 255]
    assert image[300, 320].tolist() == [0, 0, 0]
    small = render_arena(scene, ArenaConfig(num_robots=1), 150, smooth=True)
    assert small.shape == (150, 150, 3)
    assert small[50, 25].tolist() == [255, 0, 0]


@pytest.mark.parametrize("noise", [0.0, 5.0])
@pytest.mark.parametrize("renderer", ["analytic", "literal"])
@given(st.data())
@settings(max_examples=20)
def test_any_bytes_of_a_record_decode_to_an_image(
    renderer: str, noise: float, data: st.DataObject
) -> None:
    """A peer may have sent them, and the learner renders them."""
    config = ArenaConfig.model_validate(
        {"renderer": renderer, "pixel_noise": noise, "num_obstacles": 1, "view_px": 40}
    )
    codec = make_codec(config)
    odd = st.sampled_from([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e19, 2**31, 1e5, 0.0, 1e-42])
    count = codec.record_bytes // 4
    numbers = data.draw(st.lists(odd | st.floats(width=32), min_size=count, max_size=count))
    records = np.array(numbers, "<f4").view(np.uint8)
    assert codec.decode(records).shape == (40, 40)
