"""Weights versions and checkpoints: what must not go back, and what must survive.

Invariant: a checkpoint's `weights_version` is at least as large as any version published before
the next checkpoint, so that a learner killed at any moment goes on with a larger one.
"""

import hashlib
import logging
import time
from pathlib import Path

from mrcdrl.common.config import Config, to_toml
from mrcdrl.common.messages.trajectory import Weights
from mrcdrl.services.learner import checkpoint
from mrcdrl.services.learner.learner import Learner

_LOG = logging.getLogger("learner")
_RESERVED_VERSIONS = 10_000


class Keeper:
    """Numbers the weights and saves the learner; starts from the newest checkpoint there is.

    Raises CheckpointError where checkpoints exist and none is whole or fits the agent.
    """

    def __init__(self, config: Config, learner: Learner, directory: Path) -> None:
        self._settings = config.learner
        self._learner = learner
        self._directory = directory
        self._digest = hashlib.sha256(to_toml(config).encode()).hexdigest()
        self.epoch, self.version = time.time_ns(), 0
        self._restore()
        self._reserved = 0
        self.save()

    def _restore(self) -> None:
        found = checkpoint.load_latest(self._directory)
        if found is None:
            return
        for reason in found.passed_over:
            _LOG.warning("%s", reason)
        self._learner.restore(found.checkpoint.state)
        self.epoch = found.checkpoint.weights_epoch
        self.version = found.checkpoint.weights_version
        _LOG.info("going on from %s", found.path)

    def next_weights(self) -> Weights:
        """The present parameters under the next version."""
        if self.version >= self._reserved:
            self.save()
        self.version += 1
        return Weights.of(
            self.epoch, self.version, self._learner.learner_step, self._learner.payload()
        )

    def maybe_save(self) -> None:
        """Save if the checkpoint period has passed."""
        if time.monotonic() - self._saved_s >= self._settings.checkpoint_period_s:
            self.save()

    def save(self) -> None:
        """Write a checkpoint now; raises CheckpointError where that fails."""
        reserved = self.version + _RESERVED_VERSIONS  # rises from save to save: it tells the newest
        checkpoint.save(
            self._directory,
            checkpoint.Checkpoint(
                self._learner.state(), self.epoch, reserved, self._digest, time.time()
            ),
            keep=self._settings.keep_checkpoints,
        )
        self._reserved = reserved
        self._saved_s = time.monotonic()
