"""Train ECPO, PMD, UREX or MENT on groups of trajectories: Algorithm 1 and its baselines.

``python ecpo.py env=bandit loss=ecpo seed=1``; every option is in ``config/``. ``seeds=[0,1,2]``
trains as many independent runs in one process (``stack.py``).
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from stack import make_stack
from utils import check_config, is_single, make_optimizer, make_parts, reached

from torchrl_ecpo.collectors import shut_down
from torchrl_ecpo.experiment import Checkpoints, Progress, compile_module


@hydra.main(version_base="1.3", config_path="config", config_name="config")
def main(config: DictConfig) -> None:
    check_config(config)
    checkpoints = Checkpoints(config)
    torch.set_num_threads(config.threads)

    parts = make_parts(config) if config.seeds is None else make_stack(config)
    task, collector, loss_module, temperatures, run, clip_grad_norm_ = parts
    if config.compile:
        compile_module(loss_module, "loss")
    optimizer = make_optimizer(config.optim, loss_module)
    max_grad_norm = config.optim.max_grad_norm or float("inf")

    groups_of_trajectories = iter(collector)
    progress = Progress(trajectories=0, project_steps=0, is_annealing=config.anneal_from is None)
    with (
        shut_down(collector),
        run,
        checkpoints.attach(
            run,
            progress,
            loss_module=loss_module,
            optimizer=optimizer,
            temperatures=temperatures,
            collector=collector if is_single(config) else None,
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
                losses["loss_actor"].sum().backward()  # of stacked runs there is one each
                grad_norm = clip_grad_norm_(max_grad_norm)
                metrics = {**losses.detach(), "grad_norm": grad_norm}
                run.check(metrics, progress.trajectories)
                optimizer.step()

                progress.trajectories += config.num_groups * config.group_size
                progress.project_steps += 1
                metrics |= {**task.measure(groups), **temperatures.values()}
                if progress.project_steps % config.evaluation_interval == 0:
                    metrics |= task.evaluate(groups)
                run.log(metrics, step=progress.trajectories)
            progress.is_annealing |= reached(config.anneal_from, metrics)
            temperatures.step(progress.is_annealing * (progress.trajectories - lifted_at))
            checkpoints.boundary()


if __name__ == "__main__":
    main()
