"""The network is the paper's, its kinds differ in their streams only, its bytes are checked."""

import json
import struct

import pytest
import torch
from safetensors.torch import load, save

from mrcdrl.common.errors import CheckpointError, ConfigError
from mrcdrl.common.model.q_network import Kind, QNetwork, feature_size, precision
from mrcdrl.common.model.weights_io import (
    SENT_AS,
    load_weights,
    network_from_bytes,
    weights_to_bytes,
)

KINDS: list[Kind] = ["duel", "ddqn", "dqn"]


def make_network(
    kind: Kind = "duel", seed: int = 0, view_px: int = 60, dtype: torch.dtype = torch.float32
) -> QNetwork:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return QNetwork(kind, view_px=view_px, compute_dtype=dtype)


@pytest.mark.parametrize("name", ["bfloat16", "float16"])
@pytest.mark.parametrize("kind", KINDS)
def test_half_precision_halves_the_bytes_and_is_cast_up(kind: Kind, name: str) -> None:
    sent, adopted = make_network(kind), make_network(kind, seed=1)
    payload = weights_to_bytes(sent, SENT_AS[name])
    assert len(payload) < 0.51 * len(weights_to_bytes(sent))
    load_weights(adopted, payload)
    for parameter, exact in zip(adopted.parameters(), sent.parameters(), strict=True):
        assert parameter.dtype == torch.float32
        assert torch.equal(parameter, exact.to(SENT_AS[name]).float())
    again = network_from_bytes(payload)
    assert weights_to_bytes(again, SENT_AS[name]) == payload, "rounding twice is rounding once"


def test_what_half_precision_cannot_hold_is_handed_to_nobody() -> None:
    network = make_network()
    with torch.no_grad():
        network.conv1.bias[0] = 1e6
    weights_to_bytes(network, torch.bfloat16)
    with pytest.raises(CheckpointError, match=r"conv1\.bias has values that are not finite"):
        weights_to_bytes(network, torch.float16)


def random_states(count: int, view_px: int = 60) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    shape = (count, 4, view_px, view_px)
    return torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)


def sparse_states(count: int) -> torch.Tensor:
    """Images like the arena's: black but for a few bright squares."""
    generator = torch.Generator().manual_seed(4)
    states = torch.zeros((count, 4, 60, 60), dtype=torch.uint8)
    for state in states:
        for x, y in torch.randint(0, 54, (4, 2), generator=generator).tolist():
            state[:, y : y + 6, x : x + 6] = 255
    return states


@pytest.mark.parametrize(("view_px", "features"), [(60, 1024), (31, 64), (84, 3136)])
def test_feature_size_is_what_the_convolutions_leave(view_px: int, features: int) -> None:
    assert feature_size(view_px) == features
    network = make_network(view_px=view_px)
    assert network(random_states(2, view_px)).shape == (2, 3)


def test_images_too_small_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"view_px 30.*31"):
        QNetwork("duel", view_px=30)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_values_are_float32_for_every_batch_size(kind: Kind, dtype: torch.dtype) -> None:
    network = make_network(kind, dtype=dtype)
    for count in (1, 2, 7):
        values = network(random_states(count))
        assert values.dtype == torch.float32
        assert values.shape == (count, 3)
        assert all(p.dtype == torch.float32 for p in network.parameters())


def test_parameters_are_the_papers() -> None:
    """Section 5.1, unpadded."""
    trunk = {
        "conv1.weight": (32, 4, 5, 5),
        "conv1.bias": (32,),
        "conv2.weight": (64, 32, 3, 3),
        "conv2.bias": (64,),
        "conv3.weight": (64, 64, 3, 3),
        "conv3.bias": (64,),
    }
    two_streams = {
        "value_hidden.weight": (512, 1024),
        "value_hidden.bias": (512,),
        "value.weight": (1, 512),
        "value.bias": (1,),
        "advantage_hidden.weight": (512, 1024),
        "advantage_hidden.bias": (512,),
        "advantage.weight": (3, 512),
        "advantage.bias": (3,),
    }
    one_stream = {
        "hidden.weight": (512, 1024),
        "hidden.bias": (512,),
        "action_value.weight": (3, 512),
        "action_value.bias": (3,),
    }
    for kind, streams in (("duel", two_streams), ("ddqn", one_stream), ("dqn", one_stream)):
        shapes = {n: tuple(p.shape) for n, p in make_network(kind).named_parameters()}
        assert shapes == trunk | streams


