"""The number of robots for which a version of the weights does worst.

Invariants: pure and bounded; of each version that an evaluator has tested with every number of
robots there is one weakest evaluation; where there is one number, it is that of every version.
"""

from collections.abc import Sequence

from mrcdrl.common.messages.trajectory import Evaluation

_MAX_WORKERS = 64  # a peer may claim any number of names


class Weakest:
    """Collects the evaluations of a version; `add` tells the weakest once none is missing."""

    def __init__(self, numbers: Sequence[int]) -> None:
        """numbers: of robots, each of which is evaluated apart."""
        self._numbers = frozenset(numbers)
        self._pending: dict[str, dict[int, Evaluation]] = {}

    def add(self, evaluation: Evaluation) -> Evaluation | None:
        """Take an evaluation; the one of its version with the least success if this is the last."""
        if len(self._numbers) == 1:
            return evaluation
        tested = self._pending.pop(evaluation.worker, {})
        if any(_version(other) != _version(evaluation) for other in tested.values()):
            tested = {}
        tested[evaluation.num_robots] = evaluation
        if self._numbers <= tested.keys():
            return min((tested[n] for n in self._numbers), key=lambda e: e.success_rate)
        self._pending[evaluation.worker] = tested
        if len(self._pending) > _MAX_WORKERS:
            del self._pending[next(iter(self._pending))]
        return None


def _version(evaluation: Evaluation) -> tuple[int, int]:
    return evaluation.weights_epoch, evaluation.weights_version
