"""Updates on a GPU, recorded once and replayed by one launch each time.

Without it a GPU waits for Python, which names every operation of every update anew.

Invariants: what is recorded reads and writes tensors that stay where they are; recording changes
nothing, replaying is the same as doing the work; the first updates are done as they are, which
also readies what may not be readied while recording; where recording fails, all go on like that.
"""

import logging
from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.loss import Update

_LOG = logging.getLogger("learner")
_WARM_UP = 3  # calls before the work is recorded, as PyTorch's own examples do

Work = Callable[[], None]


class Recorder(Protocol):
    """What records a device's work."""

    def warm_up(self, work: Work, /) -> None:
        """Do the work as it will be recorded."""
        ...

    def record(self, work: Work, /) -> Work:
        """What does the recorded work at each call; raises RuntimeError where it cannot be."""
        ...

    def launched(self) -> None:
        """A call's work was handed to the device; returns once that of the call before is done."""
        ...


class CudaGraphs:
    """Records CUDA graphs."""

    def __init__(self) -> None:
        self._launched: torch.cuda.Event | None = None

    def warm_up(self, work: Work) -> None:
        """On a stream beside the usual one, as recordings are made."""
        usual, beside = torch.cuda.current_stream(), torch.cuda.Stream()  # type: ignore[no-untyped-call]
        beside.wait_stream(usual)
        with torch.cuda.stream(beside):
            work()
        usual.wait_stream(beside)

    def record(self, work: Work) -> Work:
        """Other threads may use the device meanwhile."""
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            work()
        replay: Work = graph.replay
        return replay

    def launched(self) -> None:
        """The device always has one launch ahead, and never more that hold their batches."""
        before, self._launched = self._launched, torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]
        self._launched.record()
        if before is not None:
            before.synchronize()


class Recording:
    """`num` updates in one launch."""

    def __init__(
        self,
        recorder: Recorder,
        update: Callable[[Batch], Update],
        learning_rate: Tensor,
        like: Batch,
        num: int,
    ) -> None:
        """learning_rate: float32 [], which the update reads; like: a batch of their shapes."""
        self._recorder = recorder
        self._update = update
        self._learning_rate = learning_rate
        self._inputs = [like.map(torch.empty_like) for _ in range(num)]
        device = learning_rate.device
        self._rates = torch.zeros(num, device=device)
        self._known_rates = [0.0] * num
        self._updates = torch.zeros(num, 3 + len(like.keys), device=device)
        self._calls = 0
        self._work: Work | None = None

    def __call__(self, batches: Sequence[Batch], rates: Sequence[float]) -> list[Update]:
        """Learn from `num` batches, one after the other, each at its learning rate."""
        for held, batch in zip(self._inputs, batches, strict=True):
            for own, given in zip(held.tensors, batch.tensors, strict=True):
                own.copy_(given, non_blocking=True)
        for i, rate in enumerate(rates):
            if rate != self._known_rates[i]:
                self._rates[i] = self._known_rates[i] = rate
        self._run()
        results = self._updates.clone()  # the next call writes over the recorded ones
        self._recorder.launched()
        return [Update.of_numbers(numbers) for numbers in results.unbind()]

    def _run(self) -> None:
        if self._work is None and self._calls == _WARM_UP:
            self._work = self._recorded()
        if self._work is None:
            self._recorder.warm_up(self._all)
        else:
            self._work()
        self._calls += 1

    def _recorded(self) -> Work:
        try:
            work = self._recorder.record(self._all)
        except RuntimeError as error:
            first_line = str(error).partition("\n")[0]
            _LOG.warning("steps go on eagerly: recording a graph failed: %s", first_line)
            return self._all
        _LOG.info("steps are replayed from a graph, %d a launch", len(self._inputs))
        return work

    def _all(self) -> None:
        for batch, rate, numbers in zip(
            self._inputs, self._rates.unbind(), self._updates.unbind(), strict=True
        ):
            self._learning_rate.copy_(rate)
            numbers.copy_(self._update(batch).numbers())
