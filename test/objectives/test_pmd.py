"""What is particular to PMD."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close
from trajectory_problems import (
    CASES,
    gradients,
    make_actor,
    move,
    numbers,
    pad,
    reinforce,
    sample,
    split,
)

from torchrl_ecpo.objectives import MENTLoss, PMDLoss


@pytest.mark.parametrize("tau", [0.1, 1.0, 10.0])
def test_reinforce_at_the_reference(tau):
    """At theta = reference, tau' = 0, for any tau: REINFORCE with the group's mean as baseline."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    expected = torch.stack([reinforce(numbers(actor, group)) for group in split(batch)]).mean()
    got = gradients(PMDLoss(actor, tau=tau).double()(batch)["loss_actor"], actor)
    assert_close(got, gradients(expected, actor))


def test_entropy_term_at_the_reference_is_ments():
    """At theta = reference, PMD+entropy is MENT with tau = tau'."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    pmd = CASES["pmd"].build(actor)
    ment = MENTLoss(actor).double()
    ment.tau = pmd.tau_prime.item()
    got = gradients(pmd(batch)["loss_actor"], actor)
    assert_close(got, gradients(ment(batch)["loss_actor"], actor))


def test_large_tau_pulls_back_to_the_reference():
    """Away from the reference a step on PMD with a large tau reduces the divergence."""
    actor = make_actor()
    batch = sample(actor, 8, 64, 1)
    move(actor)
    loss = PMDLoss(actor, tau=100.0).double()
    before = loss(batch)
    before["loss_actor"].backward()
    torch.optim.SGD(loss.parameters(), lr=1e-3).step()
    assert loss(batch)["kl_reference_policy"] < before["kl_reference_policy"]


def test_defaults():
    """As documented: the paper's PMD has no entropy term."""
    loss = PMDLoss(make_actor())
    assert_close(loss.tau, torch.tensor(0.5))
    assert_close(loss.tau_prime, torch.tensor(0.0))
    assert (loss.delay_actor, loss.reduction) == (False, "mean")
