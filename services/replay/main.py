"""`mrcdrl replay`: read the configuration, wire the table to Zenoh, serve until told to stop."""

import logging
import time
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from mrcdrl.common.config import load_config, to_toml
from mrcdrl.common.config.arguments import Parser, add_config_flags, overrides
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import LeaseRequest
from mrcdrl.common.messages.wire import decode, encode
from mrcdrl.common.runtime.files import RUN_CONFIG
from mrcdrl.common.runtime.names import check_name
from mrcdrl.common.runtime.process import STOP_DEADLINE_S, StopSignal
from mrcdrl.common.sync.joining import recorded_endpoint
from mrcdrl.common.sync.stats import StatsReporter
from mrcdrl.common.transport import Server, Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.replay.build import build, open_log
from mrcdrl.services.replay.leases import LeaseTable
from mrcdrl.services.replay.service import ReplayService

_LOG = logging.getLogger("replay")
_TICK_S = 0.2
_LEASES_A_TICK = 1000


def main(argv: Sequence[str]) -> int:
    """Serve a run's replay; the exit code."""
    parser = Parser(prog="mrcdrl replay", description="Serve the replay table of a run.")
    parser.add_argument("--run", required=True, help="the run's name")
    parser.add_argument("--config", help="a preset or a TOML file; by default the run's")
    parser.add_argument("--listen", action="append", help="endpoint, such as tcp/127.0.0.1:7447")
    parser.add_argument("--connect", action="append", help="a router's endpoint, instead")
    parser.add_argument("--shard", type=int, default=0, help="which of replay.shards, from 0")
    parser.add_argument("--id", help="this worker's name; by default from the shard")
    parser.add_argument("--run-dir", type=Path, default=Path("runs"), help="where runs are kept")
    add_config_flags(parser)
    arguments = parser.parse_args(argv)
    run_dir = arguments.run_dir / check_name(arguments.run, "run name")
    config = load_config(arguments.config or config_of(run_dir), overrides(arguments))
    listen, connect = tuple(arguments.listen or ()), tuple(arguments.connect or ())
    if not (listen or connect):
        listen, connect = config.transport.listen, config.transport.connect
    if not (listen or connect):
        listen = (recorded_endpoint(run_dir, "--listen"),)
    transport = config.transport.model_copy(update={"listen": listen, "connect": connect})
    keys, shard = Keys(arguments.run), arguments.shard
    if not 0 <= shard < config.replay.shards:
        parser.error(f"--shard {shard}: the run has {config.replay.shards} (replay.shards)")
    worker = check_name(arguments.id or f"replay-{shard}", "--id")
    stop = StopSignal().listen(STOP_DEADLINE_S)
    table, limiter = build(config)
    log = open_log(config, run_dir / "replay" / str(shard))
    with Session(transport) as session:
        configs = session.server(keys.config)
        asked = session.server(keys.leases) if shard == 0 else None
        inserts, samples = session.server(keys.insert(shard)), session.server(keys.sample(shard))
        priorities = session.server(keys.priorities(shard))
        reporter = StatsReporter(session.publisher(keys.stats("replay", worker)), "replay", worker)
        service = ReplayService(config, table, limiter, inserts, samples, priorities, log)
        service.recover()
        service.start()
        session.announce(keys.live("replay", worker))
        _LOG.info("serving %s, %d of %d transitions", arguments.run, len(table), table.capacity)
        shared = to_toml(config).encode()
        exploration = config.exploration
        leases = LeaseTable(exploration.lease_s, exploration.slots, time.monotonic())
        try:
            while not stop.is_set() and service.healthy:
                request = configs.take(_TICK_S)
                if request is not None:
                    request.reply(shared)
                if asked is not None:
                    lease_slots(asked, leases)
                if service.accepting:
                    reporter.worked()
                reporter.maybe(service.metrics)
        finally:
            service.stop()
            if log is not None:
                log.close()
    return 0 if stop.is_set() else 1


def lease_slots(asked: Server, leases: LeaseTable) -> None:
    """Answer actors that wait for a slot of exploration, so many at a time."""
    for request in islice(iter(lambda: asked.take(0.0), None), _LEASES_A_TICK):
        try:
            wish = decode(LeaseRequest, request.payload)
        except WireError as error:
            request.refuse(str(error))
            continue
        request.reply(encode(leases.answer(wish, time.monotonic())))


def config_of(run_dir: Path) -> str | None:
    """The file that the run was made with, if it has a folder."""
    path = run_dir / RUN_CONFIG
    return str(path) if path.is_file() else None
