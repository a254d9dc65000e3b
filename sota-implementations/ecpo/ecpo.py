"""Train ECPO, PMD, UREX or MENT on groups of trajectories: Algorithm 1 and its baselines.

``python ecpo.py env=bandit loss=ecpo seed=1``; every option is in ``config/``.
"""

from __future__ import annotations

import copy

import hydra
import torch
from omegaconf import DictConfig
from utils import make_collector, make_loss, make_task, make_temperatures

from torchrl_ecpo.experiment import Run


@hydra.main(version_base="1.3", config_path="config", config_name="config")
def main(config: DictConfig) -> None:
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)

    task = make_task(config)
    actor = task.actor
    reference = copy.deepcopy(actor)
    collector = make_collector(config, task.env, reference)
    loss_module = make_loss(config.loss, actor)
    temperatures = make_temperatures(config.loss, loss_module)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=config.optim.lr, eps=config.optim.eps)
    max_grad_norm = config.optim.max_grad_norm or float("inf")

    groups_of_trajectories = iter(collector)
    trajectories = 0
    project_step = 0
    with Run(
        config,
        total=config.total_trajectories,
        unit="trajectories",
        name=f"{config.env.name}/{config.loss.name}/seed_{config.seed}",
        shown=task.shown,
        plotted=task.plotted,
    ) as run:
        while trajectories < config.total_trajectories:
            # Lift: the current policy becomes the reference.
            collector.update_policy_weights_(loss_module.actor_network_params.data)
            lifted_at = trajectories
            for _ in range(config.project_steps):
                # Project: one gradient step on fresh trajectories of the reference.
                groups = next(groups_of_trajectories)
                losses = loss_module(groups)
                optimizer.zero_grad()
                losses["loss_actor"].backward()
                grad_norm = torch.nn.utils.clip_grad_norm_(actor.parameters(), max_grad_norm)
                optimizer.step()

                trajectories += config.num_groups * config.group_size
                project_step += 1
                metrics = {**losses.detach(), "grad_norm": grad_norm, **temperatures.values()}
                if project_step % config.evaluation_interval == 0:
                    metrics |= task.evaluate()
                run.log(metrics, step=trajectories)
            temperatures.step(trajectories - lifted_at)
    collector.shutdown()


if __name__ == "__main__":
    main()
