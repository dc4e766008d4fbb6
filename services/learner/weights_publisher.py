"""Publishes numbered weights and saves checkpoints: versions never go back.

Invariant: a checkpoint's `weights_version` is at least as large as any version published before
the next checkpoint, so that a learner killed at any moment continues with a larger one.
"""

import logging
import time
from pathlib import Path

from mrcdrl.common.config import Config, to_toml
from mrcdrl.common.errors import CheckpointError
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.common.model.saved_policy import read_saved, weights_path
from mrcdrl.common.runtime.files import sha256
from mrcdrl.common.runtime.repeats import is_logged
from mrcdrl.common.sync.weights import WeightsWriter
from mrcdrl.services.learner import checkpoint
from mrcdrl.services.learner.learner import Learner

_LOG = logging.getLogger("learner")
_RESERVED_VERSIONS = 10_000


class WeightsPublisher:
    """Numbers and publishes a learner's weights; starts from the newest checkpoint there is.

    Raises CheckpointError where checkpoints exist and none is whole or fits the agent.
    """

    def __init__(
        self, config: Config, learner: Learner, writer: WeightsWriter, directory: Path
    ) -> None:
        """directory: where checkpoints are kept."""
        self._settings = config.learner
        self._learner = learner
        self._writer = writer
        self._directory = directory
        self._digest = sha256(to_toml(config).encode())
        self.epoch, self.version = time.time_ns(), 0
        self._restore()
        self._reserved = 0
        self._failures, self._saved_s = 0, 0.0  # attempts to save, and the time of the last one
        self.save()

    def _restore(self) -> None:
        found = checkpoint.load_latest(self._directory)
        if found is None:
            self._start_from(self._settings.initial_weights)
            return
        for reason in found.skipped:
            _LOG.warning("%s", reason)
        self._learner.restore(found.checkpoint.state)
        self.epoch = found.checkpoint.weights_epoch
        self.version = found.checkpoint.weights_version
        _LOG.info("continuing from %s", found.path)

    def _start_from(self, source: str) -> None:
        """Give a new run its initial weights, if it is to have any."""
        if not source:
            return
        path = weights_path(Path(source))
        weights = read_saved(path)
        try:
            self._learner.start_from(weights.payload)
        except CheckpointError as error:
            raise CheckpointError(f"learner.initial_weights {path}: {error}") from error
        _LOG.info("starting from %s, learner step %d there", path, weights.learner_step)

    def publish(self) -> None:
        """Publish the present parameters under the next version; returns at once.

        Raises DivergedError, and publishes nothing, where one of them is not finite.
        """
        if self.version >= self._reserved:
            self.save()
        self.version += 1
        learner = self._learner
        payloads = filter(None, (learner.payload(), learner.average_payload()))
        numbers = self.epoch, self.version, learner.learner_step
        self._writer.publish(*(Weights.of(*numbers, payload) for payload in payloads))

    def maybe_save(self) -> None:
        """Save if the checkpoint period has passed; what cannot be written now is tried again."""
        if time.monotonic() - self._saved_s < self._settings.checkpoint_period_s:
            return
        try:
            self.save()
        except CheckpointError as error:
            self._saved_s = time.monotonic()
            self._failures += 1
            if is_logged(self._failures):
                _LOG.warning("%s (%d times so far); learning goes on", error, self._failures)

    def save(self) -> None:
        """Write a checkpoint now; raises CheckpointError where that fails."""
        reserved = self.version + _RESERVED_VERSIONS  # rises with every save: tells the newest
        checkpoint.save(
            self._directory,
            checkpoint.Checkpoint(
                self._learner.state(), self.epoch, reserved, self._digest, time.time()
            ),
            keep=self._settings.keep_checkpoints,
        )
        self._reserved = reserved
        self._saved_s = time.monotonic()
