"""Training all runs: Algorithm 1 as in ``ecpo.py``, with a loss, an optimiser and a record each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import dataclass, field
from math import lcm
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tasks import Metrics, Task, make_task
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.utils import clip_grad_norm_
from utils import (
    check_goals,
    goes_on,
    held,
    is_far,
    make_loss,
    make_optimizer,
    make_run,
    make_temperatures,
    of_batch,
    reached,
    total_loss,
)

from stacked.envs import stack_envs
from stacked.policies import stack_policies
from torchrl_ecpo import TrajectoryGroupLoss
from torchrl_ecpo.collectors import TrajectoryGroupCollector, shut_down
from torchrl_ecpo.experiment import Checkpoints, Progress, Run
from torchrl_ecpo.groups import DONE_KEY, GROUP_KEY, MASK_KEY
from torchrl_ecpo.schedules import TemperatureScheduler

KEYS_OF_LOSSES = ("action", "action_log_prob", MASK_KEY, GROUP_KEY, ("next", "reward"), DONE_KEY)


def train_stack(configs: Mapping[str, DictConfig], checkpoints: Checkpoints) -> None:
    """Train the runs, by the name of their directory, together."""
    stack = Stack(configs)
    runs = [member.config for member in stack.members]
    # Whole projections of each.
    lift = lcm(*(c.num_groups * c.group_size * c.project_steps for c in runs))
    total = -(-runs[0].total_trajectories // lift) * lift
    with shut_down(stack.collector), ExitStack() as open_runs:
        for member in stack.members:
            open_runs.enter_context(member.run)
        run, *_ = (member.run for member in stack.members)
        open_runs.enter_context(checkpoints.attach(run, stack.progress, **stack.parts()))
        while stack.progress.trajectories < total and stack.goes_on:
            stack.lift()
            stack.project()
            stack.anneal()
            checkpoints.boundary()


@dataclass
class Member:
    """What is a run's own."""

    config: DictConfig
    task: Task
    loss_module: TrajectoryGroupLoss
    optimizer: torch.optim.Optimizer
    temperatures: TemperatureScheduler
    run: Run
    metrics: Metrics = field(default_factory=dict)
    """Of the last project step."""


