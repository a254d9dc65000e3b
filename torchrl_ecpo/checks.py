"""Checks of input that more than one module makes, and their words."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from numbers import Integral
from types import NoneType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase, is_non_tensor, is_tensor_collection
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from torchrl_ecpo._torch import is_transformed


def check_choice(name: str, value: Any, choices: Sequence[Any]) -> None:
    """Refuse what is not among the choices of an option."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.")


def check_count(name: str, value: Any, *, least: int = 1, reason: str = "") -> int:
    """An integer of at least so many, numpy's too, as Python's own; refuse anything else."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}{reason}, got {value!r}.")
    return int(value)


def check_counts(name: str, values: Any) -> tuple[int, ...]:
    """Integers of at least 1, as Python's own; refuse anything else."""
    if not isinstance(values, (Sequence, np.ndarray)) or isinstance(values, (str, bytes)):
        raise TypeError(f"{name} must be a sequence of integers, got {values!r}.")
    return tuple(check_count(f"Each of {name}", value) for value in values)


def check_kind(name: str, value: Any, *kinds: Any) -> None:
    """Refuse what is an object of none of the classes."""
    if not isinstance(value, kinds):
        expected = " or ".join("None" if kind is NoneType else kind.__name__ for kind in kinds)
        article = "an" if expected[0] in "AEIOUaeiou" else "a"
        raise TypeError(f"{name} must be {article} {expected}, got {described(value)}.")


def check_network(name: str, network: Any) -> None:
    """Refuse what reads no entries."""
    if not isinstance(network, TensorDictModuleBase):
        raise TypeError(
            f"{name} must be a TensorDictModule, such as ValueOperator, got {network!r:.60}."
        )


def check_keys(name: str, keys: Any) -> list[Any]:
    """Names of entries; refuse anything else, such as one name that is in no list."""
    try:
        if not keys or isinstance(keys, (str, Mapping)):
            raise TypeError
        return [unravel_key(key) for key in keys]
    except (TypeError, RuntimeError):
        raise TypeError(
            f"{name} must list names of entries, such as ['observation'], got {keys!r}."
        ) from None


def check_flag(name: str, value: Any, *others: Any) -> Any:
    """True, False or one of the others; refuse anything else, such as ``"no"``, which is true."""
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if not any(value is other or (isinstance(other, str) and value == other) for other in others):
        choices = ", ".join(map(repr, (True, False, *others)))
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.")
    return value


def check_group_size(size: Any, name: str = "group_size") -> int:
    """A K of at least 2; refuse anything else."""
    reason = ": a trajectory is weighed against the others of its group"
    return check_count(name, size, least=2, reason=reason)


def check_mask(key: NestedKey, mask: Tensor, shape: torch.Size) -> Tensor:
    """A mask without its trailing 1, of the shape of the batch; refuse any other."""
    if not isinstance(mask, Tensor):
        raise TypeError(f"The mask {key!r} must be a boolean tensor, got {type(mask).__name__}.")
    if mask.shape == (*shape, 1):
        mask = mask.squeeze(-1)
    if mask.shape != shape:
        raise ValueError(
            f"The mask {key!r} must have the shape {tuple(shape)} of the batch (that of the reward "
            f"without its trailing 1), got {tuple(mask.shape)}."
        )
    if mask.dtype != torch.bool:
        raise ValueError(
            f"The mask {key!r} must be boolean (True: the step is real), got {mask.dtype}."
        )
    return mask


def check_real(key: NestedKey, values: Tensor) -> None:
    """Refuse complex numbers, the imaginary part of which would be dropped."""
    if values.is_complex():
        raise ValueError(f"The entry {key!r} must hold real numbers, got {values.dtype}.")


def check_integers(key: NestedKey, values: Tensor) -> None:
    """Refuse other numbers, which would be cut to integers."""
    if values.is_floating_point() or values.is_complex() or values.dtype == torch.bool:
        raise ValueError(f"The entry {key!r} must hold integers, got {values.dtype}.")


