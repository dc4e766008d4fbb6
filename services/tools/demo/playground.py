"""One arena that a policy plays in, at the pace of a film, while somebody watches.

Who watches may move robots and targets, change how many robots there are, or ask for a new start. A
change begins an episode from the changed scene. The test's rules hold: one collision ends it.

Invariants: the event loop asks and publishes, one thread at a time plays; while nobody watches,
nothing is played; what cannot be done is told, and changes nothing.
"""

import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import anyio
import numpy as np
from anyio.to_thread import run_sync

from mrcdrl.common.arena import ArenaBatch, Scene, Start, make_codec, test_starts
from mrcdrl.common.arena.world.obstacles import reachable_px
from mrcdrl.common.config.schema import MOST_ROBOTS
from mrcdrl.common.errors import MrcdrlError
from mrcdrl.common.messages.trajectory import (
    NUM_ACTIONS,
    ArenaFrame,
    BoolArray,
    Float32Array,
    Outcome,
    TimeStep,
    UInt8Array,
)
from mrcdrl.common.sync.broadcast import FRAMES_PER_S
from mrcdrl.services.evaluator.trial import PolicyPlayer
from mrcdrl.services.tools.subject import Subject
from mrcdrl.services.web.view import arena_view, frame_view
from mrcdrl.services.web.viewers import Channel, encoded

PAUSE_FRAMES = 18  # after an episode's end
MAX_CHANGES = 32  # that wait for the next frame
_IDLE_S = 0.1
_ONLY = np.zeros(1, np.int64)  # the arena
_NO_VALUES: Float32Array = np.zeros((0, NUM_ACTIONS), np.float32)
_NO_ACTIONS: UInt8Array = np.zeros(0, np.uint8)

Event = tuple[str, dict[str, Any]]  # name and values


@dataclass(frozen=True, slots=True)
class Cast:
    """Who plays, and where."""

    subject: Subject
    name: str  # of the weights
    trained_with: tuple[int, ...]  # numbers of robots; empty if that is not known


class Playground:
    """An arena, the policy that plays in it, and who watches."""

    def __init__(self, cast: Callable[[int], Cast], num_robots: int, seed: int) -> None:
        """cast: the policy and its arena for a number of robots; may raise MrcdrlError."""
        self.channel = Channel()
        self._cast = cast
        self._rng = np.random.default_rng(seed)
        self._changes: list[Callable[[], None]] = [lambda: self._set_robots(num_robots)]
        self._game: _Game | None = None
        self._pause = 0  # frames until the next start
        self._told: Event | None = None

    def __repr__(self) -> str:
        return f"Playground({self._game}, viewers={len(self.channel)})"

    def move(self, thing: str, index: int, x: float, y: float) -> None:
        """Ask for a robot or a target to be put at a place in px, or as near as robots can be."""
        self._ask(lambda: self._move(thing, index, x, y))

    def set_robots(self, number: int) -> None:
        """Ask for this number of robots, at a new start."""
        self._ask(lambda: self._set_robots(number))

    def restart(self) -> None:
        """Ask for a new start."""
        self._ask(self._restart)

    async def play(self) -> None:
        """Play until cancelled."""
        due_s = 0.0
        while True:
            await anyio.sleep(max(0.0, due_s - time.monotonic()))
            due_s = max(due_s + 1 / FRAMES_PER_S, time.monotonic())
            if not len(self.channel):
                await anyio.sleep(_IDLE_S)
                continue
            for name, values in await run_sync(self._advance):
                self.channel.publish(name, encoded(name, values))

    def _ask(self, change: Callable[[], None]) -> None:
        if len(self._changes) < MAX_CHANGES:
            self._changes.append(change)

    def _advance(self) -> list[Event]:
        """Make the changes asked for, play one frame, and say what there is to see."""
        events: list[Event] = []
        changes, self._changes = self._changes, []
        for change in changes:
            try:
                change()
            except MrcdrlError as error:
                if self._game is None:
                    raise
                events.append(("refused", {"why": str(error)}))
        game = self._game
        if game is None:
            raise RuntimeError("there is no arena")
        if self._pause:
            self._pause -= 1
            if not self._pause:
                self._restart()
        else:
            events.append(("frame", frame_view(game.next_frame())))
            if game.outcome is not None:
                self._pause = PAUSE_FRAMES
        told = ("about", game.about())
        if told != self._told:
            events.insert(0, told)
            self._told = told
        return events

    def _set_robots(self, number: int) -> None:
        if not 1 <= number <= MOST_ROBOTS:
            raise MrcdrlError(f"an arena has 1 to {MOST_ROBOTS} robots")
        self._game = _Game(self._cast(number), self._seed())
        self._restart()

    def _restart(self) -> None:
        if self._game is not None:
            self._game.begin(self._seed())
        self._pause = 0

    def _move(self, thing: str, index: int, x: float, y: float) -> None:
        if self._game is not None:
            self._game.move(thing, index, x, y)
        self._pause = 0

    def _seed(self) -> int:
        return int(self._rng.integers(2**31))


