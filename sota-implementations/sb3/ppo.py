"""PPO of Stable-Baselines3 on the tasks of exploration: the outside reference of the study.

On ``env=popgym`` it is sb3-contrib's ``RecurrentPPO``, whose policy has an LSTM.

``python ppo.py env=deep_sea seed=1`` with the extra ``bench``. It leaves the files of a run of
``ecpo.py``; one that is stopped begins anew.
"""

from __future__ import annotations

import sys
from functools import partial
from typing import Any

from torchrl_ecpo.experiment.options import check_command_line

if __name__ == "__main__":  # before torch is imported, which takes seconds
    check_command_line(__file__)

import gymnasium as gym
import hydra
import numpy as np
import torch
from omegaconf import DictConfig
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import Tensor, nn

from torchrl_ecpo.envs import DeepSeaEnv, readable
from torchrl_ecpo.experiment import Run, leaving_nothing, refuse_resume

LEAST_ENTROPY = 0.1  # nats an episode


class DeepSea(gym.Env):
    """An instance of ``DeepSeaEnv`` for a single diver."""

    def __init__(self, size: int, instance_seed: int) -> None:
        self.right = DeepSeaEnv(size, instance_seed=instance_seed).right.tolist()
        self.size, self.cell = size, 0
        self.observation_space = gym.spaces.Discrete(size**2 + 1)
        self.action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[int, dict]:
        """To the upper left."""
        self.cell = 0
        return self.cell, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict]:
        """One row down, to the left or the right."""
        row, column = divmod(self.cell, self.size)
        is_right = action == self.right[self.cell]
        reward = is_right * ((column == self.size - 1) - 0.01 / self.size)
        column = min(max(column + (1 if is_right else -1), 0), self.size - 1)
        self.cell = min(self.size * (row + 1) + column, self.size**2)
        return self.cell, reward, self.cell == self.size**2, False, {}


class EpisodeLstmPolicy(RecurrentActorCriticPolicy):
    """sb3-contrib's, which steps through its LSTM wherever an episode begins: here in one call.

    A sequence of its buffer begins with the episode, and holds no second one.
    """

    @staticmethod
    def _process_sequence(
        features: Tensor,
        lstm_states: tuple[Tensor, Tensor],
        episode_starts: Tensor,
        lstm: nn.LSTM,
    ) -> tuple[Tensor, Any]:
        starts = episode_starts.reshape(lstm_states[0].shape[1], -1)
        if not starts[:, 1:].any():
            hidden, cell = ((1 - starts[:, 0]).view(1, -1, 1) * state for state in lstm_states)
            lstm_states, episode_starts = (hidden, cell), torch.zeros_like(episode_starts)
        own = RecurrentActorCriticPolicy
        return own._process_sequence(features, lstm_states, episode_starts, lstm)


class Record(BaseCallback):
    """Logs every so many episodes what ``ecpo.py`` logs of a batch."""

    def __init__(self, run: Run, config: DictConfig) -> None:
        super().__init__()
        self.run, self.config = run, config
        self.episodes: list[tuple[float, int]] = []
        self.surprise: float | None = None  # of a step, in nats
        self.held = 0  # rows that the entropy has been gone

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        self.surprise = -float(model.rollout_buffer.log_probs.mean())

    def _on_step(self) -> bool:
        ends = [info["episode"] for info in self.locals["infos"] if "episode" in info]
        self.episodes += [(end["r"], end["l"]) for end in ends]
        interval, stop = self.config.log_interval, self.config.stop_when
        if len(self.episodes) >= interval:
            returns, lengths = np.array(self.episodes[:interval]).T
            del self.episodes[:interval]
            metrics = {"return": returns.mean(), "length": lengths.mean()}
            metrics["pass_at_1"] = (returns >= self.config.env.solved).mean()
            if self.surprise is not None:
                metrics["entropy"] = self.surprise * lengths.mean()
            self.run.log(metrics, step=self.run.step + interval)
            is_gone = metrics.get("entropy", np.inf) < LEAST_ENTROPY
            self.held = self.held + 1 if is_gone else 0
        is_over = stop is not None and self.held >= stop.batches
        return self.run.step < self.config.total_trajectories and not is_over


def make_env(config: DictConfig) -> gym.Env:
    """One copy, with the return and the length of each episode."""
    own = config.env
    if own.name == "deep_sea":
        env: gym.Env = DeepSea(own.size, own.instance_seed)
    else:
        env = gym.make(own.name, max_episode_steps=own.max_steps, disable_env_checker=True)
    return Monitor(readable(env))


@hydra.main(version_base="1.3", config_path="config", config_name="config")
@leaving_nothing
def main(config: DictConfig) -> None:
    refuse_resume(config)
    torch.set_num_threads(1)
    envs: Any = DummyVecEnv([partial(make_env, config)] * config.n_envs)
    if config.normalize:
        envs = VecNormalize(envs, gamma=config.ppo.gamma)
    is_recurrent = config.get("recurrent", False)  # of env=popgym alone
    method, policy = (RecurrentPPO, EpisodeLstmPolicy) if is_recurrent else (PPO, "MlpPolicy")
    model = method(policy, envs, seed=config.seed, device="cpu", **config.ppo)
    run = Run(
        config,
        total=config.total_trajectories,
        unit="trajectories",
        name=f"{config.env.name}/ppo/seed_{config.seed}",
        shown=("return", "pass_at_1", "entropy"),
    )
    with run:
        model.learn(sys.maxsize, callback=Record(run, config))


if __name__ == "__main__":
    main()
