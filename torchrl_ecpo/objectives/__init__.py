"""LossModules: they read keys, call :mod:`torchrl_ecpo.functional`, reduce and report."""

from torchrl_ecpo.objectives.actor_critic import ActorCriticLoss, Lift, States
from torchrl_ecpo.objectives.ecac import DiscreteECACLoss, ECACLoss
from torchrl_ecpo.objectives.ecpo import ECPOLoss
from torchrl_ecpo.objectives.grpo import GRPOLoss
from torchrl_ecpo.objectives.ment import MENTLoss
from torchrl_ecpo.objectives.mpo import MPOLoss
from torchrl_ecpo.objectives.pmd import PMDLoss
from torchrl_ecpo.objectives.pmd_ac import DiscretePMDACLoss, PMDACLoss
from torchrl_ecpo.objectives.reps import REPSLoss
from torchrl_ecpo.objectives.rloo import RLOOLoss
from torchrl_ecpo.objectives.squared_pmd import SquaredPMDLoss
from torchrl_ecpo.objectives.tpo import TPOLoss
from torchrl_ecpo.objectives.trajectory import (
    LiftProjectLoss,
    Steps,
    TrajectoryGroupLoss,
    TrajectoryGroups,
)
from torchrl_ecpo.objectives.trust_pcl import TrustPCLLoss
from torchrl_ecpo.objectives.urex import UREXLoss

__all__ = [
    "ActorCriticLoss",
    "DiscreteECACLoss",
    "DiscretePMDACLoss",
    "ECACLoss",
    "ECPOLoss",
    "GRPOLoss",
    "Lift",
    "LiftProjectLoss",
    "MENTLoss",
    "MPOLoss",
    "PMDACLoss",
    "PMDLoss",
    "REPSLoss",
    "RLOOLoss",
    "SquaredPMDLoss",
    "States",
    "Steps",
    "TPOLoss",
    "TrajectoryGroupLoss",
    "TrajectoryGroups",
    "TrustPCLLoss",
    "UREXLoss",
]
