"""Each stage of the ring alone, one thread: what one robot step and one update cost.

Prints one line of JSON: microseconds (median, min, max of the repeats) a robot step for the
actor's stages, and a batch for the learner's; and, from them, the collection rate of one actor.
"""

import argparse
from dataclasses import replace

import numpy as np
import torch

from benchmarks.machine import emit, seconds_per_call, spread
from mrcdrl.common.arena import ArenaBatch, make_codec
from mrcdrl.common.config import Config, TransportConfig, load_config
from mrcdrl.common.messages.trajectory import Chunk
from mrcdrl.common.model.policy import make_policy
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session, free_endpoint
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.actor.chunker import ChunkerConfig
from mrcdrl.services.actor.collector import Collector
from mrcdrl.services.learner.batch import collate
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.rendering import make_renderer
from mrcdrl.services.learner.symmetries import LayoutSymmetries
from mrcdrl.services.replay.client import ReplayReader, ReplayWriter
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.service import ReplayService
from mrcdrl.services.replay.table import Table

MICRO = 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=1.0)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--learner-threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    unlimited = {"replay.samples_per_insert": "0", "arena.num_robots": str(arguments.robots)}
    config = load_config("quick", unlimited, environ={})
    timing = {"seconds": arguments.seconds, "repeats": arguments.repeats}
    figures = {"bench": "stages", "robots": arguments.robots}
    collector = make_collector(config)
    figures |= collecting(config, collector, timing)
    chunks = collect_chunks(config, collector)
    torch.set_num_threads(arguments.learner_threads)
    figures["learner_threads"] = arguments.learner_threads
    figures |= learning(config, chunks, timing)
    emit(figures)


def make_collector(config: Config) -> Collector:
    rngs = [np.random.default_rng(i) for i in range(config.actor.num_arenas)]
    arenas = ArenaBatch(config.arena, rngs)
    chunking = ChunkerConfig.from_config(config, "bench", incarnation=1)
    rng = np.random.default_rng(0)
    return Collector(
        config, chunking, arenas, make_codec(config.arena), make_policy(config, averages=False), rng
    )


def collecting(config: Config, collector: Collector, timing: dict[str, float]) -> dict[str, object]:
    """Microseconds a robot step in each stage of an actor."""
    epsilons = np.full(config.actor.num_arenas, 0.1, np.float32)
    states = config.actor.num_arenas * config.arena.num_robots
    before = collector.seconds
    whole = seconds_per_call(lambda: collector.step(epsilons), **timing)  # type: ignore[arg-type]
    steps = collector.robot_steps
    shares = {
        f"{stage}_us_per_robot_step": round(getattr(before, stage) / steps * MICRO, 1)
        for stage in ("inference", "arena", "draw", "chunk")
    }
    return {
        **shares,
        "states_per_inference": states,
        "collect_us_per_robot_step": spread([s / states * MICRO for s in whole]),
        "collect_robot_steps_per_s": spread([states / s for s in whole], 0),
    }


def collect_chunks(config: Config, collector: Collector) -> list[Chunk]:
    """Enough chunks to fill the table to its minimum."""
    epsilons = np.ones(config.actor.num_arenas, np.float32)
    chunks: list[Chunk] = []
    while sum(map(len, chunks)) < config.replay.min_size + config.learner.batch_size:
        chunks += collector.step(epsilons)[0]
    return chunks


def learning(config: Config, chunks: list[Chunk], timing: dict[str, float]) -> dict[str, object]:
    """Microseconds of an insert, a sampled batch, its decoding, and an update."""
    learner = Learner.from_config(config)
    keys, stop = Keys("bench"), StopSignal()
    endpoint = free_endpoint()
    table, limiter = Table.from_config(config), RateLimiter.from_config(config)
    with (
        Session(TransportConfig(listen=(endpoint,))) as served,
        Session(TransportConfig(connect=(endpoint,))) as session,
    ):
        servers = map(served.server, (keys.insert(), keys.sample(), keys.priorities()))
        service = ReplayService(config, table, limiter, *servers)
        service.start()
        writer = ReplayWriter(session, keys, 10.0, stop)
        reader = ReplayReader(session, keys, config.learner.batch_size, 1, 4, 10.0, stop)
        numbered = iter(range(2**62))

        def insert() -> None:
            number = next(numbered)
            writer.insert([replace(chunks[number % len(chunks)], sequence=number)])

        for _ in chunks:
            insert()
        inserts = seconds_per_call(insert, **timing)  # type: ignore[arg-type]
        samples = seconds_per_call(reader.sample, **timing)  # type: ignore[arg-type]
        sampled = reader.sample()
        service.stop()
    if sampled is None:
        raise RuntimeError("no mini-batch came")
    render = make_renderer(config.arena, learner.device)
    symmetries = LayoutSymmetries(config.arena)

    def collated() -> object:
        drawn = symmetries.draw(sampled.records, learner.rng)
        return collate(sampled, render, config.arena.stack, symmetry_rows=drawn)

    batch = collate(sampled, render, config.arena.stack)
    return {
        "insert_us_per_chunk": spread([s * MICRO for s in inserts]),
        "sample_us_per_batch": spread([s * MICRO for s in samples]),
        "collate_us_per_batch": spread(
            [s * MICRO for s in seconds_per_call(collated, **timing)]  # type: ignore[arg-type]
        ),
        "update_us_per_batch": spread(
            [s * MICRO for s in seconds_per_call(lambda: learner.step(batch), **timing)]  # type: ignore[arg-type]
        ),
        "payload_us": spread(
            [s * MICRO for s in seconds_per_call(learner.payload, **timing)]  # type: ignore[arg-type]
        ),
        "batch_size": config.learner.batch_size,
    }


if __name__ == "__main__":
    main()
