"""Sources and precedence of settings, what is refused and why, and the presets' values."""

import re
import tomllib
from pathlib import Path
from typing import Any, get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from mrcdrl.common.config import (
    Config,
    LearnerConfig,
    apply_overrides,
    load_config,
    load_transport,
    preset_names,
    sections,
    to_toml,
)
from mrcdrl.common.errors import ConfigError

FIELDS = [(section, name) for section, model in sections().items() for name in model.model_fields]


def load(
    source: str | None = None,
    overrides: dict[str, str] | None = None,
    environ: dict[str, str] | None = None,
) -> Config:
    return load_config(source, overrides, environ or {})


def refusal(
    source: str | None = None,
    overrides: dict[str, str] | None = None,
    environ: dict[str, str] | None = None,
) -> str:
    """The one-line error for this configuration."""
    with pytest.raises(ConfigError) as refused:
        load(source, overrides, environ)
    assert "\n" not in str(refused.value)
    return str(refused.value)


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def to_file(text: str, name: str = "mine.toml") -> str:
        (tmp_path / name).write_text(text, "utf-8")
        return str(tmp_path / name)

    return to_file


def test_a_flag_beats_the_environment_beats_the_file_beats_the_default(write: Any) -> None:
    source = write("[learner]\nbatch_size = 2\nseed = 2\nthreads = 2\n[replay]\nmin_size = 99\n")
    environ = {"MRCDRL_LEARNER__BATCH_SIZE": "3", "MRCDRL_LEARNER__SEED": "3", "HOME": "/"}
    learner = load(source, {"learner.batch_size": "4"}, environ).learner
    assert (learner.batch_size, learner.seed, learner.threads) == (4, 3, 2)
    assert learner.publish_period == LearnerConfig().publish_period


def test_without_any_source_the_defaults_stand() -> None:
    assert load() == Config()


def test_the_process_environment_is_read_unless_another_is_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("MRCDRL_ARENA__NUM_ROBOTS", "4")
    assert load_config().arena.num_robots == 4
    assert load_config(environ={}).arena.num_robots == 2


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("arena.num_robots", "3", 3),
        ("replay.capacity", "100_000", 100_000),
        ("agent.learning_rate", "3e-4", 3e-4),
        ("learner.symmetries", "true", True),
        ("agent.kind", "ddqn", "ddqn"),
        ("agent.kind", '"ddqn"', "ddqn"),
        ("learner.device", "cuda:1", "cuda:1"),
        ("exploration.schedule", "[[0, 1.0], [5, 0.5]]", ((0, 1.0), (5, 0.5))),
        ("transport.connect", '["tcp/host:1"]', ("tcp/host:1",)),
    ],
)
def test_a_value_in_a_flag_or_the_environment_is_toml_or_plain_text(
    name: str, text: str, value: object
) -> None:
    section, field = name.split(".")
    variable = f"MRCDRL_{section}__{field}".upper()
    for config in (load(None, {name: text}), load(None, None, {variable: text})):
        assert getattr(getattr(config, section), field) == value


UNKNOWN = {
    "section of a file": ("[learners]\nseed = 1", {}, {}, "section 'learners'.*mean learner?"),
    "field of a file": ("[learner]\nseeds = 1", {}, {}, "'learner.seeds'.*mean learner.seed?"),
    "field of another": ("[learner]\ngamma = 1", {}, {}, "'learner.gamma'; did you mean"),
    "section of a flag": (None, {"learners.seed": "1"}, {}, "'learners'.*mean learner?"),
    "field of a flag": (None, {"agent.n_steps": "1"}, {}, "flag: .*mean agent.n_step?"),
    "flag without field": (None, {"agent": "1"}, {}, "write SECTION.FIELD"),
    "environment": (None, {}, {"MRCDRL_AGENT__GAMA": "1"}, "environment: .*mean agent.gamma?"),
    "value for a section": ("learner = 3", {}, {}, "learner is a section, not a value"),
    "field outside": ("gamma = 0.9", {}, {}, "unknown section 'gamma'"),
}