def check_padding(keys: Sequence[NestedKey], mask: Tensor) -> None:
    """Refuse holes ``[..., T]``: a policy with memory would read other histories than it acted on.

    Args:
        keys: of the mask, for the message.
        mask: True where a step is real.
    """
    holes = (mask[..., 1:] & ~mask[..., :-1]).any(-1)
    if holes.any():
        raise ValueError(
            f"The mask {tuple(keys)} has holes in {int(holes.sum())} trajectories: their real "
            "steps must come first, and the padding after them."
        )


def values_can_be_seen() -> bool:
    """Whether tensors have values to check: not while compiled, captured or in ``torch.vmap``."""
    return not (torch.compiler.is_compiling() or is_transformed() or is_captured())


def is_captured() -> bool:
    """Whether a CUDA graph is being captured, which replays no Python and may not wait."""
    return torch.cuda.is_initialized() and torch.cuda.is_current_stream_capturing()


def get_entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """An entry that must be there."""
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(
            f"The entry {key!r} is missing; there are {present(tensordict)}. If it has another "
            "name, say so with set_keys(...), or where the networks are built."
        )
    if is_non_tensor(value) or not (isinstance(value, Tensor) or is_tensor_collection(value)):
        raise TypeError(f"The entry {key!r} must be a tensor, got {type(value).__name__}.")
    return value


def get_choice(
    tensordict: TensorDictBase, key: NestedKey, shape: torch.Size, number: int
) -> Tensor:
    """An entry of integers from 0 to `number` - 1, of this shape."""
    value = get_entry(tensordict, key)
    if value.shape != shape or value.dtype not in (torch.int64, torch.int32):
        raise ValueError(
            f"{key!r} must be int64 of shape {list(shape)}, got {value.dtype} of shape "
            f"{list(value.shape)}."
        )
    if bool(((value < 0) | (value >= number)).any().item()):
        raise ValueError(
            f"Each {key!r} must be an integer from 0 to {number - 1}, got {value.min().item()} to "
            f"{value.max().item()}."
        )
    return value


UNREADABLE = (RuntimeError, IndexError, TypeError, AttributeError, KeyError)
"""What a network raises when it is given what it cannot read."""


def unreadable(
    network: str, tensordict: TensorDictBase, keys: Sequence[NestedKey], error: Exception
) -> Exception:
    """An error that names the entries which a network could not read."""
    if isinstance(error, torch.OutOfMemoryError):
        raise error
    values = {key: tensordict.get(key, None) for key in keys}
    told = [f"{key!r} {'(missing)' if x is None else described(x)}" for key, x in values.items()]
    lines = (str(error).strip() or type(error).__name__).splitlines()
    # Where an error only announces another one, that one is the reason.
    reason = " ".join(lines[: 2 if lines[0].rstrip().endswith(":") else 1])
    kind = KeyError if isinstance(error, KeyError) else ValueError
    return kind(f"The {network} cannot be evaluated on {', '.join(told)}: {reason}")


def names_entries(network: Callable[..., Any]) -> Callable[..., Any]:
    """Let a module's method say which of its entries it cannot read."""

    @wraps(network)
    def named(self: Any, tensordict: TensorDictBase, *arguments: Any) -> Any:
        try:
            return network(self, tensordict, *arguments)
        except UNREADABLE as error:
            name = f"network ({type(self).__name__})"
            raise unreadable(name, tensordict, self.in_keys, error) from error

    return named


def described(value: Any) -> str:
    """Type and shape of a tensor, the class of anything else."""
    is_tensor = isinstance(value, Tensor)
    return f"{value.dtype} {tuple(value.shape)}" if is_tensor else type(value).__name__


def present(tensordict: TensorDictBase) -> str:
    """The entries of a tensordict, for messages."""
    return ", ".join(sorted(map(repr, tensordict.keys(True, True))))


def as_float(name: str, value: Any, interval: str = "") -> float:
    """A number from an option; no text, and no flag. In an interval such as "(0, 1]", if given."""
    try:
        if isinstance(value, (str, bool)):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name} must be a number, got {value!r}.") from None
    if interval:
        low, high = map(float, interval[1:-1].split(","))
        is_left_out = (number == low and interval[0] == "(") or (
            number == high and interval[-1] == ")"
        )
        if not low <= number <= high or is_left_out:
            raise ValueError(f"{name} must be in {interval}, got {value}.")
    return number
