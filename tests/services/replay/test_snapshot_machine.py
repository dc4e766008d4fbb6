"""A replay service that is killed and restarted, against a plain list of priorities."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import settings as profile
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from tests.services.replay.harness import LENGTH, insert, make_chunk, save, settings, start, update

CONFIG = settings(capacity=200, min_size=32, samples_per_insert=0, segment_bytes=9000)
EXPONENT = CONFIG.replay.priority_exponent
PRIORITIES = st.floats(0, 300, width=32)  # within the bound of the table


class Lives(RuleBasedStateMachine):
    """Keeps the initial, present and last saved priority of every transition ever inserted.

    Also counts samples and inserts.
    """

    @initialize()
    def make(self) -> None:
        self.directory = Path(tempfile.mkdtemp())
        self.service = start(self.directory, CONFIG)
        self.initial: list[float] = []
        self.present: list[float] = []
        self.saved: list[float] = []
        self.samples = self.saved_samples = 0

    @rule(priorities=st.lists(PRIORITIES, min_size=1, max_size=5))
    def insert(self, priorities: list[float]) -> None:
        for priority in priorities:
            insert(self.service, make_chunk(len(self.initial) // LENGTH, priority=priority))
            self.initial += [priority] * LENGTH
            self.present += [priority] * LENGTH

    @rule(data=st.data())
    def learn(self, data: st.DataObject) -> None:
        keys = st.integers(0, len(self.present) + LENGTH)
        found = data.draw(st.dictionaries(keys, PRIORITIES, min_size=1, max_size=20))
        update(self.service, found)
        for key in found.keys() & set(self.service._table.keys):
            self.present[key] = found[key]
        if self.present:
            self.samples += 32
            self.service._limiter.samples += 32

    @rule()
    def save(self) -> None:
        save(self.service, self.directory)
        self.saved, self.saved_samples = self.present.copy(), self.samples

    @rule()
    def kill_and_start(self) -> None:
        self.service = start(self.directory, CONFIG)
        self.present = self.saved + self.initial[len(self.saved) :]
        known = set(self.service._table.keys) & set(range(len(self.saved)))
        self.samples = self.saved_samples if known else 0
        if not known:  # everything in the snapshot has been evicted since
            self.present = self.initial.copy()
        self.saved, self.saved_samples = self.present.copy(), self.samples
        save(self.service, self.directory)

    @invariant()
    def what_was_inserted_has_its_priority(self) -> None:
        table = self.service._table
        table.check_invariants()
        assert table.keys.stop == len(self.initial)
        expected = (np.array(self.present[table.keys.start :]) + 1e-6) ** EXPONENT
        np.testing.assert_allclose(table.sampler.scaled_priorities(table.keys), expected, rtol=1e-6)
        metrics = self.service.metrics()
        assert (metrics.inserts, metrics.samples) == (len(self.initial), self.samples)

    def teardown(self) -> None:
        if hasattr(self, "directory"):
            shutil.rmtree(self.directory)


TestLives = Lives.TestCase
TestLives.settings = profile(max_examples=25, stateful_step_count=20, deadline=None)
