"""The equations of the paper as pure functions: tensors in, tensors out.

Source of every equation number: Mei, Xiao, Huang, Schuurmans, Müller, *On Principled Entropy
Exploration in Policy Optimization*, IJCAI 2019.

Shapes
------
Every function works along one axis of *samples*, ``sample_dim``: the K trajectories of a group, or
the M actions drawn at a state (or all actions, where a sum is exact). ``E*`` stands for the shape
that is left when this axis is taken out: any number of dimensions, also none. So ``[E*, K]`` is a
tensor with the sample axis inserted at ``sample_dim`` and ``[E*]``, the shape of a result unless
another is stated, has one number per group. Nothing is averaged over ``E*``: the caller decides.

Symbols
-------
==================== ================ =====================================================
argument             symbol           meaning
==================== ================ =====================================================
score                r(rho), Q(s, a)  ``[E*, K]``, what is to be maximised
log_prob             log pi_theta     ``[E*, K]``, under the policy being trained; carries the
                                      gradient
reference_log_prob   log pi_bar       ``[E*, K]``, under the reference policy, which is lifted
behaviour_log_prob   log beta         ``[E*, K]``, under the policy that drew the samples
log_weights          omega            ``[E*, K]``, of the target relative to the policy that drew
                                      the samples, up to a constant
tau                  tau >= 0         temperature of the divergence from the reference
tau_prime            tau' >= 0        temperature of the entropy
sample_dim                            the axis of the samples; the last by default
mask                                  ``[E*, K]``, True where a sample is real (an action is
                                      allowed); None, the default: all are
values, weights                       ``[E*, K]``; values may carry a gradient
keepdim                               whether the sample axis stays, with length 1
==================== ================ =====================================================

Where an argument is what the table says, its function does not say it again. Temperatures are
numbers or tensors (0-d, or ``[E*, 1]``, one for each group), in the unit of the score. Numbers,
types and shapes are checked (TypeError, ValueError), and shapes broadcast to one of theirs, but not
along the samples; the values of tensors are taken as they are, so that nothing waits for a device:
NaN comes out as NaN. Finite input never gives NaN, as long as the temperatures are neither 0 nor
infinite in the dtype of the scores (from 1e-37 to 1e38 in float32), but for values of 1e20 and
above in :func:`matched_temperature` and :func:`path_consistency`. Half precision is too narrow for
sums over trajectories: give float32, as the losses do. A group in which all samples are masked has
weights and a loss of 0, and no soft value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "Surrogate",
    "centred",
    "centred_gaussian_projection",
    "check_temperatures",
    "clipped_gain",
    "divergence_penalty",
    "effective_sample_size",
    "gaussian_cross_entropy",
    "group_cross_entropy",
    "leave_one_out",
    "lift_divergence_estimate",
    "lifted_gaussian_moments",
    "lifted_log_weights",
    "log_mean_exp",
    "masked_mean",
    "matched_temperature",
    "mean_seeking_projection",
    "ment_surrogate",
    "mode_seeking_projection",
    "path_consistency",
    "score_function_loss",
    "self_normalised_weights",
    "soft_value",
    "soft_value_estimate",
    "squared_residual_projection",
    "standardised",
    "standardised_in_batch",
    "surrogate_reward",
    "temperature_dual",
    "theorem1_temperatures",
    "uniform_weights",
    "urex_surrogate",
    "weighted_sum",
]


TEMPERATURES = ("tau", "tau_prime")
LEAST_VARIANCE = 0.01
"""Of an estimate, in units of the reference's variance."""


class Surrogate(NamedTuple):
    """What a member of the family returns: a loss, the weights behind it, and what else it found.

    Only ``loss`` and ``weights`` come from the functions of this module.

    Examples:
        >>> surrogate = mean_seeking_projection(torch.zeros(2, 4), torch.zeros(2, 4))
        >>> surrogate.loss.shape, surrogate.weights[0].tolist()
        (torch.Size([2]), [0.25, 0.25, 0.25, 0.25])
    """

    loss: Tensor
    """``[E*]``: differentiate with respect to the parameters behind ``log_prob``."""
    weights: Tensor | None
    """``[E*, K]``, detached: non-negative, summing to 1 over real samples. None without a lift."""
    losses: Mapping[str, Tensor] = {}  # a mappingproxy, which cannot be written, breaks the graph
    """Further losses by their full names (``"loss_eta"``), ``[E*]`` or 0-d."""
    metrics: Mapping[str, Tensor] = {}
    """Further metrics by name (``"clip_fraction"``), ``[E*]`` or 0-d."""


def _check_samples(
    sample_dim: int | None = None, mask: Tensor | None = None, **values: Tensor | float | None
) -> torch.Size:
    """Refuse what is no tensor of real numbers, and shapes that none of the tensors has alone.

    Returns that one.
    """
    tensors: dict[str, Tensor] = {}
    for name, value in values.items():
        if isinstance(value, Tensor) and (value.is_floating_point() or _is_score(name, value)):
            tensors[name] = value
        elif value is not None and not (name in TEMPERATURES and _is_number(value)):
            raise TypeError(f"{name} must be a floating-point tensor, got {_kind(value)}.")
    if mask is not None:
        if not isinstance(mask, Tensor) or mask.dtype != torch.bool:
            raise TypeError(f"mask must be a boolean tensor, got {_kind(mask)}.")
        tensors["mask"] = mask
    first, *others = (value.shape for value in tensors.values())
    shape = first if all(other == first for other in others) else _whole([first, *others])
    if shape is None:
        listed = ", ".join(f"{name} {tuple(value.shape)}" for name, value in tensors.items())
        raise ValueError(f"The shapes do not fit each other: {listed}.")
    if sample_dim is not None and sample_dim not in range(-len(shape), len(shape)):
        raise ValueError(
            f"sample_dim must be an axis of {', '.join(tensors)}, which have the shape "
            f"{tuple(shape)}, got {sample_dim!r}."
        )
    if sample_dim is not None:
        axis = _axis(sample_dim, shape)
        if not shape[axis]:
            raise ValueError(f"There are no samples along {sample_dim} of {tuple(shape)}.")
        for name, value in tensors.items():
            size = value.shape[axis] if value.ndim >= -axis else None
            wanted = (1, None) if name in TEMPERATURES else (shape[axis],)
            if size not in wanted and name != "mask":
                raise ValueError(
                    f"{name} must have {wanted[0]} along the axis of the samples, {sample_dim} of "
                    f"{tuple(shape)}, got the shape {tuple(value.shape)}."
                )
    return shape


def widened(values: Tensor) -> Tensor:
    """In single precision at least: what is added up, or divided by a small temperature.

    Examples:
        >>> widened(torch.tensor([300.0], dtype=torch.float16)).square()
        tensor([90000.])
    """
    return values.to(torch.promote_types(values.dtype, torch.float32))


def _axis(sample_dim: int, shape: torch.Size) -> int:
    """The axis of the samples, counted from the last."""
    return sample_dim % len(shape) - len(shape)


def _of_groups(temperature: float | Tensor, axis: int) -> float | Tensor:
    """A temperature without the axis of the samples, if it has one."""
    if isinstance(temperature, Tensor) and temperature.ndim >= -axis:
        return temperature.squeeze(axis)
    return temperature


def _whole(shapes: Sequence[torch.Size]) -> torch.Size | None:
    """The one of the shapes to which the others broadcast, if there is one."""
    return next((whole for whole in shapes if all(_fits(s, whole) for s in shapes)), None)


def _fits(shape: torch.Size, whole: torch.Size) -> bool:
    """Whether a shape broadcasts to another one (torch.broadcast_shapes takes 50 times as long)."""
    pairs = zip(reversed(shape), reversed(whole), strict=False)
    return len(shape) <= len(whole) and all(size in (1, other) for size, other in pairs)


