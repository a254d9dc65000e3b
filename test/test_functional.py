"""The equations: numbers worked out by hand, exact enumeration, gradients, and properties."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from torchrl_ecpo.functional import (
    Surrogate,
    centred,
    centred_gaussian_projection,
    check_temperatures,
    clipped_gain,
    divergence_penalty,
    effective_sample_size,
    gaussian_cross_entropy,
    group_cross_entropy,
    leave_one_out,
    lift_divergence_estimate,
    lifted_gaussian_moments,
    lifted_log_weights,
    masked_mean,
    matched_temperature,
    mean_seeking_projection,
    ment_surrogate,
    mode_seeking_projection,
    path_consistency,
    score_function_loss,
    self_normalised_weights,
    soft_value,
    soft_value_estimate,
    squared_residual_projection,
    standardised,
    standardised_in_batch,
    surrogate_reward,
    temperature_dual,
    theorem1_temperatures,
    uniform_weights,
    urex_surrogate,
    weighted_sum,
)

DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)


def vector(*values: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(values, dtype=dtype)


def gradient(loss: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    at = at.detach().requires_grad_()
    return torch.autograd.grad(loss(at).sum(), at)[0]


# ------------------------------------------------------------------ every function, one signature


class Samples(NamedTuple):
    """What the functions read, each ``[E*, K]``."""

    score: Tensor
    log_prob: Tensor
    reference: Tensor
    behaviour: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> Samples:
        return Samples(*map(function, self))


class Result(NamedTuple):
    """``value`` is [E*]; ``per_sample`` is [E*, K]: the gradients and, of a surrogate, weights."""

    value: Tensor
    per_sample: tuple[Tensor, ...]


def _lift(x: Samples, tau, tau_prime) -> Tensor:
    return lifted_log_weights(x.score, x.reference, tau=tau, tau_prime=tau_prime)


def _mean_seeking(x: Samples, tau, tau_prime, **where) -> Surrogate:
    return mean_seeking_projection(x.log_prob, _lift(x, tau, tau_prime), **where)


def _mean_seeking_controlled(x: Samples, tau, tau_prime, **where) -> Surrogate:
    log_weights = _lift(x, tau, tau_prime) + x.reference - x.behaviour
    return mean_seeking_projection(x.log_prob, log_weights, control_log_prob=x.behaviour, **where)


def _mode_seeking(x: Samples, tau, tau_prime, **where) -> Surrogate:
    return mode_seeking_projection(x.log_prob, x.reference, _lift(x, tau, tau_prime), **where)


def _mode_seeking_older_data(x: Samples, tau, tau_prime, **where) -> Surrogate:
    log_weights = _lift(x, tau, tau_prime)
    return mode_seeking_projection(
        x.log_prob, x.reference, log_weights, behaviour_log_prob=x.behaviour, **where
    )


def _urex(x: Samples, tau, tau_prime, **where) -> Surrogate:
    return urex_surrogate(x.log_prob, x.score, tau=tau, **where)


def _ment(x: Samples, tau, tau_prime, **where) -> Surrogate:
    return ment_surrogate(x.log_prob, x.score, tau=tau, **where)


def _squared_residual(x: Samples, tau, tau_prime, **where) -> Surrogate:
    log_weights = _lift(x, tau, tau_prime)
    return squared_residual_projection(
        x.log_prob, x.reference, log_weights, behaviour_log_prob=x.behaviour, **where
    )


def _squared_residual_soft(x: Samples, tau, tau_prime, **where) -> Surrogate:
    log_weights = _lift(x, tau, tau_prime)
    return squared_residual_projection(
        x.log_prob, x.reference, log_weights, normaliser="soft", **where
    )


def _cross_entropy(x: Samples, tau, tau_prime, **where) -> Surrogate:
    return group_cross_entropy(x.log_prob, _lift(x, tau, tau_prime), **where)


def _value(function: Callable[..., Tensor]):
    def call(x: Samples, tau, tau_prime, **where) -> Tensor:
        return function(x.score, x.log_prob, tau=tau, tau_prime=tau_prime, **where)

    return call


SURROGATES = {
    "mean_seeking": _mean_seeking,
    "mean_seeking_controlled": _mean_seeking_controlled,
    "mode_seeking": _mode_seeking,
    "mode_seeking_older_data": _mode_seeking_older_data,
    "squared_residual": _squared_residual,
    "squared_residual_soft": _squared_residual_soft,
    "cross_entropy": _cross_entropy,
    "urex": _urex,
    "ment": _ment,
}
VALUES = {function.__name__: _value(function) for function in (soft_value, soft_value_estimate)}
FUNCTIONS = SURROGATES | VALUES
every_function = pytest.mark.parametrize("name", FUNCTIONS)
every_surrogate = pytest.mark.parametrize("name", SURROGATES)


MASKED = torch.tensor([True, True, False])
ALGEBRA = {
    "uniform_weights": (lambda x, **where: uniform_weights(x, **where), (0.5, 0.5, 0.0)),
    "weighted_sum": (lambda x, **where: weighted_sum(x, x, **where), 10.0),
    "masked_mean": (masked_mean, 2.0),
    "centred": (centred, (-1.0, 1.0, 0.0)),
    "leave_one_out": (leave_one_out, (-2.0, 2.0, 0.0)),
    "standardised": (standardised, (-1.0, 1.0, 0.0)),
    "score_function_loss": (lambda x, **where: score_function_loss(x, x, **where), -5.0),
    "lift_divergence_estimate": (
        lambda x, **where: lift_divergence_estimate(self_normalised_weights(x, **where), **where),
        None,
    ),
    "effective_sample_size": (
        lambda x, mask=None, sample_dim=-1: effective_sample_size(
            self_normalised_weights(x, mask=mask, sample_dim=sample_dim), sample_dim=sample_dim
        ),
        None,
    ),
}


def evaluate(
    name: str,
    samples: Samples,
    tau: float | Tensor = 0.5,
    tau_prime: float | Tensor = 0.25,
    **where,
) -> Result:
    samples = samples.map(lambda tensor: tensor.detach().clone().requires_grad_())
    output = FUNCTIONS[name](samples, tau, tau_prime, **where)
    value, weights = (output.loss, output.weights) if name in SURROGATES else (output, None)
    gradients = torch.autograd.grad(value.sum(), samples, allow_unused=True)
    present = [tensor for tensor in (weights, *gradients) if tensor is not None]
    return Result(value.detach(), tuple(present))


@st.composite
def groups(draw: st.DrawFn, k: int | None = None) -> Samples:
    """One group of K samples."""
    k = draw(st.integers(1, 6)) if k is None else k
    log_probs = st.lists(st.floats(-8, 0), min_size=k, max_size=k).map(lambda x: vector(*x))
    scores = st.lists(st.floats(-4, 4), min_size=k, max_size=k).map(lambda x: vector(*x))
    return Samples(draw(scores), draw(log_probs), draw(log_probs), draw(log_probs))


def random_samples(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Samples:
    generator = torch.Generator().manual_seed(seed)
    score, *logits = torch.randn(4, *shape, generator=generator, dtype=dtype)
    return Samples(score, *(x.log_softmax(-1) for x in logits))


# ----------------------------------------------------------------------------- numbers by hand


@DTYPES
def test_lifted_log_weights_by_hand(dtype):
    score, reference = vector(1, 0, -3, dtype=dtype), vector(-2, -1, 0, dtype=dtype)
    # (1 + .5 * 2) / 2, (0 + .5 * 1) / 2, (-3 + 0) / 2
    actual = lifted_log_weights(score, reference, tau=1.5, tau_prime=0.5)
    assert_close(actual, vector(1.0, 0.25, -1.5, dtype=dtype))


LOWEST = torch.finfo(torch.float64).min


@DTYPES
@pytest.mark.parametrize(
    ("log_weights", "mask", "expected"),
    [
        ((0, math.log(2), math.log(5)), None, (1 / 8, 2 / 8, 5 / 8)),
        ((0, math.log(2), math.log(5)), (True, True, False), (1 / 3, 2 / 3, 0)),
        ((0, math.log(2), math.log(5)), (False, False, True), (0, 0, 1)),
        ((0, math.log(2), math.log(5)), (False, False, False), (0, 0, 0)),
        # A masked sample takes no weight from the lowest representable one.
        ((LOWEST, 0, LOWEST), (True, False, True), (0.5, 0, 0.5)),
    ],
)
def test_self_normalised_weights_by_hand(dtype, log_weights, mask, expected):
    log_weights = vector(*log_weights).clamp(min=torch.finfo(dtype).min).to(dtype)
    actual = self_normalised_weights(log_weights, mask=None if mask is None else torch.tensor(mask))
    assert_close(actual, vector(*expected, dtype=dtype))


@DTYPES
@pytest.mark.parametrize(
    ("weights", "expected"),
    [
        ((0.5, 0.25, 0.25), 8 / 3),  # 1 / (1/4 + 1/16 + 1/16)
        ((2.0, 1.0, 1.0), 8 / 3),  # no need to be normalised
        ((0.0, 7.0, 0.0), 1.0),
        ((0.1, 0.1, 0.1), 3.0),
        ((1e-30, 1e-30, 0.0), 2.0),  # in float32 the square would underflow
        ((1e30, 1e30, 1e30), 3.0),  # and here overflow
        ((0.0, 0.0, 0.0), 0.0),
    ],
)
def test_effective_sample_size_by_hand(dtype, weights, expected):
    assert_close(effective_sample_size(vector(*weights, dtype=dtype)).item(), expected)


QUARTER = (0.5 + 0.5 * math.log(1.5)) / 4
THIRDS = (1 / 3, 1 / 3, 1 / 3)
BY_HAND = {  # a function of log_prob x and of v, which makes vectors; x; weights, loss, gradient
    "mean_seeking": (
        lambda x, v: mean_seeking_projection(x, v(1, 2, 5).log()),
        (-1, -2, -3),
        ((1 / 8, 2 / 8, 5 / 8), (1 * 1 + 2 * 2 + 5 * 3) / 8, (-1 / 8, -2 / 8, -5 / 8)),
    ),
    # Ratios 1/4, 1/4, 1/2; coefficients 1/8 - 2/8, 2/8 - 2/8, 5/8 - 4/8.
    "mean_seeking_controlled": (
        lambda x, v: mean_seeking_projection(
            x, v(1, 2, 5).log(), control_log_prob=v(-1, -2, -3) - v(1, 1, 2).log()
        ),
        (-1, -2, -3),
        ((1 / 8, 2 / 8, 5 / 8), -(-1 * -1 + 0 * -2 + 1 * -3) / 8, (1 / 8, 0, -1 / 8)),
    ),
    # v = 1/2, 1/4, 1/4; A = 1, 4, 4; mean 5/2; v (A - mean) = -3/4, 3/8, 3/8.
    "mode_seeking": (
        lambda x, v: mode_seeking_projection(
            x, v(-2, -2, -2), v(2, 4, 3), behaviour_log_prob=v(-1, -2, -3) - v(2, 1, 1).log()
        ),
        (-1, -2, -3),
        ((1 / 2, 1 / 4, 1 / 4), -(3 / 4 - 3 / 4 - 9 / 8), (3 / 4, -3 / 8, -3 / 8)),
    ),
    # v = 1/2, 1/4, 1/4; log Z = 2.5; log(pi / pi_bar) = -1, 0, 1; residuals 1/2, 3/2, -3/2.
    "squared_residual": (
        lambda x, v: squared_residual_projection(
            x, v(0, -2, -4), v(2, 4, 2), behaviour_log_prob=v(0, -2, -4) - v(2, 1, 1).log()
        ),
        (-1, -2, -3),
        (
            (1 / 2, 1 / 4, 1 / 4),
            (0.5 * 0.5**2 + 0.25 * 1.5**2 + 0.25 * 1.5**2) / 2,
            (-0.5 * 0.5, -0.25 * 1.5, 0.25 * 1.5),
        ),
    ),
    # log Z = log(2 / 2), the residual of the second sample 0 - 1.
    "squared_residual_soft": (
        lambda x, v: squared_residual_projection(
            x, v(-1, -2), v(0.5, 1.5).log(), normaliser="soft"
        ),
        (-1 + math.log(0.5), -1 + math.log(1.5)),
        (
            (1 / 2, 1 / 2),
            0.25 * 1,
            (0, 1 / 2),
        ),
    ),
    # q = 1/8, 2/8, 5/8; p = 1/2, 1/4, 1/4.
    "cross_entropy": (
        lambda x, v: group_cross_entropy(x, v(1, 2, 5).log()),
        (math.log(2), 0, 0),
        ((1 / 8, 2 / 8, 5 / 8), (1 / 8 + 2 * 7 / 8) * math.log(2), (3 / 8, 0, -3 / 8)),
    ),
    # r / tau - log pi = 1, 1 + log 3, so w = 1/4, 3/4; S = 0 + 1/4, .5 log 1.5 + 3/4.
    # QUARTER is half the distance to the mean, over K.
    "urex": (
        lambda x, v: urex_surrogate(x, v(0, 0.5 * math.log(1.5)), tau=0.5),
        (-1, -1 - math.log(2)),
        ((1 / 4, 3 / 4), QUARTER * math.log(2), (QUARTER, -QUARTER)),
    ),
    # S = 2, 2.5, 4.5; mean 3.
    "ment": (
        lambda x, v: ment_surrogate(x, v(1, 2, 3), tau=0.5),
        (-2, -1, -3),
        (THIRDS, -(-1 * -2 - 0.5 * -1 + 1.5 * -3) / 3, (1 / 3, 1 / 6, -1 / 2)),
    ),
}


@DTYPES
@pytest.mark.parametrize("name", BY_HAND)
def test_surrogate_by_hand(name, dtype):
    v = functools.partial(vector, dtype=dtype)
    function, log_prob, (weights, value, grad) = BY_HAND[name]
    # Three numbers near 1 are subtracted: some units in the last place of 1 are lost.
    tolerance = {"atol": 8 * torch.finfo(dtype).eps, "rtol": 8 * torch.finfo(dtype).eps}
    surrogate = function(v(*log_prob), v)
    assert_close(surrogate.weights, v(*weights), **tolerance)
    assert_close(surrogate.loss.item(), value, **tolerance)
    actual = gradient(lambda x: function(x, v).loss, v(*log_prob))
    assert_close(actual, v(*grad), **tolerance)


def test_mode_seeking_projection_takes_the_reference_for_the_sampler_by_default():
    x = random_samples(3, 5)
    log_weights = lifted_log_weights(x.score, x.reference, tau=0.5, tau_prime=0.25)
    default = mode_seeking_projection(x.log_prob, x.reference, log_weights)
    explicit = mode_seeking_projection(
        x.log_prob, x.reference, log_weights, behaviour_log_prob=x.reference
    )
    assert_close(tuple(default), tuple(explicit))
    assert_close(default.weights, (x.log_prob - x.reference).softmax(-1))


@DTYPES
@pytest.mark.parametrize(
    ("tau", "tau_prime", "score", "probability", "value"),
    [
        (1.0, 0.0, (math.log(4), math.log(8 / 3)), (1 / 4, 3 / 4), math.log(1 + 2)),
        (1.0, 1.0, (2 * math.log(2), 2 * math.log(8)), (1 / 4, 1 / 16), 2 * math.log(1 + 2)),
        (0.0, 0.5, (0.5 * math.log(3), 0.5 * math.log(5)), (1 / 4, 3 / 4), 0.5 * math.log(8)),
    ],
)
def test_soft_value_by_hand(dtype, tau, tau_prime, score, probability, value):
    log_prob = vector(*probability, dtype=dtype).log()
    actual = soft_value(vector(*score, dtype=dtype), log_prob, tau=tau, tau_prime=tau_prime)
    assert_close(actual.item(), value)


@DTYPES
def test_soft_value_estimate_by_hand(dtype):
    # exp(Q / 2) / sqrt(pi_bar) = 1 * 2, 2.5 * 4, whose mean is 6.
    score = vector(0, 2 * math.log(2.5), dtype=dtype)
    log_prob = vector(1 / 4, 1 / 16, dtype=dtype).log()
    actual = soft_value_estimate(score, log_prob, tau=1.0, tau_prime=1.0)
    assert_close(actual.item(), 2 * math.log(6))


@pytest.mark.parametrize("masked", [False, True])
def test_surrogate_reward_is_the_soft_value_of_trajectories(masked):
    x = random_samples(3, 4)
    mask = torch.tensor([[True], [False], [True]]).expand(3, 4) if masked else None
    arguments = {"tau": 0.5, "tau_prime": 0.25, "sample_dim": 0, "mask": mask}
    actual = surrogate_reward(x.score, x.log_prob, **arguments)
    assert_close(actual, soft_value(x.score, x.log_prob, **arguments), rtol=0, atol=0)


def test_theorem1_temperatures_by_hand():
    tau, tau_prime = theorem1_temperatures(100, 2)  # log 2 = .693147
    assert_close((tau_prime, tau + tau_prime), (0.1201122, 8.4932181), atol=1e-6, rtol=0)
    for horizon, n in itertools.product((2, 10, 1e6), (2, 3, 10_000)):
        tau, tau_prime = theorem1_temperatures(horizon, n)
        assert tau > 0
        assert_close(tau_prime**2 * horizon * math.log(n), 1.0)
        assert_close((tau + tau_prime) ** 2 * 2 * math.log(n) / horizon, 1.0)
    # At T = 1 the formula has tau < 0. The sum is kept.
    tau, tau_prime = theorem1_temperatures(1, 10)
    assert_close((tau, tau_prime), (0.0, (2 * math.log(10)) ** -0.5))


# ------------------------------------------------------------------------------ exact enumeration
#
# A group that holds outcome i c_i times, drawn by a policy with probabilities c_i / sum c, is what
# self-normalisation assumes in the limit: sample sums are then exact expectations.

COUNTS = pytest.mark.parametrize(
    "counts", [(1, 1, 1, 1, 1), (1, 2, 3, 4, 5), (7, 1, 1, 1, 2)], ids=str
)
TEMPERATURES = pytest.mark.parametrize(
    ("tau", "tau_prime"), [(0.5, 0.25), (0.3, 0.0), (0.0, 0.4), (2.0, 5.0)]
)


class Enumeration(NamedTuple):
    """A softmax policy over five outcomes, its reference, and a sample without sampling error."""

    logits: Tensor
    reference: Tensor
    score: Tensor
    index: Tensor
    behaviour: Tensor

    def lifted(self, tau: float, tau_prime: float) -> Tensor:
        """Log-probability of the target: the display of Eq. 5, term by term."""
        reference = self.reference.exp()
        target = reference * ((self.score - tau_prime * self.reference) / (tau + tau_prime)).exp()
        return (target / target.sum()).log()

    def log_weights(self, tau: float, tau_prime: float) -> Tensor:
        return lifted_log_weights(self.score, self.reference, tau=tau, tau_prime=tau_prime)


def enumeration(counts: tuple[int, ...], on_policy: bool) -> Enumeration:
    logits, other, score = random_samples(len(counts), seed=3)[:3]
    reference = (logits if on_policy else other).log_softmax(-1)
    count = torch.tensor(counts)
    behaviour = vector(*counts).log() - math.log(sum(counts))
    return Enumeration(
        logits, reference, score, torch.arange(len(counts)).repeat_interleave(count), behaviour
    )


def _to_target(log_prob: Tensor, case: Enumeration, tau, tau_prime) -> Tensor:
    """KL(target, pi)."""
    target = case.lifted(tau, tau_prime)
    return (target.exp() * (target - log_prob)).sum()


def _from_target(log_prob: Tensor, case: Enumeration, tau, tau_prime) -> Tensor:
    """KL(pi, target)."""
    return (log_prob.exp() * (log_prob - case.lifted(tau, tau_prime))).sum()


def _rewards_and_entropy(log_prob: Tensor, case: Enumeration, tau, tau_prime) -> Tensor:
    """-(E r + tau H)."""
    return -(log_prob.exp() * (case.score - tau * log_prob)).sum()


def _rewards_and_projection(log_prob: Tensor, case: Enumeration, tau, tau_prime) -> Tensor:
    """-(E r - tau KL(q, pi)), q ~ exp(r / tau)."""
    target = (case.score / tau).log_softmax(-1)
    reward = (log_prob.exp() * case.score).sum()
    return tau * (target.exp() * (target - log_prob)).sum() - reward


EXACT = {
    "mean_seeking": _to_target,
    "mean_seeking_controlled": _to_target,
    "mode_seeking_older_data": _from_target,
}


@COUNTS
@TEMPERATURES
@pytest.mark.parametrize("on_policy", [True, False])
@pytest.mark.parametrize("name", EXACT)
def test_projection_gradient_is_exact_on_an_exact_sample(name, counts, tau, tau_prime, on_policy):
    case = enumeration(counts, on_policy)
    if name == "mean_seeking":  # which takes the samples for the reference's
        case = case._replace(reference=case.behaviour)
    _assert_exact(name, case, case.logits, EXACT[name], tau, tau_prime)


@pytest.mark.parametrize(
    ("name", "objective"), [("ment", _rewards_and_entropy), ("urex", _rewards_and_projection)]
)
@pytest.mark.parametrize("tau", [0.1, 1.0])
def test_rivals_gradient_is_exact_on_an_exact_sample(name, objective, tau):
    """With samples in proportion to pi."""
    case = enumeration((1, 2, 3, 4, 5), on_policy=True)
    _assert_exact(name, case, case.behaviour, objective, tau, 0.0)


def _assert_exact(name: str, case: Enumeration, logits: Tensor, objective, tau, tau_prime) -> None:
    def estimator(logits: Tensor) -> Tensor:
        table = Samples(case.score, logits.log_softmax(-1), case.reference, case.behaviour)
        return SURROGATES[name](table.map(lambda y: y[case.index]), tau, tau_prime).loss

    def exact(logits: Tensor) -> Tensor:
        return objective(logits.log_softmax(-1), case, tau, tau_prime)

    assert_close(gradient(estimator, logits), gradient(exact, logits))


@COUNTS
@TEMPERATURES
def test_value_estimate_is_exact_on_an_exact_sample(counts, tau, tau_prime):
    case = enumeration(counts, on_policy=False)
    temperatures = {"tau": tau, "tau_prime": tau_prime}
    assert_close(
        soft_value_estimate(case.score[case.index], case.behaviour[case.index], **temperatures),
        soft_value(case.score, case.behaviour, **temperatures),
    )


@TEMPERATURES
def test_value_estimate_is_a_lower_bound_in_expectation_and_converges(tau, tau_prime):
    case = enumeration((1, 2, 3), on_policy=False)
    exact = soft_value(case.score, case.reference, tau=tau, tau_prime=tau_prime)

    def expectation(m: int) -> Tensor:
        """Over all M-tuples of samples."""
        tuples = torch.cartesian_prod(*[torch.arange(3)] * m).reshape(-1, m)
        reference = case.reference[tuples]
        estimate = soft_value_estimate(case.score[tuples], reference, tau=tau, tau_prime=tau_prime)
        return (reference.sum(-1).exp() * estimate).sum()

    gaps = [exact - expectation(m) for m in (1, 2, 4, 8)]
    assert all(left > right > 0 for left, right in itertools.pairwise(gaps))
    draws = torch.multinomial(
        case.reference.exp(), 100_000, True, generator=torch.Generator().manual_seed(0)
    )
    estimate = soft_value_estimate(
        case.score[draws], case.reference[draws], tau=tau, tau_prime=tau_prime
    )
    assert_close(estimate, exact, atol=0.02, rtol=0)


# ------------------------------------------------------------------------------------- identities


def test_urex_weights_are_lifted_weights_at_tau_zero():
    x = random_samples(3, 5)
    lifted = lifted_log_weights(x.score, x.log_prob, tau=0.0, tau_prime=0.7)
    actual = urex_surrogate(x.log_prob, x.score, tau=0.7).weights
    assert_close(actual, self_normalised_weights(lifted))
    assert_close(actual, (x.score / 0.7 - x.log_prob).softmax(-1))


def test_pmd_at_the_reference_is_reinforce_with_mean_baseline_over_tau():
    x = random_samples(3, 5)
    log_weights = lifted_log_weights(x.score, x.log_prob, tau=0.7, tau_prime=0.0)
    pmd = gradient(
        lambda log_prob: mode_seeking_projection(log_prob, x.log_prob, log_weights).loss, x.log_prob
    )
    reinforce = gradient(
        lambda log_prob: ment_surrogate(log_prob, x.score, tau=0.0).loss, x.log_prob
    )
    assert_close(pmd, reinforce / 0.7)
    assert_close(pmd, -(x.score - x.score.mean(-1, keepdim=True)) / (5 * 0.7))


def test_ecpo_without_entropy_weights_by_the_exponential_score():
    """So that equal scores weight all samples equally."""
    x = random_samples(3, 5)
    x.score[2] = 1.0
    weights = SURROGATES["mean_seeking"](x, 0.7, 0.0).weights
    exponential = (x.score / 0.7).exp()
    assert_close(weights, exponential / exponential.sum(-1, keepdim=True))
    assert_close(effective_sample_size(weights)[2].item(), 5.0)


def test_control_variate_removes_the_drift_of_a_neutral_group():
    """At the reference with equal log-weights the gradient is zero per group, not on average."""
    x = random_samples(3, 5)
    neutral = torch.full((3, 5), 1.5, dtype=torch.float64)

    def grad(control: Tensor | None) -> Tensor:
        return gradient(
            lambda y: mean_seeking_projection(y, neutral, control_log_prob=control).loss,
            x.log_prob,
        )

    assert_close(grad(x.log_prob), torch.zeros(3, 5).double())
    assert_close(grad(None), torch.full((3, 5), -0.2).double())


@TEMPERATURES
def test_one_sample_estimate_is_score_minus_entropy_term(tau, tau_prime):
    x = random_samples(6, 1)
    actual = soft_value_estimate(x.score, x.reference, tau=tau, tau_prime=tau_prime)
    assert_close(actual, (x.score - tau_prime * x.reference).squeeze(-1))


@given(x=groups(k=5), tau=st.floats(0, 3), tau_prime=st.floats(0.05, 3), seed=st.integers(0, 2**16))
def test_soft_value_is_the_maximum_and_the_lifted_policy_attains_it(x, tau, tau_prime, seed):
    reference = x.reference.log_softmax(-1)

    def objective(log_prob: Tensor) -> Tensor:
        terms = x.score - tau * (log_prob - reference) - tau_prime * log_prob
        return (log_prob.exp() * terms).sum(-1)

    value = soft_value(x.score, reference, tau=tau, tau_prime=tau_prime)
    lifted = lifted_log_weights(x.score, reference, tau=tau, tau_prime=tau_prime) + reference
    assert_close(objective(lifted.log_softmax(-1)), value)
    others = 4 * random_samples(100, 5, seed=seed).score
    assert (objective(others.log_softmax(-1)) <= value + 1e-9).all()


# ------------------------------------------------------------------------------------- properties


@given(x=groups(), tau=st.floats(0.01, 5), tau_prime=st.floats(0, 5))
@every_surrogate
def test_weights_are_a_distribution_and_ess_counts_them(name, x, tau, tau_prime):
    weights = evaluate(name, x, tau, tau_prime).per_sample[0]
    assert (weights >= 0).all()
    assert_close(weights.sum(-1).item(), 1.0)
    assert 1 - 1e-9 <= effective_sample_size(weights).item() <= weights.numel() + 1e-9


@given(x=groups(), data=st.data())
@every_function
def test_permuting_the_samples_permutes_the_result(name, x, data):
    order = torch.tensor(data.draw(st.permutations(range(x.score.numel()))))
    straight, permuted = evaluate(name, x), evaluate(name, x.map(lambda y: y[order]))
    assert_close(permuted.value, straight.value)
    assert_close(permuted.per_sample, tuple(y[order] for y in straight.per_sample))


@given(x=groups(), constant=st.floats(-10, 10))
@every_function
def test_a_constant_added_to_the_score_moves_values_and_nothing_else(name, x, constant):
    shifted = evaluate(name, x._replace(score=x.score + constant))
    straight = evaluate(name, x)
    moved = constant if name in VALUES else 0.0
    assert_close(shifted.value, straight.value + moved, atol=1e-9, rtol=1e-9)
    assert_close(shifted.per_sample, straight.per_sample, atol=1e-9, rtol=1e-9)


@given(x=groups(), data=st.data())
@every_function
def test_masked_samples_have_no_influence_whatever_stands_in_them(name, x, data):
    k = x.score.numel()
    mask = torch.tensor(data.draw(st.lists(st.booleans(), min_size=k, max_size=k).filter(any)))
    anything = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, 1e300, -1e300, 3.0])
    garbage = vector(*data.draw(st.lists(anything, min_size=k, max_size=k)))
    masked = evaluate(name, x.map(lambda y: y.where(mask, garbage)), mask=mask)
    alone = evaluate(name, x.map(lambda y: y[mask]))
    assert_close(masked.value, alone.value)
    assert_close(tuple(y[mask] for y in masked.per_sample), alone.per_sample)
    for per_sample in masked.per_sample:
        assert (per_sample[~mask] == 0).all()


@every_surrogate
def test_only_the_log_probability_carries_a_gradient(name):
    samples = random_samples(3, 5).map(lambda y: y.requires_grad_())
    loss, weights, *_ = SURROGATES[name](samples, 0.5, 0.25)
    assert not weights.requires_grad
    loss.sum().backward()
    assert samples.log_prob.grad is not None
    assert [y.grad for y in samples._replace(log_prob=samples.score)] == [None] * 4


@every_surrogate
def test_a_group_without_a_real_sample_has_no_loss_and_no_gradient(name):
    x = random_samples(2, 3).map(lambda y: torch.stack([y[0], torch.full_like(y[1], math.nan)]))
    mask = torch.tensor([[True] * 3, [False] * 3])
    value, per_sample = evaluate(name, x, mask=mask)
    assert value[1] == 0
    assert_close(value[0], evaluate(name, x.map(lambda y: y[0])).value)
    assert all((y[1] == 0).all() for y in per_sample)
    assert effective_sample_size(per_sample[0])[1] == 0


def evaluate_any(name: str, x: Samples, **where) -> Result:
    """Of the masked algebra, too."""
    if name in FUNCTIONS:
        return evaluate(name, x, **where)
    output = ALGEBRA[name][0](x.score, **where)
    is_value = output.ndim < x.score.ndim
    return (
        Result(output, ())
        if is_value
        else Result(output.sum(where.get("sample_dim", -1)), (output,))
    )


@pytest.mark.parametrize("name", [*FUNCTIONS, *ALGEBRA])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(), (2, 1, 3)], ids=str)
def test_leading_shapes_and_sample_dim(name, shape, masked):
    """Groups are independent, and the sample axis may stand anywhere."""
    x = random_samples(*shape, 4)
    mask = random_samples(*shape, 4, seed=1).score > -0.5 if masked else None
    expected = evaluate_any(name, x, mask=mask)
    assert expected.value.shape == shape
    for dim in range(-len(shape) - 1, len(shape) + 1):
        moved = evaluate_any(
            name,
            x.map(lambda y, d=dim: y.movedim(-1, d)),
            sample_dim=dim,
            mask=None if mask is None else mask.movedim(-1, dim),
        )
        assert_close(moved.value, expected.value)
        assert_close(tuple(y.movedim(dim, -1) for y in moved.per_sample), expected.per_sample)
    for group in itertools.product(*map(range, shape)):
        real = None if mask is None else mask[group]
        one = evaluate_any(name, x.map(lambda y, i=group: y[i]), mask=real)
        assert_close(one.value, expected.value[group])
        assert_close(one.per_sample, tuple(y[group] for y in expected.per_sample))


@DTYPES
@every_function
def test_dtype_is_kept(name, dtype):
    """That of the scores, also where temperatures are tensors of another."""
    x = random_samples(2, 4, dtype=dtype)
    mask = torch.tensor([True, True, False, True]).expand(2, 4)
    double = evaluate(name, x.map(Tensor.double), mask=mask)
    for temperatures in ((0.5, 0.25), torch.tensor([0.5, 0.25]), vector(0.5, 0.25)):
        value, per_sample = evaluate(name, x, *temperatures, mask=mask)
        assert value.dtype == dtype
        assert {y.dtype for y in per_sample} == {dtype}
        assert_close(value.double(), double.value, atol=1e-5, rtol=1e-5)
        per_sample = tuple(y.double() for y in per_sample)
        assert_close(per_sample, double.per_sample, atol=1e-5, rtol=1e-5)


EXTREME_SCORES = st.sampled_from([-1e30, -1.0, 0.0, 1.0, 1e30]) | st.floats(-1e30, 1e30)
EXTREME_LOG_PROBS = st.sampled_from([-1e30, -1e5, -1.0, 0.0]) | st.floats(-1e30, 0)
EXTREME_TEMPERATURES = st.floats(-8, 8).map(lambda exponent: 10.0**exponent)


@settings(max_examples=100)
@given(
    data=st.data(),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    tau=EXTREME_TEMPERATURES,
    tau_prime=st.just(0.0) | EXTREME_TEMPERATURES,
)
@every_function
def test_finite_input_never_gives_nan(name, data, dtype, tau, tau_prime):
    k = data.draw(st.integers(1, 4))
    rows = [
        data.draw(st.lists(values, min_size=k, max_size=k))
        for values in (EXTREME_SCORES, *[EXTREME_LOG_PROBS] * 3)
    ]
    samples = Samples(*(torch.tensor(row, dtype=dtype) for row in rows))
    value, per_sample = evaluate(name, samples, tau, tau_prime)
    assert not value.isnan().any()
    assert not any(y.isnan().any() for y in per_sample)
    if name in SURROGATES:
        weights = per_sample[0]
        assert (weights >= 0).all()
        assert_close(weights.sum().item(), 1.0, atol=1e-5, rtol=0)
        assert 1 - 1e-5 <= effective_sample_size(weights).item() <= k * (1 + 1e-5)


@DTYPES
@every_surrogate
def test_the_largest_numbers_never_give_nan(name, dtype):
    largest = torch.finfo(dtype).max
    masks = (None, torch.tensor([True, True, False]))
    for mask, *signs in itertools.product(masks, *[(-1, 1)] * 3):
        score = largest * vector(*signs, dtype=dtype)
        for log_prob, reference in itertools.permutations([(-1.0, -200.0, -3.0), (-200.0,) * 3], 2):
            log_prob, reference = vector(*log_prob, dtype=dtype), vector(*reference, dtype=dtype)
            samples = Samples(score, log_prob, reference, reference)
            value, per_sample = evaluate(name, samples, 0.1, 0.1, mask=mask)
            assert not value.isnan()
            assert not any(y.isnan().any() for y in per_sample)
            assert_close(per_sample[0].sum().item(), 1.0)


# ----------------------------------------------------------------------------- the masked algebra


@DTYPES
@pytest.mark.parametrize("name", ALGEBRA)
def test_masked_algebra_by_hand(name, dtype):
    """Of 1 and 3, beside a masked sample; whatever stands there, it counts for nothing."""
    function, expected = ALGEBRA[name]
    for junk in (7.0, math.nan, math.inf, -math.inf):
        actual = function(vector(1, 3, junk, dtype=dtype), mask=MASKED)
        alone = function(vector(1, 3, dtype=dtype))
        assert_close(actual if actual.ndim == 0 else actual[:2], alone)
        if expected is not None:
            assert_close(actual, torch.tensor(expected, dtype=dtype))


@DTYPES
@pytest.mark.parametrize("standardised", [standardised, standardised_in_batch])
@pytest.mark.parametrize("constant", [0.0, 0.1, -3.0, 1e4, 1e30])
def test_standardised_scores_of_equal_samples_are_zero(dtype, standardised, constant):
    """Equal up to rounding is equal: their spread is noise, and would be blown up to 1."""
    score = torch.full((3, 7), constant, dtype=dtype)
    assert (standardised(score) == 0).all()
    score[1, 0] *= 1 + torch.finfo(dtype).eps
    score[2, 3:] = math.nan
    mask = torch.arange(7) < 3
    assert (standardised(score, mask=mask.expand(3, 7)) == 0).all()


@DTYPES
@pytest.mark.parametrize("standardised", [standardised, standardised_in_batch])
def test_standardised_scores_of_nan_are_nan(dtype, standardised):
    score = torch.tensor([[math.nan, 1.0, 2.0], [0.0, 1.0, 2.0]], dtype=dtype)
    assert standardised(score)[0].isnan().all()


@given(x=groups(k=5), scale=st.sampled_from([1e-30, 1e-3, 1.0, 1e30]), shift=st.floats(-9, 9))
@pytest.mark.parametrize("standardised", [standardised, standardised_in_batch])
def test_standardised_scores_have_mean_zero_and_deviation_one(standardised, x, scale, shift):
    score = x.score + torch.arange(5.0)
    actual = standardised(scale * (score + shift))
    assert_close(actual, (score - score.mean()) / score.std(correction=0), atol=1e-6, rtol=1e-6)


@DTYPES
@pytest.mark.parametrize("junk", [7.0, math.nan, math.inf, -math.inf])
def test_scores_in_the_deviation_of_the_batch_by_hand(dtype, junk):
    """Distances 1, 1; 2, 2, 4; 0, 0, 0 from the means 1, 3, 0.1; mean square 26 / 8."""
    rows = [[0, 2, junk], [1, 1, 7], [0.1, 0.1, 0.1], [junk, junk, junk]]
    score = torch.tensor(rows, dtype=dtype)
    score[2, 1] += torch.finfo(dtype).eps / 8  # equal up to rounding
    mask = torch.tensor([[True, True, False], [True] * 3, [True] * 3, [False] * 3])
    rows = [[-1, 1, 0], [-2, -2, 4], [0, 0, 0], [0, 0, 0]]
    expected = torch.tensor(rows, dtype=dtype) / math.sqrt(26 / 8)
    actual = standardised_in_batch(score, mask=mask)
    assert_close(actual, expected)
    assert (actual[2:] == 0).all()
    assert_close(standardised_in_batch(score.mT, sample_dim=0, mask=mask.mT), expected.mT)
    shape = (2, 2, 3)
    actual = standardised_in_batch(score.view(shape), mask=mask.view(shape))
    assert_close(actual, expected.view(shape))


@given(x=groups(k=12), scale=st.sampled_from([1e-30, 1e-3, 1.0, 1e30]), data=st.data())
def test_scores_in_the_deviation_of_the_batch(x, scale, data):
    """Neither a unit nor a shift of each group matters; the order of groups and samples is kept."""
    score = (x.score + torch.arange(12.0)).view(3, 4)
    mask = torch.tensor([[True] * 4, [True, False, True, True], [True, True, False, False]])
    actual = standardised_in_batch(score, mask=mask)
    assert_close(actual.square().sum(), torch.tensor(9.0, dtype=torch.float64))
    assert_close(actual.sum(-1), torch.zeros(3, dtype=torch.float64))
    shift = torch.tensor(data.draw(st.lists(st.floats(-9, 9), min_size=3, max_size=3))).double()
    moved = standardised_in_batch(scale * (score + shift[:, None]), mask=mask)
    assert_close(moved, actual, atol=1e-6, rtol=1e-6)
    rows, columns = (torch.tensor(data.draw(st.permutations(range(n)))) for n in (3, 4))
    where = (rows[:, None], columns)
    assert_close(standardised_in_batch(score[where], mask=mask[where]), actual[where])
    # A group of equal scores adds its number of samples.
    more = torch.cat([score, torch.full((1, 4), 0.1, dtype=torch.float64)])
    mask = torch.cat([mask, torch.tensor([[True, True, True, False]])])
    more = standardised_in_batch(more, mask=mask)
    assert_close(more, torch.cat([actual, torch.zeros(1, 4)]) * math.sqrt(12 / 9))


@DTYPES
@pytest.mark.parametrize("junk", [7.0, math.nan, math.inf])
def test_matched_temperature_by_hand(dtype, junk):
    """Distances of scores 1, 1; 0, 0, of surprise 3, 3; 1, 1: mean squares 1/2 and 5."""
    score = torch.tensor([[-1.0, junk, 1.0], [0.0, 0.0, junk]], dtype=dtype)
    log_prob = torch.tensor([[-8.0, junk, -2.0], [-5.0, -3.0, junk]], dtype=dtype)
    mask = torch.tensor([[True, False, True], [True, True, False]])
    found = matched_temperature(0.4, score, log_prob, mask=mask)
    assert_close(found, torch.tensor(0.4 * math.sqrt((1 / 2 + 1 / 2) / 5), dtype=dtype))
    # A score for all groups counts in each: mean square 1/2, and still two groups.
    score = torch.tensor([-1.0, 0.0, 1.0], dtype=dtype)
    found = matched_temperature(0.4, score, log_prob, mask=mask)
    assert_close(found, torch.tensor(0.4 * math.sqrt((2.5 / 4 + 1 / 2) / 5), dtype=dtype))


@pytest.mark.parametrize(
    ("score", "log_prob", "expected"),
    [
        (((-1, 1),), ((-6, -2),), math.sqrt(2) / 2),  # one group
        (((3, 3),) * 4, ((-6, -2),) * 4, math.sqrt(1 / 4) / 2),  # equal scores: 1/G
        (((-1, 1),), ((-1.5, -1),), math.sqrt(2)),  # surprise within a nat is not blown up
        (((-1, 1),), ((-2, -2),), math.sqrt(2)),
    ],
)
def test_matched_temperature_at_its_edges(score, log_prob, expected):
    tensors = (torch.tensor(x, dtype=torch.float64) for x in (score, log_prob))
    assert_close(matched_temperature(1.0, *tensors).item(), expected)


@given(x=groups(k=8), tau_prime=st.floats(0, 9), scale=st.floats(1, 1e3))
def test_the_matched_term_knows_no_unit_of_surprise(x, tau_prime, scale):
    """Of at least a nat; and it spreads tau' times as far as the scores and 1/G."""
    score, log_prob = standardised(x.score.view(2, 4)), x.reference.view(2, 4)
    log_prob = log_prob + torch.tensor([-4.0, -1.0, 1.0, 4.0])
    spread = centred(log_prob).square().mean().sqrt()
    log_prob = log_prob / spread.clamp_max(1)
    term, scaled = (
        matched_temperature(tau_prime, score, surprise) * centred(surprise)
        for surprise in (log_prob, scale * log_prob)
    )
    assert_close(scaled, term)
    expected = tau_prime * (centred(score).square().mean() + 1 / 2).sqrt()
    assert_close(term.square().mean().sqrt(), expected)


