"""Proposition 3: for a one-layer softmax, KL(target, pi_theta) is convex in theta, for any target.

The target is fixed, so the cross-entropy of the package's mean-seeking projection differs from the
KL by a constant.
"""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from problems import ONE_LAYER, PROBLEMS, Problem, kl, one_layer, seeds
from torch import Tensor

from torchrl_ecpo.functional import mean_seeking_projection

hidden = pytest.mark.parametrize(
    "problem", [p for p in PROBLEMS if p not in ONE_LAYER], ids=lambda p: p.name
)


def any_target(problem: Problem, seed: int) -> Tensor:
    """A distribution over trajectories, hardly ever one that a policy of the class can have."""
    generator = torch.Generator().manual_seed(seed)
    return (3 * torch.randn(problem.reward.shape, generator=generator).double()).log_softmax(-1)


def loss(problem: Problem, theta: Tensor, lifted: Tensor) -> Tensor:
    return mean_seeking_projection(
        problem.log_prob(theta), lifted.expand(*theta.shape[:-1], -1)
    ).loss


def lowest_curvature(function, problem: Problem, seed: int) -> float:
    theta = problem.parameters(seed, scale=2.0)
    hessian = torch.autograd.functional.hessian(function, theta)
    return torch.linalg.eigvalsh(hessian).min().item()


@given(seed=seeds)
@one_layer
def test_the_hessian_is_positive_semidefinite(problem: Problem, seed):
    lifted = any_target(problem, seed)
    assert lowest_curvature(lambda x: loss(problem, x, lifted), problem, seed + 1) >= -1e-9


@given(seed=seeds)
@one_layer
def test_a_chord_lies_above(problem: Problem, seed):
    lifted = any_target(problem, seed)
    left, right = problem.parameters(seed + 1, 2, scale=3.0)
    share = torch.linspace(0, 1, 21, dtype=torch.float64).unsqueeze(-1)
    values = loss(problem, (1 - share) * left + share * right, lifted)
    chord = (1 - share.squeeze(-1)) * values[0] + share.squeeze(-1) * values[-1]
    assert (values <= chord + 1e-9).all()


@given(seed=seeds)
@one_layer
def test_the_loss_is_the_divergence_up_to_a_constant(problem: Problem, seed):
    lifted = any_target(problem, seed)
    theta = problem.parameters(seed + 1, 5)
    difference = loss(problem, theta, lifted) - kl(lifted, problem.log_prob(theta))
    assert (difference - difference[0]).abs().max() < 1e-9


@hidden
def test_a_hidden_layer_breaks_it(problem: Problem):
    """The premise is needed, and these tests can fail."""
    lifted = any_target(problem, 0)
    curvatures = [
        lowest_curvature(lambda x: loss(problem, x, lifted), problem, seed) for seed in range(10)
    ]
    assert min(curvatures) < -1e-2


@one_layer
def test_the_mode_seeking_divergence_is_not_convex(problem: Problem):
    """Which is the paper's computational argument against PMD."""
    lifted = any_target(problem, 0)
    curvatures = [
        lowest_curvature(lambda x: kl(problem.log_prob(x), lifted), problem, seed)
        for seed in range(10)
    ]
    assert min(curvatures) < -1e-2
