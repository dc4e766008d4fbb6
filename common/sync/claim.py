"""Who is who: a worker's name, the learner of a run and a shard of replay are one process's each.

Invariants: a claim is a liveliness token, so it ends with its process, and a link that comes back
renews it. A process declares its claim before it looks for others', so of two that start at once
at least one sees the other. A claim that another process holds is waited for while it may be that
of a process that has ended behind a lost link, and then refused.
"""

import logging
import random
import time

from mrcdrl.common.errors import NameTakenError
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys

_LAPSE_S = 15.0  # Zenoh notices a lost link after 10
_PAUSE_S = (0.1, 0.5)  # at random: two that gave way to each other are not to meet again


def claim_name(session: Session, keys: Keys, role: str, worker: str, stop: StopSignal) -> None:
    """Claim the worker's name in its role while the session is open; raises NameTakenError."""
    whose = f"{_a(role)} named {worker}"
    _claim(session, keys, role, worker, stop, f"{whose}; give each its own --id")


def claim_learner(session: Session, keys: Keys, stop: StopSignal) -> None:
    """Claim to be the run's learner while the session is open; raises NameTakenError."""
    _claim(session, keys, "learner", "learner", stop, "a learner; a run has one")


def claim_shard(session: Session, keys: Keys, shard: int, stop: StopSignal) -> None:
    """Claim a shard of the run's replay while the session is open; raises NameTakenError."""
    whose = f"a replay service for shard {shard}; a shard has one"
    _claim(session, keys, "replay", f"shard-{shard}", stop, whose)


def _claim(
    session: Session, keys: Keys, role: str, name: str, stop: StopSignal, whose: str
) -> None:
    """Claim a name; `whose` says what the run has already where it is taken, and what to do."""
    mine, all_of_them = keys.claim(role, name, str(time.time_ns())), keys.claim(role, name, "*")
    deadline, told = time.monotonic() + _LAPSE_S, False
    while True:
        if not session.tokens(all_of_them):
            withdraw = session.announce(mine)
            if session.tokens(all_of_them) <= {mine}:
                return
            withdraw()
        if time.monotonic() >= deadline or stop.wait(random.uniform(*_PAUSE_S)):
            raise NameTakenError(f"run {keys.run} has {whose}")
        if not told:
            logging.getLogger(role).info(
                "run %s has %s; waiting up to %g s, in case that process has just ended",
                *(keys.run, whose.partition(";")[0], _LAPSE_S),
            )
            told = True


def _a(role: str) -> str:
    return f"{'an' if role[0] in 'ae' else 'a'} {role}"
