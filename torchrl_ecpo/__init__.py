"""Lift-and-project policy optimisation for TorchRL: ECPO, PMD, ECAC and their rivals."""

from typing import TYPE_CHECKING

from torchrl_ecpo._lazy import importing

if TYPE_CHECKING:
    from torchrl_ecpo.collectors import TrajectoryGroupCollector
    from torchrl_ecpo.envs import BanditEnv
    from torchrl_ecpo.modules import make_softmax_policy
    from torchrl_ecpo.objectives import (
        ActorCriticLoss,
        DiscreteECACLoss,
        DiscretePMDACLoss,
        ECACLoss,
        ECPOLoss,
        GRPOLoss,
        Lift,
        LiftProjectLoss,
        MENTLoss,
        MPOLoss,
        PMDACLoss,
        PMDLoss,
        REPSLoss,
        RLOOLoss,
        SquaredPMDLoss,
        TPOLoss,
        TrajectoryGroupLoss,
        TrajectoryGroups,
        TrustPCLLoss,
        UREXLoss,
    )
    from torchrl_ecpo.schedules import TemperatureScheduler
    from torchrl_ecpo.updaters import PeriodicCopy, PolyakAverage, UpdaterSequence

__all__ = [
    "ActorCriticLoss",
    "BanditEnv",
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
    "PeriodicCopy",
    "PolyakAverage",
    "REPSLoss",
    "RLOOLoss",
    "SquaredPMDLoss",
    "TPOLoss",
    "TemperatureScheduler",
    "TrajectoryGroupCollector",
    "TrajectoryGroupLoss",
    "TrajectoryGroups",
    "TrustPCLLoss",
    "UREXLoss",
    "UpdaterSequence",
    "make_softmax_policy",
]

__version__ = "0.1.0"
__getattr__ = importing(
    __name__, "collectors", "envs", "modules", "objectives", "schedules", "updaters"
)
