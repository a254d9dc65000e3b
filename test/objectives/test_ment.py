"""What is particular to MENT."""

from __future__ import annotations

import torch
from torch.testing import assert_close
from trajectory_problems import gradients, make_actor, numbers, pad, reinforce, sample, split

from torchrl_ecpo.objectives import MENTLoss


def test_tau_zero_is_reinforce():
    """With the group's mean as baseline, which a constant added to all returns does not change."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    loss = MENTLoss(actor, tau=0.0).double()
    expected = torch.stack([reinforce(numbers(actor, group)) for group in split(batch)]).mean()
    got = gradients(loss(batch)["loss_actor"], actor)
    assert_close(got, gradients(expected, actor))
    batch["next", "reward"][..., 0, 0] += 5.0
    assert_close(got, gradients(loss(batch)["loss_actor"], actor))


def test_entropy_alone():
    """Equal returns: improbable trajectories are made more probable."""
    actor = make_actor()
    batch = sample(actor, 2, 16, 4)
    batch["next", "reward"].zero_()
    loss = MENTLoss(actor, tau=1.0).double()
    before = loss(batch)
    before["loss_actor"].backward()
    torch.optim.SGD(loss.parameters(), lr=1e-2).step()
    assert loss(batch)["entropy"] > before["entropy"]


def test_weights_are_equal():
    """All K trajectories count alike."""
    actor = make_actor()
    out = MENTLoss(actor).double()(sample(actor, 2, 3, 4))
    assert_close(out["ESS"], torch.tensor(3.0).double())
    assert_close(out["max_weight"], torch.tensor(1 / 3).double())


def test_defaults():
    """As documented."""
    loss = MENTLoss(make_actor())
    assert_close(loss.tau, torch.tensor(0.01))
    assert loss.reduction == "mean"
