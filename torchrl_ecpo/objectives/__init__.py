"""LossModules: they read keys, call :mod:`torchrl_ecpo.functional`, reduce and report."""

from torchrl_ecpo.objectives.ecpo import ECPOLoss
from torchrl_ecpo.objectives.ment import MENTLoss
from torchrl_ecpo.objectives.pmd import PMDLoss
from torchrl_ecpo.objectives.trajectory import (
    LiftProjectLoss,
    TrajectoryGroupLoss,
    TrajectoryGroups,
)
from torchrl_ecpo.objectives.urex import UREXLoss

__all__ = [
    "ECPOLoss",
    "LiftProjectLoss",
    "MENTLoss",
    "PMDLoss",
    "TrajectoryGroupLoss",
    "TrajectoryGroups",
    "UREXLoss",
]
