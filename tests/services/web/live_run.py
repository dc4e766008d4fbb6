"""A run that is up, without its services: who is there, what they publish, and what is recorded."""

import json
import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Self

import numpy as np

from mrcdrl.common.arena import Scene
from mrcdrl.common.config import Config, TransportConfig, load_config
from mrcdrl.common.messages.trajectory import Evaluation, Outcome, Stats
from mrcdrl.common.messages.wire import encode
from mrcdrl.common.runtime.closing import Closing
from mrcdrl.common.sync.broadcast import Broadcast, Moment
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor.records import to_line
from tests.patience import PATIENCE_S
from tests.services.web.web_server import record_run

SMOKE = load_config("smoke", {"agent.n_step": "2"}, environ={})
WORLD = load_config(
    "smoke",
    {
        "arena.env": "nobody.imports:this",
        "arena.num_actions": "5",
        "arena.codec": "frames",
        "learner.symmetries": "false",
    },
    environ={},
)
FRAMES = 40  # of an episode
_PERIOD_S = 0.2  # between reports
_STEP_S = 0.02  # between frames that the worker plays


class LiveRun(Closing):
    """Its thread, `run`, reports and plays until it is closed."""

    def __init__(self, path: Path, config: Config) -> None:
        self.path = path
        self.keys = Keys(path.name)
        self.endpoint = free_endpoint()
        self.extra: Callable[[Self], None] = lambda _: None  # called with each report
        record_run(path, config)
        (path / "summary.json").unlink()
        (path / "endpoint").write_text(self.endpoint, "ascii")
        self.config = config
        self.session = Session(TransportConfig(listen=(self.endpoint,)))
        self.worker = Session(TransportConfig(connect=(self.endpoint,)))
        for role, name in (("learner", "learner-0"), ("actor", "actor-0"), ("replay", "replay-0")):
            self.worker.announce(self.keys.live(role, name))
        self.worker.announce(self.keys.live("evaluator", "evaluator-0"))
        self.publisher = self.worker.watched_publisher(self.keys.arena("actor", "actor-0"))
        self._broadcast = Broadcast(self.publisher, "actor", "actor-0")
        self._second = 29.0
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=target, name=name)
            for name, target in (("report", self._report), ("play", self._play))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End it, as if it had been stopped."""
        self._stop.set()
        for thread in self._threads:
            thread.join(PATIENCE_S)
        self._broadcast.close()
        self.worker.close()
        self.session.close()
        summary = {"stop_reason": "stopped (Ctrl-C)", "wall_s": self._second + 1}
        (self.path / "summary.json").write_text(json.dumps(summary), "utf-8")

    def publish(self, stats: Stats) -> None:
        """Publish statistics, once."""
        self.worker.publisher(self.keys.stats(stats.role, stats.id)).put(encode(stats))

    def evaluate(self, success: float) -> None:
        """Publish an evaluation."""
        rest = (1 - success, 0.0, (0.1, 0.9), 5, 5, 0, 9, 1, 0, 1)
        result = Evaluation("evaluator-0", 7, 4, 300, 2, 10, success, *rest)
        self.worker.publisher(self.keys.evaluation("evaluator-0")).put(encode(result))

    def _report(self) -> None:
        reports = {
            role: self.worker.publisher(self.keys.stats(role, f"{role}-0"))
            for role in ("learner", "actor", "replay")
        }
        while not self._stop.wait(_PERIOD_S):
            self._second += _PERIOD_S
            steps = 10 * self._second
            metrics = {
                "learner": {"learner_steps": steps, "loss": 0.1, "weights_version": 3.0},
                "actor": {"robot_steps": 4 * steps, "epsilon_max": 0.5, "epsilon_min": 0.5},
                "replay": {"size": 900.0, "capacity": 1000.0, "samples_per_insert": 4.0},
            }
            for role, values in metrics.items():
                started = {"incarnation": "1700000000000000000"}
                reports[role].put(encode(Stats(role, f"{role}-0", values, started)))
            recorded: dict[str, float] = {"time_s": self._second, "learner_steps": steps}
            for role, values in metrics.items():
                recorded |= {f"{role}/{role}-0/{name}": value for name, value in values.items()}
            line = to_line(recorded)
            with (self.path / "metrics.jsonl").open("a", encoding="utf-8") as file:
                file.write(line)
            self.extra(self)

    def _play(self) -> None:
        """Play one episode after another: two robots on circles, who meet now and then."""
        frame, size, view = 0, self.config.arena.size_px, self.config.arena.view_px
        targets = np.array([[0.25, 0.25], [0.75, 0.75]]) * size
        while not self._stop.wait(_STEP_S):
            if not self._broadcast.watched:
                continue
            angles = 2 * math.pi * (frame / FRAMES + np.array([0.0, 0.5]))
            places = size * (0.5 + 0.3 * np.stack([np.cos(angles), np.sin(angles)], axis=1))
            scene = Scene(np.column_stack([places, angles + math.pi / 2]), targets)
            if self.config.arena.is_custom:
                scene = Scene(np.zeros((2, 3)), np.zeros((2, 2)))
            images = np.zeros((2, view, view), np.uint8)
            images[:, frame % view, :] = 255
            moment = Moment(frame, scene, images, 3, 0.25)
            values = np.full((2, self.config.arena.action_count), -2, np.float32)
            values[:, :3] = [[0.1, 0.2, 0.3], [-1.0, 0.5, 0.2]]
            self._broadcast.acts(moment, values, np.array([2, 0], np.uint8))
            frame += 1
            last = frame == FRAMES
            collided = np.array([frame % 10 == 0, False])
            after = Moment(frame, scene, images, 3, 0.25) if last else None
            self._broadcast.stepped(collided, after, Outcome.SUCCESS if last else None)
            frame %= FRAMES
