"""Train ECPO or a rival of it on groups of trajectories: Algorithm 1 and its baselines.

``python ecpo.py env=bandit loss=ecpo seed=1``; every option is in ``config/``. ``seeds=[0,1,2]``
and ``stack=[...]`` train several independent runs in one process (``stacked/``).
"""

from __future__ import annotations

from torchrl_ecpo.experiment.options import check_command_line

if __name__ == "__main__":  # before torch is imported, which takes seconds
    check_command_line(__file__)

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from stacked import check_runs, runs_of, train_stack
from tasks import Metrics, make_task
from torch.nn.utils import clip_grad_norm_
from utils import (
    Watch,
    check_goals,
    goes_on,
    held,
    is_far,
    is_single,
    make_collector,
    make_loss,
    make_optimizer,
    make_run,
    make_temperatures,
    of_batch,
    reached,
    total_loss,
)

from torchrl_ecpo.collectors import shut_down
from torchrl_ecpo.experiment import Checkpoints, Progress, compile_module, leaving_nothing


@hydra.main(version_base="1.3", config_path="config", config_name="config")
@leaving_nothing
def main(config: DictConfig) -> None:
    torch.set_num_threads(config.threads)
    if config.seeds is not None or config.stack is not None:
        configs = runs_of(config, HydraConfig.get().overrides.task)
        whole = OmegaConf.create({**config, "runs": configs})  # as files of members may change
        return train_stack(configs, Checkpoints(whole))

    checkpoints = Checkpoints(config)
    torch.manual_seed(config.seed)
    task = make_task(config)
    collector = make_collector(config, task)
    loss_module = make_loss(config.loss, task.actor, task.make_value_network)
    if config.compile:
        compile_module(loss_module, "loss")
    optimizer = make_optimizer(config.optim, loss_module.parameters())
    max_grad_norm = config.optim.max_grad_norm or float("inf")
    temperatures = make_temperatures(config.loss, loss_module)
    run = make_run(config, task)
    watch = Watch(config.group_size, task.least_entropy)

    groups_of_trajectories = iter(collector)
    progress = Progress(
        trajectories=0, project_steps=0, is_annealing=config.anneal_from is None, held=0
    )
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
        while progress.trajectories < config.total_trajectories and goes_on(config, progress.held):
            # Lift: the current policy becomes the reference.
            collector.update_policy_weights_()
            lifted_at = progress.trajectories
            for _ in range(config.project_steps):
                # Project: gradient steps on fresh trajectories of the reference.
                groups = next(groups_of_trajectories)
                of_steps: list[Metrics] = []
                for _ in range(config.epochs):
                    losses = loss_module(groups)
                    of_steps.append(losses.detach().to_dict())
                    if is_far(of_steps, config.max_kl):
                        break
                    optimizer.zero_grad()
                    total_loss(losses, loss_module).backward()
                    grad_norm = clip_grad_norm_(loss_module.parameters(), max_grad_norm)
                    of_steps[-1]["grad_norm"] = grad_norm
                    run.check(of_steps[-1], progress.trajectories)
                    optimizer.step()

                progress.trajectories += config.num_groups * config.group_size
                progress.project_steps += 1
                metrics = of_batch(of_steps) | task.measure(groups) | temperatures.values()
                if progress.project_steps % config.evaluation.interval == 0:
                    metrics |= task.evaluate(groups)
                check_goals(config, metrics)
                run.log(metrics, step=progress.trajectories)
                watch(metrics)
                progress.held = held(config.stop_when, progress.held, metrics)
            progress.is_annealing |= reached(config.anneal_from, metrics)
            temperatures.step(progress.is_annealing * (progress.trajectories - lifted_at))
            checkpoints.boundary()


if __name__ == "__main__":
    check_command_line(__file__, check_runs)
    main()
