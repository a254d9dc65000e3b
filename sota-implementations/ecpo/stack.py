"""Several independent runs in one process: what ``seeds=[0,1,...]`` asks for.

Each run is built as it would be alone: environment, policy, loss, temperatures, record. Then they
are stacked, so that they sample, step and learn together, with parameters and optimiser state
stacked along a leading dimension. What is cheap, or differs from run to run, stays the run's own:
random numbers, curriculum, temperatures, clipping, metrics. R is the number of runs; a batch
``[R * num_groups, group_size, T]`` holds them one after another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from tasks import Metrics, Task, make_task
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import set_recurrent_mode
from utils import Parts, is_single, make_loss, make_run, make_temperatures

from torchrl_ecpo import TrajectoryGroupLoss
from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.envs import stack_envs
from torchrl_ecpo.experiment import Run
from torchrl_ecpo.groups import MASK_KEY
from torchrl_ecpo.modules import stack_policies
from torchrl_ecpo.schedules import TemperatureScheduler

STACKABLE = ("algorithmic", "bandit")


def make_stack(config: DictConfig) -> Parts:
    """All that ``config.seeds`` names, as the parts of one run.

    Raises:
        ValueError: for seeds that are not a list of different integers, or a task that cannot be
            stacked.
    """
    _check_seeds(config)
    configs: list[Any] = [
        OmegaConf.merge(config, {"seed": seed, "seeds": None}) for seed in config.seeds
    ]
    tasks, random_states = [], []
    for own in configs:
        torch.manual_seed(own.seed)
        tasks.append(make_task(own))
        random_states.append(torch.get_rng_state())
    actors = [task.actor for task in tasks]
    actor = stack_policies(actors, random_states)
    task = _stack_tasks(tasks, actor)
    collector = TrajectoryGroupCollector(
        task.env,
        actor,
        num_groups=len(tasks) * config.num_groups,
        group_size=config.group_size,
        exclude_keys=["logits"],
    )
    for own, each in zip(configs, tasks, strict=True):
        each.env.set_seed(own.seed)  # only now, for the collector has reset it
    evaluated: Any = _Evaluated()
    losses = [make_loss(config.loss, evaluated) for _ in tasks]
    loss_module = StackedLoss(actor, actors, losses)
    temperatures = StackedTemperatures([make_temperatures(config.loss, loss) for loss in losses])
    runs = []
    for index, (own, each) in enumerate(zip(configs, tasks, strict=True)):
        directory = Path(f"seed_{own.seed}")
        directory.mkdir(exist_ok=True)
        options = {"directory": directory, "show_bar": index == 0, "stack_size": len(tasks)}
        runs.append(make_run(own, each, **options))
    run = RunStack(runs)
    return Parts(task, collector, loss_module, temperatures, run, loss_module.clip_grad_norm_)


def _check_seeds(config: DictConfig) -> None:
    seeds = config.seeds
    is_list = isinstance(seeds, ListConfig) and len(seeds) > 0
    if not is_list or not all(type(seed) is int for seed in seeds) or len({*seeds}) < len(seeds):
        raise ValueError(
            "seeds must be a list of different integers, such as seeds=[0,1,2], or null for a "
            f"single run with seed=, got {seeds!r}."
        )
    if not is_single(config):
        raise ValueError(
            f"seeds={seeds}: stacked runs are played in one process, with collector=single, got "
            f"collector.backend={config.collector.backend!r}."
        )
    if config.env.kind not in STACKABLE:
        raise ValueError(
            f"seeds={seeds}: tasks of the kinds {STACKABLE} can be stacked, got env.kind="
            f"{config.env.kind!r}. Start processes instead: --multirun "
            f"seed={','.join(map(str, seeds))}"
        )


def _stack_tasks(tasks: Sequence[Task], actor: Any) -> Task:
    """One environment and one policy; each run is measured by its own task."""

    def measure(groups: TensorDictBase) -> Metrics:
        parts = zip(tasks, split(groups, len(tasks)), strict=True)
        return _columns([task.measure(part) for task, part in parts])

    def evaluate(groups: TensorDictBase) -> Metrics:
        parts = zip(tasks, split(groups, len(tasks)), strict=True)
        return _columns([task.evaluate(part) for task, part in parts])

    others = [task.evaluation_env for task in tasks if task.evaluation_env is not None]
    evaluation_env: Any = nn.ModuleList(others) if others else None
    return replace(
        tasks[0],
        env=stack_envs([task.env for task in tasks]),
        actor=actor,
        measure=measure,
        evaluate=evaluate,
        evaluation_env=evaluation_env,
    )


def _columns(metrics: Sequence[Mapping[str, float | Tensor]]) -> Metrics:
    """A value of each run, ``[R]``, for each metric."""
    return {
        name: torch.tensor([float(own[name]) for own in metrics], dtype=torch.float64)
        for name in metrics[0]
    }


def split(groups: TensorDictBase, num_runs: int) -> list[TensorDictBase]:
    """The batch of each run, without the padding that longer trajectories of others brought."""
    parts: Any = groups.split(len(groups) // num_runs)
    return [part[..., : int(part[MASK_KEY].sum(-1).max())] for part in parts]


class _Evaluated(TensorDictModuleBase):
    """Stands for a policy whose log-probabilities have been evaluated: they are in the batch."""

    def __init__(self) -> None:
        super().__init__()
        keys: list[Any] = ["log_prob"]
        self.in_keys, self.out_keys = keys, keys[1:]

    def get_dist(self, tensordict: TensorDictBase) -> _Evaluated:
        """Keep what :meth:`log_prob` gives."""
        self.value = tensordict.get("log_prob")
        return self

    def log_prob(self, action: Tensor) -> Tensor:
        """Log-probability of the actions of the batch, whatever they are."""
        return self.value


class StackedLoss(nn.Module):
    """Evaluates the stacked policy once; each run's own loss makes of it what it would alone.

    Args:
        actor: of all runs.
        actors: of each run; their parameters are views of the stacked ones.
        losses: of each run, over log-probabilities that have been evaluated.
    """

    def __init__(
        self, actor: Any, actors: Sequence[nn.Module], losses: Sequence[TrajectoryGroupLoss]
    ) -> None:
        super().__init__()
        self.actor = actor
        self._actors, self._losses = list(actors), list(losses)

    def forward(self, groups: TensorDictBase) -> Any:
        """Loss and diagnostics, ``[R]`` each."""
        steps = groups.select(*self.actor.in_keys, "action", MASK_KEY, strict=False).flatten(0, 1)
        with set_recurrent_mode(True):
            log_prob = self.actor.get_dist(steps).log_prob(steps["action"])
        groups = groups.copy().set("log_prob", log_prob.view(groups.shape))
        parts = zip(self._losses, split(groups, len(self._losses)), strict=True)
        return torch.stack([loss(part) for loss, part in parts])

    def clip_grad_norm_(self, max_norm: float) -> Tensor:
        """Scale down each run's gradient if its norm exceeds `max_norm`; the norms ``[R]``."""
        norms = []
        for index, actor in enumerate(self._actors):
            for own, stacked in zip(actor.parameters(), self.actor.parameters(), strict=True):
                own.grad = None if stacked.grad is None else stacked.grad[index]
            norms.append(nn.utils.clip_grad_norm_(actor.parameters(), max_norm))
        return torch.stack(norms)


