"""A whole run among hostile peers: nothing ends, its records stay sound, and it learns on.

`python -m benchmarks.hostile_run --seconds 60` starts `mrcdrl train`, `mrcdrl status --watch`, and
an actor and an evaluator that join by hand. Peers then send random bytes and valid schemas with
extreme values (hostile_messages.py) on every key of the run, and answer in place of replay and the
learner for a third of the time. Prints one line of JSON with what was sent and what the run did
meanwhile and before; exit code 1, with the reasons, if something ended or a record is unsound.
tests/system/test_hostile_run.py does the same for a few seconds.
"""

import argparse
import collections
import json
import math
import os
import re
import signal
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zenoh

from benchmarks.hostile_messages import HostileMessages
from benchmarks.machine import emit
from mrcdrl.common.config import Config, load_config
from mrcdrl.common.messages.trajectory import (
    InsertReply,
    LeaseReply,
    PrioritiesReply,
    Samples,
    Stats,
    Weights,
)
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.monitor.records import read_evaluations, read_last_metrics
from tests.patience import eventually
from tests.system.system_processes import SMALL, Command, end_all, run_name

RATE = 400.0  # messages a second at most: the run has to have cores left
ENDLESS = ("--learner-steps", "100000000", "--run.target_success_rate", "0.9")
LONGEST_LINE = 1 << 20  # of a record, bytes
LONGEST_LOG = 1 << 20
GREATEST = 2.0**128  # of a recorded number; a float32 is below
WORKERS = ("actor-0", "evaluator-0", "actor-by-hand", "evaluator-by-hand")
_TURN_S = 3.0  # an impostor answers for a third of it


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = run_among(arguments.seconds, arguments.seed, Path(folder))
    emit({"bench": "hostile_run", **result})
    sys.exit(bool(result["faults"]))


def run_among(seconds: float, seed: int, folder: Path, *, at_length: bool = True) -> dict[str, Any]:
    """Run a small run among hostile peers; what came of it.

    at_length: first as long without them; with an actor and an evaluator that join by hand, and
    with a screen on a terminal.
    """
    name = run_name("hostile")
    run = folder / name
    config = load_config("smoke", {"arena.view_px": "32", "arena.max_frames": "30"}, environ={})
    here = ["--run", name, "--run-dir", str(folder)]
    training = ["train", "--config", "smoke", "--run-dir", str(folder), "--name", name]
    joining = [["actor", "--id", "actor-by-hand"], ["evaluator", "--id", "evaluator-by-hand"]]
    alone = None
    try:
        with ExitStack() as owned:
            train = owned.enter_context(Command([*training, *SMALL, *ENDLESS], folder))
            eventually(lambda: run.is_dir() and read_evaluations(run), "an evaluation", pause_s=0.5)
            commands = [["status", "--watch", "--json"], *(joining if at_length else [])]
            others = [owned.enter_context(Command([*c, *here], folder)) for c in commands]
            screen = None
            if at_length:
                screen = owned.enter_context(Screen(["status", "--watch", *here], folder))
                eventually(lambda: _evaluators(run) == 2, "both evaluate", pause_s=0.5)
                alone = _progress(run, seconds)
            else:
                eventually(lambda: others[0].out, "status shows the run")
            with Peers((run / "endpoint").read_text("utf-8"), Keys(name), config, seed) as peers:
                among = _progress(run, seconds)
            eventually(lambda: _progress(run, 2.0)["learner_steps"] > 0, "it learns afterwards")
            faults = [
                f"{each.out_path.name} ended: {each.err[-500:]}"
                for each in (train, *others)
                if each.process.poll() is not None
            ]
            if screen is not None and screen.ended:
                faults.append("the screen ended")
            train.signal(signal.SIGTERM)
            eventually(lambda: _stopping(train), "the run stops")
            train.signal(signal.SIGINT)  # without plots
            if code := train.wait():
                faults.append(f"exit code {code}: {train.err[-500:]}")
            shown = b"" if screen is None else screen.shown
            faults += _faults(run, train.err, others, shown)
    finally:
        end_all(name)
    summary = json.loads((run / "summary.json").read_bytes())
    return {
        "seconds": seconds,
        "seed": seed,
        "sent": dict(sorted(peers.sent.items())),
        "answered_in_place_of_others": dict(sorted(peers.answered.items())),
        "alone": alone,
        "among": among,
        "stop_reason": summary["stop_reason"],
        "learner_steps": summary["learner_steps"],
        "episodes": summary["episodes"],
        "evaluations": summary["evaluation"]["count"],
        "said": _said(run, train.err),
        "faults": faults,
    }


