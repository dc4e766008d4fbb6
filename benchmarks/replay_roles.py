"""Our server, writer and sampler, as `benchmarks.replay` gives them to the harness."""

import argparse
import importlib
import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mrcdrl.common.arena import make_codec
from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import Chunk, Samples, UInt8Array
from mrcdrl.common.runtime.cores import available_cores
from mrcdrl.common.runtime.process import StopSignal
from mrcdrl.common.transport import Session
from mrcdrl.common.transport.keys import Keys
from mrcdrl.services.actor.sender import Sender
from mrcdrl.services.learner.priorities import PrioritiesSender
from mrcdrl.services.learner.rendering import ThreadedDecoder
from mrcdrl.services.replay.client import PriorityWriter, ReplayReader, ReplayWriter
from mrcdrl.services.replay.limiter import RateLimiter
from mrcdrl.services.replay.log import open_log
from mrcdrl.services.replay.service import ReplayService
from mrcdrl.services.replay.table import Table

sys.path.insert(0, os.environ["MRCDRL_BENCH_HARNESS"])
base: Any = importlib.import_module("peers_harness")

STACK, VIEW_PX, NUM_ROBOTS = 4, 60, 4
KEYS = Keys("bench")
Arguments = argparse.Namespace


def config_of(args: Arguments) -> Config:
    """Our service's configuration for what the harness asks."""
    return Config.model_validate(
        {
            "arena": {
                "num_robots": NUM_ROBOTS,
                "codec": "frames" if args.codec == "frames" else "scene",
            },
            "replay": {
                "capacity": args.capacity,
                "min_size": 512,
                "samples_per_insert": 0,
                "sampler": "uniform" if args.uniform else "prioritized",
                "fsync": args.fsync,
            },
            "actor": {"chunk_length": args.chunk},
            "learner": {"batch_size": 512, "batches_per_request": max(1, args.request // 512)},
            "transport": {"shared_memory": not args.network},
        }
    )


def session_of(args: Arguments, end: str) -> Session:
    endpoint = (f"tcp/127.0.0.1:{args.port}",)
    return Session(config_of(args).transport.model_copy(update={end: endpoint}))


class Server:
    """Our service, which is also the router."""

    def __init__(self, args: Arguments) -> None:
        config = config_of(args)
        table, limiter = Table.from_config(config), RateLimiter.from_config(config)
        self._folder = Path(tempfile.mkdtemp(prefix="bench-", dir=args.log_dir))
        self._log = open_log(config, self._folder)
        self._session = session_of(args, "listen")
        keys = (KEYS.insert(), KEYS.sample(), KEYS.priorities())
        self._service = ReplayService(
            config, table, limiter, *map(self._session.server, keys), self._log
        )
        self._service.start()

    def close(self) -> None:
        self._service.stop()
        self._session.close()
        if self._log is not None:
            self._log.close()
        shutil.rmtree(self._folder)


class Writer(base.WriterBase):  # type: ignore[misc]
    """The actor's sender and the layers below it."""

    def setup(self) -> None:
        self._session = session_of(self.args, "connect")
        writer = ReplayWriter(self._session, KEYS, 10.0, StopSignal())
        self._sender = Sender(writer, self.args.spool)
        self._records = [self._episode_records(e) for e in range(base.NEP)]
        self._sequence = self._sent = 0

    def _episode_records(self, episode: int) -> UInt8Array:
        """All records of an episode, with the first one repeated to fill the first state."""
        if self.args.codec == "frames":
            records = self.pool.frames[episode].reshape(base.T + 1, -1)
        else:
            random = np.random.default_rng(episode).uniform(50, 550, (base.T + 1, 5 * NUM_ROBOTS))
            records = random.astype("<f4").view(np.uint8)
        return np.concatenate([records[:1].repeat(STACK - 1, axis=0), records])

    def write_episode(self, e: int) -> int:
        _, actions, rewards, dones, priorities = self.pool.episode(e)
        records = self._records[e % base.NEP]
        for start in range(0, base.T, self.args.chunk):
            part = slice(start, min(base.T, start + self.args.chunk))
            chunk = Chunk(
                actor="bench",
                incarnation=1,
                sequence=self._sequence,
                weights_version=1,
                records=records[start : part.stop + STACK],
                actions=actions[part].astype(np.uint8),
                rewards=rewards[part],
                discounts=np.where(dones[part], 0, 0.99).astype(np.float32),
                bootstrap_offsets=np.ones(part.stop - start, np.uint8),
                priorities=priorities[part],
            )
            while not self._sender.put(chunk, timeout_s=10.0):
                pass
            self._sequence += 1
        self._sent += base.T
        return int(base.T)

    def flush(self) -> None:
        while self._sender.transitions < self._sent:
            time.sleep(0.0005)

    def close(self) -> None:
        self._sender.close()
        self._session.close()


class Sampler(base.SamplerBase):  # type: ignore[misc]
    """The learner's reader and its sender of priorities."""

    def begin(self, batch_size: int) -> None:
        super().begin(batch_size)
        self._threads = ThreadPoolExecutor(self.args.drawing_threads or available_cores())
        codec = make_codec(config_of(self.args).arena)
        self._decode = ThreadedDecoder(codec, VIEW_PX, self._threads)
        self._session = session_of(self.args, "connect")
        self._stop = StopSignal()
        batches = max(1, self.args.request // batch_size)
        self._reader = ReplayReader(
            self._session, KEYS, batch_size, batches, self.args.prefetch, 10.0, self._stop
        )
        writer = PriorityWriter(self._session, KEYS, self._stop)
        self._priorities = PrioritiesSender(writer, 1 << 20)
        self._num_given = 0

    def next(self) -> dict[str, Any]:
        samples = self._reader.sample()
        assert samples is not None
        images = self._images(samples)
        batch: dict[str, Any] = base.as_batch(
            images,
            samples.actions,
            samples.rewards,
            samples.discounts,
            samples.probabilities,
            samples.keys,
        )
        return batch

    def _images(self, samples: Samples) -> UInt8Array:
        """Images [B, W, V, V]; for codec `records`, the sampled records."""
        if self.args.codec == "frames":
            return samples.records.reshape(*samples.records.shape[:2], VIEW_PX, VIEW_PX)
        self._num_given += 1
        if self._num_given <= 3:
            # Before it starts the clock, the harness checks the shape, order and intensities of
            # three batches; our arena is darker than its frames.
            return self._decode(samples.records) // 2 + np.uint8(120)
        return self._decode(samples.records) if self.args.codec == "drawn" else samples.records

    def update(self, keys: Any, priorities: Any) -> None:
        self._priorities.put(keys, torch.from_numpy(priorities))
        while self._priorities.waiting > self.args.backlog:
            time.sleep(0.0002)

    def end(self) -> None:
        self._stop.set()
        self._priorities.close()
        self._threads.shutdown()
        self._session.close()
