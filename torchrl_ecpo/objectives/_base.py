"""What both families of losses share: actor, temperatures, keys, checks and reduction."""

from __future__ import annotations

import inspect
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import wraps
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.objectives import LossModule
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS

from torchrl_ecpo.checks import (
    as_float,
    check_choice,
    check_flag,
    check_mask,
    present,
    values_can_be_seen,
)
from torchrl_ecpo.functional import check_temperatures, temperature_dual, widened

REDUCTIONS = ("none", "mean", "sum")


class PolicyLoss(LossModule):
    """A loss of a policy, with temperatures that are scheduled by assignment.

    A temperature is a 0-d buffer, so that ``state_dict`` carries it and ``to`` moves it.
    ``loss.tau = 0.1`` writes it in place; a value that is not allowed is refused, and the old one
    stays. One that the loss learns (:meth:`learn`) is the parameter ``log_tau``. It has a floor,
    below which :meth:`temperature` never reads, and cannot be set.

    The arguments are documented where users meet them.
    """

    tensor_keys: Any
    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    temperature_names: tuple[str, ...]
    """What :class:`~torchrl_ecpo.TemperatureScheduler` may write."""
    _learned: Mapping[str, tuple[float, str]] = MappingProxyType({})
    """By name: the floor, and what to leave out to set it."""
    losses: ClassVar[tuple[str, ...]] = ()
    """Names of the further losses that a member returns; each begins with ``loss_``."""
    metrics: ClassVar[tuple[str, ...]] = ()
    """Names of the further metrics that it returns."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        signature = _whole_signature(cls.__init__, super(cls, cls).__init__)
        cls.__init__ = _names_its_class(cls.__init__)
        vars(cls.__init__)["__signature__"] = signature  # what help() shows

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        delay_actor: bool,
        reduction: Literal["none", "mean", "sum"] | None,
        temperatures: Mapping[str, Any] | None = None,
        allow_zero: bool = False,
    ) -> None:
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[Any] | None = None
        super().__init__()
        if not hasattr(actor_network, "get_dist"):
            wrapped = (
                " Wrap a language model: TransformersWrapper(model, generate=False, tokenizer=..., "
                "input_mode='tokens', pad_output=True)."
            )
            raise TypeError(
                "actor_network must have a get_dist method, as ProbabilisticActor and "
                f"ProbabilisticTensorDictSequential have; got {type(actor_network).__name__}."
                f"{wrapped * hasattr(actor_network, 'generate')}"
            )
        self.reduction = "mean" if reduction is None else reduction
        check_choice("reduction", self.reduction, REDUCTIONS)
        self.delay_actor = check_flag("delay_actor", delay_actor)
        self._take(actor_network)
        self._allow_zero = allow_zero
        for name, value in self._as_temperatures(temperatures or {}).items():
            self.register_coeff_buffer(name, value, device=self._device)
        self.temperature_names = tuple(temperatures or ())
        self.register_load_state_dict_pre_hook(_check_loaded)

    def _take(self, actor_network: Any) -> None:
        """Hold the actor, and its delayed copy."""
        self.convert_to_functional(
            actor_network, "actor_network", create_target_params=self.delay_actor
        )

    @property
    def _device(self) -> torch.device | None:
        return next((parameter.device for parameter in self.parameters()), None)

    # ------------------------------------------------------------------------------- temperatures

    def _as_temperatures(
        self, values: Mapping[str, Any], *, allow_zero: bool = False
    ) -> dict[str, float]:
        """Numbers, by name, that are allowed together."""
        temperatures = {name: _as_temperature(name, value) for name, value in values.items()}
        check_temperatures(allow_zero=allow_zero or self._allow_zero, **temperatures)
        return temperatures

    def __setattr__(self, name: str, value: Any) -> None:
        """Write a temperature in place; refuse what is learned, and what is not allowed."""
        self._refuse_learned(name)
        names = self.__dict__.get("temperature_names", ())
        buffers = dict(self.named_buffers(recurse=False)) if name in names else {}
        if name not in buffers:
            super().__setattr__(name, value)
            return
        buffers[name].fill_(self.allowed_temperatures(**{name: _as_temperature(name, value)})[name])

    def _refuse_learned(self, name: str) -> None:
        if name in self._learned:
            instead = self._learned[name][1]
            mend = f" Build the loss without {instead} to set or schedule it." if instead else ""
            raise AttributeError(f"{name} is learned.{mend}")

    def allowed_temperatures(self, **values: Any) -> dict[str, float]:
        """Numbers, by name; refuse those that are not allowed beside the other temperatures.

        None is a value that is not known, but positive.
        """
        for name in values:
            self._refuse_learned(name)
        buffers = dict(self.named_buffers(recurse=False))
        current = {name: buffers[name] for name in self.temperature_names if name in buffers}
        known = {name: value for name, value in {**current, **values}.items() if value is not None}
        # A temperature that is no buffer is learned, and positive.
        return self._as_temperatures(known, allow_zero=len(known) < len(self.temperature_names))

    def learn(self, name: str, start: float, *, floor: float = 1e-6, instead: str = "") -> None:
        """Learn a temperature, or the multiplier of a constraint, in log-space.

        It is the parameter ``log_{name}``. Its loss is the caller's, such as :meth:`dual`.

        Args:
            name: of the temperature. What has been a scheduled one is no longer.
            start: first value.
            floor: least value, in the unit of the temperature.
            instead: what to leave out so that it is not learned, for the message of who sets it.

        Raises:
            ValueError: unless 0 < floor <= start < inf.
        """
        first = as_float(name, start)
        if not 0 < floor <= first < math.inf:
            raise ValueError(
                f"A learned {name} must start at min_{name} > 0 or above, got {name}={start} and "
                f"min_{name}={floor}."
            )
        if name in dict(self.named_buffers(recurse=False)):
            delattr(self, name)
        log_value = nn.Parameter(torch.tensor(math.log(first), device=self._device))
        self.register_parameter(f"log_{name}", log_value)
        self._learned = {**self._learned, name: (floor, instead)}

    def temperature(self, name: str) -> Tensor:
        """A temperature as it stands, 0-d and detached, scheduled or learned.

        It stays as it is when another value is set.
        """
        if name not in self._learned:
            return getattr(self, name).clone()
        log_temperature: Tensor = getattr(self, f"log_{name}")
        return log_temperature.detach().exp().clamp_min(self._learned[name][0])

    def temperatures(self) -> tuple[Tensor, ...]:
        """Those that :attr:`temperature_names` names, as they stand: tau and tau'."""
        return tuple(self.temperature(name) for name in self.temperature_names)

    def _all_temperatures(self) -> dict[str, Tensor]:
        """Those that are scheduled and those that are learned, as they stand."""
        names = dict.fromkeys((*self.temperature_names, *self._learned))
        return {name: self.temperature(name) for name in names}

    def dual(self, name: str, excess: Tensor, mask: Tensor | None = None) -> Tensor:
        """Loss of a learned temperature: up where a constraint is exceeded, else down.

        At its floor a temperature is not sent further down: it would take long to return. (To clamp
        the parameter itself would be a change in place, which a compiled graph forbids.)

        Args:
            name: of the temperature.
            excess: ``[*B]``, by how much the constraint is exceeded.
            mask: ``[*B]``, True where a state is real; None: all are.

        Returns:
            ``[*B]``, :func:`~torchrl_ecpo.functional.temperature_dual`.
        """
        log_temperature: Tensor = getattr(self, f"log_{name}")
        mean_excess = Reduction("mean", excess.shape, mask).mean(excess)
        is_at_floor = log_temperature.detach() <= math.log(self._learned[name][0])
        excess = excess.masked_fill(is_at_floor & (mean_excess < 0), 0)
        return temperature_dual(log_temperature, excess)

    # --------------------------------------------------------------------------------------- keys

    @property
    @abstractmethod
    def _all_in_keys(self) -> list[NestedKey]:
        """What the loss reads; a key may stand there twice."""

    @property
    @abstractmethod
    def _all_out_keys(self) -> list[Any]:
        """What the loss can return, in this order."""

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the loss reads; keywords of a call without a tensordict are these, joined by _."""
        return list(dict.fromkeys(self._all_in_keys)) if self._in_keys is None else self._in_keys

    @in_keys.setter
    def in_keys(self, keys: Sequence[NestedKey]) -> None:
        self._in_keys = list(keys)

    @property
    def out_keys(self) -> list[Any]:
        """What the loss returns, in this order."""
        return self._all_out_keys if self._out_keys is None else self._out_keys

    @out_keys.setter
    def out_keys(self, keys: Sequence[NestedKey]) -> None:
        self._out_keys = list(keys)

    def select_out_keys(self, *out_keys: str) -> PolicyLoss:
        """Return these entries only, until :meth:`reset_out_keys`.

        Instead of TensorDict's own hook, which takes a call for one with keywords if an entry of
        :attr:`in_keys` is absent: the mask and the states of a recurrent actor may be.
        """
        known = self._all_out_keys
        if not out_keys or not {*out_keys} <= {*known}:
            raise ValueError(f"Select some of the out_keys {known}, got {list(out_keys)}.")
        self._out_keys = list(out_keys)
        return self

    def reset_out_keys(self) -> PolicyLoss:
        """Undo :meth:`select_out_keys`."""
        self._out_keys = None
        return self

    def _make_vmap(self) -> None:
        """Nothing: networks are called one by one, each with draws of its own."""

    def set_keys(self, **kwargs: Any) -> None:
        """Rename entries of the input, see :class:`_AcceptedKeys`; None is the default name."""
        super().set_keys(**kwargs)
        self._in_keys = None

    @property
    def mask_keys(self) -> tuple[NestedKey, ...]:
        """The masks that :attr:`loss_mask_key` names; with ``"auto"`` they may be absent."""
        key = self.loss_mask_key
        if key is None:
            return ()
        return AUTO_LOSS_MASK_KEYS if key == "auto" else (key,)

    @property
    def _reward_key(self) -> NestedKey:
        return unravel_key(("next", self.tensor_keys.reward))

    def _selected(self, outputs: Mapping[str, Tensor], shape: torch.Size) -> TensorDict:
        """The entries of :attr:`out_keys`; each has this shape if nothing is reduced."""
        selected = {key: outputs[key] for key in self.out_keys}
        return TensorDict(selected, batch_size=shape if self.reduction == "none" else [])

    # ------------------------------------------------------------------------------------- checks

    def _mask(self, tensordict: TensorDictBase, shape: torch.Size) -> Tensor | None:
        """Conjunction of the masks that are there."""
        conjunction = None
        for key in self.mask_keys:
            mask = tensordict.get(key, None)
            if mask is None:
                if self.loss_mask_key == "auto":
                    continue
                raise KeyError(
                    f"The mask {key!r} is missing, which loss_mask_key names; there are "
                    f"{present(tensordict)}. Assign another name to loss_mask_key, None to use no "
                    "mask, or 'auto' for TorchRL's own where it is there."
                )
            mask = check_mask(key, mask, shape)
            conjunction = mask if conjunction is None else conjunction & mask
        return conjunction

    def _check_names(self) -> None:
        """Refuse declared names that would not be told from others; once all of them are known."""
        for name in self.losses:
            if not name.startswith("loss_"):
                raise ValueError(f"The name of a loss begins with 'loss_', got {name!r}.")
        repeated = [name for name in self._all_out_keys if self._all_out_keys.count(name) > 1]
        if repeated:
            raise ValueError(f"Names of every loss, or declared twice: {sorted(set(repeated))}.")

    def _check_declared(self, losses: Mapping[str, Tensor], metrics: Mapping[str, Tensor]) -> None:
        """Refuse other names than those in :attr:`out_keys`, which is known before the call."""
        for kind, returned in (("losses", losses), ("metrics", metrics)):
            declared = getattr(self, kind)
            if {*declared} != {*returned}:
                raise ValueError(
                    f"{type(self).__name__} declares the {kind} {sorted(declared)}, but its "
                    f"surrogate returned {sorted(returned)}. Declare what it returns ('ESS' and "
                    "'max_weight' of trajectories are computed from weights that are not None)."
                )

    def _check_values(self, quantities: Mapping[str, Tensor], *, of: str = "places") -> None:
        """Refuse values that would silently spoil the networks. One look; none when compiled."""
        if not values_can_be_seen():
            return
        temperatures = self._all_temperatures()
        total = sum(values.detach().sum() for values in quantities.values())
        # What is written in place is seen here: roots and logarithms of the forbidden are NaN.
        total = total + sum(temperature.sqrt() for temperature in temperatures.values())
        if temperatures and not self._allow_zero:
            total = total + sum(temperatures.values()).log()  # pyright: ignore
        if math.isfinite(total):
            return
        self._as_temperatures(temperatures)
        for name, values in quantities.items():
            strange = ~values.isfinite()
            if strange.any():
                raise ValueError(
                    f"The {name} is NaN or infinite in {int(strange.sum())} of {strange.numel()} "
                    f"{of}. Mend the environment, the observations or the networks that it comes "
                    "from."
                )


def _as_temperature(name: str, value: Any) -> float:
    """A number; refuse one that would have to be trained."""
    if isinstance(value, Tensor) and value.requires_grad:
        raise TypeError(
            f"{name} is set to its present number, and would not be trained: learn it by "
            f"learn({name!r}, start), or set value.item()."
        )
    return as_float(name, value)


def options_of(kind: type[PolicyLoss]) -> dict[str, Any]:
    """The arguments of a loss and their defaults."""
    _, *parameters = inspect.signature(kind.__init__).parameters.values()
    return {parameter.name: parameter.default for parameter in parameters}


def _whole_signature(init: Any, parent: Any) -> inspect.Signature:
    """With what a constructor hands on to its parent's, as ``*args`` and ``**options``."""
    own = inspect.signature(init).parameters.values()
    packed = {one.kind for one in own} & {
        inspect.Parameter.VAR_POSITIONAL,
        inspect.Parameter.VAR_KEYWORD,
    }
    named = {one.name: one for one in own if one.kind not in packed}
    for one in inspect.signature(parent).parameters.values() if packed else ():
        if one.kind is one.KEYWORD_ONLY or one.VAR_POSITIONAL in packed:
            named.setdefault(one.name, one)
    order = sorted(named.values(), key=lambda one: (one.kind, one.default is not one.empty))
    return inspect.Signature(order)


