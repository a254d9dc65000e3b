"""Groups over gymnasium: all copies in one vector environment, each started from its own seed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import deepcopy
from functools import partial
from multiprocessing.connection import wait
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.classic_control.cartpole import CartPoleEnv, CartPoleVectorEnv
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space, iterate
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, GymWrapper

from torchrl_ecpo.checks import (
    check_count,
    check_flag,
    check_group_size,
    check_integers,
    check_kind,
    check_real,
    get_entry,
)
from torchrl_ecpo.envs._groups import SeededGroups, check_is_new
from torchrl_ecpo.envs.grouped import GroupedEnv
from torchrl_ecpo.groups import GROUP_KEY


def make_grouped_env(
    env: str | Callable[[], gym.Env | EnvBase],
    *,
    num_groups: int,
    group_size: int,
    parallel: bool = False,
) -> VectorGroupedEnv | GroupedEnv:
    """Groups of copies of an environment, in the fastest way that fits.

    What is gymnasium's is played in one vector environment, :class:`VectorGroupedEnv`; any other
    environment of TorchRL in :class:`GroupedEnv`. Seeds, starts and group ids are the same.

    Args:
        env: an id of gymnasium's, or what makes one copy, of gymnasium's class or of TorchRL's.
        num_groups: `G`.
        group_size: `K`, at least 2.
        parallel: whether each copy runs in a process of its own. Default: False.

    Raises:
        TypeError: if `env` is or makes anything else.
        ValueError: for an id that gymnasium does not know, for a function that returns one copy
            again and again, and what the two classes refuse.

    Examples:
        >>> env = make_grouped_env("Acrobot-v1", num_groups=2, group_size=3)
        >>> start = env.reset()
        >>> start["observation"].shape, start["group"].shape
        (torch.Size([2, 3, 6]), torch.Size([2, 3]))
        >>> from torchrl.envs import PendulumEnv
        >>> type(make_grouped_env(PendulumEnv, num_groups=2, group_size=3)).__name__
        'GroupedEnv'
    """
    sizes: Any = {"num_groups": num_groups, "group_size": group_size, "parallel": parallel}
    if isinstance(env, str):
        return VectorGroupedEnv(env, **sizes)
    if isinstance(env, (gym.Env, EnvBase)) or not callable(env):
        raise TypeError(
            f'env must be an id such as "CartPole-v1" or a function that makes a copy, got {env!r}.'
        )
    copy: Any = env()
    check_kind("What env makes", copy, gym.Env, EnvBase)
    copy.close()
    make: Any = env
    return (GroupedEnv if isinstance(copy, EnvBase) else VectorGroupedEnv)(make, **sizes)


class VectorGroupedEnv(SeededGroups):
    """:class:`GroupedEnv` over gymnasium's own vector environments, several times as fast.

    Seeds, starts, group ids and the state that is saved are those of ``GroupedEnv`` over
    ``GymEnv(..., categorical_action_encoding=True)``, for tasks that draw from gymnasium's
    ``np_random``; torch's generator is not seeded here, so that one which draws its start from that
    is for ``GroupedEnv``. The entries are the same too: observations in the dtype of their space,
    those of a ``Dict`` by their names, those of a ``Tuple`` as ``("observation", "0")`` and so on;
    a drawing, which is a ``Box`` of bytes ``(H, W, 3)``, as ``"pixels"``; what is discrete as
    integers, ``Box`` without dimensions as one number. Rewards are float32.

    The copies are played in a ``SyncVectorEnv``, or with `parallel` in an ``AsyncVectorEnv``, by
    ``AutoresetMode.DISABLED`` and reset masks. A copy that is over, or that ``"_step"`` leaves out,
    is not stepped: it goes on showing its last observation, and earns nothing.

    Of vector entry points CartPole's is taken, given its id: it can be told where each copy starts.
    Its start and steps are those of ``CartPoleEnv`` to the last bits. Others draw all copies from
    one generator, so that those of a group would differ; then a ``SyncVectorEnv`` is made.

    Args:
        env: an id of gymnasium's, or what makes a copy. A copy that needs arguments or wrappers
            takes a function: ``lambda: readable(gym.make("Taxi-v4"))``, with
            :func:`~torchrl_ecpo.envs.readable`.
        num_groups: `G`.
        group_size: `K`, at least 2.
        parallel: whether each copy runs in a process of its own. Default: False.

    Raises:
        TypeError: if `env` makes anything else, and for a space that is not read (``Text``,
            ``Graph``, ``Sequence``), with the wrapper that mends it.
        ValueError: for an id that gymnasium does not know, and for numbers as in ``GroupedEnv``.
            Also for a function that returns one copy again and again, and for a copy that breaks
            its spaces or gymnasium's rules.
        RuntimeError: at a reset of everything, if the copies of a row do not start alike.
        ChildProcessError: if the process of a copy dies; all are ended then.

    Examples:
        >>> env = VectorGroupedEnv("CartPole-v1", num_groups=2, group_size=3)
        >>> rollout = env.rollout(100, break_when_any_done=False)
        >>> rollout["observation"].shape, rollout["group"].shape
        (torch.Size([2, 3, 100, 4]), torch.Size([2, 3, 100]))
    """

    def __init__(
        self,
        env: str | Callable[[], gym.Env],
        *,
        num_groups: int,
        group_size: int,
        parallel: bool = False,
    ) -> None:
        """Make the environment; the class describes the arguments."""
        rows = torch.Size([check_count("num_groups", num_groups), check_group_size(group_size)])
        parallel = check_flag("parallel", parallel)
        make: Any = env
        if isinstance(env, str):
            make = partial(gym.make, env, disable_env_checker=True)  # as GymEnv does
        try:
            one = make()
        except gym.error.Error as error:
            raise ValueError(
                f"env={env!r} is no task of gymnasium: {error} One that another module registers "
                "is 'module:Task-v0'; or give a function that makes a copy."
            ) from error
        check_kind("What env makes", one, gym.Env)
        one.close()
        for name in ("observation_space", "action_space"):
            if not isinstance(space := getattr(one, name, None), gym.Space):
                raise _broken(one, f"it must have an {name} of gymnasium.spaces, got {space!r}")
        shown = _read_root("observation", one.observation_space)
        action = _read_root("action", one.action_space)
        if shared := {*shown.keys()}.intersection(action.keys()):
            raise ValueError(
                f"The action space has entries {sorted(shared)}, which the observation space has "
                f"too, so that one would be written over the other. {_MENDS['action']}."
            )
        super().__init__(batch_size=rows)
        self._shown = shown.expand(rows)
        self.observation_spec = self._shown.clone()
        self.full_action_spec = action.expand(rows)
        column = torch.Size([*rows, 1])
        self.reward_spec = Unbounded(column, dtype=torch.float32)
        flag = Categorical(2, column, dtype=torch.bool)
        flags = {name: flag.clone() for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(flags, shape=rows)
        self._actions = batch_space(one.action_space, rows.numel())
        self._vector: Any
        if isinstance(env, str) and not parallel and _is_plain_cartpole(one.spec):
            limit = one.spec.max_episode_steps
            self._vector = _SeededCartPole(rows.numel(), limit, **one.spec.kwargs)
        else:
            batched = AsyncVectorEnv if parallel else SyncVectorEnv
            copies = [lambda: _Copy(make())] * rows.numel()
            self._vector = batched(copies, autoreset_mode=AutoresetMode.DISABLED)
            others: list[Any] = []
            for copy in () if parallel else self._vector.envs:
                check_is_new("env", copy.unwrapped, others)
        self._ends = np.zeros((2, rows.numel()), dtype=bool)  # terminated, truncated
        self._begin()

    def _start(
        self,
        tensordict: TensorDictBase | None,
        seeds: list[int | None],
        options: dict[str, Any] | None = None,
    ) -> TensorDictBase:
        mask = np.array([seed is not None for seed in seeds])
        if mask.any():
            options = {**(options or {}), "reset_mask": mask}
            self._seen, _ = self._call("reset", seed=seeds, options=options)
            self._ends[:, mask] = False
        return self._output()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        live: Any = ~self._ends.any(0)
        if (selected := tensordict.get("_step", None)) is not None:
            live &= selected.reshape(-1).numpy(force=True)
        entry, spec = tensordict, self.full_action_spec
        if not isinstance(self._actions, spaces.Dict):
            entry, spec = get_entry(tensordict, "action"), spec["action"]
        actions = _as_arrays("action", spec, self._actions, entry, live)
        if isinstance(self._vector, _SeededCartPole):
            self._vector.live = live
        else:
            each = zip(iterate(self._actions, actions), live.tolist(), strict=True)
            actions = [action if goes else None for action, goes in each]
        self._seen, reward, _, _, info = self._call("step", actions)
        if "terminated" in info:
            self._ends |= [info["terminated"], info["truncated"]]
        reward = torch.from_numpy(np.multiply(reward, live, dtype=np.float32))
        return self._output(reward=reward.view(*self.batch_size, 1))

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """What a step returns is complete, so that there is nothing to add."""
        return next_tensordict_out

    def _call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        """Call the vector environment, of which a process may have died."""
        try:
            return getattr(self._vector, method)(*args, **kwargs)
        except (EOFError, ConnectionError) as error:
            pipes = getattr(self._vector, "parent_pipes", [None])
            if None in pipes:  # a copy has raised it
                raise
            processes = self._vector.processes
            wait([process.sentinel for process in processes], timeout=1)
            ended = {
                i: code for i, one in enumerate(processes) if (code := one.exitcode) is not None
            }
            for pipe, process in zip(pipes, processes, strict=True):
                pipe.close()
                process.kill()
                process.join()
            self._vector.closed = True
            raise ChildProcessError(
                f"Processes of copies have died in a {method} (exit codes by copy: {ended}). The "
                "environment is closed: make it again, and see to it that no copy ends its process."
            ) from error

    def _output(self, **others: Any) -> TensorDictBase:
        """What a step or a reset returns; the arrays are not written to again."""
        entries: dict[Any, Any] = others
        ends = torch.from_numpy(self._ends.copy()).view(2, *self.batch_size, 1)
        entries |= {"terminated": ends[0], "truncated": ends[1], "done": ends[0] | ends[1]}
        entries[GROUP_KEY] = self._group.clone()
        space = self._vector.single_observation_space
        if isinstance(space, spaces.Dict):
            entries |= _as_tensors(self._shown, space, self._seen)
        else:
            for key, spec in self._shown.items():  # of which there is one
                entries[key] = _as_tensors(spec, space, self._seen)
        return TensorDict(entries, batch_size=self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the copies."""
        super().close(raise_if_closed=raise_if_closed)
        self._vector.close()


