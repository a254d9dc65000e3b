"""What ``ecpo.py`` is built from: the task, its policy, the loss and the collector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from torchrl_ecpo import ECPOLoss, MENTLoss, PMDLoss, TrajectoryGroupLoss, UREXLoss
from torchrl_ecpo.envs import BanditEnv
from torchrl_ecpo.schedules import TemperatureScheduler, make_schedule
from torchrl_ecpo.softmax_policy import SharedCategorical, make_softmax_policy

LOSSES = {
    "ecpo": ECPOLoss,
    "pmd": PMDLoss,
    "pmd_entropy": PMDLoss,
    "urex": UREXLoss,
    "ment": MENTLoss,
}
TEMPERATURES = ("tau", "tau_prime")


@dataclass
class Task:
    """What is to be solved, and by which policy."""

    env: EnvBase
    """Of batch size ``[num_groups, group_size]``."""
    actor: ProbabilisticTensorDictSequential
    evaluate: Callable[[], dict[str, float]]
    """Measures the actor as it stands."""
    shown: Sequence[str]
    """Metrics on the progress bar."""
    plotted: Sequence[str]
    """Metrics in the picture."""


def make_task(config: DictConfig) -> Task:
    return TASKS[config.env.name](config)


def make_bandit(config: DictConfig) -> Task:
    env = BanditEnv(
        num_actions=config.env.num_actions,
        num_features=config.env.num_features,
        exponent=config.env.exponent,
        instance_seed=config.env.instance_seed,
        num_groups=config.num_groups,
        group_size=config.group_size,
    )
    actor = make_softmax_policy(env.features)
    state = TensorDict({"observation": torch.ones(1)})

    @torch.no_grad()
    def evaluate() -> dict[str, float]:
        distribution = actor.get_dist(state.clone())
        assert isinstance(distribution, SharedCategorical)
        return {"expected_reward": env.expected_reward(distribution.probs).item()}

    metrics = ("expected_reward", "entropy", "ESS")
    return Task(env, actor, evaluate, shown=metrics, plotted=metrics)


TASKS = {"bandit": make_bandit}


def make_collector(
    config: DictConfig, env: EnvBase, reference: ProbabilisticTensorDictSequential
) -> Collector:
    """A collector of whole groups ``[num_groups, group_size, T]`` drawn from the reference."""
    collector = Collector(
        env,
        reference,
        frames_per_batch=env.numel(),
        total_frames=-1,
        auto_register_policy_transforms=False,
    )
    collector.set_seed(config.seed)
    return collector


def make_loss(config: DictConfig, actor: ProbabilisticTensorDictSequential) -> TrajectoryGroupLoss:
    """The loss that ``loss=`` names; its temperatures are those at the start."""
    options = {str(k): v for k, v in config.items() if k not in ("name", *TEMPERATURES)}
    start = {name: make_schedule(value)(0) for name, value in _temperatures(config).items()}
    return LOSSES[config.name](actor, **start, **options)


def make_temperatures(config: DictConfig, loss_module: TrajectoryGroupLoss) -> TemperatureScheduler:
    schedules = {name: make_schedule(value) for name, value in _temperatures(config).items()}
    return TemperatureScheduler(loss_module, **schedules)


def _temperatures(config: DictConfig) -> dict[str, float | dict]:
    """By name, a number or a schedule, as ``make_schedule`` takes them."""
    values = OmegaConf.to_container(config, resolve=True)
    assert isinstance(values, dict)
    return {name: values[name] for name in TEMPERATURES if name in values}
