"""A group loss in TRL's GRPOTrainer: the class that the page shows."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

pytest.importorskip("trl")

import tiny_llm as tiny
from datasets import Dataset
from trl import GRPOConfig

from torchrl_ecpo import ECPOLoss

PAGE = Path(__file__).parents[2] / "docs/tutorials/trl.md"
CLASS = PAGE.read_text().split("```python\n")[1].split("```")[0]
SINGLE = {"steps_per_generation": 1, "gradient_accumulation_steps": 1}


def make_loss(actor):
    return ECPOLoss(actor, score="group", entropy="matched", tau_prime=0.05)


@pytest.fixture
def make_trainer(tmp_path):
    names: dict[str, type] = {}
    exec(compile(CLASS, str(PAGE), "exec"), names)

    def make(model, **options):
        options = {"num_generations": 3, "per_device_train_batch_size": 6} | SINGLE | options
        quiet = {"use_cpu": True, "bf16": False, "report_to": "none", "save_strategy": "no"}
        suppressed = {"generation_kwargs": {"suppress_tokens": [tiny.PAD]}}
        options = {"max_completion_length": 6, "max_steps": 2} | quiet | suppressed | options
        return names["GroupTrainer"](
            model,
            make_loss,
            processing_class=tiny.make_tokenizer(),
            reward_funcs=lambda completion_ids, **_: [-float(len(x)) for x in completion_ids],
            train_dataset=Dataset.from_dict({"prompt": ["a", "b c"]}),
            args=GRPOConfig(str(tmp_path), disable_tqdm=True, **options),
        )

    return make


def test_it_takes_fewer_than_eighty_lines():
    assert len(CLASS.splitlines()) < 80


def as_trl_has_it(batch):
    """What TRL hands to compute_loss of completions: rewards are centred and scaled in a group."""
    prompt, full = batch["tokens", "prompt"], batch["tokens", "full"]
    before, reward = prompt.shape[-1], batch["next", "reward"].flatten()
    advantages = torch.empty_like(reward)
    for query in set(batch["query"]):
        rows = torch.tensor([other == query for other in batch["query"]])
        of_group = reward[rows]
        advantages[rows] = (of_group - of_group.mean()) / (of_group.std() + 1e-4)
    return {
        "prompt_ids": prompt,
        "prompt_mask": (prompt != tiny.PAD).long(),
        "completion_ids": full[:, before:],
        "completion_mask": (full[:, before:] != tiny.PAD).long(),
        "advantages": advantages,
        "old_per_token_logps": batch["log_probs", "full"][:, before:].nan_to_num(),
    }


def test_value_and_gradient_are_the_loss_s_own(make_trainer):
    """By completions of unequal length, recorded of another policy; tokens tell their groups."""
    model = tiny.make_model()
    batch = tiny.dense(tiny.ragged(model, noise=0.1))
    expected = make_loss(tiny.make_actor(model, pad_output=True))(batch.copy())["loss_actor"]
    expected.backward()
    gradients = [parameter.grad.clone() for parameter in model.parameters()]
    trainer = make_trainer(model)
    model.zero_grad()
    value = trainer.compute_loss(model, as_trl_has_it(batch))
    value.backward()
    torch.testing.assert_close(value, expected)
    for parameter, gradient in zip(model.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient)


def test_short_answers_are_learned(make_trainer):
    model = tiny.make_model()
    trainer = make_trainer(
        model,
        **{"num_generations": 8, "per_device_train_batch_size": 16, "num_iterations": 2},
        **{"max_steps": 12, "learning_rate": 1e-2, "logging_steps": 1},
    )
    trainer.train()
    logged = [entry for entry in trainer.state.log_history if "reward" in entry]
    assert len(logged) == 6  # each batch teaches twice
    assert all(abs(entry["kl_reference_policy"]) < 1e-4 for entry in logged)
    assert logged[-1]["reward"] > logged[0]["reward"] + 1


@pytest.mark.parametrize("options", [{}, {"gradient_accumulation_steps": 3, "num_iterations": 2}])
def test_a_batch_is_recorded_also_where_trl_does_not(make_trainer, options):
    """Where it is used once, and in an evaluation, which is not divided either."""
    trainer = make_trainer(tiny.make_model(), logging_steps=1, **options)
    trainer.train()
    logged = [entry for entry in trainer.state.log_history if "reward" in entry]
    assert logged
    assert abs(logged[0]["kl_reference_policy"]) < 1e-4
    told = trainer.evaluate(trainer.train_dataset)
    assert told["eval_loss"] == pytest.approx(trainer.diagnostics["loss_actor"], rel=1e-4)


def test_groups_that_are_cut_are_refused(make_trainer):
    with pytest.raises(ValueError, match="Set steps_per_generation=1: TRL would cut groups"):
        make_trainer(tiny.make_model(), per_device_train_batch_size=3, steps_per_generation=2)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"temperature": 0.7}, "temperature=0.7"), ({"top_k": 5}, "top_k=5")],
)
def test_what_changes_the_policy_is_refused(make_trainer, options, message):
    with pytest.raises(ValueError, match=message):
        make_trainer(tiny.make_model(), **options)
