"""The same model, prompts and evaluation in TRL's GRPOTrainer, with its own loss: ``loss=trl``.

``python by_trl.py env=countdown loss=trl seed=1``; the options are those of ``llm.py``. It measures
at the start and at the end, and writes no checkpoint: ``evaluation.interval`` and ``checkpoint.*``
count for nothing.
"""

from __future__ import annotations

from random import Random
from typing import Any

from torchrl_ecpo.experiment.options import check_command_line

if __name__ == "__main__":  # before torch is imported, which takes seconds
    check_command_line(__file__)

import hydra
import torch
from datasets import Dataset
from omegaconf import DictConfig
from tasks import TASKS
from transformers import TrainerCallback
from trl import GRPOConfig, GRPOTrainer  # pyright: ignore[reportPrivateImportUsage]
from utils import Policy, check_run, make_model

from torchrl_ecpo.experiment import Run, leaving_nothing, refuse_resume


class Logged(TrainerCallback):
    """Passes on what TRL measures of each batch, under the names that llm.py has."""

    def __init__(self, run: Run, batch_size: int) -> None:
        self.run, self.batch_size, self.batches = run, batch_size, 0

    def on_log(self, args: Any, state: Any, control: Any, logs: Any = None, **_: Any) -> None:
        """TRL logs a batch with the first gradient step on it; its entropy is that of a token."""
        if "reward" in logs:
            self.batches += 1
            length = float(logs["completions/mean_length"])
            values = {"return": float(logs["reward"]), "length": length}
            values["entropy"] = float(logs["entropy"]) * length
            self.run.log(values, step=self.batches * self.batch_size - 1)


@hydra.main(version_base="1.3", config_path="config", config_name="config")
@leaving_nothing
def main(config: DictConfig) -> None:
    refuse_resume(config)
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    task = TASKS[config.env]
    model, tokenizer = make_model(config.model)
    policy = Policy(model, tokenizer, task)
    batch_size = config.num_prompts * config.group_size
    batches = -(-config.total_completions // batch_size)
    draws = [Random(f"{config.seed} {batch}") for batch in range(batches)]
    prompts = [task.draw(random)[0] for random in draws for _ in range(config.num_prompts)]
    run = Run(
        config,
        total=config.total_completions,
        unit="completions",
        name=f"{config.env}/trl/seed_{config.seed}",
        shown=("pass_at_1", "pass_at_8", "pass_at_64", "distinct_right"),
    )

    def is_right(prompts: list[str], completion_ids: list[list[int]], **_: Any) -> Any:
        pairs = zip(prompts, policy.decode(completion_ids), strict=True)
        return [float(task.is_right(*pair)) for pair in pairs]

    with run:
        policy.supervise(config.supervised, Random(f"supervised {config.seed}"))
        run.log(policy.evaluate(config.evaluation), step=0)
        trainer = GRPOTrainer(
            model,
            args=GRPOConfig(
                "trl",
                **{"num_generations": config.group_size, "max_completion_length": task.max_tokens},
                **{"per_device_train_batch_size": batch_size, "steps_per_generation": 1},
                **{"num_iterations": config.epochs, "max_steps": batches * config.epochs},
                **{"loss_type": config.loss.type, "epsilon": config.loss.clip_epsilon},
                **{"lr_scheduler_type": "constant", "max_grad_norm": config.optim.max_grad_norm},
                **{"shuffle_dataset": False, "seed": config.seed, "logging_steps": 1},
                **{"bf16": False, "use_cpu": True, "report_to": "none", "save_strategy": "no"},
                generation_kwargs={"suppress_tokens": [tokenizer.pad_token_id]},
                disable_tqdm=True,
            ),
            reward_funcs=is_right,
            train_dataset=Dataset.from_dict({"prompt": prompts}),
            processing_class=tokenizer,
            callbacks=[Logged(run, batch_size)],
            optimizers=(torch.optim.Adam(model.parameters(), lr=config.optim.lr), None),
        )
        trainer.train()
        model.eval()
        run.log(policy.evaluate(config.evaluation), step=batches * batch_size)


if __name__ == "__main__":
    check_command_line(__file__, lambda config, _: check_run(config, ("trl",)))
    main()
