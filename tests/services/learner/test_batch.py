"""Collating finds the right images for s and s', and symmetry_rows images and actions together."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mrcdrl.common.config import ReplayConfig
from mrcdrl.common.errors import WireError
from mrcdrl.common.messages.trajectory import Samples, UInt8Array
from mrcdrl.services.learner.batch import collate, importance_exponent_at, importance_weights
from mrcdrl.services.learner.rendering import HostRenderer

VIEW_PX = 5


def decode(records: UInt8Array) -> UInt8Array:
    """A record is one byte: the number that fills its image, corner marked."""
    images = np.repeat(records, VIEW_PX * VIEW_PX, axis=-1)
    images = images.reshape(*records.shape[:-1], VIEW_PX, VIEW_PX).copy()
    images[..., 0, 0] = 255
    return images


def make_samples(
    offsets: list[int], width: int, *, actions: list[int] | None = None, seed: int = 0
) -> Samples:
    count = len(offsets)
    rng = np.random.default_rng(seed)
    discounts = np.array([0.99**k for k in offsets], np.float32)
    discounts[::3] = 0.0
    return Samples(
        keys=np.arange(count, dtype=np.int64),
        probabilities=np.full(count, 0.01),
        table_size=100,
        total_priority=100.0,
        records=(np.arange(count)[:, None] * 16 + np.arange(width)).astype(np.uint8)[..., None],
        actions=np.array(actions or rng.integers(3, size=count), np.uint8),
        rewards=rng.normal(size=count).astype(np.float32),
        discounts=discounts,
        bootstrap_offsets=np.array(offsets, np.uint8),
        weights_versions=np.zeros(count, np.int64),
    )


def test_states_are_the_windows_the_offsets_name() -> None:
    """Row b holds images 16 b, 16 b + 1, …: the numbers are the positions."""
    samples = make_samples([1, 3, 2], width=7)
    batch = collate(samples, HostRenderer(decode), 4)
    assert batch.observation[:, :, 1, 1].tolist() == [
        [0, 1, 2, 3],
        [16, 17, 18, 19],
        [32, 33, 34, 35],
    ]
    assert batch.next_observation[:, :, 1, 1].tolist() == [
        [1, 2, 3, 4],
        [19, 20, 21, 22],
        [34, 35, 36, 37],
    ]
    torch.testing.assert_close(batch.reward, torch.from_numpy(samples.rewards))
    torch.testing.assert_close(batch.discount, torch.from_numpy(samples.discounts))
    assert batch.action.tolist() == samples.actions.tolist()
    assert batch.importance_weights.tolist() == [1.0, 1.0, 1.0]
    assert batch.keys.tolist() == samples.keys.tolist()


def test_dtypes_and_shapes() -> None:
    batch = collate(make_samples([2] * 6, width=6), HostRenderer(decode), 4)
    assert batch.observation.dtype == batch.next_observation.dtype == torch.uint8
    assert batch.observation.shape == batch.next_observation.shape == (6, 4, VIEW_PX, VIEW_PX)
    assert batch.action.dtype == torch.int64
    for column in (batch.reward, batch.discount, batch.importance_weights):
        assert column.dtype == torch.float32
        assert column.shape == (6,)


@given(st.integers(1, 4), st.lists(st.integers(1, 5), min_size=1, max_size=8))
@settings(deadline=None)
def test_states_for_any_stack_and_offsets(stack: int, offsets: list[int]) -> None:
    batch = collate(make_samples(offsets, width=stack + 5), HostRenderer(decode), stack)
    for row, offset in enumerate(offsets):
        first = row * 16
        assert batch.observation[row, :, 1, 1].tolist() == list(range(first, first + stack))
        later = first + offset
        assert batch.next_observation[row, :, 1, 1].tolist() == list(range(later, later + stack))


def test_records_off_the_wire_are_read_only_and_decoded_once() -> None:
    samples = make_samples([1, 1], width=5)
    for array in (samples.records, samples.rewards, samples.discounts, samples.actions):
        array.flags.writeable = False
    shapes = []

    def counting(records: UInt8Array) -> UInt8Array:
        shapes.append(records.shape)
        images = decode(records)
        images.flags.writeable = False
        return images

    collate(samples, HostRenderer(counting), 4)
    assert shapes == [(2, 5, 1)]


class Identity:
    def apply_to_images(self, images: UInt8Array) -> UInt8Array:
        return images

    def apply_to_actions(self, actions: UInt8Array) -> UInt8Array:
        return actions


class MirrorX:
    """Left-right: action 0 (left) and 2 (right) change places."""

    def apply_to_images(self, images: UInt8Array) -> UInt8Array:
        return images[..., ::-1]

    def apply_to_actions(self, actions: UInt8Array) -> UInt8Array:
        return 2 - actions


class TurnHalf:
    """By 180 degrees: actions stay."""

    def apply_to_images(self, images: UInt8Array) -> UInt8Array:
        return images[..., ::-1, ::-1]

    def apply_to_actions(self, actions: UInt8Array) -> UInt8Array:
        return actions


def test_a_transition_and_its_action_undergo_the_same_symmetry() -> None:
    """The marked corner tells which was drawn."""
    samples = make_samples([1, 2, 3] * 10, width=7)
    symmetries = (Identity(), MirrorX(), TurnHalf())
    drawn_for = np.random.default_rng(0).integers(3, size=30)
    rows = [(symmetry, np.flatnonzero(drawn_for == i)) for i, symmetry in enumerate(symmetries)]
    batch = collate(samples, HostRenderer(decode), 4, symmetry_rows=rows)  # type: ignore[arg-type]
    corners = {(0, 0): 0, (0, VIEW_PX - 1): 1, (VIEW_PX - 1, VIEW_PX - 1): 2}
    seen = set()
    plain = collate(samples, HostRenderer(decode), 4)
    for row in range(30):
        both = torch.cat([batch.observation[row], batch.next_observation[row]])
        y, x = np.unravel_index(int(both[0].argmax()), (VIEW_PX, VIEW_PX))
        drawn = corners[int(y), int(x)]
        assert drawn == drawn_for[row]
        seen.add(drawn)
        assert (both[:, y, x] == 255).all(), "every image of the transition alike"
        expected = samples.actions[row] if drawn != 1 else 2 - samples.actions[row]
        assert batch.action[row] == expected
        assert batch.observation[row, :, 1, 1].tolist() == plain.observation[row, :, 1, 1].tolist()
    assert seen == {0, 1, 2}


@pytest.mark.parametrize(
    ("samples", "message"),
    [
        (make_samples([1, 4], width=7), "needs 8 records and has 7"),
        (make_samples([1], width=5, actions=[3]), "action 3"),
    ],
)
def test_samples_that_cannot_be_are_refused(samples: Samples, message: str) -> None:
    with pytest.raises(WireError, match=message):
        collate(samples, HostRenderer(decode), 4)


def test_importance_weights_by_hand() -> None:
    """N = 100: probabilities 1/100 and 4/100 weigh 1 and (1/4)**beta."""
    samples = make_samples([1, 1], width=5)
    samples.probabilities[:] = [0.01, 0.04]
    np.testing.assert_allclose(importance_weights(samples, 0.5), [1.0, 0.5])
    np.testing.assert_allclose(importance_weights(samples, 1.0), [1.0, 0.25])
    np.testing.assert_allclose(importance_weights(samples, 0.0), [1.0, 1.0])


@pytest.mark.parametrize(
    ("step", "expected"), [(0, 0.4), (50, 0.55), (200, 1.0), (201, 1.0), (10**9, 1.0)]
)
def test_importance_exponent_is_annealed(step: int, expected: float) -> None:
    annealed = ReplayConfig(
        importance_exponent=0.4, importance_exponent_final=1.0, importance_anneal_steps=200
    )
    assert importance_exponent_at(annealed, step) == pytest.approx(expected)
    assert importance_exponent_at(ReplayConfig(), step) == 0.4


def test_of_equal_probabilities_all_weights_are_exactly_1() -> None:
    samples = make_samples([1] * 7, width=5)
    samples.probabilities[:] = 1 / 93
    assert (importance_weights(samples, 0.4) == 1.0).all()


def test_a_batch_keeps_nothing_of_the_samples_memory() -> None:
    sampled = make_samples([1, 3, 2], width=7)
    batch = collate(sampled, HostRenderer(decode), 4)
    parts = (batch.observation, batch.action, batch.reward, batch.discount, batch.next_observation)
    for array in (*(part.numpy() for part in parts), batch.keys):
        for field in dataclasses.fields(sampled):
            source = getattr(sampled, field.name)
            assert not (isinstance(source, np.ndarray) and np.shares_memory(array, source))
