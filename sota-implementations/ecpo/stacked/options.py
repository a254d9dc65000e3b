"""Which runs are asked for, and whether they go together."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from utils import check_config, has_value_network

from torchrl_ecpo.experiment.options import compose_options, expand, flatten, parse

FOLDER = Path(__file__).parents[1]
KINDS = ("algorithmic", "bandit")
OF_ALL = ("seeds", "stack", "resume", "checkpoint", "compile", "threads", "hydra")
MAY_DIFFER = (
    *("seed", "loss", "optim", "project_steps", "epochs", "max_kl"),
    *("anneal_from", "stop_when", "evaluation", "env.curriculum", "env.instance_seed"),
)


def check_runs(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a run, or stacked ones, whose options do not go together."""
    check_config(config, overrides)
    if config.seeds is not None or config.stack is not None:
        runs_of(config, overrides)


def runs_of(config: DictConfig, overrides: Sequence[str]) -> dict[str, DictConfig]:
    """The configuration of each run, as it would be alone, by the name of its directory.

    Args:
        config: with ``seeds`` or ``stack``.
        overrides: the command line that it is composed of.

    Raises:
        ValueError: for runs that cannot be stacked; the message names the option.
    """
    shared = {own.key_or_group: str(own.input_line) for own in parse(overrides)}
    shared = {name: line for name, line in shared.items() if name not in ("seeds", "stack")}
    runs = []
    for options in _asked_for(config):
        own = {override.key_or_group: str(override.input_line) for override in parse(options)}
        lines = list({**shared, **own}.values())
        runs.append(compose_options(FOLDER, lines))
        check_config(runs[-1], lines)
    _check_together(runs)
    if config.stack is None:
        return {f"seed_{run.seed}": run for run in runs}
    return {f"run_{index}": run for index, run in enumerate(runs)}


def _asked_for(config: DictConfig) -> list[list[str]]:
    """The options of each run that are not those of all."""
    seeds, stack = config.seeds, config.stack
    if None not in (seeds, stack):
        raise ValueError("Give seeds or stack, not both: stack=['loss=urex seed=0,1'] has seeds.")
    if stack is None:
        if not _is_list(seeds, int) or len({*seeds}) < len(seeds):
            raise ValueError(
                "seeds must be a list of different integers, such as seeds=[0,1,2], or null for a "
                f"single run with seed=, got {seeds!r}."
            )
        return [[f"seed={seed}"] for seed in seeds]
    if not _is_list(stack, str):
        raise ValueError(
            "stack must be a list of options, such as stack=['loss=ecpo seed=0,1','loss=urex'], or "
            f"null for a single run, got {stack!r}."
        )
    runs = [run for entry in stack for run in expand(shlex.split(entry))]
    for run in runs:
        for own in parse(run):
            if own.key_or_group.split(".")[0] in OF_ALL:
                raise ValueError(
                    f"stack: {own.input_line} is for all runs together, got it in "
                    f"{' '.join(run)!r}. Give it beside stack; several seeds of one are seed=0,1."
                )
    twice = [" ".join(run) for run in runs if runs.count(run) > 1]
    if twice:
        raise ValueError(f"stack: {twice[0]!r} is there twice.")
    return runs


def _is_list(value: Any, kind: type) -> bool:
    is_list = isinstance(value, ListConfig) and len(value) > 0
    return is_list and all(type(item) is kind for item in value)


def _check_together(runs: Sequence[DictConfig]) -> None:
    """Refuse runs that cannot share a collector."""
    first = runs[0]
    if first.collector.backend != "direct":
        raise ValueError(
            "Stacked runs are played in one process, with collector=single, got "
            f"collector.backend={first.collector.backend!r}."
        )
    if first.env.kind not in KINDS:
        raise ValueError(
            f"Tasks of the kinds {KINDS} can be stacked, got env.kind={first.env.kind!r}. Start "
            "processes instead: --multirun seed=0,1"
        )
    if any(has_value_network(run.loss) for run in runs):
        raise ValueError(
            "A loss with a value network, such as loss=trust_pcl, cannot be stacked. Start "
            "processes instead: --multirun seed=0,1"
        )
    flat = [flatten(OmegaConf.to_container(run, resolve=True)) for run in runs]
    for name in dict.fromkeys(["env.name", *(name for own in flat for name in own)]):
        values = list(dict.fromkeys(str(own.get(name, "absent")) for own in flat))
        if len(values) > 1 and not any(f"{name}.".startswith(f"{one}.") for one in MAY_DIFFER):
            raise ValueError(
                f"Stacked runs must agree in {name}, got {' and '.join(values)}. They may differ "
                f"in {', '.join(MAY_DIFFER)}."
            )
