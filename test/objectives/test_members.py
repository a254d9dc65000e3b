"""What is particular to each member: ECPO, PMD, UREX, MENT."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close
from trajectory_problems import (
    CASES,
    gradients,
    make_actor,
    move,
    normalise,
    numbers,
    pad,
    problem,
    reinforce,
    sample,
    split,
)

from torchrl_ecpo.objectives import ECPOLoss, MENTLoss, PMDLoss, UREXLoss

CASE = CASES["ecpo"]


@pytest.mark.parametrize(
    ("loss_class", "tau", "tau_prime"),
    [(ECPOLoss, 0.5, 0.01), (PMDLoss, 0.5, 0.0), (UREXLoss, 0.1, None), (MENTLoss, 0.01, None)],
)
def test_defaults(loss_class, tau, tau_prime):
    """As documented; the paper's PMD has no entropy term."""
    loss = loss_class(make_actor())
    assert_close(loss.tau, torch.tensor(tau))
    if tau_prime is not None:
        assert_close(loss.tau_prime, torch.tensor(tau_prime))
    assert (loss.delay_actor, loss.reduction) == (False, "mean")
    assert not getattr(loss, "control_variate", False)


# -------------------------------------------------------------------------------------------- ECPO


def test_weights_stay_while_the_policy_is_projected():
    """Within one projection theta moves, and the weights, which are the reference's, do not."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = CASE.build(actor)
    before = loss(batch)
    move(actor)
    after = loss(batch)
    assert_close(after.select("ESS", "max_weight"), before.select("ESS", "max_weight"))
    assert (after["loss_actor"] - before["loss_actor"]).abs() > 1e-3


def test_projection_reaches_the_minimum_of_the_cross_entropy():
    """Solved, the projection's loss is the entropy of the weights (a policy that can be them)."""
    actor = make_actor()
    weights = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    batch = sample(actor, 4, 1)
    batch["observation"].zero_()
    batch["action"] = torch.arange(4).unsqueeze(-1)
    batch["action_log_prob"].fill_(0.25).log_()
    loss = CASE.build(actor)
    loss.tau, loss.tau_prime = 1.0, 0.0
    batch["next", "reward"] = weights.log().view(4, 1, 1)
    actor.module[0].module[0].bias.data.copy_(weights.log())  # type: ignore
    value = loss(batch)["loss_actor"]
    assert_close(value, -(weights * weights.log()).sum())
    assert max(g.abs().max() for g in gradients(value, actor)) < 1e-12


@pytest.mark.parametrize("delayed", [False, True], ids=["recorded", "delayed"])
def test_control_variate(delayed):
    """Each weight less the self-normalised ratio of the policy to the sampler."""
    reference, lag = (make_actor(), 0.1) if delayed else (None, 0.0)
    loss, actor, batch = problem(CASE, lag=lag, control_variate=True, delay_actor=delayed)
    if reference is not None:
        move(reference, lag)
    expected = []
    for group in split(batch):
        n = numbers(actor, group, reference)
        _, weights = CASE.formula(n, **CASE.temperatures)
        ratios = normalise((n.log_prob - n.behaviour).exp()).detach()
        expected.append(-((weights - ratios) * n.log_prob).sum())
    value = loss(batch)["loss_actor"]
    assert_close(value, torch.stack(expected).mean())
    assert_close(gradients(value, actor), gradients(torch.stack(expected).mean(), actor))


# --------------------------------------------------------------------------------------------- PMD


@pytest.mark.parametrize(
    ("loss_class", "tau"), [(PMDLoss, 0.1), (PMDLoss, 1.0), (PMDLoss, 10.0), (MENTLoss, 0.0)]
)
def test_reinforce_at_the_reference(loss_class, tau):
    """PMD at theta = reference, tau' = 0, for any tau; MENT without an entropy term.

    The group's mean is the baseline, which a constant added to all returns does not change.
    """
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    expected = torch.stack([reinforce(numbers(actor, group)) for group in split(batch)]).mean()
    loss = loss_class(actor, tau=tau).double()
    got = gradients(loss(batch)["loss_actor"], actor)
    assert_close(got, gradients(expected, actor))
    batch["next", "reward"][..., 0, 0] += 5.0
    assert_close(got, gradients(loss(batch)["loss_actor"], actor))


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


# -------------------------------------------------------------------------------------------- UREX


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


# -------------------------------------------------------------------------------------------- MENT


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
