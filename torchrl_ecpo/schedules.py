"""Temperatures over time, numbers of at least 0.

A schedule is a function from a count to a temperature. What is counted is the caller's choice:
project steps, lifts or trajectories; :class:`TemperatureScheduler` counts what ``step`` is told.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torchrl.objectives import LossModule

from torchrl_ecpo._torchrl import schedulable_buffers
from torchrl_ecpo.checks import as_float, check_kind
from torchrl_ecpo.functional import theorem1_temperatures
from torchrl_ecpo.objectives._base import PolicyLoss

__all__ = [
    "Schedule",
    "TemperatureScheduler",
    "constant",
    "exponential",
    "linear",
    "make_schedule",
    "theorem1_schedules",
]

Schedule = Callable[[float], float]
"""A temperature by the count."""


def constant(value: float) -> Schedule:
    """Always ``value``.

    Examples:
        >>> constant(0.5)(1_000)
        0.5
    """
    value = _number("value", value)
    return partial(_linear, start=value, end=value, duration=1.0)


def linear(start: float, end: float, duration: float) -> Schedule:
    """From ``start`` to ``end`` in a straight line over ``duration`` counts, then ``end``.

    Examples:
        >>> tau_prime = linear(0.02, 0.0, 100)
        >>> [tau_prime(count) for count in (0, 50, 100, 200)]
        [0.02, 0.01, 0.0, 0.0]
    """
    return _schedule(_linear, start=start, end=end, duration=duration)


def exponential(start: float, end: float, duration: float) -> Schedule:
    """From ``start`` to ``end``, both above 0, by a constant factor over ``duration`` counts.

    Examples:
        >>> tau_prime = exponential(0.02, 0.0002, 100)
        >>> [round(tau_prime(count), 6) for count in (0, 50, 100, 200)]
        [0.02, 0.002, 0.0002, 0.0002]
    """
    schedule = _schedule(_exponential, start=start, end=end, duration=duration)
    if not (start > 0 and end > 0):
        raise ValueError(
            f"An exponential schedule needs start > 0 and end > 0, got {start} and {end}. "
            "Use a linear one to reach 0."
        )
    return schedule


def theorem1_schedules(num_trajectories: int, *, horizon: int | None = None) -> dict[str, Schedule]:
    """Theorem 1's temperatures for ``tau`` and ``tau_prime``; counts are lifts.

    Args:
        num_trajectories: how many trajectories (actions of a bandit) there are.
        horizon: number of lifts, for the constant choice; None: a choice for each lift.

    Examples:
        >>> schedules = theorem1_schedules(10)
        >>> [round(schedules["tau_prime"](count), 3) for count in (0, 99)]
        [0.466, 0.066]
    """
    theorem1_temperatures(1 if horizon is None else horizon, num_trajectories)  # or is refused
    return {
        name: partial(_theorem1, index=index, num_trajectories=num_trajectories, horizon=horizon)
        for index, name in enumerate(("tau", "tau_prime"))
    }


def make_schedule(setting: float | Mapping[str, Any]) -> Schedule:
    """The schedule that a configuration describes.

    Args:
        setting: a number, which is held, or a mapping with ``schedule`` (``"constant"``,
            ``"linear"`` or ``"exponential"``) and that function's arguments.

    Examples:
        >>> make_schedule({"schedule": "linear", "start": 1.0, "end": 0.0, "duration": 20})(10)
        0.5
    """
    if not isinstance(setting, Mapping):
        return constant(_number("A setting that is no mapping", setting))
    arguments = dict(setting)
    kind = arguments.pop("schedule", None)
    if kind not in [*_SCHEDULES]:
        raise ValueError(f"A setting's schedule must be one of {sorted(_SCHEDULES)}, got {kind!r}.")
    try:
        return _SCHEDULES[kind](**arguments)
    except TypeError as error:
        raise ValueError(f"Wrong arguments for the schedule {kind!r}: {error}.") from error


_SCHEDULES: dict[str, Callable[..., Schedule]] = {
    "constant": constant,
    "exponential": exponential,
    "linear": linear,
}


class TemperatureScheduler:
    """Writes scheduled temperatures into a loss.

    Args:
        loss_module: a loss of this package, or one of TorchRL's with schedulable buffers.
        schedules: by temperature, for example ``tau_prime=linear(0.02, 0.0, 800)``. Their values
            at 0 are written at once.

    Raises:
        ValueError: if the loss has no schedulable temperature of that name, or if the temperatures
            at 0, or those with which the schedules of this module end, are not allowed together.
        TypeError: for a schedule that is no function, such as a number.
        AttributeError: if the loss learns it.

    Examples:
        >>> import torch
        >>> from torchrl_ecpo import ECPOLoss
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> loss_module = ECPOLoss(make_softmax_policy(torch.eye(4)))
        >>> temperatures = TemperatureScheduler(loss_module, tau_prime=linear(0.02, 0.0, 100))
        >>> temperatures.step(50)
        >>> loss_module.tau_prime
        tensor(0.0100)
    """

    def __init__(self, loss_module: LossModule, **schedules: Schedule) -> None:
        check_kind("loss_module", loss_module, LossModule)
        known = getattr(loss_module, "temperature_names", None) or schedulable_buffers(loss_module)
        for name, schedule in schedules.items():
            if name not in known:
                raise ValueError(
                    f"{type(loss_module).__name__} has no temperature {name!r} to schedule; "
                    f"it has {list(known)}."
                )
            try:
                float(schedule(0.0))
            except TypeError as error:
                raise TypeError(
                    f"The schedule of {name} must be a function from a count to a number, such as "
                    f"constant(0.5), got {schedule!r}: {error}."
                ) from error
        self.loss_module = loss_module
        self.schedules = schedules
        if isinstance(loss_module, PolicyLoss):
            ends = {name: _end_of(schedule) for name, schedule in schedules.items()}
            try:
                loss_module.allowed_temperatures(**ends)
            except ValueError as error:
                raise ValueError(f"Where the schedules end: {error}") from None
        self._move_to(0.0)

    def step(self, count: float = 1) -> None:
        """Advance by ``count``, at least 0, and write the temperatures."""
        self._move_to(self.count + _number("count", count))

    def values(self) -> dict[str, float]:
        """The temperatures as they stand, by name."""
        return self._at(self.count)

    def _at(self, count: float) -> dict[str, float]:
        return {name: float(schedule(count)) for name, schedule in self.schedules.items()}

    def _move_to(self, count: float) -> None:
        """Write the temperatures at a count, or none of them."""
        values = self._at(count)
        if isinstance(self.loss_module, PolicyLoss):
            self.loss_module.allowed_temperatures(**values)
        # The largest first: the loss refuses a moment in which all temperatures are 0.
        for name, value in sorted(values.items(), key=lambda item: -item[1]):
            setattr(self.loss_module, name, value)
        self.count = count

    def state_dict(self) -> dict[str, float]:
        """The count; the schedules are configuration."""
        return {"count": self.count}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Continue at a saved count, and write its temperatures."""
        self._move_to(_number("count", state_dict["count"]))


