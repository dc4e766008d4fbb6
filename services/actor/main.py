"""`mrcdrl actor`: join a run and collect transitions until told to stop."""

from collections.abc import Sequence

import torch

from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.sync.claim import claim_name
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.common.transport import Session
from mrcdrl.services.actor.actor import Actor, LockstepActor
from mrcdrl.services.actor.lease import LeaseClient
from mrcdrl.services.actor.sender import Sender
from mrcdrl.services.replay.client import ReplayWriter


def main(argv: Sequence[str]) -> int:
    """Collect for a run; return the exit code."""
    joining = Joining.from_argv("actor", argv)
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with Session(joining.transport) as session, Session(joining.transport) as bulk:
        config = fetch_config(session, joining, stop)
        claim_name(session, joining.keys, "actor", joining.worker, stop)
        torch.set_num_threads(config.actor.threads)
        session.announce(joining.keys.live("actor", joining.worker))
        writer = ReplayWriter.from_config(bulk, joining.keys, config, joining.worker, stop)
        sender = Sender(writer, config.actor.spool_chunks)
        lease = LeaseClient(session, joining.keys, joining.worker, config.exploration.lease_s)
        try:
            parts, lockstep = (
                (config, joining, session, sender, lease),
                Lockstep.from_config(config),
            )
            actor = Actor(*parts) if lockstep is None else LockstepActor(*parts, lockstep)
            actor.run(stop)
        finally:
            stop.set()
            lease.give_back()
            sender.close()
    return 0
