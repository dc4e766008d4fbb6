"""`mrcdrl actor`: join a run and collect transitions until told to stop."""

from collections.abc import Sequence

import torch

from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.sync.broadcast import Broadcast
from mrcdrl.common.sync.claim import claim_name
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.common.sync.stats import serve_statistics
from mrcdrl.common.transport import Session
from mrcdrl.services.actor.actor import Actor, LockstepActor
from mrcdrl.services.actor.lease import LeaseClient
from mrcdrl.services.actor.sender import Sender
from mrcdrl.services.replay.client import ReplayWriter


def main(argv: Sequence[str]) -> int:
    """Collect for a run; return the exit code."""
    joining = Joining.from_argv("actor", argv)
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with Session(joining.transport) as session:
        config = fetch_config(session, joining, stop, plays=True)
        claim_name(session, joining.keys, "actor", joining.worker, stop)
        torch.set_num_threads(config.actor.threads)
        session.announce(joining.keys.live("actor", joining.worker))
        writer = ReplayWriter.from_config(session, joining.keys, config, joining.worker, stop)
        sender = Sender(writer, config.actor.spool_chunks)
        lease = LeaseClient(session, joining.keys, joining.worker, config.exploration.lease_s)
        shown = session.watched_publisher(joining.keys.arena("actor", joining.worker))
        broadcast = Broadcast(shown, "actor", joining.worker)
        try:
            parts, lockstep = (
                (config, joining, session, sender, lease),
                Lockstep.from_config(config),
            )
            if lockstep is None:
                actor = Actor(*parts, broadcast)
            else:
                actor = LockstepActor(*parts, lockstep, broadcast)
            with serve_statistics(joining.transport, "actor", joining.run, actor.reporter):
                actor.run(stop)
        finally:
            stop.set()
            broadcast.close()
            lease.give_back()
            sender.close()
    return 0
