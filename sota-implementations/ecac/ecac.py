"""Train ECAC, or a rival with a critic, on continuous control or one discrete action.

``python ecac.py env=halfcheetah loss=ecac seed=1``; every option is in ``config/``.
"""

from __future__ import annotations

import sys

from choice import chosen_loss

from torchrl_ecpo.experiment.options import check_command_line

if __name__ == "__main__":  # before torch is imported, which takes seconds
    sys.argv[1:1] = chosen_loss(sys.argv[1:])  # before options and flags alike
    check_command_line(__file__)

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor, nn
from utils import (
    SHOWN,
    BufferState,
    CollectorState,
    Every,
    Speed,
    check_config,
    compile_parts,
    compute_losses,
    evaluate,
    finished_returns,
    make_actor,
    make_collector,
    make_evaluation_environment,
    make_loss,
    make_optimizer,
    make_policy,
    make_replay_buffer,
    make_temperatures,
    make_updater,
    mean,
    scalars,
    updates_due,
)

from torchrl_ecpo.collectors import shut_down
from torchrl_ecpo.experiment import (
    Checkpoints,
    Progress,
    Run,
    leaving_nothing,
)


def total(losses: TensorDictBase, is_policy_due: bool) -> Tensor:
    """The sum of the losses, each of which reaches its own parameters only."""
    trained = [
        loss
        for name, loss in losses.items()
        if name.startswith("loss_") and (is_policy_due or name != "loss_actor")
    ]
    return torch.stack(trained).sum()


def descend(loss: Tensor, optimizer: torch.optim.Optimizer, kept: nn.Module | None = None) -> None:
    """A gradient step, which leaves a module as it is."""
    loss.backward()
    if kept is not None:
        kept.zero_grad()  # compiled, it has a gradient of 0, not none, by which Adam still moves
    optimizer.step()
    optimizer.zero_grad()


@hydra.main(version_base="1.3", config_path="config", config_name="config")
@leaving_nothing
def main(config: DictConfig) -> None:
    checkpoints = Checkpoints(config)
    torch.set_num_threads(config.threads)

    evaluation_env = make_evaluation_environment(config)
    torch.manual_seed(config.seed)
    actor = make_actor(config, evaluation_env)
    loss_module = make_loss(config, actor, evaluation_env)
    temperatures = make_temperatures(config.loss, loss_module)
    updater = make_updater(config, loss_module)
    optimizer = make_optimizer(config.optim, loss_module)
    replay_buffer = make_replay_buffer(config)
    collector = make_collector(config, make_policy(config.loss, actor, evaluation_env))
    compile_parts(config, loss_module, actor)

    progress = Progress(frames=0, updates=0, returns=[], losses={})
    is_log_due, is_evaluation_due = Every(config.log_interval), Every(config.evaluation.interval)
    run = Run(
        config,
        total=config.total_frames,
        unit="frames",
        name=f"{config.env.title}/{config.loss.name}/seed_{config.seed}",
        shown=SHOWN,
    )
    with (
        shut_down(collector),
        run,
        checkpoints.attach(
            run,
            progress,
            loss_module=loss_module,
            optimizer=optimizer,
            updater=updater,
            temperatures=temperatures,
            replay_buffer=BufferState(replay_buffer),
            collector=CollectorState(collector),
            evaluation_env=evaluation_env,
            is_log_due=is_log_due,
            is_evaluation_due=is_evaluation_due,
        ),
    ):
        speed = Speed(progress.frames)
        collector.update_policy_weights_()
        batches = iter(collector)
        while progress.frames < config.total_frames:
            transitions = next(batches).reshape(-1)
            progress.frames += len(transitions)
            progress.returns += finished_returns(transitions)
            replay_buffer.extend(transitions.select(*loss_module.in_keys, strict=False))

            if progress.frames > config.collector.init_random_frames:
                new = len(transitions)
                for _ in range(updates_due(progress.frames, new, config.updates_per_frame)):
                    is_policy_due = (progress.updates + 1) % config.loss.policy_delay == 0
                    batch = replay_buffer.sample()
                    losses = compute_losses(loss_module, batch, is_policy_due)
                    loss = total(losses, is_policy_due)
                    if not loss.isfinite():
                        run.check(scalars(losses), progress.frames)
                    descend(loss, optimizer, kept=None if is_policy_due else actor)
                    progress.losses |= scalars(losses)  # the policy's stay from when it was due
                    progress.updates += 1
                    if updater is not None and is_policy_due:
                        updater.step()
                temperatures.step(new)
                collector.update_policy_weights_()

            is_over = progress.frames >= config.total_frames
            is_evaluated = is_evaluation_due(progress.frames)
            if is_log_due(progress.frames) or is_evaluated or is_over:
                metrics = {
                    "return": mean(progress.returns),
                    "steps_per_second": speed(progress.frames),
                }
                progress.returns.clear()
                if is_evaluated:
                    metrics |= evaluate(evaluation_env, actor, config.evaluation, progress.frames)
                    speed(progress.frames)  # evaluation does not count
                run.log({**progress.losses, **metrics}, step=progress.frames)
            checkpoints.boundary()


if __name__ == "__main__":
    check_command_line(__file__, check_config)
    main()
