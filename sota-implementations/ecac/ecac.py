"""Train ECAC, PMD-AC, SAC, TD3 or DDPG on continuous control.

``python ecac.py env=halfcheetah loss=ecac seed=1``; every option is in ``config/``.
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from utils import (
    SHOWN,
    Every,
    Speed,
    check_config,
    evaluate,
    finished_returns,
    make_actor,
    make_collector,
    make_environment,
    make_loss,
    make_optimizer,
    make_policy,
    make_replay_buffer,
    make_temperatures,
    make_updater,
    mean,
    scalars,
)

from torchrl_ecpo.experiment import Run


def step(optimizer: torch.optim.Optimizer, losses: TensorDictBase, is_policy_due: bool) -> None:
    """One gradient step on the sum of the losses, each of which reaches its own parameters only."""
    trained = [
        loss
        for name, loss in losses.items()
        if name.startswith("loss_") and (is_policy_due or name != "loss_actor")
    ]
    torch.stack(trained).sum().backward()
    optimizer.step()
    optimizer.zero_grad()


@hydra.main(version_base="1.3", config_path="config", config_name="config")
def main(config: DictConfig) -> None:
    check_config(config)
    torch.set_num_threads(config.threads)

    evaluation_env = make_environment(config, seed=config.seed + 1_000_000, is_evaluation=True)
    torch.manual_seed(config.seed)
    actor = make_actor(config, evaluation_env)
    loss_module = make_loss(config, actor, evaluation_env)
    temperatures = make_temperatures(config.loss, loss_module)
    updater = make_updater(config, loss_module)
    optimizer = make_optimizer(config.loss.lr, loss_module)
    replay_buffer = make_replay_buffer(config)
    collector = make_collector(config, make_policy(config.loss, actor, evaluation_env))

    frames = updates = 0
    losses = TensorDict()
    returns: list[float] = []
    is_log_due, is_evaluation_due = Every(config.log_interval), Every(config.evaluation.interval)
    speed = Speed()
    with Run(
        config,
        total=config.total_frames,
        unit="frames",
        name=f"{config.env.title}/{config.loss.name}/seed_{config.seed}",
        shown=SHOWN,
    ) as run:
        for batch in collector:
            transitions = batch.reshape(-1)
            frames += len(transitions)
            returns += finished_returns(transitions)
            replay_buffer.extend(transitions.select(*loss_module.in_keys, strict=False))

            if frames > config.collector.init_random_frames:
                for _ in range(len(transitions) * config.updates_per_frame):
                    updates += 1
                    is_policy_due = updates % config.loss.policy_delay == 0
                    losses = loss_module(replay_buffer.sample())
                    step(optimizer, losses, is_policy_due)
                    if is_policy_due:
                        updater.step()
                temperatures.step(len(transitions))
                collector.update_policy_weights_()

            if is_log_due(frames):
                metrics = {"return": mean(returns), "steps_per_second": speed(frames)}
                returns.clear()
                if is_evaluation_due(frames):
                    metrics |= evaluate(evaluation_env, actor, config.evaluation, frames)
                    speed(frames)  # evaluation does not count
                run.log({**scalars(losses), **metrics}, step=frames)
    collector.shutdown()


if __name__ == "__main__":
    main()
