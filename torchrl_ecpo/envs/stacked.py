"""Environments of several independent runs that step as one.

Their batch is `[R * num_groups, group_size]` for R runs, run after run; an entry ``run`` says whose
each row is.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase

from torchrl_ecpo.envs.algorithmic import AlgorithmicEnv
from torchrl_ecpo.envs.bandit import BanditEnv
from torchrl_ecpo.groups import RUN_KEY

__all__ = ["stack_envs"]


def stack_envs(envs: Sequence[EnvBase]) -> EnvBase:
    """Put the environments of independent runs behind one.

    Args:
        envs: one for each run, of one type, task and batch size `[num_groups, group_size]`, each
            seeded by itself: :class:`AlgorithmicEnv` or :class:`BanditEnv`.

    Returns:
        An environment of batch size `[R * num_groups, group_size]`, the runs one after another,
        with an entry ``run`` (int64, of the batch size). What it draws and counts, it draws and
        counts in `envs`, which must not be stepped any more; to seed it has no effect.

    Raises:
        TypeError: for an environment of another type.

    Examples:
        >>> from torchrl_ecpo.envs import AlgorithmicEnv
        >>> runs = [AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=s) for s in (0, 1)]
        >>> env = stack_envs(runs)
        >>> env.batch_size, env.reset()["run"][:, 0].tolist()
        (torch.Size([4, 3]), [0, 0, 1, 1])
    """
    return _stack(envs[0], envs)


@singledispatch
def _stack(first: EnvBase, envs: Sequence[Any]) -> EnvBase:
    raise TypeError(
        "Environments of the types AlgorithmicEnv and BanditEnv can be stacked, got "
        f"{type(first).__name__}: start these runs as processes of their own."
    )


class _StackedAlgorithmicEnv(AlgorithmicEnv):
    """Steps the episodes of all runs; each run's environment starts its own.

    The state of a run's environment is a view of the rows of this one. Its curriculum, its pending
    instances and their random stream stay its own.
    """

    _run: Tensor

    def __init__(self, envs: Sequence[AlgorithmicEnv]) -> None:
        first = envs[0]
        num_groups, group_size = first.batch_size
        super().__init__(
            first.task_name,
            num_groups=len(envs) * num_groups,
            group_size=group_size,
            curriculum=None,
            seed=0,
            device=first.device,
        )
        for name in [key for key in first.state_dict() if "." not in key]:
            whole = getattr(self, name)
            for env, part in zip(envs, whole.chunk(len(envs)), strict=True):
                setattr(env, name, part.copy_(getattr(env, name)))
        self.runs = nn.ModuleList(envs)
        _add_run(self, len(envs))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        selected = None if tensordict is None else tensordict.get("_reset", None)
        for index, env in enumerate(self.runs):
            assert isinstance(env, AlgorithmicEnv)
            if selected is None:
                env._reset()
            else:
                part = selected.chunk(len(self.runs))[index]
                env._reset(TensorDict({"_reset": part}, batch_size=env.batch_size))
        return self._output()

    def _output(self) -> TensorDictBase:
        return super()._output().set(RUN_KEY, self._run.clone())


class _StackedBanditEnv(BanditEnv):
    """Bandits with as many actions and other rewards."""

    _run: Tensor

    def __init__(self, envs: Sequence[BanditEnv]) -> None:
        first = envs[0]
        num_groups, group_size = first.batch_size
        super().__init__(
            num_actions=first.rewards.shape[-1],
            num_features=first.features.shape[-1],
            num_groups=len(envs) * num_groups,
            group_size=group_size,
            device=first.device,
        )
        self.register_buffer("rewards", torch.stack([env.rewards for env in envs]))
        self.register_buffer("features", torch.stack([env.features for env in envs]))
        _add_run(self, len(envs))

    def _reward(self, action: Tensor) -> Tensor:
        return self.rewards[self._run, action]

    def _output(self, *, done: bool) -> TensorDict:
        return super()._output(done=done).set(RUN_KEY, self._run.clone())


_stack.register(AlgorithmicEnv, lambda first, envs: _StackedAlgorithmicEnv(envs))
_stack.register(BanditEnv, lambda first, envs: _StackedBanditEnv(envs))


def _add_run(env: EnvBase, num_runs: int) -> None:
    """Say of each row whose it is."""
    batch = env.batch_size
    run = torch.arange(num_runs, device=env.device).repeat_interleave(batch[0] // num_runs)
    env.register_buffer("_run", run.unsqueeze(-1).expand(batch).clone(), persistent=False)
    spec = env.observation_spec.clone()
    spec[RUN_KEY] = Categorical(num_runs, shape=batch, device=env.device)
    env.observation_spec = spec
