"""Feed-forward actors and critics, for continuous actions and for one discrete one.

All networks are multi-layer perceptrons with ReLU; by default two layers of 256 units, the usual
size for SAC and TD3 on the MuJoCo tasks. They read ``observation``, a vector, or pixels through a
:class:`~torchrl_ecpo.modules.PixelEncoder` of their own; an actor writes ``action`` within the
bounds of its specification.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
    dispatch,
    set_skip_existing,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torch.nn.functional import layer_norm as normalise
from torch.nn.functional import linear
from torchrl.data import Bounded, TensorSpec
from torchrl.data import Categorical as CategoricalSpec
from torchrl.modules import ProbabilisticActor, TanhModule, TanhNormal

from torchrl_ecpo._torch import is_transformed
from torchrl_ecpo.checks import (
    as_float,
    check_count,
    check_counts,
    check_flag,
    check_keys,
    check_kind,
    names_entries,
)
from torchrl_ecpo.modules.pixels import PixelEncoder

HIDDEN_SIZES = (256, 256)
LOG_SCALE_BOUNDS = (-5.0, 2.0)
"""Of the Gaussian before tanh: 2 is SAC's, its -20 is never reached; e^-5 acts like no scale."""
NARROW = 32
"""So many numbers are multiplied as fast for each sample as once."""


