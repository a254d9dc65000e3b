"""The losses where TorchRL's hydra trainers look for them, as ``loss@loss: ecac``.

Importing this module, which needs hydra, registers a config of each loss in TorchRL's group
``loss``. Its options are those of the loss's constructor, with its defaults; networks have none. A
loss with a critic also has ``gamma``, the discount, as TorchRL's configs have.

Examples:
    >>> from hydra.utils import instantiate
    >>> from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
    >>> from torchrl.data import Bounded
    >>> actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
    >>> config = ECACLossConfig(qvalue_network=make_qvalue_network(3, 2), tau=0.5, gamma=0.98)
    >>> loss_module = instantiate(config, actor_network=actor)
    >>> round(loss_module.log_tau.exp().item(), 3), loss_module.value_estimator.gamma.item()
    (0.5, 0.9800000190734863)
"""

from __future__ import annotations

import inspect
from dataclasses import field, make_dataclass
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING
from torchrl.trainers import Trainer, TrainerHookBase
from torchrl.trainers.algorithms.configs import LossConfig

import torchrl_ecpo
from torchrl_ecpo.checks import as_float
from torchrl_ecpo.objectives import ActorCriticLoss
from torchrl_ecpo.objectives._base import PolicyLoss, options_of

__all__ = [
    "DiscreteECACLossConfig",
    "DiscretePMDACLossConfig",
    "ECACLossConfig",
    "ECPOLossConfig",
    "GRPOLossConfig",
    "LearningRates",
    "MENTLossConfig",
    "MPOLossConfig",
    "PMDACLossConfig",
    "PMDLossConfig",
    "REPSLossConfig",
    "RLOOLossConfig",
    "SquaredPMDLossConfig",
    "TPOLossConfig",
    "TrustPCLLossConfig",
    "UREXLossConfig",
    "make_loss",
]


class LearningRates(TrainerHookBase):
    """Gives networks and temperatures of a loss learning rates of their own.

    TorchRL's configs of trainers have one optimiser with one rate for all parameters. This hook,
    one of ``trainer.hooks``, moves those that it names to parameter groups of their own.

    Args:
        rates: the rate of what is named: ``log_tau``, ``actor_network``, ``qvalue_network``, ...

    Raises:
        ValueError: for a rate that is no finite number >= 0 and, when registered, for a name of
            nothing that the loss learns or the optimiser holds, without an optimiser, or after a
            learning-rate scheduler.

    Examples:
        >>> LearningRates(log_tau=1e-2, actor_network=1e-3).rates
        {'log_tau': 0.01, 'actor_network': 0.001}
    """

    def __init__(self, **rates: float) -> None:
        self.rates = {
            name: as_float(f"The learning rate {name}", rate, "[0, inf)")
            for name, rate in rates.items()
        }

    def register(self, trainer: Trainer, name: str = "learning_rates") -> None:
        """Regroup the parameters of the trainer's optimiser."""
        optimizer = trainer.optimizer
        if optimizer is None:
            raise ValueError("LearningRates needs a trainer with an optimizer=, which it regroups.")
        if any("initial_lr" in group for group in optimizer.param_groups):
            raise ValueError(
                "LearningRates adds groups of parameters, and a learning-rate scheduler has "
                "counted those that there are: register LearningRates before it is made."
            )
        learned: dict[str, list[Any]] = {}
        for parameter_name, parameter in trainer.loss_module.named_parameters():
            owner = parameter_name.split(".")[0].removesuffix("_params")
            learned.setdefault(owner, []).append(parameter)
        if unknown := self.rates.keys() - learned.keys():
            known = ", ".join(sorted(learned))
            raise ValueError(f"LearningRates names {min(unknown)}; the loss learns {known}.")
        owners = {id(parameter): owner for owner in self.rates for parameter in learned[owner]}
        groups = [*optimizer.param_groups]
        if left := owners.keys() - {id(one) for group in groups for one in group["params"]}:
            raise ValueError(
                f"LearningRates names {min(owners[one] for one in left)}, which the trainer's "
                "optimizer does not hold: make it of loss_module.parameters()."
            )
        for group in groups:
            parts: dict[str | None, list[Any]] = {name: [] for name in (None, *self.rates)}
            for parameter in group["params"]:
                parts[owners.get(id(parameter))].append(parameter)
            group["params"] = parts.pop(None)
            for owner, parameters in parts.items():
                if parameters:
                    own = {"params": parameters, "lr": self.rates[str(owner)]}
                    optimizer.add_param_group({**group, **own})


def make_loss(loss_class: str, **options: Any) -> PolicyLoss:
    """Make a loss of its config.

    Args:
        loss_class: its name in ``torchrl_ecpo``.
        options: of its constructor and, with a critic, ``gamma``.

    Raises:
        TypeError: for an option that it does not have.
    """
    kind = getattr(torchrl_ecpo, loss_class)
    gamma = options.pop("gamma", None) if issubclass(kind, ActorCriticLoss) else None
    loss_module = kind(**options)
    if gamma is not None:
        loss_module.make_value_estimator(gamma=gamma)
    return loss_module


def _register(name: str, kind: type[PolicyLoss]) -> Any:
    """Make the config of a loss, and let hydra find it."""
    constants = {
        "loss_class": kind.__name__,
        "_target_": "torchrl_ecpo.trainers.make_loss",
        "_convert_": "all",  # lists, such as GRPO's clip_epsilon, in Python's own
    }
    options = options_of(kind) | ({"gamma": None} if issubclass(kind, ActorCriticLoss) else {})
    fields = [
        (option, Any, field(default=MISSING if default is inspect.Parameter.empty else default))
        for option, default in (options | constants).items()
    ]
    text = f"Hydra configuration of :class:`~torchrl_ecpo.{kind.__name__}`, with its options."
    namespace = {"__doc__": text, "__module__": __name__}
    config = make_dataclass(
        f"{kind.__name__}Config", fields, bases=(LossConfig,), namespace=namespace
    )
    ConfigStore.instance().store(group="loss", name=name, node=config)
    return config


ECPOLossConfig = _register("ecpo", torchrl_ecpo.ECPOLoss)
PMDLossConfig = _register("pmd", torchrl_ecpo.PMDLoss)
UREXLossConfig = _register("urex", torchrl_ecpo.UREXLoss)
MENTLossConfig = _register("ment", torchrl_ecpo.MENTLoss)
RLOOLossConfig = _register("rloo", torchrl_ecpo.RLOOLoss)
GRPOLossConfig = _register("grpo", torchrl_ecpo.GRPOLoss)
TPOLossConfig = _register("tpo", torchrl_ecpo.TPOLoss)
SquaredPMDLossConfig = _register("squared_pmd", torchrl_ecpo.SquaredPMDLoss)
REPSLossConfig = _register("reps", torchrl_ecpo.REPSLoss)
TrustPCLLossConfig = _register("trust_pcl", torchrl_ecpo.TrustPCLLoss)
ECACLossConfig = _register("ecac", torchrl_ecpo.ECACLoss)
DiscreteECACLossConfig = _register("discrete_ecac", torchrl_ecpo.DiscreteECACLoss)
PMDACLossConfig = _register("pmd_ac", torchrl_ecpo.PMDACLoss)
DiscretePMDACLossConfig = _register("discrete_pmd_ac", torchrl_ecpo.DiscretePMDACLoss)
MPOLossConfig = _register("mpo", torchrl_ecpo.MPOLoss)
