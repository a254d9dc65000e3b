"""What ``ecpo.py`` is built from beside the task: the collector, the loss, the temperatures."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from tasks import Metrics, Task, make_task
from tensordict.nn import ProbabilisticTensorDictSequential

from torchrl_ecpo import ECPOLoss, MENTLoss, PMDLoss, TrajectoryGroupLoss, UREXLoss
from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.experiment import Run, check_options
from torchrl_ecpo.schedules import TemperatureScheduler, make_schedule

LOSSES = {
    "ecpo": ECPOLoss,
    "pmd": PMDLoss,
    "pmd_entropy": PMDLoss,
    "urex": UREXLoss,
    "ment": MENTLoss,
}
TEMPERATURES = ("tau", "tau_prime")
COMPILABLE = ("bandit", "gym")


def check_config(config: DictConfig) -> None:
    """Refuse settings with which a run would never end, or never begin."""
    counts = ("total_trajectories", "evaluation_interval", "num_groups", "group_size")
    check_options(config, (*counts, "project_steps"))
    if config.compile and config.seeds is not None:
        raise ValueError(
            f"compile=true is for single runs, got seeds={config.seeds}. Leave out compile, or "
            "start a run for each seed: --multirun seed=..."
        )
    if config.compile and config.env.kind not in COMPILABLE:
        raise ValueError(
            f"compile=true is for tasks of the kinds {COMPILABLE}, got env.kind="
            f"{config.env.kind!r}, whose policy computes each distinct history once: how much that "
            "is differs from batch to batch. Leave out compile."
        )


class Parts(NamedTuple):
    """What a run is made of; of stacked runs (``stack.py``), numbers come as one for each run."""

    task: Task
    collector: TrajectoryGroupCollector
    loss_module: Any
    temperatures: Any
    run: Any
    clip_grad_norm_: Callable[[float], torch.Tensor]


def make_parts(config: DictConfig) -> Parts:
    """The parts of a single run."""
    torch.manual_seed(config.seed)
    task = make_task(config)
    collector = make_collector(config, task)
    loss_module = make_loss(config.loss, task.actor)
    temperatures = make_temperatures(config.loss, loss_module)
    clip = partial(torch.nn.utils.clip_grad_norm_, list(loss_module.parameters()))
    return Parts(task, collector, loss_module, temperatures, make_run(config, task), clip)


def make_run(config: DictConfig, task: Task, **options: Any) -> Run:
    """The record of a run."""
    return Run(
        config,
        total=config.total_trajectories,
        unit="trajectories",
        name=f"{config.env.name}/{config.loss.name}/seed_{config.seed}",
        shown=task.shown,
        **options,
    )


def make_collector(config: DictConfig, task: Task) -> TrajectoryGroupCollector:
    """A collector of whole groups ``[num_groups, group_size, T]`` drawn from the reference.

    In this process it plays the task's own environment; workers make theirs, and share the groups
    of a batch unless each makes batches of its own.
    """
    options: Any = OmegaConf.to_container(config.collector, resolve=True)
    num_groups = config.num_groups // (options["num_collectors"] if options.get("sync") else 1)
    collector = TrajectoryGroupCollector(
        task.env if is_single(config) else partial(task.make_env, num_groups=num_groups),
        task.actor,
        num_groups=config.num_groups,
        group_size=config.group_size,
        # The loss computes them anew; they are most of a batch.
        exclude_keys=["logits", "loc", "scale", "parameters"],
        **options,
    )
    collector.set_seed(config.seed)
    return collector


def is_single(config: DictConfig) -> bool:
    """Whether episodes are played in this process."""
    return config.collector.backend == "direct"


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


def reached(goal: DictConfig | None, metrics: Metrics) -> bool | torch.Tensor:
    """Whether a metric has come up to a goal, ``{metric: ..., at_least: ...}``; always for none.

    Of stacked runs, bool ``[R]``.
    """
    if goal is None:
        return True
    if goal.metric not in metrics:
        raise KeyError(
            f"anneal_from.metric must be one of {sorted(metrics)}, which every gradient step has, "
            f"got {goal.metric!r}."
        )
    is_reached = torch.as_tensor(metrics[goal.metric] >= goal.at_least)
    return is_reached if is_reached.ndim else bool(is_reached)


def run_name(seed: int, seeds: Any) -> str:
    """The name of the directory of a run, or of stacked runs, whose seeds are yet to be checked."""
    return (
        f"seed_{seed}" if seeds is None else "seeds_" + re.sub(r"\W+", "_", str(seeds)).strip("_")
    )


OmegaConf.register_new_resolver("run_name", run_name, replace=True)
