"""`mrcdrl figure`: plot the paper's figures of any run, weights or controller."""

import argparse
import copy
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from mrcdrl.common.arena import Scene, literal_views, make_codec, render_arena, test_starts
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.errors import ConfigError
from mrcdrl.common.messages.trajectory import Float64Array, Outcome, UInt8Array
from mrcdrl.common.runtime.files import prepare_output
from mrcdrl.common.runtime.runs import find_run, find_weights
from mrcdrl.services.evaluator.trial import EpisodeResult
from mrcdrl.services.plots.figures import Path2D, check_suffix, trajectories
from mrcdrl.services.plots.paper import (
    SUFFIXES,
    Contender,
    Sight,
    arenas,
    comparison,
    curves,
    sight,
)
from mrcdrl.services.tools import flags
from mrcdrl.services.tools.progress import Done, Progress
from mrcdrl.services.tools.subject import Subject, config_without_weights, controlled, subject

_ARENA_PX = 900
_INTENSITY_WEIGHTS = (0.114, 0.587, 0.299)  # OpenCV's, for blue, green and red
# Fields that must agree for a comparison; rewards and images may differ between policies.
_WORLD = (
    "num_robots", "robots", "size_px", "wall_offset_px", "wall_thickness_px", "robot_radius_px",
    "target_size_px", "turn_deg", "step_px", "target_layout", "targets_px",
    "success_radius_px", "back_off_frames", "max_frames",
)  # fmt: skip


def main(argv: Sequence[str]) -> int:
    """Write the figure; return the exit code."""
    arguments = flags.figure().parse_args(argv)
    check_suffix(arguments.out, SUFFIXES)
    prepare_output(arguments.out)
    with Progress() as progress:
        _FIGURES[arguments.figure](arguments, progress)
    print(arguments.out)
    return 0


def _arena(arguments: argparse.Namespace, _progress: Progress) -> None:
    """Draw a test start in the arena of each subject, or of --config if there is none."""
    named = [shown.config for shown in _subjects(arguments)] or [config_without_weights(arguments)]
    configs = [one.arena for config in named for one in config.each_number()]
    draw_arenas(configs, arguments.seed, arguments.out)


def draw_arenas(configs: Sequence[ArenaConfig], seed: int, *outs: Path) -> None:
    """Draw the first test start of each arena (Fig. 1)."""
    images, obstacles = [], False
    for config in configs:
        (start,) = test_starts(config, 1, seed)
        obstacles |= len(start.obstacles) > 0
        scene = Scene(start.robots, start.targets, start.obstacles)
        images.append(render_arena(scene, config, _ARENA_PX, smooth=True))
    titles = [f"{c.num_robots} robot{'s' * (c.num_robots != 1)}" for c in configs]
    arenas(images, titles, *outs, obstacles=obstacles)


def _views(arguments: argparse.Namespace, progress: Progress) -> None:
    """Show what the lowermost robot sees (Fig. 3)."""
    shown, done = _one(arguments), progress.stage("the episode")
    draw_views(shown, arguments.seed, arguments.frame, done, arguments.out)


def draw_views(shown: Subject, seed: int, at_frame: int, report: Done, *outs: Path) -> None:
    """Show what the lowermost robot sees in that frame of an episode (Fig. 3)."""
    (episode,) = shown.episodes(1, seed, report)
    config = shown.config.arena.with_robots(episode.robots.shape[1])
    frame = min(at_frame, episode.frames)
    before = range(frame - config.stack + 1, frame + 1)
    targets, obstacles = episode.targets, episode.obstacles
    scenes = [Scene(episode.robots[max(0, at)], targets, obstacles) for at in before]
    robot = int(scenes[-1].robots[:, 1].argmax())
    codec = make_codec(config)
    states = np.stack([codec.decode(codec.encode(scene)) for scene in scenes], axis=1)
    seen = Sight(
        arena=_intensities(scenes[-1], config),
        pose=scenes[-1].robots[robot],
        view=literal_views(scenes[-1], config)[robot],
        states=states,
    )
    sight(seen, config, *outs)


def _trajectories(arguments: argparse.Namespace, progress: Progress) -> None:
    shown = _one(arguments)
    num = arguments.episodes or 12
    episodes = shown.episodes(num, arguments.seed, progress.stage("episodes", num))
    progress.stage(arguments.out.name)
    trajectories(paths_of(episodes), shown.config.arena, arguments.out)


def _comparison(arguments: argparse.Namespace, progress: Progress) -> None:
    """Compare policies; raise ConfigError, naming the field, if their arenas differ."""
    subjects = _subjects(arguments)
    if len(subjects) < 2:
        raise ConfigError("a comparison takes at least two weights or controllers")
    world = subjects[0].config.arena
    for other in subjects[1:]:
        for name in _WORLD:
            if getattr(other.config.arena, name) != getattr(world, name):
                raise ConfigError(f"different arenas: arena.{name} differs; give --arena.{name}")
    num = arguments.episodes or 4
    rows = []
    for name, shown in zip(_names(arguments), subjects, strict=True):
        done = progress.stage(f"episodes of {name}", num)
        episodes = shown.episodes(num, arguments.seed, done)
        won = sum(episode.outcome is Outcome.SUCCESS for episode in episodes)
        rows.append(Contender(f"{name}: {won} of {len(episodes)}", paths_of(episodes)))
    progress.stage(arguments.out.name)
    comparison(rows, world, arguments.out)


def _curves(arguments: argparse.Namespace, _progress: Progress) -> None:
    """Plot the records of runs; no episode is played."""
    if not arguments.weights or arguments.controller:
        raise ConfigError("curves takes run directories only")
    curves([find_run(run, arguments.run_dir) for run in arguments.weights], arguments.out)


_FIGURES: dict[str, Callable[[argparse.Namespace, Progress], None]] = {
    "arena": _arena,
    "views": _views,
    "trajectories": _trajectories,
    "comparison": _comparison,
    "curves": _curves,
}


def _subjects(arguments: argparse.Namespace) -> list[Subject]:
    """The subjects named, weights first; controllers play in the arena of the first."""
    subjects = []
    for word in arguments.weights:
        alone = copy.copy(arguments)
        alone.weights, alone.controller = word, None
        subjects.append(subject(alone))
    config = subjects[0].config if subjects else config_without_weights(arguments)
    return subjects + [controlled(name, config) for name in arguments.controller]


def _one(arguments: argparse.Namespace) -> Subject:
    if len(arguments.weights) + len(arguments.controller) != 1:
        raise ConfigError(f"{arguments.figure} takes one: either weights or --controller")
    return _subjects(arguments)[0]


def _names(arguments: argparse.Namespace) -> list[str]:
    paths = [find_weights(word, arguments.run_dir) for word in arguments.weights]
    return [*(path.resolve().stem for path in paths), *arguments.controller]


def paths_of(episodes: Sequence[EpisodeResult]) -> list[Path2D]:
    """The paths of episodes that were kept, as they are plotted."""
    return [Path2D(e.robots, e.targets, e.obstacles, e.outcome) for e in episodes]


def _intensities(scene: Scene, config: ArenaConfig) -> UInt8Array:
    image = render_arena(scene, config, config.size_px)
    intensities: Float64Array = image @ np.array(_INTENSITY_WEIGHTS)
    return np.rint(intensities).astype(np.uint8)
