"""Show how the policy of a run plays: ``python play.py runs/reverse/ecpo/seed_1/<time>``.

It prints the returns of greedy episodes, and draws the first one where the task can be drawn. Of an
algorithmic task it prints the episodes, a column for each step: what the policy reads, where it
moves, what it writes; ``-`` is a blank.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from stacked.policies import stack_policies
from tasks import Task, greedy, is_solved, make_single, make_task
from torchrl.checkpoint import CheckpointError
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.modules import get_env_transforms_from_module
from utils import make_loss

from torchrl_ecpo.checks import check_count
from torchrl_ecpo.envs import AlgorithmicEnv
from torchrl_ecpo.experiment import restore_part
from torchrl_ecpo.experiment._videos import show

MOVES = "<>^v"


def load_run(directory: Path) -> tuple[DictConfig, Task]:
    """The configuration and the task of a run, alone or one of a stack, with its trained policy.

    Raises:
        FileNotFoundError: if the directory is not that of a run.
        ValueError: if it is that of a run of another script.
        CheckpointError: if the run has no checkpoint, or a damaged one.
    """
    config: Any = OmegaConf.load(directory / "config.yaml")
    if not {"total_trajectories", "collector"} <= config.keys():
        raise ValueError(f"{directory} is no run of ecpo.py.")
    if (directory / "checkpoints").is_dir():
        task = make_task(config)
        restore_part(
            directory, "loss_module", make_loss(config.loss, task.actor, task.make_value_network)
        )
        return config, task
    tasks = [make_task(config) for _ in directory.parent.glob("*/config.yaml")]
    states = [torch.get_rng_state()] * len(tasks)
    stack = stack_policies([task.actor for task in tasks], states)
    seeds = restore_part(directory.parent, "policy", stack)["seeds"]
    of_run = int(directory.name.rpartition("_")[2]) if seeds is None else seeds.index(config.seed)
    return config, tasks[of_run]


def episodes(config: DictConfig, task: Task, level: int, count: int) -> Iterator[str]:
    """Greedy episodes of an algorithmic task, in words."""
    env = AlgorithmicEnv(
        config.env.name, num_groups=count, min_length=level, curriculum=None, seed=config.seed
    )
    played: Any = greedy(
        TransformedEnv(env, get_env_transforms_from_module(task.actor)), task.actor
    )
    symbols = "".join(map(str, range(env.task.base))) + "-"
    for episode, solved in zip(played[:, 0], is_solved(played).flatten(), strict=True):
        end = int(episode["next", "done"].squeeze(-1).int().argmax()) + 1
        yield "\n".join(_tracks(episode[:end], symbols, bool(solved)))


def _tracks(episode: Any, symbols: str, solved: bool) -> Iterator[str]:
    earned, best = episode["next", "reward"].sum().item(), episode["attainable"][0].item()
    yield f"return {earned:g} of {best:g}{', solved' * solved}"
    yield "reads   " + "".join(symbols[i] for i in episode["observation"].tolist())
    moves, writes, characters = episode["action"].unbind(-1)
    yield "moves   " + "".join(MOVES[i] for i in moves.tolist())
    written = zip(writes.tolist(), characters.tolist(), strict=True)
    yield "writes  " + "".join(symbols[i] if write else " " for write, i in written).rstrip()


def main(arguments: Sequence[str] | None = None) -> None:
    """Play, and say what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path, help="directory of a run")
    parser.add_argument("--level", type=int, default=10, help="of an algorithmic task; default 10")
    parser.add_argument("--episodes", type=int, default=2, help="default 2")
    options = parser.parse_args(arguments)
    try:
        check_count("--level", options.level)
        check_count("--episodes", options.episodes)
        config, task = load_run(options.run.resolve())
        if config.env.kind == "algorithmic":
            print("\n\n".join(episodes(config, task, options.level, options.episodes)))
        elif config.env.kind == "gym":
            directory = options.run.resolve()

            def make(**pixels: Any) -> EnvBase:
                transforms = get_env_transforms_from_module(task.actor)
                return TransformedEnv(make_single(config, **pixels), transforms, auto_unwrap=False)

            show(make, task.actor, options.episodes, directory, config.env.name)
        else:  # one problem instance, in which greedy episodes are all alike
            played: Any = greedy(task.env, task.actor)[0, 0]
            print(f"return {played['next', 'reward'].sum().item():g}")
    except (CheckpointError, FileNotFoundError, ValueError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