def _is_score(name: str, value: Tensor) -> bool:
    """Rewards may be integers."""
    return name in ("score", "rewards") and not value.is_complex() and value.dtype != torch.bool


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float, np.number)) and not isinstance(value, (bool, complex))


def _kind(value: object) -> str:
    return str(value.dtype) if isinstance(value, Tensor) else type(value).__name__


# --------------------------------------------------------------------------------------- the lift


def check_temperatures(*, allow_zero: bool = False, **temperatures: float | Tensor) -> None:
    """Refuse temperatures for which a loss is not defined.

    Each must be finite and at least 0, and one above 0, unless ``allow_zero``. Tensors are not
    looked at.

    Examples:
        >>> check_temperatures(tau=0.5, tau_prime=0.01)
        >>> check_temperatures(tau=0.5, tau_prime=-0.01)
        Traceback (most recent call last):
            ...
        ValueError: tau_prime must be a finite number >= 0, got -0.01.
    """
    floats = {name: t for name, t in temperatures.items() if not isinstance(t, Tensor)}
    for name, value in floats.items():
        if not (_is_number(value) and 0 <= value < math.inf):
            raise ValueError(f"{name} must be a finite number >= 0, got {value!r}.")
    none_is_positive = len(floats) == len(temperatures) and not any(floats.values())
    if temperatures and none_is_positive and not allow_zero:
        raise ValueError(
            f"{' + '.join(temperatures)} must be positive, got 0: without any regularisation the "
            "lifted policy is a maximum, not a distribution. Set a temperature above 0."
        )


def lifted_log_weights(
    score: Tensor,
    reference_log_prob: Tensor,
    *,
    tau: float | Tensor,
    tau_prime: float | Tensor,
) -> Tensor:
    r"""Log-weight of the lifted policy relative to the reference: Lemma 1's :math:`\omega`, Eq. 5.

    .. math::
        \omega = \frac{r(\rho) - \tau' \log \bar\pi(\rho)}{\tau + \tau'},
        \qquad \bar\pi^*_{\tau,\tau'}(\rho) \propto \bar\pi(\rho) \exp \omega .

    Returns:
        ``[E*, K]``, unnormalised. Add ``reference_log_prob`` for the lifted log-probability up to a
        constant (Eq. 5, 8); add ``reference_log_prob - behaviour_log_prob`` where another policy
        than the reference drew the samples.

    Examples:
        (1 - 0.25 * -2) / (0.5 + 0.25) = 2 and (0 - 0.25 * -1) / 0.75 = 1/3:

        >>> score, reference = torch.tensor([1.0, 0.0]), torch.tensor([-2.0, -1.0])
        >>> lifted_log_weights(score, reference, tau=0.5, tau_prime=0.25)
        tensor([2.0000, 0.3333])
    """
    check_temperatures(tau=tau, tau_prime=tau_prime)
    _check_samples(score=score, reference_log_prob=reference_log_prob, tau=tau, tau_prime=tau_prime)
    return _representable((score - tau_prime * reference_log_prob) / (tau + tau_prime))


def self_normalised_weights(
    log_weights: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None
) -> Tensor:
    r"""Self-normalised importance weights, the softmax in Eq. 6.

    .. math:: w_k = \frac{\exp \omega_k}{\sum_j \exp \omega_j}

    Returns:
        ``[E*, K]``, summing to one; 0 where masked.

    Examples:
        >>> self_normalised_weights(torch.tensor([3.0, 1.0]).log())
        tensor([0.7500, 0.2500])
        >>> self_normalised_weights(torch.zeros(3), mask=torch.tensor([True, True, False]))
        tensor([0.5000, 0.5000, 0.0000])
    """
    _check_samples(sample_dim, mask, log_weights=log_weights)
    if mask is None:
        return log_weights.softmax(sample_dim)
    weights = log_weights.where(mask, _lowest(log_weights)).softmax(sample_dim).where(mask, 0.0)
    # A real sample may itself have the lowest log-weight there is, and have shared with the masked.
    return weights / weights.sum(sample_dim, keepdim=True).clamp_min(_tiny(weights))


def effective_sample_size(weights: Tensor, *, sample_dim: int = -1) -> Tensor:
    r"""Kish's effective sample size (Owen 2013, section 9.3), the spread of importance weights.

    .. math:: \mathrm{ESS} = \frac{(\sum_k w_k)^2}{\sum_k w_k^2}

    It is 1 where one sample has all the weight, K where all are equal, and 0 for a group without
    weight. The weights are non-negative, normalised or not.

    Examples:
        1 / (0.75**2 + 0.25**2) = 1.6:

        >>> effective_sample_size(torch.tensor([0.75, 0.25]))
        tensor(1.6000)
    """
    _check_samples(sample_dim, weights=weights)
    # Scaled by the largest weight, so that no square under- or overflows.
    scaled = weights / weights.amax(sample_dim, keepdim=True).clamp_min(_tiny(weights))
    squares = scaled.square().sum(sample_dim)
    return scaled.sum(sample_dim).square() / squares.clamp_min(_tiny(weights))


# -------------------------------------------------------------------------------- the projections


