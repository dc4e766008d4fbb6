"""`mrcdrl simulate`: what simulated actors send is what actors send, and what limits is named."""

import math
import os
import resource
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from mrcdrl.common.config import load_config
from mrcdrl.common.errors import ConfigError, UnreachableError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.services.replay.table import Table
from mrcdrl.services.tools.simulate.actors import EPISODE_FRAMES, episode_chunks, published_s
from mrcdrl.services.tools.simulate.load import Load, Totals, Usage, bottleneck, busy_cores, latency
from mrcdrl.services.tools.simulate.main import _check_open_files, main


@pytest.mark.parametrize(
    ("settings", "priorities"),
    [
        ({}, 0),
        ({"replay.sampler": "prioritized"}, 1),
        ({"arena.codec": "frames", "arena.num_robots": "4"}, 0),
    ],
)
def test_chunks_are_those_of_whole_episodes(settings: dict[str, str], priorities: int) -> None:
    config = load_config("quick", {**settings, "replay.capacity": "6000"}, environ={})
    table = Table.from_config(config)
    chunks = episode_chunks(config)
    for chunk in chunks:
        table.check(chunk)
        assert len(chunk.priorities) == priorities * len(chunk)
    length = config.actor.chunk_length
    full, rest = divmod(EPISODE_FRAMES, length)
    assert Counter(map(len, chunks)) == {length: 8 * full, rest: 8}
    assert sum((chunk.discounts == 0).any() for chunk in chunks) == 8


# -- limits ------------------------------------------------------------------------------


def using(cores: float) -> Usage:
    return Usage(cores, 0.0, 100.0, 9)


IDLE = {"replay-0": using(0.4), "actors-0": using(0.3)}
LIMITS = {
    "none": (Load(1000, 990, 0.0, 2.0, 4, 1.0, IDLE), "none"),
    "held": (Load(1000, 500, 0.5, 900.0, 4, 1.0, IDLE), "the rate limiter"),
    "machine": (
        Load(math.inf, 500, 0.0, 9.0, 2, 1.99, {"replay-0": using(0.95)}),
        "the machine's 2 cores: replay-0 0.95, all others 1.04",
    ),
    "replay": (
        Load(math.inf, 500, 0.0, 9.0, 8, 3.0, {"actors-0": using(0.5), "replay-0": using(1.2)}),
        "replay-0: it fills a core (1.20)",
    ),
    "simulation": (Load(9, 1, 0.0, 9.0, 8, 3.0, {"actors-1": using(0.97)}), "the simulation"),
    "way": (Load(math.inf, 500, 0.0, 9.0, 4, 1.0, IDLE), "an acknowledgement takes 9.0 ms"),
    "nothing": (Load(1000, 0, 0.0, None, 4, None, {}), "did not acknowledge"),
}


def test_weights_that_are_late_are_a_limit_and_the_simulation_tells_its_own_share() -> None:
    usage = {"replay-0": using(0.9), "actors-0": using(0.8), "simulate": using(0.1)}
    ours = frozenset({"actors-0", "simulate"})
    said = bottleneck(Load(1000, 1000, 0.0, 2.0, 2, 1.98, usage, 12_300.0, ours))
    assert said.startswith("weights: actors have them 12.3 s after they are published; ")
    assert said.endswith("all others 0.18; the simulation itself took 0.90")
    assert bottleneck(Load(1000, 1000, 0.0, 2.0, 2, 1.98, usage, 900.0, ours)).startswith("none")


@pytest.mark.parametrize(("load", "said"), LIMITS.values(), ids=LIMITS)
def test_the_bottleneck_is_named(load: Load, said: str) -> None:
    assert said in bottleneck(load)


def test_what_a_process_used_is_read() -> None:
    first, busy_s = Totals.of(os.getpid()), busy_cores()
    assert first is not None
    assert busy_s is not None
    while (last := Totals.of(os.getpid())) is not None and last.cpu_s <= first.cpu_s:
        pass
    assert last is not None
    used = Usage.between(first, last, 0.5)
    assert used.cores > 0
    assert used.memory_mib > 1
    assert used.threads >= 1
    assert Totals.of(2**22 + 1) is None  # above what Linux numbers


def test_latency_in_milliseconds() -> None:
    assert latency(np.linspace(0, 1, 101)) == {"p50": 500.0, "p99": 990.0, "max": 1000.0}
    assert latency(np.empty(0)) == {"p50": None, "p99": None, "max": None}


def test_weights_say_when_a_simulated_learner_published_them() -> None:
    weights = Weights.of(2**62, 3, 12_345_678_901, bytes(1000))
    assert published_s(weights) == pytest.approx(12.345678901)


# -- refusals ----------------------------------------------------------------------------

REFUSED = {
    "no actors": (["--actors", "0"], "--actors"),
    "no number": (["--actors", "many"], "--actors"),
    "no time": (["--minutes", "0"], "--minutes"),
    "no rate": (["--rate", "-3"], "--rate"),
    "no frequency": (["--publications", "nan"], "--publications"),
    "an endpoint without run": (["--connect", "tcp/127.0.0.1:1"], "needs the run's name"),
    "a real run": (["--run", "four", "--connect", "tcp/127.0.0.1:1"], "'simulate', or --force"),
    "settings of a run": (
        ["--run", "simulate-1", "--connect", "tcp/127.0.0.1:1", "--replay.capacity", "9"],
        "--replay.capacity is set by the run",
    ),
    "a misspelt flag": (["--actor", "3"], "did you mean --actors?"),
}


@pytest.mark.parametrize(("flags", "said"), REFUSED.values(), ids=REFUSED)
def test_bad_input_is_refused(
    flags: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(flags)
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


def test_too_few_places_are_reported_before_anything_starts() -> None:
    with pytest.raises(ConfigError, match=r"for 45 actors: give --transport.max_peers 56 or more"):
        main(["--actors", "45", "--transport.max_peers", "50"])


def test_a_run_that_is_not_up_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnreachableError, match=r"no run 'simulate-1'.*give --connect"):
        main(["simulate-1", "--run-dir", str(tmp_path)])


def test_too_few_open_files_are_reported_before_anything_starts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1024, 4096))
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: asked.append(limits))
    _check_open_files(100)
    assert asked == []
    _check_open_files(500)
    assert asked == [(1700, 4096)]
    with pytest.raises(ConfigError, match="2000 actors need 6200 open files"):
        _check_open_files(2000)
