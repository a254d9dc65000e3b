"""Proposition 2: monotone improvement of PMD, and its fixed points.

Exact global solutions of the projection come from classes of finitely many policies, searched
exhaustively: the proposition allows any class. With tau' > 0 (PMD+entropy) the same holds for
E r + tau' H in the place of E r.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import (
    Problem,
    entropy,
    expectation,
    gradient,
    kl,
    mode_seeking_loss,
    seeds,
    target,
    temperatures,
)
from torch import Tensor
from torch.testing import assert_close


def regularised_reward(problem: Problem, policy: Tensor, tau_prime: float) -> Tensor:
    return expectation(policy, problem.reward) + tau_prime * entropy(policy)


@given(tau=temperatures, tau_prime=st.just(0.0) | temperatures, seed=seeds)
def test_reward_never_falls_when_the_projection_is_solved(problem: Problem, tau, tau_prime, seed):
    policies = problem.log_prob(problem.parameters(seed, 50))
    reference = policies[0]
    for _ in range(5):
        lifted = target(problem, reference, tau=tau, tau_prime=tau_prime)
        policy = policies[kl(policies, lifted).argmin()]
        gain = regularised_reward(problem, policy, tau_prime) - regularised_reward(
            problem, reference, tau_prime
        )
        assert gain >= tau * kl(policy, reference) - 1e-9  # which is more than the paper claims
        reference = policy


@given(tau=temperatures, tau_prime=st.just(0.0) | temperatures, seed=seeds)
def test_the_first_project_step_follows_the_reward_gradient(problem: Problem, tau, tau_prime, seed):
    """So a point where the projection does not move is stationary, and the other way round."""
    theta = problem.parameters(seed)
    reference = problem.log_prob(theta)
    projection = gradient(
        lambda x: mode_seeking_loss(
            problem, problem.log_prob(x), reference, tau=tau, tau_prime=tau_prime
        ),
        theta,
    )
    reward = gradient(lambda x: regularised_reward(problem, problem.log_prob(x), tau_prime), theta)
    assert_close((tau + tau_prime) * projection, -reward, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("tau", [0.3, 3.0])
def test_a_stationary_point_is_a_fixed_point(problem: Problem, tau):
    """The reward is drawn from those of which theta is a stationary point."""
    theta = problem.parameters(3)
    policy = problem.log_prob(theta)
    jacobian = torch.autograd.functional.jacobian(problem.log_prob, theta)
    to_gradient = jacobian.T * policy.exp()
    reward = problem.reward - torch.linalg.pinv(to_gradient) @ (to_gradient @ problem.reward)
    stationary = Problem("stationary", reward, problem.log_prob, problem.num_parameters)
    moved = theta
    for _ in range(20):
        moved = moved - 0.1 * gradient(
            lambda x: mode_seeking_loss(
                stationary, problem.log_prob(x), policy, tau=tau, tau_prime=0.0
            ),
            moved,
        )
    assert_close(moved, theta, atol=1e-9, rtol=0)
    away = gradient(
        lambda x: mode_seeking_loss(problem, problem.log_prob(x), policy, tau=tau, tau_prime=0.0),
        theta,
    )
    assert away.norm() > 1e-3  # with the reward as it was, it is not
