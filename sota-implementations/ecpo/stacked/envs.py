"""The environments of all runs as one, ``[R * num_groups, group_size]``.

An entry ``run`` (int64, of that shape) says whose each row is. What is drawn and counted, a run's
own environment draws and counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical
from torchrl.envs import EnvBase

from torchrl_ecpo.envs import AlgorithmicEnv, BanditEnv


def stack_envs(envs: Sequence[Any]) -> EnvBase:
    """Put environments of one type, task and batch size behind one; step them through it alone."""
    kinds = {AlgorithmicEnv: _StackedAlgorithmicEnv, BanditEnv: _StackedBanditEnv}
    types = {type(env) for env in envs}
    if not types <= kinds.keys():
        raise TypeError(f"AlgorithmicEnv and BanditEnv can be stacked, got {types}.")
    described = dict.fromkeys(map(_describe, envs))
    if len(described) != 1:
        raise ValueError(
            f"Stacked environments must be of one task and size, got {' and '.join(described)}."
        )
    return kinds[type(envs[0])](envs)


def _describe(env: Any) -> str:
    is_bandit = isinstance(env, BanditEnv)
    task = f"a bandit of {env.rewards.shape[-1]} actions" if is_bandit else env.task_name
    return f"{task} in a batch {tuple(env.batch_size)}"


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
        )
        for name in [key for key in first.state_dict() if "." not in key and "extra" not in key]:
            whole = getattr(self, name)
            for env, part in zip(envs, whole.chunk(len(envs)), strict=True):
                setattr(env, name, part.copy_(getattr(env, name)))
        self.runs = nn.ModuleList(envs)
        _add_run(self, len(envs))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        selected = None if tensordict is None else tensordict.get("_reset", None)
        parts = [None] * len(self.runs) if selected is None else selected.chunk(len(self.runs))
        for env, part in zip(self.runs, parts, strict=True):
            assert isinstance(env, AlgorithmicEnv)
            given = None if part is None else TensorDict({"_reset": part}, env.batch_size)
            env._reset(given)
        return self._output()

    def _output(self) -> TensorDictBase:
        return super()._output().set("run", self._run.clone())


class _StackedBanditEnv(BanditEnv):
    """Bandits with as many actions and other rewards."""

    _run: Tensor

    def __init__(self, envs: Sequence[BanditEnv]) -> None:
        first = envs[0]
        num_groups, group_size = first.batch_size
        super().__init__(
            num_actions=first.rewards.shape[-1],
            num_groups=len(envs) * num_groups,
            group_size=group_size,
        )
        self.register_buffer("rewards", torch.stack([env.rewards for env in envs]))
        _add_run(self, len(envs))

    def _reward(self, action: Tensor) -> Tensor:
        return self.rewards[self._run, action]

    def _output(self, *, done: bool) -> TensorDict:
        return super()._output(done=done).set("run", self._run.clone())


def _add_run(env: EnvBase, num_runs: int) -> None:
    """Say of each row whose it is."""
    batch = env.batch_size
    run = torch.arange(num_runs).repeat_interleave(batch[0] // num_runs)
    env.register_buffer("_run", run.unsqueeze(-1).expand(batch).clone(), persistent=False)
    spec = env.observation_spec.clone()
    spec["run"] = Categorical(num_runs, shape=batch)
    env.observation_spec = spec
