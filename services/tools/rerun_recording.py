"""Records evaluation episodes for rerun's viewer: shapes and images, frame by frame.

Invariants: the timelines are `frame`, counted over all episodes, and `episode`; positions are px of
the arena, as in mrcdrl.common.arena.world.scene.
"""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mrcdrl.common.arena import Scene
from mrcdrl.common.arena.world.obstacles import inner_walls
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError, MrcdrlError
from mrcdrl.common.messages.trajectory import Float64Array
from mrcdrl.services.evaluator.trial import EpisodeResult
from mrcdrl.services.tools.episode_frames import moments

SUFFIX = ".rrd"
_BLACK, _WHITE = (0, 0, 0), (255, 255, 255)
_RED, _GREEN, _BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def check_rerun() -> None:
    """Raise ConfigError if rerun is not installed."""
    if importlib.util.find_spec("rerun") is None:
        raise ConfigError(
            f"{SUFFIX} needs rerun-sdk, which is not installed: pip install 'mrcdrl[rerun]'"
        )


def write_recording(path: Path, config: ArenaConfig, episodes: Sequence[EpisodeResult]) -> None:
    """Write these episodes, whose paths were kept, to an .rrd file.

    Raises MrcdrlError if it cannot be written; needs rerun.
    """
    import rerun

    with rerun.RecordingStream("mrcdrl") as recording:
        try:
            recording.save(path)
        except RuntimeError as error:
            raise MrcdrlError(f"recording {path} cannot be written: {error}") from error
        recording.set_log_time_enabled(False)
        recording.set_log_tick_enabled(False)
        half = config.wall_thickness_px / 2
        walls = rerun.LineStrips2D(_walls(config), radii=half, colors=_RED)
        recording.log("arena/walls", walls, static=True)
        for number, moment in enumerate(moments(config, episodes)):
            recording.set_time("frame", sequence=number)
            recording.set_time("episode", sequence=moment.episode)
            for name, shapes in _shapes(moment.scene, config).items():
                recording.log(f"arena/{name}", shapes)
            for robot, view in enumerate(moment.views, 1):
                recording.log(f"views/robot_{robot}", rerun.Image(view, "L"))
            if moment.ending:
                line = f"episode {moment.episode}: {moment.ending}"
                recording.log("outcome", rerun.TextLog(line))


def _walls(config: ArenaConfig) -> list[Float64Array]:
    """Centre lines of the walls, around the arena and within it."""
    near = config.wall_offset_px + config.wall_thickness_px / 2
    far = config.size_px - near
    around = [(near, near), (far, near), (far, far), (near, far), (near, near)]
    return [np.array(around), *inner_walls(config)[:, :4].reshape(-1, 2, 2)]


def _shapes(scene: Scene, config: ArenaConfig) -> dict[str, Any]:
    """The shapes of a scene as rerun archetypes, by name."""
    import rerun

    positions, headings = scene.robots[:, :2], scene.robots[:, 2]
    radius = config.robot_radius_px
    sizes = np.full_like(scene.targets, config.target_size_px)
    ahead = radius * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    names = [f"robot {robot}" for robot in range(1, len(positions) + 1)]
    return {
        "obstacles": rerun.Points2D(
            scene.obstacles[:, :2], radii=scene.obstacles[:, 2], colors=_GREEN
        ),
        "targets": rerun.Boxes2D(centers=scene.targets, sizes=sizes, colors=_BLUE),
        "robots": rerun.Points2D(
            positions, radii=radius, colors=_WHITE, labels=names, show_labels=False
        ),
        "headings": rerun.Arrows2D(origins=positions, vectors=ahead, colors=_BLACK),
    }
