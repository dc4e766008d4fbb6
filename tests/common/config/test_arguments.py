"""Flags made from the schema, and suggestions for unknown ones."""

import re
from pathlib import Path

import pytest

from mrcdrl.common.config import load_config, sections
from mrcdrl.common.config.arguments import (
    SEEDS,
    Parser,
    add_config_flags,
    overrides,
    whole_number,
)

FIELDS = [(section, name) for section, model in sections().items() for name in model.model_fields]


def make_parser() -> Parser:
    parser = Parser(prog="mrcdrl test")
    parser.add_argument("--run-dir")
    add_config_flags(parser)
    return parser


def given(*argv: str) -> dict[str, str]:
    return overrides(make_parser().parse_args(argv))


def refused(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The one-line error for these arguments."""
    with pytest.raises(SystemExit) as ended:
        make_parser().parse_args(argv)
    assert ended.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def test_every_field_has_a_flag() -> None:
    flags = [f"--{section}.{name}={index}" for index, (section, name) in enumerate(FIELDS)]
    expected = {f"{section}.{name}": str(index) for index, (section, name) in enumerate(FIELDS)}
    assert given(*flags) == expected


def test_a_seed_sets_those_of_training_that_have_no_flag_of_their_own() -> None:
    assert given("--seed", "7") == dict.fromkeys(SEEDS, "7")
    for flags in (("--seed", "7", "--learner.seed", "8"), ("--learner.seed", "8", "--seed", "7")):
        assert given(*flags) == dict.fromkeys(SEEDS, "7") | {"learner.seed": "8"}


def test_a_command_keeps_a_flag_of_its_own() -> None:
    parser = Parser(prog="mrcdrl test")
    for flag in ("--actors", "--seed"):
        parser.add_argument(flag)
    add_config_flags(parser)
    parsed = parser.parse_args(["--actors", "3", "--seed", "4", "--run.actors", "5"])
    assert (parsed.actors, parsed.seed) == ("3", "4")
    assert overrides(parsed) == {"run.actors": "5"}


def test_flags_may_stand_anywhere() -> None:
    parser = make_parser()
    parser.add_argument("figure")
    parser.add_argument("weights", nargs="*")
    words = ["comparison", "a", "b"]
    for flag_at in range(4):
        argv = [*words[:flag_at], "--agent.kind", "dqn", *words[flag_at:]]
        parsed = parser.parse_args(argv)
        assert [parsed.figure, *parsed.weights] == words
        assert overrides(parsed) == {"agent.kind": "dqn"}


def test_only_what_is_given_overrides() -> None:
    assert given() == {}
    assert given("--run-dir", "here", "--agent.gamma=0.9", "--arena.collision_reward", "-7") == {
        "agent.gamma": "0.9",
        "arena.collision_reward": "-7",
    }


def test_flags_reach_the_configuration() -> None:
    flags = given("--arena.num_robots", "3", "--agent.kind", "dqn", "--learner.symmetries", "true")
    config = load_config(None, flags, environ={})
    assert (config.arena.num_robots, config.agent.kind) == (3, "dqn")
    assert config.learner.symmetries is True


@pytest.mark.parametrize(
    ("argument", "near"),
    [
        ("--arena.num_robot", "--arena.num_robots"),
        ("--learner.batchsize=64", "--learner.batch_size"),
        ("--agent.n_steps", "--agent.n_step"),
        ("--run_dir", "--run-dir"),
        ("--batch-size", "--learner.batch_size"),
        ("--threads", "--actor.threads, --learner.threads or --evaluator.threads"),
    ],
)
def test_an_unknown_flag_gets_the_nearest_as_a_suggestion(
    argument: str, near: str, capsys: pytest.CaptureFixture[str]
) -> None:
    line = refused(capsys, argument)
    assert f"unknown argument {argument.split('=')[0]}; did you mean {near}?" in line
    assert "see mrcdrl test --help" in line


def test_an_argument_like_no_flag_gets_no_suggestion(capsys: pytest.CaptureFixture[str]) -> None:
    assert refused(capsys, "xyzzy") == "mrcdrl: unknown argument xyzzy (see mrcdrl test --help)\n"


def test_there_are_no_abbreviations(capsys: pytest.CaptureFixture[str]) -> None:
    assert "did you mean --agent.gamma?" in refused(capsys, "--agent.gam", "0.5")
    assert "did you mean --run-dir?" in refused(capsys, "--run-di", "x")


def test_a_flag_without_its_value_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--agent.gamma: expected one argument" in refused(capsys, "--agent.gamma")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("-1", "-1 must be at least 0"),
        ("1.5", "'1.5' is not a whole number"),
        (str(2**63), f"{2**63} must be at most"),
    ],
)
def test_a_number_out_of_range_is_one_line(
    text: str, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    parser = make_parser()
    parser.add_argument("--count", type=whole_number(0))
    assert parser.parse_args(["--count", "7"]).count == 7
    with pytest.raises(SystemExit):
        parser.parse_args(["--count", text])
    assert f"argument --count: {reason}" in capsys.readouterr().err


ROOT = Path(__file__).parents[3]
COMMANDS = [path for top in ("common", "services") for path in (ROOT / top).rglob("*.py")]


def test_no_flag_takes_a_number_without_limits() -> None:
    unlimited = [
        f"{path.relative_to(ROOT)}: {found}"
        for path in COMMANDS
        for found in re.findall(
            r"add_argument\([^#]*?type=(?:int|float)\b", path.read_text("utf-8")
        )
    ]
    assert unlimited == []
