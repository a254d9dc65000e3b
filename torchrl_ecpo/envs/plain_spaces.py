"""Any task of gymnasium as one that a network can read and play: plain spaces, at the door."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces, wrappers

from torchrl_ecpo.checks import check_kind

SINGLE_SPACES = (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Box)


def readable(env: gym.Env) -> gym.Env:
    """Wrap a task of gymnasium, where it must be, so that its spaces are plain.

    An observation becomes a vector of numbers or an image, by gymnasium's own wrappers:

    - ``Discrete``, ``MultiDiscrete`` (one-hot), ``MultiBinary``, ``Text``, and ``Dict`` and
      ``Tuple`` of all these and of boxes, are flattened; so is a box of another shape. If all are
      integers within bounds below 256, they are scaled to [0, 1]. A vector of doubles stays one.
    - Bytes from 0 to 255 in two or three dimensions are pixels, ``[C, H, W]``.
    - What a MiniGrid task shows is flattened, and its mission too, by MiniGrid's
      ``FlatObsWrapper``, unless it is always the same.

    An action becomes one choice (``Discrete``), several (``MultiDiscrete``), or a vector of bounded
    numbers (``Box``), whichever way ``Dict`` and ``Tuple`` arrange them. One of both choices and
    numbers is ``Dict(action=Dict(choices=..., numbers=...))``, which TorchRL reads as the entries
    ``("action", "choices")`` and ``("action", "numbers")``.

    Args:
        env: of gymnasium. One whose spaces are plain is returned as it is.

    Raises:
        TypeError: if it is no environment of gymnasium.
        ValueError: for a space that cannot be read, with what would help.

    Examples:
        >>> import gymnasium as gym
        >>> env = readable(gym.make("Blackjack-v1"))
        >>> env.observation_space.shape, env.action_space
        ((45,), Discrete(2))
        >>> cartpole = gym.make("CartPole-v1")
        >>> readable(cartpole) is cartpole
        True
    """
    check_kind("env", env, gym.Env)
    return _with_plain_actions(_with_plain_observations(env))


# ------------------------------------------------------------------------------------ observations


def _with_plain_observations(env: gym.Env) -> gym.Env:
    space = env.observation_space
    if _has_mission(space):
        from minigrid.wrappers import FlatObsWrapper, ImgObsWrapper

        mission: Any = space["mission"]  # pyright: ignore[reportIndexIssue] - it is a Dict
        if mission.ordered_placeholders is None:  # it is always the same
            flat = wrappers.FlattenObservation(ImgObsWrapper(env))
        else:
            flat = FlatObsWrapper(env)
        # Not scaled: what it shows has numbers up to 10, and its letters are one-hot.
        return wrappers.DtypeObservation(flat, np.float32)
    if _is_image(space):
        return _with_channels_first(env)
    images = [part for part in _parts(space) if _is_image(part)]
    if images:
        raise _refused(
            env,
            f"observes an image among other things, {images[0]}, which would lose its shape. Keep "
            "the image alone, or leave it out, with gymnasium.wrappers.FilterObservation.",
        )
    is_flat = not isinstance(space, spaces.Box) or len(space.shape) != 1
    if is_flat:
        with suppress(NotImplementedError):  # a space that gymnasium does not know
            env = wrappers.FlattenObservation(env)
    space = env.observation_space
    if not isinstance(space, spaces.Box):
        raise _refused(
            env,
            f"observes {space}, which has no fixed number of numbers. Make it a Box with "
            "gymnasium.wrappers.TransformObservation.",
        )
    is_integer = not np.issubdtype(space.dtype, np.floating)
    is_mixed = is_flat and space.dtype == np.float64  # what gymnasium makes of choices and numbers
    if is_integer or is_mixed or space.dtype == np.float16:
        # DtypeObservation warns of the precision of bounds.
        low, high = (end.astype(np.float32) for end in (space.low, space.high))
        single: Any = np.float32
        env = wrappers.TransformObservation(env, single, spaces.Box(low, high))
    is_small = space.high.max() < 256 and space.low.min() >= -256
    if is_integer and is_small and (space.high > space.low).all():  # it is divided by the range
        env = wrappers.RescaleObservation(env, np.float32(0), np.float32(1))
    return env


def _has_mission(space: gym.Space) -> bool:
    """Whether it is that of a MiniGrid task; the package need not be there."""
    mission = space.spaces.get("mission") if isinstance(space, spaces.Dict) else None
    return type(mission).__name__ == "MissionSpace"


def _is_image(space: Any) -> bool:
    is_box = isinstance(space, spaces.Box) and len(space.shape) in (2, 3)
    return is_box and space.dtype == np.uint8 and bool((space.high == 255).all())


def _with_channels_first(env: gym.Env) -> gym.Env:
    """The smallest of three dimensions is that of the channels, unless it comes first anyway."""
    shape: Any = env.observation_space.shape
    if len(shape) == 2:
        return wrappers.ReshapeObservation(env, (1, *shape))
    if shape[0] == min(shape):
        return env
    images = spaces.Box(0, 255, (shape[2], *shape[:2]), np.uint8)
    return wrappers.TransformObservation(
        env, partial(np.moveaxis, source=-1, destination=0), images
    )


# ----------------------------------------------------------------------------------------- actions


def _with_plain_actions(env: gym.Env) -> gym.Env:
    """One choice, several, bounded numbers, or choices and numbers."""
    space, parts = env.action_space, list(_parts(env.action_space))
    for part in parts:
        if not isinstance(part, SINGLE_SPACES):
            raise _refused(
                env,
                f"takes actions of {part}. Choices (Discrete, MultiDiscrete, MultiBinary) and "
                "bounded numbers (Box) can be played: offer these with "
                "gymnasium.wrappers.TransformAction.",
            )
        if isinstance(part, spaces.Box):
            _check_box(env, part)
    nvec = [int(n) for part in parts for n in _sizes(part)]
    boxes = [spaces.flatten_space(part) for part in parts if isinstance(part, spaces.Box)]
    choices: Any = spaces.Discrete(nvec[0]) if len(nvec) == 1 else spaces.MultiDiscrete(nvec or [1])
    if not boxes:
        plain = choices
    else:
        low, high = (np.concatenate([getattr(b, end) for b in boxes]) for end in ("low", "high"))
        plain = numbers = spaces.Box(low.astype(np.float32), high.astype(np.float32))
        if nvec:
            plain = spaces.Dict(action=spaces.Dict(choices=choices, numbers=numbers))
    if space == plain or (isinstance(space, spaces.Box) and len(space.shape) == 1):
        return env
    return wrappers.TransformAction(env, partial(_arrange, space), plain)


def _check_box(env: gym.Env, box: spaces.Box) -> None:
    if not np.issubdtype(box.dtype, np.floating):
        raise _refused(
            env,
            f"takes actions of integers in a box, {box}: make each a choice (MultiDiscrete) with "
            "gymnasium.wrappers.TransformAction.",
        )
    if not box.is_bounded():
        raise _refused(
            env,
            f"takes actions without bounds, {box}: give them bounds with "
            "gymnasium.wrappers.TransformAction(env, lambda action: action, Box(-1, 1, ...)).",
        )


def _parts(space: gym.Space) -> Iterator[gym.Space]:
    """The single spaces that it is made of, in the order in which gymnasium flattens them."""
    if isinstance(space, spaces.Dict):
        space = spaces.Tuple(space.spaces.values())
    if isinstance(space, spaces.Tuple):
        for part in space.spaces:
            yield from _parts(part)
    else:
        yield space


def _sizes(part: Any) -> list[int]:
    """Of each choice."""
    if isinstance(part, spaces.Discrete):
        return [part.n]
    if isinstance(part, spaces.MultiDiscrete):
        return part.nvec.flatten().tolist()
    return [2] * math.prod(part.shape) if isinstance(part, spaces.MultiBinary) else []


def _arrange(space: gym.Space, action: Any) -> Any:
    """An action of the task's own space, through gymnasium's flat form of it."""
    both = action["action"] if isinstance(action, dict) else {"choices": action, "numbers": action}
    choices, numbers = (iter(np.atleast_1d(both[name])) for name in ("choices", "numbers"))
    flat: list[Any] = []
    for part in _parts(space):
        if isinstance(part, spaces.Box):
            flat += [next(numbers) for _ in range(math.prod(part.shape))]
            continue
        for size in _sizes(part):
            choice = int(next(choices))
            flat += (
                [choice] if isinstance(part, spaces.MultiBinary) else np.eye(size)[choice].tolist()
            )
    return spaces.unflatten(space, np.array(flat))


def _refused(env: gym.Env, reason: str) -> ValueError:
    name = type(env.unwrapped).__name__ if env.spec is None else env.spec.id
    return ValueError(f"{name} {reason}")