class Screen:
    """`mrcdrl …` on a terminal of its own."""

    def __init__(self, arguments: list[str], folder: Path) -> None:
        main, terminal = os.openpty()
        self._main = main
        self._command = Command(arguments, folder, terminal=terminal, TERM="xterm-256color")
        os.close(terminal)
        self.shown = b""
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def __enter__(self) -> "Screen":
        return self

    def __exit__(self, *_: object) -> None:
        self._command.end()
        self._thread.join()
        os.close(self._main)

    @property
    def ended(self) -> bool:
        return self._command.process.poll() is not None

    def _read(self) -> None:
        while True:
            try:
                self.shown += os.read(self._main, 1 << 16)
            except OSError:  # the terminal has no other end any more
                return


class Peers:
    """One that sends, and one that answers in place of others; both until the block ends."""

    def __init__(self, endpoint: str, keys: Keys, config: Config, seed: int) -> None:
        self.sent: collections.Counter[str] = collections.Counter()
        self.answered: collections.Counter[str] = collections.Counter()
        self._keys = keys
        self._messages = HostileMessages(keys, config, seed)
        self._replies = HostileMessages(keys, config, seed + 1)
        self._ended = threading.Event()
        settings = zenoh.Config()
        settings.insert_json5("mode", '"client"')
        settings.insert_json5("connect/endpoints", json.dumps([endpoint]))
        settings.insert_json5("scouting/multicast/enabled", "false")
        self._settings = settings
        self._threads = [threading.Thread(target=work) for work in (self._send, self._answer)]

    def __enter__(self) -> "Peers":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _send(self) -> None:
        with zenoh.open(self._settings) as session:
            began_s = time.monotonic()
            for number, act in enumerate(self._messages):
                late_s = time.monotonic() - began_s - number / RATE
                if self._ended.wait(max(0.0, -late_s)):
                    return
                self.sent[f"{act.verb} {act.kind}"] += 1
                if act.verb == "put":
                    session.put(act.key, act.payload)
                else:
                    ignore = zenoh.handlers.Callback(_ignore, indirect=False)
                    session.get(act.key, ignore, payload=act.payload, timeout=1.0)

    def _answer(self) -> None:
        keys = self._keys
        due = (
            (keys.insert(), InsertReply),
            (keys.sample(), Samples),
            (keys.priorities(), PrioritiesReply),
            (keys.leases, LeaseReply),
            (keys.weights, Weights),
            (keys.config, Stats),
        )
        turn = 0
        while not self._ended.is_set():
            key, cls = due[turn % len(due)]
            turn += 1
            with zenoh.open(self._settings) as session:

                def offer(query: Any, key: str = key, cls: type = cls) -> None:
                    self.answered[key.rpartition("/")[2]] += 1
                    kind = self.answered.total() % 4
                    if kind == 0:
                        query.reply_err(b"no\x1b[31m" + bytes(range(256)))
                    elif kind < 3:
                        query.reply(key, self._replies.reply(cls))
                    query.drop()

                handler = zenoh.handlers.Callback(offer, indirect=False)
                session.declare_queryable(key, handler, complete=True)
                self._ended.wait(_TURN_S / 3)
            self._ended.wait(2 * _TURN_S / 3)


def _stopping(train: Command) -> bool:
    return "stopping (SIGTERM)" in train.err or train.process.poll() is not None


def _ignore(_reply: Any) -> None:
    """Take no notice of an answer."""


def _evaluators(run: Path) -> int:
    return len({record.evaluation.worker for record in read_evaluations(run)})


