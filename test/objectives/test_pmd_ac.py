"""What is particular to PMD-AC: the mode-seeking projection, and SAC as a special case."""

from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from actor_critic_problems import (
    CASES,
    GAMMA,
    call,
    gradients,
    make_batch,
    make_networks,
)
from test_ecac import SCORES, TEMPERATURES, _target, gaussian_bandit, quadratic, states
from torch.testing import assert_close
from torchrl.objectives import DiscreteSACLoss, SACLoss, SoftUpdate
from trajectory_problems import MASK

from torchrl_ecpo import DiscretePMDACLoss, PeriodicCopy, PMDACLoss, PolyakAverage

CASE, DISCRETE = CASES["pmd_ac"], CASES["discrete_pmd_ac"]

# ---------------------------------------------------------------------------------------- SAC

ALPHA = 0.25


def sac(networks, *, loss=SACLoss, **options):
    """With a fixed temperature, exact in the dtype of the networks."""
    module = loss(
        networks.actor,
        networks.qvalues,
        fixed_alpha=True,
        alpha_init=ALPHA,
        loss_function="l2",
        target_entropy=-2.0,
        **options,
    )
    module.make_value_estimator(gamma=GAMMA)
    module.to(next(networks.actor.parameters()).dtype)
    module.log_alpha.fill_(math.log(ALPHA))
    return module


def both(networks, **options):
    """PMD-AC at tau = 0, and SAC, of the same parameters."""
    ours = CASE.build(
        deepcopy(networks), tau=0.0, tau_prime=ALPHA, delay_actor=False, updater=False, **options
    )
    return ours, sac(deepcopy(networks), **options)


@pytest.mark.parametrize(
    ("kind", "dtype", "reduction", "entry"),
    [
        ("tanh_normal", torch.float32, "mean", None),
        ("tanh_normal", torch.float64, "mean", None),
        ("bounded", torch.float64, "sum", None),
        ("bounded", torch.float64, "mean", "priority_weight"),
        ("tanh_normal", torch.float64, "sum", "priority_weight"),
        ("tanh_normal", torch.float64, "mean", MASK),
    ],
    ids=str,
)
def test_is_sac_without_a_divergence(kind, dtype, reduction, entry):
    """tau = 0, no value network, no delayed actor: losses, all gradients, priorities; by seed."""
    networks = make_networks(kind, dtype=dtype)
    ours, theirs = both(networks, reduction=reduction)
    PolyakAverage(ours)
    SoftUpdate(theirs, tau=0.005)
    for seed in range(3):
        mine = make_batch(kind, dtype=dtype, seed=seed)
        if entry == "priority_weight":
            mine[entry] = torch.linspace(0.5, 2.0, 6).double()
        elif entry == MASK:
            mine[entry] = torch.ones(6, dtype=torch.bool)
        other = mine.clone()
        actual, expected = call(ours, mine, seed), call(theirs, other, seed)
        for name in ("loss_actor", "loss_qvalue"):
            assert_close(actual[name], expected[name], msg=name)
            grads, sacs = gradients(ours, actual[name]), gradients(theirs, expected[name])
            assert list(grads) == list(sacs)
            for key in grads:
                assert_close(grads[key], sacs[key], msg=f"{name} {key}")
        assert_close(mine["td_error"], other["td_error"])


