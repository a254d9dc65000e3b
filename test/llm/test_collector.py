"""TorchRL's LLMCollector over a chat environment, whose batches the losses read as they are."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("transformers")

import tiny_llm as tiny
from tensordict import TensorDict, lazy_stack, set_list_to_stack
from torch.utils.data import DataLoader
from torchrl.collectors.llm import LLMCollector
from torchrl.envs.llm import DatasetChatEnv

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.llm import record_log_probs

K, PROMPTS = 4, ("a b c", "d e", "f")


def collate(rows):
    return lazy_stack([TensorDict(query=row) for row in rows])


@pytest.fixture
def batches():
    """Two batches of three groups of K, rewarded for short answers, and the actor."""
    model = tiny.make_model()
    sampler = tiny.make_sampler(model, input_mode="text", return_log_probs=False)
    actor = tiny.make_actor(model)

    def finish(batch):
        lengths = [len(row) for row in batch.get(("tokens", "response"), as_list=True)]
        batch["next", "reward"] = -torch.tensor(lengths).float().view(-1, 1, 1)
        return record_log_probs(actor, batch)

    with set_list_to_stack(True):  # as TorchRL's chat environments ask for
        env = DatasetChatEnv.from_dataloader(
            DataLoader(PROMPTS, collate_fn=collate),
            repeats=K,
            batch_size=(K * len(PROMPTS),),
            tokenizer=tiny.make_tokenizer(),
            input_mode="text",
        )
        collector = LLMCollector(
            env,
            policy=sampler,
            postproc=finish,
            dialog_turns_per_batch=K * len(PROMPTS),
            total_dialog_turns=2 * K * len(PROMPTS),
            flatten_data=True,
        )
        yield actor, list(collector)
        collector.shutdown()


@pytest.mark.filterwarnings("ignore:The env passed to LLMCollector is missing:FutureWarning")
def test_its_batches_are_read_as_they_are(batches):
    actor, collected = batches
    loss_module = ECPOLoss(actor, score="group", entropy="matched")
    for batch in collected:
        losses = loss_module(batch)
        assert abs(losses["kl_reference_policy"]) < 1e-4
        rewards = batch["next", "reward"].view(len(PROMPTS), K)
        torch.testing.assert_close(losses["return"], rewards.mean())
        assert sorted(set(batch["query"])) == sorted(PROMPTS)
    losses["loss_actor"].backward()
    assert all(parameter.grad is not None for parameter in actor.parameters())
