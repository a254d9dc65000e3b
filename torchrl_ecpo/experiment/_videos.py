"""Greedy episodes as a person sees them: their returns, and the first one as a gif."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

LONGEST_EPISODE = 100_000


def with_pixels(name: str, make: Callable[..., EnvBase]) -> EnvBase:
    """An environment that shows what it draws too, as ``"pixels"``; or a ValueError, with the mend.

    `make` makes it, given TorchRL's ``from_pixels``.
    """
    os.environ.setdefault("MUJOCO_GL", "egl")
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # gymnasium draws into memory
    try:
        return make(from_pixels=True, pixels_only=False)
    except Exception as error:  # of each renderer another
        make(from_pixels=False).close()  # if it is not the renderer, this says what it is
        hint = (
            f"MuJoCo draws with OpenGL: MUJOCO_GL (now {os.environ['MUJOCO_GL']}) must be egl, "
            "with libegl1 installed, osmesa, with libosmesa6, or on a desktop glfw."
        )
        if isinstance(error, ImportError):
            hint = "pip install '.[video]' in the repository has what gymnasium draws with."
        reason = str(error.__cause__ or error).rstrip(".")
        raise ValueError(f"There is no video of {name}: {reason}. {hint}") from error


@torch.no_grad()
def greedy_episodes(env: EnvBase, policy: Any, count: int) -> list[TensorDictBase]:
    """Whole episodes ``[T]`` with the most probable actions, the first one with its pictures."""
    twice: Any = ("next", "pixels")
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        return [
            env.rollout(LONGEST_EPISODE, policy).exclude(twice, *(["pixels"] if index else []))
            for index in range(count)  # pictures are most of the memory
        ]


def save_gif(file: Path, episode: TensorDictBase) -> None:
    """What an episode shows, step by step."""
    from PIL import Image

    first, *others = (Image.fromarray(pixels.numpy()) for pixels in episode["pixels"])
    first.save(file, save_all=True, append_images=others)


def show(make: Callable[..., EnvBase], policy: Any, count: int, directory: Path, name: str) -> None:
    """Play a task greedily, print the returns, and leave a gif of the first episode."""
    try:
        env = with_pixels(name, make)
    except ValueError as error:
        print(error)
        env = make(from_pixels=False)
    episodes = greedy_episodes(env, policy, count)
    returns = [episode["next", "reward"].sum().item() for episode in episodes]
    for episode, value in zip(episodes, returns, strict=True):
        print(f"return {value:g}, {len(episode)} steps")
    print(f"mean return {sum(returns) / count:g}")
    if "pixels" in episodes[0]:
        save_gif(directory / "episode.gif", episodes[0])
        print(f"the first one is drawn in {directory / 'episode.gif'}")