def test_scores_are_held_constant_and_the_log_probability_is_not():
    score, log_prob = random_samples(2, 4).score.requires_grad_(), random_samples(2, 4).log_prob
    assert not centred(score).requires_grad
    assert not standardised(score).requires_grad
    assert not standardised_in_batch(score).requires_grad
    assert not score_function_loss(log_prob, score).requires_grad
    expected = -score.detach() / 4
    assert_close(gradient(lambda x: score_function_loss(x, score), log_prob), expected)


# ------------------------------------------------------------------------------ of single steps


@DTYPES
@pytest.mark.parametrize(
    ("ratio", "advantage", "gain", "slope"),
    [
        *[(1.0, 2.0, 2.0, 2.0), (1.0, -2.0, -2.0, -2.0), (1.0, 0.0, 0.0, 0.0)],
        *[(1.4, 2.0, 2.5, 0.0), (1.4, -2.0, -2.8, -2.8), (1.2, 2.0, 2.4, 2.4)],
        *[(0.6, 2.0, 1.2, 1.2), (0.6, -2.0, -1.5, 0.0), (0.8, -2.0, -1.6, -1.6)],
    ],
)
def test_clipped_gain_by_hand(dtype, ratio, advantage, gain, slope):
    """Between 0.75 and 1.25 the ratio counts; outside, only where that is a loss."""

    def call(x):
        return clipped_gain(x, vector(advantage, dtype=dtype), clip_low=0.25, clip_high=0.25)

    log_ratio = vector(ratio, dtype=dtype).log()
    found, is_cut = call(log_ratio)
    assert_close(found.item(), gain, rtol=1e-6, atol=0)
    assert_close(gradient(lambda x: call(x)[0].sum(), log_ratio).item(), slope, rtol=1e-6, atol=0)
    assert is_cut.item() is (slope == 0 and advantage != 0)


