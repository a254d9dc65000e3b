"""Tasks of gymnasium for the scripts, by the id that ``env.name`` is."""

from __future__ import annotations

from contextlib import closing
from functools import cache
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.wrappers import FrameStackObservation
from torchrl.envs import GymWrapper

from torchrl_ecpo.envs import readable


def open_raw_task(name: str, **options: Any) -> gym.Env:
    """A task of gymnasium by its id, as it is, or an error that names ``env.name``."""
    make = _make_game if name.startswith("MinAtar/") else gym.make
    try:
        return make(name, disable_env_checker=True, **options)
    except (gym.error.DependencyNotInstalled, ModuleNotFoundError) as error:
        raise missing(f"env.name={name}", error) from error
    except gym.error.Error as error:
        raise ValueError(
            f"env.name={name} is no task of gymnasium: {' '.join(str(error).split())} If another "
            "module registers it, name that too: env.name=module:Task-v0."
        ) from error


def _make_game(name: str, **options: Any) -> gym.Env:
    """A game of MinAtar, whose package lets gymnasium know of it when it is asked only."""
    import minatar.gym

    if "MinAtar/Breakout-v1" not in gym.registry:
        minatar.gym.register_envs()
    return _Game(gym.make(name, **options))


class _Game(gym.Wrapper):
    """A game of MinAtar that is random by gymnasium's name for it, and begins without a past.

    It draws from a generator of its own, and repeats actions, also the last one before a reset.
    """

    @property
    def np_random(self) -> Any:
        """What the game draws from."""
        game: Any = self.unwrapped
        return game.game.random

    def reset(self, **options: Any) -> Any:
        """Begin an episode."""
        game: Any = self.unwrapped
        game.game.last_action = 0
        return super().reset(**options)


def open_task(name: str, window: int = 1, **options: Any) -> gym.Env:
    """A task of gymnasium, with spaces that a network can read and play; likewise.

    With a `window` it shows the last observations; those before the first are 0.
    """
    env = open_raw_task(name, **options)
    try:
        env = readable(env)
        if window == 1:
            return env
        return readable(FrameStackObservation(env, window, padding_type="zero"))
    except ValueError as error:
        raise ValueError(f"env.name: {error}") from error


def wrap_task(
    name: str, window: int = 1, *, from_pixels: bool = False, **options: Any
) -> GymWrapper:
    """The same as an environment of TorchRL; `options` are its wrapper's."""
    drawn: dict[str, Any] = {"render_mode": "rgb_array"} if from_pixels else {}
    options |= {"from_pixels": from_pixels, "categorical_action_encoding": True}
    return GymWrapper(open_task(name, window, **drawn), **options)


@cache
def is_plain(name: str) -> bool:
    """Whether the spaces of a task are plain as it is.

    Raises:
        ModuleNotFoundError: if a package is missing.
        ValueError: if it cannot be played, or no two copies of it start alike.
    """
    with closing(open_raw_task(name)) as raw, closing(open_task(name)) as copy:
        first, second = readable(raw).reset(seed=0)[0], copy.reset(seed=0)[0]
        if not np.array_equal(first, second, equal_nan=True):
            raise ValueError(
                f"env.name={name}: two copies of a problem instance differ at their start, though "
                "they are reset with one seed. It has to draw its start from self.np_random, which "
                "super().reset(seed=seed) seeds."
            )
        return readable(raw) is raw


def missing(task: str, error: Exception) -> ModuleNotFoundError:
    """What to say where a task needs a package."""
    return ModuleNotFoundError(
        f"{task} needs what is not installed: {error} For MuJoCo and dm_control: "
        "pip install '.[mujoco]' in the repository, likewise box2d and minigrid."
    )
