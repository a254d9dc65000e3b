"""What is chosen before the options are read: a loss for the actions of a task."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, suppress

import gymnasium as gym

OF_ONE_CHOICE = ("acrobot", "cartpole", "minatar")


def chosen_loss(options: Sequence[str]) -> list[str]:
    """The option ``loss=``, if none is given and a task of gymnasium takes one discrete action."""
    given = {name: value for name, _, value in (option.partition("=") for option in options)}
    if "loss" in given:
        return []
    if {*given.get("env", "").split(",")} <= {*OF_ONE_CHOICE}:
        return ["loss=discrete_ecac"]
    if given.get("env") != "gym":
        return []
    with (
        suppress(gym.error.Error, ModuleNotFoundError, ValueError),  # which is said later
        closing(gym.make(given.get("env.name", ""), disable_env_checker=True)) as env,
    ):
        if isinstance(env.action_space, gym.spaces.Discrete):
            return ["loss=discrete_ecac"]
    return []
