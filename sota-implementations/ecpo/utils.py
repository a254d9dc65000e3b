"""What ``ecpo.py`` is built from beside the task: the collector, the loss, the temperatures."""

from __future__ import annotations

import torch
from omegaconf import DictConfig, OmegaConf
from tasks import Metrics, Task
from tensordict.nn import ProbabilisticTensorDictSequential

from torchrl_ecpo import ECPOLoss, MENTLoss, PMDLoss, TrajectoryGroupLoss, UREXLoss
from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.schedules import TemperatureScheduler, make_schedule

LOSSES = {
    "ecpo": ECPOLoss,
    "pmd": PMDLoss,
    "pmd_entropy": PMDLoss,
    "urex": UREXLoss,
    "ment": MENTLoss,
}
TEMPERATURES = ("tau", "tau_prime")


def check_config(config: DictConfig) -> None:
    """Refuse counts with which a run would never end, or never begin."""
    names = ("total_trajectories", "evaluation_interval", "num_groups", "group_size")
    for name in (*names, "project_steps", "threads"):
        value = config[name]
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"{name} must be an integer of at least 1, got {value!r}.")
    if not isinstance(config.seed, int):
        raise ValueError(f"seed must be an integer, got {config.seed!r}.")


def make_collector(config: DictConfig, task: Task) -> TrajectoryGroupCollector:
    """A collector of whole groups ``[num_groups, group_size, T]`` drawn from the reference."""
    collector = TrajectoryGroupCollector(
        task.env,
        task.actor,
        num_groups=config.num_groups,
        group_size=config.group_size,
        # The loss computes them anew; they are most of a batch.
        exclude_keys=["logits", "loc", "scale", "parameters"],
    )
    collector.set_seed(config.seed)
    return collector


def make_loss(config: DictConfig, actor: ProbabilisticTensorDictSequential) -> TrajectoryGroupLoss:
    """The loss that ``loss=`` names; ``make_temperatures`` sets its temperatures."""
    options = {str(k): v for k, v in config.items() if k not in ("name", *TEMPERATURES)}
    return LOSSES[config.name](actor, **options)


def make_optimizer(config: DictConfig, loss_module: TrajectoryGroupLoss) -> torch.optim.Optimizer:
    """Adam over the parameters of the actor."""
    return torch.optim.Adam(
        loss_module.parameters(), lr=config.lr, eps=config.eps, amsgrad=config.amsgrad
    )


def make_temperatures(config: DictConfig, loss_module: TrajectoryGroupLoss) -> TemperatureScheduler:
    """Schedules of the temperatures, counted in trajectories; they begin at once."""
    settings = OmegaConf.to_container(config, resolve=True)
    assert isinstance(settings, dict)
    schedules = {name: make_schedule(settings[name]) for name in TEMPERATURES if name in settings}
    return TemperatureScheduler(loss_module, **schedules)


def reached(goal: DictConfig | None, metrics: Metrics) -> bool:
    """Whether a metric has come up to a goal, ``{metric: ..., at_least: ...}``; always for none."""
    if goal is None:
        return True
    if goal.metric not in metrics:
        raise KeyError(f"anneal_from.metric must be one of {sorted(metrics)}, got {goal.metric!r}.")
    return bool(metrics[goal.metric] >= goal.at_least)