def test_nothing_is_cut_off_where_nothing_is_gained():
    log_ratio = torch.tensor([-1.0, 0.0, 1.0])
    _, is_cut = clipped_gain(log_ratio, torch.zeros(3), clip_low=0.2, clip_high=0.2)
    assert not is_cut.any()


@pytest.mark.parametrize("function", [soft_value, soft_value_estimate, surrogate_reward])
def test_a_temperature_for_each_group(function):
    """[G, 1] beside [G, K], and [1, G] beside [K, G]; no other shape but a single number."""
    score, log_prob = torch.randn(3, 4), torch.randn(3, 4) - 2
    tau, tau_prime = torch.tensor([[0.1], [0.5], [1.0]]), torch.tensor([[0.3], [0.2], [0.1]])
    expected = torch.stack(
        [
            function(score[i], log_prob[i], tau=tau[i].item(), tau_prime=tau_prime[i].item())
            for i in range(3)
        ]
    )
    assert_close(function(score, log_prob, tau=tau, tau_prime=tau_prime), expected)
    for temperatures in ({"tau": tau.T, "tau_prime": tau_prime.T}, {"tau": tau[:, 0]}):
        options = {"tau_prime": tau_prime[:, 0], **temperatures, "sample_dim": 0}
        assert_close(function(score.T, log_prob.T, **options), expected)
    square = score[:, :3]
    with pytest.raises(ValueError, match=r"tau must have 1 along the axis of the samples, -1 of"):
        function(square, square, tau=tau[:, 0], tau_prime=0.1)