class DenseNetwork(TensorDictModuleBase):
    """A multi-layer perceptron with ReLU, from entries of a TensorDict to entries of it.

    It computes what ``TensorDictModule(MLP(...))`` does, and :meth:`each` with several sets of
    parameters at once.

    Args:
        in_keys: entries to read, ``[..., n]`` each; they are concatenated.
        out_keys: entries to write.
        sizes: units of each layer, that of the inputs first.
        head: from the output of the last layer to the tuple of entries; by default it is the one
            entry.

    Keyword Args:
        final_gain: factor of the last layer's parameters at the start. Default: 1.
        layer_norm: whether what goes into each ReLU is normalised over its units, to mean 0 and
            variance 1, as ``torch.nn.LayerNorm`` does without parameters. Default: False.

    Raises:
        TypeError: if keys are no lists of names, or ``head`` is no function.
        ValueError: if a size is no integer of at least 1, if ``final_gain`` is negative or not
            finite, and for entries that it cannot read.

    Examples:
        >>> import torch
        >>> network = DenseNetwork(["observation"], ["state_value"], [3, 8, 1])
        >>> network(observation=torch.zeros(5, 3)).shape
        torch.Size([5, 1])
    """

    def __init__(
        self,
        in_keys: Sequence[Any],
        out_keys: Sequence[Any],
        sizes: Sequence[int],
        head: Callable[[Tensor], tuple[Tensor, ...]] | None = None,
        *,
        final_gain: float = 1.0,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = (
            check_keys("in_keys", in_keys),
            check_keys("out_keys", out_keys),
        )
        self.sizes = check_counts("sizes", sizes)
        if len(self.sizes) < 2:
            raise ValueError(f"sizes must be of the inputs and of each layer, got {self.sizes}.")
        if head is not None:
            check_kind("head", head, Callable)
        self.head = head
        self.final_gain = as_float("final_gain", final_gain, "[0, inf)")
        self.layer_norm = check_flag("layer_norm", layer_norm)
        self._names = [name for i in range(len(sizes) - 1) for name in (f"weight_{i}", f"bias_{i}")]
        for weight, bias, fan_in, fan_out in self._layers():
            self.register_parameter(weight, nn.Parameter(torch.empty(fan_out, fan_in)))
            self.register_parameter(bias, nn.Parameter(torch.empty(fan_out)))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw all parameters as ``torch.nn.Linear`` does: uniform up to 1/sqrt(fan-in).

        Those of the last layer: times ``final_gain``.
        """
        for weight, bias, fan_in, _ in self._layers():
            for name in (weight, bias):
                nn.init.uniform_(getattr(self, name), -(fan_in**-0.5), fan_in**-0.5)
        with torch.no_grad():
            for name in self._names[-2:]:
                getattr(self, name).mul_(self.final_gain)

    def reset_parameters_recursive(
        self, parameters: TensorDictBase | None = None
    ) -> TensorDictBase | None:
        """Draw all parameters, or in place those that are given; see ``TensorDictModule``.

        tensordict's own draws those of submodules alone, of which there are none.
        """
        if parameters is None:
            return self.reset_parameters()
        drawn: Any = super().reset_parameters_recursive(parameters)  # refuses what is batched
        with drawn.to_module(self, preserve_module_state=False):
            self.reset_parameters()
        return drawn

    @dispatch(auto_batch_size=False)
    @set_skip_existing(None)
    @names_entries
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the outputs into ``tensordict``."""
        parameters = [getattr(self, name) for name in self._names]
        inputs = torch.cat([tensordict.get(key) for key in self.in_keys], -1)
        return self._write(_compute([inputs], parameters, self.layer_norm), tensordict)

    @names_entries
    def each(self, tensordict: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
        """The outputs with each of N sets of parameters, on the same inputs.

        It stands for ``torch.vmap`` over the parameters in a loss that has several Q networks, and
        is faster on a CPU: parameters are not swapped in and out of the module, and nothing but the
        outputs is stacked. Where entries of more than 32 numbers are repeated along the first
        dimension by ``expand``, as states are that have several actions each, the first layer
        multiplies them once. An update of ECAC takes 6 % less than with a loop over the networks
        where observations have 17 numbers, 33 % less where they have 348.

        Args:
            tensordict: with the entries to read; left as it is.
            params: parameters by their names, stacked along the first dimension.

        Returns:
            A TensorDict of the outputs only, ``[N, ..., n]``.

        Examples:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> network = DenseNetwork(["observation"], ["state_value"], [3, 8, 1])
            >>> twice = TensorDict.from_module(network).expand(2)
            >>> network.each(TensorDict(observation=torch.zeros(5, 3)), twice)["state_value"].shape
            torch.Size([2, 5, 1])
        """
        inputs = [tensordict.get(key) for key in self.in_keys]
        repeated = [_is_repeated(x) for x in inputs]
        is_uniform = len({(x.shape[:-1], x.dtype) for x in inputs}) == 1
        if is_uniform and any(repeated) and not all(repeated):
            inputs = [x[:1] if once else x for x, once in zip(inputs, repeated, strict=True)]
        else:
            inputs = [torch.cat(inputs, -1)]
        sets = zip(*(params.get(name).unbind(0) for name in self._names), strict=True)
        outputs = [_compute(inputs, parameters, self.layer_norm) for parameters in sets]
        return self._write(torch.stack(outputs), TensorDict())

    def _layers(self) -> Iterator[tuple[str, str, int, int]]:
        """Names of weight and bias of each layer, and its numbers of inputs and outputs."""
        return zip(self._names[::2], self._names[1::2], self.sizes, self.sizes[1:], strict=False)

    def _write(self, output: Tensor, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = (output,) if self.head is None else self.head(output)
        if len(outputs) != len(self.out_keys):
            raise ValueError(f"The head gives {len(outputs)} outputs for out_keys={self.out_keys}.")
        for key, value in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, value)
        return tensordict


def _compute(inputs: Sequence[Tensor], parameters: Sequence[Tensor], is_normal: bool) -> Tensor:
    """Of inputs side by side; the first layer multiplies once what is ``[1, ...]``."""
    (weight, bias), *others = zip(parameters[::2], parameters[1::2], strict=True)
    if len(inputs) == 1:
        x = linear(inputs[0], weight, bias)
    else:
        blocks = weight.split([x.shape[-1] for x in inputs], -1)
        products = [linear(x, block) for x, block in zip(inputs, blocks, strict=True)]
        shared = sum((x for x in products if len(x) == 1), bias)
        own = [x for x in products if len(x) > 1]
        x = sum(own[1:], own[0]).add_(shared)
    for weight, bias in others:
        if is_normal:
            x = normalise(x, x.shape[-1:])
        x = linear(x.relu_(), weight, bias)  # what goes into ReLU is read by nobody else
    return x


def _is_repeated(x: Tensor) -> bool:
    """Whether ``expand`` has made it, the same all along its first dimension, and it is worth it.

    If it has a gradient, that is one of each copy.
    """
    is_expanded = x.dim() > 2 and x.shape[0] > 1 and x.stride(0) == 0
    is_worth_it = is_expanded and x.shape[-1] > NARROW
    return is_worth_it and not x.requires_grad and not is_transformed()


def _loc_and_scale(output: Tensor) -> tuple[Tensor, Tensor]:
    """Split a network's output ``[..., 2 * A]`` into the location and the scale of a Gaussian.

    An untrained network, whose outputs are near 0, gives a scale of about 1.
    """
    loc, log_scale = output.chunk(2, -1)
    return loc, log_scale.clamp(*LOG_SCALE_BOUNDS).exp()


def make_tanh_gaussian_actor(
    observation_size: int | Sequence[int],
    action_spec: TensorSpec,
    *,
    hidden_sizes: Sequence[int] = HIDDEN_SIZES,
    final_gain: float = 1.0,
) -> ProbabilisticTensorDictSequential:
    """A stochastic policy: a Gaussian, squashed by tanh into the bounds of the actions.

    Args:
        observation_size: length of an observation vector, or ``(C, H, W)`` of pixels.
        action_spec: of one environment, bounded, ``[A]``.
        hidden_sizes: units of each hidden layer. Default: (256, 256).
        final_gain: factor of the last layer's parameters at the start. Default: 1. With 0.01 the
            policy starts in the middle of the actions' range with a scale of 1, whatever it
            observes; where observations are large, as the forces in ``Humanoid-v5`` are, it would
            start at the ends of the range. The value is that of "What Matters In On-Policy
            Reinforcement Learning?", Andrychowicz et al., 2021.

    Raises:
        ValueError: if the actions are not vectors of numbers within finite bounds, or if
            ``final_gain`` is negative or not finite.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> actor = make_tanh_gaussian_actor(3, Bounded(-2.0, 2.0, shape=(1,)))
        >>> state = actor(TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5]))
        >>> state["action"].shape, bool((state["action"].abs() <= 2).all())
        (torch.Size([5, 1]), True)
    """
    spec = _bounded(action_spec)
    network = _network(
        observation_size,
        ["loc", "scale"],
        hidden_sizes,
        2 * spec.shape[-1],
        head=_loc_and_scale,
        final_gain=final_gain,
    )
    return ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
    )


def make_deterministic_actor(
    observation_size: int | Sequence[int],
    action_spec: TensorSpec,
    *,
    hidden_sizes: Sequence[int] = HIDDEN_SIZES,
) -> TensorDictSequential:
    """A deterministic policy, for TD3 and DDPG: tanh, scaled to the bounds of the actions.

    Args:
        observation_size: length of an observation vector, or ``(C, H, W)`` of pixels.
        action_spec: of one environment, bounded, ``[A]``.
        hidden_sizes: units of each hidden layer. Default: (256, 256).

    Raises:
        ValueError: if the actions are not vectors of numbers within finite bounds.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> actor = make_deterministic_actor(3, Bounded(-2.0, 2.0, shape=(1,)))
        >>> actor(TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5]))["action"].shape
        torch.Size([5, 1])
    """
    spec = _bounded(action_spec)
    network = _network(observation_size, ["pre_tanh"], hidden_sizes, spec.shape[-1])
    squash: Any = TanhModule(in_keys=["pre_tanh"], out_keys=["action"], spec=spec)
    return TensorDictSequential(network, squash)


def make_qvalue_network(
    observation_size: int | Sequence[int],
    action_size: int,
    *,
    hidden_sizes: Sequence[int] = HIDDEN_SIZES,
    layer_norm: bool = False,
    num_outputs: int = 1,
) -> TensorDictModuleBase:
    """Q(s, a): reads ``observation`` and ``action``, writes ``state_action_value`` ``[..., n]``.

    Args:
        observation_size: length of an observation vector, or ``(C, H, W)`` of pixels.
        action_size: length A of an action vector.
        hidden_sizes: units of each hidden layer. Default: (256, 256).
        layer_norm: as of :class:`DenseNetwork`. Default: False.
        num_outputs: n, the value (1, the default) or that many quantiles of the return, which
            TorchRL's ``TQCLoss`` reads.

    Examples:
        >>> import torch
        >>> qvalue = make_qvalue_network(3, 2)
        >>> qvalue(observation=torch.zeros(5, 3), action=torch.zeros(5, 2)).shape
        torch.Size([5, 1])
    """
    size = check_count("action_size", action_size)
    options = {"action_size": size, "layer_norm": layer_norm}
    outputs = check_count("num_outputs", num_outputs)
    return _network(observation_size, ["state_action_value"], hidden_sizes, outputs, **options)


def make_value_network(
    observation_size: int | Sequence[int],
    *,
    hidden_sizes: Sequence[int] = HIDDEN_SIZES,
    layer_norm: bool = False,
) -> TensorDictModuleBase:
    """V(s): reads ``observation``, writes ``state_value`` ``[..., 1]``.

    Args:
        observation_size: length of an observation vector, or ``(C, H, W)`` of pixels.
        hidden_sizes: units of each hidden layer. Default: (256, 256).
        layer_norm: as of :class:`DenseNetwork`. Default: False.

    Examples:
        >>> import torch
        >>> make_value_network(3)(observation=torch.zeros(5, 3)).shape
        torch.Size([5, 1])
    """
    return _network(observation_size, ["state_value"], hidden_sizes, 1, layer_norm=layer_norm)


def make_categorical_actor(
    observation_size: int | Sequence[int],
    action_spec: TensorSpec,
    *,
    hidden_sizes: Sequence[int] = HIDDEN_SIZES,
) -> ProbabilisticTensorDictSequential:
    """A policy over one of n actions, for the discrete losses.

    Args:
        observation_size: length of an observation vector, or ``(C, H, W)`` of pixels.
        action_spec: of one environment: ``Categorical``, an integer.
        hidden_sizes: units of each hidden layer. Default: (256, 256).

    Raises:
        ValueError: if an action is not one integer.

    Examples:
        >>> import torch
        >>> from torchrl.data import Categorical
        >>> actor = make_categorical_actor(3, Categorical(4))
        >>> actor(TensorDict({"observation": torch.zeros(5, 3)}, batch_size=[5]))["action"].shape
        torch.Size([5])
    """
    spec = action_spec
    if not isinstance(spec, CategoricalSpec) or spec.ndim:
        raise ValueError(
            "action_spec must be of one discrete action (torchrl's Categorical, of shape ()), got "
            f"{type(spec).__name__} of shape {tuple(getattr(spec, 'shape', ()))}. Several actions "
            "belong to the losses of groups, such as ECPOLoss."
        )
    return ProbabilisticActor(
        _network(observation_size, ["logits"], hidden_sizes, spec.n),
        in_keys=["logits"],
        spec=spec,
        distribution_class=Categorical,
    )


def make_action_value_network(
    observation_size: int | Sequence[int],
    num_actions: int,
    *,
    hidden_sizes: Sequence[int] = HIDDEN_SIZES,
    layer_norm: bool = False,
) -> TensorDictModuleBase:
    """Q(s, .): reads ``observation``, writes ``action_value`` ``[..., n]``, of each of n actions.

    Args:
        observation_size: length of an observation vector, or ``(C, H, W)`` of pixels.
        num_actions: n.
        hidden_sizes: units of each hidden layer. Default: (256, 256).
        layer_norm: as of :class:`DenseNetwork`. Default: False.

    Examples:
        >>> import torch
        >>> make_action_value_network(3, 4)(observation=torch.zeros(5, 3)).shape
        torch.Size([5, 4])
    """
    size = check_count("num_actions", num_actions)
    return _network(observation_size, ["action_value"], hidden_sizes, size, layer_norm=layer_norm)


def _network(
    observation_size: int | Sequence[int],
    out_keys: Sequence[str],
    hidden_sizes: Sequence[int],
    num_outputs: int,
    *,
    action_size: int = 0,
    **options: Any,
) -> Any:
    """A multi-layer perceptron; of pixels, behind convolutions."""
    hidden = check_counts("hidden_sizes", hidden_sizes)
    action = ["action"] if action_size else []
    if not isinstance(observation_size, Sequence) or isinstance(observation_size, str):
        sizes = [check_count("observation_size", observation_size) + action_size, *hidden]
        sizes.append(num_outputs)
        return DenseNetwork(["observation", *action], out_keys, sizes, **options)
    if len(observation_size) != 3:
        raise ValueError(
            "observation_size must be an integer of at least 1, or (channels, height, width) of "
            f"pixels, got {observation_size!r}."
        )
    encoder = PixelEncoder(observation_size)
    sizes = [encoder.size + action_size, *hidden, num_outputs]
    parts: list[Any] = [
        TensorDictModule(encoder, ["observation"], ["features"]),
        DenseNetwork(["features", *action], out_keys, sizes, **options),
    ]
    return TensorDictSequential(*parts, selected_out_keys=list(out_keys))


def _bounded(action_spec: TensorSpec) -> Any:
    """The specification, if it is one of vectors of bounded numbers."""
    if not isinstance(action_spec, Bounded) or not action_spec.dtype.is_floating_point:
        raise ValueError(
            "action_spec must be of bounded continuous actions (torchrl's Bounded), got "
            f"{type(action_spec).__name__}. Discrete actions belong to DiscreteECACLoss, "
            "several or hybrid ones to the losses of groups, such as ECPOLoss."
        )
    if len(action_spec.shape) != 1 or not action_spec.shape[0]:
        raise ValueError(
            f"action_spec must be of one vector, got the shape {tuple(action_spec.shape)}: take "
            "`env.action_spec_unbatched`."
        )
    space: Any = action_spec.space
    low, high = space.low, space.high
    if not (
        (high > low) & (high - low < math.inf)
    ).all():  # wider than the largest number is infinite
        raise ValueError(
            "action_spec must have finite bounds, the upper one above, at a finite distance, got "
            f"{low.tolist()} to {high.tolist()}. Bound the actions in the environment."
        )
    return action_spec
