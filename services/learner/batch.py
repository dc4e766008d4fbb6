"""The tensors of one learner step, made from sampled records.

Invariants: every record is rendered once; a transition's images and its action undergo the same
symmetry; states are stacked out of single images here only.

Shapes: B = transitions, W = records a transition may touch, R = bytes of a record, S = images
stacked in a state, V = width of an image in px.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Generic, Self

import numpy as np
import torch
from torch import Tensor
from typing_extensions import TypeVar

from mrcdrl.common.config import ReplayConfig
from mrcdrl.common.config.schedule import value_at
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import (
    NUM_ACTIONS,
    Float32Array,
    Int64Array,
    Samples,
    UInt8Array,
)
from mrcdrl.services.learner.rendering import Renderer, SymmetryRows, to_device

S = TypeVar("S", default=Tensor)
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Ahead:
    """What is known of a batch before its step, since the online network does not matter for it."""

    observation: Any  # as the first layer takes states
    next_observation: Any
    next_q: Tensor  # float32 [B, A], of next_observation by the target network
    target_version: int  # of that network

    def values_of(self, states: object, target_version: int) -> Tensor | None:
        """The values of these states by that target network, where they are known."""
        known = states is self.next_observation and target_version == self.target_version
        return self.next_q if known else None

    def __getitem__(self, rows: slice) -> Self:
        """What is known of some transitions, as views."""
        return replace(
            self,
            observation=self.observation[rows],
            next_observation=self.next_observation[rows],
            next_q=self.next_q[rows],
        )


@dataclass(frozen=True, slots=True)
class Demonstration:
    """What a demonstrator does in the states of a batch."""

    actions: Tensor  # int64 [B]
    weights: Tensor  # float32 [B], of the margin's loss

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The same with each tensor changed."""
        return replace(self, actions=change(self.actions), weights=change(self.weights))


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
    ahead: Ahead | None = None
    demonstration: Demonstration | None = None

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """What a step needs."""
        shown = self.demonstration
        own = tuple(getattr(self, name) for name in _TENSORS)
        return own if shown is None else (*own, shown.actions, shown.weights)

    def map(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The batch with each of its tensors changed, and the same keys."""
        changed: dict[str, Any] = {name: change(getattr(self, name)) for name in _TENSORS}
        shown = self.demonstration
        return replace(self, **changed, demonstration=shown and shown.map(change))

    def __getitem__(self, rows: slice) -> Self:
        """Some of its transitions, as views."""
        ahead = None if self.ahead is None else self.ahead[rows]
        return replace(self.map(lambda x: x[rows]), keys=self.keys[rows], ahead=ahead)

    def with_states(self, observation: T, next_observation: T) -> "Batch[T]":
        """The batch with its states in another form."""
        return Batch(
            observation,
            self.action,
            self.reward,
            self.discount,
            next_observation,
            self.importance_weights,
            self.keys,
            self.ahead,
            self.demonstration,
        )


_OTHERS = {"keys", "ahead", "demonstration"}
_TENSORS = tuple(field.name for field in fields(Batch) if field.name not in _OTHERS)


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
    symmetry_rows: SymmetryRows = (),
    beta: float = 0.0,
    num_actions: int = NUM_ACTIONS,
    demonstrate: Callable[[UInt8Array], UInt8Array] | None = None,
    demonstration_weight: float = 0.0,
) -> Batch:
    """The batch of these samples, on the renderer's device.

    symmetry_rows: symmetries, each with the transitions that undergo it. beta: of the importance
    weights; 0 makes them 1. demonstrate: actions [B] in the states whose newest records are [B, R].

    Raises WireError if an action or a bootstrap offset is outside what the records hold.
    """
    _check(samples, stack, num_actions)
    actions = _mapped(samples.actions, symmetry_rows)
    images = render(samples.records, symmetry_rows)
    device = images.device
    offsets = to_device(samples.bootstrap_offsets.astype(np.int64), device)
    shown = None if demonstrate is None else demonstrate(samples.records[:, stack - 1])
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
        demonstration=None
        if shown is None
        else Demonstration(
            to_device(_mapped(shown, symmetry_rows).astype(np.int64), device),
            to_device(np.full(len(shown), demonstration_weight, np.float32), device),
        ),
    )


def _mapped(actions: UInt8Array, symmetry_rows: SymmetryRows) -> UInt8Array:
    """The actions [B] after the symmetries that their rows undergo."""
    mapped = actions.copy()
    for symmetry, rows in symmetry_rows:
        mapped[rows] = symmetry.apply_to_actions(mapped[rows])
    return mapped


def _check(samples: Samples, stack: int, num_actions: int) -> None:
    if len(samples) == 0:
        raise WireError("a batch without transitions")
    if int(samples.actions.max()) >= num_actions:
        raise WireError(f"action {samples.actions.max()} is none of {num_actions}")
    width, last = samples.records.shape[1], int(samples.bootstrap_offsets.max()) + stack
    if last > width:
        raise WireError(f"a transition needs {last} records and has {width}")
