"""Whether transitions fit a run's configuration; docs/wire.md.

Invariant: pure. Replay gives no samples that do not, but another process may answer in its place.
"""

import numpy as np

from mrcdrl.common.config import Config
from mrcdrl.common.config.returns import largest_n_step_return
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import Chunk, Samples


class Fitting:
    """What a run's configuration allows in a mini-batch."""

    def __init__(self, config: Config) -> None:
        window = config.arena.stack + config.agent.n_step
        self._shape = (config.learner.batch_size, window, config.arena.record_bytes)
        self._num_actions = config.arena.action_count
        self._n_step = config.agent.n_step
        self._largest_return = largest_n_step_return(config)

    def check(self, samples: Samples) -> None:
        """Raise WireError unless these samples are a mini-batch of the run."""
        if samples.records.shape != self._shape:
            raise WireError(
                f"records {list(samples.records.shape)} where {list(self._shape)} are due: "
                "another run?"
            )
        check_actions(samples, self._num_actions)
        check_returns(samples, self._n_step, self._largest_return)


def check_actions(transitions: Samples | Chunk, num_actions: int) -> None:
    """Raise WireError for an action that the run's arena does not have."""
    if int(transitions.actions.max()) >= num_actions:
        raise WireError(
            f"action {transitions.actions.max()} where the arena of this run has {num_actions}"
        )


def check_returns(transitions: Samples | Chunk, n_step: int, largest_return: float) -> None:
    """Raise WireError for a return over too many steps, or one that no arena of the run gives."""
    if int(transitions.bootstrap_offsets.max()) > n_step:
        raise WireError(f"a bootstrap offset exceeds agent.n_step, {n_step}")
    largest = float(np.abs(transitions.rewards).max())
    if largest > largest_return:
        raise WireError(
            f"a return of {largest:g} where no arena of this run gives more than "
            f"{largest_return:g}: other rewards?"
        )
