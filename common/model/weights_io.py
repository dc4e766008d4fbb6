"""A network's parameters as bytes (safetensors), and back.

Invariant: bytes that are damaged, foreign, not finite or of another network are refused, and the
network keeps the parameters it had.
"""

import json
import struct
from typing import Final, TypeGuard

import torch
from safetensors import SafetensorError
from safetensors.torch import load as read_safetensors
from safetensors.torch import save as write_safetensors
from torch import Tensor

from mrcdrl.common.errors import CheckpointError, ConfigError
from mrcdrl.common.model.q_network import QNetwork

FORMAT_VERSION: Final = 1
SENT_AS: Final = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
_METADATA_KEY: Final = "mrcdrl"  # one JSON text: safetensors does not keep an order of several


def weights_to_bytes(network: QNetwork, dtype: torch.dtype = torch.float32) -> bytes:
    """The parameters as safetensors: by name, with what they belong to in the header.

    dtype: one of SENT_AS; all but float32 round. Raises CheckpointError if a value is not finite,
    or not once it is rounded: weights that diverged are handed to nobody.
    """
    arrays = {
        name: parameter.detach().to("cpu", dtype).contiguous()
        for name, parameter in network.state_dict().items()
    }
    _check_finite(arrays)
    return write_safetensors(arrays, {_METADATA_KEY: json.dumps(_metadata(network))})


def load_weights(network: QNetwork, payload: bytes, *, any_kind: bool = False) -> None:
    """Set the network's parameters in place, cast up where they were sent in half precision.

    any_kind: take weights of a network of another kind whose parameters fit.

    Raises CheckpointError, leaving the network as it was, if the payload is unreadable, belongs
    to another kind or shape of network, or holds a value that is not finite.
    """
    metadata = _read_metadata(payload)
    expected = _metadata(network)
    for name, value in expected.items():
        if metadata.get(name) != value and not (any_kind and name == "kind"):
            raise CheckpointError(f"weights have {name} {metadata.get(name)!r}, not {value!r}")
    arrays = read_arrays(payload)
    own = network.state_dict()
    if odd := sorted(own.keys() ^ arrays.keys()):
        where = "lack" if odd[0] in own else "have an unknown"
        raise CheckpointError(f"weights {where} parameter {odd[0]!r}")
    sent_as = arrays[next(iter(own))].dtype
    dtype = sent_as if sent_as in SENT_AS.values() else torch.float32
    for name, parameter in own.items():
        array = arrays[name]
        if array.dtype != dtype or array.shape != parameter.shape:
            raise CheckpointError(
                f"weights: {name} is {array.dtype} {list(array.shape)}, "
                f"not {dtype} {list(parameter.shape)}"
            )
    _check_finite(arrays)
    network.load_state_dict(arrays)


def network_from_bytes(
    payload: bytes, *, compute_dtype: torch.dtype = torch.float32, device: str = "cpu"
) -> QNetwork:
    """The network that the payload's header names, with its parameters.

    Raises CheckpointError as `load_weights` does.
    """
    metadata = _read_metadata(payload)
    kind, stack, view_px = metadata.get("kind"), metadata.get("stack"), metadata.get("view_px")
    num_actions = metadata.get("num_actions")
    if (
        kind not in ("duel", "ddqn", "dqn")
        or not _in_range(stack, 16)
        or not _in_range(view_px, 255)
        or not _in_range(num_actions, 255)
    ):
        raise CheckpointError(f"weights of an unknown network: {json.dumps(metadata)[:200]}")
    try:
        network = QNetwork(
            kind, stack=stack, view_px=view_px, num_actions=num_actions, compute_dtype=compute_dtype
        )
    except ConfigError as error:
        raise CheckpointError(f"weights name an impossible network: {error}") from error
    load_weights(network, payload)
    return network.to(device)


def read_arrays(payload: bytes) -> dict[str, Tensor]:
    """Tensors by name of a safetensors payload; raises CheckpointError if it is unreadable."""
    try:
        return read_safetensors(payload)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        first_line = str(error).partition("\n")[0]
        raise CheckpointError(f"weights are unreadable: {first_line}") from error


def _metadata(network: QNetwork) -> dict[str, object]:
    return {
        "format_version": FORMAT_VERSION,
        "kind": network.kind,
        "stack": network.stack,
        "view_px": network.view_px,
        "num_actions": network.num_actions,
    }


def _in_range(value: object, highest: int) -> TypeGuard[int]:
    return type(value) is int and 1 <= value <= highest


def _read_metadata(payload: bytes) -> dict[str, object]:
    try:
        (length,) = struct.unpack_from("<Q", payload)
        header = json.loads(payload[8 : 8 + length])
        metadata = json.loads(header["__metadata__"][_METADATA_KEY])
    except (struct.error, ValueError, OverflowError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError("not an MRCDRL weights file") from error
    if not isinstance(metadata, dict):
        raise CheckpointError("not an MRCDRL weights file")
    return metadata


def _check_finite(arrays: dict[str, Tensor]) -> None:
    for name, array in arrays.items():
        if not bool(torch.isfinite(array).all()):
            raise CheckpointError(f"weights: {name} has values that are not finite")
