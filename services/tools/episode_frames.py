"""Renders evaluation episodes: the arena beside the images that its robots see.

Invariants: rendered from poses, with the same kind of noise as the robots saw; no frame is dropped.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from mrcdrl.common.arena import Scene, make_codec, render_arena
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import UInt8Array
from mrcdrl.services.evaluator.trial import EpisodeResult
from mrcdrl.services.plots.film import compose_frame

_ARENA_PX = 600
ENDING_FRAMES = 20  # repeats of an episode's last frame


class Moment(NamedTuple):
    """One frame of an episode."""

    episode: int  # from 1
    frame: int  # from 0
    scene: Scene
    views: UInt8Array  # [K, V, V], the robots' images
    ending: str  # the outcome, in the last frame; else empty


def moments(config: ArenaConfig, episodes: Sequence[EpisodeResult]) -> Iterator[Moment]:
    """Yield all frames of these episodes in order."""
    for number, episode in enumerate(episodes, 1):
        codec = make_codec(config.with_robots(episode.robots.shape[1]))
        last = len(episode.robots) - 1
        for frame, robots in enumerate(episode.robots):
            scene = Scene(robots, episode.targets, episode.obstacles)
            noise_seeds = np.arange(len(robots), dtype=np.uint32) + frame * len(robots)
            views = codec.decode(codec.encode(scene, noise_seeds))
            ending = episode.outcome.value if frame == last else ""
            yield Moment(number, frame, scene, views, ending)


def num_film_frames(episodes: Sequence[EpisodeResult]) -> int:
    """The number of images that `film_frames` yields."""
    return sum(len(episode.robots) - 1 + ENDING_FRAMES for episode in episodes)


def film_frames(
    config: ArenaConfig, episodes: Sequence[EpisodeResult], note: str = ""
) -> Iterator[UInt8Array]:
    """Yield images uint8 BGR [H, W, 3] of all frames of these episodes, for a film.

    note: which episodes these are. Those with fewer robots than others have black images in place
    of absent ones'.
    """
    most = max((episode.robots.shape[1] for episode in episodes), default=0)
    for number, frame, scene, views, ending in moments(config, episodes):
        caption = f"episode {number} of {len(episodes)}   frame {frame}"
        if ending:
            caption += f"   {ending}"
        absent = np.zeros((most - len(views), *views.shape[1:]), np.uint8)
        shown = np.concatenate([views, absent])
        image = compose_frame(render_arena(scene, config, _ARENA_PX), shown, caption, note)
        for _ in range(ENDING_FRAMES if ending else 1):
            yield image
