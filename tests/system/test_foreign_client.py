"""The client that shares no code with us joins a real replay service, and learns what is there."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from mrcdrl.common.config import TransportConfig, load_config
from mrcdrl.common.messages.trajectory import Evaluation, Weights
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.model.q_network import QNetwork
from mrcdrl.common.model.weights_io import weights_to_bytes
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from tests.patience import eventually
from tests.system.system_processes import (
    PATIENCE_S,
    REPOSITORY,
    Command,
    environment,
    run_name,
)

pytestmark = [pytest.mark.system, pytest.mark.timeout(2 * PATIENCE_S)]

EXAMPLES = REPOSITORY / "examples"
CLIENT = EXAMPLES / "foreign_client.py"
ALLOWED = {"zenoh", "msgpack", "numpy", "foreign_images", *sys.stdlib_module_names}


@pytest.mark.parametrize("name", ["foreign_client.py", "foreign_images.py"])
def test_it_imports_nothing_of_ours(name: str) -> None:
    tree = ast.parse((EXAMPLES / name).read_text("utf-8"))
    imported = {
        (alias.name if isinstance(node, ast.Import) else str(node.module)).split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert "numpy" in imported
    assert imported <= ALLOWED


def said(*arguments: str) -> str:
    """What the client prints until it ends."""
    result = subprocess.run(
        [sys.executable, str(CLIENT), *arguments],
        capture_output=True,
        text=True,
        env=environment(),
        timeout=PATIENCE_S,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.mark.parametrize("codec", ["scene", "frames"])
def test_it_inserts_and_samples_what_it_inserted(codec: str, tmp_path: Path) -> None:
    name, endpoint = run_name("foreign"), free_endpoint()
    settings = {"replay.sampler": "prioritized", "arena.codec": codec, "replay.min_size": "64"}
    flags = [f"--{setting}={value}" for setting, value in settings.items()]
    served = ["replay", "--run", name, "--run-dir", tmp_path, "--listen", endpoint]
    config = load_config("smoke", settings, environ={})
    window = config.arena.stack + config.agent.n_step
    with Command([*served, "--config", "smoke", *flags], tmp_path) as replay:
        eventually(lambda: "replay: serving" in replay.err, "replay serves")
        total = config.arena.max_frames // config.actor.chunk_length * config.actor.chunk_length
        assert said(endpoint, name, "insert") == (
            f"inserted {total} transitions in all, duplicate: False\n"
        )
        shape = f"{config.learner.batch_size} {window} {config.arena.record_bytes}"
        assert said(endpoint, name, "sample") == (
            f"sampled {shape} of {total}\n"
            f"priorities {config.learner.batch_size} updated 0 ignored\n"
        )


def test_it_reads_weights_and_follows_evaluations(tmp_path: Path) -> None:
    name, endpoint = run_name("foreign"), free_endpoint()
    keys = Keys(name)
    weights = Weights.of(7, 3, 100, weights_to_bytes(QNetwork("duel")))
    test = Evaluation("e", 7, 3, 100, 2, 10, 0.5, 0.5, 0, (0.2, 0.8), 5, 5, 0, 9, 1, 0, 1)
    served = ["replay", "--run", name, "--run-dir", tmp_path, "--listen", endpoint]
    printed = tmp_path / "printed"
    with (
        Command([*served, "--config", "smoke"], tmp_path),
        Session(TransportConfig(connect=(endpoint,)), open_timeout_s=PATIENCE_S) as session,
        printed.open("wb") as output,
    ):
        asked = session.server(keys.weights)
        publisher = session.publisher(keys.evaluation("e"))
        client = subprocess.Popen(
            [sys.executable, str(CLIENT), endpoint, name],
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment(),
        )

        def both() -> bool:
            request = asked.take(0.0)
            if request is not None:
                request.reply(encode(weights))
            publisher.put(encode(test))
            lines = printed.read_text("utf-8").splitlines()
            return any("duel" in line for line in lines) and "evaluation 3 0.5" in lines

        try:
            eventually(both, f"the client shows both: {printed}", pause_s=0.2)
        finally:
            client.terminate()
            client.wait(PATIENCE_S)
    assert printed.read_text("utf-8").startswith("weights 3 duel [")
