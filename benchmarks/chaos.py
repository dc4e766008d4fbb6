"""Random faults on a run whose services each have their own host, in two networks.

`python -m benchmarks.chaos --minutes 20 --seed 0 --actors 4` kills, suspends and disconnects each
service and lets it recover, drops its host's packets and slows its links, fills disks and shifts
clocks. Every applicable kind hits every service once before any repeats. The same seed gives the
same faults in the same order. Two linked routers join the networks (tests/chaos/chaos_stack.py).

Prints a line for each fault, and one line of JSON at the end: `works_again_s`, the time from the
end of a fault until its service has done more work and was heard over the network;
`all_work_again_s`, the same for the slowest of all services; `lost`, `doubled` and
`weights_backwards`, which should be zero. Exit code 1 if any is not, if a service did not recover,
or if the learner made no progress. Needs root, iproute2 and iptables; writes only to a temporary
directory.
"""

import argparse
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.machine import emit, spread
from mrcdrl.common.config import load_config
from tests.chaos.chaos_faults import (
    cut_off,
    full,
    lossy,
    shifted_clock,
    slow,
    stopped,
    why_no_hosts,
)
from tests.chaos.chaos_observer import Observer, judge, watch
from tests.chaos.chaos_stack import ON_DISKS, Service, stack

PROMISED_S = 15.0
LIMIT_S = 300.0  # how long a service may take to recover
UP_S = 300.0
LEARNT = ("learner", "learner_steps")
LEASE_S = 10.0  # of a Zenoh link, which survives shorter silences only
CONFIG = {
    "arena.view_px": "32",
    "arena.max_frames": "30",
    "replay.capacity": "3_000_000",  # nothing is replaced, so that every transition can be checked
    "replay.snapshot_period_s": "2",
    "replay.samples_per_insert": "2",  # a slow learner still admits every actor
    "actor.spool_chunks": "4",
    "learner.precision": "float32",
    "learner.threads": "1",
    "learner.publish_period": "20",
    "evaluator.episodes": "2",
    "run.learner_steps": "0",
}
Recovered = dict[str, float]  # seconds by service; LIMIT_S: did not recover in time


@dataclass(frozen=True, slots=True)
class Fault:
    """A kind of fault on a service, and its duration."""

    kind: str
    service: str
    seconds: float
    degree: float  # severity, 0 … 1, for the kinds that have one

    def __str__(self) -> str:
        return f"{self.kind} {self.service} {self.seconds:g} s"

    def on(self, service: Service) -> AbstractContextManager[None]:
        match self.kind:
            case "kill":
                return service.killed()
            case "clock":
                return service.killed(shifted_clock(86_400 * (2 * self.degree - 1)))
            case "stop":
                return stopped(service.pid)
            case "cut":
                return cut_off(service.host)
            case "loss":
                return lossy(service.host, 0.05 + 0.25 * self.degree)
            case "slow":
                return slow(service.host, int(500 + 3500 * self.degree))
            case "full":
                return full(service.folder)
        raise ValueError(f"no fault is called {self.kind!r}")


KINDS = ("kill", "stop", "cut", "loss", "slow")


def faults(rng: random.Random, services: list[str]) -> Iterator[Fault]:
    """Yield faults forever: each kind on each service once, then again in another order."""
    pairs = [(kind, service) for kind in KINDS for service in services]
    pairs += [("full", service) for service in ON_DISKS]
    pairs += [("clock", service) for service in ("learner", "actor-0")]
    while True:
        rng.shuffle(pairs)
        for kind, service in pairs:
            longest_s = 2.0 if kind in ("kill", "clock") else 1.3 * LEASE_S
            yield Fault(kind, service, round(rng.uniform(0.5, longest_s), 2), rng.random())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--actors", type=int, default=4)
    parser.add_argument("--kinds", nargs="+", help="only these, such as kill stop cut")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that everything is cleaned up
    if (why := why_no_hosts()) is not None:
        print(f"cannot create hosts: {why}", file=sys.stderr)
        return 1

    def chosen(services: list[str]) -> Iterator[Fault]:
        until_s = time.monotonic() + 60 * arguments.minutes
        for fault in faults(random.Random(arguments.seed), services):
            if time.monotonic() > until_s:
                return
            if not arguments.kinds or fault.kind in arguments.kinds:
                yield fault

    print(f"seed {arguments.seed}", file=sys.stderr)
    with tempfile.TemporaryDirectory() as folder:
        result = ordeal(Path(folder), arguments.actors, chosen)
    settings = {name: vars(arguments)[name] for name in ("minutes", "seed", "actors")}
    emit({"bench": "chaos", **settings, **result})
    return 0 if result["held"] else 1


