"""What is particular to MPO: the dual of its temperature, and the bounds on mean and scale."""

from __future__ import annotations

from copy import deepcopy

import pytest
import torch
from actor_critic_problems import CASES, become, call, gradients, make_batch, make_networks
from torch.testing import assert_close

CASE, BATCH = CASES["mpo"], make_batch()


def lift_of(loss):
    """That of a call: the actions of the next states are drawn before it."""
    torch.manual_seed(0)
    loss.states(BATCH["next"].clone()).reference.rsample((loss.num_next_action_samples,))
    return loss.states(BATCH).lift


@pytest.mark.parametrize("epsilon", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("tau_prime", [0.0, 0.05])
def test_tau_is_where_the_dual_is_least(epsilon, tau_prime):
    """By a search; and the gradient on the way there is the dual's, in units of tau epsilon."""
    loss = CASE.build(epsilon=epsilon, tau_prime=tau_prime)
    lift = lift_of(loss)

    def dual(log_tau):
        """Tau epsilon + tau E log mean exp(Q / tau); with tau' ECPO's."""
        tau, total = log_tau.exp(), log_tau.exp() + tau_prime
        log_weights = (lift.score - tau_prime * lift.actions.log_prob) / total
        return tau * epsilon + total * log_weights.exp().mean(0).log().mean()

    def slope(log_tau):
        loss.log_tau.data.fill_(log_tau)
        outputs = call(loss, BATCH)
        return gradients(loss, outputs["loss_tau"])["log_tau"], outputs["kl_target_reference"]

    for log_tau in (-3.0, -1.0, 0.5):
        at = torch.tensor(log_tau, dtype=torch.float64, requires_grad=True)
        (expected,) = torch.autograd.grad(dual(at), at)
        assert_close(slope(log_tau)[0], expected / (at.exp() * epsilon))
    low, high = -6.0, 2.0
    for _ in range(4):  # the dual has one minimum
        grid = torch.linspace(low, high, 41, dtype=torch.float64)
        least = grid[torch.stack([dual(at) for at in grid]).argmin()]
        low, high = (least.item() + step * (high - low) / 40 for step in (-1, 1))
    slopes = [slope(least + step)[0].item() for step in (-1e-3, 1e-3)]
    assert slopes[0] < 0 < slopes[1]
    assert_close(slope(least)[1].item(), epsilon, rtol=0.005, atol=0)


def test_a_policy_that_is_the_reference_moves_as_ecacs():
    """The bounds have no gradient there, and both parts together are the paper's projection."""
    networks, options = make_networks(), {"delay_actor": True, "num_action_samples": 8}
    ecac = CASES["ecac"].build(deepcopy(networks), projection="paper", **options)
    mpo = CASE.build(deepcopy(networks), num_next_action_samples=1, **options)
    grads = [gradients(loss, call(loss, BATCH.clone())["loss_actor"]) for loss in (ecac, mpo)]
    for name, gradient in grads[0].items():
        assert_close(grads[1][name], gradient, msg=name)


def test_multipliers_weigh_their_divergence_and_rise_where_it_exceeds_its_bound():
    loss = CASE.build()
    become(loss, make_networks(seed=2))
    one = call(loss, BATCH)
    loss.log_alpha_mean.data.fill_(3.0).log_()
    three = call(loss, BATCH)
    assert_close(three["alpha_mean"].item(), 3.0)
    assert_close(three["loss_actor"] - one["loss_actor"], 2 * one["kl_mean"])
    for name, bound in (("mean", 0.01), ("scale", 0.001)):
        slopes = gradients(loss, three[f"loss_alpha_{name}"])
        assert_close(slopes.pop(f"log_alpha_{name}"), 1 - three[f"kl_{name}"] / bound)
        assert not any(slope.any() for slope in slopes.values())


def test_padding_does_not_hold_a_multiplier_at_its_floor():
    """The four real states exceed the bound; with the 60 that are not, the mean would not."""
    loss = CASE.build()
    become(loss, make_networks(seed=2))
    loss.log_alpha_mean.data.fill_(-20.0)
    real = make_batch()[:4]
    padded = torch.cat([real, torch.zeros_like(real).expand(15, 4).reshape(-1)])
    padded["collector", "mask"] = torch.arange(64) < 4
    slopes = []
    for batch in (real, padded):
        torch.manual_seed(0)
        outputs = loss(batch)
        assert outputs["kl_mean"] > 0.01
        slopes.append(gradients(loss, outputs["loss_alpha_mean"])["log_alpha_mean"])
    assert slopes[0] < 0
    assert (slopes[1] < 0).all()


def test_a_temperature_at_its_floor_stays_there():
    """Where Q tells nothing, the target is never far: its temperature falls, but not for ever."""
    loss = CASE.build(min_tau=0.5, tau=0.5)
    loss.qvalue_network_params.data.zero_()
    assert gradients(loss, call(loss, BATCH)["loss_tau"])["log_tau"] == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"epsilon": 0.0}, r"epsilon must be above 0 and below 3, in nats.*got 0\.0"),
        ({"epsilon": 1.4, "num_action_samples": 4}, r"below 1\.39.*num_action_samples=4.*got 1\.4"),
        ({"num_action_samples": 1}, "epsilon must be above 0 and below 0.*num_action_samples=1"),
        ({"epsilon_mean": 0}, r"epsilon_mean must be above 0.*got 0\.0"),
        ({"target_kl": 0.1}, r"MPO's lift has the bound epsilon; got .*target_kl.*0\.1"),
        ({"tau": 0.1, "min_tau": 0.2}, "learned tau must start at min_tau"),
    ],
    ids=str,
)
def test_options_are_checked_at_the_door(options, message):
    with pytest.raises(ValueError, match=message):
        CASE.build(**options)


def test_a_policy_over_n_actions_is_refused():
    """With all their values, as DiscreteECACLoss takes it."""
    networks = make_networks("categorical")
    loss = CASE.build(networks)
    with pytest.raises(ValueError, match=r"needs a diagonal Gaussian policy.*got Categorical"):
        loss(make_batch("categorical"))
