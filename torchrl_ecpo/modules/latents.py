"""Squashed actions: what was drawn before the squashing, which rounding makes them forget.

An action near the end of its range stands for many latents, so that its log-probability cannot be
told from it. Here ``*B`` is the batch shape of a distribution.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import CompositeDistribution, ProbabilisticTensorDictModule
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, TransformedDistribution
from torch.distributions.transforms import ComposeTransform, TanhTransform

from torchrl_ecpo.checks import check_kind

LOST = 1e-4
"""An error of the latent, by the rounding of the action, that counts."""


def record_latents(policy: nn.Module) -> None:
    """Let a policy write, beside each squashed action, the latent that was drawn.

    It goes to the key of the action with ``_latent`` at its end, ``"action_latent"``. The recorded
    log-probability is then that of the latent, and the group losses evaluate the policy there, so
    that they are exact however near an action is to the end of its range. Other actions, and the
    random numbers, stay as they are. :class:`~torchrl_ecpo.collectors.TrajectoryGroupCollector`
    calls it for its policy; a sampling loop of your own calls it once.

    Args:
        policy: whose ``ProbabilisticTensorDictModule`` draw the actions; changed in place.

    Raises:
        TypeError: if it is no module.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_ecpo.modules import make_tanh_gaussian_actor
        >>> actor = make_tanh_gaussian_actor(3, Bounded(-2.0, 2.0, shape=(1,)))
        >>> record_latents(actor)
        >>> step = actor(TensorDict(observation=torch.zeros(5, 3), batch_size=[5]))
        >>> torch.equal(2 * step["action_latent"].tanh(), step["action"])
        True
    """
    check_kind("policy", policy, nn.Module)
    for module in policy.modules():
        is_head = isinstance(module, ProbabilisticTensorDictModule)
        if is_head and may_squash(module) and not isinstance(module.distribution_class, _Drawn):
            module.distribution_class = _Drawn(module.distribution_class)  # pyright: ignore
            # Before the hook that projects actions into their specification.
            module.register_forward_hook(_write_latents, prepend=True)


class _Drawn:
    """Makes distributions whose last one knows the latents of what it has drawn."""

    last: Any = None

    def __init__(self, make: Callable[..., Distribution]) -> None:
        self.make = make

    def __call__(self, *args: Any, **kwargs: Any) -> Distribution:
        self.last = self.make(*args, **kwargs)
        for _, part in parts_of(self.last, [""]):
            level: Any = part
            while hasattr(level, "base_dist"):
                if isinstance(level, TransformedDistribution):
                    level.transforms = [transform.with_cache() for transform in level.transforms]
                level = level.base_dist
        return self.last

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.make,)


def _write_latents(module: Any, args: Any, output: Any) -> None:
    drawn, module.distribution_class.last = module.distribution_class.last, None
    if not isinstance(output, TensorDictBase):
        return
    for key, part in parts_of(drawn, module.dist_sample_keys):
        _, transforms = split(part)
        latent = output.get(key)
        for transform in reversed(transforms):
            latent = transform.inv(latent)  # what it has come from, not computed
        if transforms:
            output.set(latent_key(key), latent.detach())


def latent_key(key: NestedKey) -> NestedKey:
    """Where the latent of an action is recorded."""
    return f"{key}_latent" if isinstance(key, str) else (*key[:-1], f"{key[-1]}_latent")


def may_squash(module: Any) -> bool:
    """Whether the distributions of a probabilistic module may be transformed ones."""
    kind, kinds = module.distribution_class, [module.distribution_class]
    if isinstance(kind, type) and issubclass(kind, CompositeDistribution):
        kinds = list(module.distribution_kwargs["distribution_map"].values())
    squashing = (TransformedDistribution, Independent)
    return any(not isinstance(kind, type) or issubclass(kind, squashing) for kind in kinds)


def parts_of(
    distribution: Distribution, keys: list[NestedKey]
) -> list[tuple[NestedKey, Distribution]]:
    """Each part of an action, and its distribution."""
    if isinstance(distribution, CompositeDistribution):
        return list(distribution.dists.items())
    return [(keys[0], distribution)]


def split(distribution: Any) -> tuple[Distribution, list[Any]]:
    """The distribution of the latent, and the transforms that make it an action."""
    if not isinstance(distribution, (TransformedDistribution, Independent)):
        return distribution, []
    base, transforms = split(distribution.base_dist)
    if isinstance(distribution, TransformedDistribution):
        return base, transforms + distribution.transforms
    if not transforms:
        return distribution, []
    return Independent(base, distribution.reinterpreted_batch_ndims), transforms


def invert(distribution: Distribution, action: Tensor) -> Tensor:
    """A latent of an action: one of many if it is rounded to the end of its range, NaN outside."""
    for transform in reversed(list(_each(split(distribution)[1]))):
        is_tanh = isinstance(transform, TanhTransform)
        if is_tanh:
            eps = torch.finfo(action.dtype).eps
            inside = action.clamp(-1 + eps, 1 - eps)
            action = inside.where(action.abs() <= 1 + 8 * eps, torch.nan)
        action = transform.inv(action)
    return action


def latent_of(distribution: Distribution, action: Tensor, recorded: Tensor | None) -> Tensor:
    """The latent of an action: the recorded one where it makes that action, or else by inversion.

    Noise that is added behind the policy makes another one.
    """
    latent = invert(distribution, action)
    if recorded is None:
        return latent
    made = recorded
    for transform in split(distribution)[1]:
        made = transform(made)
    if made.shape != action.shape:
        return recorded
    eps = max(torch.finfo(x.dtype).eps for x in (action, recorded))
    num_batch_dims = action.ndim - len(distribution.event_shape)
    scale = action.abs().amax(tuple(range(num_batch_dims)))  # of each number of the action
    is_same = (made - action).abs() <= 64 * eps * scale
    if recorded.shape != action.shape:  # as on a simplex, which has a number more
        is_same = is_same.all(-1, keepdim=True)
    return recorded.where(is_same, latent.to(recorded.dtype))


def _each(transforms: list[Any]) -> Iterator[Any]:
    """Every single one."""
    for transform in transforms:
        if isinstance(transform, ComposeTransform):
            yield from _each(transform.parts)
        else:
            yield transform


def log_prob_of_latent(distribution: Distribution, latent: Tensor) -> Tensor:
    """Log-probability ``[*B]`` of the action that comes of a latent."""
    # In the order in which torch adds up, so that half precision gives what was recorded.
    if isinstance(distribution, Independent):
        of_each = log_prob_of_latent(distribution.base_dist, latent)
        return _sum_last(of_each, distribution.reinterpreted_batch_ndims)
    base, transforms = split(distribution)
    terms: list[Any] = [base.log_prob(latent)]
    for transform in transforms:
        before, latent = latent, transform(latent)
        ndim = len(distribution.event_shape) - transform.domain.event_dim
        terms.append(-_sum_last(transform.log_abs_det_jacobian(before, latent), ndim))
    total: Any = sum(reversed(terms))
    return total


def _sum_last(values: Tensor, ndim: int) -> Tensor:
    return values.flatten(-ndim).sum(-1) if ndim else values


def is_lost(distribution: Distribution, action: Tensor, parameters: Iterable[Tensor]) -> Tensor:
    """Whether ``[*B]`` rounding, in the coarsest of these types, leaves a latent open by LOST."""
    eps = max(torch.finfo(x.dtype).eps for x in (action, *parameters) if x.is_floating_point())
    latent, shape = invert(distribution, action), (*distribution.batch_shape, -1)
    log_slope, error = torch.zeros_like(latent).reshape(shape), 0.0
    for transform in _each(split(distribution)[1]):
        before, latent = latent, transform(latent)
        log_slope = log_slope + transform.log_abs_det_jacobian(before, latent).reshape(shape)
        size, slope = latent.abs().reshape(shape), log_slope.exp()
        if size.shape != slope.shape:  # as on a simplex: by its largest and least
            size, slope = size.amax(-1, keepdim=True), slope.amin(-1, keepdim=True)
        error = error + eps * size / slope
    return torch.as_tensor(error > LOST).any(-1)
