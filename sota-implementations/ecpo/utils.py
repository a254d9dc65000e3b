"""What ``ecpo.py`` is built from beside the task: the collector, the loss, the temperatures."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf
from tasks import Metrics, Task
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from tqdm import tqdm

import torchrl_ecpo
from torchrl_ecpo import (
    ECPOLoss,
    MENTLoss,
    PMDLoss,
    TrajectoryGroupLoss,
    TrustPCLLoss,
    UREXLoss,
)
from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.experiment import Run
from torchrl_ecpo.experiment._tasks import is_plain
from torchrl_ecpo.experiment.options import parse
from torchrl_ecpo.schedules import TemperatureScheduler, make_schedule

LOSSES = {  # whose files in config/loss/ are older than the entry class
    "ecpo": ECPOLoss,
    "pmd": PMDLoss,
    "pmd_entropy": PMDLoss,
    "urex": UREXLoss,
    "ment": MENTLoss,
}
TEMPERATURES = ("tau", "tau_prime", "kl_to_ref_coeff")
ENDLESS = 10_000  # steps of a trajectory, unless the task has longer ones
COMPILABLE = ("bandit", "gym")
LEAST_ESS = 1.5
PUBLISHED = Path(__file__).parent / "config/setting/paper"
PATIENCE = 10  # batches running


def check_config(config: DictConfig, options: Sequence[str] = ()) -> None:
    """Refuse options that do not go together, with a line for each."""
    loss_class(config.loss)
    if config.env.kind == "gym":
        is_plain(config.env.name)
    if problems := [*_problems(config, options)]:
        raise ValueError("\n".join(problems))


def _problems(config: DictConfig, options: Sequence[str]) -> Iterator[str]:
    kind = config.env.kind
    given = {own.key_or_group: own.value() for own in parse(options)}
    own = f"{given.get('env', 'bandit')}/{given.get('loss', 'ecpo')}"  # or what config.yaml has
    if given.get("form") == "paper" and not (PUBLISHED / f"{own}.yaml").is_file():
        files = [*PUBLISHED.glob("*/*.yaml")]
        tasks = sorted({file.parent.name for file in files})
        losses = sorted({file.stem for file in files})
        yield (
            f"form=paper is for env= of {', '.join(tasks)} and loss= of {', '.join(losses)}; with "
            f"{own} it would change nothing. Leave out form."
        )
    if config.loss.get("delay_actor"):
        yield (
            "loss.delay_actor=true: the script moves no copy of the policy, which would stay as it "
            "began. Leave it out."
        )
    if config.compile and not (config.seeds is None and config.stack is None):
        yield (
            "compile=true is for single runs. Leave out compile, or seeds and stack: --multirun "
            "starts a process for each run."
        )
    if config.compile and kind not in COMPILABLE:
        yield (
            f"compile=true is for tasks of the kinds {COMPILABLE}, got env.kind={kind!r}, whose "
            "policy computes each distinct history once: how much that is differs from batch to "
            "batch. Leave out compile."
        )
    if "policy" in config and kind not in ("algorithmic", "gym"):
        yield (
            f"policy= is for the algorithmic tasks and env=popgym, got env.kind={kind!r}, which "
            "has a policy of its own. Leave out policy."
        )
    if kind == "gym" and "policy" in config and config.policy.tables:
        yield (
            "policy.tables=true is for the algorithmic tasks, got env.kind='gym'. Choose "
            "policy=window."
        )


class Watch:
    """Says in one line, once, that the weights or the entropy of a run are gone.

    Args:
        group_size: K.
        least_entropy: in nats a step.
    """

    def __init__(self, group_size: int, least_entropy: float) -> None:
        self.least_entropy = least_entropy
        self.batches = {"ESS": 0, "entropy": 0}
        self.lines = {
            "ESS": f"ESS stays below {LEAST_ESS} of {group_size}: an update rests on one "
            "trajectory of a group. A higher loss.tau spreads the weights.",
            "entropy": "The entropy is gone: the trajectories of a group hardly differ any more. "
            "If the return is not what it could be, raise loss.tau_prime or lower optim.lr.",
        }

    def __call__(self, metrics: Metrics) -> None:
        """Look at a batch."""
        is_low = {
            "ESS": metrics.get("ESS", LEAST_ESS) < LEAST_ESS,
            "entropy": metrics["entropy"] / metrics.get("length", 1.0) < self.least_entropy,
        }
        for name, line in list(self.lines.items()):
            self.batches[name] = self.batches[name] + 1 if is_low[name] else 0
            if self.batches[name] == PATIENCE:
                tqdm.write(line, file=sys.stderr)
                del self.lines[name]


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
        max_steps=max(ENDLESS, config.env.get("max_steps") or 0),
        # The loss computes them anew; they are most of a batch.
        exclude_keys=["logits", "loc", "scale", "parameters", "params"],
        **options,
    )
    collector.set_seed(config.seed)
    return collector


def is_single(config: DictConfig) -> bool:
    """Whether episodes are played in this process."""
    return config.collector.backend == "direct"


def make_loss(
    config: DictConfig,
    actor: TensorDictModuleBase,
    make_value_network: Callable[[], TensorDictModule] | None = None,
) -> TrajectoryGroupLoss:
    """The loss that ``loss=`` names; ``make_temperatures`` sets its temperatures."""
    apart = ("name", "class", *TEMPERATURES)
    options = {str(k): v for k, v in config.items() if k not in apart}
    if has_value_network(config):
        assert make_value_network is not None
        options["value_network"] = make_value_network()
    policy: Any = actor
    loss_module = loss_class(config)(policy, **options)
    head = policy[-1] if isinstance(actor, ProbabilisticTensorDictSequential) else None
    if head is not None and len(head.dist_sample_keys) > 1:
        names = {"action": head.dist_sample_keys, "sample_log_prob": head.log_prob_keys}
        loss_module.set_keys(**names)
    return loss_module


def has_value_network(config: DictConfig) -> bool:
    """Whether a loss learns values too."""
    return issubclass(loss_class(config), TrustPCLLoss)


def loss_class(config: DictConfig) -> type[TrajectoryGroupLoss]:
    """The one that ``loss.class`` names, here or by its import path; of the oldest, its name."""
    name = str(config.get("class"))
    found = LOSSES.get(config.name) or getattr(torchrl_ecpo, name, None)
    reason = ""
    if found is None and "." in name:
        try:
            found = get_class(name)
        except Exception as error:  # of Hydra or of the module itself
            reason = f": {error}"
    if not (isinstance(found, type) and issubclass(found, TrajectoryGroupLoss)):
        raise ValueError(
            "loss.class must be a loss over groups: one of torchrl_ecpo, such as GRPOLoss, or the "
            f"import path of another, such as mine.MyLoss, got {name!r}{reason}."
        )
    return found


def make_optimizer(
    config: DictConfig, parameters: Iterable[torch.nn.Parameter]
) -> torch.optim.Optimizer:
    """Adam."""
    return torch.optim.Adam(parameters, lr=config.lr, eps=config.eps, amsgrad=config.amsgrad)


def total_loss(losses: TensorDictBase, loss_module: TrajectoryGroupLoss) -> torch.Tensor:
    """The policy's and, where a temperature is learned, that of it."""
    return torch.stack([losses[name] for name in ("loss_actor", *loss_module.losses)]).sum()


