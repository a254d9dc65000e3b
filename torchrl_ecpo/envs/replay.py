"""The state of a simulator, as the episode that led to it."""

from __future__ import annotations

import json
from itertools import takewhile
from typing import Any

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import (
    BurnInTransform,
    DMControlWrapper,
    FrameSkipTransform,
    GymWrapper,
    NoopResetEnv,
    Transform,
)

from torchrl_ecpo.checks import check_flag, check_kind
from torchrl_ecpo.envs._groups import check_owner, describe

STEPPERS = (BurnInTransform, FrameSkipTransform, NoopResetEnv)
"""Transforms that step an environment by themselves."""


class EpisodeReplay(Transform):
    """Makes the state of a gymnasium or dm_control task part of the environment's state dict.

    A simulator's state is spread over arrays, counters of wrappers and attributes of a task, which
    differ from one to the next. Every task can play an episode again: the state dict holds the
    random generator's state before the last reset and the actions since; loading it resets and
    repeats them. That costs as much as the steps themselves. It is exact, because that generator is
    all that is random in these tasks. A seed given to ``reset`` counts, where the task draws from
    gymnasium's own generator; what else ``reset`` is given does not.

    Only the simulator is put where it was: what an episode has summed or counted so far travels in
    the tensordict that the caller holds.

    Raises:
        TypeError: if it is not on one task of gymnasium or dm_control (`num_envs` are several), or
            behind a transform that
            steps by itself.
        ValueError: for the state of another environment.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env, other = (TransformedEnv(GymEnv("Pendulum-v1"), EpisodeReplay()) for _ in range(2))
        >>> state = env.rollout(5)[-1]
        >>> other.load_state_dict(env.state_dict())
        >>> action = TensorDict({"action": torch.zeros(1)})
        >>> after, again = (each.step(action.clone())["next"] for each in (env, other))
        >>> bool((after["observation"] == again["observation"]).all())
        True
    """

    def __init__(self) -> None:
        super().__init__()
        self._start: str | None = None
        self._before: Any = None  # the generator, within a reset
        self._actions: list[Tensor | dict[str, Any]] = []

    def _reset_env_preprocess(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._start, self._actions = self._random_state(), []
        self._before = self._generator()
        return tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        generator, before, self._before = self._generator(), self._before, None
        if generator is not before and isinstance(generator, np.random.Generator):  # of a seed
            bits: Any = generator.bit_generator
            self._start = _as_text(type(bits)(bits.seed_seq).state)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        container: Any = self.container
        keys = container.base_env.action_keys
        if keys == ["action"]:  # quicker
            self._actions.append(tensordict["action"].clone())
        else:
            taken = tensordict.select(*keys).clone().to_dict()
            self._actions.append(taken["action"] if [*taken] == ["action"] else taken)
        return next_tensordict

    def get_extra_state(self) -> dict[str, Any]:
        """The random generator's state before the last reset, and the actions since."""
        is_begun = self._start is not None
        return {
            "env": describe(self._task()),
            "is_begun": is_begun,
            "start": self._start or self._random_state(),
            "actions": list(self._actions),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Play the episode again, up to where it was."""
        check_owner(state, describe(self._task()))
        is_begun = check_flag("is_begun", state["is_begun"])
        check_kind("actions", state["actions"], list)
        for action in state["actions"]:
            check_kind("Each of actions", action, Tensor, dict)
        try:
            self._set_random_state(state["start"])
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ValueError(f"start is no state of the task's generator: {error}.") from error
        if not is_begun:
            return
        env = self._task()
        has_one = {*env.full_action_spec.keys()} == {"action"}
        step = env.reset()
        for action in state["actions"]:
            taken = {"action": action} if has_one else action
            step = env.step(TensorDict({**step, **taken}))["next"]
            step = step.exclude("reward")
        self._start, self._actions = state["start"], list(state["actions"])

    def _random_state(self) -> str:
        generator = self._generator()
        is_legacy = isinstance(generator, np.random.RandomState)
        state = generator.get_state(legacy=False) if is_legacy else generator.bit_generator.state
        return _as_text(state)

    def _set_random_state(self, state: str) -> None:
        generator = self._generator()
        if isinstance(generator, np.random.RandomState):
            generator.set_state(json.loads(state))
        else:
            generator.bit_generator.state = json.loads(state)

    def _task(self) -> Any:
        env = getattr(self.container, "base_env", None)
        is_one = isinstance(env, (GymWrapper, DMControlWrapper))
        if not is_one or env.batch_size:
            batch = f" of batch size {tuple(env.batch_size)}" if is_one else ""
            raise TypeError(
                "EpisodeReplay is a transform of one task of gymnasium or dm_control, got "
                f"{type(env).__name__}{batch}. Put it on each copy: TransformedEnv(GymEnv(...), "
                "EpisodeReplay())."
            )
        container: Any = self.container
        before = takewhile(lambda each: each is not self, container.transform.modules())
        if steppers := [type(each).__name__ for each in before if isinstance(each, STEPPERS)]:
            raise TypeError(
                f"EpisodeReplay stands behind {steppers[0]}, whose own steps it does not see: put "
                "it in front."
            )
        return env

    def _generator(self) -> Any:
        # TorchRL hands on what it does not know to gymnasium's or dm_control's environment.
        env = self._task()
        return env.np_random if isinstance(env, GymWrapper) else env.task.random


def _as_text(state: Any) -> str:
    return json.dumps(state, default=np.ndarray.tolist)
