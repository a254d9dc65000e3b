"""The paper's problems as batched TorchRL environments, and groups over any environment."""

from typing import TYPE_CHECKING

from torchrl_ecpo._lazy import importing
from torchrl_ecpo.envs._groups import GroupIdAllocator
from torchrl_ecpo.envs.algorithmic import TASKS, AlgorithmicEnv, AlgorithmicTask
from torchrl_ecpo.envs.bandit import BanditEnv
from torchrl_ecpo.envs.deep_sea import DeepSeaEnv
from torchrl_ecpo.envs.grouped import GroupedEnv
from torchrl_ecpo.envs.replay import EpisodeReplay

if TYPE_CHECKING:
    from torchrl_ecpo.envs.plain_spaces import readable
    from torchrl_ecpo.envs.vector import VectorGroupedEnv, make_grouped_env

__all__ = [
    "TASKS",
    "AlgorithmicEnv",
    "AlgorithmicTask",
    "BanditEnv",
    "DeepSeaEnv",
    "EpisodeReplay",
    "GroupIdAllocator",
    "GroupedEnv",
    "VectorGroupedEnv",
    "make_grouped_env",
    "readable",
]

# What needs gymnasium is imported where it is first asked for: the rest does without.
__getattr__ = importing(__name__, "plain_spaces", "vector")
