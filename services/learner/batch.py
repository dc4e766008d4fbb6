"""The tensors of one learner step, made from sampled records.

Invariants: every record is rendered once; a transition's images and its action undergo the same
symmetry; states are stacked out of single images here only.

Shapes: B = transitions, W = records a transition may touch, R = bytes of a record, S = images
stacked in a state, V = width of an image in px.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Generic, Self

import numpy as np
import torch
from torch import Tensor
from typing_extensions import TypeVar

from mrcdrl.common.arena import Symmetry
from mrcdrl.common.config import ReplayConfig
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Float32Array, Int64Array, Samples
from mrcdrl.services.learner.rendering import Renderer, SymmetryRows, to_device

S = TypeVar("S", default=Tensor)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Batch(Generic[S]):
    """What one learner step reads; states are tensors, or what a fast first layer takes."""

    observation: S  # uint8 [B, S, V, V], may be a view with strides
    action: Tensor  # int64 [B]
    reward: Tensor  # float32 [B], n-step return
    discount: Tensor  # float32 [B], gamma**k, 0 after a termination
    next_observation: S  # uint8 [B, S, V, V], k steps later
    importance_weights: Tensor  # float32 [B], largest is 1
    keys: Int64Array  # [B], of the transitions in replay

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All but the keys."""
        return tuple(getattr(self, name) for name in _TENSORS)

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The batch with each of its tensors changed, and the same keys."""
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in _TENSORS}
        return replace(self, **changed)

    def __getitem__(self, rows: slice) -> Self:
        """Some of its transitions, as views."""
        return replace(self.map(lambda x: x[rows]), keys=self.keys[rows])

    def with_states(self, change: Callable[[S], T]) -> "Batch[T]":
        """The batch with its states in another form."""
        return Batch(
            change(self.observation),
            self.action,
            self.reward,
            self.discount,
            change(self.next_observation),
            self.importance_weights,
            self.keys,
        )


_TENSORS = tuple(field.name for field in fields(Batch) if field.name != "keys")


def importance_exponent_at(replay: ReplayConfig, learner_step: int) -> float:
    """beta of the importance weights at a learner step: linear, then constant."""
    begin = (0, replay.importance_exponent)
    end = (replay.importance_anneal_steps, replay.importance_exponent_final)
    return value_at((begin, end), learner_step)


def importance_weights(samples: Samples, beta: float) -> Float32Array:
    """(1 / (N p)) ** beta over its largest, float32 [B] (prioritized replay, section 3.4)."""
    weights = np.power(samples.table_size * samples.probabilities, -beta)
    largest: np.float64 = weights.max()
    return (weights / largest).astype(np.float32)


def collate(
    samples: Samples,
    render: Renderer,
    stack: int,
    *,
    symmetries: Sequence[Symmetry] = (),
    rng: np.random.Generator | None = None,
    beta: float = 0.0,
) -> Batch:
    """The batch of these samples, on the renderer's device.

    symmetries: one is drawn by rng for each transition; include the identity among them. beta:
    of the importance weights; 0 makes them 1.

    Raises WireError if an action or a bootstrap offset is outside what the records hold.
    """
    _check(samples, stack)
    symmetry_rows = _drawn(symmetries, rng, len(samples))
    actions = samples.actions.copy()
    for symmetry, rows in symmetry_rows:
        actions[rows] = symmetry.apply_to_actions(actions[rows])
    images = render(samples.records, symmetry_rows)
    device = images.device
    offsets = to_device(samples.bootstrap_offsets.astype(np.int64), device)
    each = torch.arange(len(samples), device=device)[:, None]
    window = offsets[:, None] + torch.arange(stack, device=device)
    return Batch(
        observation=images[:, :stack],
        action=to_device(actions.astype(np.int64), device),
        reward=to_device(samples.rewards.astype(np.float32), device),
        discount=to_device(samples.discounts.astype(np.float32), device),
        next_observation=images[each, window],
        importance_weights=to_device(importance_weights(samples, beta), device),
        keys=samples.keys.copy(),  # the samples are valid for a while only
    )


def _check(samples: Samples, stack: int) -> None:
    if len(samples) == 0:
        raise WireError("a batch without transitions")
    if int(samples.actions.max()) >= NUM_ACTIONS:
        raise WireError(f"action {samples.actions.max()} is none of {NUM_ACTIONS}")
    width, last = samples.records.shape[1], int(samples.bootstrap_offsets.max()) + stack
    if last > width:
        raise WireError(f"a transition needs {last} records and has {width}")


def _drawn(
    symmetries: Sequence[Symmetry], rng: np.random.Generator | None, num: int
) -> SymmetryRows:
    """One symmetry for each of num rows; none where there are none."""
    if not symmetries:
        return ()
    if rng is None:
        raise ValueError("symmetries are drawn at random: give an rng")
    drawn = rng.integers(len(symmetries), size=num)
    return [(symmetry, np.flatnonzero(drawn == i)) for i, symmetry in enumerate(symmetries)]