@pytest.mark.parametrize(("shape", "sample_dim"), [((3, 1), -1), ((1,), 1), ((4,), 0), ((), 1)])
def test_samples_are_not_repeated(shape, sample_dim):
    """Weights over one sample would be 1, and the loss K times too large."""
    message = rf"log_weights must have [34] along the axis of the samples, {sample_dim} of \(3, 4\)"
    with pytest.raises(ValueError, match=message):
        mean_seeking_projection(torch.zeros(3, 4), torch.zeros(shape), sample_dim=sample_dim)
    alike = mean_seeking_projection(torch.zeros(3, 4), torch.arange(4.0))
    assert alike.loss.shape == (3,)


@DTYPES
def test_divergence_penalty_by_hand(dtype):
    """Of d = 0, log 2, log 1/2; its slope is 1 - e^d."""
    log_prob = torch.zeros(3, dtype=dtype)
    reference = vector(1, 2, 0.5, dtype=dtype).log()
    expected = vector(0, 1 - math.log(2), -0.5 + math.log(2), dtype=dtype)
    assert_close(divergence_penalty(log_prob, reference), expected)
    slope = gradient(lambda x: divergence_penalty(x, reference).sum(), log_prob)
    assert_close(slope, vector(0, -1, 0.5, dtype=dtype))


