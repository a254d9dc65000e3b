"""Theorem 1: ECPO's regret is at most 4 sqrt(T log n), for both choices of temperatures.

Tested on the simplex and on two convex subsets of it, on which the projection min_pi KL(q, pi) is
solved exactly by bisection: policies that give every action at least a floor (where both directions
of KL have the same projection), and policies with an expectation of at least b (where they differ).
Rewards are in [0, 1]. The paper's are fixed, and its policy t has seen them. We also let them
change, at random and against the policy, and let policy t see only the rewards before t: the bound
held there as well, although the paper does not claim it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from torchrl_ecpo.functional import lifted_log_weights, theorem1_temperatures


def bisect(excess: Callable[[Tensor], Tensor], low: Tensor, high: Tensor) -> Tensor:
    """Where the decreasing function changes its sign."""
    for _ in range(50):
        middle = (low + high) / 2
        positive = excess(middle) > 0
        low, high = middle.where(positive, low), high.where(positive, middle)
    return high


class Simplex:
    """All distributions."""

    def project(self, probability: Tensor) -> Tensor:
        return probability

    def best(self, reward: Tensor) -> Tensor:
        """Largest expected reward of its members."""
        return reward.amax(-1)


class Floor(Simplex):
    """Distributions that give every action half of what the uniform one gives."""

    def project(self, probability: Tensor) -> Tensor:
        floor = 0.5 / probability.shape[-1]
        one = torch.ones_like(probability[..., :1])

        def scaled(divisor: Tensor) -> Tensor:
            return (probability / divisor).clamp_min(floor)

        return scaled(bisect(lambda d: scaled(d).sum(-1, keepdim=True) - 1, one, 4 * one))

    def best(self, reward: Tensor) -> Tensor:
        return 0.5 * reward.mean(-1) + 0.5 * reward.amax(-1)


class Expectation(Simplex):
    """Distributions under which i / (n - 1), i the action, has an expectation of at least 0.7."""

    bound = 0.7

    def features(self, n: int) -> Tensor:
        return torch.linspace(0, 1, n, dtype=torch.float64)

    def project(self, probability: Tensor) -> Tensor:
        slack = self.bound - self.features(probability.shape[-1])
        zero = torch.zeros_like(probability[..., :1])

        def tilted(multiplier: Tensor) -> Tensor:
            return probability / (1 + multiplier * slack)

        # The multiplier is below where the last action's weight would become infinite.
        limit = zero + (1 - 1e-12) / (1 - self.bound)
        return tilted(bisect(lambda m: (tilted(m) * slack).sum(-1, keepdim=True), zero, limit))

    def best(self, reward: Tensor) -> Tensor:
        """At a corner: one action that meets the bound, or two that meet it together."""
        features = self.features(reward.shape[-1])
        meets = features >= self.bound
        high, low = features[meets, None], features[~meets]
        share = (self.bound - low) / (high - low)
        pairs = share * reward[..., meets, None] + (1 - share) * reward[..., None, ~meets]
        return torch.maximum(reward[..., meets].amax(-1), pairs.flatten(-2).amax(-1))


CLASSES = [Simplex(), Floor(), Expectation()]
every_class = pytest.mark.parametrize("policies", CLASSES, ids=lambda c: type(c).__name__)


def choices(t: int, *horizons: int, n: int) -> Tensor:
    """(tau, tau') of lift t, `[2, C, 1, 1]`: varying ones, then constant ones for each horizon."""
    pairs = [theorem1_temperatures(horizon, n) for horizon in (t, *horizons)]
    return torch.tensor(pairs, dtype=torch.float64).T[..., None, None]


def lift_and_project(
    policy: Tensor, reward: Tensor, policies: Simplex, temperatures: Tensor
) -> Tensor:
    """`[C, P, n]` to the same: P problems under each of the C choices of temperatures."""
    (tau, tau_prime), log_prob = temperatures, policy.log()
    log_weights = lifted_log_weights(reward, log_prob, tau=tau, tau_prime=tau_prime)
    return policies.project((log_weights + log_prob).softmax(-1))


def uniform(policies: Simplex, *shape: int) -> Tensor:
    return policies.project(torch.full(shape, 1 / shape[-1], dtype=torch.float64))


def fixed_rewards(n: int) -> Tensor:
    """`[problems, n]`: one good action, one bad, half good, a ladder up and down, random ones."""
    generator = torch.Generator().manual_seed(n)
    ladder = torch.arange(n, dtype=torch.float64)
    first = ladder == 0
    special = [first, ~first, ladder % 2, ladder / (n - 1), 1 - ladder / (n - 1)]
    random = torch.rand(8, n, generator=generator, dtype=torch.float64)
    return torch.cat([torch.stack([row.double() for row in special]), random, random**8])


def assert_bounded(regret: Tensor, t: int, horizons: tuple[int, ...], n: int) -> None:
    """Below the bound: at each t where temperatures vary, at their horizon where they do not."""
    for horizon, of_choice in zip((t, *horizons), regret, strict=True):
        assert t != horizon or (of_choice <= 4 * math.sqrt(t * math.log(n))).all()


@every_class
@pytest.mark.parametrize("n", [2, 10, 100])
@pytest.mark.parametrize("horizons", [(1, 10, 100), pytest.param((400,), marks=pytest.mark.slow)])
def test_regret_with_fixed_rewards(policies: Simplex, n, horizons):
    """Policy t is the lift of policy t - 1, as the theorem says."""
    reward = fixed_rewards(n).expand(1 + len(horizons), -1, -1)
    policy = uniform(policies, *reward.shape)
    regret = torch.zeros(reward.shape[:-1], dtype=torch.float64)
    for t in range(1, max(horizons) + 1):
        policy = lift_and_project(policy, reward, policies, choices(t, *horizons, n=n))
        regret += policies.best(reward) - (policy * reward).sum(-1)
        assert_bounded(regret, t, horizons, n)
    assert (regret >= -1e-9).all()


@every_class
def test_regret_with_changing_rewards_seen_afterwards(policies: Simplex):
    """At random, alternating, drifting from action to action, and against the policy."""
    n, horizon = 10, 200
    generator = torch.Generator().manual_seed(n)
    actions = torch.arange(n)
    policy = uniform(policies, 2, 4, n)
    earned, total = torch.zeros(2, 4, dtype=torch.float64), torch.zeros_like(policy)
    for t in range(1, horizon + 1):
        random = torch.rand(n, generator=generator, dtype=torch.float64)
        drifting = actions == (n * t) // (horizon + 1)
        reward = torch.stack([random, (actions + t) % 2, drifting, actions]).repeat(2, 1, 1)
        reward[:, 3] = (policy[:, 3] < policy[:, 3].amax(-1, keepdim=True)).double()
        earned += (policy * reward).sum(-1)
        total += reward
        assert_bounded(policies.best(total) - earned, t, (horizon,), n)
        policy = lift_and_project(policy, reward, policies, choices(t, horizon, n=n))


def test_the_regret_of_wrong_temperatures_is_above_the_bound():
    """Large temperatures all along: the policy stays where it was. So the bound can be broken."""
    n, horizon = 10, 200
    reward = fixed_rewards(n).expand(2, -1, -1)
    policy = uniform(Simplex(), *reward.shape)
    regret = torch.zeros(reward.shape[:-1], dtype=torch.float64)
    for t in range(1, horizon + 1):
        wrong = choices(t, horizon, n=n).flip(0)
        policy = lift_and_project(policy, reward, Simplex(), wrong)
        regret += reward.amax(-1) - (policy * reward).sum(-1)
    assert (regret.amax(-1) > 4 * math.sqrt(horizon * math.log(n))).all()


@every_class
def test_the_projections_are_projections(policies: Simplex):
    """In the class, and no nearer member among mixtures with others of the class."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(40, 6, generator=generator, dtype=torch.float64) ** 4
    points = points / points.sum(-1, keepdim=True)
    projected = policies.project(points)
    assert_close(projected.sum(-1), torch.ones(40, dtype=torch.float64))
    assert_close(policies.project(projected), projected, atol=1e-9, rtol=0)
    reward = torch.rand(20, 1, 6, generator=generator, dtype=torch.float64)
    assert ((projected * reward).sum(-1) <= policies.best(reward) + 1e-9).all()

    def cross_entropy(probability: Tensor) -> Tensor:
        return -(points * probability.log()).sum(-1)

    for other in projected:
        mixture = 0.99 * projected + 0.01 * other
        assert (cross_entropy(projected) <= cross_entropy(mixture) + 1e-12).all()