class _Copy(gym.Wrapper):
    """One copy: it waits where the action is None, and tells how it ended in its info alone.

    So gymnasium's vector environments, which step all copies and under ``AutoresetMode.DISABLED``
    none that is over, play those that go on and let the others wait.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.action_space = spaces.Discrete(1)  # of which a batch may be any list

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        options = kwargs.pop("options", None)
        if options:  # gymnasium's vector environment makes an empty mapping
            with suppress(TypeError):  # what cannot be copied is shared
                options = deepcopy(options)  # the others are given them too
            kwargs["options"] = options
        out: Any = self.env.reset(**kwargs)
        if not isinstance(out, tuple) or len(out) != 2:
            raise _broken(self, f"reset must return (observation, info), got {_told(out)}")
        self._seen = self._check_seen(out[0])
        return self._seen, {}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if action is None:
            return self._seen, 0.0, False, False, {}
        out: Any = self.env.step(action)
        if not isinstance(out, tuple) or len(out) != 5:
            wanted = "(observation, reward, terminated, truncated, info)"
            raise _broken(self, f"step must return {wanted}, got {_told(out)}")
        seen, reward, terminated, truncated, _ = out
        self._seen = self._check_seen(seen)
        number = np.asarray(reward)  # an array of one number, too
        if number.size != 1 or number.dtype.kind not in "biuf":
            raise _broken(self, f"the reward of a step must be one number, got {reward!r}")
        reward = number.item()
        is_over = terminated or truncated
        ends = {"terminated": bool(terminated), "truncated": bool(truncated)} if is_over else {}
        return self._seen, reward, False, False, ends

    def _check_seen(self, seen: Any) -> Any:
        if not _has_shape(self.observation_space, seen):
            raise _broken(
                self, f"an observation must be of {self.observation_space}, got {seen!r:.200}"
            )
        return seen


def _has_shape(space: Any, value: Any) -> bool:
    """Whether a value is laid out as a space says; its numbers are not looked at."""
    if parts := _parts(space):
        kind = Mapping if isinstance(space, spaces.Dict) else (tuple, list)
        if not isinstance(value, kind) or len(value) < len(parts):
            return False
        there = range(len(value)) if isinstance(value, (tuple, list)) else value
        return all(key in there and _has_shape(part, value[key]) for key, _, part in parts)
    return np.shape(value) == space.shape


def _told(out: Any) -> str:
    return f"a tuple of {len(out)}" if isinstance(out, tuple) else f"{out!r:.200}"


def _broken(env: gym.Env, what: str) -> ValueError:
    """A copy does not do what gymnasium asks of it."""
    try:
        name = type(env.unwrapped).__name__
    except AttributeError:
        name = type(env).__name__
    return ValueError(
        f"{name} breaks gymnasium's rules: {what}. gymnasium.utils.env_checker.check_env(env) "
        "finds out more."
    )


def _is_plain_cartpole(spec: Any) -> bool:
    """Whether gymnasium's vector entry point of CartPole is the whole task."""
    own = gym.spec("CartPole-v1").vector_entry_point
    has_limit = spec.max_episode_steps is not None  # or the entry point has one of its own
    return spec.vector_entry_point == own and has_limit and not spec.additional_wrappers


