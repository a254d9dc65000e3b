"""Group ids, one integer for each problem instance; copies seeded by group; whose a state is."""

from __future__ import annotations

import os
import secrets
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torchrl.data import Categorical, Composite, MultiCategorical, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torchrl_ecpo.checks import check_count, check_kind
from torchrl_ecpo.groups import GROUP_KEY

_COUNTER_BITS = 24
_PREFIX_BITS = 63 - _COUNTER_BITS


class GroupIdAllocator:
    """Hands out non-negative int64 ids, unique across allocators and processes.

    An id is a random 39-bit prefix and a 24-bit counter. A new prefix is drawn when the counter is
    used up, and when the allocator finds itself in another process or is copied or unpickled:
    a thousand allocators share a prefix with a probability of about one in a million. The
    prefix comes from the operating system, so that no seeded generator is touched.

    Raises:
        ValueError: by :meth:`allocate` and :meth:`identify`, for what is no count or too many.

    Examples:
        >>> ids = GroupIdAllocator().allocate(3)
        >>> ids.dtype, (ids - ids[0]).tolist()
        (torch.int64, [0, 1, 2])
    """

    def __init__(self) -> None:
        self._renew()

    def identify(self, *key: int) -> int:
        """Return the id of a thing that has a key: the same until :meth:`allocate` needs a prefix.

        It is a hash of 63 bits: a million of them collide with a probability of one in 20 million.
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

        They are `stride` apart; the ids in between are reserved, for a caller who tells variants of
        one instance apart.
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


def check_action_shape(key: NestedKey, action: torch.Tensor, spec: TensorSpec) -> None:
    """Refuse what is no action, such as an index where the environment reads one-hot."""
    if action.shape == spec.shape:
        return
    mend = (
        "It takes an index for each choice, as Independent(Categorical(...), 1) gives."
        if isinstance(spec, MultiCategorical)
        else "An index (Categorical) goes with GymEnv(..., categorical_action_encoding=True), "
        "OneHotCategorical with GymEnv(...)."
    )
    raise ValueError(
        f"Got {key!r} of shape {tuple(action.shape)}, but the action of the environment is "
        f"{type(spec).__name__} of shape {tuple(spec.shape)}. {mend}"
    )


def check_is_new(name: str, task: Any, others: list[Any]) -> None:
    """Refuse a copy that is one of the others, and note it."""
    if any(task is other for other in others):
        raise ValueError(
            f"{name} must make a new copy at each call, and it returns {task!r:.100} again. Make "
            "the environment in the function: lambda: MyTask(...)."
        )
    others.append(task)


class OneInstance(EnvBase):
    """Rows of copies `[G, K]` that all play one problem instance, in which nothing is random.

    Who extends this calls :meth:`_set_specs`, and writes ``_reset`` and ``_step``.
    """

    _group: torch.Tensor

    def __init__(self, num_groups: int, group_size: int, device: torch.device | str | None) -> None:
        rows = (check_count("num_groups", num_groups), check_count("group_size", group_size))
        super().__init__(batch_size=torch.Size(rows), device=device)
        # A row's group stays the same from episode to episode.
        group = GroupIdAllocator().allocate(rows[0]).to(self.device)
        self.register_buffer("_group", group.unsqueeze(-1).expand(rows).clone())

    def _set_specs(self, observation: TensorSpec, num_actions: int) -> None:
        shape, one = self.batch_size, torch.Size((*self.batch_size, 1))
        group = Unbounded(shape, dtype=torch.int64)
        self.observation_spec = Composite(observation=observation, group=group, shape=shape)
        self.action_spec = Composite(action=Categorical(num_actions, shape=shape), shape=shape)
        self.reward_spec = Composite(reward=Unbounded(one), shape=shape)
        flag = Categorical(2, shape=one, dtype=torch.bool)
        self.done_spec = Composite(done=flag, terminated=flag.clone(), shape=shape)

    def _show(self, observation: torch.Tensor, done: torch.Tensor) -> TensorDict:
        """What a step or a reset returns."""
        shown = {"observation": observation, "group": self._group.clone()}
        shown |= {"done": done, "terminated": done.clone()}
        return TensorDict(shown, batch_size=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Nothing to seed: `instance_seed` draws the instance, and an episode is not random."""
        if seed is not None:
            check_count("seed", seed, least=0)