class _Game:
    """Episodes of one number of robots."""

    def __init__(self, cast: Cast, seed: int) -> None:
        rng, subject = np.random.default_rng(seed), cast.subject
        self._cast, self._arena = cast, subject.config.arena
        if subject.policy is None:
            raise ValueError("a playground shows a policy")
        epsilon = subject.config.evaluator.epsilon
        self._player = PolicyPlayer(
            self._arena, make_codec(self._arena), subject.policy, epsilon, rng
        )
        self._arenas = ArenaBatch(self._arena, [rng], max_collisions=1)
        self._episode, self._frame = 0, 0
        self._collided: BoolArray = np.zeros(self._arena.num_robots, np.bool_)
        self._outcomes: Counter[str] = Counter()  # of episodes from starts that nobody changed
        self._changed = False  # by hand, since the last start
        self._last: Outcome | None = None  # of the frame that is shown next
        self.outcome: Outcome | None = None  # of the frame shown last

    def __repr__(self) -> str:
        return f"{self._arena.num_robots} robots, episode {self._episode}, frame {self._frame}"

    def about(self) -> dict[str, Any]:
        """What is played, and how it went."""
        return {
            "robots": self._arena.num_robots,
            "most_robots": MOST_ROBOTS,
            "weights": self._cast.name,
            "trained_with": list(self._cast.trained_with),
            "layout": self._arena.target_layout,
            "arena": arena_view(self._arena),
            "successes": self._outcomes[Outcome.SUCCESS],
            "episodes": self._outcomes.total(),
        }

    def begin(self, seed: int) -> None:
        """Begin an episode from a start of the paper's test."""
        (start,) = test_starts(self._arena, 1, seed)
        self._begin(start)
        self._changed = False

    def move(self, thing: str, index: int, x: float, y: float) -> None:
        """Begin an episode from this scene with a robot or target at another place.

        Raises MrcdrlError if there is no such thing, or if a robot would overlap something.
        """
        scene, place = self._arenas.scene(0), np.clip([x, y], *reachable_px(self._arena))
        moved = {"robot": scene.robots, "target": scene.targets}.get(thing)
        if moved is None or not 0 <= index < len(moved):
            raise MrcdrlError(f"there is no {thing} {index + 1}")
        before = moved[index, :2].copy()
        moved[index, :2] = place
        start = Start(scene.robots, scene.targets, scene.obstacles)
        try:
            self._begin(start)
        except ValueError as error:
            moved[index, :2] = before
            self._begin(start)
            raise MrcdrlError(f"it cannot stand there: {error}") from error
        self._changed = True

    def next_frame(self) -> ArenaFrame:
        """The scene with the actions chosen in it, which are then played; at last, what was left.

        After a frame with an outcome call `begin` or `move`.
        """
        scene = self._arenas.scene(0)
        if self.outcome is not None:
            raise ValueError("the episode has ended")
        if self._last is not None:
            self.outcome = self._last
            if not self._changed:
                self._outcomes[self.outcome] += 1
            return self._shown(scene, _NO_VALUES, _NO_ACTIONS, self.outcome)
        actions = self._player.act(_ONLY, [scene])
        shown = self._shown(scene, self._player.first_q_values, actions[0], "")
        steps = self._arenas.step(actions, _ONLY)
        self._player.observe(_ONLY, steps.records)
        self._frame += 1
        self._collided, self._last = steps.collided[0], steps.outcomes[0]
        return shown

    def _begin(self, start: Start) -> None:
        first: TimeStep = self._arenas.reset(0, start)
        self._player.begin(0, first)
        self._episode += 1
        self._frame = 0
        self._collided = np.zeros(self._arena.num_robots, np.bool_)
        self.outcome = self._last = None

    def _shown(
        self, scene: Scene, q_values: Float32Array, actions: UInt8Array, outcome: str
    ) -> ArenaFrame:
        images = np.ascontiguousarray(self._player.first_images)
        return ArenaFrame(
            role="demo",
            worker=self._cast.name,
            arena=0,
            episode=self._episode,
            frame=self._frame,
            weights_version=self._cast.subject.weights.version,
            epsilon=self._player.epsilon,
            robots=scene.robots.astype(np.float32),
            targets=scene.targets.astype(np.float32),
            obstacles=scene.obstacles.astype(np.float32),
            q_values=q_values,
            actions=actions.astype(np.uint8),
            collided=self._collided.astype(np.uint8),
            outcome=outcome,
            view_px=self._arena.view_px,
            images=zlib.compress(images.tobytes(), 1),
        )
