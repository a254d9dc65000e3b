r"""Lemma 2: the surrogate reward lies between E r + tau' H and a second-order bound; its limits.

With eta = tau + tau' and r_hat = r - tau' log pi, SR = eta log E exp(r_hat / eta) over pi. Jensen
gives the lower bound. For the upper take out any c >= max r_hat and use exp(x) <= 1 + x + x^2/2 for
x = (r_hat - c) / eta <= 0, then log(1 + y) <= y:

    SR <= E r_hat + E (r_hat - c)^2 / (2 eta).

The paper takes c = ||r_hat||_inf. Where all of r_hat is negative that is more than its maximum, and
the bound looser than need be, but true. (Some prints of the paper read 1/(2n) for 1/(2 eta).)
"""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st
from problems import Problem, entropy, expectation, seeds, temperatures
from torch import Tensor
from torch.testing import assert_close

from torchrl_ecpo.functional import surrogate_reward


def upper_bound(reward_hat: Tensor, policy: Tensor, ceiling: Tensor, scale: float) -> Tensor:
    spread = expectation(policy, (reward_hat - ceiling[..., None]).square())
    return expectation(policy, reward_hat) + spread / (2 * scale)


@given(
    temperature=st.tuples(st.just(0.0) | temperatures, temperatures)
    | st.tuples(temperatures, st.just(0.0)),
    shift=st.floats(-5, 5),
    seed=seeds,
)
def test_bounds(problem: Problem, temperature, shift, seed):
    tau, tau_prime = temperature
    reward = problem.reward + shift  # all signs
    policy = problem.log_prob(problem.parameters(seed, 10, scale=2.0))
    sr = surrogate_reward(reward.expand_as(policy), policy, tau=tau, tau_prime=tau_prime)
    lower = expectation(policy, reward) + tau_prime * entropy(policy)
    reward_hat = reward - tau_prime * policy
    norm, largest = reward_hat.abs().amax(-1), reward_hat.amax(-1)
    assert (sr >= lower - 1e-9).all()
    assert (sr <= upper_bound(reward_hat, policy, largest, tau + tau_prime) + 1e-9).all()
    assert (sr <= upper_bound(reward_hat, policy, norm, tau + tau_prime) + 1e-9).all()


def test_the_constant_is_a_temperature_and_not_a_count():
    """Two actions of probability 1/2: SR = .58 is above the bound read with 1/(2n)."""
    policy = torch.tensor([0.5, 0.5], dtype=torch.float64).log()
    reward = torch.tensor([1.0, 0.0], dtype=torch.float64)
    sr = surrogate_reward(reward, policy, tau=0.1, tau_prime=0.0)
    ceiling = reward.amax(-1)
    assert_close(sr.item(), 1 - 0.1 * 0.6931, atol=1e-4, rtol=0)
    assert sr > upper_bound(reward, policy, ceiling, scale=2)
    assert sr <= upper_bound(reward, policy, ceiling, scale=0.1)


@given(seed=seeds)
def test_limit_without_regularisation_is_the_best_reward(problem: Problem, seed):
    """At least max (r + tau log pi), and at most (tau + tau') log n more."""
    policy = problem.log_prob(problem.parameters(seed))
    best = problem.reward.argmax()
    for tau, tau_prime in [(1e-2, 1e-2), (1e-4, 1e-5), (1e-5, 1e-4), (1e-7, 0.0), (0.0, 1e-7)]:
        sr = surrogate_reward(problem.reward, policy, tau=tau, tau_prime=tau_prime)
        above = (tau + tau_prime) * torch.tensor(float(len(policy))).log()
        assert -tau * -policy[best] - 1e-12 <= sr - problem.reward[best] <= above + 1e-12


@given(tau_prime=st.just(0.0) | temperatures, seed=seeds)
def test_limit_of_infinite_divergence_is_the_regularised_reward(problem: Problem, tau_prime, seed):
    """With the rate: the gap is the variance of r_hat over 2 tau, to first order."""
    policy = problem.log_prob(problem.parameters(seed))
    limit = expectation(policy, problem.reward) + tau_prime * entropy(policy)
    reward_hat = problem.reward - tau_prime * policy
    variance = expectation(policy, (reward_hat - limit).square())
    scale = 1 + reward_hat.abs().max().item()
    for relative in (1e2, 1e3, 1e4):
        tau = relative * scale
        sr = surrogate_reward(problem.reward, policy, tau=tau, tau_prime=tau_prime)
        gap = 2 * (tau + tau_prime) * (sr - limit)
        assert_close(gap, variance, atol=4 * scale**2 / relative + 1e-6, rtol=0)