@pytest.mark.parametrize("case", UNKNOWN)
def test_an_unknown_name_is_refused_with_the_nearest_right_one(case: str, write: Any) -> None:
    text, overrides, environ, reason = UNKNOWN[case]
    source = None if text is None else write(text)
    assert re.search(reason, refusal(source, overrides, environ))


def test_an_unknown_preset_is_told_which_there_are() -> None:
    assert refusal("papr").endswith(f"give a file or a preset: {', '.join(preset_names())}")


def test_a_file_that_is_no_toml_is_refused(write: Any, tmp_path: Path) -> None:
    assert "is not TOML" in refusal(write("[learner\n"))
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe")
    assert "can't decode" in refusal(str(tmp_path / "bytes.toml"))
    assert "Is a directory" in refusal(str(tmp_path))
    assert "is not TOML" in refusal(write(f"[run]\nseed = {'[' * 3000}{']' * 3000}\n"))
    assert "is not TOML" in refusal(write(f"[run]\nseed = {'9' * 5000}\n"))


@pytest.mark.parametrize("path", ["/tmp/\udcff", "a\x00b"])
def test_a_path_that_no_file_of_settings_holds_is_refused(path: str) -> None:
    said = refusal(None, {"learner.initial_weights": path})
    assert said.startswith("learner.initial_weights: must be text in UTF-8")
    assert said.isprintable()


@pytest.mark.parametrize("text", ["[" * 3000 + "]" * 3000, "9" * 5000, "true"])
def test_a_value_that_is_no_number_is_one_short_line(text: str) -> None:
    said = refusal(None, {"run.seed": text})
    assert said.startswith("run.seed: must be a")
    assert len(said) < 300


def test_a_file_extends_a_preset_field_by_field(write: Any) -> None:
    source = write('extends = "smoke"\n[replay]\ncapacity = 3000\n')
    config, smoke = load(source), load("smoke")
    assert config.replay.capacity == 3000
    assert config.replay.min_size == smoke.replay.min_size
    assert config == apply_overrides(smoke.model_dump(), {"replay.capacity": "3000"})


def test_a_file_extends_a_file(write: Any) -> None:
    below = write("[learner]\nseed = 5\nthreads = 5\n[run]\nseed = 5\n", "below.toml")
    source = write(f'extends = "{below}"\n[learner]\nseed = 6\n')
    config = load(source)
    assert (config.learner.seed, config.learner.threads, config.run.seed) == (6, 5, 5)


def test_a_file_that_extends_itself_is_refused(write: Any, tmp_path: Path) -> None:
    source = write(f'extends = "{tmp_path}/mine.toml"')
    assert "extends itself" in refusal(source)
    other = write(f'extends = "{source}"', "other.toml")
    write(f'extends = "{other}"')
    assert "extends itself" in refusal(source)


def test_a_broken_file_below_is_named(write: Any) -> None:
    below = write("learner = 3", "below.toml")
    assert "below.toml': learner is a section" in refusal(
        write(f'extends = "{below}"\n[learner]\nseed = 1')
    )


