"""Train ECPO, PMD, UREX or MENT on groups of trajectories: Algorithm 1 and its baselines.

``python ecpo.py env=bandit loss=ecpo seed=1``; every option is in ``config/``.
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from tasks import make_task
from utils import (
    check_config,
    make_collector,
    make_loss,
    make_optimizer,
    make_temperatures,
    reached,
)

from torchrl_ecpo.experiment import Checkpoints, Progress, Run


@hydra.main(version_base="1.3", config_path="config", config_name="config")
def main(config: DictConfig) -> None:
    check_config(config)
    checkpoints = Checkpoints(config)
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)

    task = make_task(config)
    collector = make_collector(config, task)
    loss_module = make_loss(config.loss, task.actor)
    temperatures = make_temperatures(config.loss, loss_module)
    optimizer = make_optimizer(config.optim, loss_module)
    max_grad_norm = config.optim.max_grad_norm or float("inf")

    groups_of_trajectories = iter(collector)
    progress = Progress(trajectories=0, project_steps=0, is_annealing=config.anneal_from is None)
    run = Run(
        config,
        total=config.total_trajectories,
        unit="trajectories",
        name=f"{config.env.name}/{config.loss.name}/seed_{config.seed}",
        shown=task.shown,
    )
    with (
        run,
        checkpoints.attach(
            run,
            progress,
            loss_module=loss_module,
            optimizer=optimizer,
            temperatures=temperatures,
            collector=collector,
            evaluation_env=task.evaluation_env,
        ),
    ):
        while progress.trajectories < config.total_trajectories:
            # Lift: the current policy becomes the reference.
            collector.update_policy_weights_()
            lifted_at = progress.trajectories
            for _ in range(config.project_steps):
                # Project: one gradient step on fresh trajectories of the reference.
                groups = next(groups_of_trajectories)
                losses = loss_module(groups)
                optimizer.zero_grad()
                losses["loss_actor"].backward()
                grad_norm = torch.nn.utils.clip_grad_norm_(loss_module.parameters(), max_grad_norm)
                metrics = {**losses.detach(), "grad_norm": grad_norm}
                run.check(metrics, progress.trajectories)
                optimizer.step()

                progress.trajectories += config.num_groups * config.group_size
                progress.project_steps += 1
                metrics |= {**task.measure(groups), **temperatures.values()}
                if progress.project_steps % config.evaluation_interval == 0:
                    metrics |= task.evaluate(groups)
                run.log(metrics, step=progress.trajectories)
            progress.is_annealing = progress.is_annealing or reached(config.anneal_from, metrics)
            if progress.is_annealing:
                temperatures.step(progress.trajectories - lifted_at)
            checkpoints.boundary()
    collector.shutdown()


if __name__ == "__main__":
    main()
