"""Facts of settings: what is said of each, and where its value comes from."""

from pathlib import Path

import pytest

from mrcdrl.common.config import load_config, preset_names
from mrcdrl.common.config.explain import explain, explained
from mrcdrl.common.config.load import origin
from mrcdrl.common.config.settings import all_settings, find_setting, listed
from mrcdrl.common.errors import ConfigError

FACTS = {
    "arena.num_robots": ("integer between 1 and 10", "", "N", "between 1 and 10"),
    "arena.target_layout": ("fixed or random", "", "WORD", ""),
    "agent.loss": ("squared or huber", "", "WORD", "squared or huber"),
    "learner.symmetries": ("true or false", "", "WORD", "true or false"),
    "arena.turn_deg": ("number at least 0.1 and below 180", "degrees", "DEGREES", ""),
    "replay.hold_s": ("number above 0 and at most 1e+09", "seconds", "SECONDS", ""),
    "run.seed": ("integer between 0 and 9223372036854775807", "", "N", ""),
    "arena.targets_px": ("list of [number, number]", "px", "LIST", ""),
    "learner.device": ("text", "", "TEXT", ""),
}


@pytest.mark.parametrize("key", FACTS)
def test_facts_are_read_off_the_schema(key: str) -> None:
    setting = find_setting(key)
    assert (setting.allowed, setting.unit, setting.metavar, setting.hint) == FACTS[key]


def test_every_setting_says_what_it_means_and_whose_its_default_is() -> None:
    assert [s.key for s in all_settings() if not (s.meaning and s.source)] == []


@pytest.mark.parametrize(
    ("key", "near"),
    [
        ("learner.bach_size", "learner.batch_size"),
        ("batch_size", "learner.batch_size"),
        ("seed", "replay.seed, learner.seed, evaluator.seed or run.seed"),
        ("lerner.threads", "actor.threads, learner.threads or evaluator.threads"),
    ],
)
def test_an_unknown_setting_gets_the_nearest(key: str, near: str) -> None:
    with pytest.raises(ConfigError, match=f"no setting '{key}'; did you mean {near}\\?"):
        find_setting(key)


def test_words_are_listed() -> None:
    assert [listed("abc"[:n]) for n in range(4)] == ["", "a", "a or b", "a, b or c"]


def test_the_origin_of_a_value(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('extends = "hard"\n[learner]\nbatch_size = 48\n', "utf-8")
    environ = {"MRCDRL_AGENT__GAMMA": "0.9", "MRCDRL_RUN__MINUTES": "3"}
    flags = {"run.minutes": "4"}
    expected = {
        "run.minutes": "a flag",
        "agent.gamma": "the environment, MRCDRL_AGENT__GAMMA",
        "learner.batch_size": str(mine),
        "arena.target_layout": "preset hard",
        "agent.n_step": "preset quick",
        "arena.num_robots": "its default",
    }
    assert {key: origin(key, str(mine), flags, environ) for key in expected} == expected


def test_a_value_differs_from_its_default_only_where_something_sets_it() -> None:
    """What `origin` calls a default has the default's value, in every preset."""
    for preset in preset_names():
        values = load_config(preset, environ={}).model_dump()
        for setting in all_settings():
            if origin(setting.key, preset, environ={}) == "its default":
                assert values[setting.section][setting.name] == setting.default, setting.key


def test_a_setting_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MRCDRL_REPLAY__MIN_SIZE", "7000")
    facts = explain("replay.min_size", "quick", {})
    assert explained(facts).splitlines() == [
        "replay.min_size",
        "  meaning    Transitions inserted before the first sample.",
        "  allowed    integer at least 1",
        "  default    50000 (paper)",
        "  in force   7000, from the environment, MRCDRL_REPLAY__MIN_SIZE",
        "  flag       --replay.min_size",
        "  variable   MRCDRL_REPLAY__MIN_SIZE",
        "  on resume  cannot change with run.turn_size, and can otherwise",
    ]
    assert "  unit       seconds" in explained(explain("replay.hold_s", None, {}))
    assert explain("agent.gamma", None, {})["kept"] == "always"
    assert explain("run.minutes", None, {"run.minutes": "9"})["value"] == 9
