"""What both families of losses share: the actor, temperatures, entries of a batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS

from torchrl_ecpo.checks import as_float, check_choice, check_mask, present
from torchrl_ecpo.functional import check_temperatures

REDUCTIONS = ("none", "mean", "sum")


class PolicyLoss(LossModule):
    """A loss of a policy, with temperatures that are scheduled by assignment.

    A temperature is a 0-d buffer, so that ``state_dict`` carries it and ``to`` moves it.
    ``loss.tau = 0.1`` writes it in place; a value that is not allowed is refused, and the old one
    stays.

    Args:
        actor_network: a policy with ``get_dist``.
        delay_actor: whether the loss keeps a delayed copy of the actor.
        reduction: ``"mean"`` (None: the same), ``"sum"`` or ``"none"``.
        temperatures: initial values by name; their names are :attr:`temperature_names`.
        allow_zero: whether all temperatures may be 0 together.
    """

    tensor_keys: Any
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    temperature_names: tuple[str, ...]
    """What :class:`~torchrl_ecpo.TemperatureScheduler` may write."""

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        delay_actor: bool,
        reduction: Literal["none", "mean", "sum"] | None,
        temperatures: Mapping[str, Any] | None = None,
        allow_zero: bool = False,
    ) -> None:
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        if not hasattr(actor_network, "get_dist"):
            raise TypeError(
                "actor_network must have a get_dist method, as ProbabilisticActor and "
                f"ProbabilisticTensorDictSequential have; got {type(actor_network).__name__}."
            )
        self.reduction = "mean" if reduction is None else reduction
        check_choice("reduction", self.reduction, REDUCTIONS)
        self.delay_actor = delay_actor
        self.convert_to_functional(actor_network, "actor_network", create_target_params=delay_actor)
        self._allow_zero = allow_zero
        device = next((parameter.device for parameter in self.parameters()), None)
        for name, value in self._as_temperatures(temperatures or {}).items():
            self.register_coeff_buffer(name, value, device=device)
        self.temperature_names = tuple(temperatures or ())

    def _as_temperatures(
        self, values: Mapping[str, Any], *, allow_zero: bool = False
    ) -> dict[str, float]:
        """Numbers, by name, that are allowed together."""
        temperatures = {name: as_float(name, value) for name, value in values.items()}
        check_temperatures(allow_zero=allow_zero or self._allow_zero, **temperatures)
        return temperatures

    def __setattr__(self, name: str, value: Any) -> None:
        """Write a temperature in place, or refuse it and keep the old one."""
        names = self.__dict__.get("temperature_names", ())
        buffers = dict(self.named_buffers(recurse=False)) if name in names else {}
        if name not in buffers:
            super().__setattr__(name, value)
            return
        current = {other: buffers[other] for other in names if other in buffers}
        # A temperature that is no buffer is learned, and positive.
        has_learned = len(current) < len(names)
        allowed = self._as_temperatures({**current, name: value}, allow_zero=has_learned)
        buffers[name].fill_(allowed[name])

    @property
    def mask_keys(self) -> tuple[NestedKey, ...]:
        """The masks that :attr:`loss_mask_key` names; with ``"auto"`` they may be absent."""
        key = self.loss_mask_key
        if key is None:
            return ()
        return AUTO_LOSS_MASK_KEYS if key == "auto" else (key,)

    @property
    def _reward_key(self) -> NestedKey:
        return unravel_key(("next", self.tensor_keys.reward))

    def _mask(self, tensordict: TensorDictBase, shape: torch.Size) -> Tensor | None:
        """Conjunction of the masks that are there."""
        conjunction = None
        for key in self.mask_keys:
            mask = tensordict.get(key, None)
            if mask is None:
                if self.loss_mask_key == "auto":
                    continue
                raise KeyError(
                    f"The mask {key!r} is missing, which loss_mask_key names; there are "
                    f"{present(tensordict)}. Assign another name to loss_mask_key, None to use no "
                    "mask, or 'auto' for TorchRL's own where it is there."
                )
            mask = check_mask(key, mask, shape)
            conjunction = mask if conjunction is None else conjunction & mask
        return conjunction