@DTYPES
def test_single_steps_of_finite_input_are_never_nan(dtype):
    largest = torch.finfo(dtype).max
    values = vector(-1, -1e-3, 0, 1e-3, 1, dtype=dtype) * largest
    for other in values:

        def gain(x, other=other):
            return clipped_gain(x, other.expand(5), clip_low=0.2, clip_high=0.3)[0]

        for function in (gain, lambda x, other=other: divergence_penalty(x, other.expand(5))):
            assert not function(values).isnan().any()
            assert not gradient(lambda x, f=function: f(x).mean(), values).isnan().any()


def test_a_ratio_is_cut_above_zero():
    with pytest.raises(ValueError, match="must be a number >= 0 and < "):
        clipped_gain(torch.zeros(2), torch.ones(2), clip_low=1.0, clip_high=0.2)


# ------------------------------------------------------------- the lift's divergence, temperatures


@DTYPES
@pytest.mark.parametrize(
    ("weights", "mask", "expected"),
    [
        ((0.25, 0.25, 0.25, 0.25), None, 0.0),
        ((0.0, 1.0, 0.0, 0.0), None, math.log(4)),
        ((0.5, 0.25, 0.25), None, 0.5 * math.log(1.5) + 0.5 * math.log(0.75)),
        ((0.75, 0.25, 0.0), (True, True, False), 0.75 * math.log(1.5) + 0.25 * math.log(0.5)),
        ((1.0, 0.0, 0.0), (True, False, False), 0.0),
        ((0.0, 0.0), (False, False), 0.0),
    ],
)
def test_lift_divergence_estimate_by_hand(dtype, weights, mask, expected):
    actual = lift_divergence_estimate(
        vector(*weights, dtype=dtype), mask=None if mask is None else torch.tensor(mask)
    )
    assert actual.dtype == dtype
    assert_close(actual.item(), expected, atol=1e-6, rtol=1e-6)


@COUNTS
@TEMPERATURES
def test_lift_divergence_estimate_is_exact_on_an_exact_sample(counts, tau, tau_prime):
    case = enumeration(counts, on_policy=False)
    case = case._replace(reference=case.behaviour)
    weights = self_normalised_weights(case.log_weights(tau, tau_prime)[case.index])
    target = case.lifted(tau, tau_prime)
    expected = (target.exp() * (target - case.reference)).sum()
    assert_close(lift_divergence_estimate(weights), expected)


@DTYPES
@pytest.mark.parametrize("excess", [0.3, 0.0, -0.7])
def test_temperature_dual_by_hand(dtype, excess):
    """A temperature that is too low goes up, one that is too high goes down; the excess stays."""
    log_tau = torch.tensor(0.5, dtype=dtype).log().requires_grad_()
    slack = torch.tensor([excess, 2 * excess], dtype=dtype, requires_grad=True)
    loss = temperature_dual(log_tau, slack)
    assert_close(loss, math.log(2) * slack)
    loss.sum().backward()
    assert_close(log_tau.grad.item(), -3 * excess)
    assert slack.grad is None


