"""Acting on the network's values: stacks of images in, actions out.

Invariants: one inference for all robots given; the values returned are those the actions were
chosen by; weights change in `adopt` only, wholly or not at all.

Shapes: N = robots acted for at once, S = images stacked, V = width of an image in px.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from mrcdrl.common.arena import IDENTITY, Symmetry, layout_symmetries
from mrcdrl.common.config import Config
from mrcdrl.common.messages.trajectory import NUM_ACTIONS, Float32Array, UInt8Array, Weights
from mrcdrl.common.model.fast_forward import fast_forward, operands, prepare
from mrcdrl.common.model.q_network import QNetwork, precision
from mrcdrl.common.model.weights_io import load_weights

_ACTIONS = np.arange(NUM_ACTIONS, dtype=np.uint8)


@dataclass(frozen=True, slots=True)
class Selection:
    """Chosen actions, and the values they were chosen by."""

    actions: UInt8Array  # [N]
    q_values: Float32Array  # [N, num_actions]
    greedy_q: Float32Array  # [N], of the best action, whether it was taken or not

    @property
    def taken_q(self) -> Float32Array:
        """Values of the chosen actions, [N]."""
        return self.q_values[np.arange(len(self.actions)), self.actions]


class Policy:
    """Epsilon-greedy on a network's values (paper section 5.2)."""

    def __init__(self, network: QNetwork, symmetries: Sequence[Symmetry] = (IDENTITY,)) -> None:
        """symmetries: values are means over what the network says of the states mapped by each."""
        self._symmetries = tuple(symmetries)
        self.network = network.eval().requires_grad_(requires_grad=False)
        self._device = next(network.parameters()).device
        self._operands = operands(network)
        self.weights_epoch = -1  # -1: initial parameters, none adopted yet
        self.weights_version = -1
        self.learner_step = 0

    def __repr__(self) -> str:
        return (
            f"Policy(kind={self.network.kind!r}, weights_epoch={self.weights_epoch}, "
            f"weights_version={self.weights_version}, learner_step={self.learner_step})"
        )

    def averaging(self, symmetries: Sequence[Symmetry]) -> Self:
        """The policy with the same network, and these symmetries in place of its own.

        They share parameters, so neither is to adopt others.
        """
        other = copy.copy(self)
        other._symmetries = tuple(symmetries)
        return other

    def adopt(self, weights: Weights) -> None:
        """Act by these weights from now on.

        Raises CheckpointError if they are not this network's; the old ones stay.
        """
        load_weights(self.network, weights.payload)
        self._operands = operands(self.network)
        self.weights_epoch = weights.epoch
        self.weights_version = weights.version
        self.learner_step = weights.learner_step

    def q_values(self, observations: UInt8Array) -> Float32Array:
        """Values float32 [N, num_actions] of states uint8 [N, S, V, V]."""
        if self._symmetries == (IDENTITY,):
            return self._inferred(observations)
        total = np.zeros((len(observations), NUM_ACTIONS), np.float32)
        for symmetry in self._symmetries:
            values = self._inferred(symmetry.apply_to_images(observations))
            total += values[:, symmetry.apply_to_actions(_ACTIONS)]
        return total / np.float32(len(self._symmetries))

    def _inferred(self, observations: UInt8Array) -> Float32Array:
        """The network's values of the states as they are."""
        states = torch.from_numpy(np.require(observations, requirements=["C", "W"]))
        with torch.inference_mode():
            prepared = prepare(self.network, states.to(self._device))
            values = fast_forward(self.network, prepared, self._operands)
            array: Float32Array = values.cpu().numpy()
        return array

    def select_actions(
        self, observations: UInt8Array, epsilon: float | Float32Array, rng: np.random.Generator
    ) -> Selection:
        """Epsilon-greedy actions for states uint8 [N, S, V, V]; epsilon is one for all or [N].

        With epsilon's probability the action is uniform over all, the greedy one included.
        """
        values = self.q_values(observations)
        count, num_actions = values.shape
        explores = rng.random(count) < epsilon
        uniform = rng.integers(num_actions, size=count, dtype=np.uint8)
        actions = np.where(explores, uniform, values.argmax(axis=1).astype(np.uint8))
        return Selection(actions=actions, q_values=values, greedy_q=values.max(axis=1))


def averaged_symmetries(config: Config) -> tuple[Symmetry, ...]:
    """The symmetries over which whoever judges or uses weights of a run averages their values."""
    return layout_symmetries(config.arena)[: config.agent.symmetric_views]


def make_policy(
    config: Config, device: str | torch.device = "cpu", *, averages: bool = True
) -> Policy:
    """A policy of the configured network on a device, its parameters still to be adopted.

    averages: over symmetries, if the configuration says so.
    """
    network = QNetwork(
        config.agent.kind,
        stack=config.arena.stack,
        view_px=config.arena.view_px,
        num_actions=config.arena.action_count,
        compute_dtype=precision(config.learner.precision, device),
    )
    return Policy(network.to(device), averaged_symmetries(config) if averages else (IDENTITY,))


class FrameStack:
    """The latest S images of each of N robots, oldest first."""

    def __init__(self, num_robots: int, stack: int, view_px: int) -> None:
        self._stacks: UInt8Array = np.zeros((num_robots, stack, view_px, view_px), np.uint8)

    @property
    def stacks(self) -> UInt8Array:
        """uint8 [N, S, V, V]; overwritten by the next `reset` or `push`."""
        return self._stacks

    def reset(self, indices: NDArray[np.integer] | slice, frames: UInt8Array) -> UInt8Array:
        """Fill the stacks of these robots with their first image, uint8 [len(indices), V, V]."""
        self._stacks[indices] = frames[:, np.newaxis]
        return self._stacks

    def push(
        self, frames: UInt8Array, indices: NDArray[np.integer] | slice = slice(None)
    ) -> UInt8Array:
        """Add an image to each of these robots' stacks, uint8 [n, V, V]; returns `stacks`."""
        for age in range(self._stacks.shape[1] - 1):
            self._stacks[indices, age] = self._stacks[indices, age + 1]
        self._stacks[indices, -1] = frames
        return self._stacks
