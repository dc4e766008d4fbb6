"""Signs that learning goes wrong, reported while it can still be fixed.

Invariants: looks only, and changes nothing. One look is one inference on a few states and one
transfer from the device, so that a look a second costs next to nothing. A warning is logged once
until its cause has gone. Histograms keep their bins for as long as the run lasts.
"""

import logging
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mrcdrl.common.config import Config
from mrcdrl.common.config.returns import largest_return
from mrcdrl.common.messages.metrics import Q_EDGES, TD_ERROR_EDGES, Bins, DiagnosticMetrics
from mrcdrl.common.messages.trajectory import Float32Array
from mrcdrl.common.model.fast_forward import Trace, fast_forward, operands, prepare
from mrcdrl.services.learner.batch import Batch
from mrcdrl.services.learner.learner import Learner
from mrcdrl.services.learner.step import Update

_LOG = logging.getLogger("learner")
_STATES = 64  # looked at, of a batch
_TOO_LARGE = 2.0  # times the largest return
_TOO_DEAD = 0.9

_LOOKS_A_HISTOGRAM = 15


class Diagnostics:
    """Looks at values, errors, units and target of a learner on its last batch."""

    def __init__(self, config: Config, learner: Learner) -> None:
        self._learner = learner
        self._largest_return = largest_return(config)
        self._warned: set[str] = set()
        self._looks = 0
        self._q_histogram = Histogram(np.array(Q_EDGES) * self._largest_return)
        self._td_error_histogram = Histogram(np.array(TD_ERROR_EDGES) * self._largest_return)

    def look(self, batch: Batch, update: Update) -> DiagnosticMetrics:
        """Metrics after a step on this batch; logs what is alarming.

        Histograms come with the first look and each 15th after it, and cover the looks between.
        """
        values, dead = self._infer(batch.observation[:_STATES])
        network = torch.stack([dead, self._drift()])
        found = torch.cat([network, values.flatten(), update.numbers()]).cpu().numpy()
        (dead_share, target_drift), q, told = np.split(found, [2, 2 + values.numel()])
        (loss, mean_q, gradient_norm), errors = told[:3], np.abs(told[3:])
        with np.errstate(invalid="ignore"):  # where there are infinite ones
            q_min, q_p50, q_max = np.quantile(q, (0.0, 0.5, 1.0))
            error_p50, error_p90, error_p99 = np.quantile(errors, (0.5, 0.9, 0.99))
        self._warn(
            "values",
            max(-q_min, q_max) > _TOO_LARGE * self._largest_return,
            f"values of {q_min:.3g} to {q_max:.3g}, where no return exceeds "
            f"{self._largest_return:.3g}: learning diverges; lower agent.learning_rate",
        )
        self._warn(
            "units",
            dead_share > _TOO_DEAD,
            f"{dead_share:.0%} of the network's units are 0 whatever they see: little can be "
            "learned any more; lower agent.learning_rate and start a new run",
        )
        q_bin, td_error_bin = self._binned(q, errors)
        return DiagnosticMetrics(
            loss=float(loss),
            mean_q=float(mean_q),
            td_error_mean=float(errors.mean()),
            gradient_norm=float(gradient_norm),
            loss_finite=math.isfinite(loss),
            q_min=float(q_min),
            q_p50=float(q_p50),
            q_max=float(q_max),
            td_error_p50=float(error_p50),
            td_error_p90=float(error_p90),
            td_error_p99=float(error_p99),
            dead_share=float(dead_share),
            target_drift=float(target_drift),
            q_bin=q_bin,
            td_error_bin=td_error_bin,
        )

    def _infer(self, states: Tensor) -> tuple[Tensor, Tensor]:
        """Values [B, A], and the share of hidden units that are 0 for all these states.

        The units of a convolution are its channels.
        """
        network = self._learner.online
        trace = Trace()
        with torch.no_grad():
            q = fast_forward(network, prepare(network, states), operands(network), trace)
        dead = torch.cat([x.transpose(0, 1).flatten(1).amax(1) <= 0 for x in trace.units])
        return q, dead.float().mean()

    def _drift(self) -> Tensor:
        """Distance of the online parameters from the target's, relative to the target's norm."""
        online, target = self._learner.online.parameters(), self._learner.target.parameters()
        with torch.no_grad():
            pairs = [(p - t, t) for p, t in zip(online, target, strict=True)]
            far = torch.nn.utils.get_total_norm([difference for difference, _ in pairs])
            length = torch.nn.utils.get_total_norm([parameter for _, parameter in pairs])
        return far / length

    def _binned(self, q: Float32Array, errors: Float32Array) -> tuple[Bins, Bins]:
        """The histograms of values and errors when they are due, else empty ones."""
        self._q_histogram.add(q)
        self._td_error_histogram.add(errors)
        self._looks += 1
        if self._looks % _LOOKS_A_HISTOGRAM != 1:
            return (), ()
        return self._q_histogram.take(), self._td_error_histogram.take()

    def _warn(self, cause: str, alarming: bool, text: str) -> None:
        if alarming and cause not in self._warned:
            _LOG.warning("%s", text)
        (self._warned.add if alarming else self._warned.discard)(cause)


class Histogram:
    """Counts of values by bin: below the first edge, between edges, from the last one on."""

    def __init__(self, edges: NDArray[np.float64]) -> None:
        self._edges = edges
        self._counts = np.zeros(len(edges) + 1)

    def add(self, values: Float32Array) -> None:
        """Count these values; NaN is left out."""
        bins = np.searchsorted(self._edges, values[~np.isnan(values)], side="right")
        self._counts += np.bincount(bins, minlength=len(self._counts))

    def take(self) -> Bins:
        """The fraction of values in each bin since the last call; zeros where there were none."""
        shares = self._counts / max(self._counts.sum(), 1.0)
        self._counts[:] = 0
        return tuple(float(share) for share in shares)
