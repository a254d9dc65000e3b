"""Checks of input that more than one module makes, and their words."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase, is_non_tensor, is_tensor_collection
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_ecpo._torch import is_transformed


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse what is not among the choices of an option."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.")


def check_count(name: str, value: Any, *, least: int = 1, reason: str = "") -> int:
    """An integer of at least so many, numpy's too, as Python's own; refuse anything else."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}{reason}, got {value!r}.")
    return int(value)


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
    """Whether tensors have values to check: not while being compiled, nor within ``torch.vmap``."""
    return not (torch.compiler.is_compiling() or is_transformed())


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


UNREADABLE = (RuntimeError, IndexError, TypeError, AttributeError, KeyError)
"""What a network raises when it is given what it cannot read."""


def unreadable(
    network: str, tensordict: TensorDictBase, keys: Sequence[NestedKey], error: Exception
) -> Exception:
    """An error that names the entries which a network could not read."""
    if isinstance(error, torch.OutOfMemoryError):
        raise error
    told = []
    for key in keys:
        value = tensordict.get(key, None)
        if value is None:
            told.append(f"{key!r} (missing)")
        elif isinstance(value, Tensor):
            told.append(f"{key!r} {value.dtype} {tuple(value.shape)}")
        else:
            told.append(f"{key!r} ({type(value).__name__})")
    reason = (str(error).strip() or type(error).__name__).splitlines()[0]
    kind = KeyError if isinstance(error, KeyError) else ValueError
    return kind(f"The {network} cannot be evaluated on {', '.join(told)}: {reason}")


def present(tensordict: TensorDictBase) -> str:
    """The entries of a tensordict, for messages."""
    return ", ".join(sorted(map(repr, tensordict.keys(True, True))))


def as_float(name: str, value: Any) -> float:
    """A number from an option; no text, and no flag."""
    try:
        if isinstance(value, (str, bool)):
            raise TypeError
        return float(value)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name} must be a number, got {value!r}.") from None
