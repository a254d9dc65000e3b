"""PPO and DQN of Stable-Baselines3: the outside reference of the study.

On ``env=popgym`` PPO is sb3-contrib's ``RecurrentPPO``, whose policy has an LSTM.

``python sb3.py env=cartpole method=dqn seed=1`` with the extra ``bench``. It leaves the files of a
run of ``ecpo.py``, or of ``ecac.py`` where the length counts in frames; one that is stopped begins
anew.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from typing import Any

from torchrl_ecpo.experiment.options import check_command_line

if __name__ == "__main__":  # before torch is imported, which takes seconds
    check_command_line(__file__)

import gymnasium as gym
import hydra
import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import Tensor, nn

from torchrl_ecpo.envs import DeepSeaEnv, readable
from torchrl_ecpo.experiment import Run, leaving_nothing, refuse_resume
from torchrl_ecpo.experiment._tasks import open_task

LEAST_ENTROPY = 0.1  # nats, in the unit of its column


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
    """Logs every so many episodes or frames what scripts of ours log.

    The entropy is that of an episode, or of an action where the length counts in frames.
    """

    def __init__(self, run: Run, config: DictConfig, unit: str) -> None:
        super().__init__()
        self.run, self.config, self.unit = run, config, unit
        self.total = config[f"total_{unit}"]
        self.episodes: list[tuple[float, int]] = []  # return and length
        self.surprise: float | None = None  # of a step, in nats
        self.held = 0  # rows that the entropy has been gone

    def _on_rollout_end(self) -> None:
        if isinstance(self.model, OnPolicyAlgorithm):
            self.surprise = -float(self.model.rollout_buffer.log_probs.mean())

    def _on_step(self) -> bool:
        ends = [info["episode"] for info in self.locals["infos"] if "episode" in info]
        self.episodes += [(end["r"], end["l"]) for end in ends]
        interval, stop = self.config.log_interval, self.config.stop_when
        if self.unit == "frames":  # of which a step has one for each copy, perhaps several rows
            whole, rows = (self.num_timesteps - self.run.step) // interval, len(self.episodes)
        else:
            whole, rows = int(len(self.episodes) >= interval), interval
        if whole:
            metrics = self.measured(self.episodes[:rows])
            del self.episodes[:rows]
            self.run.log(metrics, step=self.run.step + whole * interval)
            is_gone = metrics.get("entropy", np.inf) < LEAST_ENTROPY
            self.held = self.held + 1 if is_gone else 0
        is_over = stop is not None and self.held >= stop.batches
        return self.run.step < self.total and not is_over

    def measured(self, episodes: list[tuple[float, int]]) -> dict[str, float]:
        """Of episodes; nothing but the name where none has ended."""
        if not episodes:
            return {"return": np.nan}
        returns, lengths = np.array(episodes).T
        metrics = {"return": returns.mean(), "length": lengths.mean()}
        if "solved" in self.config.env:
            metrics["pass_at_1"] = (returns >= self.config.env.solved).mean()
        if self.surprise is not None:
            actions = 1.0 if self.unit == "frames" else lengths.mean()
            metrics["entropy"] = self.surprise * actions
        return metrics


def make_env(config: DictConfig) -> gym.Env:
    """One copy, with the return and the length of each episode."""
    own = config.env
    if own.name == "deep_sea":
        return Monitor(readable(DeepSea(own.size, own.instance_seed)))
    return Monitor(open_task(own.name, max_episode_steps=own.max_steps))


def check_config(config: DictConfig, options: Sequence[str] = ()) -> None:
    """Refuse a task that cannot be made, and one that does not go with DQN."""
    with closing(make_env(config)) as env:
        actions = env.action_space
    if config.method.name != "dqn":
        return
    if "total_frames" not in config:
        raise ValueError(
            "method=dqn explores less and less over total_frames, which env.name="
            f"{config.env.name} has not: take a task that counts frames, or method=ppo."
        )
    if not isinstance(actions, gym.spaces.Discrete):
        raise ValueError(
            f"method=dqn chooses one of several actions, got env.name={config.env.name}, whose "
            f"actions are {type(actions).__name__}: take method=ppo."
        )


def make_model(config: DictConfig) -> BaseAlgorithm:
    """The method, with its settings of this task."""
    name = config.method.name
    envs: Any = DummyVecEnv([partial(make_env, config)] * config.n_envs)
    settings: Any = OmegaConf.to_container(config[name], resolve=True)
    if config.normalize:
        envs = VecNormalize(envs, gamma=settings["gamma"])
    for falling in config.get("linear", ()):  # of some settings alone
        settings[falling] = LinearSchedule(settings[falling], 0.0, end_fraction=1.0)
    policy: Any = "MlpPolicy"
    method: Any = {"ppo": PPO, "dqn": DQN}[name]
    if config.get("recurrent", False):  # of env=popgym alone
        method, policy = RecurrentPPO, EpisodeLstmPolicy
    return method(policy, envs, seed=config.seed, device="cpu", **settings)


@hydra.main(version_base="1.3", config_path="config", config_name="config")
@leaving_nothing
def main(config: DictConfig) -> None:
    refuse_resume(config)
    torch.set_num_threads(1)
    unit = "frames" if "total_frames" in config else "trajectories"
    model = make_model(config)
    total = config[f"total_{unit}"]
    run = Run(
        config,
        total=total,
        unit=unit,
        name=f"{config.env.name}/{config.method.name}/seed_{config.seed}",
        shown=("return", "pass_at_1", "entropy"),
    )
    with run:
        whole_rows = -(-total // config.log_interval) * config.log_interval
        steps = whole_rows if unit == "frames" else sys.maxsize
        model.learn(steps, callback=Record(run, config, unit))


if __name__ == "__main__":
    check_command_line(__file__, check_config)
    main()