IMPOSSIBLE = {
    "value too large": ({"arena.num_robots": "11"}, "robots: must be between 1 and 10 .given 11."),
    "value too small": ({"arena.num_robots": "0"}, "robots: must be between 1 and 10 .given 0."),
    "value at an open limit": (
        {"arena.turn_deg": "180"},
        "deg: must be at least 0.1 and below 180 ",
    ),
    "value without an upper limit": ({"run.actors": "-1"}, "run.actors: must be at least 0 "),
    "no such choice": ({"agent.kind": "duell"}, "agent.kind: must be 'duel', 'ddqn' or 'dqn' "),
    "not a number": ({"agent.gamma": "nan"}, "agent.gamma: must be a finite number .given nan"),
    "a reward beyond float32": (
        {"arena.success_reward": "1e39"},
        "must be between -1e.06 and 1e.06",
    ),
    "a time beyond the clock": ({"transport.timeout_s": "1e12"}, "above 0 and at most 1e.09"),
    "two values": ({"agent.gamma": "0.5\n[x]"}, r"must be a number .given '0.5\\n\[x\]'"),
    "half a robot": ({"arena.num_robots": "2.5"}, "must be a whole number .given 2.5"),
    "text for a count": ({"arena.num_robots": "two"}, "must be a whole number .given 'two'"),
    "text for a number": ({"agent.gamma": "high"}, "agent.gamma: must be a number .given 'high'"),
    "text for a switch": ({"learner.symmetries": "no way"}, "must be true or false"),
    "a number for text": ({"learner.device": "3"}, "learner.device: must be text .given 3"),
    "text for a list": (
        {"transport.connect": "tcp/a:1"},
        r"""must be a list: \["tcp/a:1"\], quoted in a shell: '\["tcp/a:1"\]' .given 'tcp/a""",
    ),
    "a list without quotes": (
        {"transport.listen": "[tcp/a:1, tcp/b:2]"},
        r'listen: must be a list: \["tcp/a:1", "tcp/b:2"\], quoted',
    ),
    "a number for a schedule": (
        {"exploration.schedule": "0.1"},
        r"schedule: must be a list, such as \[\[0, 1.0\], \[800000, 0.1\]\] .given 0.1",
    ),
    "a number for points": ({"arena.targets_px": "5"}, r"must be a list, such as \[\[1.0, 1.0\]\]"),
    "text in a schedule": (
        {"exploration.schedule": "[[0, 'x']]"},
        r"schedule\.0\.1: must be a number .given 'x'",
    ),
    "robots as wide as the arena": ({"arena.robot_radius_px": "300"}, "no robot of radius 300"),
    "a target as wide as the arena": (
        {"arena.target_size_px": "601"},
        "target_size_px 601 exceeds",
    ),
    "turns too small to count": ({"arena.turn_deg": "1e-9"}, "must be at least 0.1 and below 180"),
    "a target too few": ({"arena.targets_px": "[[1, 2]]"}, "1 targets for 2 robots; give 2, one a"),
    "an obstacle without size": ({"arena.obstacles_px": "[[1, 2, 0]]"}, "radius that is not above"),
    "an inner wall without length": (
        {"arena.inner_walls_px": "[[1, 2, 1, 2]]"},
        "a wall without length",
    ),
    "a step over an obstacle": (
        {"arena.num_obstacles": "1", "arena.step_px": "50"},
        "step_px 50 is not below a robot's width",
    ),
    "targets for some robots only": ({"arena.num_targets": "1"}, "leaves 2 robots without"),
    "counters in poses": ({"arena.kind": "counting"}, 'codec = "frames"'),
    "a schedule from nowhere": ({"exploration.schedule": "[[5, 1.0]]"}, "rise from 0"),
    "a schedule going back": ({"exploration.schedule": "[[0, 1], [9, 1], [5, 1]]"}, "rise from 0"),
    "no schedule": ({"exploration.schedule": "[]"}, "rise from 0"),
    "epsilon above 1": ({"exploration.schedule": "[[0, 2.0]]"}, "epsilon outside 0 ... 1"),
    "shaping that grows": ({"agent.shaping_schedule": "[[0, 2.0]]"}, "factor outside 0 ... 1$"),
    "shaping from nowhere": ({"agent.shaping_schedule": "[[5, 1.0]]"}, "rise from 0"),
    "collisions that pay": (
        {"agent.collision_schedule": "[[0, -1.0]]"},
        "collision_schedule has a factor outside 0 ... 100",
    ),
    "never sampled": ({"replay.min_size": "500_000"}, "sampling would never start"),
    "first batch repeats": ({"replay.min_size": "8"}, "first batch would repeat transitions"),
    **{
        f"turns {name}": ({"run.turn_size": "64", **overrides}, f"turn_size [0-9]+ .*{reason}")
        for name, (overrides, reason) in {
            "of two actors": ({"run.actors": "2"}, "needs a single actor"),
            "of two shards": ({"replay.shards": "2"}, "needs a single shard"),
            "without a log": ({"replay.fsync": "off"}, "needs a log"),
            "by priorities": ({"replay.sampler": "prioritized"}, "needs replay.sampler"),
            "of half a frame": ({"run.turn_size": "72"}, "is not a multiple of 16, the robots"),
            "of half a request": ({"learner.batches_per_request": "5"}, "the learner's request"),
            "without an end": ({"replay.samples_per_insert": "0"}, "the learner's request"),
            "broken off": (
                {"run.learner_steps": "40"},
                "multiples of 16, unlike run.learner_steps",
            ),
            "beyond the table": ({"replay.capacity": "50_050"}, "does not fit in replay.capacity"),
        }.items()
    },
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_the_impossible_is_refused_with_its_consequence(case: str) -> None:
    overrides, reason = IMPOSSIBLE[case]
    assert re.search(reason, refusal(None, overrides))


NUMBERS = [
    (section, name)
    for section, name in FIELDS
    if re.search(r"\bfloat\b", str(sections()[section].model_fields[name].annotation))
]
SEEDS = [f"{section}.{name}" for section, name in FIELDS if name.endswith("seed")]


def filled(annotation: Any, number: float) -> Any:
    """A value of this type, with the number in each place of a float."""
    inner = [kind for kind in get_args(annotation) if kind is not Ellipsis]
    return (
        [filled(kind, number) for kind in inner]
        if inner
        else annotation(annotation is int or number)
    )


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
@pytest.mark.parametrize(("section", "name"), NUMBERS)
def test_every_number_is_finite(section: str, name: str, number: str, write: Any) -> None:
    value = filled(sections()[section].model_fields[name].annotation, float(number))
    source = write(f"[{section}]\n{name} = {value}\n")
    assert re.search(rf"^{section}\.{name}[.0-9]*: must be a finite number", refusal(source))


@pytest.mark.parametrize("seed", ["-1", str(2**63)])
@pytest.mark.parametrize("name", SEEDS)
def test_every_seed_is_one_that_all_generators_take(name: str, seed: str) -> None:
    assert f"{name}: must be between 0 and {2**63 - 1} (given {seed})" in refusal(
        None, {name: seed}
    )


@pytest.mark.parametrize(("section", "name"), FIELDS)
def test_a_setting_with_an_underscore_too_few_is_reported(section: str, name: str) -> None:
    line = refusal(None, None, {f"MRCDRL_{section}_{name}".upper(): "1"})
    assert f"did you mean MRCDRL_{section.upper()}__{name.upper()}?" in line


@pytest.mark.parametrize(
    "variable",
    [
        "MRCDRL_HEARTBEAT",
        "MRCDRL_DIE_WITH_PARENT",
        "MRCDRL_RUN_DIR",
        "MRCDRL_REPLAY_PORT",
        "MRCDRL_REPLAY_PORT_7447_TCP",
        "MRCDRL_REPLAY_SERVICE_HOST",
        "MRCDRL_DOCKER_ENGINE",
    ],
)
def test_a_variable_that_is_no_setting_is_left_alone(variable: str) -> None:
    assert load(None, None, {variable: "1"}) == Config()


def test_a_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "mark.toml").write_text("[learner]\nseed = 5\n", "utf-8-sig")
    assert load(str(tmp_path / "mark.toml")).learner.seed == 5


