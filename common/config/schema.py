"""The configuration's schema: a frozen section for each part, every field with its source.

A default is the paper's where the paper gives one ("paper"), that of the game it descends from
where that settles it ("ancestor"), and ours otherwise ("ours").
"""

import ipaddress
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self, cast

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)

_NO_PATH = re.compile(r"[\x00\ud800-\udfff]")  # NUL, and bytes that are no UTF-8
_FINEST_PX = 2.5  # arena px per image px; below, the literal renderer draws

_LONGEST_S = 1e9  # thirty years; the system's waits overflow beyond nine times that
LARGEST = 2**63 - 1  # whole number that TOML, torch and the wire all take
MOST_ROBOTS = 10
MOST_ACTIONS = 64
_WORLD = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")  # package.module:make

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0, le=LARGEST)]
Seconds = Annotated[float, Field(gt=0, le=_LONGEST_S)]
Pause = Annotated[float, Field(ge=0, le=_LONGEST_S)]  # in seconds
Schedule = tuple[tuple[int, float], ...]  # points (learner step, value)
Reward = Annotated[float, Field(ge=-1e6, le=1e6)]  # sums of them are exact enough in float32


@dataclass(frozen=True, slots=True)
class Kept:
    """Marks a setting that a resumed run keeps: its stored transitions or weights depend on it."""

    in_lockstep: bool = False  # only where run.turn_size makes the numbers depend on it


class Section(BaseModel):
    """A section of the configuration: frozen, finite, and strict about names."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False
    )
    kept: ClassVar[bool] = False  # whether a resumed run keeps all of its settings

    @field_validator("*", mode="before")
    @classmethod
    def _check_given(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false for a number, which Python counts as 1 and 0, and odd text."""
        kind = cls.model_fields[str(info.field_name)].annotation
        if isinstance(value, bool) and kind in (int, float):
            raise ValueError("must be a number")
        if kind is str and isinstance(value, str) and _NO_PATH.search(value):
            raise ValueError("must be text in UTF-8, without NUL")
        return value