def _names_its_class(init: Callable[..., None]) -> Callable[..., None]:
    """Refuse unknown arguments in the name of the class that was called, not of a parent's."""

    @wraps(init)
    def named(self: PolicyLoss, *args: Any, **options: Any) -> None:
        try:
            init(self, *args, **options)
        except TypeError as error:
            known = options_of(type(self))
            unknown = ", ".join(repr(name) for name in options if name not in known)
            is_outermost = type(self).__init__ is named
            if not (unknown and is_outermost and "unexpected keyword argument" in str(error)):
                raise
            message = f"{type(self).__name__} has no option {unknown}; it has {', '.join(known)}."
            raise TypeError(message) from None

    return named


def _check_loaded(module: Any, state_dict: Mapping[str, Any], prefix: str, *args: Any) -> None:
    """Refuse temperatures of a state dict that could not be set."""
    values = module._all_temperatures()
    for name in values:
        if prefix + name in state_dict:
            values[name] = state_dict[prefix + name]
        elif f"{prefix}log_{name}" in state_dict:
            values[name] = state_dict[f"{prefix}log_{name}"].exp()
    module._as_temperatures(values)


class Reduction(NamedTuple):
    """How numbers of each state, or group, become one: over the real ones, by replay's weights."""

    kind: str
    """``"mean"``, ``"sum"`` or ``"none"``."""
    shape: torch.Size
    """``[*B]``."""
    mask: Tensor | None = None
    weights: Tensor | None = None

    def first(self, number: int | None) -> Reduction:
        """Of the first states of the batch; of all if the number is None."""
        if number is None:
            return self
        shape = torch.Size([min(number, self.shape[0]), *self.shape[1:]])
        rows = [None if x is None else x[:number] for x in (self.mask, self.weights)]
        return Reduction(self.kind, shape, *rows)

    def loss(self, values: Tensor) -> Tensor:
        """Of values ``[*B]``, or of one number."""
        values = widened(values)
        if values.shape != self.shape:
            return values.expand(self.shape) if self.kind == "none" else values
        if self.mask is not None:
            values = values.where(self.mask, 0.0)
        if self.weights is not None:
            values = values * self.weights
        if self.kind != "mean":
            return values if self.kind == "none" else values.sum()
        if self.weights is None:
            return self.mean(values)
        total = self.weights.sum()
        return values.sum() / total.where(total > 0, 1.0)

    def metric(self, values: Tensor) -> Tensor:
        """The mean, without weights; or the values of each state with ``"none"``."""
        values = values.detach()
        if self.kind == "none":
            return values.expand(self.shape)
        return values if values.shape != self.shape else self.mean(values)

    def mean(self, values: Tensor) -> Tensor:
        """Over the real states, without weights; in single precision at least, as all sums."""
        values = widened(values)
        if self.mask is None:
            return values.mean()
        return values.where(self.mask, 0.0).sum() / self.mask.sum().clamp_min(1)
