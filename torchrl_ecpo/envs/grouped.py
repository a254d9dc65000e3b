"""Groups over any environment: copies that start from the same state."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data.utils import CloudpickleWrapper
from torchrl.envs import EnvBase, GymWrapper, ParallelEnv, SerialEnv, TransformedEnv

from torchrl_ecpo.checks import check_count, check_flag, check_group_size, check_real, get_entry
from torchrl_ecpo.envs._groups import SeededGroups, check_action_shape, check_is_new


class GroupedEnv(SeededGroups):
    """`G` rows of `K` copies of an environment; the copies of a row start from the same state.

    The batch size is `[num_groups, group_size]`, `[G, K]`. Each row plays one problem instance
    after the other: the `n`-th episode of each of its copies is started from the seed of (row, `n`)
    and carries the same integer ``"group"``, whether the copies are reset together or each at its
    own time. A reset of everything starts a new instance in every row.

    Copies of gymnasium's are played several times as fast by
    :func:`~torchrl_ecpo.envs.make_grouped_env`.

    Wrap it in the transforms that count or sum (``StepCounter(max_steps=...)``, ``RewardSum()``,
    ``InitTracker()``, ``DoubleToFloat()``) like any other environment.

    Args:
        create_env_fn: makes one copy, for example
            ``lambda: GymEnv("CartPole-v1", categorical_action_encoding=True)``; its batch size must
            be empty. Without ``categorical_action_encoding=True`` discrete actions are one-hot,
            and the numbers of a ``Categorical`` policy are refused.
        num_groups: `G`.
        group_size: `K`, at least 2.
        parallel: whether each copy runs in a process of its own (``ParallelEnv``) instead of one
            after the other in this one (``SerialEnv``). Default: False.

    The seeds come from the operating system until ``set_seed`` is called, as gymnasium's do.
    Within a reset, torch's generators are seeded too and put back afterwards, so that environments
    written in torch start from the same state as well and the policy's randomness is untouched.
    What an environment draws later from the generator that its reset seeded, gymnasium's
    ``np_random``, is shared too: equal actions of two copies then lead to equal trajectories.
    Noise of their own must come from a generator that a reset does not seed.

    Raises:
        TypeError: if `create_env_fn` is no function, or makes no environment of TorchRL.
        ValueError: if `group_size` is below 2, `num_groups` below 1, or a copy has a batch size;
            if `create_env_fn` returns one copy again and again; for a negative seed, for an action
            of another shape, and for the state of another environment.
        RuntimeError: at a reset of everything, if the copies of a row do not start alike.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> copy = lambda: GymEnv("CartPole-v1", categorical_action_encoding=True)
        >>> env = GroupedEnv(copy, num_groups=2, group_size=3)
        >>> start = env.reset()
        >>> start["observation"].shape, start["group"].shape
        (torch.Size([2, 3, 4]), torch.Size([2, 3]))
        >>> bool((start["observation"] == start["observation"][:, :1]).all())
        True
        >>> start["group"].unique().numel()
        2
    """

    copies: EnvBase
    _seeded_generators = "gymnasium's self.np_random, or from torch's"

    def __init__(
        self,
        create_env_fn: Callable[[], EnvBase],
        *,
        num_groups: int,
        group_size: int,
        parallel: bool = False,
    ) -> None:
        """Make the environment; the class describes the arguments."""
        num_groups = check_count("num_groups", num_groups)
        group_size = check_group_size(group_size)
        if isinstance(create_env_fn, EnvBase) or not callable(create_env_fn):
            raise TypeError(
                "create_env_fn must be a function that makes a copy, such as "
                f'lambda: GymEnv("CartPole-v1"), got {create_env_fn!r}.'
            )
        parallel = check_flag("parallel", parallel)
        batched = ParallelEnv if parallel else SerialEnv
        copies = batched(
            num_groups * group_size,
            CloudpickleWrapper(partial(_make_copy, create_env_fn, None if parallel else _Made())),
        )
        if copies.batch_size != (num_groups * group_size,):
            shape = tuple(copies.batch_size[1:])
            copies.close(raise_if_closed=False)
            raise ValueError(
                f"create_env_fn must make an environment of batch size (), got {shape}: its rows "
                "cannot be started one by one. num_groups and group_size make the batch."
            )
        super().__init__(batch_size=torch.Size([num_groups, group_size]), device=copies.device)
        # Not a submodule: the state of the copies is not the state_dict's business.
        object.__setattr__(self, "copies", copies)
        for name in ("observation", "action", "state", "reward", "done"):
            # The copies are alike, and some specs cannot be unflattened.
            spec = getattr(copies, f"full_{name}_spec")[0].expand(self.batch_size)
            setattr(self, f"full_{name}_spec", spec)
        self._begin()

    def _start(
        self,
        tensordict: TensorDictBase | None,
        seeds: list[int | None],
        **kwargs: Any,
    ) -> TensorDictBase:
        options = [kwargs if seed is None else {**kwargs, "seed": seed} for seed in seeds]
        flat = None if tensordict is None else tensordict.reshape(-1)
        out = self.copies.reset(flat, list_of_kwargs=options)
        return self._add_group(out.reshape(self.batch_size))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key in self.action_keys:
            action = get_entry(tensordict, key)
            check_real(key, action)
            check_action_shape(key, action, self.full_action_spec[key])
        out = self.copies.step(tensordict.reshape(-1))["next"]
        return self._add_group(out.reshape(self.batch_size))

    def to(self, device: torch.device | str | int) -> GroupedEnv:
        """Move the copies too."""
        object.__setattr__(self, "copies", self.copies.to(device))
        super().to(device)
        self._group = self._group.to(self.device)
        return self

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the copies."""
        super().close(raise_if_closed=raise_if_closed)
        if not self.copies.is_closed:
            self.copies.close(raise_if_closed=raise_if_closed)


class _Made:
    """The tasks that were made, none of which this keeps alive; a pickle has none."""

    def __init__(self) -> None:
        self.tasks: list[weakref.ref[Any]] = []

    def __reduce__(self) -> tuple[type[_Made], tuple[()]]:
        return _Made, ()

    def add(self, task: Any) -> None:
        check_is_new("create_env_fn", task, [known() for known in self.tasks])
        self.tasks.append(weakref.ref(task))


def _make_copy(create_env_fn: Callable[[], EnvBase], made: _Made | None) -> EnvBase:
    """Make one, of another task than those made, which are None in a process of its own."""
    env = create_env_fn()
    if not isinstance(env, EnvBase):
        raise TypeError(
            "create_env_fn must make an environment of TorchRL (of gymnasium's: GymWrapper), got "
            f"{env!r}."
        )
    if made is not None:
        task: Any = _without_transforms(env)
        task = task.unwrapped if isinstance(task, GymWrapper) else task
        made.add(task)
    return _SeededEnv(env, auto_unwrap=False)


def _without_transforms(env: Any) -> EnvBase:
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


class _SeededEnv(TransformedEnv):
    """An environment whose reset takes the seed that it starts from."""

    def _reset(
        self, tensordict: TensorDictBase | None = None, seed: int | None = None, **kwargs: Any
    ) -> TensorDictBase:
        if seed is None:
            return super()._reset(tensordict, **kwargs)
        native = _without_transforms(self.base_env)
        cuda = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
        with torch.random.fork_rng(devices=cuda):
            torch.manual_seed(seed)
            if isinstance(native, GymWrapper):
                # Gymnasium seeds and resets in one call; set_seed would be a second reset.
                kwargs["seed"] = seed
            else:
                self.base_env.set_seed(seed, static_seed=True)
            return super()._reset(tensordict, **kwargs)
