"""TorchRL's LLMCollector over a chat environment, whose batches the losses read as they are."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec

import pytest
import torch

pytest.importorskip("transformers")

import tiny_llm as tiny
from tensordict import TensorDict, lazy_stack, set_list_to_stack
from torch.utils.data import DataLoader
from torchrl.collectors.llm import LLMCollector, RayLLMCollector
from torchrl.envs.llm import DatasetChatEnv

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.llm import record_log_probs

K, PROMPTS = 4, ("a b c", "d e", "f")


def collate(rows):
    return lazy_stack([TensorDict(query=row) for row in rows])


def make_env():
    """Three prompts, each K times, for ever."""
    return DatasetChatEnv.from_dataloader(
        DataLoader(PROMPTS, collate_fn=collate),
        repeats=K,
        batch_size=(K * len(PROMPTS),),
        tokenizer=tiny.make_tokenizer(),
        input_mode="text",
    )


def make_sampler():
    """The policy of all these tests: one seed."""
    return tiny.make_sampler(tiny.make_model(), input_mode="text", return_log_probs=False)


def finish(batch):
    """Reward short answers, and record the log-probabilities of the policy that sampled them."""
    lengths = [len(row) for row in batch.get(("tokens", "response"), as_list=True)]
    batch["next", "reward"] = -torch.tensor(lengths).float().view(-1, 1, 1)
    return record_log_probs(tiny.make_actor(tiny.make_model()), batch)


def check(batch):
    """Losses of a batch of three groups, by an actor of the same weights."""
    actor = tiny.make_actor(tiny.make_model())
    losses = ECPOLoss(actor, score="group", entropy="matched")(batch)
    assert abs(losses["kl_reference_policy"]) < 1e-4
    rewards = batch["next", "reward"].view(len(PROMPTS), K)
    torch.testing.assert_close(losses["return"], rewards.mean())
    assert sorted(set(batch["query"])) == sorted(PROMPTS)
    losses["loss_actor"].backward()
    assert all(parameter.grad is not None for parameter in actor.parameters())


SETTINGS = {
    "postproc": finish,
    "dialog_turns_per_batch": K * len(PROMPTS),
    "total_dialog_turns": 2 * K * len(PROMPTS),
    "flatten_data": True,
}


@pytest.mark.filterwarnings("ignore:The env passed to LLMCollector is missing:FutureWarning")
def test_its_batches_are_read_as_they_are():
    with set_list_to_stack(True):  # as TorchRL's chat environments ask for
        collector = LLMCollector(make_env(), policy=make_sampler(), **SETTINGS)
        batches = list(collector)
        collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        check(batch)


@pytest.mark.slow
@pytest.mark.skipif(find_spec("ray") is None, reason="needs ray")
def test_the_same_from_an_actor_of_ray():
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])  # no package for its actor
    paths = {"PYTHONPATH": os.pathsep.join(sys.path), "LIST_TO_STACK": "1"}
    ray.init(num_cpus=1, include_dashboard=False, runtime_env={"env_vars": paths})
    try:
        collector = RayLLMCollector(
            make_env, policy_factory=make_sampler, remote_config={"num_cpus": 1}, **SETTINGS
        )
        with set_list_to_stack(True):
            batches = [collector.next(), collector.next()]  # a for loop would get None for ever
        collector.shutdown()
    finally:
        ray.shutdown()
    assert len(batches) == 2
    for batch in batches:
        check(batch)
