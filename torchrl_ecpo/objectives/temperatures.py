"""Temperatures that a loss learns, so that a constraint holds; the others are scheduled."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_ecpo.functional import temperature_dual
from torchrl_ecpo.objectives._base import PolicyLoss


class LearningTemperatures(PolicyLoss):
    """A :class:`PolicyLoss` some of whose temperatures are parameters, ``log_tau`` of ``tau``.

    What is learned has a floor, below which :meth:`temperature` never reads, and cannot be set.
    """

    _learned: Mapping[str, tuple[float, str]] = MappingProxyType({})
    """By name: the floor, and what to leave out to set it."""

    def learn(self, name: str, start: float, *, floor: float = 1e-6, instead: str = "") -> None:
        """Learn a temperature, or the multiplier of a constraint, in log-space.

        It is the parameter ``log_{name}``. Its loss is the caller's, such as :meth:`dual`.

        Args:
            name: of the temperature. What has been a scheduled one is no longer.
            start: first value.
            floor: least value, in the unit of the temperature.
            instead: what to leave out so that it is not learned, for the message of who sets it.

        Raises:
            ValueError: unless 0 < floor <= start.
        """
        if not 0 < floor <= start:
            raise ValueError(
                f"A learned {name} must start at min_{name} > 0 or above, got {name}={start} and "
                f"min_{name}={floor}."
            )
        if name in dict(self.named_buffers(recurse=False)):
            delattr(self, name)
        log_value = nn.Parameter(torch.tensor(math.log(start), device=self._device))
        self.register_parameter(f"log_{name}", log_value)
        self._learned = {**self._learned, name: (floor, instead)}

    @property
    def learned_names(self) -> tuple[str, ...]:
        """Temperatures and multipliers that are learned."""
        return tuple(self._learned)

    def temperature(self, name: str) -> Tensor:
        """A temperature as it stands, 0-d and detached, scheduled or learned."""
        if name not in self._learned:
            return getattr(self, name)
        log_temperature: Tensor = getattr(self, f"log_{name}")
        return log_temperature.detach().exp().clamp_min(self._learned[name][0])

    def temperatures(self) -> tuple[Tensor, ...]:
        """Those that :attr:`temperature_names` names, as they stand: tau and tau'."""
        return tuple(self.temperature(name) for name in self.temperature_names)

    def dual(self, name: str, excess: Tensor, mean_excess: Tensor | None = None) -> Tensor:
        """Loss of a learned temperature: up where a constraint is exceeded, else down.

        At its floor a temperature is not sent further down: it would take long to return. (To clamp
        the parameter itself would be a change in place, which a compiled graph forbids.)

        Args:
            name: of the temperature.
            excess: ``[*B]``, by how much the constraint is exceeded.
            mean_excess: 0-d, its mean over the real states, by default over all of them: it says
                where the temperature is sent.

        Returns:
            ``[*B]``, :func:`~torchrl_ecpo.functional.temperature_dual`.
        """
        log_temperature: Tensor = getattr(self, f"log_{name}")
        mean_excess = excess.mean() if mean_excess is None else mean_excess
        is_at_floor = log_temperature.detach() <= math.log(self._learned[name][0])
        excess = excess.masked_fill(is_at_floor & (mean_excess < 0), 0)
        return temperature_dual(log_temperature, excess)

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse to set what is learned."""
        if name in self._learned:
            instead = self._learned[name][1]
            mend = f" Build the loss without {instead} to set or schedule it." if instead else ""
            raise AttributeError(f"{name} is learned.{mend}")
        super().__setattr__(name, value)
