"""Problems small enough to list every trajectory, and the exact quantities the claims speak of.

A *policy* here is the vector of its log-probabilities over all n trajectories, in float64. Whatever
the package can compute is taken from the package, so that a mistake in it fails a claim; the plain
definitions (expected reward, KL, entropy) are written out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from hypothesis import strategies as st
from torch import Tensor

from torchrl_ecpo.functional import (
    lifted_log_weights,
    mean_seeking_projection,
    mode_seeking_projection,
)


@dataclass(frozen=True)
class Problem:
    """A deterministic MDP, all its trajectories, and a family of policies for it."""

    name: str
    reward: Tensor
    """``[n]``, the return of each trajectory."""
    log_prob: Callable[[Tensor], Tensor]
    """From parameters ``[..., d]`` to the log-probabilities ``[..., n]`` of all trajectories."""
    num_parameters: int

    def parameters(self, seed: int, *shape: int, scale: float = 1.0) -> Tensor:
        """``[*shape, d]``, drawn from a Gaussian."""
        generator = torch.Generator().manual_seed(seed)
        return scale * torch.randn(
            *shape, self.num_parameters, generator=generator, dtype=torch.float64
        )


def make_problem(
    family: str, *, num_states: int, num_actions: int, horizon: int, seed: int = 0
) -> Problem:
    """A random MDP under a softmax policy.

    Args:
        family: "tabular", "linear" (one-layer softmax of two features, so that most policies are
            out of reach) or "hidden" (a layer of two tanh units between: nothing is convex).
        num_states: how many states; 1 with horizon 1 is a bandit.
        num_actions: how many actions.
        horizon: actions in a trajectory, of which there are num_actions ** horizon.
        seed: of the transitions, rewards and features.
    """
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    transition = torch.randint(num_states, (num_states, num_actions), generator=generator)
    step_reward = randn(num_states, num_actions)
    features = randn(num_states, num_actions, 2)

    actions = torch.cartesian_prod(*[torch.arange(num_actions)] * horizon).reshape(-1, horizon)
    state, states = torch.zeros(len(actions), dtype=torch.long), []
    for action in actions.unbind(-1):
        states.append(state)
        state = transition[state, action]
    states = torch.stack(states, -1)

    def logits(theta: Tensor) -> Tensor:
        if family == "tabular":
            return theta.unflatten(-1, (num_states, num_actions))
        if family == "linear":
            return torch.einsum("sad,...d->...sa", features, theta)
        units = torch.tanh(features * theta[..., None, None, :] + features.flip(-1))
        return 3 * (units[..., 0] - units[..., 1])

    def log_prob(theta: Tensor) -> Tensor:
        return logits(theta).log_softmax(-1)[..., states, actions].sum(-1)

    return Problem(
        name=f"{family}-{num_states}x{num_actions}x{horizon}",
        reward=step_reward[states, actions].sum(-1),
        log_prob=log_prob,
        num_parameters=num_states * num_actions if family == "tabular" else 2,
    )


BANDIT = {"num_states": 1, "num_actions": 6, "horizon": 1}
MDP = {"num_states": 3, "num_actions": 2, "horizon": 3}
PROBLEMS = [
    make_problem(family, **size)
    for size in (BANDIT, MDP)
    for family in ("tabular", "linear", "hidden")
]
ONE_LAYER = [problem for problem in PROBLEMS if not problem.name.startswith("hidden")]
one_layer = pytest.mark.parametrize("problem", ONE_LAYER, ids=lambda problem: problem.name)

temperatures = st.floats(-2, 1).map(lambda exponent: 10.0**exponent)
"""Positive, from 0.01 to 10."""
seeds = st.integers(0, 2**20)


def target(problem: Problem, reference: Tensor, *, tau: float, tau_prime: float) -> Tensor:
    """The lifted policy of the reference: Eq. 5."""
    log_weights = lifted_log_weights(problem.reward, reference, tau=tau, tau_prime=tau_prime)
    return (log_weights + reference).log_softmax(-1)


def mean_seeking_loss(
    problem: Problem, policy: Tensor, reference: Tensor, *, tau: float, tau_prime: float
) -> Tensor:
    """Cross-entropy from the target, KL(target, pi) + H(target): the group has every trajectory
    once, as if a uniform policy had drawn it, so that Eq. 6 is exact."""
    log_weights = lifted_log_weights(problem.reward, reference, tau=tau, tau_prime=tau_prime)
    return mean_seeking_projection(policy, log_weights + reference).loss


def mode_seeking_loss(
    problem: Problem, policy: Tensor, reference: Tensor, *, tau: float, tau_prime: float
) -> Tensor:
    """A loss with the exact gradient of KL(pi, target), by the same trick."""
    log_weights = lifted_log_weights(problem.reward, reference, tau=tau, tau_prime=tau_prime)
    uniform = torch.full_like(reference, -math.log(reference.shape[-1]))
    return mode_seeking_projection(policy, reference, log_weights, behaviour_log_prob=uniform).loss


def expectation(policy: Tensor, values: Tensor) -> Tensor:
    return (policy.exp() * values).sum(-1)


def kl(policy: Tensor, other: Tensor) -> Tensor:
    return expectation(policy, policy - other)


def entropy(policy: Tensor) -> Tensor:
    return -expectation(policy, policy)


def lift_objective(
    problem: Problem, policy: Tensor, reference: Tensor, *, tau: float, tau_prime: float
) -> Tensor:
    """E r - tau KL(pi, pi_bar) + tau' H(pi): Eq. 2, and the Lift of Eq. 3 and 4."""
    reward = expectation(policy, problem.reward)
    return reward - tau * kl(policy, reference) + tau_prime * entropy(policy)


def minimise(loss: Callable[[Tensor], Tensor], theta: Tensor) -> Tensor:
    """A local minimiser by L-BFGS with a line search; the global one of a convex loss."""
    theta = theta.detach().clone().requires_grad_()
    optimizer = torch.optim.LBFGS(
        [theta],
        max_iter=500,
        tolerance_grad=1e-10,
        tolerance_change=1e-14,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = loss(theta)
        value.backward()
        return value

    optimizer.step(closure)
    return theta.detach()


def gradient(function: Callable[[Tensor], Tensor], theta: Tensor) -> Tensor:
    theta = theta.detach().requires_grad_()
    return torch.autograd.grad(function(theta), theta)[0]
