"""Lemma 1: the sampled gradient, Eq. 6, and how it tends to the exact one.

The paper calls the estimator unbiased. That is true in the limit only: the weights are normalised
by their own sum, which biases the mean by O(1/K), below the standard error of O(1/sqrt(K)). Both
rates are measured here, the bias without noise, by listing all samples of size K. What holds for
the paper's projection holds for PMD's, to which the tests apply as well.
"""

from __future__ import annotations

import itertools

import pytest
import torch
from problems import MDP, Problem, gradient, kl, make_problem, target
from torch import Tensor
from torch.testing import assert_close

from torchrl_ecpo.functional import (
    Surrogate,
    lifted_log_weights,
    mean_seeking_projection,
    mode_seeking_projection,
)

# Mild, so that few samples are enough for the asymptotic rates to show.
AT = {"tau": 2.0, "tau_prime": 0.5}


def mean_seeking(log_prob: Tensor, reference: Tensor, log_weights: Tensor) -> Surrogate:
    return mean_seeking_projection(log_prob, log_weights)


def controlled(log_prob: Tensor, reference: Tensor, log_weights: Tensor) -> Surrogate:
    return mean_seeking_projection(log_prob, log_weights, control_log_prob=reference)


ESTIMATORS = {
    "mean_seeking": mean_seeking,
    "mean_seeking_controlled": controlled,
    "mode_seeking": mode_seeking_projection,
}
every_estimator = pytest.mark.parametrize("estimator", ESTIMATORS)


def exact_gradient(problem: Problem, theta: Tensor, reference: Tensor, estimator: str) -> Tensor:
    lifted = target(problem, reference, **AT)

    def divergence(x: Tensor) -> Tensor:
        policy = problem.log_prob(x)
        return kl(policy, lifted) if estimator == "mode_seeking" else kl(lifted, policy)

    return gradient(divergence, theta)


def sampled_gradients(
    problem: Problem, theta: Tensor, reference: Tensor, estimator: str, index: Tensor
) -> Tensor:
    """``[N, d]``: the estimates from N groups of K trajectories, whose ``index`` is ``[N, K]``."""
    log_prob = problem.log_prob(theta)[index].requires_grad_()
    log_weights = lifted_log_weights(problem.reward, reference, **AT)
    loss = ESTIMATORS[estimator](log_prob, reference[index], log_weights[index]).loss
    (coefficients,) = torch.autograd.grad(loss.sum(), log_prob)
    scores = torch.autograd.functional.jacobian(problem.log_prob, theta)  # grad log pi(rho): [n, d]
    return torch.einsum("nk,nkd->nd", coefficients, scores[index])


def multinomial_probability(index: Tensor, reference: Tensor) -> Tensor:
    """Of drawing each row's K trajectories, in whatever order."""
    counts = torch.nn.functional.one_hot(index).sum(-2)
    orders = torch.lgamma(counts.double().sum(-1) + 1) - torch.lgamma(counts.double() + 1).sum(-1)
    return (orders + counts.double() @ reference).exp()


def slope(sizes: list[int], errors: list[Tensor]) -> float:
    """Of the least-squares line through the points on log-log axes."""
    x = torch.tensor(sizes, dtype=torch.float64).log()
    y = torch.stack(errors).log()
    return (((x - x.mean()) * (y - y.mean())).sum() / (x - x.mean()).square().sum()).item()


@every_estimator
def test_the_error_falls_with_the_root_of_the_sample_size(problem: Problem, estimator):
    theta, other = problem.parameters(5, 2, scale=0.5)
    reference = problem.log_prob(other)
    exact = exact_gradient(problem, theta, reference, estimator)
    generator = torch.Generator().manual_seed(0)
    sizes, errors = [64, 256, 1024, 4096], []
    for size in sizes:
        index = torch.multinomial(
            reference.exp().expand(200, -1), size, replacement=True, generator=generator
        )
        estimates = sampled_gradients(problem, theta, reference, estimator, index)
        errors.append((estimates - exact).square().sum(-1).mean().sqrt())
    assert -0.56 < slope(sizes, errors) < -0.44
    assert errors[-1] < 0.25 * exact.norm()


@pytest.mark.parametrize("family", ["tabular", "linear", "hidden"])
@every_estimator
def test_the_bias_falls_with_the_sample_size(family, estimator):
    """By enumeration of all samples: neither zero nor slower than 1/K."""
    problem = make_problem(family, num_states=1, num_actions=3, horizon=1, seed=2)
    theta, other = problem.parameters(5, 2, scale=0.5)
    reference = problem.log_prob(other)
    exact = exact_gradient(problem, theta, reference, estimator)
    sizes, biases = [16, 32, 64], []
    for size in sizes:
        index = torch.tensor(list(itertools.combinations_with_replacement(range(3), size)))
        probability = multinomial_probability(index, reference)
        assert_close(probability.sum().item(), 1.0)
        estimates = sampled_gradients(problem, theta, reference, estimator, index)
        biases.append((probability @ estimates - exact).norm())
    assert biases[-1] > 1e-5
    assert -1.15 < slope(sizes, biases) < -0.85


def test_one_sample_says_nothing_of_the_reward():
    """The plainest case of the bias: with K = 1 the weight is 1, whatever the trajectory."""
    problem = make_problem("tabular", **MDP)
    theta = problem.parameters(5)
    reference = problem.log_prob(theta)
    index = torch.arange(len(reference)).unsqueeze(-1)
    estimates = sampled_gradients(problem, theta, reference, "mean_seeking", index)
    mean = reference.exp() @ estimates
    assert_close(mean, torch.zeros_like(mean))
    assert exact_gradient(problem, theta, reference, "mean_seeking").norm() > 0.1