def make_temperatures(config: DictConfig, loss_module: TrajectoryGroupLoss) -> TemperatureScheduler:
    """Schedules of the temperatures, counted in trajectories; they begin at once."""
    schedules = {name: make_schedule(config[name]) for name in TEMPERATURES if name in config}
    return TemperatureScheduler(loss_module, **schedules)


def is_far(of_steps: Sequence[Metrics], max_kl: float | None) -> bool:
    """Whether the gradient steps on a batch have led further from the reference than they may."""
    if max_kl is None or len(of_steps) < 2:
        return False
    return bool(of_steps[-1]["kl_reference_policy"] > max_kl)


def of_batch(of_steps: Sequence[Metrics]) -> Metrics:
    """The metrics of a batch, from those that the loss gave before each gradient step on it.

    They are those of the policy before the first one, and how far the last one found it.
    """
    last = {"kl_reference_policy": of_steps[-1]["kl_reference_policy"]}
    return {**of_steps[0], **last, "gradient_steps": sum("grad_norm" in step for step in of_steps)}


def reached(goal: DictConfig | None, metrics: Metrics) -> bool:
    """Whether a metric has come up to a goal, ``{metric: ..., at_least: ...}``; always for none."""
    if goal is None:
        return True
    if goal.metric not in metrics:
        raise KeyError(
            f"anneal_from.metric and stop_when.metric must be one of {sorted(metrics)}, which "
            f"every batch has, got {goal.metric!r}."
        )
    return bool(metrics[goal.metric] >= goal.at_least)


def check_goals(config: DictConfig, metrics: Metrics) -> None:
    """Refuse a goal whose metric a batch does not have, before anything of it is recorded."""
    for goal in (config.anneal_from, config.stop_when):
        reached(goal, metrics)


def held(goal: DictConfig | None, so_far: int, metrics: Metrics) -> int:
    """For how many batches in a row a metric has been up to a goal; once enough, always."""
    if goal is None or so_far >= goal.batches:
        return so_far
    return so_far + 1 if reached(goal, metrics) else 0


def goes_on(config: DictConfig, so_far: int) -> bool:
    """Whether there is still something to wait for."""
    return config.stop_when is None or so_far < config.stop_when.batches


def run_name(loss: str, seed: int, seeds: Any, stack: Any) -> str:
    """The directory of a run, or of stacked runs, whose options are yet to be checked."""
    if stack is not None:
        return "stack"
    if seeds is None:
        return f"{loss}/seed_{seed}"
    return f"{loss}/seeds_" + re.sub(r"\W+", "_", str(seeds)).strip("_")


OmegaConf.register_new_resolver("run_name", run_name, replace=True)
