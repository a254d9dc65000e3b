"""The paper's problems as batched TorchRL environments, and groups over any environment."""

from torchrl_ecpo.envs._groups import GroupIdAllocator
from torchrl_ecpo.envs.algorithmic import TASKS, AlgorithmicEnv, AlgorithmicTask
from torchrl_ecpo.envs.bandit import BanditEnv
from torchrl_ecpo.envs.grouped import GroupedEnv
from torchrl_ecpo.envs.replay import EpisodeReplay
from torchrl_ecpo.envs.vector import VectorGroupedEnv, make_grouped_env

__all__ = [
    "TASKS",
    "AlgorithmicEnv",
    "AlgorithmicTask",
    "BanditEnv",
    "EpisodeReplay",
    "GroupIdAllocator",
    "GroupedEnv",
    "VectorGroupedEnv",
    "make_grouped_env",
]