# ---------------------------------------------------------------------------- the centred scale


class GaussianGradient(NamedTuple):
    """Of a projection, with respect to the mean and the log-scale; and what it returned."""

    loss: Tensor
    mean: Tensor
    log_scale: Tensor


def gaussian_gradient(projection, loc, scale, samples, log_weights, **where) -> GaussianGradient:
    loc = loc.detach().requires_grad_()
    log_scale = scale.detach().log().requires_grad_()
    loss = projection(loc, log_scale.exp(), samples, log_weights, **where).loss
    return GaussianGradient(loss.detach(), *torch.autograd.grad(loss.sum(), (loc, log_scale)))


centred_gradient = functools.partial(gaussian_gradient, centred_gaussian_projection)


def paper_projection(loc, scale, samples, log_weights, *, sample_dim=-1) -> Surrogate:
    """Eq. 11 of a diagonal Gaussian, ``samples`` ``[M, *B, A]`` with the axis 0."""
    log_prob = torch.distributions.Normal(loc, scale).log_prob(samples).sum(-1)
    return mean_seeking_projection(log_prob, log_weights, sample_dim=sample_dim)


def sample_variance(samples: Tensor, log_weights: Tensor) -> Tensor:
    """The S that the scale is fitted to, ``[*B]``: of the gradient 1 - S at a standard Gaussian."""
    zero = torch.zeros(*samples.shape[1:], dtype=samples.dtype)
    grad = centred_gradient(zero, torch.ones_like(zero), samples, log_weights, sample_dim=0)
    return (1 - grad.log_scale).squeeze(-1)


@DTYPES
def test_centred_gaussian_projection_by_hand(dtype):
    """m = 0/8 + 8/8 + 40/8 = 6, V = (36 + 2 * 4 + 5 * 4) / 8 = 8, sum w^2 = 30/64."""
    log_weights = vector(1, 2, 5, dtype=dtype).log()
    samples = vector(0, 4, 8, dtype=dtype).unsqueeze(-1)
    loc, scale = vector(2, dtype=dtype), vector(2, dtype=dtype)
    variance = 8 / (34 / 64)
    grad = centred_gradient(loc, scale, samples, log_weights, sample_dim=0)
    assert_close(grad.mean.item(), (2 - 6) / 4)
    assert_close(grad.log_scale.item(), 1 - variance / 4)
    expected = math.log(2) + 0.5 * (variance / 4 + (6 - 2) ** 2 / 4 + math.log(2 * math.pi))
    assert_close(grad.loss.item(), expected)
    weights = centred_gaussian_projection(loc, scale, samples, log_weights, sample_dim=0).weights
    assert_close(weights, vector(1 / 8, 2 / 8, 5 / 8, dtype=dtype))
    # To the letter: the same gradient of the mean, and (6 - 2)^2 in that of the scale.
    paper = gaussian_gradient(paper_projection, loc, scale, samples, log_weights, sample_dim=0)
    assert_close(paper.mean, grad.mean)
    assert_close(paper.log_scale.item(), 1 - (8 + 16) / 4)


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)], ids=str)
@pytest.mark.parametrize("masked", [False, True])
def test_centred_projection_of_any_shape(shape, masked):
    """States are independent, the sample axis may stand anywhere, masked samples are nowhere."""
    log_weights = random_samples(*shape, 4).score
    samples = random_samples(*shape, 4, 2, seed=1).score
    loc, scale = random_samples(*shape, 2).score, random_samples(*shape, 2, seed=2).score.exp()
    mask = random_samples(*shape, 4, seed=3).score > -0.8 if masked else None
    if mask is not None:
        mask[..., 0] = True
        log_weights = log_weights.where(mask, math.nan)
        samples = samples.where(mask.unsqueeze(-1), math.inf)
    expected = centred_gradient(loc, scale, samples, log_weights, mask=mask)
    assert expected.loss.shape == shape
    assert all(value.isfinite().all() for value in expected)
    for i in itertools.product(*map(range, shape)):
        real = slice(None) if mask is None else mask[i]
        one = centred_gradient(loc[i], scale[i], samples[i][real], log_weights[i][real])
        assert_close(tuple(one), tuple(value[i] for value in expected))
    for dim in range(-len(shape) - 1, len(shape) + 1):
        at = dim % (len(shape) + 1)
        at_dim = None if mask is None else mask.movedim(-1, at)
        moved = samples.movedim(-2, at), log_weights.movedim(-1, at)
        moved = centred_gradient(loc, scale, *moved, sample_dim=dim, mask=at_dim)
        assert_close(tuple(moved), tuple(expected))
    if masked and shape:
        mask[0] = False  # a state without a real sample leaves the policy as it is
        for values in centred_gradient(loc, scale, samples, log_weights, mask=mask):
            assert (values[0] == 0).all()
            assert (values[1] != 0).all()


def test_centred_projection_trains_the_policy_only():
    tensors = {
        "loc": torch.zeros(3, 2),
        "scale": torch.ones(3, 2),
        "samples": torch.randn(4, 3, 2),
        "log_weights": torch.randn(4, 3),
    }
    for tensor in tensors.values():
        tensor.requires_grad_()
    loss, weights, *_ = centred_gaussian_projection(**tensors, sample_dim=0)
    assert not weights.requires_grad
    loss.sum().backward()
    trained = [name for name, tensor in tensors.items() if tensor.grad is not None]
    assert trained == ["loc", "scale"]


@DTYPES
@pytest.mark.parametrize("log_weights", [(0.0,), (0.0, -1e5, -1e5), (3e38, 0.0, -3e38)])
def test_one_sample_says_nothing_of_the_scale(dtype, log_weights):
    """Where all weight is on one sample the scale stays, the mean goes there."""
    samples = torch.arange(1.0, len(log_weights) + 1, dtype=dtype).unsqueeze(-1)
    loc, scale, log_weights = (vector(*x, dtype=dtype) for x in ((0,), (0.5,), log_weights))
    grad = centred_gradient(loc, scale, samples, log_weights, sample_dim=0)
    assert_close(grad.mean.item(), -4.0)
    assert_close(grad.log_scale.item(), 0.0, atol=1e-6, rtol=0)
    assert grad.loss.isfinite()


@settings(max_examples=100)
@given(data=st.data(), dtype=st.sampled_from([torch.float32, torch.float64]))
def test_centred_projection_of_finite_input_is_never_nan(data, dtype):
    m = data.draw(st.integers(1, 4))
    rows = [
        data.draw(st.lists(values, min_size=m, max_size=m))
        for values in (EXTREME_SCORES, st.floats(-1e3, 1e3))
    ]
    log_weights, samples = (torch.tensor(row, dtype=dtype) for row in rows)
    scale = torch.tensor([data.draw(st.sampled_from([1e-4, 1.0, 10.0]))], dtype=dtype)
    loc, samples = torch.zeros(1, dtype=dtype), samples.unsqueeze(-1)
    grad = centred_gradient(loc, scale, samples, log_weights, sample_dim=0)
    assert all(value.isfinite().all() for value in grad)


def _two_humps(u: Tensor) -> Tensor:
    """Log-density, up to a constant, of a mixture that is no Gaussian."""
    return torch.logaddexp(-0.5 * (u - 1) ** 2 / 0.3, -0.5 * (u + 2) ** 2 - 0.7)


@pytest.mark.parametrize(
    "log_density", [_two_humps, lambda u: -0.5 * (u - 1.5) ** 2 / 0.4], ids=["humps", "gaussian"]
)
@pytest.mark.parametrize("start", [(4.0, 0.3), (-3.0, 2.0)], ids=str)
def test_both_projections_have_the_same_minimiser(log_density, start):
    """Mean and variance of the target, by quadrature; and descent arrives there."""
    grid = torch.linspace(-12, 12, 10_001, dtype=torch.float64)
    log_weights = log_density(grid)
    weights = log_weights.softmax(0)
    mean = (weights * grid).sum()
    scale = (weights * (grid - mean) ** 2).sum().sqrt()
    tolerance = {"atol": 2e-3, "rtol": 0.0}  # sum w^2 of the grid
    for projection in (centred_gaussian_projection, paper_projection):
        at = [projection, mean.view(1), scale.view(1), grid.unsqueeze(-1), log_weights]
        grad = gaussian_gradient(*at, sample_dim=0)
        assert_close((grad.mean.item(), grad.log_scale.item()), (0.0, 0.0), **tolerance)
        loc, log_scale = vector(start[0]), vector(math.log(start[1]))
        for _ in range(120):
            at[1], at[2] = loc, log_scale.exp()
            grad = gaussian_gradient(*at, sample_dim=0)
            # Newton's steps, shortened: units of the policy's own scale.
            loc = loc - 0.2 * log_scale.exp().square().clamp(max=4.0) * grad.mean
            log_scale = log_scale - (0.1 * grad.log_scale).clamp(-0.1, 0.1)
        assert_close((loc.item(), log_scale.exp().item()), (mean.item(), scale.item()), **tolerance)


