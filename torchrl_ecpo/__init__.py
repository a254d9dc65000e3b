"""Lift-and-project policy optimisation for TorchRL: ECPO, PMD, ECAC and their rivals."""

from torchrl_ecpo.objectives import (
    ActorCriticLoss,
    ContinuousActorCriticLoss,
    DiscreteActorCriticLoss,
    DiscreteECACLoss,
    DiscretePMDACLoss,
    ECACLoss,
    ECPOLoss,
    Lift,
    LiftProjectLoss,
    MENTLoss,
    PMDACLoss,
    PMDLoss,
    TrajectoryGroupLoss,
    TrajectoryGroups,
    UREXLoss,
)
from torchrl_ecpo.schedules import TemperatureScheduler
from torchrl_ecpo.updaters import PeriodicCopy, PolyakAverage, UpdaterSequence

__all__ = [
    "ActorCriticLoss",
    "ContinuousActorCriticLoss",
    "DiscreteActorCriticLoss",
    "DiscreteECACLoss",
    "DiscretePMDACLoss",
    "ECACLoss",
    "ECPOLoss",
    "Lift",
    "LiftProjectLoss",
    "MENTLoss",
    "PMDACLoss",
    "PMDLoss",
    "PeriodicCopy",
    "PolyakAverage",
    "TemperatureScheduler",
    "TrajectoryGroupLoss",
    "TrajectoryGroups",
    "UREXLoss",
    "UpdaterSequence",
]

__version__ = "0.1.0"
