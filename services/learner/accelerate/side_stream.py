"""Batches on their way to the learner's device, beside the step that it computes meanwhile."""

from collections.abc import Callable
from typing import Any

import torch

from mrcdrl.common.messages.trajectory import Samples
from mrcdrl.services.learner.batch import Batch


def beside_the_step(
    collate: Callable[[Samples], Batch], device: torch.device
) -> Callable[[Samples], Batch]:
    """The same collate; on a GPU on a stream of its own, for use by one thread.

    It returns once the batch is there: the thread that prepares batches waits, the step does not.
    Their few kernels therefore go before those of the step.
    """
    if device.type != "cuda":
        return collate
    beside: Any = torch.cuda.Stream(device, priority=-1)  # type: ignore[no-untyped-call]
    usual = torch.cuda.default_stream(device)

    def collated(samples: Samples) -> Batch:
        with torch.cuda.stream(beside):
            batch = collate(samples)
        beside.synchronize()
        for tensor in batch.tensors:
            tensor.record_stream(usual)  # its memory is free once the step has read it
        return batch

    return collated
