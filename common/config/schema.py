"""The one configuration: a frozen section for each part, every field with its source.

Precedence: a flag beats an environment variable beats the file beats the default written here.
The defaults are the paper's where it speaks ("paper"), the game it descends from where that
settles it ("ancestor"), ours otherwise ("ours"). An unknown name is refused with the nearest
right one.
"""

from collections.abc import Sequence
from typing import Annotated, Literal, Self, cast

from pydantic import BaseModel, ConfigDict, Field, model_validator

_FINEST_PX = 2.5  # of the arena: smaller pixels of an image are drawn literally

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]


class Section(BaseModel):
    """A part of the configuration: frozen, and strict about names."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class ArenaConfig(Section):
    """The 2-D world, its rewards and its images (paper sections 3 and 4)."""

    kind: Literal["robots", "counting"] = "robots"
    """`robots`: the paper's arena. `counting`: images that encode actor, episode and step, for
    tests of the data path. (ours)"""
    physics: Literal["array", "pymunk"] = "array"
    """What moves the robots: compiled arrays, or pymunk, which is the reference; both give the same
    poses. (ours; ancestor: pymunk)"""
    num_robots: Annotated[int, Field(ge=1, le=10)] = 2
    """(paper: 2, 3, 4)"""
    num_targets: Annotated[int, Field(ge=0, le=20)] = 0
    """Targets, of which every robot needs one; 0: as many as robots. (paper: as many as robots)"""
    size_px: Annotated[int, Field(ge=120)] = 600
    """Width and height of the square arena. (paper)"""
    wall_offset_px: Annotated[float, Field(ge=0)] = 10
    """From the border to the wall's outer face. (paper)"""
    wall_thickness_px: Positive = 2
    """(paper)"""
    robot_radius_px: Positive = 25
    """c_r. (paper)"""
    target_size_px: Positive = 30
    """s_w = s_h, sides of a square target. (paper)"""
    turn_deg: Annotated[float, Field(gt=0, lt=180)] = 23
    """Turn of a `left` or `right` action. (paper)"""
    step_px: Positive = 2.5
    """Way moved after the turn, by every action. (paper; ancestor: a turn moves on too)"""
    target_layout: Literal["fixed", "random"] = "fixed"
    """`fixed`: one layout for each number of robots; `random`: anew each episode. (ours: the
    paper calls only the robots' start random)"""
    targets_px: tuple[tuple[float, float], ...] = ()
    """Target centres (x, y) instead of the built-in fixed layout. (ours)"""
    obstacles_px: tuple[tuple[float, float, float], ...] = ()
    """Discs (x, y, radius) that stop robots as walls do. (ours)"""
    num_obstacles: Annotated[int, Field(ge=0, le=20)] = 0
    """Discs besides, at random places anew each episode; robots can always pass between them.
    (ours)"""
    obstacle_radius_px: Positive = 30
    """Of the random discs. (ours)"""
    inner_walls_px: tuple[tuple[float, float, float, float], ...] = ()
    """Walls (x, y, x, y) from one point to another, as thick as the outer ones. (ours)"""
    failure_probability: Fraction = 0
    """Of each robot in each frame: it then stands where it is to the episode's end, and success is
    that of the others; the last one never fails. (ours)"""
    success_radius_px: Positive = 20
    """delta: every robot this near to a target of its own is success. (paper)"""
    max_collisions: Count = 5
    """Robot collisions that end a training episode as failed; the test ends at 1. (paper)"""
    back_off_frames: Annotated[int, Field(ge=0)] = 0
    """Frames a robot is driven backwards after a collision; 0: its move is undone and it goes on.
    (ancestor: 10)"""
    success_reward: float = 200
    """To each robot. (paper)"""
    collision_reward: float = -5
    """(paper)"""
    step_reward: float = 0.03
    """Off target, no collision. (paper)"""
    proximity_weight: Fraction = 0.7
    """p in r = r_chi p + r_f (1 - p). (paper, Fig. 5)"""
    f_max: Count = 500
    """Frames after which r_f is 0. (ours: the paper names f_max, not its value)"""
    max_frames: Count = 1000
    """Frames after which an episode is truncated (and bootstrapped). (ours)"""
    view_px: Annotated[int, Field(ge=31, le=255)] = 60
    """Width and height of a robot's image. (paper)"""
    crop_px: Annotated[float, Field(ge=1)] = 600
    """w = h of the rectangle cut out around the robot. (ours: not given; 600 shows the half
    around it)"""
    orientation: Literal["unrotated", "heading_up"] = "unrotated"
    """Of the cut-out. (paper names no rotation; heading_up is ours)"""
    stack: Annotated[int, Field(ge=1, le=16)] = 4
    """Consecutive images that make a state. (paper)"""
    renderer: Literal["analytic", "literal"] = "analytic"
    """`literal` draws 600x600, greys, crops, pads and area-resizes as the paper does; `analytic`
    computes the same coverage straight at 60x60, but where an image's pixel is less than 2.5 px of
    the arena: there single pixels of the drawing show, and it draws as `literal` does. (ours)"""
    pixel_noise: Annotated[float, Field(ge=0)] = 0
    """Standard deviation of the noise on every pixel of a robot's image, in levels of grey.
    (ours)"""
    dropped_frame_probability: Annotated[float, Field(ge=0, lt=1)] = 0
    """Of each robot in each frame: it then sees its image before once more. (ours)"""
    codec: Literal["scene", "frames"] = "scene"
    """What an observation record holds: poses from which the image is drawn, or pixels. (ours)"""

    @property
    def target_count(self) -> int:
        """Targets of an episode."""
        return self.num_targets or self.num_robots

    @property
    def obstacle_count(self) -> int:
        """Discs of an episode."""
        return len(self.obstacles_px) + self.num_obstacles

    @property
    def renders_analytically(self) -> bool:
        """Whether images are computed from the poses."""
        return self.renderer == "analytic" and self.crop_px >= _FINEST_PX * self.view_px

    @property
    def record_bytes(self) -> int:
        """Length of one observation record: the pixels, or all that they are drawn from."""
        if self.codec == "frames":
            return self.view_px * self.view_px
        layout = 2 * self.target_count + 3 * self.obstacle_count
        return 4 * (3 * self.num_robots + layout + bool(self.pixel_noise))

    @model_validator(mode="after")
    def _check(self) -> Self:
        inner = self.size_px - 2 * (self.wall_offset_px + self.wall_thickness_px)
        if inner < 2 * self.robot_radius_px:
            raise ValueError(
                f"no robot of radius {self.robot_radius_px} px fits inside walls {inner} px apart"
            )
        if self.target_count < self.num_robots:
            raise ValueError(
                f"num_targets {self.num_targets} leaves {self.num_robots} robots without a target "
                "each; give as many as robots or more, or 0"
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
            raise ValueError("inner_walls_px has a wall without length: give two points")
        if self.codec == "scene" and self.kind == "counting":
            raise ValueError('kind = "counting" encodes its counters in pixels: codec = "frames"')
        return self


class AgentConfig(Section):
    """What is learned (paper sections 4 and 5.2)."""

    kind: Literal["duel", "ddqn", "dqn"] = "duel"
    """`dqn`: target (4). `ddqn`: target (2). `duel`: target (2) and two streams (1). (paper)"""
    gamma: Annotated[float, Field(gt=0, lt=1)] = 0.99
    """(paper)"""
    n_step: Annotated[int, Field(ge=1, le=32)] = 1
    """Rewards summed before the bootstrap. (paper: 1; Ape-X: 3)"""
    reward_scale: Positive = 1.0
    """Rewards are multiplied by this in the learner's target. (ours)"""
    loss: Literal["squared", "huber"] = "squared"
    """Of the TD error, Eq. (3). (paper: squared)"""
    optimizer: Literal["adam", "rmsprop"] = "adam"
    """(ours; ancestor: rmsprop)"""
    learning_rate: Positive = 1e-4
    """(ours)"""
    learning_rate_schedule: tuple[tuple[int, float], ...] = ((0, 1.0),)
    """Points (learner step, factor of learning_rate), linear between, constant after the last.
    (ours)"""
    optimizer_epsilon: Positive = 1e-7
    """Added to the root of the second moment; 1.5e-4 all but stops learning here. (ours)"""
    max_gradient_norm: Annotated[float, Field(ge=0)] = 10.0
    """Clipped above; 0: never. (ours; dueling paper: 10)"""
    target_period: Count = 2500
    """Learner steps between copies to the target network: t of section 4. (ours; Ape-X: 2500)"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_schedule("learning_rate_schedule", self.learning_rate_schedule)
        if any(factor <= 0 for _, factor in self.learning_rate_schedule):
            raise ValueError("learning_rate_schedule has a factor that is not above 0")
        return self


def _check_schedule(name: str, points: Sequence[tuple[int, float]]) -> None:
    steps = [step for step, _ in points]
    if not steps or steps[0] != 0 or steps != sorted(set(steps)):
        raise ValueError(f"{name} needs points whose steps rise from 0")


class ExplorationConfig(Section):
    """How epsilon of the epsilon-greedy actors runs (paper section 5.2)."""

    kind: Literal["schedule", "ladder"] = "schedule"
    """`schedule`: epsilon over learner steps, the same in every actor. `ladder`: the schedule,
    raised to a power 1 ... ladder_power spread over the arenas of all actors. (ours; Ape-X)"""
    schedule: tuple[tuple[int, float], ...] = ((0, 1.0), (800_000, 0.1))
    """Points (learner step, epsilon), linear between, constant after the last. (paper)"""
    ladder_power: Annotated[float, Field(ge=1)] = 3.0
    """Power of the least exploring arena. (ours; Ape-X: 8 with 360 actors)"""
    slots: Annotated[int, Field(ge=0)] = 0
    """Places of the ladder, each leased to one actor; 0: as many as there are actors that hold
    one. (ours; Ape-X: as many as actors)"""
    lease_s: Annotated[float, Field(ge=1)] = 15.0
    """An actor that is not heard of for so long loses its slot; it renews three times as often.
    (ours)"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _check_schedule("schedule", self.schedule)
        if any(not 0 <= epsilon <= 1 for _, epsilon in self.schedule):
            raise ValueError("schedule has an epsilon outside 0 ... 1")
        return self


class ReplayConfig(Section):
    """The table and its rate limiter (paper section 5.2)."""

    capacity: Count = 400_000
    """Transitions; the oldest are replaced. (paper)"""
    min_size: Count = 50_000
    """Transitions before the first sample is given. (paper)"""
    capacity_bytes: Annotated[int, Field(ge=0)] = 0
    """Memory that the table takes at most, all of it at the start; fewer transitions are kept where
    capacity would need more; 0: no limit. (ours)"""
    shards: Count = 1
    """Replay processes that share capacity and min_size; an actor inserts into one, the learner
    samples from all. (ours)"""
    sampler: Literal["uniform", "prioritized"] = "uniform"
    """`uniform`: each transition as likely as any other. `prioritized`: in proportion to its last
    absolute TD error, to the power priority_exponent. (paper; Ape-X: prioritized)"""
    priority_exponent: Fraction = 0.6
    """alpha of prioritized sampling; 0 is uniform. (Ape-X)"""
    importance_exponent: Fraction = 0.4
    """beta of the importance weights, which take back what prioritized sampling distorts, in the
    learner's first step; 1 takes back all of it. (Ape-X)"""
    importance_exponent_final: Fraction = 0.4
    """beta after importance_anneal_steps. (Ape-X; prioritized replay's paper: 1)"""
    importance_anneal_steps: Count = 100_000
    """Learner steps over which beta goes from the one to the other, linearly. (ours)"""
    samples_per_insert: Annotated[float, Field(ge=0)] = 8.0
    """Transitions sampled for each inserted; both sides are held to it; 0: no limit. (ours)"""
    tolerance: Annotated[float, Field(ge=0)] = 0.1
    """Share of min_size x samples_per_insert by which either side may run ahead. (ours)"""
    hold_s: Positive = 5.0
    """A request the limiter holds is answered "held" after this; the client asks again. (ours)"""
    fsync: Literal["never", "always", "off"] = "never"
    """Of the log of accepted chunks: `never` outlives kill -9, `always` a power cut as well, at
    the disk's pace; `off` keeps no log. (ours)"""
    segment_bytes: Count = 64 << 20
    """Size at which the log starts a new file; whole files go as the table evicts. (ours)"""
    snapshot_period_s: Positive = 10.0
    """Between snapshots of the priorities and counters, which the log does not hold. (ours)"""
    seed: int = 0
    """Of the sampler. (ours)"""

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
        """Transitions of one shard."""
        return -(-self.capacity // self.shards)

    @property
    def shard_min_size(self) -> int:
        """Transitions of one shard before its first sample."""
        return -(-self.min_size // self.shards)

    @property
    def prioritized(self) -> bool:
        """Whether TD errors decide what is sampled."""
        return self.sampler == "prioritized"


class ActorConfig(Section):
    """Collecting."""

    num_arenas: Count = 8
    """Arenas stepped together, one batched inference for all their robots. (ours)"""
    chunk_length: Annotated[int, Field(ge=1, le=1024)] = 50
    """Transitions a chunk. (Ape-X)"""
    spool_chunks: Count = 8
    """Chunks waiting to be acknowledged before the arenas stop: nothing is dropped. (ours)"""
    warn_s: Positive = 10.0
    """Without an acknowledgement for so long, the actor says whom it waits for. (ours)"""
    device: str = "cpu"
    """That chooses the actions; `auto`: cuda if there is one, else cpu. (ours)"""
    threads: Count = 1
    """Torch threads. (ours)"""


class LearnerConfig(Section):
    """Learning."""

    batch_size: Count = 32
    """(paper)"""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of convolutions and hidden layers; heads and loss are float32 always. `auto`: bfloat16
    where the processor computes in it. (ours)"""
    device: str = "auto"
    """`auto`: cuda if there is one, else cpu. (ours)"""
    step: Literal["auto", "eager", "graph"] = "auto"
    """`eager`: operation after operation. `graph`: recorded once as a CUDA graph, then replayed.
    `auto`: graph on a GPU where that works, eager elsewhere; the log says which. (ours)"""
    updates_per_launch: Count = 4
    """Updates that one launch of a graph makes where so many batches are ready and none of
    target_period, publish_period and run.learner_steps falls between them. (ours)"""
    threads: Annotated[int, Field(ge=0)] = 0
    """Threads that share a batch on a CPU; 0: half the cores, at least 1. (ours)"""
    drawing_threads: Annotated[int, Field(ge=0)] = 0
    """Threads that share the drawing of a large batch where the CPU draws; 0: one a core. (ours)"""
    prefetch_batches: Count = 8
    """Batches decoded ahead of the step. (ours)"""
    requests_in_flight: Count = 4
    """Sample requests sent ahead. (ours)"""
    batches_per_request: Annotated[int, Field(ge=0)] = 0
    """Mini-batches sampled by one request; 0: as many as fit 128 transitions, or 1. (ours)"""
    symmetries: bool = False
    """Turn and mirror each sampled transition by a random symmetry of the target layout, its
    action with it. (ours)"""
    publish_period: Count = 100
    """Learner steps between publications of the weights. (ours)"""
    publish_interval_s: Annotated[float, Field(ge=0)] = 0.2
    """Seconds between publications at least: a learner that takes so many steps a second passes
    over some, and leaves time to those who adopt them. Not with run.turn_size. (ours)"""
    publish_precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Of published weights; half of it halves their bytes, and those who adopt them cast up. The
    best weights are kept as they were judged. (ours)"""
    checkpoint_period_s: Positive = 60.0
    """(ours)"""
    keep_checkpoints: Count = 3
    """Newest kept; the evaluator keeps the best beside them. (ours)"""
    warn_s: Positive = 10.0
    """Without a batch for so long, the learner says whom it waits for. (ours)"""
    seed: int = 0
    """Of the initial parameters and the symmetries drawn. (ours)"""

    @property
    def sample_size(self) -> int:
        """Transitions of one sample request: whole mini-batches."""
        return self.batch_size * (self.batches_per_request or max(1, 128 // self.batch_size))


class EvaluatorConfig(Section):
    """The paper's test (section 5.3), run on live weights."""

    episodes: Count = 100
    """Starts judged each time; the paper's table has 1100. (ours)"""
    epsilon: Fraction = 0.01
    """(paper)"""
    period_s: Annotated[float, Field(ge=0)] = 30.0
    """From the start of one evaluation to the next at the earliest. (ours)"""
    max_share: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Share of the time spent judging at most: a wandering policy takes long to judge. (ours)"""
    seed: int = 1
    """Of the start states: the same for every version. (ours)"""
    threads: Count = 1
    """Torch threads. (ours)"""


class RunConfig(Section):
    """One run of `mrcdrl train`."""

    actors: Annotated[int, Field(ge=0)] = 0
    """Actor processes; 0: from the cores. (ours)"""
    evaluators: Annotated[int, Field(ge=0)] = 1
    """Evaluator processes. (ours)"""
    seed: int = 0
    """Of the arenas. (ours)"""
    turn_size: Annotated[int, Field(ge=0)] = 0
    """Transitions that the one actor collects before the learner takes its turn; the same seeds
    then give the same numbers, over restarts too. 0: both at once. (ours)"""
    minutes: Annotated[float, Field(ge=0)] = 0
    """Ends the run after so long; 0: never. (ours)"""
    learner_steps: Annotated[int, Field(ge=0)] = 0
    """Ends the run at this many; 0: never. (ours)"""
    target_success_rate: Fraction = 0
    """Ends the run at the first evaluation that reaches this; 0: never. (ours)"""
    patience_episodes: Annotated[int, Field(ge=0)] = 1000
    """The paper's stopping rule (section 5.2): ends the run when the successes of 100 episodes
    reached no new maximum in so many episodes; 0: never. (paper)"""
    patience_floor: Fraction = 0.5
    """The rule acts only after this share of 100 episodes succeeded: before learning takes
    hold there is no maximum to wait for. ("when a certain size is satisfied"; value ours)"""


class TransportConfig(Section):
    """Zenoh."""

    connect: tuple[str, ...] = ()
    """Endpoints to connect to, such as tcp/127.0.0.1:7447. (ours)"""
    listen: tuple[str, ...] = ()
    """Endpoints to listen on; the replay process of one machine. (ours)"""
    ca: str = ""
    """The certificate of the authority that the others' certificates are of, a PEM file. With it,
    certificate and key, endpoints are tls/HOST:PORT and everyone shows a certificate. (ours)"""
    certificate: str = ""
    """This process's own, a PEM file; its common name is the role it may play. (ours)"""
    key: str = ""
    """The private key of the certificate, a PEM file. (ours)"""
    timeout_s: Positive = 10.0
    """Deadline of one query. (ours)"""
    max_message_bytes: Count = 64 << 20
    """Larger messages are refused. (ours)"""
    shared_memory: bool = True
    """Large messages between processes of one host go through memory that they share, where both
    can reach it; over the network otherwise. (ours)"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len({bool(self.ca), bool(self.certificate), bool(self.key)}) > 1:
            raise ValueError("ca, certificate and key are given together or not at all")
        return self


class Config(Section):
    """The whole configuration of a run."""

    arena: ArenaConfig = ArenaConfig()
    agent: AgentConfig = AgentConfig()
    exploration: ExplorationConfig = ExplorationConfig()
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
                f"{self.transport.timeout_s:g}: a request held would look like one unanswered"
            )
        smallest = self.learner.batch_size
        if self.replay.shard_min_size < smallest:
            shares = f" over {self.replay.shards} shards" if self.replay.shards > 1 else ""
            raise ValueError(
                f"replay.min_size {self.replay.min_size}{shares} is below learner.batch_size "
                f"{smallest}: the first batch would repeat transitions"
            )
        if self.run.turn_size:
            self._check_lockstep()
        return self

    def _check_lockstep(self) -> None:
        """Raise ValueError where turns of that size could not be taken, or not be repeated."""
        replay, turn_size = self.replay, self.run.turn_size
        robots = self.actor.num_arenas * self.arena.num_robots
        samples = turn_size * replay.samples_per_insert
        steps = samples / self.learner.batch_size
        reasons = {
            "takes one actor (run.actors)": self.run.actors > 1,
            "takes one replay.shards": replay.shards > 1,
            'takes a log, and replay.fsync "off" keeps none': replay.fsync == "off",
            'takes replay.sampler "uniform": priorities come when they come': replay.prioritized,
            f"is no multiple of {robots}, the robots of one actor": turn_size % robots,
            "x replay.samples_per_insert is no multiple of the learner's request, "
            f"{self.learner.sample_size}": not samples or samples % self.learner.sample_size,
            f"ends at learner steps that are multiples of {steps:g}, and run.learner_steps "
            f"{self.run.learner_steps} is none": steps and self.run.learner_steps % steps,
            f"does not fit in replay.capacity, with replay.min_size {replay.min_size}": (
                turn_size + replay.min_size + robots > replay.capacity
            ),
        }
        for reason, holds in reasons.items():
            if holds:
                raise ValueError(f"run.turn_size {turn_size} {reason}")


def sections() -> dict[str, type[Section]]:
    """Section name to its class, in the order of the file."""
    return {
        name: cast(type[Section], info.annotation) for name, info in Config.model_fields.items()
    }