def test_overrides_of_a_configuration_are_checked_as_a_whole() -> None:
    smaller = apply_overrides(Config().model_dump(), {"replay.min_size": "64"})
    assert smaller.replay.min_size == 64
    with pytest.raises(ConfigError, match="first batch would repeat"):
        apply_overrides(smaller.model_dump(), {"learner.batch_size": "65"})


def test_a_configuration_is_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        Config().learner.seed = 1  # type: ignore[misc]


def test_every_field_says_where_its_value_is_from() -> None:
    sourceless = []
    for section, name in FIELDS:
        description = sections()[section].model_fields[name].description or ""
        sources = re.findall(r"\(([^)]*)\)", description)
        if not any(re.search(r"\b(paper|ancestor|ours|Ape-X)\b", source) for source in sources):
            sourceless.append(f"{section}.{name}")
    assert sourceless == []


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_loads_and_reads_back_from_its_toml(name: str, write: Any) -> None:
    config = load(name)
    assert load(write(to_toml(config))) == config
    assert list(tomllib.loads(to_toml(config))) == list(sections())


@given(
    device=st.text(st.characters(codec="utf-8", exclude_characters="\0")), points=st.floats(0, 1)
)
def test_any_text_and_number_reads_back_from_toml(device: str, points: float) -> None:
    config = Config.model_validate(
        {
            "learner": {"device": device},
            "exploration": {"schedule": ((0, points), (7, 0.5))},
            "transport": {"connect": (device, "b")},
        }
    )
    assert Config.model_validate(tomllib.loads(to_toml(config))) == config


