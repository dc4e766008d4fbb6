"""`mrcdrl replay`: read the configuration, wire the table to Zenoh, serve until told to stop."""

import logging
import sys
import time
from collections.abc import Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from common.arguments import Parser, add_config_flags, overrides
from common.config import Config, ReplayConfig, load_config, to_toml
from common.errors import WireError
from common.files import RUN_CONFIG
from common.keys import Keys, check_name
from common.process import (
    STOP_DEADLINE_S,
    StatsReporter,
    StopSignal,
    noted_endpoint,
    run_main,
)
from common.trajectory import LeaseRequest
from common.transport import Server, Session
from common.wire import decode, encode
from services.replay.leases import LeaseTable
from services.replay.limiter import RateLimiter
from services.replay.log import SegmentLog
from services.replay.sampler import PrioritizedSampler, Sampler, UniformSampler
from services.replay.service import ReplayService
from services.replay.size import capacity_of
from services.replay.table import Table

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
        listen = (noted_endpoint(run_dir, "--listen"),)
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


def open_log(config: Config, directory: Path) -> SegmentLog | None:
    """The log a configuration asks for."""
    if config.replay.fsync == "off":
        return None
    return SegmentLog(
        directory,
        segment_bytes=config.replay.segment_bytes,
        fsync=config.replay.fsync == "always",
    )


def build(config: Config, *, record_bytes: int | None = None) -> tuple[Table, RateLimiter]:
    """The table and limiter a configuration asks for.

    record_bytes: kept of each record, if not all of it. Raises ConfigError where
    replay.capacity_bytes leave no room for replay.min_size.
    """
    capacity = capacity_of(config)
    turns = config.run.turn_size > 0
    table = Table(
        capacity=capacity,
        stack=config.arena.stack,
        n_step=config.agent.n_step,
        # In turns the capacity alone decides what goes, not where chunks happen to lie.
        chunk_length=1 if turns else config.actor.chunk_length,
        record_bytes=config.arena.record_bytes if record_bytes is None else record_bytes,
        sampler=make_sampler(config.replay, capacity),
    )
    limiter = RateLimiter.with_tolerance(
        0.0 if turns else config.replay.samples_per_insert,
        config.replay.shard_min_size,
        config.replay.tolerance,
        largest_insert=config.actor.chunk_length,
        largest_sample=config.learner.sample_size,
    )
    return table, limiter


def make_sampler(replay: ReplayConfig, capacity: int) -> Sampler:
    """The sampler a configuration asks for."""
    rng = np.random.default_rng(replay.seed)
    if replay.prioritized:
        return PrioritizedSampler(capacity, replay.priority_exponent, rng)
    return UniformSampler(rng)


if __name__ == "__main__":
    sys.exit(run_main(lambda: main(sys.argv[1:])))