class SeededGroups(EnvBase):
    """Rows of copies `[G, K]`; the `n`-th episode of each copy of a row has one seed and one id.

    Who extends this sets the specs, calls :meth:`_begin`, and writes :meth:`_start` and ``_step``.
    """

    _seeded_generators = "gymnasium's self.np_random"

    def _begin(self) -> None:
        """Add the group to the specs, and draw a seed."""
        rows = self.batch_size
        spec: Any = self.full_observation_spec
        spec[GROUP_KEY] = Unbounded(shape=rows, dtype=torch.int64, device=self.device)
        self.full_observation_spec = spec
        self._group = torch.zeros(rows, dtype=torch.int64, device=self.device)
        self._set_seed(None)

    def _start(
        self, tensordict: TensorDictBase | None, seeds: list[int | None], **kwargs: Any
    ) -> TensorDictBase:
        """Reset the copies that have a seed, and return what all of them show, and their groups.

        Args:
            tensordict: what `reset` was given if some of the copies go on. None: all have a seed.
            seeds: of each copy `[G * K]`; None: it goes on.
            kwargs: what else `reset` was given.
        """
        raise NotImplementedError

    def _add_group(self, out: TensorDictBase) -> TensorDictBase:
        """Write what is played."""
        return out.set(GROUP_KEY, self._group.clone())

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            seed = check_count("seed", seed, least=0)
        self._seed = secrets.randbits(63) if seed is None else seed
        self._ids = GroupIdAllocator()  # an instance of another seed is another one
        self._episode = np.zeros(self.batch_size, dtype=int)  # of each copy, the next one

    def _next_instances(self, selected: np.ndarray) -> tuple[list[int | None], np.ndarray]:
        """Return the seeds and the group ids of the next episodes of copies `[G, K]`."""
        seeds: list[int | None] = [None] * selected.size
        ids = np.zeros(selected.shape, dtype=int)
        known: dict[tuple[int, int], tuple[int, int]] = {}
        for row, copy in np.argwhere(selected).tolist():
            key = row, int(self._episode[row, copy])
            if key not in known:
                sequence = np.random.SeedSequence(self._seed, spawn_key=key)
                known[key] = int(sequence.generate_state(1)[0]), self._ids.identify(*key)
            seeds[row * selected.shape[1] + copy], ids[row, copy] = known[key]
        self._episode += selected
        return seeds, ids

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        if (seed := kwargs.pop("seed", None)) is not None:
            raise TypeError(
                "Groups are seeded by set_seed(...), from which the seeds of their episodes come; "
                f"reset takes none, got seed={seed!r}."
            )
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            tensordict = None
            # The copies of a row may have played different numbers of episodes.
            self._episode[:] = self._episode.max(1, keepdims=True)
            selected = np.ones(self.batch_size, dtype=bool)
        else:
            selected = mask.reshape(*self.batch_size, -1).any(-1).numpy(force=True)
        seeds, ids = self._next_instances(selected)
        group = torch.from_numpy(np.where(selected, ids, self._group.numpy(force=True)))
        self._group = group.to(self._group.device)
        out = self._start(tensordict, seeds, **kwargs)
        if mask is None:
            self._check_alike(out)
        return out

    def _check_alike(self, start: TensorDictBase) -> None:
        for key in self.full_observation_spec.keys(True, True):
            value = start.get(key, None)
            if not isinstance(value, torch.Tensor):
                continue
            first = value[:, :1]
            if not ((value == first) | ((value != value) & (first != first))).all():
                raise RuntimeError(
                    f"The copies of a group differ in {key!r} at their start, though they are "
                    "reset with one seed. The environment has to draw its start from a generator "
                    f"that its reset seeds, {self._seeded_generators}."
                )

    def get_extra_state(self) -> dict[str, Any]:
        """The seed and what was played of it; an episode that is being played is not in it."""
        return {"env": describe(self), "seed": self._seed, "episode": self._episode.tolist()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on with the next instances; the environment must be reset."""
        check_owner(state, describe(self))
        seed, episode = check_count("seed", state["seed"], least=0), np.asarray(state["episode"])
        if episode.shape != self._episode.shape or episode.dtype.kind != "i":
            raise ValueError(f"episode must be integers {list(self.batch_size)}, got {episode}.")
        self._set_seed(seed)
        self._episode[:] = episode