WEIGHTS = {
    "equal": (1.0,) * 8,
    "unequal": (8.0, 5.0, 3.0, 2.0, 1.0, 1.0, 0.5, 0.1),
    "two": (1.0, 1.0),
    "four": (10.0, 1.0, 1.0, 1.0),
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_variance_of_the_centred_scale_is_unbiased(name):
    """Over 40,000 draws of M samples; without 1 / (1 - sum w^2) it falls short by sum w^2."""
    weights = vector(*WEIGHTS[name])
    repetitions = 40_000
    generator = torch.Generator().manual_seed(0)
    samples = torch.randn(len(weights), repetitions, 1, generator=generator, dtype=torch.float64)
    log_weights = weights.log().unsqueeze(-1).expand(-1, repetitions)
    variance = sample_variance(samples, log_weights)
    standard_error = variance.std() / math.sqrt(repetitions)
    assert (variance.mean() - 1).abs() < 4 * standard_error
    share = (weights / weights.sum()).square().sum()
    uncorrected = variance * (1 - share)
    assert (uncorrected.mean() - 1).abs() > 10 * standard_error
    assert (uncorrected.mean() - (1 - share)).abs() < 4 * standard_error


@pytest.mark.parametrize(
    ("slope", "m", "most"), [(0.25, 8, 0.02), (0.5, 8, 0.06), (0.5, 64, 0.013)]
)
def test_variance_of_a_lift_is_nearly_unbiased(slope, m, most):
    """Weights that depend on the samples (Q linear: the target is N(slope, 1)) leave a bias."""
    generator = torch.Generator().manual_seed(0)
    samples = torch.randn(m, 1_600_000 // m, 1, generator=generator, dtype=torch.float64)
    log_weights = slope * samples.squeeze(-1)
    variance = sample_variance(samples, log_weights)
    share = self_normalised_weights(log_weights, sample_dim=0).square().sum(0)
    bias = (variance.mean() - 1).item()
    assert abs(bias) < most
    uncorrected = ((variance * (1 - share)).mean() - 1).item()
    assert uncorrected < bias - 0.8 / m


def _entropy_excess(
    projection, *, speed: float, m: int = 256, num_runs: int = 50, num_steps: int = 400
) -> float:
    """Entropy of a Gaussian policy that follows Q = -c/2 (a - speed t)^2, above the lift's own.

    Each step lifts the policy as it is and takes one gradient step, before the mean has arrived.
    The lift's fixed point has the variance tau'/c, wherever the optimum is.
    """
    tau, tau_prime, curvature, rate = 1.0, 0.25, 1.0, 0.1
    torch.manual_seed(0)
    loc = torch.zeros(num_runs, 1, dtype=torch.float64)
    log_scale = torch.full_like(loc, 0.5 * math.log(tau_prime / curvature))
    start = log_scale.mean().item()
    entropy = []
    for step in range(num_steps):
        scale = log_scale.exp()
        samples = loc + scale * torch.randn(m, *loc.shape, dtype=torch.float64)
        score = -0.5 * curvature * (samples - speed * step).square().squeeze(-1)
        log_prob = torch.distributions.Normal(loc, scale).log_prob(samples).squeeze(-1)
        log_weights = lifted_log_weights(score, log_prob, tau=tau, tau_prime=tau_prime)
        grad = gaussian_gradient(projection, loc, scale, samples, log_weights, sample_dim=0)
        loc = loc - rate * scale.square() * grad.mean
        log_scale = log_scale - rate * grad.log_scale
        if step >= num_steps // 2:
            entropy.append(log_scale.mean().item() - start)
    return sum(entropy) / len(entropy)


def test_centred_scale_keeps_the_entropy_where_the_letter_inflates_it():
    """While the mean lags behind its target, which it does as long as the optimum moves."""
    assert _entropy_excess(paper_projection, speed=0.02) > 0.2
    assert abs(_entropy_excess(centred_gaussian_projection, speed=0.02)) < 0.01
    for projection in (paper_projection, centred_gaussian_projection):
        assert abs(_entropy_excess(projection, speed=0.0)) < 0.01


# ----------------------------------------------------------------------------------------- compile


@every_surrogate
@pytest.mark.parametrize(
    ("backend", "tensor_temperatures"),
    [("eager", True), pytest.param("aot_eager", False, marks=pytest.mark.slow)],
)
def test_surrogates_compile_without_a_graph_break(name, backend, tensor_temperatures):
    torch._dynamo.reset()
    x = random_samples(2, 4)
    mask = torch.tensor([True, True, False, True]).expand(2, 4)
    temperatures = (0.5, 0.25)
    if tensor_temperatures:
        temperatures = tuple(torch.tensor(t) for t in temperatures)
    compiled = torch.compile(SURROGATES[name], fullgraph=True, backend=backend)
    expected = SURROGATES[name](x, *temperatures, mask=mask)
    assert_close(tuple(compiled(x, *temperatures, mask=mask)), tuple(expected))

    def grad(function) -> Tensor:
        return gradient(
            lambda log_prob: function(x._replace(log_prob=log_prob), *temperatures, mask=mask).loss,
            x.log_prob,
        )

    assert_close(grad(compiled), grad(SURROGATES[name]))


# ------------------------------------------------------------------------------------------ errors


@pytest.mark.parametrize("name", ["mean_seeking", *VALUES])
@pytest.mark.parametrize(
    ("tau", "tau_prime", "message"),
    [
        (-0.1, 0.5, r"tau must be a finite number >= 0, got -0\.1"),
        (0.5, -0.1, r"tau_prime must be a finite number >= 0, got -0\.1"),
        (math.nan, 0.5, r"tau must be a finite number >= 0, got nan"),
        (0.5, math.inf, r"tau_prime must be a finite number >= 0, got inf"),
        (0.0, 0.0, r"tau \+ tau_prime must be positive, got 0.*Set a temperature above 0"),
    ],
)
def test_bad_temperatures_are_refused(name, tau, tau_prime, message):
    with pytest.raises(ValueError, match=message):
        FUNCTIONS[name](random_samples(4), tau, tau_prime)


def test_urex_needs_a_temperature_and_ment_does_not():
    x = random_samples(4)
    for name, tau in itertools.product(("urex", "ment"), (-1.0, math.nan, math.inf)):
        with pytest.raises(ValueError, match=f"tau must be a finite number >= 0, got {tau}"):
            SURROGATES[name](x, tau, None)
    with pytest.raises(ValueError, match="tau must be positive, got 0"):
        SURROGATES["urex"](x, 0.0, None)
    assert SURROGATES["ment"](x, 0.0, None).loss.isfinite()


def test_check_temperatures():
    check_temperatures()  # a loss may have none
    check_temperatures(tau=0.0, tau_prime=1e-300)
    check_temperatures(allow_zero=True, tau=0.0, tau_prime=0.0)
    check_temperatures(tau=torch.tensor(-1.0), tau_prime=0.0)  # tensors are not looked at
    with pytest.raises(ValueError, match="tau_prime must be a finite number"):
        check_temperatures(allow_zero=True, tau=0.0, tau_prime=-1.0)
    with pytest.raises(ValueError, match="tau_prime must be a finite number"):
        check_temperatures(tau=torch.tensor(1.0), tau_prime=math.nan)


@pytest.mark.parametrize(
    ("horizon", "n", "message"),
    [
        (0.5, 2, "horizon must be at least 1.*, got 0.5"),
        (10, 1, "num_trajectories must be at least 2.*, got 1"),
    ],
)
def test_theorem1_arguments_at_the_edges(horizon, n, message):
    with pytest.raises(ValueError, match=message):
        theorem1_temperatures(horizon, n)


@pytest.mark.parametrize("name", ["urex", "ment", "soft_value_estimate"])
def test_integer_scores_are_taken_as_numbers(name):
    x = random_samples(1, 3)._replace(score=torch.tensor([[1, 0, 2]]))
    found, expected = (
        FUNCTIONS[name](each, 0.5, 0.25) for each in (x, x._replace(score=x.score.double()))
    )
    assert_close(found[0], expected[0])


def test_differences_of_log_probabilities_may_overflow():
    large = torch.tensor([3e38, -3e38])
    projections = [
        mode_seeking_projection(large, large, torch.zeros(2), behaviour_log_prob=-large),
        mode_seeking_projection(large, -large, torch.zeros(2)),
        mean_seeking_projection(large, torch.zeros(2), control_log_prob=-large),
    ]
    for loss, weights, *_ in projections:
        assert loss.isfinite()
        assert weights.isfinite().all()


# -------------------------------------------------------------------------------- path consistency


@DTYPES
@pytest.mark.parametrize(
    ("n_steps", "masked", "expected"),
    [
        (1, False, (0.0, -0.5, -0.75)),
        (2, False, (-0.25, -0.875, -0.75)),
        (9, False, (-0.4375, -0.875, -0.75)),
        (2, True, (-0.375, -0.75, 0.0)),
    ],
)
def test_path_consistency_by_hand(n_steps, masked, expected, dtype):
    """Steps gain r + 0.75 - 1 = 0.75, -0.25, -0.25; V is 1, 0.5, 0.5, and half of it later."""
    log_prob, values = vector(-1, -1, -1, dtype=dtype), vector(1, 0.5, 0.5, dtype=dtype)
    tensors = [vector(1, 0, 0, dtype=dtype), log_prob, 2 * log_prob, values]
    mask = torch.tensor([True, True, False]) if masked else None
    for tensor in tensors if masked else ():
        tensor[2] = math.nan
    options = {"tau": 0.5, "tau_prime": 0.25, "gamma": 0.5, "n_steps": n_steps, "mask": mask}
    assert_close(path_consistency(*tensors, **options), vector(*expected, dtype=dtype))
    if not masked:
        tensors[0], options["n_steps"] = tensors[0].int(), np.int64(n_steps)
        assert_close(path_consistency(*tensors, **options), vector(*expected, dtype=dtype))


@pytest.mark.parametrize(("tau", "tau_prime"), [(0.5, 0.25), (1.0, 0.0), (0.0, 0.3)])
@pytest.mark.parametrize("gamma", [1.0, 0.7])
def test_path_consistency_holds_at_the_optimum_on_every_path(tau, tau_prime, gamma):
    """V of Eq. 8 and its policy, by enumeration: 3 states, 2 actions, 4 steps; not of others."""
    generator = torch.Generator().manual_seed(0)
    reward, logits = torch.randn(2, 3, 2, generator=generator, dtype=torch.float64)
    reference, following = logits.log_softmax(-1), torch.tensor([[1, 2], [2, 0], [0, 1]])
    values, policies = [torch.zeros(3).double()], []
    for _ in range(4):
        score = reward + gamma * values[0][following]
        options = {"tau": tau, "tau_prime": tau_prime}
        values.insert(0, soft_value(score, reference, **options))
        log_weights = lifted_log_weights(score, reference, **options) + reference
        policies.insert(0, log_weights.log_softmax(-1))
    rows = []
    for actions in itertools.product(range(2), repeat=4):
        state, row = 0, []
        for t, action in enumerate(actions):
            step = reward[state, action], policies[t][state, action], reference[state, action]
            row.append(torch.stack([*step, values[t][state]]))
            state = int(following[state, action])
        rows.append(torch.stack(row, -1))
    paths = torch.stack(rows, 1)
    for n_steps in (1, 2, 3, 7):
        options = {"tau": tau, "tau_prime": tau_prime, "gamma": gamma, "n_steps": n_steps}
        assert_close(path_consistency(*paths, **options), torch.zeros(16, 4).double())
        assert (path_consistency(paths[0] + 0.01, *paths[1:], **options) > 0.0099).all()


# ---------------------------------------------------------------- moments by the score's gradient


def test_gaussian_cross_entropy_by_hand():
    """At N(2, 4), of moments 5 and 12: log 2 + (12/4 + 9/4 + log 2 pi) / 2."""
    loc, log_scale = vector(2).requires_grad_(), vector(math.log(2)).requires_grad_()
    loss = gaussian_cross_entropy(loc, log_scale.exp(), vector(5), vector(12))
    assert_close(loss.item(), math.log(2) + 0.5 * (3 + 2.25 + math.log(2 * math.pi)))
    loss.backward()
    assert_close((loc.grad, log_scale.grad), (vector(-3 / 4), vector(1 - 12 / 4)))


class Lifts(NamedTuple):
    """Samples of a standard Gaussian in pairs ``[M, B, A]``, and f = g x - x H x / 2 there."""

    samples: Tensor
    slope: Tensor
    log_weights: Tensor
    mean: Tensor
    variance: Tensor

    @classmethod
    def of(cls, gradient: Tensor, hessian: Tensor, m: int, *, tau: float, tau_prime: float):
        """With the target's moments: its precision is (tau + H) / (tau + tau')."""
        half = torch.randn(m // 2, *gradient.shape, dtype=gradient.dtype)
        x = torch.cat([half, -half])
        curved = torch.einsum("bij,mbj->mbi", hessian, x)
        total = tau + tau_prime
        score = (gradient * x - curved * x / 2).sum(-1) + tau_prime * x.square().sum(-1) / 2
        covariance = torch.linalg.inv(tau * torch.eye(x.shape[-1], dtype=x.dtype) + hessian)
        mean = torch.einsum("bij,bj->bi", covariance, gradient)
        variance = total * covariance.diagonal(dim1=-2, dim2=-1)
        return cls(x, gradient - curved, score / total, mean, variance)

    def moments(self, **options):
        """As they are estimated."""
        return lifted_gaussian_moments(*self[:3], sample_dim=0, **options)


@DTYPES
def test_lifted_gaussian_moments_by_hand(dtype):
    """Curvatures 1 and 3, tau = tau' = 1: z = x and 2x, so that c = (1 + 2) / (1 + 4) = 3/5.

    With weights 3/4 and 1/4 at +-1 the mean is 1/2, and all covariances are those of equal ones.
    """
    samples = vector(1, -1, dtype=dtype).view(2, 1, 1).expand(2, 2, 1)
    slope = -samples * vector(1, 3, dtype=dtype).view(1, 2, 1)
    log_weights = vector(3, 1, dtype=dtype).log().unsqueeze(-1).expand(2, 2)
    lifts = Lifts(samples, slope, log_weights, *(torch.empty(0),) * 2)
    temperatures = {"tau": 1.0, "tau_prime": 1.0}
    shift, variance = lifts.moments(**temperatures)
    assert_close(shift, vector(0.5 - 0.6 * 0.5, 0.5 - 0.6 * 1, dtype=dtype).unsqueeze(-1))
    assert_close(variance, vector(1 - 0.6 * (1 - 1), 1 - 0.6 * (2 - 1), dtype=dtype).unsqueeze(-1))
    variance = lifts.moments(**temperatures, width_entropy=0.0)[1]
    assert_close(variance, vector(1 - 0.6 * 0.5, 1 - 0.6 * 1.5, dtype=dtype).unsqueeze(-1))
    shift, variance = lifts.moments(**temperatures, state_mask=torch.tensor([True, False]))
    assert_close(shift, vector(0, -0.5, dtype=dtype).unsqueeze(-1))  # c = 1
    assert_close(variance, vector(1, 0.01, dtype=dtype).unsqueeze(-1))  # 0 would be no variance


@pytest.mark.parametrize(
    ("curvature", "control"),
    [(1.0, 1.0), (-0.5, 2.0), (-3.0, 0.0)],  # (tau + tau') / (tau + curvature), from 0 to 2
)
def test_control_coefficient_is_bounded(curvature, control):
    """Where the score curves upward: tau = tau' = 1 and z = (1 + curvature) x / 2, at +-1."""
    samples, log_weights = vector(1, -1).unsqueeze(-1), vector(3, 1).log()
    lifts = Lifts(samples, -curvature * samples, log_weights, *(torch.empty(0),) * 2)
    shift, variance = lifts.moments(tau=1.0, tau_prime=1.0)
    share = (1 + curvature) / 2
    assert_close(shift, vector(0.5 - control * share / 2))
    assert_close(variance, vector(1 - control * (share - 1)))


@pytest.mark.parametrize("size", [1, 6, 17])
@pytest.mark.parametrize("curvature", [0.0, 1.5])
@pytest.mark.parametrize(("tau", "tau_prime"), [(0.5, 0.25), (1.0, 0.0), (0.0, 0.4), (0.3, 5.0)])
def test_moments_are_exact_where_the_curvature_is_the_same(size, curvature, tau, tau_prime):
    """Of one pair at each state already, whatever the weights; phi narrows the width alone."""
    if tau == curvature == 0:
        return  # no distribution
    torch.manual_seed(size)
    gradient = torch.randn(5, size, dtype=torch.float64) / 3
    hessian = curvature * torch.linspace(1, 2, size).double().diag().expand(5, -1, -1)
    lifts = Lifts.of(gradient, hessian, 2, tau=tau, tau_prime=tau_prime)
    shift, variance = lifts.moments(tau=tau, tau_prime=tau_prime)
    assert_close((shift, variance), (lifts.mean, lifts.variance))
    lifts = lifts._replace(log_weights=torch.zeros(2, 5).double())
    shift, variance = lifts.moments(tau=tau, tau_prime=tau_prime, width_entropy=0.4)
    share = (tau + 0.4 * tau_prime) / (tau + tau_prime)
    assert_close((shift, variance), (lifts.mean, (share * lifts.variance).clamp_min(0.01)))


@pytest.mark.parametrize("size", [6, 17])
def test_moments_converge_and_err_less_than_those_of_samples(size):
    """A full Hessian at each state. Four samples with gradients against eight without."""
    torch.manual_seed(0)
    root = torch.randn(500, size, size, dtype=torch.float64) / size**0.5
    gradient = torch.randn(500, size, dtype=torch.float64) * 0.4 / size**0.5
    temperatures = {"tau": 1.0, "tau_prime": 0.25}

    def errors(m):
        lifts = Lifts.of(gradient, root @ root.mT / 4, m, **temperatures)
        weights = lifts.log_weights.softmax(0).unsqueeze(-1)
        by_weights = (weights * lifts.samples).sum(0) - lifts.mean
        shift, variance = lifts.moments(**temperatures)
        differences = (by_weights, shift - lifts.mean, variance - lifts.variance)
        return torch.stack([x.square().mean().sqrt() for x in differences])

    few, eight, many = errors(4), errors(8), errors(2_000)
    assert few[1] < eight[0] / 2
    assert (many[1:] < 0.03).all()
    assert (many[1:] < few[1:] / 5).all()


def test_moments_of_a_curved_score_by_quadrature():
    """f = sin 2x: of one dimension, where the target can be summed on a grid."""
    torch.manual_seed(0)
    tau, tau_prime = 0.7, 0.3
    grid = torch.linspace(-9, 9, 20_001, dtype=torch.float64)
    density = (-tau * grid.square() / 2 + (2 * grid).sin()).softmax(0)
    mean = (density * grid).sum()
    variance = (density * (grid - mean).square()).sum()
    half = torch.randn(50_000, 4, 1, dtype=torch.float64)
    x = torch.cat([half, -half])
    log_weights = ((2 * x).sin() + tau_prime * x.square() / 2).squeeze(-1)
    lifts = Lifts(x, 2 * (2 * x).cos(), log_weights, mean, variance)
    estimate = lifts.moments(tau=tau, tau_prime=tau_prime)
    assert_close(estimate, (mean.expand(4, 1), variance.expand(4, 1)), atol=0.02, rtol=0)


def test_antithetic_pairs_have_their_own_degrees_of_freedom():
    """Without them, by 1 - sum w^2 = 3/4 of four flat weights, S would be 4/3 of what it is."""
    torch.manual_seed(0)
    flat = torch.zeros(20_000, 1, dtype=torch.float64)
    lifts = Lifts.of(flat, flat.unsqueeze(-1), 4, tau=1.0, tau_prime=0.0)
    curved = torch.randn_like(lifts.slope) * 1e3  # which leaves c = 0
    variance = lifts._replace(slope=curved).moments(tau=1.0, tau_prime=0.0)[1]
    assert variance.mean().item() == pytest.approx(1, abs=0.03)


def test_moments_of_one_sample_and_of_any_shape():
    """All weight on one sample tells no width; states are pooled over all their dimensions."""
    torch.manual_seed(0)
    gradient = torch.randn(6, 2, dtype=torch.float64)
    lifts = Lifts.of(gradient, torch.eye(2).double().expand(6, 2, 2), 4, tau=1.0, tau_prime=0.5)
    alone = lifts._replace(
        log_weights=torch.full((4, 6), -1e5).double().index_fill(0, vector(1).long(), 0.0)
    )
    assert_close(alone.moments(tau=1.0, tau_prime=0.5)[1], torch.ones(6, 2).double())
    expected = lifts.moments(tau=1.0, tau_prime=0.5)
    moved = [x.unflatten(1, (3, 2)).movedim(0, 2) for x in lifts[:3]]
    actual = lifted_gaussian_moments(*moved, tau=1.0, tau_prime=0.5)
    assert_close([x.flatten(0, 1) for x in actual], list(expected))


def test_there_must_be_samples():
    none = torch.zeros(2, 0)
    for call in (lambda: mean_seeking_projection(none, none), lambda: standardised(none)):
        with pytest.raises(ValueError, match=r"There are no samples along -1 of \(2, 0\)"):
            call()
