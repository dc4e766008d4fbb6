"""`mrcdrl actor`: join a run, follow its weights and collect until told to stop."""

from collections.abc import Sequence

import torch

from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.sync.joining import Joining, fetch_config
from mrcdrl.common.sync.lockstep import Lockstep
from mrcdrl.common.transport import Session
from mrcdrl.services.actor.actor import Actor
from mrcdrl.services.actor.lease import LeaseKeeper
from mrcdrl.services.actor.sender import Sender
from mrcdrl.services.replay.client import ReplayWriter, shard_of


def main(argv: Sequence[str]) -> int:
    """Collect for a run; the exit code."""
    joining = Joining.from_argv("actor", argv)
    stop = StopSignal().listen(STOP_DEADLINE_S)
    with Session(joining.transport) as session, Session(joining.transport) as bulk:
        config = fetch_config(session, joining, stop)
        torch.set_num_threads(config.actor.threads)
        session.announce(joining.keys.live("actor", joining.worker))
        num_shards = config.replay.shards
        writer = ReplayWriter(
            bulk,
            joining.keys,
            config.actor.warn_s,
            stop,
            shard=shard_of(joining.worker, num_shards),
            num_shards=num_shards,
        )
        sender = Sender(writer, config.actor.spool_chunks)
        lease = LeaseKeeper(session, joining.keys, joining.worker, config.exploration.lease_s)
        try:
            actor, lockstep = Actor(config, joining, session, sender, lease), Lockstep.from_config(config)
            if lockstep is None:
                actor.run(stop)
            else:
                actor.run_in_lockstep(lockstep, stop)
        finally:
            stop.set()
            lease.give_back()
            sender.close()
    return 0
