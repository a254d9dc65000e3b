"""What is particular to UREX."""

from __future__ import annotations

import torch
from torch.testing import assert_close
from trajectory_problems import CASES, gradients, make_actor, pad, sample

from torchrl_ecpo.objectives import ECPOLoss, MENTLoss, UREXLoss


def test_policy_gradient_plus_tau_times_the_mean_seeking_projection():
    """The second part is ECPO's at tau = 0, tau' = UREX's tau, with the group's mean taken off."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    urex = CASES["urex"].build(actor)
    tau = urex.tau.item()
    policy_gradient = MENTLoss(actor, tau=0.0).double()
    mean_seeking = ECPOLoss(actor, tau=0.0, tau_prime=1.0, control_variate=True).double()
    mean_seeking.tau_prime = tau
    parts = policy_gradient(batch)["loss_actor"] + tau * mean_seeking(batch)["loss_actor"]
    out = urex(batch)
    assert_close(gradients(out["loss_actor"], actor), gradients(parts, actor))
    assert_close(out["ESS"], mean_seeking(batch)["ESS"])


def test_weights_are_under_the_policy_being_trained():
    """What the sampler recorded is for the diagnostics only."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    older = batch.clone()
    older["action_log_prob"] -= torch.rand_like(older["action_log_prob"])
    urex = CASES["urex"].build(actor)
    names = ("loss_actor", "ESS", "max_weight")
    assert_close(urex(older).select(*names), urex(batch).select(*names))


def test_defaults():
    """As documented."""
    loss = UREXLoss(make_actor())
    assert_close(loss.tau, torch.tensor(0.1))
    assert loss.reduction == "mean"
