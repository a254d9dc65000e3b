"""Steps per second of the batched Reverse against a Python environment for each episode.

    python benchmarks/environments.py --copies 8 16

Both sides are rolled out by TorchRL, `env.rollout`, with random actions, drawn in one call for all
rows; an episode that ends is followed by the next one, so every row steps every time. The Python
form is a `gymnasium.Env`, in `GymWrapper`, in a `SerialEnv` of so many copies; the batched one is
`AlgorithmicEnv` with 40 groups of 10. One thread; the environments take turns; medians of processor
time.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from common import read_arguments, write_csv
from gymnasium.spaces import Discrete, MultiDiscrete
from loop import take_turns
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, GymWrapper, SerialEnv

from torchrl_ecpo.envs import AlgorithmicEnv

NUM_GROUPS, GROUP_SIZE = 40, 10
BASE = BLANK = 2
NVEC = (2, 2, BASE)
RIGHT = 1


class Reverse(gymnasium.Env):
    """One episode of Reverse at a time, by the rules of gym's algorithmic suite."""

    observation_space = Discrete(BASE + 1)
    action_space = MultiDiscrete(list(NVEC))

    def __init__(self, min_length: int) -> None:
        self.min_length = min_length

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Draw a tape; the target is what stands on it, backwards."""
        super().reset(seed=seed)
        length = self.min_length + int(self.np_random.integers(3))
        self.tape = self.np_random.integers(BASE, size=length).tolist()
        self.target = self.tape[::-1]
        self.time_limit = 2 * length + 4
        self.head = self.written = self.clock = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[int, float, bool, bool, dict[str, Any]]:
        """Move the head and, if told to, write a character."""
        move, write, character = action.tolist()
        self.clock += 1
        reward, done = 0.0, False
        if write:
            if character == self.target[self.written]:
                self.written += 1
                reward, done = 1.0, self.written == len(self.target)
            else:
                reward, done = -0.5, True
        self.head += 1 if move == RIGHT else -1
        if self.clock > self.time_limit:
            reward, done = -1.0, True
        return self._observe(), reward, done, False, {}

    def _observe(self) -> int:
        return self.tape[self.head] if 0 <= self.head < len(self.tape) else BLANK


def make_python(copies: int, min_length: int) -> EnvBase:
    """`copies` Python environments."""

    def make_copy() -> EnvBase:
        return GymWrapper(Reverse(min_length), categorical_action_encoding=True)

    return SerialEnv(copies, make_copy)


def act(tensordict: TensorDictBase) -> TensorDictBase:
    """Draw legal actions at once; `env.rand_action` draws those of each row by themselves."""
    uniform = torch.rand(*tensordict.shape, len(NVEC))
    return tensordict.set("action", (uniform * torch.tensor(NVEC)).long())


def play(env: EnvBase, num_steps: int) -> int:
    """Roll out; how many steps of single episodes."""
    return env.rollout(num_steps, act, break_when_any_done=False).numel()


def main() -> None:
    arguments = read_arguments(__doc__, copies=[8, 16], min_length=10, steps=100, repeats=7)
    torch.manual_seed(0)
    batched = AlgorithmicEnv(
        "reverse",
        min_length=arguments.min_length,
        curriculum=None,
        num_groups=NUM_GROUPS,
        group_size=GROUP_SIZE,
    )
    envs: dict[str, EnvBase] = {f"AlgorithmicEnv, {batched.numel()} episodes": batched}
    for copies in arguments.copies:
        envs[f"SerialEnv of {copies} GymWrapper"] = make_python(copies, arguments.min_length)
    loops = [partial(play, env, arguments.steps) for env in envs.values()]
    processor, _, steps = take_turns(loops, arguments.repeats)
    medians = {name: ms / 1e3 / n for name, ms, n in zip(envs, processor, steps, strict=True)}
    fastest = next(iter(medians.values()))
    print(f"{'':32} {'steps/s':>9}  {'batched is':>10}")
    for name, taken in medians.items():
        print(f"{name:32} {1 / taken:9,.0f}  {taken / fastest:9.1f}x")
    write_csv(
        arguments.csv,
        [
            {
                "environment": name,
                "steps_per_second": round(1 / taken),
                "batched_is_times_as_fast": taken / fastest,
            }
            for name, taken in medians.items()
        ],
    )


if __name__ == "__main__":
    main()
