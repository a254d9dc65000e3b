"""What is particular to each member: ECPO, PMD, UREX, MENT."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close
from torchrl.objectives import HardUpdate
from trajectory_problems import (
    CASES,
    gradients,
    make_actor,
    move,
    normalise,
    numbers,
    pad,
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


def _first_step(group, actor):
    """Eq. 6 at theta = reference: the weights need nothing but the policy itself."""
    n = numbers(actor, group)
    lift = (n.returns - CASE.temperatures["tau_prime"] * n.log_prob.detach()).div(
        sum(CASE.temperatures.values())
    )
    return -(lift.softmax(0) * n.log_prob).sum()


def test_single_step_projection():
    """M = 1, the paper's "no projection": the gradient at the reference itself."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    expected = torch.stack([_first_step(group, actor) for group in split(batch)]).mean()
    value = CASE.build(actor)(batch)["loss_actor"]
    assert_close(value, expected)
    assert_close(gradients(value, actor), gradients(expected, actor))


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
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    reference = make_actor() if delayed else None
    if reference is not None:
        move(actor, 0.1)
        move(reference, 0.1)
    loss = CASE.build(actor, control_variate=True, delay_actor=delayed)
    if delayed:
        HardUpdate(loss, value_network_update_interval=1)
    move(actor)
    expected = []
    for group in split(batch):
        n = numbers(actor, group, reference)
        _, weights = CASE.formula(n, **CASE.temperatures)
        ratios = normalise((n.log_prob - n.behaviour).exp()).detach()
        expected.append(-((weights - ratios) * n.log_prob).sum())
    value = loss(batch)["loss_actor"]
    assert_close(value, torch.stack(expected).mean())
    assert_close(gradients(value, actor), gradients(torch.stack(expected).mean(), actor))


def test_control_variate_removes_the_drift_of_groups_without_preference():
    """Equal returns, tau' = 0, theta = reference: no gradient at all; without it, a random one."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    batch["next", "reward"].zero_()
    largest = {}
    for control_variate in (False, True):
        loss = ECPOLoss(actor, tau=0.5, tau_prime=0.0, control_variate=control_variate).double()
        grads = gradients(loss(batch)["loss_actor"], actor)
        largest[control_variate] = max(g.abs().max() for g in grads)
    assert largest[False] > 1e-2
    assert largest[True] < 1e-12


# --------------------------------------------------------------------------------------------- PMD


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