class Stack:
    """The runs, and what they share.

    Args:
        configs: of the runs, by the name of their directory.
    """

    def __init__(self, configs: Mapping[str, DictConfig]) -> None:
        first, *_ = configs.values()
        tasks, random_states = [], []
        for config in configs.values():
            torch.manual_seed(config.seed)
            tasks.append(make_task(config))
            random_states.append(torch.get_rng_state())
        self.policy = stack_policies([task.actor for task in tasks], random_states)
        self.reference = deepcopy(self.policy)  # runs lift at different times
        self.collector = TrajectoryGroupCollector(
            stack_envs([task.env for task in tasks]),
            self.reference,
            num_groups=len(tasks) * first.num_groups,
            group_size=first.group_size,
            exclude_keys=["logits"],
        )
        for config, task in zip(configs.values(), tasks, strict=True):
            task.env.set_seed(config.seed)  # only now, for the collector has reset it
        self._batches = iter(self.collector)
        self._batch_size = first.num_groups * first.group_size
        self.members = [
            _make_member(Path(name), config, task, stack_size=len(tasks), show_bar=not index)
            for index, ((name, config), task) in enumerate(zip(configs.items(), tasks, strict=True))
        ]
        is_annealing = [config.anneal_from is None for config in configs.values()]
        self.progress = Progress(
            trajectories=0, project_steps=0, is_annealing=is_annealing, held=[0] * len(tasks)
        )

    @property
    def goes_on(self) -> bool:
        """Whether there is still something to wait for in one of the runs."""
        pairs = zip(self.members, self.progress.held, strict=True)
        return any(goes_on(member.config, so_far) for member, so_far in pairs)

    def parts(self) -> dict[str, Any]:
        """What a checkpoint holds beside the first run's record and the progress."""
        parts: dict[str, Any] = {
            "policy": self.policy,
            "reference": self.reference,
            "collector": self.collector,
        }
        for index, member in enumerate(self.members):
            parts |= {
                f"run_{index}": member.run,
                **({f"loss_{index}": member.loss_module} if member.loss_module.losses else {}),
                f"optimizer_{index}": member.optimizer,
                f"temperatures_{index}": member.temperatures,
                f"evaluation_env_{index}": member.task.evaluation_env,
            }
        del parts["run_0"]
        return parts

    def lift(self) -> None:
        """Where a run's projection begins, its current policy becomes its reference."""
        lifted = [index for index, member in enumerate(self.members) if self._is_due(member)]
        for index in lifted:
            self.reference.copy_run(index, self.policy)
        if lifted:
            self.collector.update_policy_weights_()

    def project(self) -> None:
        """Gradient steps of each run, on fresh trajectories of its reference."""
        groups = next(self._batches)
        losses_of_runs = self._losses(groups)
        of_steps: list[list[Metrics]] = [[] for _ in self.members]
        stepping = list(range(len(self.members)))
        for epoch in range(max(member.config.epochs for member in self.members)):
            all_losses = losses_of_runs()
            for index in list(stepping):
                config = self.members[index].config
                if epoch < config.epochs:
                    of_steps[index].append(all_losses[index].detach().to_dict())
                if epoch >= config.epochs or is_far(of_steps[index], config.max_kl):
                    stepping.remove(index)
            if not stepping:
                break
            losses = [total_loss(all_losses[i], self.members[i].loss_module) for i in stepping]
            for index in stepping:
                self.members[index].optimizer.zero_grad()
            torch.stack(losses).sum().backward()
            for index in stepping:
                self._step(self.members[index], of_steps[index][-1])

        self.progress.trajectories += self._batch_size
        self.progress.project_steps += 1
        for index, part in enumerate(self._split(groups)):
            member = self.members[index]
            metrics = of_batch(of_steps[index]) | member.task.measure(part)
            metrics |= member.temperatures.values()
            if self.progress.project_steps % member.config.evaluation.interval == 0:
                with self.collector.policy.streams.drawing_from(index):
                    metrics |= member.task.evaluate(part)
            member.metrics = metrics
            check_goals(member.config, metrics)
            member.run.log(metrics, step=self.progress.trajectories)
            so_far = self.progress.held[index]
            self.progress.held[index] = held(member.config.stop_when, so_far, metrics)

    def anneal(self) -> None:
        """Where a run's projection ends, its temperatures may fall."""
        annealing = self.progress.is_annealing
        for index, member in enumerate(self.members):
            if self._is_due(member):
                annealing[index] |= reached(member.config.anneal_from, member.metrics)
                num_trajectories = member.config.project_steps * self._batch_size
                member.temperatures.step(annealing[index] * num_trajectories)

    def _is_due(self, member: Member) -> bool:
        return self.progress.project_steps % member.config.project_steps == 0

    def _losses(self, groups: TensorDictBase) -> Callable[[], list[Any]]:
        """What evaluates the policies once; each run's own loss makes of it what it would alone."""
        steps = groups.select(*self.policy.in_keys, "action", MASK_KEY, strict=False).flatten(0, 1)
        log_prob = self.policy.log_prob(steps)
        parts = self._split(groups.select(*KEYS_OF_LOSSES, strict=False))
        handed = [
            part if member.loss_module.reads_steps else _summed(part)
            for member, part in zip(self.members, parts, strict=True)
        ]

        def evaluate() -> list[Any]:
            values = log_prob().view(groups.shape).chunk(len(parts))
            for part, given, value in zip(parts, handed, values, strict=True):
                own = value[..., : part.shape[-1]]
                own = own if given is part else own.where(part[MASK_KEY], 0).sum(-1, keepdim=True)
                given.set("log_prob", own)
            return [own.loss_module(part) for own, part in zip(self.members, handed, strict=True)]

        return evaluate

    def _split(self, groups: TensorDictBase) -> list[TensorDictBase]:
        """The batch of each run, without the padding that longer trajectories of others brought."""
        parts: Any = groups.chunk(len(self.members))
        return [part[..., : int(part[MASK_KEY].sum(-1).max())] for part in parts]

    def _step(self, member: Member, metrics: Metrics) -> None:
        """A gradient step of a run; all stop before one is spoilt."""
        max_norm = member.config.optim.max_grad_norm or float("inf")
        parameters = member.optimizer.param_groups[0]["params"]
        metrics["grad_norm"] = clip_grad_norm_(parameters, max_norm)
        try:
            member.run.check(metrics, self.progress.trajectories)
        except FloatingPointError as error:
            raise FloatingPointError(f"{member.run.name}: {error}") from error
        member.optimizer.step()


def _summed(groups: TensorDictBase) -> TensorDictBase:
    """Each trajectory as one step ``[G, K, 1]``, of what its steps add up to."""
    mask = groups[MASK_KEY]
    first = groups.select("action", GROUP_KEY)[..., :1]
    reward, log_prob = groups["next", "reward"], groups["action_log_prob"]
    first["next", "reward"] = reward.where(mask.unsqueeze(-1), 0).sum(-2, keepdim=True)
    return first.set("action_log_prob", log_prob.where(mask, 0).sum(-1, keepdim=True))


def _make_member(directory: Path, config: DictConfig, task: Task, **options: Any) -> Member:
    evaluated: Any = _Evaluated()
    loss_module = make_loss(config.loss, evaluated)
    directory.mkdir(exist_ok=True)
    return Member(
        config,
        task,
        loss_module,
        make_optimizer(config.optim, [*task.actor.parameters(), *loss_module.parameters()]),
        make_temperatures(config.loss, loss_module),
        make_run(config, task, directory=directory, **options),
    )


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
