"""Group ids, one integer for each problem instance; and which environment a state is of."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torchrl.envs import EnvBase

from torchrl_ecpo.checks import check_count, check_kind

_COUNTER_BITS = 24
_PREFIX_BITS = 63 - _COUNTER_BITS


class GroupIdAllocator:
    """Hands out non-negative int64 ids, unique across allocators and processes.

    An id is a random 39-bit prefix and a 24-bit counter. A new prefix is drawn when the counter is
    used up, and when the allocator finds itself in another process or is copied or unpickled:
    a thousand allocators share a prefix with a probability of about one in a million. The
    prefix comes from the operating system, so that no seeded generator is touched.

    Examples:
        >>> ids = GroupIdAllocator().allocate(3)
        >>> ids.dtype, (ids - ids[0]).tolist()
        (torch.int64, [0, 1, 2])
    """

    def __init__(self) -> None:
        self._renew()

    def identify(self, *key: int) -> int:
        """Return the id of a thing that has a key: the same whenever this process asks.

        It is a hash of 63 bits: a million of them collide with a probability of one in 20 million.

        Args:
            key: non-negative integers; anything else is a ValueError.
        """
        key = tuple(check_count("key", part, least=0) for part in key)
        self._renew_elsewhere()
        bits = np.random.SeedSequence(self._prefix, spawn_key=key).generate_state(1, np.uint64)
        return int(bits[0] >> np.uint64(1))

    def _renew_elsewhere(self) -> None:
        if os.getpid() != self._process:
            self._renew()

    def _renew(self) -> None:
        self._prefix = secrets.randbits(_PREFIX_BITS) << _COUNTER_BITS
        self._count = 0
        self._process = os.getpid()

    def __reduce__(self) -> tuple[type[GroupIdAllocator], tuple[()]]:
        """A copy is another allocator."""
        return type(self), ()

    def allocate(self, count: int, *, stride: int = 1) -> torch.Tensor:
        """Return `count` new ids, int64 `[count]` on the CPU.

        Args:
            count: how many.
            stride: the distance from one id to the next; the ids in between are reserved, for a
                caller who tells variants of one instance apart. Default: 1.

        Raises:
            ValueError: if one call asks for more ids than the counter holds.
        """
        count, stride = check_count("count", count, least=0), check_count("stride", stride)
        span = count * stride
        if span > 1 << _COUNTER_BITS:
            raise ValueError(
                f"count * stride must be at most {1 << _COUNTER_BITS} in one call, got {span}: "
                "allocate the group ids in smaller blocks."
            )
        self._renew_elsewhere()
        if self._count + span > 1 << _COUNTER_BITS:
            self._renew()
        start = self._prefix + self._count
        self._count += span
        return torch.arange(start, start + span, stride)


def describe(env: EnvBase) -> str:
    """What an environment gives and takes, by which others are told apart."""
    specs = (own.items(True, True) for own in (env.full_observation_spec, env.full_action_spec))
    entries = ", ".join(
        f"{name} {tuple(spec.shape)} {spec.dtype}" for own in specs for name, spec in own
    )
    return f"{entries} in a batch {tuple(env.batch_size)}"


def check_owner(state: Mapping[str, Any], own: str) -> None:
    """Refuse the state of another environment; one written before states had an owner is taken."""
    check_kind("_extra_state", state, Mapping)
    owner = state.get("env", own)
    if owner != own:
        raise ValueError(f"The state is of another environment: of {owner}, and this is {own}.")
