"""The command line of replay: a run that has begun keeps what its records depend on."""

from pathlib import Path

import pytest

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.errors import RunDirectoryError
from mrcdrl.services.replay.serving import Serving


@pytest.fixture
def begun(tmp_path: Path) -> list[str]:
    """Flags for a run whose configuration is in its directory, as the recorder keeps it there."""
    (tmp_path / "stack").mkdir()
    config = load_config("smoke", {}, environ={})
    (tmp_path / "stack" / "config.toml").write_text(to_toml(config))
    return ["--run", "stack", "--run-dir", str(tmp_path), "--listen", "tcp/127.0.0.1:1"]


def test_replay_of_other_transitions_is_refused(
    begun: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RunDirectoryError, match=r"agent\.n_step is 7 here and 5 in .*stack"):
        Serving.from_argv([*begun, "--agent.n_step", "7"])
    monkeypatch.setenv("MRCDRL_ARENA__NUM_ROBOTS", "3")
    for flags in ([], ["--config", "smoke"]):  # as containers are given it
        with pytest.raises(RunDirectoryError, match=r"arena\.num_robots is 3 here and 2 in"):
            Serving.from_argv([*begun, *flags])


def test_replay_may_change_the_rest(begun: list[str]) -> None:
    serving = Serving.from_argv([*begun, "--config", "smoke", "--replay.hold_s", "2"])
    assert serving.config.replay.hold_s == 2


def test_a_run_without_a_directory_begins_with_any_settings(tmp_path: Path) -> None:
    flags = ["--run", "new", "--run-dir", str(tmp_path), "--listen", "tcp/127.0.0.1:1"]
    assert Serving.from_argv([*flags, "--agent.n_step", "3"]).config.agent.n_step == 3
