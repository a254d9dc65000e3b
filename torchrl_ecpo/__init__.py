"""Lift-and-project policy optimisation for TorchRL: ECPO, PMD and their rivals."""

from torchrl_ecpo.objectives import (
    ECPOLoss,
    LiftProjectLoss,
    MENTLoss,
    PMDLoss,
    TrajectoryGroupLoss,
    TrajectoryGroups,
    UREXLoss,
)
from torchrl_ecpo.schedules import TemperatureScheduler
from torchrl_ecpo.updaters import PeriodicCopy, PolyakAverage, UpdaterSequence

__all__ = [
    "ECPOLoss",
    "LiftProjectLoss",
    "MENTLoss",
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
