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
    total,
)
from tensordict.nn import TensorDictModule
from test_ecac import LOC, SCALE, SCORES, TEMPERATURES, _Parameters, _Score, _target, states
from torch.testing import assert_close
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
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


def assert_same(ours, theirs, batch, seed=0, **tolerance):
    """Losses, all gradients, priorities; and nothing but the random numbers is shared."""
    mine, other = batch.clone(), batch.clone()
    actual, expected = call(ours, mine, seed), call(theirs, other, seed)
    for name in ("loss_actor", "loss_qvalue"):
        assert_close(actual[name], expected[name], **tolerance, msg=name)
        grads, sacs = gradients(ours, actual[name]), gradients(theirs, expected[name])
        assert list(grads) == list(sacs)
        for key in grads:
            assert_close(grads[key], sacs[key], **tolerance, msg=f"{name} {key}")
    assert_close(mine["td_error"], other["td_error"], **tolerance)
    return actual, expected


def test_is_sac_without_a_divergence(dtype):
    """tau = 0, no value network, no delayed actor: losses and gradients, seed for seed."""
    networks = make_networks(dtype=dtype)
    ours, theirs = both(networks)
    PolyakAverage(ours)
    SoftUpdate(theirs, tau=0.005)
    for seed in range(3):
        assert_same(ours, theirs, make_batch(dtype=dtype, seed=seed), seed)


@pytest.mark.parametrize("reduction", ["sum", "mean"])
@pytest.mark.parametrize("entry", [None, "priority_weight", MASK], ids=str)
@pytest.mark.parametrize("kind", ["tanh_normal", "bounded"])
def test_is_sac_with_weights_and_masks(reduction, entry, kind):
    """Whatever the batch brings along."""
    networks = make_networks(kind)
    ours, theirs = both(networks, reduction=reduction)
    PolyakAverage(ours)
    SoftUpdate(theirs, tau=0.005)
    batch = make_batch(kind)
    if entry == "priority_weight":
        batch[entry] = torch.linspace(0.5, 2.0, 6).double()
    elif entry == MASK:
        batch[entry] = torch.ones(6, dtype=torch.bool)
    assert_same(ours, theirs, batch)


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
    start = make_networks(dtype=dtype)
    for (name, mine), (_, other), old in zip(
        ours.named_parameters(),
        theirs.named_parameters(),
        [*start.actor.parameters(), *ours.parameters()],
        strict=False,
    ):
        assert_close(mine, other, **tolerance, msg=name)
        if name.startswith("actor"):
            assert (mine - old).abs().max() > 1e-2
    for name, buffer in ours.named_buffers():
        if name.startswith("target_"):
            assert_close(buffer, dict(theirs.named_buffers())[name], **tolerance, msg=name)


@pytest.mark.parametrize("n", [1, 8])
def test_number_of_samples_is_not_the_projections(n):
    """It draws one action of its own; the others are for metrics and temperatures."""
    outputs = call(CASE.build(num_action_samples=n, delay_actor=True), make_batch())
    expected = call(CASE.build(num_action_samples=3, delay_actor=True), make_batch())
    assert_close(outputs["loss_actor"], expected["loss_actor"])
    assert_close(outputs["loss_qvalue"], expected["loss_qvalue"])
    assert not torch.allclose(outputs["entropy"], expected["entropy"])


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
    slope, curvature = (torch.tensor(x, dtype=torch.float64) for x in SCORES[name])
    parameters = _Parameters(torch.tensor(LOC).double(), torch.tensor(SCALE).double())
    actor = ProbabilisticActor(
        TensorDictModule(parameters, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
    )
    score = _Score(lambda a: slope * a - curvature * a**2 / 2)
    loss = PMDACLoss(
        actor,
        ValueOperator(score, ["observation", "action"]),
        num_qvalue_nets=1,
        delay_qvalue=False,
        tau=tau,
        tau_prime=tau_prime,
        target_entropy=None,
    ).double()
    PeriodicCopy(loss, "actor_network", interval=100)
    loc, scale = torch.tensor([0.5, -0.2]).double(), torch.tensor([0.6, 0.9]).double()
    for parameter, value in zip(parameters.parameters(), (loc, scale), strict=True):
        parameter.data.copy_(value)
    target, _ = _target(name, tau, tau_prime)
    expected = torch.stack(
        [(loc - target.mean) / target.variance, scale / target.variance - 1 / scale]
    )
    torch.manual_seed(0)
    estimates = []
    for _ in range(25):
        batch = states(400)
        divergence, *_ = loss.project(loss.states(batch))
        grads = torch.autograd.grad(divergence.mean(), list(parameters.parameters()))
        estimates.append(torch.stack(grads))
    estimates = torch.stack(estimates)
    standard_error = estimates.std(0) / math.sqrt(25)
    deviation = (estimates.mean(0) - (tau + tau_prime) * expected).abs()
    assert (deviation < 4 * standard_error + 1e-9).all()


# ------------------------------------------------------------------------------------- discrete


@pytest.mark.parametrize("kind", ["categorical", "one_hot"])
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


# --------------------------------------------------------------------------------------- options


def test_defaults():
    """A fixed tau, a learned tau', a delayed reference; one sample."""
    networks = make_networks()
    loss = PMDACLoss(networks.actor, networks.qvalues)
    PolyakAverage(loss)
    outputs = call(loss, make_batch())
    assert loss.out_keys[:3] == ["loss_actor", "loss_qvalue", "loss_tau_prime"]
    assert_close((outputs["tau"], outputs["tau_prime"]), (torch.tensor(0.1), torch.tensor(1.0)))
    assert (loss.target_kl, loss.target_entropy, loss.delay_actor) == (None, "auto", True)
    assert (loss.num_action_samples, loss.num_next_action_samples) == (1, 1)
    total(outputs).backward()
    networks = make_networks("one_hot")
    loss = DiscretePMDACLoss(networks.actor, networks.qvalues)
    PolyakAverage(loss)
    assert_close(call(loss, make_batch("one_hot"))["tau_prime"], torch.tensor(0.1))
    assert (loss.target_kl, loss.target_entropy, loss.delay_actor) == (None, None, True)


def test_pmd_ac_without_entropy():
    """The paper's PMD-AC: tau' = 0."""
    loss = CASE.build(tau_prime=0.0, delay_actor=True)
    outputs = call(loss, make_batch())
    assert all(output.isfinite() for output in outputs.values())


def test_one_sample_shows_no_divergence():
    """A learned tau needs several samples."""
    with pytest.raises(ValueError, match="1 samples cannot show more than log 1 = 0"):
        CASE.build(target_kl=0.1, num_action_samples=1)(make_batch())


def test_projection_is_no_option():
    """It is ECAC's."""
    with pytest.raises(TypeError, match="projection"):
        CASE.build(projection="paper")