def double_parameters(network: QNetwork) -> dict[str, torch.Tensor]:
    return {n: p.detach().double().requires_grad_() for n, p in network.named_parameters()}


def reference_values(p: dict[str, torch.Tensor], states: torch.Tensor) -> torch.Tensor:
    """The paper's order of operations, in float64, without any rearrangement."""
    x = states.double() / 255
    f = torch.nn.functional
    x = f.max_pool2d(f.relu(f.conv2d(x, p["conv1.weight"], p["conv1.bias"], stride=2)), 2)
    x = f.relu(f.conv2d(x, p["conv2.weight"], p["conv2.bias"], stride=2))
    x = f.relu(f.conv2d(x, p["conv3.weight"], p["conv3.bias"])).flatten(1)

    def stream(hidden: str, out: str) -> torch.Tensor:
        h = f.relu(f.linear(x, p[f"{hidden}.weight"], p[f"{hidden}.bias"]))
        return f.linear(h, p[f"{out}.weight"], p[f"{out}.bias"])

    if "hidden.weight" in p:
        return stream("hidden", "action_value")
    advantage = stream("advantage_hidden", "advantage")
    return stream("value_hidden", "value") + advantage - advantage.mean(1, keepdim=True)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("view_px", [60, 61])
def test_values_are_those_of_the_papers_order_of_operations(kind: Kind, view_px: int) -> None:
    network = make_network(kind, view_px=view_px)
    states = random_states(5, view_px)
    expected = reference_values(double_parameters(network), states).detach()
    torch.testing.assert_close(network(states).double(), expected, atol=1e-5, rtol=1e-5)


def test_mean_of_the_duelling_values_is_the_value_stream() -> None:
    """Eq. (1): the advantages cancel, so adding to all of them changes nothing."""
    network = make_network("duel")
    states = random_states(4)
    before = network(states)
    with torch.no_grad():
        network.advantage.bias += 17.0
    torch.testing.assert_close(network(states), before, atol=1e-4, rtol=1e-4)
    with torch.no_grad():
        network.value.bias += 2.0
    torch.testing.assert_close(network(states), before + 2.0, atol=1e-4, rtol=1e-4)


def test_gradients_reach_every_parameter_and_agree_with_the_reference() -> None:
    network = make_network("duel")
    states = random_states(3)
    network(states).square().sum().backward()
    gradients = {name: p.grad for name, p in network.named_parameters()}
    double = double_parameters(network)
    reference_values(double, states).square().sum().backward()
    for name, gradient in gradients.items():
        assert gradient is not None
        expected = double[name].grad
        assert expected is not None
        torch.testing.assert_close(gradient.double(), expected, atol=1e-4, rtol=1e-3)


def test_bfloat16_agrees_on_the_greedy_action() -> None:
    """Where the best action leads by more than rounding; heads in bfloat16 would not."""
    exact, rounded = make_network(), make_network(dtype=torch.bfloat16)
    states = sparse_states(400)
    with torch.no_grad():
        expected, values = exact(states), rounded(states)
    assert (expected.argmax(1) == values.argmax(1)).float().mean() > 0.97
    torch.testing.assert_close(values, expected, atol=2e-3, rtol=2e-2)