# Functions of the module, so that schedules can be pickled.


def _linear(count: float, start: float, end: float, duration: float) -> float:
    progress = min(count / duration, 1.0)
    return (1 - progress) * start + progress * end


def _exponential(count: float, start: float, end: float, duration: float) -> float:
    return start * (end / start) ** min(count / duration, 1.0)


def _theorem1(count: float, index: int, num_trajectories: int, horizon: int | None) -> float:
    lift = count + 1 if horizon is None else horizon
    return theorem1_temperatures(lift, num_trajectories)[index]


def _schedule(function: Callable[..., float], **numbers: Any) -> Schedule:
    """From a start to an end; refuse what are no temperatures."""
    numbers = {name: _number(name, value) for name, value in numbers.items()}
    if not numbers["duration"] > 0:
        raise ValueError(f"duration must be positive, got {numbers['duration']}.")
    return partial(function, **numbers)


def _end_of(schedule: Schedule) -> float | None:
    is_known = isinstance(schedule, partial) and schedule.func in (_linear, _exponential)
    return schedule.keywords["end"] if is_known else None


def _number(name: str, value: Any) -> float:
    number = as_float(name, value)
    if not 0 <= number < math.inf:
        raise ValueError(f"{name} must be at least 0 and finite, got {value}.")
    return number