def ordeal(
    folder: Path, num_actors: int, chosen: Callable[[list[str]], Iterable[Fault]]
) -> dict[str, Any]:
    """Inflict faults one after the other and report what came of them.

    chosen: gives the faults for services of these names; called once all services work.
    """
    config = load_config("smoke", CONFIG, environ={})
    with stack(config, folder, num_actors) as run, watch(run) as session:
        observer, started_s = Observer(run, session), time.monotonic()
        wait_until_up(observer)
        up_s, first_step = time.monotonic() - started_s, observer.figure(*LEARNT)
        suffered = [(fault, suffer(observer, fault)) for fault in chosen(list(run.services))]
        last_step = observer.figure(*LEARNT)
        by_themselves = {n: service.ends for n, service in run.services.items() if service.ends}
        codes = run.end()
        observer.listen(0.5)
        verdict = judge(observer, config, folder / "replay" / run.run)
    all_back = all(s < LIMIT_S for _, recovered in suffered for s in recovered.values())
    kept_all = not (verdict["lost"] or verdict["doubled"] or verdict["weights_backwards"])
    return {
        "held": kept_all and all_back and last_step > first_step,
        "up_s": round(up_s, 1),
        **verdict,
        "learner_steps": [first_step, last_step],
        **recoveries(suffered),
        "ended_by_themselves": by_themselves,
        "exit_codes": codes,
    }


def wait_until_up(observer: Observer) -> None:
    """Wait until all services work; raise AssertionError with their logs if they do not."""
    recovered = observer.recovery(time.monotonic(), UP_S)
    if UP_S in recovered.values():
        raise AssertionError(f"never worked: {recovered}\n{observer.stack.logs()}")


def suffer(observer: Observer, fault: Fault) -> Recovered:
    """Inflict a fault; return the seconds from its end until each service worked again."""
    with fault.on(observer.stack.services[fault.service]):
        observer.listen(fault.seconds)
    recovered = observer.recovery(time.monotonic(), LIMIT_S)
    slowest = max(recovered, key=lambda name: recovered[name])
    print(
        f"{fault.kind:5} {fault.service:12} {fault.seconds:5.1f} s: works again after "
        f"{recovered[fault.service]:5.1f} s, all after {recovered[slowest]:5.1f} s ({slowest}); "
        f"learner step {observer.figure(*LEARNT):.0f}",
        file=sys.stderr,
        flush=True,
    )
    if recovered[slowest] >= LIMIT_S:
        print(observer.stack.logs(), file=sys.stderr)
    return recovered


def recoveries(suffered: list[tuple[Fault, Recovered]]) -> dict[str, Any]:
    """Summarize recovery times by kind of fault, and list those longer than promised."""
    own: dict[str, list[float]] = {}
    for fault, recovered in suffered:
        own.setdefault(fault.kind, []).append(recovered[fault.service])
    return {
        "faults": len(suffered),
        "works_again_s": {kind: spread(values) for kind, values in sorted(own.items())},
        "all_work_again_s": spread([max(r.values()) for _, r in suffered]) if suffered else {},
        "over_15_s": [
            {"fault": str(fault), **late}
            for fault, recovered in suffered
            if (late := {name: s for name, s in recovered.items() if s > PROMISED_S})
        ],
        "each": [{"fault": str(fault), **recovered} for fault, recovered in suffered],
    }


if __name__ == "__main__":
    sys.exit(main())
