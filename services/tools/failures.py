"""Failed episodes described: who hit what, why perhaps, and until when they could be saved.

Invariants: pure; replays are the caller's, who gives their results. Frame f is the scene before
the episode's action f, counted from 0; an episode of F frames ends with the scene of frame F.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mrcdrl.common.arena import Scene
from mrcdrl.common.arena.controllers import shortest_assignment
from mrcdrl.common.arena.controllers.heading import directions
from mrcdrl.common.arena.world.obstacles import inner_walls, outer_walls
from mrcdrl.common.arena.world.rewards import target_distances_px
from mrcdrl.common.config import ArenaConfig
from mrcdrl.common.messages.trajectory import BoolArray, Float64Array, Int64Array, Outcome
from mrcdrl.services.evaluator.trial import EpisodeResult

RECENT_FRAMES = 10  # before the end: exploring actions, and the way to a wanted target
LATE_FRAMES = 200  # before a time-out: who reached no target, and who circled
_CIRCLED = 0.25  # displacement over path length, below which a robot circled


@dataclass(frozen=True, slots=True)
class Contact:
    """What one or two robots ran into in an episode's last frame."""

    what: Literal["robot", "wall", "obstacle"]
    robots: tuple[int, ...]  # two that ran into each other, or the one that hit something fixed
    place_px: tuple[float, float]  # x, y where their rims met


@dataclass(frozen=True, slots=True)
class LateRobot:
    """A robot that was on its target in none of the last LATE_FRAMES of a time-out.

    Its target is that of the assignment with the least sum of distances at the end.
    """

    robot: int
    target: int
    distance_px: float  # to the target's centre at the end
    path_px: float  # driven in these frames
    displacement_px: float  # between their first and last place
    circled: bool  # displacement below a quarter of the path


@dataclass(frozen=True, slots=True)
class Failure:
    """One failed episode; a field is None where its question does not apply."""

    start: int  # number of the start, from 0
    outcome: Outcome
    frames: int  # when it ended
    contacts: tuple[Contact, ...]  # none at a time-out
    explored_before: bool | None
    """Whether exploration changed an action of a robot that collided, in its last 10 frames."""
    succeeds_without_exploration: bool
    """Whether the same start succeeds with epsilon 0."""
    savable: bool | None
    """Whether `safe_circle`, which sees the true state, succeeds from some frame of the path."""
    savable_until_frame: int | None
    """The last such frame, by bisection."""
    same_target: bool
    """Whether a robot that collided, at a time-out any robot, wanted another robot's target."""
    unseen: bool | None
    """Whether a robot that hit a robot had it outside one of its images: those of its last state,
    and that at the collision."""
    late_robots: tuple[LateRobot, ...]  # at a time-out only

    def hit(self, what: str) -> bool:
        """Whether a robot ran into this."""
        return any(contact.what == what for contact in self.contacts)


def failure(
    config: ArenaConfig,
    start: int,
    result: EpisodeResult,
    *,
    succeeds_without_exploration: bool,
    savable: bool | None,
    savable_until_frame: int | None,
) -> Failure:
    """Describe a failed episode whose path was kept, given the results of its replays."""
    collided = result.journey.hit_robot | result.journey.hit_wall
    timeout = result.outcome is Outcome.TIMEOUT
    met = () if timeout else contacts(config, result)
    pairs = [contact.robots for contact in met if contact.what == "robot"]
    wanted = wanted_targets(config, result.robots, result.targets)
    shared = (wanted[:, None] == wanted) & ~np.eye(len(wanted), dtype=np.bool_)
    return Failure(
        start=start,
        outcome=result.outcome,
        frames=result.frames,
        contacts=met,
        explored_before=None if timeout else bool(result.explored[-RECENT_FRAMES:, collided].any()),
        succeeds_without_exploration=succeeds_without_exploration,
        savable=savable,
        savable_until_frame=savable_until_frame,
        same_target=bool(shared[collided | timeout].any()),
        unseen=any(
            collided[i] and outside_images(config, result.robots, i, j).any()
            for one, other in pairs
            for i, j in ((one, other), (other, one))
        )
        if pairs
        else None,
        late_robots=late_robots(config, result) if timeout else (),
    )


def contacts(config: ArenaConfig, result: EpisodeResult) -> tuple[Contact, ...]:
    """What each robot ran into that collided in the last frame.

    Its move was undone, its turn was not: so its place in vain follows from its last pose. A robot
    that was stopped by another is paired with the nearest, at the place it tried or kept.
    """
    ends, hit_wall = result.robots[-1], result.journey.hit_wall
    collided = result.journey.hit_robot | hit_wall
    steps = np.where(collided[:, None], config.step_px * directions(ends[:, 2]), 0.0)
    tried = ends[:, :2] + steps
    met: dict[tuple[int, ...], Contact] = {}
    for i in np.flatnonzero(collided).tolist():
        if hit_wall[i]:
            what, place = _fixed_at(config, tried[i], result.obstacles)
            met[(i,)] = Contact(what, (i,), place)
            continue
        others = np.stack([tried, ends[:, :2]])  # [2, K, 2]
        apart = np.linalg.norm(others - tried[i], axis=2)
        apart[:, i] = np.inf
        kept, j = np.unravel_index(int(apart.argmin()), apart.shape)
        pair = (min(i, int(j)), max(i, int(j)))
        met.setdefault(pair, Contact("robot", pair, _point((tried[i] + others[kept, j]) / 2)))
    return tuple(met.values())


