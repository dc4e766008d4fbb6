"""`mrcdrl replay`: read the configuration, wire the table to Zenoh, serve until stopped."""

import logging
import time
from collections.abc import Sequence

from mrcdrl.common.config import to_toml
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.sync.claim import claim_shard
from mrcdrl.common.sync.stats import StatsReporter, serve_statistics
from mrcdrl.common.transport import Session
from mrcdrl.services.replay.leases import LeaseTable, answer_leases
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.log import open_log
from mrcdrl.services.replay.service import ReplayService
from mrcdrl.services.replay.serving import Serving
from mrcdrl.services.replay.table import Table

_LOG = logging.getLogger("replay")
_TICK_S = 0.2


def main(argv: Sequence[str]) -> int:
    """Serve a run's replay; return the exit code."""
    serving = Serving.from_argv(argv)
    config, keys, shard = serving.config, serving.keys, serving.shard
    stop = StopSignal().listen(STOP_DEADLINE_S)
    table, limiter = Table.from_config(config), RateLimiter.from_config(config)
    log = open_log(config, serving.log_directory)
    if log is not None:
        log.lock()
    with Session(serving.transport) as session:
        claim_shard(session, keys, shard, stop)
        config_requests = session.server(keys.config)
        lease_requests = session.server(keys.leases) if shard == 0 else None
        inserts = session.server(keys.insert(shard), capacity=serving.transport.max_peers)
        samples = session.server(keys.sample(shard))
        priorities = session.server(keys.priorities(shard))
        stats = session.publisher(keys.stats("replay", serving.worker))
        reporter = StatsReporter(stats, "replay", serving.worker)
        service = ReplayService(config, table, limiter, inserts, samples, priorities, log)
        shared = to_toml(config).encode()

        def serve_config(timeout_s: float = 0.0) -> None:
            request = config_requests.take(timeout_s)
            if request is not None:
                request.reply(shared)

        service.recover(meanwhile=serve_config)
        service.start()
        session.announce(keys.live("replay", serving.worker))
        _LOG.info("serving %s, %d of %d transitions", serving.run, len(table), table.capacity)
        leases = LeaseTable(config.exploration.lease_s, config.exploration.slots, time.monotonic())
        try:
            with serve_statistics(serving.transport, "replay", serving.run, reporter):
                while not stop.is_set() and service.healthy:
                    serve_config(_TICK_S)
                    if lease_requests is not None:
                        answer_leases(lease_requests, leases)
                    if service.accepting:
                        reporter.worked()
                    reporter.publish_if_due(service.metrics)
        finally:
            service.stop()
            if log is not None:
                log.close()
    return 0 if stop.is_set() else 1