# The values of sections 3 to 5 of the paper.
PAPER = {
    "arena.size_px": 600,
    "arena.wall_offset_px": 10,
    "arena.wall_thickness_px": 2,
    "arena.robot_radius_px": 25,
    "arena.target_size_px": 30,
    "arena.turn_deg": 23,
    "arena.step_px": 2.5,
    "arena.success_radius_px": 20,
    "arena.max_collisions": 5,
    "arena.success_reward": 200,
    "arena.collision_reward": -5,
    "arena.step_reward": 0.03,
    "arena.proximity_weight": 0.7,
    "arena.view_px": 60,
    "arena.stack": 4,
    "arena.renderer": "literal",
    "agent.kind": "duel",
    "agent.gamma": 0.99,
    "agent.n_step": 1,
    "agent.loss": "squared",
    "exploration.kind": "schedule",
    "exploration.schedule": ((0, 1.0), (800_000, 0.1)),
    "replay.capacity": 400_000,
    "replay.min_size": 50_000,
    "learner.batch_size": 32,
    "evaluator.episodes": 1100,
    "evaluator.epsilon": 0.01,
    "run.patience_episodes": 1000,
}


@pytest.mark.parametrize("dotted", PAPER)
def test_the_preset_paper_is_the_paper(dotted: str) -> None:
    section, name = dotted.split(".")
    assert getattr(getattr(load("paper"), section), name) == PAPER[dotted]


# Horgan et al. 2018, section 4.1.
APEX = {
    "agent.n_step": 3,
    "agent.learning_rate": 6.25e-5,
    "agent.target_period": 2500,
    "exploration.kind": "ladder",
    "exploration.schedule": ((0, 0.4),),
    "replay.sampler": "prioritized",
    "replay.priority_exponent": 0.6,
    "replay.importance_exponent": 0.4,
    "replay.importance_exponent_final": 0.4,
    "learner.batch_size": 512,
}


@pytest.mark.parametrize("dotted", APEX)
def test_the_preset_apex_is_ape_x(dotted: str) -> None:
    section, name = dotted.split(".")
    assert getattr(getattr(load("apex"), section), name) == APEX[dotted]


@pytest.mark.parametrize("preset", ["paper", "quick", "smoke"])
def test_the_other_presets_sample_uniformly(preset: str) -> None:
    assert not load(preset).replay.prioritized


def test_the_length_of_a_record_follows_from_the_codec() -> None:
    assert load(None, {"arena.codec": "frames"}).arena.record_bytes == 3600
    assert load(None, {"arena.num_robots": "4"}).arena.record_bytes == 80


def test_the_way_to_a_run_is_known_before_its_other_settings() -> None:
    given = {"transport.timeout_s": "2", "learner.batch_size": "64"}
    assert load_transport(given, environ={}).timeout_s == 2
    with pytest.raises(ConfigError, match="not below"):
        load_config(None, given, environ={})