class ArenaConfig(Section):
    """The 2-D world, its rewards and its images (paper sections 3 and 4)."""

    kept: ClassVar[bool] = True
    kind: Literal["robots", "counting", "custom"] = "robots"
    """`robots`: the paper's arena. `counting`: images that encode actor, episode and step, for
    tests of the data path. `custom`: the world that env names, which sets this. (ours)"""
    env: str = ""
    """A world of your own, package.module:make, where make() returns a PettingZoo ParallelEnv or a
    Gymnasium environment; empty: the paper's arena. (ours)"""
    num_actions: Annotated[int, Field(ge=0, le=MOST_ACTIONS)] = 0
    """Actions of a custom world; 0: found out from the world, with num_robots, before a run starts.
    (ours)"""
    largest_reward: Annotated[float, Field(gt=0, le=1e6)] = 100.0
    """Greatest absolute reward of a custom world's step; a greater one ends the run. (ours)"""
    physics: Literal["array", "pymunk"] = "array"
    """Physics engine: compiled arrays, or pymunk, the reference; both give the same poses.
    (ours; ancestor: pymunk)"""
    num_robots: Annotated[int, Field(ge=1, le=MOST_ROBOTS)] = 2
    """Robots in every episode; if arena.robots is set, its greatest number. (paper: 2, 3, 4)"""
    robots: tuple[int, ...] = ()
    """Numbers of robots, such as [1, 2, 4], in rising order: each episode of training draws one, by
    the weights of [curriculum], and evaluations test each apart; empty: always num_robots. Of
    num_robots and robots, give one. (ours)"""
    num_targets: Annotated[int, Field(ge=0, le=20)] = 0
    """Targets; every robot needs one; 0: as many as the episode has robots. (paper: as many as
    robots)"""
    size_px: Annotated[int, Field(ge=120)] = 600
    """Width and height of the square arena. (paper)"""
    wall_offset_px: Annotated[float, Field(ge=0)] = 10
    """Distance from the border to the wall's outer face. (paper)"""
    wall_thickness_px: Positive = 2
    """Thickness of the walls. (paper)"""
    robot_radius_px: Positive = 25
    """Radius of a robot, c_r. (paper)"""
    target_size_px: Positive = 30
    """Side of a square target, s_w = s_h. (paper)"""
    turn_deg: Annotated[float, Field(ge=0.1, lt=180)] = 23
    """Angle that a `left` or `right` action turns. (paper)"""
    step_px: Positive = 2.5
    """Distance that every action moves, after its turn. (paper; ancestor: a turn moves too)"""
    target_layout: Literal["fixed", "random"] = "fixed"
    """`fixed`: one layout for each number of robots; `random`: a new one each episode. (ours: the
    paper calls only the robots' start random)"""
    targets_px: tuple[tuple[float, float], ...] = ()
    """Target centres (x, y) instead of the built-in fixed layout. (ours)"""
    obstacles_px: tuple[tuple[float, float, float], ...] = ()
    """Discs (x, y, radius) that stop robots as walls do. (ours)"""
    num_obstacles: Annotated[int, Field(ge=0, le=20)] = 0
    """Further discs at random places, new each episode; robots can always pass between them.
    (ours)"""
    obstacle_radius_px: Positive = 30
    """Radius of the random discs. (ours)"""
    inner_walls_px: tuple[tuple[float, float, float, float], ...] = ()
    """Inner walls (x, y, x, y) between two points, as thick as the outer ones. (ours)"""
    failure_probability: Fraction = 0
    """Probability, for each robot and frame, that it fails: it then stands still to the episode's
    end, and success counts the others; the last one never fails. (ours)"""
    success_radius_px: Positive = 20
    """delta: success is each robot within this distance of a different target. (paper)"""
    max_collisions: Count = 5
    """Robot collisions that end a training episode in failure; the test ends at 1. (paper)"""
    back_off_frames: Annotated[int, Field(ge=0)] = 0
    """Frames that a robot drives backwards after a collision; 0: its move is undone instead.
    (ancestor: 10)"""
    success_reward: Reward = 200
    """Reward to each robot. (paper)"""
    collision_reward: Reward = -5
    """Reward for a collision. (paper)"""
    step_reward: Reward = 0.03
    """Reward off target and without a collision. (paper)"""
    proximity_weight: Fraction = 0.7
    """p in r = r_chi p + r_f (1 - p). (paper, Fig. 5)"""
    f_max: Count = 500
    """Frames after which r_f is 0. (ours: the paper names f_max, not its value)"""
    max_frames: Count = 1000
    """Frames after which an episode is truncated (and bootstrapped). (ours)"""
    view_px: Annotated[int, Field(ge=31, le=255)] = 60
    """Width and height of a robot's image. (paper)"""
    crop_px: Annotated[float, Field(ge=1)] = 600
    """w = h of the square cut out around the robot. (ours: not given; 600 shows the half around
    it)"""
    orientation: Literal["unrotated", "heading_up"] = "unrotated"
    """Orientation of the cut-out. (paper names no rotation; heading_up is ours)"""
    stack: Annotated[int, Field(ge=1, le=16)] = 4
    """Consecutive images that make a state. (paper)"""
    renderer: Literal["analytic", "literal"] = "analytic"
    """`literal` draws at 600x600, converts to intensity, crops, pads and area-resizes as the paper
    does; `analytic` computes the same coverage directly at 60x60, but draws as `literal` does where
    an image's pixel is less than 2.5 px of the arena, and single pixels show. (ours)"""
    pixel_noise: Annotated[float, Field(ge=0)] = 0
    """Standard deviation of the noise on every pixel of a robot's image, in intensity levels.
    (ours)"""
    dropped_frame_probability: Annotated[float, Field(ge=0, lt=1)] = 0
    """Probability, for each robot and frame, that it sees its previous image again. (ours)"""
    codec: Literal["scene", "frames"] = "scene"
    """Content of a record: poses from which the image is rendered, or its pixels. (ours)"""

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of robots that an episode may have, rising; the last one is num_robots."""
        return self.robots or (self.num_robots,)

    @property
    def mixes_numbers(self) -> bool:
        """Whether the number of robots differs between episodes."""
        return len(self.numbers) > 1

    def with_robots(self, number: int) -> Self:
        """The same arena with this number of robots in every episode."""
        if self.numbers == (number,):
            return self
        return self.model_copy(update={"num_robots": number, "robots": ()})

    @property
    def target_count(self) -> int:
        """Greatest number of targets in an episode."""
        return self.num_targets or self.num_robots

    @property
    def obstacle_count(self) -> int:
        """Number of discs in an episode."""
        return len(self.obstacles_px) + self.num_obstacles

    @property
    def is_custom(self) -> bool:
        """Whether this is a world that somebody else wrote."""
        return self.kind == "custom"

    @property
    def action_count(self) -> int:
        """Number of actions; 0 for a custom world that nobody has asked yet."""
        return self.num_actions if self.is_custom else 3  # left, straight, right

    @property
    def renders_analytically(self) -> bool:
        """Whether images are computed from the poses."""
        return self.renderer == "analytic" and self.crop_px >= _FINEST_PX * self.view_px

    @property
    def record_bytes(self) -> int:
        """Length of one observation record: pixels, or the scene they are rendered from."""
        if self.codec == "frames":
            return self.view_px * self.view_px
        layout = 2 * self.target_count + 3 * self.obstacle_count
        return 4 * (3 * self.num_robots + layout + bool(self.pixel_noise))

    @model_validator(mode="before")
    @classmethod
    def _derive_num_robots(cls, given: Any) -> Any:
        """Let robots alone decide, where num_robots is not given."""
        robots = given.get("robots") if isinstance(given, dict) else None
        if isinstance(robots, (list, tuple)) and robots and "num_robots" not in given:
            return {**given, "num_robots": robots[-1]}
        return given

    @model_validator(mode="before")
    @classmethod
    def _derive_custom(cls, given: Any) -> Any:
        """Let env alone decide on a custom world, where kind and codec are not given."""
        if isinstance(given, dict) and given.get("env"):
            return {"kind": "custom", "codec": "frames", **given}
        return given

    @field_validator("env")
    @classmethod
    def _check_env(cls, value: str) -> str:
        if value and not _WORLD.fullmatch(value):
            raise ValueError("name a module and what makes the world in it: package.module:make")
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        self._check_robots()
        self._check_custom()
        inner = self.size_px - 2 * (self.wall_offset_px + self.wall_thickness_px)
        if inner < 2 * self.robot_radius_px:
            raise ValueError(
                f"no robot of radius {self.robot_radius_px} px fits inside walls {inner} px apart"
            )
        if self.target_size_px > self.size_px:
            raise ValueError(
                f"target_size_px {self.target_size_px:g} exceeds size_px {self.size_px}: a target "
                "would cover the arena"
            )
        if self.target_count < self.num_robots:
            raise ValueError(
                f"num_targets {self.num_targets} leaves {self.num_robots} robots without a target "
                "each; give at least one a robot, or 0"
            )
        if self.targets_px and len(self.targets_px) != self.target_count:
            raise ValueError(
                f"targets_px has {len(self.targets_px)} targets for {self.num_robots} robots; "
                f"give {self.target_count}"
                + (", one a robot, or set num_targets" if not self.num_targets else "")
            )
        if (self.obstacle_count or self.inner_walls_px) and (
            self.step_px >= 2 * self.robot_radius_px
        ):
            raise ValueError(
                f"step_px {self.step_px:g} is not below a robot's width: it would jump over "
                "obstacles and inner walls"
            )
        if any(radius <= 0 for _, _, radius in self.obstacles_px):
            raise ValueError("obstacles_px has a radius that is not above 0")
        if any(wall[:2] == wall[2:] for wall in self.inner_walls_px):
            raise ValueError("inner_walls_px has a wall without length: give two different points")
        if self.codec == "scene" and self.kind == "counting":
            raise ValueError(
                'kind = "counting" encodes its counters in pixels: set codec = "frames"'
            )
        return self

    def _check_custom(self) -> None:
        """Raise ValueError if settings of a custom world are missing, or given without one."""
        if self.is_custom != bool(self.env):
            raise ValueError(
                f'kind = "{self.kind}" with env "{self.env}": a custom world needs env, such as '
                '"package.module:make", and kind = "custom", which follows from it'
            )
        if self.is_custom and self.codec != "frames":
            raise ValueError('a custom world has no scene to send: set codec = "frames"')
        if self.num_actions and not self.is_custom:
            raise ValueError(f"num_actions {self.num_actions} is of a custom world: give env too")
        if self.num_actions == 1:
            raise ValueError("num_actions 1 leaves nothing to choose")

    def _check_robots(self) -> None:
        """Raise ValueError if robots and the settings that depend on it do not fit."""
        numbers = self.numbers
        if list(numbers) != sorted(set(numbers)) or numbers[0] < 1:
            raise ValueError(f"robots {list(numbers)} do not rise from 1 or more")
        if numbers[-1] != self.num_robots:
            raise ValueError(
                f"num_robots {self.num_robots} is not the last of robots {list(numbers)}; give one "
                "of the two"
            )
        if self.mixes_numbers and self.kind != "robots":
            raise ValueError(f'kind = "{self.kind}" needs a fixed number of robots, num_robots')
        if self.mixes_numbers and self.targets_px and not self.num_targets:
            raise ValueError(
                f"targets_px has the same {len(self.targets_px)} targets for each of robots "
                f"{list(numbers)}: set num_targets too"
            )


class AgentConfig(Section):
    """The network and its update (paper sections 4 and 5.2)."""

    kind: Annotated[Literal["duel", "ddqn", "dqn"], Kept()] = "duel"
    """`duel`: double DQN, target (2), with the two streams (1). `ddqn`: double DQN. `dqn`: DQN,
    target (4). (paper)"""
    gamma: Annotated[float, Field(gt=0, lt=1), Kept()] = 0.99
    """Discount of rewards for each step that they are away. (paper)"""
    n_step: Annotated[int, Field(ge=1, le=32), Kept()] = 1
    """Rewards summed before the bootstrap. (paper: 1; Ape-X: 3)"""
    symmetric_views: Annotated[int, Field(ge=1, le=8)] = 1
    """Evaluators, `mrcdrl evaluate` and robots act by the mean of the values of up to so many views
    of a state, mapped by symmetries of the layout. A network has not quite learned that these are
    alike. Each view costs an inference. Actors act by one. (paper: 1)"""
    shaping_per_px: Annotated[float, Field(ge=0, le=1000), Kept()] = 0.0
    """Potential that a robot loses with each px between it and its target, by the assignment with
    the least sum of distances. Learned from are then rewards with gamma Phi(s') - Phi(s) added;
    scores and the test never see it. 0: none. (ours; Ng et al. 1999)"""
    shaping_schedule: Annotated[Schedule, Kept()] = ((0, 1.0),)
    """Points (learner step of the weights that act, factor 0 to 1 of shaping_per_px), linear
    between, constant after the last. (ours; Devlin and Kudenko 2012)"""
    collision_schedule: Annotated[Schedule, Kept()] = ((0, 1.0),)
    """Points (learner step of the weights that act, factor 0 to 100 of arena.collision_reward in
    the rewards learned from), linear between, constant after the last. (ours)"""
    occupied_targets_pay: Annotated[bool, Kept()] = True
    """Whether a robot also learns from what it is paid on a target that another robot is nearer to;
    without, such a frame counts as one off target. (paper: true)"""
    demonstrator: Literal["none", "potential_field"] = "none"
    """`potential_field`: in every sampled state the network is also drawn to the action of that
    controller, **which sees the true state**, by a margin (Hester et al. 2018). The states are the
    learner's own (Ross et al. 2011). The test never sees it. (ours)"""
    demonstration_margin: Positive = 0.2
    """Amount by which the value of the action shown is to exceed the others', in scaled rewards.
    (ours; DQfD: 0.8)"""
    demonstration_schedule: Schedule = ((0, 1.0),)
    """Points (learner step, weight 0 to 100 of the margin's loss), linear between, constant after
    the last. (ours; DQfD: 1)"""
    reward_scale: Annotated[Positive, Kept()] = 1.0
    """Factor on the rewards in the learner's target. (ours)"""
    loss: Literal["squared", "huber"] = "squared"
    """Loss of the TD error, Eq. (3). (paper: squared)"""
    munchausen_alpha: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Part of the action's log-probability that is added to the target, by the target network's
    softmax policy, which also makes the bootstrap soft; 0: none. (ours; Munchausen paper: 0.9)"""
    munchausen_temperature: Annotated[float, Field(ge=0)] = 0.03
    """Temperature of that policy, in scaled rewards; 0 is advantage learning: the part is of
    Q(s, a) - max Q(s, .), and the bootstrap stays hard. (Munchausen paper)"""
    munchausen_clip: Positive = 1.0
    """Temperature times log-probability, or the advantage, counts as no less than minus this, in
    scaled rewards. (Munchausen paper; advantage learning: never)"""
    optimizer: Annotated[Literal["adam", "rmsprop"], Kept()] = "adam"
    """Optimizer of the gradient step. (ours; ancestor: rmsprop)"""
    learning_rate: Positive = 1e-4
    """Step size of the optimizer. (ours)"""
    learning_rate_schedule: Schedule = ((0, 1.0),)
    """Points (learner step, factor of learning_rate), linear between, constant after the last.
    (ours)"""
    optimizer_epsilon: Positive = 1e-7
    """Added to the root of the second moment; 1.5e-4 all but stops learning here. (ours)"""
    max_gradient_norm: Annotated[float, Field(ge=0)] = 10.0
    """Gradients are clipped to this norm; 0: never. (ours; dueling paper: 10)"""
    target_period: Count = 2500
    """Learner steps between copies to the target network: t of section 4. (ours; Ape-X: 2500)"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_schedule("learning_rate_schedule", self.learning_rate_schedule)
        if any(factor <= 0 for _, factor in self.learning_rate_schedule):
            raise ValueError("learning_rate_schedule has a factor that is not above 0")
        schedules = ("shaping_schedule", 1), ("collision_schedule", 100)
        for name, most in (*schedules, ("demonstration_schedule", 100)):
            points = getattr(self, name)
            _check_schedule(name, points)
            if any(not 0 <= factor <= most for _, factor in points):
                raise ValueError(f"{name} has a factor outside 0 ... {most}")
        return self


def _check_schedule(name: str, points: Sequence[tuple[float, float]]) -> None:
    steps = [step for step, _ in points]
    if not steps or steps[0] != 0 or steps != sorted(set(steps)):
        raise ValueError(f"{name} needs points whose steps rise from 0")


class ExplorationConfig(Section):
    """Epsilon of the epsilon-greedy actors (paper section 5.2)."""

    kind: Literal["schedule", "ladder"] = "schedule"
    """`schedule`: epsilon over learner steps, the same in every actor. `ladder`: the schedule,
    raised to powers from 1 to ladder_power spread over the arenas of all actors. (ours; Ape-X)"""
    schedule: Schedule = ((0, 1.0), (800_000, 0.1))
    """Points (learner step, epsilon), linear between, constant after the last. (paper)"""
    ladder_power: Annotated[float, Field(ge=1)] = 3.0
    """Power of the arena that explores least. (ours; Ape-X: 8 with 360 actors)"""
    slots: Annotated[int, Field(ge=0)] = 0
    """Exploration slots, the places of the ladder, each leased to one actor; 0: as many as actors
    hold one. (ours; Ape-X: as many as actors)"""
    lease_s: Annotated[float, Field(ge=1, le=_LONGEST_S)] = 15.0
    """Lease of an exploration slot: an actor that stays silent for longer loses it, and renews it
    three times as often. (ours)"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_schedule("schedule", self.schedule)
        if any(not 0 <= epsilon <= 1 for _, epsilon in self.schedule):
            raise ValueError("schedule has an epsilon outside 0 ... 1")
        return self


class CurriculumConfig(Section):
    """How often each number of arena.robots is played, as a share of the transitions."""

    kind: Literal["schedule", "automatic"] = "schedule"
    """`schedule`: weights over learner steps. `automatic`: by the success p so far of each number,
    in each actor, in proportion to p (1 - p): what is neither solved nor hopeless is played most.
    (ours; rule: Tzannetos et al. 2023, as Florensa et al. 2018 choose goals)"""
    schedule: tuple[tuple[float, ...], ...] = ()
    """Points [learner step, a weight for each of arena.robots], linear between, constant after the
    last, such as [[0, 1, 0], [5000, 1, 3]]; empty: equal weights. (ours)"""
    greatest_first_steps: Annotated[int, Field(ge=0)] = 0
    """Learner steps in which only the greatest number is played, before `kind` decides. (ours)"""
    floor: Fraction = 0.2
    """Part of the transitions that `automatic` spreads evenly over all numbers. (ours)"""
    memory_episodes: Count = 50
    """Episodes of a number, over which its success is averaged exponentially. (ours)"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.schedule:
            if any(not point or min(point) < 0 or sum(point[1:]) <= 0 for point in self.schedule):
                raise ValueError("schedule has a weight below 0, or a point without one above 0")
            _check_schedule("schedule", [(point[0], 0) for point in self.schedule])
        return self


class ReplayConfig(Section):
    """The replay table and its rate limiter (paper section 5.2)."""

    capacity: Count = 400_000
    """Transitions that the table holds; new ones replace the oldest. (paper)"""
    min_size: Annotated[Count, Kept(in_lockstep=True)] = 50_000
    """Transitions inserted before the first sample. (paper)"""
    capacity_bytes: Annotated[int, Field(ge=0)] = 0
    """Limit of the table's memory, allocated at the start; fewer transitions are kept if capacity
    would need more; 0: no limit. (ours)"""
    shards: Annotated[Count, Kept()] = 1
    """Replay processes that share capacity and min_size; an actor inserts into one, the learner
    samples from all. (ours)"""
    sampler: Literal["uniform", "prioritized"] = "uniform"
    """`uniform`: each transition is equally likely. `prioritized`: in proportion to its last
    absolute TD error, raised to priority_exponent. (paper; Ape-X: prioritized)"""
    priority_exponent: Fraction = 0.6
    """alpha of prioritized sampling; 0 is uniform. (Ape-X)"""
    importance_exponent: Fraction = 0.4
    """beta of the importance weights at the learner's first step; they correct for prioritized
    sampling, with 1 fully. (Ape-X)"""
    importance_exponent_final: Fraction = 0.4
    """beta after importance_anneal_steps. (Ape-X; prioritized replay's paper: 1)"""
    importance_anneal_steps: Count = 100_000
    """Learner steps over which beta changes linearly to its final value. (ours)"""
    samples_per_insert: Annotated[float, Field(ge=0), Kept(in_lockstep=True)] = 8.0
    """Transitions sampled for each one inserted; both sides keep to it; 0: no limit. (ours)"""
    tolerance: Annotated[float, Field(ge=0)] = 0.1
    """Fraction of min_size x samples_per_insert by which either side may run ahead. (ours)"""
    hold_s: Seconds = 5.0
    """Time after which a throttled request is answered "held"; the client asks again. (ours)"""
    fsync: Literal["never", "always", "off"] = "never"
    """When the log of accepted chunks is synced: with `never` it survives kill -9, with `always` a
    power cut too, at the disk's pace; `off` keeps no log. (ours)"""
    segment_bytes: Count = 64 << 20
    """Size at which the log starts a new file; files are deleted as the table evicts. (ours)"""
    snapshot_period_s: Seconds = 10.0
    """Time between snapshots of the priorities and counters, which the log lacks. (ours)"""
    seed: Seed = 0
    """Seed of the sampler. (ours)"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.min_size > self.capacity:
            raise ValueError(
                f"min_size {self.min_size} exceeds capacity {self.capacity}: "
                "sampling would never start"
            )
        return self

    @property
    def shard_capacity(self) -> int:
        """Transitions that one shard holds."""
        return -(-self.capacity // self.shards)

    @property
    def shard_min_size(self) -> int:
        """Transitions inserted into one shard before its first sample."""
        return -(-self.min_size // self.shards)

    @property
    def prioritized(self) -> bool:
        """Whether TD errors decide which transitions are sampled."""
        return self.sampler == "prioritized"


class ActorConfig(Section):
    """Collecting transitions."""

    num_arenas: Annotated[Count, Kept(in_lockstep=True)] = 8
    """Arenas stepped together, with one batched inference for all their robots. (ours)"""
    chunk_length: Annotated[int, Field(ge=1, le=1024)] = 50
    """Transitions in a chunk. (Ape-X)"""
    spool_chunks: Count = 8
    """Unacknowledged chunks at which the arenas stop; nothing is dropped. (ours)"""
    warn_s: Seconds = 10.0
    """Time without an acknowledgement after which the actor logs whom it waits for. (ours)"""
    device: str = "cpu"
    """Device of the policy; `auto`: cuda if available, else cpu. (ours)"""
    threads: Count = 1
    """Torch threads. (ours)"""


class LearnerConfig(Section):
    """Learning from samples."""

    batch_size: Annotated[Count, Kept(in_lockstep=True)] = 32
    """Transitions in a mini-batch. (paper)"""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Precision of convolutions and hidden layers; heads and loss are always float32. `auto`:
    bfloat16 where the processor supports it. (ours)"""
    device: str = "auto"
    """`auto`: cuda if available, else cpu. (ours)"""
    step: Literal["auto", "eager", "graph"] = "auto"
    """`eager`: one operation after another. `graph`: captured once as a CUDA graph, then replayed.
    `auto`: graph on a GPU where that works, eager elsewhere; the log says which. (ours)"""
    updates_per_launch: Count = 4
    """Updates in one launch of a graph, if as many batches are ready and none of target_period,
    publish_period and run.learner_steps falls between them. (ours)"""
    threads: Annotated[int, Field(ge=0)] = 0
    """Threads that share a batch on a CPU; 0: as many as prove fastest while it runs, up to one a
    core; with run.turn_size half the cores. (ours)"""
    drawing_threads: Annotated[int, Field(ge=0)] = 0
    """Threads that render a large batch, where the CPU renders; 0: one a core. (ours)"""
    prefetch_batches: Count = 8
    """Batches decoded ahead of the step. (ours)"""
    requests_in_flight: Count = 4
    """Sample requests in flight. (ours)"""
    batches_per_request: Annotated[int, Field(ge=0)] = 0
    """Mini-batches in one sample request; 0: as many as fit 128 transitions, or 1. (ours)"""
    symmetries: bool = False
    """Apply a random symmetry of the target layout (rotation, mirror image) to each sampled
    transition, its action included. (ours)"""
    publish_period: Count = 100
    """Learner steps between publications of the weights. (ours)"""
    publish_interval_s: Pause = 0.2
    """Least time between publications: a fast learner skips some, which leaves their readers time
    to adopt them. Not with run.turn_size. (ours)"""
    publish_bytes_per_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 3e8
    """Bytes of weights a second that other hosts may take of the learner's link: the more of them
    ask, the less often there are new ones. 0: no limit. Not with run.turn_size. (ours)"""
    publish_precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Precision of published weights: half precision halves their bytes, and readers cast up. The
    best weights are kept as evaluated. (ours)"""
    checkpoint_period_s: Seconds = 60.0
    """Time between checkpoints. (ours)"""
    average_decay: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Part of an exponential average of the parameters that a learner step keeps. It is tested, and
    the best one is kept; 0: no average. (ours)"""
    average_for: Literal["all", "evaluation"] = "all"
    """Who acts by the average: `all`: actors, evaluators and robots. `evaluation`: evaluators and
    robots, while actors act by the newest parameters, so that their transitions stay fresh.
    (ours)"""
    initial_weights: Annotated[str, Kept()] = ""
    """Weights file or run directory from whose weights a new run starts: for other numbers of
    robots, other targets, or a kind whose parameters are the same; empty: random. (ours)"""
    keep_checkpoints: Count = 3
    """Newest checkpoints kept; the evaluator keeps the best weights beside them. (ours)"""
    warn_s: Seconds = 10.0
    """Time without a batch after which the learner logs whom it waits for. (ours)"""
    seed: Seed = 0
    """Seed of the initial parameters and the random symmetries. (ours)"""

    @property
    def average_apart(self) -> bool:
        """Whether what is tested are other weights than those that actors act by."""
        return self.average_decay > 0 and self.average_for == "evaluation"

    @property
    def sample_size(self) -> int:
        """Transitions in one sample request: whole mini-batches."""
        return self.batch_size * (self.batches_per_request or max(1, 128 // self.batch_size))


class EvaluatorConfig(Section):
    """The paper's test (section 5.3), run on live weights."""

    episodes: Count = 100
    """Episodes of each evaluation; the paper's table has 1100. (ours)"""
    probe_episodes: Annotated[int, Field(ge=0)] = 20
    """Episodes after which an evaluation without a success ends: a policy that has learned nothing
    plays each to the time limit; 0: all are always played. (ours)"""
    epsilon: Fraction = 0.01
    """Probability of a random action in the test. (paper)"""
    period_s: Pause = 30.0
    """Least time between the starts of two evaluations. (ours)"""
    max_share: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Greatest fraction of time spent evaluating: a wandering policy takes long. (ours)"""
    seed: Seed = 1
    """Seed of the start states, which are the same for every version. (ours)"""
    confirm_episodes: Annotated[int, Field(ge=0)] = 400
    """Episodes, from other starts, of a second evaluation of weights that may be the best and have
    90 % success: the best of many evaluations owes some of its score to luck; 0: none. (ours)"""
    threads: Count = 1
    """Torch threads. (ours)"""


class RunConfig(Section):
    """One run of `mrcdrl train`."""

    actors: Annotated[int, Field(ge=0)] = 0
    """Actor processes; 0: derived from the number of cores. (ours)"""
    evaluators: Annotated[int, Field(ge=0)] = 1
    """Evaluator processes. (ours)"""
    seed: Seed = 0
    """Seed of the arenas. (ours)"""
    turn_size: Annotated[int, Field(ge=0), Kept()] = 0
    """Lockstep: transitions that the one actor collects before the learner takes its turn; the same
    seeds then give the same numbers, even across restarts. 0: both run freely. (ours)"""
    minutes: Annotated[float, Field(ge=0)] = 0
    """Ends the run after this time; 0: never. (ours)"""
    learner_steps: Annotated[int, Field(ge=0)] = 0
    """Ends the run at this learner step; 0: never. (ours)"""
    target_success_rate: Fraction = 0
    """Ends the run at the first evaluation that reaches this rate; 0: never. (ours)"""
    tracker: Literal["none", "trackio", "wandb"] = "none"
    """Experiment tracker that the recorder hands the run's figures to, in a process of its own; its
    package is an extra, and its own variables say where they go. (ours)"""
    tracker_project: str = "mrcdrl"
    """Name of the project there. (ours)"""
    patience_episodes: Annotated[int, Field(ge=0)] = 1000
    """The paper's stopping rule (section 5.2): ends the run when the successes in 100 episodes
    reach no new maximum for this many episodes; 0: never. (paper)"""
    patience_floor: Fraction = 0.5
    """Fraction of successes in 100 episodes before which the stopping rule waits: until learning
    takes hold there is no maximum. ("when a certain size is satisfied"; value ours)"""


class TransportConfig(Section):
    """Connections of one process: over Zenoh, and for Prometheus."""

    connect: tuple[str, ...] = ()
    """Endpoints to connect to, such as tcp/127.0.0.1:7447. (ours)"""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on, for the replay process or a router. (ours)"""
    ca: str = ""
    """Certificate of the authority that signs all certificates, a PEM file. With ca, certificate
    and key, endpoints are tls/HOST:PORT and every process shows a certificate. (ours)"""
    certificate: str = ""
    """This process's certificate, a PEM file; its common name is the role it may play. (ours)"""
    key: str = ""
    """Private key of the certificate, a PEM file. (ours)"""
    timeout_s: Seconds = 10.0
    """Deadline of one query. (ours)"""
    max_message_bytes: Count = 64 << 20
    """Largest message; larger ones are refused. (ours)"""
    max_peers: Count = 2000
    """Connections that a process which listens admits at once, and as many more that are still
    joining: one for each actor, evaluator and watcher, two for the learner. (ours)"""
    shared_memory: bool = True
    """Send large messages between processes of one host through shared memory, where both can
    reach it; over the network otherwise. (ours)"""
    metrics_port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Port on which this process serves its metrics to Prometheus; 0: none. `mrcdrl train` and
    `mrcdrl status` serve those of the whole run. (ours; usual: 9464)"""
    metrics_address: str = "127.0.0.1"
    """IP address on which it does so; 0.0.0.0 is all of this machine's. (ours)"""

    @field_validator("metrics_address")
    @classmethod
    def _check_address(cls, value: str) -> str:
        try:
            ipaddress.ip_address(value)
        except ValueError:
            raise ValueError(
                f"{value!r} is not an IP address; give one, such as 127.0.0.1 or 0.0.0.0"
            ) from None
        return value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len({bool(self.ca), bool(self.certificate), bool(self.key)}) > 1:
            raise ValueError("give ca, certificate and key together, or none of them")
        return self


class Config(Section):
    """The whole configuration of a run."""

    arena: ArenaConfig = ArenaConfig()
    agent: AgentConfig = AgentConfig()
    exploration: ExplorationConfig = ExplorationConfig()
    curriculum: CurriculumConfig = CurriculumConfig()
    replay: ReplayConfig = ReplayConfig()
    actor: ActorConfig = ActorConfig()
    learner: LearnerConfig = LearnerConfig()
    evaluator: EvaluatorConfig = EvaluatorConfig()
    run: RunConfig = RunConfig()
    transport: TransportConfig = TransportConfig()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.replay.hold_s >= self.transport.timeout_s:
            raise ValueError(
                f"replay.hold_s {self.replay.hold_s:g} is not below transport.timeout_s "
                f"{self.transport.timeout_s:g}: a throttled request would look unanswered"
            )
        smallest = self.learner.batch_size
        if self.replay.shard_min_size < smallest:
            shares = f" over {self.replay.shards} shards" if self.replay.shards > 1 else ""
            raise ValueError(
                f"replay.min_size {self.replay.min_size}{shares} is below learner.batch_size "
                f"{smallest}: the first batch would repeat transitions"
            )
        numbers = self.arena.numbers
        if any(len(point) != 1 + len(numbers) for point in self.curriculum.schedule):
            raise ValueError(
                "curriculum.schedule needs points of a learner step and a weight for each of "
                f"arena.robots {list(numbers)}"
            )
        if self.arena.is_custom:
            self._check_custom()
        if self.agent.demonstrator != "none" and self.arena.codec != "scene":
            raise ValueError(
                f"agent.demonstrator needs the poses in the records: arena.codec is "
                f"{self.arena.codec!r}, not 'scene'"
            )
        if self.run.turn_size:
            self._check_lockstep()
        return self

    def _check_custom(self) -> None:
        """Raise ValueError for rewards that need the paper's arena: poses, targets, collisions."""
        agent = self.agent
        needing = {
            "agent.shaping_per_px": agent.shaping_per_px > 0,
            "agent.collision_schedule": any(factor != 1 for _, factor in agent.collision_schedule),
            "agent.occupied_targets_pay": not agent.occupied_targets_pay,
            "agent.demonstrator": agent.demonstrator != "none",
        }
        for name, given in needing.items():
            if given:
                raise ValueError(f"{name} needs the paper's arena: leave it out with arena.env")

    def _check_lockstep(self) -> None:
        """Raise ValueError if turns of this size are impossible, or not repeatable."""
        replay, turn_size = self.replay, self.run.turn_size
        robots = self.actor.num_arenas * self.arena.num_robots
        samples = turn_size * replay.samples_per_insert
        steps = samples / self.learner.batch_size
        reasons = {
            "needs a single actor (run.actors)": self.run.actors > 1,
            "needs a single shard (replay.shards)": replay.shards > 1,
            "needs one number of robots (arena.robots)": self.arena.mixes_numbers,
            'needs a log, and replay.fsync "off" keeps none': replay.fsync == "off",
            'needs replay.sampler "uniform": priorities arrive at any time': replay.prioritized,
            f"is not a multiple of {robots}, the robots of one actor": turn_size % robots,
            "x replay.samples_per_insert is not a multiple of the learner's request, "
            f"{self.learner.sample_size}": not samples or samples % self.learner.sample_size,
            f"ends at learner steps that are multiples of {steps:g}, unlike run.learner_steps "
            f"{self.run.learner_steps}": steps and self.run.learner_steps % steps,
            f"does not fit in replay.capacity, with replay.min_size {replay.min_size}": (
                turn_size + replay.min_size + robots > replay.capacity
            ),
        }
        for reason, holds in reasons.items():
            if holds:
                raise ValueError(f"run.turn_size {turn_size} {reason}")

    def each_number(self) -> tuple[Self, ...]:
        """The configuration with each of arena.robots alone, in their order."""
        arena = self.arena
        return tuple(
            self.model_copy(update={"arena": arena.with_robots(number)}) for number in arena.numbers
        )


def sections() -> dict[str, type[Section]]:
    """The class of each section by name, in the order of the file."""
    return {
        name: cast(type[Section], info.annotation) for name, info in Config.model_fields.items()
    }


def kept_settings(*, lockstep: bool) -> Iterator[tuple[str, str]]:
    """The section and name of each setting that a resumed run keeps.

    lockstep: whether actor and learner take turns.
    """
    for section, model in sections().items():
        for name, info in model.model_fields.items():
            marks = [mark for mark in info.metadata if isinstance(mark, Kept)]
            if model.kept or any(lockstep or not mark.in_lockstep for mark in marks):
                yield section, name
