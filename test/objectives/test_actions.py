"""Sampling actions, and telling kinds of policies apart."""

from __future__ import annotations

import math

import pytest
import torch
from torch.distributions import (
    AffineTransform,
    Bernoulli,
    Beta,
    Categorical,
    ExpTransform,
    Independent,
    IndependentTransform,
    MultivariateNormal,
    Normal,
    OneHotCategorical,
    TanhTransform,
    TransformedDistribution,
)
from torch.testing import assert_close
from torchrl.modules import IndependentNormal, MaskedCategorical, TanhNormal, TruncatedNormal
from torchrl.modules import OneHotCategorical as TorchRLOneHotCategorical

from torchrl_ecpo.objectives.actions import (
    AllActions,
    SampledActions,
    gaussian_parameters,
    is_discrete,
)

LOC = torch.tensor([[0.3, -1.0], [0.0, 2.0], [-0.5, 0.1]], dtype=torch.float64)
SCALE = torch.tensor([[0.5, 1.0], [0.2, 0.3], [1.5, 0.7]], dtype=torch.float64)


def _torch_tanh(loc, scale):
    base = Independent(Normal(loc, scale), 1)
    return TransformedDistribution(base, [TanhTransform(), AffineTransform(0.5, 2.5)])


GAUSSIAN = {
    "normal": lambda loc, scale: Independent(Normal(loc, scale), 1),
    "torchrl_normal": IndependentNormal,
    "tanh": lambda loc, scale: TanhNormal(loc, scale),
    "bounded": lambda loc, scale: TanhNormal(loc, scale, low=-2.0, high=3.0),
    "torch_bounded": _torch_tanh,
    "joint_tanh": lambda loc, scale: TransformedDistribution(
        Independent(Normal(loc, scale), 1),
        [IndependentTransform(TanhTransform(), 1), AffineTransform(0.5, 2.5, event_dim=1)],
    ),
}


@pytest.mark.parametrize("kind", GAUSSIAN)
def test_samples_are_those_of_the_policy(kind, dtype):
    """Values, gradients, and the same log-probability as by inverting the transform."""
    loc, scale = (x.to(dtype).requires_grad_() for x in (LOC, SCALE))
    policy = GAUSSIAN[kind](loc, scale)
    assert_close(gaussian_parameters(policy), (loc, scale))
    torch.manual_seed(0)
    actions = SampledActions.of(policy, 5)
    assert {x.dtype for x in (actions.log_prob, actions.action, actions.latent)} == {dtype}
    torch.manual_seed(0)
    assert_close(actions.latent, loc + scale * torch.randn(5, 3, 2, dtype=dtype))
    expected = actions.latent
    if kind == "tanh":
        expected = actions.latent.tanh()
    elif kind not in ("normal", "torchrl_normal"):
        expected = 0.5 + 2.5 * actions.latent.tanh()
    assert_close(actions.action, expected)
    tolerance = {"rtol": 1e-3, "atol": 1e-3} if dtype == torch.float32 else {}
    assert_close(actions.log_prob, policy.log_prob(actions.action), **tolerance)
    # Of the same transform: its log-volume is that of the samples.
    other = GAUSSIAN[kind](loc + 0.3, scale * 1.2)
    assert_close(actions.log_prob_of(other), other.log_prob(actions.action), **tolerance)
    for output in (actions.action, actions.log_prob):
        for gradient in torch.autograd.grad(output.sum(), (loc, scale), retain_graph=True):
            assert gradient.isfinite().all()
    # A translation moves every sample alike.
    gradient = torch.autograd.grad(actions.latent.sum(), loc)[0]
    assert_close(gradient, torch.full_like(loc, 5.0))


@pytest.mark.parametrize("kind", ["tanh", "bounded"])
def test_saturated_actions_are_never_inverted(kind, dtype):
    """tanh(30) is 1: its inverse is not 30, but the log-probability is that of 30."""
    loc = torch.full((1, 2), 30.0, dtype=dtype)
    policy = GAUSSIAN[kind](loc, torch.full_like(loc, 1e-3))
    actions = SampledActions.of(policy, 4)
    stretch = math.log(2.5) if kind == "bounded" else 0.0
    normal = Normal(loc, 1e-3).log_prob(actions.latent)
    expected = normal - (math.log(4) - 2 * actions.latent) - stretch
    assert_close(actions.log_prob, expected.sum(-1), rtol=1e-4, atol=1e-3)
    assert actions.log_prob.isfinite().all()


@pytest.mark.parametrize(
    ("policy", "width"),
    [
        (GAUSSIAN["normal"](LOC, SCALE), math.inf),
        *((GAUSSIAN[kind](LOC, SCALE), 5) for kind in ("bounded", "torch_bounded", "joint_tanh")),
        (TanhNormal(LOC, SCALE), 2),
        (TruncatedNormal(LOC, SCALE, low=-0.5, high=0.5), 1),
        (TransformedDistribution(Independent(Normal(LOC, SCALE), 1), [ExpTransform()]), math.inf),
    ],
    ids=lambda x: type(x).__name__,
)
def test_no_policy_has_more_entropy_than_the_volume_allows(policy, width):
    low, high = SampledActions.of(policy, 5).entropy_range(policy)
    assert low == -math.inf
    assert_close(high, torch.full((3,), 2 * math.log(width), dtype=torch.float64))


OTHERS = {
    "Beta": Independent(Beta(LOC.exp(), SCALE), 1),
    "MultivariateNormal": MultivariateNormal(LOC, torch.eye(2).double()),
    "TruncatedNormal": TruncatedNormal(LOC, SCALE),
}


@pytest.mark.parametrize("name", OTHERS)
def test_policies_that_are_no_diagonal_gaussians(name):
    """They can be sampled, not centred; the message says what to do."""
    policy = OTHERS[name]
    actions = SampledActions.of(policy, 5)
    assert_close(actions.log_prob, policy.log_prob(actions.action))
    assert_close(actions.log_prob_of(policy), actions.log_prob)
    kind = type(policy).__name__
    message = f'needs a diagonal Gaussian.*got {kind}.*projection="paper".* takes any'
    with pytest.raises(ValueError, match=message):
        gaussian_parameters(policy)


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        (Categorical(logits=LOC), True),
        (OneHotCategorical(logits=LOC), True),
        (TorchRLOneHotCategorical(logits=LOC), True),
        (MaskedCategorical(logits=LOC, mask=torch.ones(3, 2, dtype=torch.bool)), True),
        (Bernoulli(logits=LOC), False),  # n coins are not one of n
        *((make(LOC, SCALE), False) for make in GAUSSIAN.values()),
        *((policy, False) for policy in OTHERS.values()),
    ],
    ids=lambda x: type(x).__name__,
)
def test_is_discrete(policy, expected):
    """Asked of a distribution or of its class."""
    assert is_discrete(policy) is expected
    if not isinstance(policy, (Independent, TransformedDistribution)):
        assert is_discrete(type(policy)) is expected


def test_forbidden_actions_have_no_part_where_q_is_of_higher_precision():
    actions = AllActions.of(MaskedCategorical(torch.zeros(3), mask=torch.arange(3) < 2))
    temperatures = {"tau": torch.tensor(0.0), "tau_prime": torch.tensor(1.0)}
    log_weights, _ = actions.lift(torch.zeros(3, dtype=torch.float64), **temperatures)
    assert log_weights.softmax(0).tolist() == [0.5, 0.5, 0.0]
