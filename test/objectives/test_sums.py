"""Losses that say that they read no single steps: the sums over each trajectory are enough."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torch.testing import assert_close
from torchrl.objectives import HardUpdate
from trajectory_problems import CASES, DELAYED, MASK

import torchrl_ecpo
from torchrl_ecpo import ECPOLoss, GRPOLoss, LiftProjectLoss, REPSLoss, TPOLoss, TrajectoryGroupLoss


class Recorded(TensorDictModuleBase):
    """A policy whose log-probabilities are an entry of the batch, times a parameter."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones((), dtype=torch.float64))
        keys: list[Any] = ["log_prob"]
        self.in_keys, self.out_keys = keys, keys[1:]

    def get_dist(self, tensordict: TensorDict) -> SimpleNamespace:
        log_prob = self.scale * tensordict["log_prob"]
        return SimpleNamespace(log_prob=lambda action: log_prob)


MEMBERS = {
    **{
        f"{name}, {score}": (case.loss, {**case.temperatures, **case.options, "score": score})
        for name, case in CASES.items()
        if name != "grpo"
        for score in ("return", "group", "batch")
    },
    "matched": (ECPOLoss, {"entropy": "matched", "tau_prime": 0.3, "score": "batch"}),
    "controlled": (ECPOLoss, {"control_variate": True, "tau_prime": 0.3}),
    "soft": (CASES["squared_pmd"].loss, {"normaliser": "soft", "tau_prime": 0.3}),
    "reps": (REPSLoss, {"tau_prime": 0.3}),
    **{
        f"{name}, delayed": (CASES[name].loss, {**CASES[name].options, "delay_actor": True})
        for name in DELAYED
        if name != "grpo"
    },
}


def draw(seed):
    """A batch ``[3, 4, 5]`` with trajectories of 1 to 5 steps, and that of its sums."""
    generator = torch.Generator().manual_seed(seed)
    lengths = torch.randint(1, 6, (3, 4, 1), generator=generator)
    mask = torch.arange(5) < lengths
    numbers = torch.randn(3, 3, 4, 5, generator=generator, dtype=torch.float64)
    reward, log_prob, behaviour = numbers.where(mask, 0.0)

    def batch(over_steps, **others):
        entries = (over_steps(x) for x in (reward, log_prob - 1.0 * mask, behaviour - 1.0 * mask))
        reward_, log_prob_, behaviour_ = entries
        steps = {"action": torch.zeros_like(reward_), "log_prob": log_prob_}
        steps |= {"action_log_prob": behaviour_, "next": {"reward": reward_.unsqueeze(-1)}}
        return TensorDict(steps | others, batch_size=reward_.shape)

    return batch(lambda x: x, collector={"mask": mask}), batch(lambda x: x.sum(-1, keepdim=True))


def evaluate(loss_class, options, batch):
    """Loss and metrics, and the policy's gradient."""
    actor = Recorded()
    loss = loss_class(actor, **options).double()
    if loss.delay_actor:
        HardUpdate(loss, value_network_update_interval=1)
    actor.scale.data.fill_(1.1)
    out = loss(batch)
    names = ("loss_actor", *loss.losses)
    total = torch.stack([out[name] for name in names]).sum()
    slopes = torch.autograd.grad(total, [*loss.parameters()])
    return loss, out.detach(), slopes


@settings(max_examples=5)
@given(seed=st.integers(0, 10**6))
@pytest.mark.parametrize("name", MEMBERS)
def test_a_loss_that_reads_no_steps_is_that_of_the_sums(name, seed):
    loss_class, options = MEMBERS[name]
    steps, sums = draw(seed)
    assert MASK in steps.keys(True)
    loss, out, slopes = evaluate(loss_class, options, steps)
    assert not loss.reads_steps
    _, expected, of_sums = evaluate(loss_class, options, sums)
    assert_close(out, expected)
    assert_close(slopes, of_sums)


@pytest.mark.parametrize(
    ("loss_class", "options"),
    [(GRPOLoss, {}), (GRPOLoss, {"ratio": "trajectory"}), (TPOLoss, {"length_norm": True})],
)
def test_a_loss_that_reads_steps_is_not(loss_class, options):
    steps, sums = draw(0)
    loss, out, _ = evaluate(loss_class, options, steps)
    assert loss.reads_steps
    _, of_sums, _ = evaluate(loss_class, options, sums)
    assert (out["loss_actor"] - of_sums["loss_actor"]).abs() > 1e-3


def test_every_member_is_here():
    public = (getattr(torchrl_ecpo, name) for name in torchrl_ecpo.__all__)
    members = {c for c in public if isinstance(c, type) and issubclass(c, TrajectoryGroupLoss)}
    tested = {loss_class for loss_class, _ in MEMBERS.values()}
    bases = {TrajectoryGroupLoss, LiftProjectLoss}
    assert {c.__name__ for c in members - tested - bases} == {"GRPOLoss", "TrustPCLLoss"}
    reading = {c.__name__ for c in members if c.reads_steps}
    assert reading == {"TrajectoryGroupLoss", "GRPOLoss", "TPOLoss", "TrustPCLLoss"}