class _SeededCartPole(CartPoleVectorEnv):
    """CartPole's vector entry point: each copy has its own seed, and moves if it is `live`."""

    live: np.ndarray
    state: Any

    def reset(self, *, seed: Any, options: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        if not hasattr(self, "_single"):
            self._single = CartPoleEnv()
            super().reset()  # which makes the arrays
        starts = {}
        mask = options.pop("reset_mask")
        for copy in mask.nonzero()[0]:
            if seed[copy] not in starts:
                self._single.reset(seed=seed[copy], options=options)
                starts[seed[copy]] = self._single.state
            self.state[:, copy] = starts[seed[copy]]
        self.steps[mask] = 0
        return self._show(), {}

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        waits = ~self.live
        state, steps = self.state[:, waits], self.steps[waits]
        _, reward, terminated, truncated, _ = super().step(action)
        self.state[:, waits], self.steps[waits] = state, steps
        self.prev_done[:] = False  # or it would reset by itself
        ends = {"terminated": terminated & self.live, "truncated": truncated & self.live}
        return self._show(), reward, None, None, ends

    def _show(self) -> np.ndarray:
        return np.ascontiguousarray(self.state.T, dtype=np.float32)


class _Spaces(gym.Env):
    """What TorchRL's wrapper reads a space of."""

    def __init__(self, space: gym.Space) -> None:
        self.observation_space = self.action_space = space


_MENDS = {
    "observation": "gymnasium.wrappers.FilterObservation leaves out entries of a Dict, and "
    "TransformObservation translates others",
    "action": "gymnasium.wrappers.TransformAction translates it",
}


def _parts(space: Any) -> list[tuple[Any, str, gym.Space]]:
    """The parts of a Dict or a Tuple: their keys, what TorchRL calls them, and their spaces."""
    if isinstance(space, spaces.Tuple):
        return [(i, str(i), part) for i, part in enumerate(space.spaces)]
    if not isinstance(space, spaces.Dict):
        return []
    names = {key: key for key in space.spaces}
    if "state" in names and "observation" not in names:
        names["state"] = "observation"  # as by GymEnv
    return [(key, names[key], part) for key, part in space.items()]


def _read_root(root: str, space: gym.Space) -> Composite:
    """The TorchRL spec of a space, by its parts' own names if it is a Dict."""
    spec = _read_space(root, root, space)
    if not isinstance(space, spaces.Dict):
        is_box = isinstance(space, spaces.Box) and root == "observation"
        is_picture = is_box and GymWrapper(_Spaces(space)).from_pixels
        return Composite({"pixels" if is_picture else root: spec})
    own = {"reward", "done", "terminated", "truncated", GROUP_KEY}
    own |= {"next", "_step", "_reset", "is_init", "collector"}
    if taken := (own | ({"action"} - {root})).intersection(spec.keys()):
        raise ValueError(
            f"The {root} space has entries {sorted(taken)}, which an environment of TorchRL, or "
            f"what is around it, has itself. {_MENDS[root]}."
        )
    return spec


def _read_space(root: str, name: str, space: gym.Space) -> Any:
    if parts := _parts(space):
        if strange := [own for _, own, _ in parts if not isinstance(own, str)]:
            raise TypeError(
                f"The entries of the space of {name} must have strings as names, got {strange}. "
                f"{_MENDS[root]}."
            )
        return Composite(
            {own: _read_space(root, f"{name}[{key!r}]", part) for key, own, part in parts}
        )
    kinds = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    sizes = getattr(space, "nvec", np.zeros(1))
    is_ragged = sizes.ndim > 1 and bool((sizes != sizes[:1]).any())  # as no spec of TorchRL's is
    if isinstance(space, kinds) and not np.any(getattr(space, "start", 0)) and not is_ragged:
        try:
            return GymWrapper(_Spaces(space), categorical_action_encoding=True).action_spec
        except (KeyError, TypeError, RuntimeError):  # TorchRL has no spec of the dtype or the shape
            pass
    raise TypeError(
        f"The space of {name} must be Box, Discrete, MultiDiscrete or MultiBinary, counted from 0, "
        f"or Dict or Tuple of these, got {space}, which TorchRL does not read. {_MENDS[root]}."
    )


def _as_tensors(spec: Any, space: gym.Space, seen: Any) -> Any:
    """What a vector environment shows, as tensors ``[G, K, *]``."""
    parts = _parts(space)
    if not parts:
        return torch.from_numpy(seen).view(spec.shape)
    return {own: _as_tensors(spec[own], part, seen[key]) for key, own, part in parts}


def _as_arrays(name: str, spec: Any, space: Any, entry: Any, live: np.ndarray) -> Any:
    """Actions as arrays ``[G * K, *]`` of a batched space, with 0 for copies that are not live."""
    if parts := _parts(space):
        arrays = {
            key: _as_arrays(own, spec[own], part, get_entry(entry, own), live)
            for key, own, part in parts
        }
        return arrays if isinstance(space, spaces.Dict) else tuple(arrays.values())
    check_real(name, entry)
    if entry.shape != spec.shape:
        raise ValueError(f"{name!r} must have the shape {[*spec.shape]}, got {[*entry.shape]}.")
    array = entry.numpy(force=True).reshape(space.shape)
    if np.issubdtype(space.dtype, np.floating):
        return array.astype(space.dtype, copy=False)
    check_integers(name, entry)
    array = array.astype(space.dtype)
    array[~live] = 0
    if not space.contains(array):
        raise ValueError(f"{name!r} must be of {space}, got {array.tolist()}.")
    return array
