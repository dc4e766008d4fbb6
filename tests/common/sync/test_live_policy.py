"""A LivePolicy acts as the run's own policy would, with the newest weights, or says why not."""

import importlib.util
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from mrcdrl.common.config import Config, TransportConfig, load_config, to_toml
from mrcdrl.common.errors import DeadlineError, EndpointError
from mrcdrl.common.messages.trajectory import UInt8Array, Weights
from mrcdrl.common.model.policy import Policy, averaged_symmetries
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import network_from_bytes, weights_to_bytes
from mrcdrl.common.sync.live_policy import LivePolicy
from mrcdrl.common.sync.weights import WeightsWriter
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import PATIENCE_S

RUN = "followed"
SMALL = {"arena.view_px": "32", "arena.max_frames": "20", "learner.precision": "float32"}
EXAMPLE = Path(__file__).parents[3] / "examples" / "live_policy.py"


@dataclass(frozen=True, slots=True)
class Run:
    """The parts of a run that a LivePolicy sees: its configuration and its weights."""

    endpoint: str
    config: Config
    writer: WeightsWriter
    session: Session

    def publish(self, version: int, view_px: int = 32, epoch: int = 1) -> bytes:
        with torch.random.fork_rng():
            torch.manual_seed(version)
            payload = weights_to_bytes(QNetwork("duel", view_px=view_px))
        self.writer.publish(Weights.of(epoch, version, 10 * version, payload))
        return payload


@pytest.fixture
def run() -> Iterator[Run]:
    endpoint, keys, config = free_endpoint(), Keys(RUN), load_config("smoke", SMALL, environ={})
    with Session(TransportConfig(listen=(endpoint,))) as session:
        configs, ended = session.server(keys.config), threading.Event()

        def serve() -> None:
            while not ended.is_set():
                request = configs.take(0.1)
                if request is not None:
                    request.reply(to_toml(config).encode())

        server = threading.Thread(target=serve)
        server.start()
        writer = WeightsWriter(session, keys)
        yield Run(endpoint, config, writer, session)
        writer.close()
        ended.set()
        server.join()


def images(step: int, num_robots: int = 2) -> UInt8Array:
    rng = np.random.default_rng(step)
    return rng.integers(0, 256, (num_robots, 32, 32), dtype=np.uint8)


def adopted(policy: LivePolicy, version: int) -> None:
    """Act until it acts with this version."""
    act_until(policy, lambda: policy.version == version)


def act_until(policy: LivePolicy, reached: Callable[[], bool]) -> None:
    pause, deadline = threading.Event(), time.monotonic() + PATIENCE_S
    while True:
        policy.act(images(0))
        if reached():
            return
        assert time.monotonic() < deadline, f"still {policy}"
        pause.wait(0.1)


def test_it_acts_on_stacks_by_the_newest_weights(run: Run) -> None:
    same = Policy(network_from_bytes(run.publish(1)), averaged_symmetries(run.config))
    with LivePolicy(RUN, run.endpoint) as policy:
        assert (policy.version, policy.refused) == (1, 0)
        assert policy.config.arena == run.config.arena
        seen = [images(step) for step in range(6)]
        actions = [policy.act(frame) for frame in seen]
        stacks = [np.stack([seen[max(0, step - a)] for a in (3, 2, 1, 0)], 1) for step in range(6)]
        for states, chosen in zip(stacks, actions, strict=True):
            expected = same.q_values(states).argmax(axis=1)
            assert chosen.dtype == np.uint8
            np.testing.assert_array_equal(chosen, expected)
            np.testing.assert_array_equal(policy.act(states), expected)
        policy.begin(np.array([1]))
        policy.act(images(6))
        stack = policy._frames.stacks
        assert (stack[1] == images(6)[1]).all(), "the second robot began again"
        assert (stack[0, 2] == seen[5][0]).all(), "and the first did not"
        assert policy.act(images(7, num_robots=3)).shape == (3,)


def test_it_follows_and_says_how_stale_it_is(run: Run) -> None:
    run.publish(1)
    with LivePolicy(RUN, run.endpoint) as policy:
        adopted(policy, 1)
        before = policy.staleness_s
        assert policy.staleness_s > before >= 0.0
        run.publish(2)
        adopted(policy, 2)
        run.publish(3, view_px=40)
        run.session.publisher(Keys(RUN).weights).put(b"torn")
        run.publish(4)
        adopted(policy, 4)
        assert "version=4" in repr(policy)


def test_weights_of_another_network_do_not_block_those_of_the_run(run: Run) -> None:
    run.publish(1)
    with LivePolicy(RUN, run.endpoint) as policy:
        for version in (2, 3):
            refused = policy.refused
            run.publish(10**6, view_px=40, epoch=2)
            act_until(policy, lambda before=refused: policy.refused > before)
            run.publish(version)
            adopted(policy, version)


def test_without_weights_it_says_so(run: Run) -> None:
    with pytest.raises(DeadlineError, match=r"no weights of run 'followed' .* is its learner up"):
        LivePolicy(RUN, run.endpoint, timeout_s=0.5)


def test_an_unknown_run_and_a_dead_endpoint_are_said(run: Run) -> None:
    with pytest.raises(DeadlineError, match=r"'another'.* is that the run's name"):
        LivePolicy("another", run.endpoint, timeout_s=0.5)
    with pytest.raises(EndpointError, match="nobody answers"):
        LivePolicy(RUN, free_endpoint(), timeout_s=0.5)


def test_the_example_plays(run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run.publish(5)
    spec = importlib.util.spec_from_file_location("live_policy", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    folder = tmp_path / RUN
    folder.mkdir()
    (folder / "endpoint").write_text(run.endpoint)
    example.main(folder, episodes=2)
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(" of ")[2] for line in lines] == ["1, version 5", "2, version 5"]