def test_precision_settings() -> None:
    assert precision("float32") == torch.float32
    assert precision("bfloat16") == torch.bfloat16
    assert precision("auto") in (torch.float32, torch.bfloat16)


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_hold_the_same_parameters(kind: Kind) -> None:
    network = make_network(kind, seed=1, view_px=31)
    payload = weights_to_bytes(network)
    assert payload == weights_to_bytes(network), "the same weights are the same bytes"
    copy = network_from_bytes(payload)
    assert (copy.kind, copy.stack, copy.view_px) == (kind, 4, 31)
    for name, parameter in network.state_dict().items():
        assert torch.equal(copy.state_dict()[name], parameter), name


def with_header(payload: bytes, change: dict[str, object]) -> bytes:
    (length,) = struct.unpack_from("<Q", payload)
    header = json.loads(payload[8 : 8 + length])
    metadata = json.loads(header["__metadata__"]["mrcdrl"]) | change
    return save(load(payload), {"mrcdrl": json.dumps(metadata)})


def with_array(payload: bytes, name: str, value: torch.Tensor | None) -> bytes:
    (length,) = struct.unpack_from("<Q", payload)
    metadata = json.loads(payload[8 : 8 + length])["__metadata__"]
    arrays = {k: v for k, v in load(payload).items() if k != name}
    return save(arrays if value is None else arrays | {name: value}, metadata)


GOOD = weights_to_bytes(make_network(view_px=31))


@pytest.mark.parametrize(
    ("payload", "message"),
    [
        (b"", "not an MRCDRL weights file"),
        (b"\x00" * 7, "not an MRCDRL weights file"),
        (b"\xff" * 64, "not an MRCDRL weights file"),
        (struct.pack("<Q", 4) + b"[[1]" + b"x" * 9, "not an MRCDRL weights file"),
        (save({"a": torch.zeros(1)}), "not an MRCDRL weights file"),
        (GOOD[:-1], "unreadable"),
        (GOOD[: len(GOOD) // 2], "unreadable"),
        (GOOD + b"x", "unreadable"),
        (with_header(GOOD, {"kind": "dqn"}), "kind 'dqn', not 'duel'"),
        (with_header(GOOD, {"view_px": 60}), "view_px 60, not 31"),
        (with_header(GOOD, {"stack": 3}), "stack 3, not 4"),
        (with_header(GOOD, {"format_version": 99}), "format_version 99, not 1"),
        (with_array(GOOD, "value.bias", None), "lack parameter 'value.bias'"),
        (with_array(GOOD, "extra", torch.zeros(1)), "unknown parameter 'extra'"),
        (with_array(GOOD, "value.bias", torch.zeros(2)), r"value.bias is .*\[2\], not"),
        (with_array(GOOD, "value.bias", torch.zeros(1).half()), "value.bias is torch.float16"),
        (with_array(GOOD, "value.bias", torch.tensor([torch.nan])), "value.bias.*not finite"),
        (with_array(GOOD, "value.bias", torch.tensor([torch.inf])), "value.bias.*not finite"),
    ],
)
def test_weights_that_do_not_fit_are_refused_and_change_nothing(
    payload: bytes, message: str
) -> None:
    network = make_network(seed=5, view_px=31)
    before = weights_to_bytes(network)
    with pytest.raises(CheckpointError, match=message) as caught:
        load_weights(network, payload)
    assert "\n" not in str(caught.value)
    assert weights_to_bytes(network) == before


@pytest.mark.parametrize(
    "change",
    [{"kind": "c51"}, {"stack": 0}, {"stack": True}, {"view_px": 10**9}, {"view_px": 12}],
)
def test_a_header_cannot_make_us_build_just_anything(change: dict[str, object]) -> None:
    with pytest.raises(CheckpointError, match="network"):
        network_from_bytes(with_header(GOOD, change))


def test_weights_that_diverged_are_not_handed_out() -> None:
    network = make_network(view_px=31)
    with torch.no_grad():
        network.conv1.bias[0] = torch.nan
    with pytest.raises(CheckpointError, match=r"conv1.bias.*not finite"):
        weights_to_bytes(network)
