"""Collecting groups over gymnasium: one vector environment, `GroupedEnv`, and a bare loop.

    python benchmarks/groups.py --csv benchmarks/results/groups.csv

One process, one thread; the loops take turns, with one untrained network of two layers of 64 units.

- bare: gymnasium's vector environment, which resets by itself, and the network, on plain tensors;
  no groups, no TensorDict, the steps are put in lists.
- vector: `TrajectoryGroupCollector` over `make_grouped_env`.
- grouped: the same over `GroupedEnv`, which plays one copy after the other.

Figures are medians of steps per second of processor time, and medians of the ratios within a turn.
A step that only resets a copy does not count. The copies of a batch wait for the longest episode,
those of the bare loop for nothing: where episodes end at different times, as CartPole's do, that is
a part of what "vector" loses.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from common import read_arguments, write_csv
from gymnasium.vector import SyncVectorEnv, VectorEnv
from minigrid.wrappers import ImgObsWrapper
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.envs import EnvBase, GymWrapper
from torchrl.modules import MLP, ProbabilisticActor

from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.envs import GroupedEnv, make_grouped_env

GROUP_SIZE, LIMIT = 8, 100


def make_minigrid() -> gym.Env:
    return ImgObsWrapper(gym.make("MiniGrid-Empty-8x8-v0", max_steps=LIMIT))


class Task(NamedTuple):
    """What is played: an id or what makes a copy, and of how many copies."""

    env: str | Callable[[], gym.Env]
    num_groups: int


TASKS = {
    "Acrobot-v1": Task(partial(gym.make, "Acrobot-v1", max_episode_steps=LIMIT), 4),
    "MiniGrid-Empty-8x8-v0": Task(make_minigrid, 4),
    "CartPole-v1": Task("CartPole-v1", 4),
    "CartPole-v1, 400 copies": Task("CartPole-v1", 50),
}


class Network(nn.Module):
    """Logits of the actions, of observations of any shape."""

    def __init__(self, copy: gym.Env) -> None:
        super().__init__()
        space: Any = copy.action_space
        shape = copy.observation_space.shape or ()
        self.num_dims = len(shape)
        self.layers = MLP(int(np.prod(shape)), space.n, num_cells=[64, 64])

    def forward(self, observation: Tensor) -> Tensor:
        """Of ``[*B, *]``, ``[*B, n]``."""
        return self.layers(observation.flatten(-self.num_dims).float())


def play_collector(env: EnvBase, network: Network, num_groups: int) -> Callable[[], int]:
    """A function that collects a batch and returns the number of its steps."""
    (seen,) = {"observation", "pixels"}.intersection(env.observation_spec.keys())
    policy = ProbabilisticActor(
        TensorDictModule(network, [seen], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
        return_log_prob=True,
    )
    collector = TrajectoryGroupCollector(
        env, policy, num_groups=num_groups, group_size=GROUP_SIZE, exclude_keys=["logits"]
    )
    return lambda: int(collector.rollout()["collector", "mask"].sum())


@torch.no_grad()
def play_bare(env: VectorEnv, network: Network) -> int:
    """Play `LIMIT` steps in each copy and return how many of them were no resets."""
    steps, is_reset = [], np.zeros(env.num_envs, dtype=bool)
    seen, _ = env.reset(seed=0)
    count = 0
    for _ in range(LIMIT):
        observation = torch.from_numpy(seen)
        distribution = Categorical(logits=network(observation))
        action = distribution.sample()
        seen, reward, terminated, truncated, _ = env.step(action.numpy())
        steps.append((observation, action, distribution.log_prob(action), reward, terminated))
        count += env.num_envs - is_reset.sum()
        is_reset = terminated | truncated
    return int(count)


def measure(task: Task, turns: int) -> dict[str, float]:
    """Steps per second of the loops, and the ratios."""
    num_groups, num_copies = task.num_groups, task.num_groups * GROUP_SIZE
    make = partial(gym.make, task.env) if isinstance(task.env, str) else task.env
    network = Network(make())
    own: Any = (
        gym.make_vec(task.env, num_copies)
        if isinstance(task.env, str)
        else SyncVectorEnv([make] * num_copies)
    )
    sizes: Any = {"num_groups": num_groups, "group_size": GROUP_SIZE}
    copies = GroupedEnv(lambda: GymWrapper(make(), categorical_action_encoding=True), **sizes)
    loops = {
        "bare": partial(play_bare, own, network),
        "vector": play_collector(make_grouped_env(task.env, **sizes), network, num_groups),
        "grouped": play_collector(copies, network, num_groups),
    }
    speeds: dict[str, list[float]] = {name: [] for name in loops}
    for turn in range(turns + 1):  # the first one warms up
        for name, play in loops.items():
            start = time.process_time()
            count = play()
            if turn:
                speeds[name].append(count / (time.process_time() - start))
    bare, vector, grouped = speeds.values()
    return {f"{name}_steps_per_second": round(median(own)) for name, own in speeds.items()} | {
        "vector_over_bare": median(a / b for a, b in zip(vector, bare, strict=True)),
        "vector_over_grouped": median(a / b for a, b in zip(vector, grouped, strict=True)),
    }


def main() -> None:
    arguments = read_arguments(__doc__, turns=5)
    torch.manual_seed(0)
    rows: list[dict[str, Any]] = []
    print(f"{'':24} {'bare':>9} {'vector':>9} {'grouped':>9}  v / bare  v / grouped")
    for name, task in TASKS.items():
        measured = measure(task, arguments.turns)
        copies = task.num_groups * GROUP_SIZE
        rows.append({"task": name.partition(",")[0], "copies": copies, **measured})
        bare, vector, grouped, over_bare, over_grouped = measured.values()
        print(
            f"{name:24} {bare:9,} {vector:9,} {grouped:9,}  {over_bare:8.2f}  {over_grouped:11.1f}",
            flush=True,
        )
    write_csv(arguments.csv, rows)


if __name__ == "__main__":
    main()
