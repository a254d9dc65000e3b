"""Updates of ECAC against SAC, and the script's training loop against Stable-Baselines3's SAC.

    python benchmarks/actor_critic.py --csv actor_critic.csv

One thread, one process; what is compared takes turns. Networks, losses, buffer and collector are
those of `sota-implementations/ecac` with its defaults: two layers of 256 units, batches of 256,
HalfCheetah-v5. Figures are medians of processor time, which other processes disturb least.

- update: the loss, its backward pass, Adam and the average of the delayed networks, on random data;
  ECACLoss against TorchRL's SACLoss.
- loop: all that a frame takes, environment, buffer and update, against Stable-Baselines3's
  `SAC("MlpPolicy", "HalfCheetah-v5")`, whose networks and batches are of the same size.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from common import read_arguments, write_csv
from loop import Iteration, take_turns
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import LossModule, TargetNetUpdater

from torchrl_ecpo.experiment import compose_options

SCRIPT = Path(__file__).resolve().parents[1] / "sota-implementations/ecac"
sys.path.append(str(SCRIPT))

from ecac import descend, total  # noqa: E402 # pyright: ignore[reportMissingImports]
from utils import (  # noqa: E402 # pyright: ignore[reportMissingImports]
    compile_parts,
    make_actor,
    make_collector,
    make_environment,
    make_loss,
    make_optimizer,
    make_policy,
    make_replay_buffer,
    make_updater,
)

UPDATES = {
    "sac": ["loss=sac"],
    "ecac, M = 8": ["loss=ecac"],
    "ecac, M = 16": ["loss=ecac", "loss.num_action_samples=16"],
}
LOOPS = {
    "sac": ["loss=sac"],
    "ecac": ["loss=ecac"],
    "ecac, compiled": ["loss=ecac", "compile=true"],
}

# Made in a turn
NUM_UPDATES = 10
FRAMES = 200


def configure(overrides: list[str]) -> DictConfig:
    """The script's configuration."""
    frames = ["total_frames=1000000000", "collector.init_random_frames=0"]
    return compose_options(SCRIPT, ["env=halfcheetah", *frames, *overrides])


class Parts(NamedTuple):
    """What the script makes from its configuration to train."""

    env: EnvBase
    actor: ProbabilisticActor
    loss_module: LossModule
    updater: TargetNetUpdater
    optimizer: torch.optim.Optimizer


def make_parts(config: DictConfig) -> Parts:
    """The script's parts, with the same weights each time."""
    env = make_environment(config, seed=0)
    torch.manual_seed(0)
    actor = make_actor(config, env)
    loss_module = make_loss(config, actor, env)
    updater = make_updater(config, loss_module)
    compile_parts(config, loss_module, actor)
    return Parts(env, actor, loss_module, updater, make_optimizer(config.optim, loss_module))


def make_data(config: DictConfig, parts: Parts) -> tuple[ReplayBuffer, Iterator[TensorDictBase]]:
    """The script's buffer, empty, and what its collector yields."""
    policy = make_policy(config.loss, parts.actor, parts.env)
    return make_replay_buffer(config), iter(make_collector(config, policy))


def random_batch(env_batch: TensorDictBase, size: int) -> TensorDict:
    """Transitions like those of an environment, but random and none the last."""
    observation, action = (env_batch[key].shape[-1] for key in ("observation", "action"))
    never = torch.zeros(size, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": torch.randn(size, observation),
            "action": torch.rand(size, action) * 2 - 1,
            "next": {
                "observation": torch.randn(size, observation),
                "reward": torch.randn(size, 1),
                "done": never,
                "terminated": never.clone(),
            },
        },
        batch_size=[size],
    )


def step(optimizer: torch.optim.Optimizer, losses: TensorDictBase) -> None:
    """The script's gradient step."""
    descend(total(losses, is_policy_due=True), optimizer)


def update(config: DictConfig) -> Iteration:
    """Updates on one random batch, of which the loss gets a fresh copy as from a buffer."""
    env, _, loss_module, updater, optimizer = make_parts(config)
    batch = random_batch(env.fake_tensordict(), config.replay_buffer.batch_size)
    batch = batch.select(*loss_module.in_keys)

    def iterate() -> int:
        for _ in range(NUM_UPDATES):
            step(optimizer, loss_module(batch.copy()))
            updater.step()
        return NUM_UPDATES

    return iterate


def script_loop(config: DictConfig) -> Iteration:
    """Batches of the collector, and an update for each of their frames."""
    parts = make_parts(config)
    _, _, loss_module, updater, optimizer = parts
    replay_buffer, batches = make_data(config, parts)

    def iterate() -> int:
        frames = 0
        while frames < FRAMES:
            transitions = next(batches)
            frames += len(transitions)
            replay_buffer.extend(transitions.select(*loss_module.in_keys, strict=False))
            for _ in range(len(transitions)):
                step(optimizer, loss_module(replay_buffer.sample()))
                updater.step()
        return frames

    return iterate


def peer_loop() -> Iteration:
    """As many frames of Stable-Baselines3's SAC."""
    try:
        from stable_baselines3 import SAC  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        message = "The peer is not installed: pip install '.[bench]' in the repository."
        raise ModuleNotFoundError(message) from error

    model = SAC("MlpPolicy", "HalfCheetah-v5", learning_starts=0, device="cpu", seed=0)
    model.learn(1)

    def iterate() -> int:
        model.learn(FRAMES, reset_num_timesteps=False)
        return FRAMES

    return iterate


def compare(kind: str, iterations: dict[str, Iteration], repeats: int) -> list[dict[str, object]]:
    """Rows of the table: the time of a step of each, and relative to the first."""
    processor, _, steps = take_turns(list(iterations.values()), repeats)
    times = [time / count for time, count in zip(processor, steps, strict=True)]
    return [
        {"what": kind, "method": name, "ms": ms, "time": ms / times[0], "speed": times[0] / ms}
        for name, ms in zip(iterations, times, strict=True)
    ]


def main() -> None:
    arguments = read_arguments(__doc__, repeats=10)
    peer = peer_loop()
    updates = {name: update(configure(overrides)) for name, overrides in UPDATES.items()}
    rows = compare("update", updates, arguments.repeats)
    loops = {name: script_loop(configure(overrides)) for name, overrides in LOOPS.items()}
    loops = {"Stable-Baselines3 SAC": peer, **loops}
    rows += compare("loop", loops, arguments.repeats)
    print("what    method                   ms a step  time ratio  speed ratio")
    for row in rows:
        print("{what:8}{method:24}{ms:10.2f}{time:12.2f}{speed:13.2f}".format(**row))
    write_csv(arguments.csv, rows)


if __name__ == "__main__":
    main()