def _fixed_at(
    config: ArenaConfig, place: Float64Array, obstacles: Float64Array
) -> tuple[Literal["wall", "obstacle"], tuple[float, float]]:
    """The wall or obstacle nearest to a robot's place [2], and the point of its rim nearest to it.

    A disc is a wall of length 0.
    """
    discs = obstacles[:, [0, 1, 0, 1, 2]]
    fixed = np.concatenate([discs, outer_walls(config), inner_walls(config)])
    lines = fixed[:, 2:4] - fixed[:, :2]
    squares = np.maximum((lines * lines).sum(axis=1), 1e-12)
    fractions = ((place - fixed[:, :2]) * lines).sum(axis=1) / squares
    axes = fixed[:, :2] + np.clip(fractions, 0, 1)[:, None] * lines
    far = np.linalg.norm(place - axes, axis=1)
    i = int((far - fixed[:, 4]).argmin())
    rim = axes[i] + (place - axes[i]) * fixed[i, 4] / max(far[i], 1e-12)
    return ("obstacle" if i < len(discs) else "wall"), _point(rim)


def wanted_targets(config: ArenaConfig, path: Float64Array, targets: Float64Array) -> Int64Array:
    """The target [K] that each robot wanted at the end of a path [T, K, 3]: a guess from its way.

    A robot that is on a target, or circles (its displacement over the last 10 frames is at most
    half its way), wants the nearest; any other the one that it came nearest to, by px gained in
    these frames.
    """
    recent = path[-1 - RECENT_FRAMES :]
    before = target_distances_px(Scene(recent[0], targets))
    now = target_distances_px(Scene(recent[-1], targets))
    driven, moved = _ways_px(recent)
    stays = (now.min(axis=1) < config.success_radius_px) | (moved <= driven / 2)
    wanted = np.where(stays, now.argmin(axis=1), (before - now).argmax(axis=1))
    return np.asarray(wanted, np.int64)


def outside_images(config: ArenaConfig, path: Float64Array, robot: int, other: int) -> BoolArray:
    """Whether the other robot's disc lies wholly outside each of the robot's last images.

    These are the images of its last state, `arena.stack` of them, and the one at the end of the
    path [T, K, 3].
    """
    recent = path[-1 - config.stack :]
    poses = recent[:, robot]
    offsets = recent[:, other, :2] - poses[:, :2]
    if config.orientation == "heading_up":
        ahead = directions(poses[:, 2])
        right = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        offsets = np.stack([(offsets * right).sum(1), (offsets * ahead).sum(1)], axis=1)
    gaps = np.maximum(np.abs(offsets) - config.crop_px / 2, 0)
    return np.asarray(np.linalg.norm(gaps, axis=1) >= config.robot_radius_px, np.bool_)


def late_robots(config: ArenaConfig, result: EpisodeResult) -> tuple[LateRobot, ...]:
    """The robots that were on their target in none of the last frames."""
    recent = result.robots[-1 - LATE_FRAMES :]
    own = shortest_assignment(Scene(recent[-1], result.targets))
    distances = np.linalg.norm(recent[..., :2] - result.targets[own], axis=2)  # [T, K]
    driven, moved = _ways_px(recent)
    late = distances.min(axis=0) >= config.success_radius_px
    return tuple(
        LateRobot(
            robot=i,
            target=int(own[i]),
            distance_px=float(distances[-1, i]),
            path_px=float(driven[i]),
            displacement_px=float(moved[i]),
            circled=bool(moved[i] < _CIRCLED * driven[i]),
        )
        for i in np.flatnonzero(late).tolist()
    )


def last_savable_frames(
    ends: Sequence[int], saves: Callable[[Sequence[tuple[int, int]]], Sequence[bool]]
) -> list[int | None]:
    """The last frame of each episode from which it can be saved; None if from none that was tried.

    ends: the frames at which the episodes ended. saves: told pairs of an episode's index and a
    frame, says which can be saved. Bisection takes it that what can be saved at one frame could be
    saved at all before; it is asked for all episodes at once.
    """
    low, high = [-1] * len(ends), list(ends)
    while asked := [(i, (low[i] + high[i]) // 2) for i in range(len(ends)) if high[i] - low[i] > 1]:
        for (i, frame), saved in zip(asked, saves(asked), strict=True):
            (low if saved else high)[i] = frame
    return [frame if frame >= 0 else None for frame in low]


def _ways_px(path: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Length [K] of a path [T, K, 3], and displacement [K] from its first to its last place."""
    places = path[..., :2]
    driven = np.linalg.norm(np.diff(places, axis=0), axis=2).sum(axis=0)
    return driven, np.linalg.norm(places[-1] - places[0], axis=1)


def _point(place: Float64Array) -> tuple[float, float]:
    return float(place[0]), float(place[1])