def lift_divergence_estimate(
    weights: Tensor,
    *,
    base_weights: Tensor | None = None,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Tensor:
    r"""How far the lift goes: KL(target, pi_bar), from samples of the reference.

    .. math::
        \mathrm{KL}(\bar\pi^*_{\tau,\tau'} \| \bar\pi) \approx \sum_m w_m \log (M w_m)

    with w the :func:`self_normalised_weights` of M samples that the reference drew. In nats, from 0
    (equal weights) to log M (all weight on one sample), whatever the true divergence is.

    Args:
        base_weights: ``[E*, K]``, those of the reference itself, where another policy drew the
            samples; 1/M by default.

    Examples:
        >>> lift_divergence_estimate(torch.tensor([[0.5, 0.5], [1.0, 0.0]])) / math.log(2)
        tensor([0., 1.])
    """
    _check_samples(sample_dim, mask, weights=weights, base_weights=base_weights)
    log_base = (
        _log_uniform(weights, sample_dim, mask)
        if base_weights is None
        else base_weights.clamp_min(_tiny(base_weights)).log()
    )
    # 0 log 0 = 0
    log_ratio = weights.clamp_min(_tiny(weights)).log() - log_base
    return weighted_sum(weights, log_ratio, sample_dim=sample_dim, mask=mask).clamp_min(0.0)


def temperature_dual(log_temperature: Tensor, excess: Tensor) -> Tensor:
    r"""Loss of a learned temperature that holds a constraint: up where it is exceeded.

    .. math::
        L(\log \tau) = -\log \tau \cdot \mathrm{excess}

    with the excess held constant: a step of dual ascent in log-space. For SAC's temperature the
    excess is target entropy minus entropy; for a bound on the lift it is the divergence minus the
    bound, :func:`lift_divergence_estimate`.

    Args:
        log_temperature: ``[]``; carries the gradient.
        excess: ``[...]``, the shape of the loss; above 0 where the temperature is too low.

    Examples:
        >>> log_tau = torch.tensor(0.5).log().requires_grad_()
        >>> temperature_dual(log_tau, torch.tensor(0.3)).backward()
        >>> log_tau.grad  # gradient descent raises log tau
        tensor(-0.3000)
    """
    _check_samples(log_temperature=log_temperature, excess=excess)
    return -log_temperature * excess.detach()


def mean_seeking_projection(
    log_prob: Tensor,
    log_weights: Tensor,
    *,
    control_log_prob: Tensor | None = None,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Surrogate:
    r"""Project by the mean-seeking KL(target, pi): ECPO's gradient, Lemma 1, Eq. 6.

    .. math::
        L(\theta) = -\sum_k w_k \log \pi_\theta(\rho_k),
        \qquad w = \mathrm{softmax}_k(\omega_k)

    Args:
        log_weights: :func:`lifted_log_weights`, plus ``reference_log_prob - behaviour_log_prob``
            for data of another policy.
        control_log_prob: ``[E*, K]``, log-probability under the policy that drew the samples. If
            given, the self-normalised ratio softmax_k(log_prob - control_log_prob) is subtracted
            from each weight: a control variate whose expectation tends to zero, which removes the
            drift of groups in which all weights are equal. Not in the paper; ours.

    Returns:
        :class:`Surrogate`: its loss ``[E*]`` is the cross-entropy to the target (minus that to the
        policy itself, with the control variate); its weights are w.

    Examples:
        Weights 3/4 and 1/4; 0.75 * 2 + 0.25 * 1 = 1.75:

        >>> log_prob = torch.tensor([-2.0, -1.0], requires_grad=True)
        >>> loss, weights, *_ = mean_seeking_projection(log_prob, torch.tensor([3.0, 1.0]).log())
        >>> loss.backward(); loss.detach(), log_prob.grad
        (tensor(1.7500), tensor([-0.7500, -0.2500]))
    """
    _check_samples(
        sample_dim,
        mask,
        log_prob=log_prob,
        log_weights=log_weights,
        control_log_prob=control_log_prob,
    )
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    weights = self_normalised_weights(log_weights.detach(), **where)
    coefficients = weights
    if control_log_prob is not None:
        log_ratio = _representable((log_prob - control_log_prob).detach())
        coefficients = weights - self_normalised_weights(log_ratio, **where)
    return Surrogate(-weighted_sum(coefficients, log_prob, **where), weights)


def centred_gaussian_projection(
    loc: Tensor,
    scale: Tensor,
    samples: Tensor,
    log_weights: Tensor,
    *,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Surrogate:
    r"""Project by the mean-seeking KL(target, pi) onto a diagonal Gaussian, with a *centred scale*.

    Of a Gaussian the projection (Eq. 6, Eq. 11) has the gradients

    .. math::
        \frac{\partial L}{\partial \mu} = \frac{\mu - m}{\sigma^2}, \qquad
        \frac{\partial L}{\partial \log \sigma} = 1 - \frac{V + (m - \mu)^2}{\sigma^2}, \qquad
        m = \sum_m w_m u_m, \quad V = \sum_m w_m (u_m - m)^2 .

    At the projection :math:`\mu = m`. An actor-critic lifts again long before it is there, so
    :math:`(m - \mu)^2` never vanishes and keeps the policy wider than its target. Here the scale
    gets the variance of the samples about *their own* mean, with the factor that makes it unbiased
    for weights that do not depend on the samples:

    .. math::
        \frac{\partial L}{\partial \log \sigma} = 1 - \frac{S}{\sigma^2}, \qquad
        S = \frac{\sum_m w_m (u_m - m)^2}{1 - \sum_m w_m^2}

    The gradient of the mean is the same, and so is the minimiser, as M grows. The way there is a
    block-coordinate step: the scale goes where it would go if the mean had arrived. The weights of
    a lift do depend on the samples, so that S is too small by about 5 % at M = 8 for a lift that
    moves the mean by half a standard deviation.

    Args:
        loc: ``[E*, A]``, mean of the policy being trained; carries the gradient.
        scale: ``[E*, A]``, its standard deviation; carries the gradient.
        samples: ``[E*, M, A]`` with the sample axis where ``sample_dim`` has it in the weights. Of
            a transformed Gaussian (tanh) they are the values before the transform, whose Jacobian
            does not depend on the policy.
        sample_dim: the axis of the M samples, in ``log_weights``.

    Returns:
        :class:`Surrogate`: the loss is a cross-entropy in nats, with the variance above. Where all
        weight is on one sample, which tells no width, the scale gets no gradient.

    Examples:
        Two equal weights at 1 and 3: m = 2, S = 1 / (1 - 1/2) = 2.

        >>> loc, scale = torch.zeros(1, requires_grad=True), torch.ones(1, requires_grad=True)
        >>> samples = torch.tensor([[1.0], [3.0]])
        >>> loss, weights, *_ = centred_gaussian_projection(loc, scale, samples, torch.zeros(2))
        >>> loss.backward(); loc.grad, scale.grad
        (tensor([-2.]), tensor([-1.]))
    """
    _check_samples(sample_dim, log_weights=log_weights)
    dim = sample_dim % log_weights.ndim
    each, one = log_weights.shape, log_weights.select(dim, 0).shape
    of_each = {"loc": (loc, one), "scale": (scale, one), "samples": (samples, each)}
    for name, (value, shape) in of_each.items():
        _check_samples(None, None, **{name: value})
        if value.shape[:-1] != shape or value.shape[-1:] != loc.shape[-1:]:
            raise ValueError(
                f"{name} must have the shape {tuple(shape)} and an axis of A more, as "
                f"log_weights have {tuple(each)} and loc {tuple(loc.shape)}, got "
                f"{tuple(value.shape)}."
            )
    if mask is not None and getattr(mask, "shape", None) != each:
        raise ValueError(f"mask must have the shape {tuple(each)} of log_weights.")
    weights = self_normalised_weights(log_weights.detach(), sample_dim=dim, mask=mask)
    samples = samples.detach()
    if mask is not None:
        samples = samples.where(mask.unsqueeze(-1), 0.0)
    each = weights.unsqueeze(-1)
    mean = (each * samples).sum(dim)
    variance = (each * (samples - mean.unsqueeze(dim)).square()).sum(dim)
    freedom = (weights * (1 - weights)).sum(dim).unsqueeze(-1)
    is_known = freedom > torch.finfo(freedom.dtype).eps ** 0.5
    variance = torch.where(is_known, variance / freedom, scale.detach().square())
    loss = gaussian_cross_entropy(loc, scale, mean, variance)
    if mask is not None:
        loss = loss.where(mask.any(dim), 0.0)
    return Surrogate(loss, weights)


def gaussian_cross_entropy(loc: Tensor, scale: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    r"""Project by the mean-seeking KL(target, pi) onto a diagonal Gaussian, by given moments.

    .. math::
        \frac{\partial L}{\partial \mu} = \frac{\mu - m}{\sigma^2}, \qquad
        \frac{\partial L}{\partial \log \sigma} = 1 - \frac{S}{\sigma^2}

    The scale goes where it would go if the mean had arrived, see
    :func:`centred_gaussian_projection`.

    Args:
        loc: ``[E*, A]``, mean of the policy being trained; carries the gradient.
        scale: ``[E*, A]``, its standard deviation; carries the gradient.
        mean: ``[E*, A]``, m of the target.
        variance: ``[E*, A]``, S of the target.

    Returns:
        ``[E*]``, cross-entropy in nats.

    Examples:
        >>> loc, scale = torch.zeros(1, requires_grad=True), torch.ones(1, requires_grad=True)
        >>> gaussian_cross_entropy(loc, scale, torch.tensor([2.0]), torch.tensor([3.0])).backward()
        >>> loc.grad, scale.grad
        (tensor([-2.]), tensor([-2.]))
    """
    _check_samples(loc=loc, scale=scale, mean=mean, variance=variance)
    log_scale = scale.log()
    distance = (mean - loc) / scale.detach()
    width = variance * (-2 * log_scale).exp()
    return (log_scale + 0.5 * (width + distance.square() + math.log(2 * math.pi))).sum(-1)


def lifted_gaussian_moments(
    samples: Tensor,
    slope: Tensor,
    log_weights: Tensor,
    *,
    tau: float | Tensor,
    tau_prime: float | Tensor,
    width_entropy: float = 1.0,
    sample_dim: int = -1,
    state_mask: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    r"""Mean and variance of the lifted Gaussian policy (Eq. 8), from samples and gradients of Q.

    In units x of the reference N(0, 1), along each dimension, the target is

    .. math::
        \bar\pi^*(x) \propto N(x; 0, 1)^{\tau / \eta} e^{f(x) / \eta}, \qquad
        f = Q + \tau' \log |da/dx|, \quad \eta = \tau + \tau'

    and Stein's identity says of its score :math:`-z` that

    .. math::
        z = \frac{\tau x - \nabla f(x)}{\eta}, \qquad
        \mathbb{E}[z] = 0, \quad \mathrm{Cov}(x, z) = 1 .

    So z is a control variate of both moments. With means :math:`\langle \cdot \rangle` and
    covariances V by the weights of M samples,

    .. math::
        \delta = \langle x \rangle - c \langle z \rangle, \qquad
        S = V_{xx} - c \Big( V_{xz} - \frac{\tau + \varphi \tau'}{\eta} \Big), \qquad
        c = \frac{\sum V_{xz}}{\sum V_{zz}} \le \frac{\eta}{\tau}

    with sums over ``E*``. c = 0 is the estimate by samples alone; at its upper bound they have no
    part but in the weights, and :math:`\delta = \langle \nabla f \rangle / \tau`. Where f is
    linear, or quadratic, concave and of the same curvature everywhere, both are exact, whatever the
    weights are. Not in the paper; ours.

    Args:
        samples: ``[E*, M, A]`` with the sample axis where ``sample_dim`` has it in the weights: x,
            in antithetic pairs. The second half are the first half's mirror images, -x.
        slope: ``[E*, M, A]``, the gradient of f with respect to x, in the unit of Q.
        log_weights: ``[E*, M]``, :func:`lifted_log_weights`.
        width_entropy: phi in S. With 1 (default) S is the target's variance. Below, it is that of
            a target with less entropy, whose mean stays where it is.
        sample_dim: the axis of the M samples, in ``log_weights``.
        state_mask: ``[E*]``, True where a state is real: others have no part in c.

    Returns:
        The mean :math:`\delta` and the variance S, ``[E*, A]`` each, in units of the reference's
        deviation: 0 and 1 are the reference's own. Covariances have the factor
        :math:`1 / (1 - \sum (w_+ - w_-)^2)` over pairs, which makes them unbiased for weights that
        do not depend on the samples. Where all weight is on one sample, which tells no width, S
        is 1; elsewhere it is at least 0.01.

    Raises:
        ValueError: for shapes that do not go together and an odd number of samples.

    Examples:
        f = 2x, tau = 1, tau' = 0: the target is N(2, 1), whatever the weights are.

        >>> samples = torch.tensor([[0.5], [-0.5]])
        >>> slope, log_weights = torch.full((2, 1), 2.0), torch.zeros(2)
        >>> lifted_gaussian_moments(samples, slope, log_weights, tau=1.0, tau_prime=0.0)
        (tensor([2.]), tensor([1.]))
    """
    check_temperatures(tau=tau, tau_prime=tau_prime)
    _check_samples(sample_dim, log_weights=log_weights)
    dim, each = sample_dim % log_weights.ndim, log_weights.shape
    for name, value in {"samples": samples, "slope": slope}.items():
        _check_samples(None, None, **{name: value})
        if value.shape[:-1] != each or value.shape != samples.shape:
            raise ValueError(
                f"{name} must have the shape {tuple(each)} of log_weights and an axis of A more, "
                f"the same as samples, got {tuple(value.shape)}."
            )
    one = log_weights.select(dim, 0).shape
    if state_mask is not None and (
        not isinstance(state_mask, Tensor)
        or state_mask.dtype != torch.bool
        or state_mask.shape != one
    ):
        raise ValueError(
            f"state_mask must be boolean, of the shape {tuple(one)} of log_weights without the "
            f"samples, got {_kind(state_mask)} of shape {tuple(getattr(state_mask, 'shape', ()))}."
        )
    if not (_is_number(width_entropy) and 0 <= width_entropy <= 1):
        raise ValueError(f"width_entropy must be in [0, 1], got {width_entropy!r}.")
    if each[dim] % 2:
        raise ValueError(f"samples must come in pairs, got {each[dim]} of them.")
    tau, tau_prime = (torch.as_tensor(t).to(samples) for t in (tau, tau_prime))
    if tau.ndim or tau_prime.ndim:
        raise ValueError("tau and tau_prime must each be one number, or c could not be pooled.")
    total = tau + tau_prime
    residual = (tau * samples - slope) / total
    weights = log_weights.softmax(dim).unsqueeze(-1)

    def mean(values: Tensor) -> Tensor:
        return (weights * values).sum(dim, keepdim=True)

    first, second = weights.chunk(2, dim)
    freedom = 1 - (first - second).square().sum(dim)
    is_known = freedom > torch.finfo(freedom.dtype).eps ** 0.5
    is_pooled = is_known if state_mask is None else is_known & state_mask.unsqueeze(-1)

    def covariance(a: Tensor, b: Tensor) -> Tensor:
        return mean((a - mean(a)) * (b - mean(b))).squeeze(dim) / freedom.where(is_known, 1.0)

    def pooled(values: Tensor) -> Tensor:
        return values.where(is_pooled, 0.0).reshape(-1, values.shape[-1]).sum(0)

    both, own = covariance(samples, residual), covariance(residual, residual)
    control = pooled(both) / pooled(own).clamp_min(_tiny(own))
    control = control.clamp_min(0.0).minimum(total / tau)
    shift = (mean(samples) - control * mean(residual)).squeeze(dim)
    entropy = (tau + width_entropy * tau_prime) / total
    variance = covariance(samples, samples) - control * (both - entropy)
    return shift, variance.clamp_min(LEAST_VARIANCE).where(is_known, 1.0)


def mode_seeking_projection(
    log_prob: Tensor,
    reference_log_prob: Tensor,
    log_weights: Tensor,
    *,
    behaviour_log_prob: Tensor | None = None,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Surrogate:
    r"""Project by the mode-seeking KL(pi, target): PMD's gradient, Eq. 3 and footnote 1.

    By self-normalised importance sampling, with the score-function gradient centred:

    .. math::
        L(\theta) = -\sum_k v_k (A_k - \bar A) \log \pi_\theta(\rho_k), \quad
        v = \mathrm{softmax}_k \log\frac{\pi_\theta}{\beta}, \quad
        A_k = \omega_k - \log\frac{\pi_\theta(\rho_k)}{\bar\pi(\rho_k)}, \quad
        \bar A = \sum_k v_k A_k

    with v and A held constant. (tau + tau') A is the familiar
    r - tau (log pi - log pi_bar) - tau' log pi, so at pi = pi_bar and tau' = 0 this is REINFORCE
    with the group's mean as baseline, divided by tau.

    Args:
        log_weights: :func:`lifted_log_weights`, of the target relative to the *reference*, whoever
            drew the samples.
        behaviour_log_prob: that of the reference by default.

    Returns:
        :class:`Surrogate`: a loss ``[E*]`` whose gradient estimates that of KL(pi, target), but
        whose value does not; its weights are v.

    Examples:
        At pi = pi_bar the ratios are equal, and the weights 1 and 0 give A - mean = +-1/2:

        >>> log_prob = torch.tensor([-2.0, -1.0], requires_grad=True)
        >>> reference, log_weights = log_prob.detach(), torch.tensor([1.0, 0.0])
        >>> loss, v, *_ = mode_seeking_projection(log_prob, reference, log_weights)
        >>> loss.backward(); v, log_prob.grad
        (tensor([0.5000, 0.5000]), tensor([-0.2500,  0.2500]))
    """
    _check_samples(
        sample_dim,
        mask,
        log_prob=log_prob,
        reference_log_prob=reference_log_prob,
        log_weights=log_weights,
        behaviour_log_prob=behaviour_log_prob,
    )
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    current, reference_log_prob = log_prob.detach(), reference_log_prob.detach()
    behaviour = reference_log_prob if behaviour_log_prob is None else behaviour_log_prob.detach()
    ratios = self_normalised_weights(_representable(current - behaviour), **where)
    distance = _representable(current - reference_log_prob)
    advantage = _representable(log_weights.detach() - distance)
    advantage = advantage - weighted_sum(ratios, advantage, **where, keepdim=True)
    return Surrogate(-weighted_sum(ratios * advantage, log_prob, **where), ratios)


def squared_residual_projection(
    log_prob: Tensor,
    reference_log_prob: Tensor,
    log_weights: Tensor,
    *,
    normaliser: str = "mean",
    behaviour_log_prob: Tensor | None = None,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Surrogate:
    r"""Project by regression of log pi on the log of the target: Kimi k1.5's loss (2025).

    .. math::
        L(\theta) = \frac12 \sum_k v_k \left(
            \omega_k - \log Z - \log\frac{\pi_\theta(\rho_k)}{\bar\pi(\rho_k)} \right)^2, \quad
        v = \mathrm{softmax}_k \log\frac{\bar\pi}{\beta}

    with v, omega and Z held constant. It is 0 at the target. At pi = pi_bar its gradient is that of
    :func:`mode_seeking_projection`.

    Args:
        log_weights: :func:`lifted_log_weights`, of the target relative to the *reference*, whoever
            drew the samples.
        normaliser: ``"soft"``, log Z = log sum v exp omega, or ``"mean"``, its lower bound
            sum v omega, with which the residuals of a policy at the reference have mean 0.
        behaviour_log_prob: that of the reference by default: v is then 1/K.

    Returns:
        :class:`Surrogate`: a loss ``[E*]``; its weights are v.

    Examples:
        At pi = pi_bar: the residuals are 1 - 1/2 and 0 - 1/2.

        >>> log_prob = torch.tensor([-2.0, -1.0], requires_grad=True)
        >>> reference, log_weights = log_prob.detach(), torch.tensor([1.0, 0.0])
        >>> loss, v, *_ = squared_residual_projection(log_prob, reference, log_weights)
        >>> loss.backward(); loss.detach(), log_prob.grad
        (tensor(0.1250), tensor([-0.2500,  0.2500]))
    """
    if normaliser not in ("mean", "soft"):
        raise ValueError(f"normaliser must be 'mean' or 'soft', got {normaliser!r}.")
    _check_samples(
        sample_dim,
        mask,
        log_prob=log_prob,
        reference_log_prob=reference_log_prob,
        log_weights=log_weights,
        behaviour_log_prob=behaviour_log_prob,
    )
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    reference, log_weights = reference_log_prob.detach(), _representable(log_weights.detach())
    behaviour = reference if behaviour_log_prob is None else behaviour_log_prob.detach()
    weights = self_normalised_weights(_representable(reference - behaviour), **where)
    if normaliser == "mean":
        log_z = weighted_sum(weights, log_weights, **where, keepdim=True)
    else:
        log_base = weights.clamp_min(_tiny(weights)).log()
        log_z = _masked_logsumexp(log_weights + log_base, sample_dim, mask).unsqueeze(sample_dim)
    residual = log_weights - log_z - _representable(log_prob - reference)
    if mask is not None:
        residual = residual.where(mask, 0.0)
    largest = torch.finfo(residual.dtype).max ** 0.5 / 2  # whose square can be added up
    return Surrogate(
        weighted_sum(weights / 2, residual.clamp(-largest, largest).square(), **where), weights
    )


def group_cross_entropy(
    log_prob: Tensor, log_target: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None
) -> Surrogate:
    r"""Cross-entropy between two distributions over the samples of a group: TPO's loss (2026).

    .. math::
        L(\theta) = -\sum_k q_k \log p_k, \quad
        q = \mathrm{softmax}_k(\mathrm{log\_target}_k), \quad
        p = \mathrm{softmax}_k \log \pi_\theta(\rho_k)

    Its gradient in log pi is p - q: that of :func:`mean_seeking_projection` with a control variate
    whose sampler is uniform.

    Args:
        log_target: ``[E*, K]``, held constant, up to a constant.

    Returns:
        :class:`Surrogate`: its weights are q.

    Examples:
        p = (1/2, 1/2) and q = (3/4, 1/4); the loss is log 2:

        >>> log_prob = torch.tensor([-1.0, -1.0], requires_grad=True)
        >>> loss, q, *_ = group_cross_entropy(log_prob, torch.tensor([3.0, 1.0]).log())
        >>> loss.backward(); loss.detach(), log_prob.grad
        (tensor(0.6931), tensor([-0.2500,  0.2500]))
    """
    _check_samples(sample_dim, mask, log_prob=log_prob, log_target=log_target)
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    weights = self_normalised_weights(log_target.detach(), **where)
    normaliser = _masked_logsumexp(log_prob, sample_dim, mask).unsqueeze(sample_dim)
    return Surrogate(weighted_sum(weights, _representable(normaliser - log_prob), **where), weights)


def urex_surrogate(
    log_prob: Tensor,
    score: Tensor,
    *,
    tau: float | Tensor,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Surrogate:
    r"""UREX: policy gradient plus tau times a mean-seeking projection (Nachum et al., ICLR 2017).

    .. math::
        L(\theta) = -\frac1K \sum_k (S_k - \bar S) \log \pi_\theta(\rho_k), \quad
        S_k = r_k + \tau K w_k, \quad
        w = \mathrm{softmax}_k(r_k / \tau - \log \pi_\theta(\rho_k))

    with S held constant and :math:`\bar S` its mean over the group. The samples are the current
    policy's. UREX's tau is above 0. The weights w are ECPO's at tau = 0 and tau' = UREX's tau.

    Examples:
        Equal log-probabilities and tau = 1/log 3 give w = (3/4, 1/4), S = (1 + 1.5 tau, 0.5 tau):

        >>> log_prob = torch.tensor([-1.0, -1.0], requires_grad=True)
        >>> tau = 1 / math.log(3)
        >>> loss, weights, *_ = urex_surrogate(log_prob, torch.tensor([1.0, 0.0]), tau=tau)
        >>> loss.backward(); weights, log_prob.grad * 4 / (1 + tau)
        (tensor([0.7500, 0.2500]), tensor([-1.,  1.]))
    """
    check_temperatures(tau=tau)
    _check_samples(sample_dim, mask, log_prob=log_prob, score=score, tau=tau)
    current, score = log_prob.detach(), score.detach()
    log_weights = lifted_log_weights(score, current, tau=0.0, tau_prime=tau)
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    weights = self_normalised_weights(log_weights, **where)
    uniform = uniform_weights(log_prob, **where)
    # A masked sample has weight 0 in both, so the quotient's denominator may be anything there.
    signal = score + tau * weights / uniform.clamp_min(_tiny(uniform))
    return Surrogate(score_function_loss(log_prob, centred(signal, **where), **where), weights)


def ment_surrogate(
    log_prob: Tensor,
    score: Tensor,
    *,
    tau: float | Tensor,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Surrogate:
    r"""MENT: REINFORCE with an entropy bonus (Williams 1992), baseline = the group's mean.

    .. math::
        L(\theta) = -\frac1K \sum_k (S_k - \bar S) \log \pi_\theta(\rho_k), \quad
        S_k = r_k - \tau \log \pi_\theta(\rho_k)

    with S held constant. The samples are the current policy's, and the weights uniform. Here tau is
    the temperature of the entropy; 0 is plain REINFORCE.

    Examples:
        S = (1 + 0.5 * 1, 0 + 0.5 * 1), so S - mean = +-1/2 and the gradient -+1/4:

        >>> log_prob = torch.tensor([-1.0, -1.0], requires_grad=True)
        >>> loss, weights, *_ = ment_surrogate(log_prob, torch.tensor([1.0, 0.0]), tau=0.5)
        >>> loss.backward(); log_prob.grad
        tensor([-0.2500,  0.2500])
    """
    check_temperatures(tau=tau, allow_zero=True)
    _check_samples(sample_dim, mask, log_prob=log_prob, score=score, tau=tau)
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    signal = score - tau * log_prob.detach()
    loss = score_function_loss(log_prob, centred(signal, **where), **where)
    return Surrogate(loss, uniform_weights(log_prob, **where))


def clipped_gain(
    log_ratio: Tensor, advantage: Tensor, *, clip_low: float, clip_high: float
) -> tuple[Tensor, Tensor]:
    r"""The clipped gain of each sample, or step (Schulman et al. 2017), which GRPO ascends.

    .. math::
        \min\left(\rho A, \; \mathrm{clip}(\rho, 1 - \epsilon_{low}, 1 + \epsilon_{high}) A\right),
        \qquad \rho = \frac{\pi_\theta}{\beta}

    Args:
        log_ratio: ``[E*, K]``, log rho; carries the gradient.
        advantage: ``[E*, K]``, held constant: :func:`centred` or :func:`standardised` scores.
        clip_low: how far below 1 the ratio of what was worse counts; below 1.
        clip_high: how far above 1 the ratio of what was better counts.

    Returns:
        The gain ``[E*, K]``, and True where it is cut off, so that it has no gradient.

    Examples:
        Ratios 2, 2, 1/2, 1/2 with advantages 1, -1, 1, -1: the first and the last are cut off.

        >>> log_ratio = torch.tensor([2.0, 2.0, 0.5, 0.5]).log()
        >>> advantage = torch.tensor([1.0, -1.0, 1.0, -1.0])
        >>> clipped_gain(log_ratio, advantage, clip_low=0.25, clip_high=0.5)
        (tensor([ 1.5000, -2.0000,  0.5000, -0.7500]), tensor([ True, False, False,  True]))
    """
    for name, value, bound in (("clip_low", clip_low, 1.0), ("clip_high", clip_high, math.inf)):
        if not (_is_number(value) and 0 <= value < bound):
            raise ValueError(f"{name} must be a number >= 0 and < {bound:g}, got {value!r}.")
    _check_samples(log_ratio=log_ratio, advantage=advantage)
    advantage, log_ratio = advantage.detach(), _representable(log_ratio)
    too_low, too_high = math.log1p(-clip_low), math.log1p(clip_high)
    # The less of the two gains: the ratio is bounded from above, or from below if A is negative.
    limited = torch.where(
        advantage > 0,
        log_ratio.clamp(max=too_high),
        log_ratio.clamp(min=too_low, max=_largest_exponent(log_ratio)),
    )
    is_cut = (limited != log_ratio) & (advantage != 0)
    return _representable(limited.exp() * advantage), is_cut


def divergence_penalty(log_prob: Tensor, reference_log_prob: Tensor) -> Tensor:
    r"""Estimate of KL(pi, pi_bar) by each sample, or step, of pi: GRPO's penalty.

    .. math:: e^d - d - 1, \qquad d = \log\frac{\bar\pi}{\pi_\theta}

    Never below 0, and with the right expectation, which -d alone has too (Schulman, *Approximating
    KL divergence*, 2020).

    Returns:
        ``[E*, K]``.

    Examples:
        d = log 2 and 0:

        >>> penalty = divergence_penalty(torch.tensor([0.25, 0.5]).log(), torch.tensor(0.5).log())
        >>> penalty + torch.tensor([2.0, 1.0]).log()
        tensor([1., 0.])
    """
    _check_samples(log_prob=log_prob, reference_log_prob=reference_log_prob)
    distance = _representable(reference_log_prob.detach() - log_prob)
    distance = distance.clamp(max=_largest_exponent(distance))
    return distance.expm1() - distance


# -------------------------------------------------------------------------------- soft values


def path_consistency(
    rewards: Tensor,
    log_prob: Tensor,
    reference_log_prob: Tensor,
    values: Tensor,
    *,
    tau: float | Tensor,
    tau_prime: float | Tensor,
    gamma: float = 1.0,
    n_steps: int = 1,
    mask: Tensor | None = None,
) -> Tensor:
    r"""Residual of the soft values along paths of d steps: Trust-PCL (Nachum et al., ICLR 2018).

    .. math::
        C_t = -V(s_t) + \gamma^d V(s_{t+d}) + \sum_{i<d} \gamma^i \left[ r_{t+i}
            - (\tau + \tau') \log \pi(a_{t+i}|s_{t+i}) + \tau \log \bar\pi(a_{t+i}|s_{t+i}) \right]

    It is 0 on every path, of any length, if and only if V is the :func:`soft_value` of Eq. 8 and pi
    its lifted policy (of deterministic problems; of others, in expectation over the next state).

    Args:
        rewards: ``[*, T]``, of the steps of one trajectory a row, as the other tensors.
        values: ``[*, T]``, V of the state in which each step begins. Nothing is to come after the
            last real step, which ends the trajectory.
        gamma: discount, from 0 to 1.
        n_steps: d; paths that would be longer than the trajectory end with it.
        mask: ``[*, T]``, True where a step is real.

    Returns:
        ``[*, T]``, of the path that begins with each step; 0 where masked.

    Examples:
        Each step gains r + 0.75 - 1. C = 0.75 + 0.5 * 0.5 - 1, and -0.25 - 0.5:

        >>> log_prob, values = torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 0.5])
        >>> path_consistency(torch.tensor([1.0, 0.0]), log_prob, 2 * log_prob, values,
        ...                  tau=0.5, tau_prime=0.25, gamma=0.5)
        tensor([ 0.0000, -0.7500])
    """
    check_temperatures(tau=tau, tau_prime=tau_prime)
    tensors = {"rewards": rewards, "log_prob": log_prob, "reference_log_prob": reference_log_prob}
    _check_samples(-1, mask, **tensors, values=values, tau=tau, tau_prime=tau_prime)
    if not (_is_number(gamma) and 0 <= gamma <= 1):
        raise ValueError(f"gamma must be a number from 0 to 1, got {gamma!r}.")
    if not isinstance(n_steps, (int, np.integer)) or isinstance(n_steps, bool) or n_steps < 1:
        raise ValueError(f"n_steps must be an integer of at least 1, got {n_steps!r}.")
    gains = rewards - (tau + tau_prime) * log_prob + tau * reference_log_prob
    gains, values = torch.broadcast_tensors(gains, values)
    if mask is not None:
        gains, values = gains.where(mask, 0.0), values.where(mask, 0.0)
    d = min(n_steps, gains.shape[-1])
    discounts = gamma ** torch.arange(d + 1, dtype=gains.dtype, device=gains.device)
    paths = torch.nn.functional.pad(gains, (0, d - 1)).unfold(-1, d, 1)
    later = torch.nn.functional.pad(values, (0, d))[..., d:]
    residual = (paths * discounts[:-1]).sum(-1) + discounts[-1] * later - values
    return residual if mask is None else residual.where(mask, 0.0)


def soft_value(
    score: Tensor,
    reference_log_prob: Tensor,
    *,
    tau: float | Tensor,
    tau_prime: float | Tensor,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Tensor:
    r"""Soft value of the lifted policy by an exact sum over all actions: Eq. 8.

    .. math::
        \bar V^*(s) = (\tau + \tau') \log \sum_a
            \exp \frac{\bar Q^*(s, a) + \tau \log \bar\pi(a|s)}{\tau + \tau'}

    In the unit of the score: the maximum of E score - tau KL(pi, pi_bar) + tau' H(pi) over all
    distributions pi.

    Examples:
        Two equal actions, log pi_bar = -log 2: 1 + tau' log 2, their score and an entropy bonus.

        >>> reference = torch.tensor([0.5, 0.5]).log()
        >>> value = soft_value(torch.ones(2), reference, tau=0.5, tau_prime=0.25)
        >>> (value - 1) / math.log(2)
        tensor(0.2500)
    """
    check_temperatures(tau=tau, tau_prime=tau_prime)
    values = {"score": score, "reference_log_prob": reference_log_prob}
    shape = _check_samples(sample_dim, mask, **values, tau=tau, tau_prime=tau_prime)
    temperature = tau + tau_prime
    logits = _representable((score + tau * reference_log_prob) / temperature)
    log_sum = _masked_logsumexp(logits, sample_dim, mask)
    return _of_groups(temperature, _axis(sample_dim, shape)) * log_sum


def soft_value_estimate(
    score: Tensor,
    reference_log_prob: Tensor,
    *,
    tau: float | Tensor,
    tau_prime: float | Tensor,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Tensor:
    r"""Soft value of the lifted policy from M actions of the reference: the display above Eq. 9.

    .. math::
        \bar V^*(s) \approx (\tau + \tau') \log \frac1M \sum_{m=1}^M
            \exp \frac{\bar Q^*(s, a_m) - \tau' \log \bar\pi(a_m|s)}{\tau + \tau'},
        \qquad a_m \sim \bar\pi(\cdot|s)

    In the unit of the score. A lower bound in expectation (Jensen), consistent as M grows; with
    M = 1 it is the paper's one-sample estimate Q - tau' log pi_bar (Eq. 9).

    Examples:
        One sample: 1 - 0.25 * -2 = 1.5.

        >>> soft_value_estimate(torch.ones(1), torch.tensor([-2.0]), tau=0.5, tau_prime=0.25)
        tensor(1.5000)
    """
    values = {"score": score, "reference_log_prob": reference_log_prob}
    shape = _check_samples(sample_dim, mask, **values, tau=tau, tau_prime=tau_prime)
    log_weights = lifted_log_weights(score, reference_log_prob, tau=tau, tau_prime=tau_prime)
    log_mean = log_mean_exp(log_weights, sample_dim=sample_dim, mask=mask)
    return _of_groups(tau + tau_prime, _axis(sample_dim, shape)) * log_mean


def surrogate_reward(
    score: Tensor,
    log_prob: Tensor,
    *,
    tau: float | Tensor,
    tau_prime: float | Tensor,
    sample_dim: int = -1,
    mask: Tensor | None = None,
) -> Tensor:
    r"""The surrogate reward SR that ECPO ascends, by an exact sum over all trajectories: Eq. 7.

    .. math::
        \mathrm{SR}(\pi) = (\tau + \tau') \log \sum_\rho
            \exp \frac{r(\rho) + \tau \log \pi(\rho)}{\tau + \tau'}

    It is the :func:`soft_value` of the problem whose actions are whole trajectories, with pi as the
    reference: from E r + tau' H(pi) (tau to infinity) to max r (both to zero), Lemma 2. From K
    trajectories of pi it is estimated by :func:`soft_value_estimate`.

    Examples:
        >>> log_prob, score = torch.tensor([0.5, 0.5]).log(), torch.tensor([1.0, 0.0])
        >>> surrogate_reward(score, log_prob, tau=1e-3, tau_prime=0.0)  # near max r
        tensor(0.9993)
    """
    return soft_value(
        score, log_prob, tau=tau, tau_prime=tau_prime, sample_dim=sample_dim, mask=mask
    )


def theorem1_temperatures(horizon: float, num_trajectories: int) -> tuple[float, float]:
    r"""The temperatures of Theorem 1, under which ECPO's regret is below 4 sqrt(T log n).

    .. math::
        \tau' = \frac{1}{\sqrt{T \log n}}, \qquad \tau + \tau' = \sqrt{\frac{T}{2 \log n}}

    Args:
        horizon: T, the number of lifts to come, for the constant choice; t, the number of the
            lift, counted from 1, for the choice that needs no horizon.
        num_trajectories: n, how many trajectories there are; at least 2.

    Returns:
        (tau, tau_prime), for rewards in [0, 1]. Where the formula has tau < 0, for T < 1.41, it is
        0 and tau_prime the whole sum, on which alone the lift of the uniform start depends.

    Raises:
        ValueError: if ``horizon`` < 1 or ``num_trajectories`` < 2.

    Examples:
        >>> tau, tau_prime = theorem1_temperatures(100, 10)
        >>> round(tau, 4), round(tau_prime, 4)
        (4.594, 0.0659)
    """
    for name, value, least in (("horizon", horizon, 1), ("num_trajectories", num_trajectories, 2)):
        if not (_is_number(value) and least <= value < math.inf):
            raise ValueError(f"{name} must be at least {least} and finite, got {value!r}.")
    log_n = math.log(num_trajectories)
    total = math.sqrt(horizon / (2 * log_n))
    tau_prime = min(1 / math.sqrt(horizon * log_n), total)
    return total - tau_prime, tau_prime


# -------------------------------------------------------------------------------- masked algebra


def uniform_weights(like: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """``[E*, K]``, 1/K for each of the K real samples of a group, 0 for the others.

    Args:
        like: ``[E*, K]``, whose shape, dtype and device the weights get.

    Examples:
        >>> uniform_weights(torch.rand(3), mask=torch.tensor([True, True, False]))
        tensor([0.5000, 0.5000, 0.0000])
    """
    _check_samples(sample_dim, mask, like=like)
    if mask is None:
        return torch.full_like(like, 1 / like.shape[sample_dim])
    return self_normalised_weights(torch.zeros_like(like), sample_dim=sample_dim, mask=mask)


def weighted_sum(
    weights: Tensor,
    values: Tensor,
    *,
    sample_dim: int = -1,
    mask: Tensor | None = None,
    keepdim: bool = False,
) -> Tensor:
    """Sum of weights times values over the real samples, whatever stands in the masked ones.

    Weights are clipped where the sum would overflow, so that a gradient is left.

    Examples:
        >>> weights, values = torch.tensor([0.5, 0.5, 0.5]), torch.tensor([1.0, 3.0, math.nan])
        >>> weighted_sum(weights, values, mask=torch.tensor([True, True, False]))
        tensor(2.)
    """
    _check_samples(sample_dim, mask, weights=weights, values=values)
    if mask is not None:
        weights, values = weights.where(mask, 0.0), values.where(mask, 0.0)
    # The constant is clipped, not the product, so that an overflow leaves a gradient.
    largest = torch.finfo(values.dtype).max / values.shape[sample_dim]
    limit = largest / values.detach().abs().clamp_min(1.0)
    return (weights.clamp(-limit, limit) * values).sum(sample_dim, keepdim=keepdim)


def masked_mean(
    values: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None, keepdim: bool = False
) -> Tensor:
    """Mean over the real samples, whatever stands in the masked ones; 0 where all are masked.

    Examples:
        >>> masked_mean(torch.tensor([1.0, 3.0, math.nan]), mask=torch.tensor([True, True, False]))
        tensor(2.)
    """
    _check_samples(sample_dim, mask, values=values)
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    return weighted_sum(uniform_weights(values, **where), values, **where, keepdim=keepdim)


def centred(score: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Scores less the mean of their group: REINFORCE's advantage with the group as baseline.

    ``[E*, K]``, detached; 0 where masked.

    Examples:
        >>> centred(torch.tensor([1.0, 2.0, 9.0]), mask=torch.tensor([True, True, False]))
        tensor([-0.5000,  0.5000,  0.0000])
    """
    _check_samples(sample_dim, mask, score=score)
    score = _representable(score.detach())
    distance = score - masked_mean(score, sample_dim=sample_dim, mask=mask, keepdim=True)
    return distance if mask is None else distance.where(mask, 0.0)


def standardised(score: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None) -> Tensor:
    r"""Centred scores in units of their group's standard deviation: GRPO's advantage.

    .. math:: A_k = \frac{r_k - \bar r}{\sqrt{\frac1K \sum_j (r_j - \bar r)^2}}

    Returns:
        ``[E*, K]``, detached; 0 where masked, and in a group of equal scores (equal up to
        rounding: within 8 units in the last place of the largest).

    Examples:
        >>> standardised(torch.tensor([[0.0, 2.0], [5.0, 5.0]]))
        tensor([[-1.,  1.],
                [ 0.,  0.]])
    """
    where: Any = {"sample_dim": sample_dim, "mask": mask}
    return _in_deviations(_spread(score, **where), **where)


def standardised_in_batch(
    score: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None
) -> Tensor:
    r"""Centred scores in units of the standard deviation within groups, pooled over all of them.

    .. math:: A_{gk} = \frac{r_{gk} - \bar r_g}
        {\sqrt{\frac1{\sum_i K_i} \sum_i \sum_j (r_{ij} - \bar r_i)^2}}

    So a group whose scores lie closer together than those of others has smaller ones, which
    :func:`standardised` would blow up.

    Returns:
        ``[E*, K]``, detached; 0 where masked, and in groups of equal scores, as
        :func:`standardised`. These count in the deviation.

    Examples:
        The distances are 1, 1, 7 and 7, the deviation is 5:

        >>> standardised_in_batch(torch.tensor([[0.0, 2.0], [0.0, 14.0]]))
        tensor([[-0.2000,  0.2000],
                [-1.4000,  1.4000]])
    """
    distance = _spread(score, sample_dim=sample_dim, mask=mask)
    real = None if mask is None else mask.expand_as(distance).flatten()
    return _in_deviations(distance.flatten(), mask=real).view_as(distance)


def matched_temperature(
    tau_prime: float | Tensor,
    score: Tensor,
    reference_log_prob: Tensor,
    *,
    mask: Tensor | None = None,
) -> Tensor:
    r"""The tau' at which the entropy term of a lift spreads `tau_prime` times as far as the scores.

    .. math:: \tau' \frac{\sqrt{\sigma_r^2 + 1/G}}{\max(\sigma_{\log\bar\pi}, 1)}

    with deviations within the G groups, pooled over them. That of the log-probabilities grows with
    the trajectories' length, and falls with the entropy. 1/G: as if one more group had scores of
    unit deviation, so that the entropy counts where all scores are equal.

    Args:
        score: ``[E*, K]``, of unit deviation within their group or in the batch.

    Returns:
        0-d, or as tau_prime is.

    Examples:
        Scores of deviation 1, surprise of deviation 2, a single group:

        >>> score, log_prob = torch.tensor([[-1.0, 1.0]]), torch.tensor([[-5.0, -1.0]])
        >>> matched_temperature(0.2, score, log_prob) * 2 / math.sqrt(2)
        tensor(0.2000)
    """
    check_temperatures(tau_prime=tau_prime, allow_zero=True)
    given = {"score": score, "reference_log_prob": reference_log_prob, "tau_prime": tau_prime}
    num_groups = _check_samples(-1, mask, **given)[:-1].numel()
    of_score, of_log_prob = (_pooled_variance(x, mask) for x in (score, reference_log_prob))
    return tau_prime * ((of_score + 1 / num_groups) / of_log_prob.clamp_min(1)).sqrt()


def leave_one_out(score: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None) -> Tensor:
    r"""Scores less the mean of the *others* of their group: RLOO's advantage.

    .. math:: A_k = r_k - \frac1{K-1} \sum_{j \ne k} r_j = \frac{K}{K-1} (r_k - \bar r)

    Returns:
        ``[E*, K]``, detached; 0 where masked, and for a sample without others.

    Examples:
        >>> leave_one_out(torch.tensor([1.0, 2.0, 9.0]), mask=torch.tensor([True, True, False]))
        tensor([-1.,  1.,  0.])
    """
    distance = centred(score, sample_dim=sample_dim, mask=mask)
    real = torch.ones_like(distance) if mask is None else mask.expand_as(distance)
    size = real.sum(sample_dim, keepdim=True, dtype=distance.dtype)
    return distance * size / (size - 1).clamp_min(1)


def score_function_loss(
    log_prob: Tensor, advantage: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None
) -> Tensor:
    r"""The loss whose gradient is the score-function estimator's (REINFORCE).

    .. math:: L(\theta) = -\frac1K \sum_k A_k \log \pi_\theta(\rho_k)

    Args:
        advantage: ``[E*, K]``, held constant: scores that are :func:`centred`,
            :func:`leave_one_out` or :func:`standardised`.

    Examples:
        >>> log_prob = torch.tensor([-1.0, -2.0], requires_grad=True)
        >>> score_function_loss(log_prob, torch.tensor([0.5, -0.5])).backward(); log_prob.grad
        tensor([-0.2500,  0.2500])
    """
    _check_samples(sample_dim, mask, log_prob=log_prob, advantage=advantage)
    uniform = uniform_weights(log_prob, sample_dim=sample_dim, mask=mask)
    return -weighted_sum(uniform * advantage.detach(), log_prob, sample_dim=sample_dim, mask=mask)


def log_mean_exp(values: Tensor, *, sample_dim: int = -1, mask: Tensor | None = None) -> Tensor:
    """Logarithm of the mean of exp(values) over the real samples.

    Args:
        values: ``[E*, K]``.

    Returns:
        ``[E*]``.

    Examples:
        log((1 + 3) / 2) = log 2:

        >>> round(log_mean_exp(torch.tensor([1.0, 3.0]).log()).exp().item(), 4)
        2.0
    """
    _check_samples(sample_dim, mask, values=values)
    return _masked_logsumexp(values + _log_uniform(values, sample_dim, mask), sample_dim, mask)


def _pooled_variance(values: Tensor, mask: Tensor | None) -> Tensor:
    """Mean square distance from the own group's mean, 0-d."""
    distance = centred(values, mask=mask)
    real = None if mask is None else mask.expand_as(distance).flatten()
    return masked_mean(distance.square().flatten(), mask=real)


def _spread(score: Tensor, *, sample_dim: int, mask: Tensor | None) -> Tensor:
    """Centred scores; 0 in a group whose scores are equal up to rounding."""
    distance = centred(score, sample_dim=sample_dim, mask=mask)
    real = torch.ones_like(distance, dtype=torch.bool) if mask is None else mask
    highest = score.detach().where(real, -math.inf).amax(sample_dim, keepdim=True)
    lowest = score.detach().where(real, math.inf).amin(sample_dim, keepdim=True)
    rounding = 8 * torch.finfo(distance.dtype).eps * torch.maximum(highest.abs(), lowest.abs())
    return distance.where(~(highest - lowest <= rounding), 0.0)  # NaN stays NaN


def _in_deviations(distance: Tensor, *, sample_dim: int = -1, mask: Tensor | None) -> Tensor:
    """Distances in units of the root of their mean square; 0 where all are 0."""
    # Scaled by the largest distance, so that no square under- or overflows.
    largest = distance.abs().amax(sample_dim, keepdim=True)
    unit = distance / largest.where(largest != 0, 1.0)
    variance = masked_mean(unit.square(), sample_dim=sample_dim, mask=mask, keepdim=True)
    return unit / variance.where(largest != 0, 1.0).sqrt()


def _log_uniform(like: Tensor, dim: int, mask: Tensor | None) -> Tensor | float:
    """Logarithm of :func:`uniform_weights`; that of 0 is very low."""
    if mask is None:
        return -math.log(like.shape[dim])
    return uniform_weights(like, sample_dim=dim, mask=mask).clamp_min(_tiny(like)).log()


def _masked_logsumexp(values: Tensor, dim: int, mask: Tensor | None) -> Tensor:
    return (values if mask is None else values.where(mask, _lowest(values))).logsumexp(dim)


def _representable(values: Tensor) -> Tensor:
    """Clip overflow: a softmax of the result is a maximum, and differences stay finite."""
    values = values if values.is_floating_point() else values.to(torch.get_default_dtype())
    largest = torch.finfo(values.dtype).max / 4
    return values.clamp(-largest, largest)


def _largest_exponent(like: Tensor) -> float:
    return math.log(torch.finfo(like.dtype).max) - 1


def _lowest(like: Tensor) -> float:
    return torch.finfo(like.dtype).min


def _tiny(like: Tensor) -> float:
    return torch.finfo(like.dtype).tiny
