"""Plays episodes of a custom world and shows them: as it renders itself, beside what is seen.

Invariants: nothing is kept but the frame that is shown; worlds that render nothing are shown by
what their agents see.
"""

from collections.abc import Callable, Iterator

import numpy as np

from mrcdrl.common.arena import CustomBatch, make_codec, test_starts
from mrcdrl.common.messages.trajectory import Outcome, UInt8Array
from mrcdrl.services.plots.film import compose_frame
from mrcdrl.services.tools.episode_frames import ENDING_FRAMES
from mrcdrl.services.tools.subject import Subject

_HEIGHT_PX = 480  # up to which the world's picture is enlarged


def world_frames(
    shown: Subject, episodes: int, seed: int, ended: Callable[[Outcome], None]
) -> Iterator[UInt8Array]:
    """Play the test's first episodes and yield images of them, uint8 BGR [H, W, 3], for a film.

    ended: called with the outcome of each.
    """
    arena = shown.config.arena
    codec, player, only = make_codec(arena), shown.player(seed), np.zeros(1, np.int64)
    worlds = CustomBatch(arena, [np.random.default_rng(seed)])

    def image(records: UInt8Array, caption: str) -> UInt8Array:
        picture = worlds.render(0)
        views = codec.decode(records.reshape(arena.num_robots, -1))
        return compose_frame(_large(picture), views, caption)

    for number, start in enumerate(test_starts(arena, episodes, seed), 1):
        first = worlds.reset(0, start)
        player.begin(0, first)
        frame, score = 0, 0.0
        yield image(first.records, _caption(number, episodes, frame, score))
        outcome: Outcome | None = None
        while outcome is None:
            steps = worlds.step(player.act(only, [worlds.scene(0)]), only)
            player.observe(only, steps.records)
            frame, outcome = frame + 1, steps.outcomes[0]
            score += float(steps.rewards.mean())
            caption = _caption(number, episodes, frame, score)
            if outcome is None:
                yield image(steps.records, caption)
                continue
            last = image(steps.records, f"{caption}   {outcome.value}")
            for _ in range(ENDING_FRAMES):
                yield last
            ended(outcome)


def _caption(number: int, episodes: int, frame: int, score: float) -> str:
    return f"episode {number} of {episodes}   frame {frame}   return {score:.1f}"


def _large(picture: UInt8Array | None) -> UInt8Array:
    """The world's RGB picture as BGR, enlarged by a whole factor; without one, no columns."""
    if picture is None:
        return np.zeros((_HEIGHT_PX, 0, 3), np.uint8)
    factor = max(1, _HEIGHT_PX // len(picture))
    bgr = picture[..., ::-1]
    return np.ascontiguousarray(bgr.repeat(factor, axis=0).repeat(factor, axis=1))
