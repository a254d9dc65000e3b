"""Theorem 2: monotone improvement of ECPO in the surrogate reward SR (Eq. 7), and its fixed points.

The projection is solved globally in two ways: by exhaustive search of a class of finitely many
policies, and by L-BFGS where Proposition 3 makes it convex.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import (
    PROBLEMS,
    Problem,
    expectation,
    gradient,
    kl,
    mean_seeking_loss,
    minimise,
    one_layer,
    seeds,
    target,
    temperatures,
)
from torch.testing import assert_close

from torchrl_ecpo.functional import surrogate_reward


@given(tau=st.just(0.0) | temperatures, tau_prime=temperatures, seed=seeds)
def test_sr_never_falls_when_the_projection_is_solved(problem: Problem, tau, tau_prime, seed):
    at = {"tau": tau, "tau_prime": tau_prime}
    policies = problem.log_prob(problem.parameters(seed, 50))
    reference = policies[0]
    for _ in range(5):
        losses = mean_seeking_loss(problem, policies, reference.expand_as(policies), **at)
        policy = policies[losses.argmin()]
        lifted = target(problem, reference, **at)
        gain = surrogate_reward(problem.reward, policy, **at) - surrogate_reward(
            problem.reward, reference, **at
        )
        # More than the paper claims: SR gains at least tau times what the projection gained.
        assert gain >= tau * (kl(lifted, reference) - kl(lifted, policy)) - 1e-9
        assert gain >= -1e-9
        reference = policy


@pytest.mark.parametrize(("tau", "tau_prime"), [(0.3, 0.0), (0.3, 0.1), (0.1, 1.0)])
@one_layer
def test_sr_never_falls_when_the_convex_projection_is_solved(problem: Problem, tau, tau_prime):
    at = {"tau": tau, "tau_prime": tau_prime}
    theta = problem.parameters(2)
    values = []
    for _ in range(6):
        reference = problem.log_prob(theta)
        values.append(surrogate_reward(problem.reward, reference, **at))
        theta = minimise(
            lambda x, fixed=reference: mean_seeking_loss(problem, problem.log_prob(x), fixed, **at),
            theta,
        )
    gains = torch.stack(values).diff()
    assert (gains >= -1e-9).all()
    assert gains.max() > 1e-4


def test_expected_reward_may_fall_meanwhile():
    """The theorem is about SR: with entropy in the lift, E r need not grow."""
    problem = PROBLEMS[0]
    reference = (10 * problem.reward).log_softmax(-1)
    lifted = target(problem, reference, tau=0.1, tau_prime=1.0)
    assert expectation(lifted, problem.reward) < expectation(reference, problem.reward)
    at = {"tau": 0.1, "tau_prime": 1.0}
    assert surrogate_reward(problem.reward, lifted, **at) > surrogate_reward(
        problem.reward, reference, **at
    )


@given(tau=temperatures, tau_prime=st.just(0.0) | temperatures, seed=seeds)
def test_the_first_project_step_follows_the_gradient_of_sr(problem: Problem, tau, tau_prime, seed):
    """grad KL(lifted, pi_theta) = -grad SR / tau at the reference, where SR is not constant."""
    at = {"tau": tau, "tau_prime": tau_prime}
    theta = problem.parameters(seed)
    reference = problem.log_prob(theta)
    projection = gradient(
        lambda x: mean_seeking_loss(problem, problem.log_prob(x), reference, **at), theta
    )
    ascent = gradient(lambda x: surrogate_reward(problem.reward, problem.log_prob(x), **at), theta)
    assert_close(tau * projection, -ascent, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize(("tau", "tau_prime"), [(0.3, 0.0), (0.3, 0.1), (3.0, 1.0)])
def test_a_stationary_point_of_sr_is_a_fixed_point(problem: Problem, tau, tau_prime):
    """The reward is chosen such that theta is stationary: its target has no mean score function."""
    at = {"tau": tau, "tau_prime": tau_prime}
    theta = problem.parameters(3)
    policy = problem.log_prob(theta)
    jacobian = torch.autograd.functional.jacobian(problem.log_prob, theta)
    to_gradient = jacobian.T * policy.exp()
    tilt = problem.reward - torch.linalg.pinv(to_gradient) @ (to_gradient @ problem.reward)
    tilted = policy.exp() * (1 + 0.5 * tilt / tilt.abs().max())
    reward = (tau + tau_prime) * tilted.log() - tau * policy  # whose target it is, by Eq. 5
    stationary = Problem("stationary", reward, problem.log_prob, problem.num_parameters)
    sr_gradient = gradient(lambda x: surrogate_reward(reward, problem.log_prob(x), **at), theta)
    assert_close(sr_gradient, torch.zeros_like(theta), atol=1e-9, rtol=0)
    moved = theta
    for _ in range(20):
        moved = moved - 0.1 * gradient(
            lambda x: mean_seeking_loss(stationary, problem.log_prob(x), policy, **at), moved
        )
    assert_close(moved, theta, atol=1e-9, rtol=0)


@given(tau_prime=temperatures, seed=seeds)
def test_without_divergence_sr_is_the_same_for_every_policy(problem: Problem, tau_prime, seed):
    """At tau = 0 the theorem is true and empty: the lift has forgotten its reference."""
    values = [
        surrogate_reward(problem.reward, policy, tau=0.0, tau_prime=tau_prime)
        for policy in problem.log_prob(problem.parameters(seed, 2))
    ]
    assert_close(values[0], values[1])
