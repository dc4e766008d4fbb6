"""Batches copied to a GPU on a stream beside that of the step, which runs meanwhile."""

from collections.abc import Callable
from typing import Any

import torch

from mrcdrl.common.messages.trajectory import Samples
from mrcdrl.services.learner.batch import Batch


def on_side_stream(
    collate: Callable[[Samples], Batch], device: torch.device
) -> Callable[[Samples], Batch]:
    """The same collate; on a GPU it runs on its own stream, for use by one thread.

    It returns once the batch has arrived: the thread that prepares batches waits, the step does
    not. Its few kernels therefore go before those of the step.
    """
    if device.type != "cuda":
        return collate
    side: Any = torch.cuda.Stream(device, priority=-1)  # type: ignore[no-untyped-call]
    usual = torch.cuda.default_stream(device)

    def collated(samples: Samples) -> Batch:
        with torch.cuda.stream(side):
            batch = collate(samples)
        side.synchronize()
        for tensor in batch.tensors:
            tensor.record_stream(usual)  # its memory is free once the step has read it
        return batch

    return collated
