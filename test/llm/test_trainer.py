"""ECPOLoss in TorchRL's own GRPOTrainer."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("transformers")

import tiny_llm as tiny
from tensordict import TensorDict, lazy_stack
from torchrl.data import LazyStackStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import PromptGroupSampler
from torchrl.trainers.algorithms.grpo import GRPOTrainer

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.llm import record_log_probs

K, PROMPTS = 4, ((3,), (4,), (5, 6))


class Samples:
    """What the trainer asks of a collector: batches, and a few names."""

    def __init__(self, model, batches):
        self.sampler = tiny.make_sampler(model, return_log_probs=False)
        self.actor, self.batches = tiny.make_actor(model), batches
        self.requested_frames_per_batch, self.init_random_frames = K * len(PROMPTS), 0

    def __iter__(self):
        for _ in range(self.batches):
            rows = [
                TensorDict({"tokens": {"prompt": torch.tensor(prompt)}, "query": str(prompt)})
                for prompt in PROMPTS * K
            ]
            batch = record_log_probs(self.actor, self.sampler(lazy_stack(rows)))
            lengths = [len(x) for x in batch.get(("tokens", "response"), as_list=True)]
            batch["next", "reward"] = torch.tensor(lengths).float().neg().view(-1, 1, 1)
            yield batch

    def set_seed(self, seed):
        return seed

    def shutdown(self):
        pass


@pytest.mark.filterwarnings("ignore:GRPOTrainer is an experimental:UserWarning")
def test_groups_are_whole_in_a_minibatch():
    """Each minibatch has two groups of K, of rows of unequal length; short answers are learnt."""
    torch.manual_seed(0)
    model, seen = tiny.make_model(), []

    class Watched(ECPOLoss):
        def surrogate(self, groups):
            seen.append(groups)
            return super().surrogate(groups)

    loss_module = Watched(tiny.make_actor(model), score="group", entropy="matched")
    batches, optimizer = 6, torch.optim.Adam(model.parameters(), lr=1e-2)
    trainer = GRPOTrainer(
        collector=Samples(model, batches),
        total_frames=batches * K * len(PROMPTS),
        loss_module=loss_module,
        optimizer=optimizer,
        optim_steps_per_batch=2,
        replay_buffer=ReplayBuffer(
            storage=LazyStackStorage(K * len(PROMPTS)),
            sampler=PromptGroupSampler(samples_per_group=K),
            batch_size=2 * K,
        ),
        progress_bar=False,
        empty_replay_buffer_on_weight_update=True,
    )
    trainer.train()
    assert len(seen) == 2 * batches
    assert all(groups.returns.shape == (2, K) for groups in seen)
    assert abs(seen[0].log_prob - seen[0].reference_log_prob).max() < 1e-4
    first, last = (torch.stack([g.returns for g in part]).mean() for part in (seen[:2], seen[-2:]))
    assert last > first