def test_trains_as_sac_does(dtype):
    """Ten steps of Adam with target networks: the same parameters at the end."""
    networks = make_networks(dtype=dtype)
    ours, theirs = both(networks)
    updaters = PolyakAverage(ours, weight=0.1), SoftUpdate(theirs, tau=0.1)
    optimizers = [torch.optim.Adam(loss.parameters(), 1e-2) for loss in (ours, theirs)]
    for step in range(10):
        batch = make_batch(dtype=dtype, seed=step)
        for loss, updater, optimizer in zip((ours, theirs), updaters, optimizers, strict=True):
            outputs = call(loss, batch.clone(), seed=step)
            (outputs["loss_actor"] + outputs["loss_qvalue"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            updater.step()
    tolerance = {"rtol": 1e-3, "atol": 1e-4} if dtype == torch.float32 else {}
    parameters = dict(theirs.named_parameters())
    assert dict(ours.named_parameters()).keys() == parameters.keys()
    for name, mine in ours.named_parameters():
        assert_close(mine, parameters[name], **tolerance, msg=name)
    start = [*make_networks(dtype=dtype).actor.parameters()]
    moved = [x for name, x in ours.named_parameters() if name.startswith("actor")]
    for new, old in zip(moved, start, strict=True):
        assert (new - old).abs().max() > 1e-2
    for name, buffer in ours.named_buffers():
        if name.startswith("target_"):
            assert_close(buffer, dict(theirs.named_buffers())[name], **tolerance, msg=name)


def test_number_of_samples_is_not_the_projections():
    """It draws one action of its own; the others are for metrics and temperatures."""
    one, eight = (call(CASE.build(num_action_samples=n), make_batch()) for n in (1, 8))
    assert_close(one["loss_actor"], eight["loss_actor"])
    assert_close(one["loss_qvalue"], eight["loss_qvalue"])
    assert not torch.allclose(one["entropy"], eight["entropy"])


# ------------------------------------------------------------------------------- the divergence


def test_tau_needs_a_reference_that_differs():
    """A policy does not differ from itself, in value or in gradient."""
    losses = {}
    for tau in (0.0, 5.0):
        for delay_actor in (False, True):
            loss = CASE.build(tau=tau, delay_actor=delay_actor)
            value = call(loss, make_batch())["loss_actor"]
            losses[tau, delay_actor] = value, gradients(loss, value)
    assert_close(losses[5.0, False], losses[0.0, False])
    # Delayed, but not moved yet: the value is the same, the gradient is not.
    assert_close(losses[5.0, True][0], losses[0.0, True][0])
    name = next(iter(losses[0.0, True][1]))
    assert not torch.allclose(losses[5.0, True][1][name], losses[0.0, True][1][name])


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize(("tau", "tau_prime"), [(0.5, 0.25), (1.0, 0.0), (0.6, 0.05)])
def test_gradient_is_that_of_the_divergence_from_the_target(name, tau, tau_prime):
    """(tau + tau') KL(pi, target) of Gaussians, whose gradient is known; four standard errors."""
    loss = gaussian_bandit(
        quadratic(name), loss=PMDACLoss, tau=tau, tau_prime=tau_prime, delay_actor=True
    )
    parameters = list(loss.actor_network.parameters())
    PeriodicCopy(loss, "actor_network", interval=100)
    loc, scale = torch.tensor([0.5, -0.2]).double(), torch.tensor([0.6, 0.9]).double()
    for parameter, value in zip(parameters, (loc, scale), strict=True):
        parameter.data.copy_(value)
    target, _ = _target(name, tau, tau_prime)
    expected = torch.stack(
        [(loc - target.mean) / target.variance, scale / target.variance - 1 / scale]
    )
    torch.manual_seed(0)
    estimates = []
    for _ in range(25):
        divergence = loss.project(loss.states(states(400))).loss.mean()
        grads = torch.autograd.grad(divergence, parameters)
        estimates.append(torch.stack(grads))
    estimates = torch.stack(estimates)
    standard_error = estimates.std(0) / math.sqrt(25)
    deviation = (estimates.mean(0) - (tau + tau_prime) * expected).abs()
    assert (deviation < 4 * standard_error + 1e-9).all()


# ------------------------------------------------------------------------------------- discrete


@pytest.mark.parametrize(
    ("kind", "dtype"), [("categorical", torch.float64), ("one_hot", torch.float32)]
)
def test_discrete_actor_is_discrete_sacs(kind, dtype):
    """At tau = 0 the same gradient; the value differs by the soft value, which is constant.

    What follows is not comparable: here the next state has the value of the lift (Eq. 8), there
    that of the policy.
    """
    networks = make_networks(kind, dtype=dtype)
    ours = DISCRETE.build(deepcopy(networks), tau=0.0, tau_prime=ALPHA, delay_actor=False)
    theirs = sac(
        deepcopy(networks),
        loss=DiscreteSACLoss,
        action_space=kind.replace("_", "-"),
        num_actions=4,
    )
    SoftUpdate(theirs, tau=0.005)
    batch = make_batch(kind, dtype=dtype)
    actual, expected = call(ours, batch), call(theirs, batch)
    assert_close(actual["loss_actor"] - actual["state_value"], expected["loss_actor"])
    assert_close(actual["entropy"], expected["entropy"])
    grads = gradients(ours, actual["loss_actor"])
    sacs = gradients(theirs, expected["loss_actor"])
    for name in grads:
        assert_close(grads[name], sacs[name], msg=name)


@TEMPERATURES
def test_discrete_divergence_by_summation(tau, tau_prime):
    """(tau + tau') KL(pi, target) = E[tau log(pi/pi_bar) + tau' log pi - Q] + soft value."""
    networks, old = make_networks("categorical", seed=2), make_networks("categorical", seed=3)
    loss = DiscretePMDACLoss(
        deepcopy(old.actor), networks.qvalues, tau=tau, tau_prime=tau_prime, reduction="none"
    ).double()
    PolyakAverage(loss)
    loss.from_stateful_net("actor_network", networks.actor)
    batch = make_batch("categorical")
    outputs = loss(batch)
    policy = networks.actor.get_dist(batch).logits.log_softmax(-1)
    reference = old.actor.get_dist(batch).logits.log_softmax(-1)
    score = torch.stack([q(batch.clone())["action_value"] for q in networks.qvalues]).amin(0)
    relative = tau * (policy - reference) + tau_prime * policy - score
    expected = (policy.exp() * relative).sum(-1) + outputs["state_value"]
    assert_close(outputs["loss_actor"], expected.detach(), check_dtype=False)
    assert (outputs["loss_actor"] >= -1e-9).all()


def test_pmd_ac_without_entropy():
    """The paper's PMD-AC: tau' = 0."""
    loss = CASE.build(tau_prime=0.0, delay_actor=True)
    outputs = call(loss, make_batch())
    assert all(output.isfinite() for output in outputs.values())
