"""What both families of losses share: the actor, temperatures, entries of a batch, checks."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_ecpo.checks import as_float, check_choice, present
from torchrl_ecpo.functional import check_temperatures

REDUCTIONS = ("none", "mean", "sum")


class PolicyLoss(LossModule):
    """A loss of a policy, with temperatures that are scheduled by assignment."""

    tensor_keys: Any
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    _may_be_zero: ClassVar[bool] = False
    """Whether all temperatures may be 0 together."""

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        delay_actor: bool,
        reduction: Literal["none", "mean", "sum"] | None,
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

    def _as_temperatures(
        self, values: dict[str, Any], *, allow_zero: bool = False
    ) -> dict[str, float]:
        """Numbers, by name, that are allowed together."""
        temperatures = {name: as_float(name, value) for name, value in values.items()}
        check_temperatures(allow_zero=allow_zero or self._may_be_zero, **temperatures)
        return temperatures

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse a scheduled temperature that is not allowed, and keep the old one."""
        schedulable = type(self)._all_schedulable_buffers
        buffers = self.__dict__.get("_buffers", {})
        if name in schedulable and name in buffers:
            current = {other: buffers[other] for other in sorted(schedulable) if other in buffers}
            # A temperature that is no buffer is learned, and positive.
            has_learned = len(current) < len(schedulable)
            value = self._as_temperatures({**current, name: value}, allow_zero=has_learned)[name]
        super().__setattr__(name, value)  # pyright: ignore[reportArgumentType] - of TorchRL's base

    @property
    def _reward_key(self) -> NestedKey:
        return unravel_key(("next", self.tensor_keys.reward))

    def _mask(self, tensordict: TensorDictBase, shape: torch.Size) -> Tensor | None:
        """Conjunction of the masks that :attr:`loss_mask_key` names, those that are there."""
        conjunction = None
        for key in self._loss_mask_keys():
            mask = tensordict.get(key, None)
            if mask is None:
                if self.loss_mask_key == "auto":
                    continue
                raise KeyError(
                    f"The mask {key!r} is missing, which loss_mask_key names; there are "
                    f"{present(tensordict)}. Assign another name to loss_mask_key, None to use no "
                    "mask, or 'auto' for TorchRL's own where it is there."
                )
            if mask.shape == (*shape, 1):
                mask = mask.squeeze(-1)
            if mask.shape != shape:
                raise ValueError(
                    f"The mask {key!r} must have the shape {tuple(shape)} of the batch (that of "
                    f"the reward without its trailing 1), got {tuple(mask.shape)}."
                )
            if mask.dtype != torch.bool:
                raise ValueError(
                    f"The mask {key!r} must be boolean (True: the step is real), got {mask.dtype}."
                )
            conjunction = mask if conjunction is None else conjunction & mask
        return conjunction