class StackedTemperatures:
    """The temperatures of each run."""

    def __init__(self, schedulers: Sequence[TemperatureScheduler]) -> None:
        self.schedulers = schedulers

    def step(self, count: float | Tensor) -> None:
        """Advance by ``count``, one number or one for each run."""
        counts = torch.as_tensor(count).expand(len(self.schedulers)).tolist()
        for scheduler, own in zip(self.schedulers, counts, strict=True):
            scheduler.step(own)

    def values(self) -> Metrics:
        """The temperatures as they stand, ``[R]`` each."""
        return _columns([scheduler.values() for scheduler in self.schedulers])

    def state_dict(self) -> dict[str, Any]:
        """The counts."""
        return {str(i): scheduler.state_dict() for i, scheduler in enumerate(self.schedulers)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue at saved counts."""
        for i, scheduler in enumerate(self.schedulers):
            scheduler.load_state_dict(state_dict[str(i)])


class RunStack:
    """The records of all runs; a metric is a value for each, ``[R]``."""

    def __init__(self, runs: Sequence[Run]) -> None:
        self.runs, self.unit = runs, runs[0].unit
        self._open = ExitStack()

    def log(self, metrics: Mapping[str, Tensor], step: int) -> None:
        """Record a row in each run."""
        for i, run in enumerate(self.runs):
            run.log({name: values[i] for name, values in metrics.items()}, step)

    def check(self, metrics: Mapping[str, Tensor], step: int) -> None:
        """Stop all runs before one is spoilt.

        Raises:
            FloatingPointError: if a loss or the norm of a gradient is NaN or infinite.
        """
        for i, run in enumerate(self.runs):
            try:
                run.check({name: values[i] for name, values in metrics.items()}, step)
            except FloatingPointError as error:
                raise FloatingPointError(f"{run.name}: {error}") from error

    def state_dict(self) -> dict[str, Any]:
        """Where the records stand."""
        return {str(i): run.state_dict() for i, run in enumerate(self.runs)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on there: the records are cut back to it."""
        for i, run in enumerate(self.runs):
            run.load_state_dict(state_dict[str(i)])

    def __enter__(self) -> RunStack:
        """Enter every run."""
        for run in self.runs:
            self._open.enter_context(run)
        return self

    def __exit__(self, *error: Any) -> None:
        """Close every run."""
        self._open.__exit__(*error)
