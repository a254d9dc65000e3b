"""Train a language model on a task with verifiable answers, by ECPO or a rival of it.

``python llm.py env=countdown loss=ecpo seed=1``; every option is in ``config/``.
"""

from __future__ import annotations

from random import Random

from torchrl_ecpo.experiment.options import check_command_line

if __name__ == "__main__":  # before torch is imported, which takes seconds
    check_command_line(__file__)

import hydra
import torch
from omegaconf import DictConfig
from tasks import TASKS
from torch.nn.utils import clip_grad_norm_
from utils import LOSSES, Policy, check_run, make_loss, make_model

from torchrl_ecpo.experiment import Checkpoints, Progress, Run, leaving_nothing

SHOWN = ("pass_at_1", "pass_at_8", "pass_at_64", "distinct_right", "entropy")


@hydra.main(version_base="1.3", config_path="config", config_name="config")
@leaving_nothing
def main(config: DictConfig) -> None:
    torch.set_num_threads(config.threads)
    checkpoints = Checkpoints(config)
    torch.manual_seed(config.seed)
    task = TASKS[config.env]
    model, tokenizer = make_model(config.model)
    policy = Policy(model, tokenizer, task)
    loss_module = make_loss(config.loss, policy.actor)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.optim.lr)
    progress = Progress(completions=0, batches=0)
    run = Run(
        config,
        total=config.total_completions,
        unit="completions",
        name=f"{config.env}/{config.loss.name}/seed_{config.seed}",
        shown=SHOWN,
    )
    with run, checkpoints.attach(run, progress, model=model, optimizer=optimizer):
        if not run.table.rows:
            policy.supervise(config.supervised, Random(f"supervised {config.seed}"))
            run.log(policy.evaluate(config.evaluation), step=0)
        while progress.completions < config.total_completions:
            random = Random(f"{config.seed} {progress.batches}")  # for every method the same
            prompts = [task.draw(random)[0] for _ in range(config.num_prompts)]
            batch = policy.sample_groups(prompts, config.group_size)
            for _ in range(config.epochs):
                losses = loss_module(batch)
                optimizer.zero_grad()
                parts = [x.sum() for name, x in losses.items() if name.startswith("loss_")]
                torch.stack(parts).sum().backward()
                grad_norm = clip_grad_norm_(model.parameters(), config.optim.max_grad_norm)
                run.check({"grad_norm": grad_norm}, progress.completions)
                optimizer.step()
            progress.batches += 1
            progress.completions += len(batch)
            metrics = {name: value.detach().mean() for name, value in losses.items()}
            metrics |= {"grad_norm": grad_norm} | policy.measure(batch)
            is_over = progress.completions >= config.total_completions
            if is_over or progress.batches % config.evaluation.interval == 0:
                metrics |= policy.evaluate(config.evaluation)
            run.log(metrics, step=progress.completions)
            checkpoints.boundary()
        for part in (model, tokenizer):
            part.save_pretrained("model")  # for model.path


if __name__ == "__main__":
    check_command_line(__file__, lambda config, _: check_run(config, LOSSES))
    main()