def test_the_way_to_a_run_may_stand_in_a_file(write: Any) -> None:
    source = write("[transport]\ntimeout_s = 7\nmax_message_bytes = 9\n[learner]\nseed = 1\n")
    transport = load_transport({"transport.timeout_s": "8"}, environ={}, source=source)
    assert (transport.timeout_s, transport.max_message_bytes) == (8, 9)


def test_a_wrong_way_to_a_run_is_named() -> None:
    with pytest.raises(ConfigError, match=r"transport\.timeout_s: must be above 0 and .*given -1"):
        load_transport({"transport.timeout_s": "-1"}, environ={})


def test_the_environment_counts_in_a_service_that_joins() -> None:
    table = Config().model_dump()
    environ = {"MRCDRL_LEARNER__THREADS": "3", "MRCDRL_LEARNER__SEED": "4"}
    joined = apply_overrides(table, {"learner.seed": "5"}, environ)
    assert (joined.learner.threads, joined.learner.seed) == (3, 5)


@pytest.mark.parametrize("name", ["ca", "certificate", "key"])
def test_certificates_are_given_together(name: str) -> None:
    with pytest.raises(ConfigError, match="give ca, certificate and key together"):
        load_transport({f"transport.{name}": "file.pem"}, environ={})


@pytest.mark.parametrize(
    ("overrides", "num_robots", "robots"),
    [
        ({}, 4, (1, 2, 3, 4)),
        ({"arena.num_robots": "3"}, 3, ()),
        ({"arena.robots": "[1, 6]"}, 6, (1, 6)),
        ({"arena.num_robots": "2", "arena.robots": "[2]"}, 2, (2,)),
    ],
)
def test_of_num_robots_and_robots_the_one_given_last_counts(
    overrides: dict[str, str], num_robots: int, robots: tuple[int, ...]
) -> None:
    loaded = load("curriculum", overrides).arena
    assert (loaded.num_robots, loaded.robots) == (num_robots, robots)
    assert loaded.numbers == (robots or (num_robots,))
    assert apply_overrides(tomllib.loads(to_toml(load("curriculum", overrides))), {}, {}).arena == (
        loaded
    ), "a run's file names both"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[arena]\nrobots = [4, 1]", "robots [4, 1] do not rise"),
        ("[arena]\nrobots = [0, 1]", "rise from 1 or more"),
        ("[arena]\nrobots = [1, 11]", "arena.num_robots: must be between 1 and 10 (given 11)"),
        ("[arena]\nrobots = 4", "arena.robots: must be a list, such as [1]"),
        ("[arena]\nnum_robots = 3\nrobots = [1, 4]", "num_robots 3 is not the last of robots"),
        (
            "[arena]\nrobots = [1, 2]\ntargets_px = [[100, 100], [300, 300]]",
            "targets_px has the same 2 targets for each of robots [1, 2]: set num_targets too",
        ),
        (
            '[arena]\nrobots = [1, 2]\nkind = "counting"\ncodec = "frames"',
            'kind = "counting" needs a fixed number of robots',
        ),
        (
            "[arena]\nrobots = [1, 2]\n[curriculum]\nschedule = [[0, 1]]",
            "curriculum.schedule needs points of a learner step and a weight for each",
        ),
        ("[curriculum]\nschedule = [[5, 1]]", "schedule needs points whose steps rise from 0"),
        ("[curriculum]\nschedule = [[0, 0]]", "a point without one above 0"),
        ("[curriculum]\nschedule = [[0, -1]]", "schedule has a weight below 0"),
        (
            "[arena]\nrobots = [1, 2]\n[run]\nturn_size = 16",
            "run.turn_size 16 needs one number of robots (arena.robots)",
        ),
    ],
)
def test_numbers_of_robots_that_make_no_sense_are_refused(
    write: Any, text: str, reason: str
) -> None:
    assert reason in refusal(write(text))
