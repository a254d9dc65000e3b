"""Proposition 1: the maximisers of Eq. 2 are the minimisers of the lift-and-project problem, Eq. 3.

The two objectives are an affine map of each other, whatever the parametrisation:
(tau + tau') KL(pi, lifted) = max over the simplex of the lift's objective - that objective at pi.
With tau' > 0 the same holds for PMD+entropy.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import (
    Problem,
    gradient,
    kl,
    lift_objective,
    minimise,
    mode_seeking_loss,
    seeds,
    target,
    temperatures,
)
from torch.testing import assert_close

from torchrl_ecpo.functional import soft_value


@given(tau=temperatures, tau_prime=st.just(0.0) | temperatures, seed=seeds)
def test_the_objectives_are_affine_in_each_other(problem: Problem, tau, tau_prime, seed):
    at = {"tau": tau, "tau_prime": tau_prime}
    policies = problem.log_prob(problem.parameters(seed, 10))
    reference = problem.log_prob(problem.parameters(seed + 1))
    divergence = kl(policies, target(problem, reference, **at))
    shortfall = soft_value(problem.reward, reference, **at) - lift_objective(
        problem, policies, reference, **at
    )
    assert_close((tau + tau_prime) * divergence, shortfall, atol=1e-9, rtol=1e-9)


@given(tau=temperatures, tau_prime=st.just(0.0) | temperatures, seed=seeds)
def test_the_gradients_are_proportional(problem: Problem, tau, tau_prime, seed):
    at = {"tau": tau, "tau_prime": tau_prime}
    theta, other = problem.parameters(seed, 2)
    reference = problem.log_prob(other)
    projection = gradient(
        lambda x: mode_seeking_loss(problem, problem.log_prob(x), reference, **at), theta
    )
    objective = gradient(
        lambda x: lift_objective(problem, problem.log_prob(x), reference, **at), theta
    )
    assert_close((tau + tau_prime) * projection, -objective, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize(("tau", "tau_prime"), [(0.5, 0.0), (0.1, 0.3)])
def test_the_best_of_a_finite_class_is_the_same(problem: Problem, tau, tau_prime):
    """However non-convex the class: here a thousand policies without any structure."""
    at = {"tau": tau, "tau_prime": tau_prime}
    policies = problem.log_prob(problem.parameters(0, 1000, scale=2.0))
    for reference in policies[:10]:
        nearest = kl(policies, target(problem, reference, **at)).argmin()
        assert nearest == lift_objective(problem, policies, reference, **at).argmax()


@pytest.mark.parametrize(("tau", "tau_prime"), [(0.5, 0.0), (0.1, 0.3)])
def test_descent_on_either_ends_at_the_same_policy(problem: Problem, tau, tau_prime):
    at = {"tau": tau, "tau_prime": tau_prime}
    start, other = problem.parameters(7, 2, scale=0.3)
    reference = problem.log_prob(other)
    lifted = target(problem, reference, **at)
    best = minimise(lambda x: -lift_objective(problem, problem.log_prob(x), reference, **at), start)
    nearest = minimise(lambda x: kl(problem.log_prob(x), lifted), start)
    assert_close(problem.log_prob(nearest).exp(), problem.log_prob(best).exp(), atol=1e-5, rtol=0)
    # Both are where the package's project step comes to rest.
    rest = gradient(
        lambda x: mode_seeking_loss(problem, problem.log_prob(x), reference, **at), best
    )
    assert_close(rest, torch.zeros_like(rest), atol=1e-5, rtol=0)
    if problem.name.startswith("tabular-1x"):  # its policies are the whole simplex
        assert_close(problem.log_prob(best).exp(), lifted.exp(), atol=1e-5, rtol=0)
