"""Checks of input that more than one module makes, and their words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Refuse what is not among the choices of an option."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {choices}, got {value!r}.")


def check_count(name: str, value: Any, *, least: int = 1, reason: str = "") -> None:
    """Refuse what is not an integer of at least so many."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}{reason}, got {value!r}.")


def values_can_be_seen() -> bool:
    """Whether tensors have values to check: not while being compiled, nor within ``torch.vmap``."""
    return not (torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active())


def get_entry(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
    """An entry that must be there."""
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(
            f"The entry {key!r} is missing; there are {present(tensordict)}. If it has another "
            "name, say so with set_keys(...), or where the networks are built."
        )
    return value


def present(tensordict: TensorDictBase) -> str:
    """The entries of a tensordict, for messages."""
    return ", ".join(sorted(map(repr, tensordict.keys(True, True))))


def as_float(name: str, value: Any) -> float:
    """A number from an option."""
    try:
        return float(value)
    except (TypeError, ValueError, RuntimeError):
        raise ValueError(f"{name} must be a number, got {value!r}.") from None
