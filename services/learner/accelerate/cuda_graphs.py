"""Steps captured once as a CUDA graph, and replayed by one launch each time.

Without graphs a GPU waits for Python, which names every operation of every step anew.

Invariants: what is captured reads and writes tensors that stay where they are; capturing changes
nothing, replaying is the same as doing the work. The first steps are eager, which also readies
what may not be readied during a capture. Where capturing fails, all steps stay eager.
"""

import logging
from collections.abc import Callable, Sequence
from typing import Literal, Protocol

import torch
from torch import Tensor

from mrcdrl.common.errors import ConfigError
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.step import Update

_LOG = logging.getLogger("learner")
_WARM_UP = 3  # calls before the work is captured, as PyTorch's own examples do

Work = Callable[[], None]


class Capturer(Protocol):
    """Captures a device's work, to be replayed."""

    def warm_up(self, work: Work, /) -> None:
        """Do the work as it will be captured."""
        ...

    def capture(self, work: Work, /) -> Work:
        """A function that replays the work; raises RuntimeError where it cannot be captured."""
        ...

    def launched(self) -> None:
        """A call's work was handed to the device; return once that of the call before is done."""
        ...


class CudaGraphs:
    """Captures CUDA graphs."""

    def __init__(self) -> None:
        self._launched: torch.cuda.Event | None = None

    def warm_up(self, work: Work) -> None:
        """Work on a side stream, where graphs are captured."""
        usual, side = torch.cuda.current_stream(), torch.cuda.Stream()  # type: ignore[no-untyped-call]
        side.wait_stream(usual)
        with torch.cuda.stream(side):
            work()
        usual.wait_stream(side)

    def capture(self, work: Work) -> Work:
        """Capture the work; other threads may use the device meanwhile."""
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            work()
        replay: Work = graph.replay
        return replay

    def launched(self) -> None:
        """Keep the device one launch ahead, and never more: launches hold their batches."""
        before, self._launched = self._launched, torch.cuda.Event(blocking=True)  # type: ignore[no-untyped-call]
        self._launched.record()
        if before is not None:
            before.synchronize()


def capturer_for(
    setting: Literal["auto", "eager", "graph"], device: torch.device
) -> Capturer | None:
    """CUDA graphs where device and setting have them; None: steps are eager.

    Raises ConfigError where graphs are demanded of a device without them.
    """
    if device.type == "cuda":
        return None if setting == "eager" else CudaGraphs()
    if setting == "graph":
        raise ConfigError(
            f"learner.step 'graph': only a CUDA device replays graphs, not {device}; use auto"
        )
    return None


class CapturedSteps:
    """`num` steps in one launch."""

    def __init__(
        self,
        capturer: Capturer,
        update: Callable[[Batch], Update],
        learning_rate: Tensor,
        like: Batch,
        num: int,
    ) -> None:
        """learning_rate: float32 [], which the update reads; like: a batch of their shapes."""
        self._capturer = capturer
        self._update = update
        self._learning_rate = learning_rate
        self._inputs = [like.map(torch.empty_like) for _ in range(num)]
        device = learning_rate.device
        self._rates = torch.zeros(num, device=device)
        self._known_rates = [0.0] * num
        self._updates = torch.zeros(num, 3 + len(like.keys), device=device)
        self._calls = 0
        self._replay: Work | None = None

    def __call__(self, batches: Sequence[Batch], rates: Sequence[float]) -> list[Update]:
        """Learn from `num` batches, one after the other, each at its learning rate."""
        for held, batch in zip(self._inputs, batches, strict=True):
            for own, given in zip(held.tensors, batch.tensors, strict=True):
                own.copy_(given, non_blocking=True)
        for i, rate in enumerate(rates):
            if rate != self._known_rates[i]:
                self._rates[i] = self._known_rates[i] = rate
        self._run()
        results = self._updates.clone()  # the next call overwrites the captured ones
        self._capturer.launched()
        return [Update.from_numbers(numbers) for numbers in results.unbind()]

    def _run(self) -> None:
        if self._replay is None and self._calls == _WARM_UP:
            self._replay = self._captured()
        if self._replay is None:
            self._capturer.warm_up(self._all)
        else:
            self._replay()
        self._calls += 1

    def _captured(self) -> Work:
        try:
            replay = self._capturer.capture(self._all)
        except RuntimeError as error:
            first_line = str(error).partition("\n")[0]
            _LOG.warning("steps stay eager: capturing a graph failed: %s", first_line)
            return self._all
        _LOG.info("steps are replayed from a graph, %d a launch", len(self._inputs))
        return replay

    def _all(self) -> None:
        for batch, rate, numbers in zip(
            self._inputs, self._rates.unbind(), self._updates.unbind(), strict=True
        ):
            self._learning_rate.copy_(rate)
            numbers.copy_(self._update(batch).numbers())