def _progress(run: Path, seconds: float) -> dict[str, float]:
    """What the run does in that time, by its own records."""
    before, evaluations = read_last_metrics(run), len(read_evaluations(run))
    threading.Event().wait(seconds)
    after = read_last_metrics(run)
    names = ("learner_steps", "robot_steps", "episodes", "time_s")
    progress = {name: round(after[name] - before[name], 1) for name in names}
    return progress | {"evaluations": len(read_evaluations(run)) - evaluations}


def _faults(run: Path, said: str, others: list[Command], shown: bytes) -> Iterator[str]:
    """All that is unsound in what the run has left and said."""
    logs = {path.name: path.read_bytes() for path in (run / "logs").iterdir()}
    logs |= {each.err_path.name: each.err.encode() for each in others}
    logs |= {"train": said.encode(), "screen": shown}
    for name, log in logs.items():
        if b"Traceback" in log:
            yield f"{name}: {log[log.index(b'Traceback') :][:2000].decode('utf-8', 'replace')}"
        if b"\x1b[31mred" in log or (name != "screen" and b"\x1b" in log):
            yield f"{name}: control characters of a peer"
        if name != "screen" and len(log) > LONGEST_LOG:
            yield f"{name}: {len(log)} bytes"
        yield from (
            f"{name}: {line.decode('utf-8', 'replace')[:500]}"
            for line in log.splitlines()
            if re.search(rb"failed: .*; the run goes on|ended with code|restart it with", line)
        )
    for file in ("summary.json", "metrics.jsonl", "episodes.jsonl", "evaluations.jsonl"):
        lines = (run / file).read_bytes().splitlines()
        for line in [b"".join(lines)] if file == "summary.json" else lines:
            if odd := _unsound(line):
                yield f"{file}: {odd}"
    for file in ("episodes.jsonl", "evaluations.jsonl"):
        for line in (run / file).read_bytes().splitlines():
            record = json.loads(line)
            worker = record.get("actor") or record.get("worker")
            if worker not in WORKERS:
                yield f"{file}: a record of {worker}"
    for path in (run / "tensorboard").iterdir():
        yield from _unsound_events(path.read_bytes())


def _unsound(line: bytes) -> str:
    """Why a line is not a bounded object of strict JSON with bounded numbers; "" if it is."""
    if len(line) > LONGEST_LINE:
        return f"a line of {len(line)} bytes"

    def refuse(constant: str) -> float:
        raise ValueError(f"{constant} is not JSON")

    def walk(value: Any) -> Iterator[float]:
        if isinstance(value, dict):
            value = list(value.values())
        if isinstance(value, list):
            for inner in value:
                yield from walk(inner)
        elif isinstance(value, (int, float)):
            yield value

    try:
        numbers = list(walk(json.loads(line, parse_constant=refuse)))
    except ValueError as error:
        return str(error)
    return next((f"{n:g}" for n in numbers if not abs(n) < GREATEST), "")


def _unsound_events(data: bytes) -> Iterator[str]:
    from tensorboardX.proto.event_pb2 import Event

    tags, place = set[str](), 0
    while place + 12 <= len(data):
        (length,) = struct.unpack_from("<Q", data, place)
        event = Event.FromString(data[place + 12 : place + 12 + length])
        place += 16 + length
        for value in event.summary.value:
            tags.add(value.tag)
            if not math.isfinite(value.simple_value):
                yield f"tensorboard: {value.tag} {value.simple_value}"
    if len(tags) > 200:
        yield f"tensorboard: {len(tags)} tags"


def _said(run: Path, said: str) -> dict[str, int]:
    """Warnings of the run's processes, with numbers and what peers say left out."""
    lines = said.splitlines()
    for path in (run / "logs").iterdir():
        lines += [f"{path.stem} {line}" for line in path.read_text("utf-8").splitlines()]
    warnings = (line for line in lines if " WARNING " in line and "plots and video" not in line)
    forms = (re.sub(r"\d+", "9", re.sub(r"^(\S* ?)\S+ \S+,\d+ ", r"\1", w))[:100] for w in warnings)
    return dict(collections.Counter(forms).most_common(40))


if __name__ == "__main__":
    main()
