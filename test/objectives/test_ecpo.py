"""What is particular to ECPO."""

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
    sample,
    split,
)

from torchrl_ecpo.objectives import ECPOLoss

CASE = CASES["ecpo"]


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


def test_defaults():
    """As documented."""
    loss = ECPOLoss(make_actor())
    assert_close(loss.tau, torch.tensor(0.5))
    assert_close(loss.tau_prime, torch.tensor(0.01))
    assert (loss.control_variate, loss.delay_actor) == (False, False)
    assert loss.reduction == "mean"
