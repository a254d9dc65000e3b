"""What the actor-critic losses share: soft values, soft Q, temperatures and bookkeeping."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import _vmap_func, dispatch_value_estimator, distance_loss
from torchrl.objectives.value import TD0Estimator, TD1Estimator, TDLambdaEstimator
from torchrl.objectives.value.advantages import ValueEstimatorBase

from torchrl_ecpo.checks import (
    as_float,
    check_choice,
    check_count,
    get_entry,
    values_can_be_seen,
)
from torchrl_ecpo.functional import (
    effective_sample_size,
    lift_divergence_estimate,
    lifted_log_weights,
    self_normalised_weights,
    soft_value,
    soft_value_estimate,
    temperature_dual,
)
from torchrl_ecpo.objectives._base import PolicyLoss
from torchrl_ecpo.objectives.actions import (
    SampledActions,
    is_discrete,
    log_prob_of,
    sample_actions,
)

__all__ = ["ActorCriticLoss", "ContinuousActorCriticLoss", "DiscreteActorCriticLoss", "Lift"]

LOSS_FUNCTIONS = ("l2", "l1", "smooth_l1")
SATURATED = 0.95
ESTIMATORS: tuple[type, ...] = (TD0Estimator, TD1Estimator, TDLambdaEstimator)


class Lift(NamedTuple):
    """The lifted policy at each state, on the actions that stand for it; without gradients."""

    score: Tensor
    """``[M, *B]``, the least of the soft Q values of each action."""
    reference_log_prob: Tensor
    """``[M, *B]``, under the reference policy."""
    log_weights: Tensor
    """``[M, *B]``, log-weight of the target, relative to whatever proposed the actions."""
    weights: Tensor
    """``[M, *B]``, :attr:`log_weights` normalised."""
    value: Tensor
    """``[*B]``, the soft value of the state."""
    actions: SampledActions | None
    """The actions, where they are samples; None where they are all there are."""

    @property
    def sampled_actions(self) -> SampledActions:
        """The actions of a lift that was estimated from samples."""
        assert self.actions is not None
        return self.actions


class ActorCriticLoss(PolicyLoss):
    """Base class of the actor-critic losses: lift the reference policy by soft Q, and project.

    Two subclasses say what stands for the actions at a state: M samples of the reference
    (:class:`ContinuousActorCriticLoss`), or all actions there are
    (:class:`DiscreteActorCriticLoss`). A member of the family implements :meth:`project`.

    The arguments are documented where users meet them: :class:`~torchrl_ecpo.ECACLoss`.
    """

    @dataclass
    class _AcceptedKeys:
        """Entries of the input tensordict, of leading shape ``[*B]``.

        Attributes:
            action: what was done. Defaults to ``"action"``.
            reward: ``[*B, 1]``, read from ``"next"``. Defaults to ``"reward"``.
            done: ``[*B, 1]``, read from ``"next"``. Defaults to ``"done"``.
            terminated: ``[*B, 1]``, read from ``"next"``: where there is no state to come, as
                opposed to a time limit. Defaults to ``"terminated"``.
            value: written by the value network. Defaults to ``"state_value"``.
            state_action_value: written by the Q network. Defaults to ``"state_action_value"``.
            action_value: written by the Q network of the discrete losses. Defaults to
                ``"action_value"``.
            priority: written into the input. Defaults to ``"td_error"``.
            priority_weight: of prioritised replay. Defaults to ``"priority_weight"``.
        """

        action: NestedKey = "action"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        value: NestedKey = "state_value"
        state_action_value: NestedKey = "state_action_value"
        action_value: NestedKey = "action_value"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    SUPPORTED_VALUE_ESTIMATORS = (
        ValueEstimators.TD0,
        ValueEstimators.TD1,
        ValueEstimators.TDLambda,
    )
    _schedulable_buffers = frozenset({"tau", "tau_prime"})

    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    value_network: TensorDictModule | None
    value_network_params: TensorDictParams | None
    target_value_network_params: TensorDictParams | None

    _metric_names: ClassVar[tuple[str, ...]]
    _is_discrete: ClassVar[bool]
    _qvalue_key: ClassVar[str]
    num_action_samples: int
    num_next_action_samples: int
    log_tau: nn.Parameter
    log_tau_prime: nn.Parameter
    _twin: ClassVar[str]
    """The loss for the other kind of action space."""

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        tau: float,
        tau_prime: float,
        target_kl: float | None,
        target_entropy: float | Literal["auto"] | None,
        min_tau: float,
        min_tau_prime: float,
        num_qvalue_nets: int,
        num_actor_states: int | None,
        loss_function: str,
        delay_actor: bool,
        delay_qvalue: bool | None,
        delay_value: bool,
        separate_losses: bool,
        reduction: Literal["none", "mean", "sum"] | None,
        skip_done_states: bool,
        use_prioritized_weights: bool | Literal["auto"],
        deactivate_vmap: bool,
    ) -> None:
        self._out_keys: list[NestedKey] | None = None
        super().__init__(actor_network, delay_actor=delay_actor, reduction=reduction)
        check_count("num_qvalue_nets", num_qvalue_nets)
        self._check_networks(actor_network, qvalue_network, num_qvalue_nets)
        check_choice("loss_function", loss_function, LOSS_FUNCTIONS)
        if value_network is not None and not (delay_value and not delay_qvalue):
            raise ValueError(
                "With a value_network the value of the next state comes from its delayed copy: "
                f"leave delay_value=True and delay_qvalue=None, got {delay_value} and "
                f"{delay_qvalue}."
            )
        if num_actor_states is not None:
            check_count("num_actor_states", num_actor_states)
            if self.reduction == "none":
                raise ValueError(
                    "num_actor_states must be None with reduction='none', where each state has its "
                    f"number; got {num_actor_states}."
                )
        if use_prioritized_weights not in (True, False, "auto"):
            raise ValueError(
                "use_prioritized_weights must be True, False or 'auto', got "
                f"{use_prioritized_weights!r}."
            )
        self.num_actor_states = num_actor_states
        self.loss_function = loss_function
        self.skip_done_states = skip_done_states
        self.use_prioritized_weights = use_prioritized_weights
        self.deactivate_vmap = deactivate_vmap
        self.num_qvalue_nets = num_qvalue_nets
        self.delay_value = value_network is not None
        self.delay_qvalue = value_network is None if delay_qvalue is None else delay_qvalue

        shared = list(actor_network.parameters()) if separate_losses else None
        if value_network is None:
            self.value_network = None
            self.value_network_params = self.target_value_network_params = None
        else:
            self.convert_to_functional(
                value_network,
                "value_network",
                create_target_params=True,
                compare_against=shared,
            )
            shared = None if shared is None else [*shared, *value_network.parameters()]
        self.convert_to_functional(
            qvalue_network,  # pyright: ignore[reportArgumentType] - a list is allowed
            "qvalue_network",
            num_qvalue_nets,
            create_target_params=self.delay_qvalue,
            compare_against=shared,
        )
        if isinstance(target_entropy, str):
            check_choice("target_entropy", target_entropy, ("auto",))
        elif target_entropy is not None:
            target_entropy = as_float("target_entropy", target_entropy)
            if not math.isfinite(target_entropy):
                raise ValueError(
                    f'target_entropy must be finite, in nats, "auto" or None, got {target_entropy}.'
                )
        temperatures = self._as_temperatures({"tau": tau, "tau_prime": tau_prime})
        self.temperature_names = tuple(temperatures)
        if target_kl is not None:
            target_kl = as_float("target_kl", target_kl)
            if not 0 < target_kl < math.inf:
                raise ValueError(f"target_kl must be above 0, in nats, or None, got {target_kl}.")
        self.target_kl = target_kl
        self.target_entropy = target_entropy
        self._set_temperature("tau", temperatures["tau"], min_tau, is_learned=target_kl is not None)
        self._set_temperature(
            "tau_prime",
            temperatures["tau_prime"],
            min_tau_prime,
            is_learned=target_entropy is not None,
        )
        self._make_vmap()
        self._default_value_estimator()
        action_keys = getattr(actor_network, "dist_sample_keys", None)
        if action_keys:
            self.set_keys(action=action_keys[0])

    # ----------------------------------------------------------------------------- what differs

    @abstractmethod
    def _scored_actions(
        self,
        observations: TensorDictBase,
        reference: Distribution,
        qvalue_params: TensorDictParams,
        num_samples: int,
    ) -> tuple[Tensor, Tensor, SampledActions | None]:
        """Least soft Q and log-probability ``[M, *B]`` of the actions, and they where sampled."""

    @abstractmethod
    def project(
        self, tensordict: TensorDictBase, policy: Distribution, reference: Distribution
    ) -> tuple[Tensor, Lift]:
        """Divergence ``[*B]`` of target and policy up to a constant (Eq. 11), and the lift."""

    @abstractmethod
    def _chosen_qvalue(self, tensordict: TensorDictBase) -> Tensor:
        """Soft Q ``[N, *B]`` of the actions that were taken; carries the gradient."""

    @abstractmethod
    def _metrics(self, lift: Lift, policy: Distribution, reference: Distribution) -> dict:
        """KL(target, pi_bar), KL(pi_bar, pi_theta), entropy and saturation, each ``[*B]``."""

    @abstractmethod
    def _constraints(self, lift: Lift) -> tuple[float, float]:
        """Target entropy, and the bound on KL(target, pi_bar), both in nats; 0 where there is none.

        Raises:
            ValueError: for a bound that the lift cannot show.
        """

    # ------------------------------------------------------------------------------ the algorithm

    # The rewards tell the batch size: entries of a single number each would be taken for a batch.
    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute all losses of a batch of transitions ``[*B]``.

        Args:
            tensordict: with the entries of :attr:`in_keys`; the priority is written into it.

        Returns:
            The entries of :attr:`out_keys`, losses and, detached, metrics; with
            ``reduction="none"`` each has the shape of the batch.
        """
        transitions, mask = self._read(tensordict)
        if self.num_actor_states is not None and not transitions.ndim:
            raise ValueError(
                f"num_actor_states={self.num_actor_states} takes the first of a batch, but this is "
                "one transition, without a batch dimension: build the loss with "
                "num_actor_states=None."
            )
        target = self.soft_bellman_target(transitions)
        loss_qvalue, td_error = self._qvalue_loss(transitions, target)
        states: Any = transitions[: self.num_actor_states]
        policy, reference = self._policies(states)
        loss_actor, lift = self.project(states, policy, reference)
        self._check_values(
            {
                f"reward {self._reward_key!r}": transitions.get(self._reward_key),
                "target of the soft Q value": target,
                "soft Q value": lift.score,
                "log-probability of the reference policy": lift.reference_log_prob,
                "temporal difference error": td_error,
                "loss of the policy": loss_actor,
            }
        )
        losses = {"loss_actor": loss_actor}
        if self.value_network is not None:
            losses["loss_value"] = self._value_loss(states, lift)
        with torch.no_grad():
            metrics = {
                "ESS": effective_sample_size(lift.weights, sample_dim=0),
                **self._metrics(lift, policy, reference),
                "qvalue": lift.score.mean(0),
                "state_value": lift.value,
            }
        losses |= self._temperature_losses(lift, metrics, states)
        priority = td_error if mask is None else td_error.where(mask, 0.0)
        tensordict.set(self.tensor_keys.priority, priority)
        outputs = {
            "loss_qvalue": self._reduce(loss_qvalue, transitions),
            **{name: self._reduce(loss, states) for name, loss in losses.items()},
            **self._report(metrics, states),
        }
        td_out = TensorDict(
            {key: outputs[key] for key in self._all_out_keys},
            batch_size=transitions.shape if self.reduction == "none" else [],
        )
        self._clear_weakrefs(
            tensordict,
            td_out,
            "actor_network_params",
            "qvalue_network_params",
            "value_network_params",
            "target_actor_network_params",
            "target_qvalue_network_params",
            "target_value_network_params",
        )
        return td_out

    def _read(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor | None]:
        """The transitions ``[*B]``, and the mask of the real ones where there is one.

        Those that are not real are blank: the gradient of NaN is NaN, also of one that counts 0.
        """
        for key in self.in_keys:
            get_entry(tensordict, key)
        shape = self._batch_shape(tensordict)
        mask = self._mask(tensordict, shape)
        if mask is None and tensordict.shape == shape:
            return tensordict, None

        def only_real(entry: Tensor) -> Tensor:
            return entry if mask is None else _blank(entry, ~mask)

        transitions: Any = tensordict.apply(only_real, batch_size=shape)
        if mask is not None:
            transitions.update(tensordict.select(*self._loss_mask_keys(), strict=False))
        return transitions, mask

    def soft_bellman_target(self, tensordict: TensorDictBase) -> Tensor:
        """The target of soft Q, ``[*B]``: r + gamma V(s') of Eq. 10, by the value estimator."""
        with torch.no_grad():
            next_tensordict = tensordict.get("next")
            ended = next_tensordict.get(
                self.tensor_keys.done if self.skip_done_states else self.tensor_keys.terminated
            )
            value = self._next_state_value(next_tensordict, ended.squeeze(-1))
            # Nothing is to come, whatever stands there: NaN times 0 would be NaN.
            value = value.unsqueeze(-1).masked_fill(ended, 0.0)
            valued = tensordict.copy()
            valued.set(unravel_key(("next", self.tensor_keys.value)), value)
            mask = self._mask(tensordict, ended.shape[:-1])
            if mask is not None and mask.ndim:
                # What is not real follows on nothing: TD(1) and TD(lambda) look no further.
                is_followed = (mask & mask.roll(-1, -1)).unsqueeze(-1)
                done = unravel_key(("next", self.tensor_keys.done))
                valued.set(done, tensordict.get(done) | ~is_followed)
            return self.value_estimator.value_estimate(valued).squeeze(-1)

    def _next_state_value(self, tensordict: TensorDictBase, ended: Tensor) -> Tensor:
        """V(s') ``[*B]`` of the delayed value network, or of the lift by delayed soft Q (Eq. 8)."""
        observations = tensordict.select(*self._next_observations)
        if self.skip_done_states:
            observations = observations.apply(lambda x: _blank(x, ended))
        if self.value_network is not None:
            return self._state_value(observations, self.target_value_network_params)
        params = self.target_actor_network_params if self.delay_actor else self.actor_network_params
        reference = self._distribution(observations, params)
        return self.lift(
            observations,
            reference,
            self.target_qvalue_network_params,
            self.num_next_action_samples,
        ).value

    def lift(
        self,
        observations: TensorDictBase,
        reference: Distribution,
        qvalue_params: TensorDictParams,
        num_samples: int,
    ) -> Lift:
        """Lift the reference policy at each state: Eq. 8, by samples of it or over all actions."""
        with torch.no_grad():
            score, log_prob, actions = self._scored_actions(
                observations, reference, qvalue_params, num_samples
            )
            if log_prob.shape != score.shape:
                raise ValueError(
                    f"The soft Q values of the actions have the shape {tuple(score.shape)}, their "
                    f"log-probabilities {tuple(log_prob.shape)}: actor and Q network must know the "
                    "same actions, and an action of several numbers has one log-probability, as "
                    "with torch.distributions.Independent or TanhNormal."
                )
            tau, tau_prime = self.temperatures()
            log_weights = lifted_log_weights(score, log_prob, tau=tau, tau_prime=tau_prime)
            mask = None
            if actions is None:  # nobody has drawn them: the reference counts by its probability
                mask = ~(log_prob <= impossible(log_prob))  # NaN is not impossible, but wrong
                log_weights = (log_weights + log_prob).where(mask, impossible(log_prob))
            weights = self_normalised_weights(log_weights, sample_dim=0)
            value_of = soft_value if actions is None else soft_value_estimate
            value = value_of(score, log_prob, tau=tau, tau_prime=tau_prime, sample_dim=0, mask=mask)
        return Lift(score, log_prob, log_weights, weights, value, actions)

    def _qvalue_loss(self, tensordict: TensorDictBase, target: Tensor) -> tuple[Tensor, Tensor]:
        """Eq. 10, summed over the Q networks, and the largest error of them: both ``[*B]``."""
        qvalue = self._chosen_qvalue(tensordict)
        target = target.expand_as(qvalue)
        loss = distance_loss(qvalue, target, loss_function=self.loss_function).sum(0)
        return loss, (qvalue.detach() - target).abs().amax(0)

    def _value_loss(self, tensordict: TensorDictBase, lift: Lift) -> Tensor:
        """Eq. 9, with the soft value that the lift knows anyway."""
        value = self._state_value(tensordict, self.value_network_params)
        return distance_loss(value, lift.value, loss_function=self.loss_function)

    def _state_value(self, observations: TensorDictBase, params: TensorDictParams | None) -> Tensor:
        """V ``[*B]`` of the value network."""
        network = self.value_network
        assert network is not None
        assert params is not None
        observations = observations.select(*network.in_keys)
        with params.to_module(network, preserve_module_state=False):
            outputs = network(observations)
        return _written(outputs, "value", self.tensor_keys.value, network).squeeze(-1)

    def _policies(self, tensordict: TensorDictBase) -> tuple[Distribution, Distribution]:
        """The policy being trained, and the reference: its delayed copy, or itself."""
        policy = self._distribution(tensordict, self.actor_network_params)
        if not self.delay_actor:
            return policy, policy
        with torch.no_grad():
            return policy, self._distribution(tensordict, self.target_actor_network_params)

    def _distribution(self, tensordict: TensorDictBase, params: TensorDictParams) -> Distribution:
        inputs = tensordict.select(*self.actor_network.in_keys)
        with (
            set_exploration_type(ExplorationType.RANDOM),
            params.to_module(self.actor_network, preserve_module_state=False),
        ):
            distribution = self.actor_network.get_dist(inputs)
        self._check_policy(type(distribution))
        if not self._is_discrete and not distribution.has_rsample:
            self._refuse(type(distribution))
        return distribution

    # ------------------------------------------------------------------------------ temperatures

    def temperatures(self) -> tuple[Tensor, Tensor]:
        """Tau and tau' as they stand, 0-d and detached, in the unit of Q."""
        return self._temperature("tau"), self._temperature("tau_prime")

    def _set_temperature(self, name: str, value: float, floor: float, *, is_learned: bool) -> None:
        setattr(self, f"min_{name}", floor)
        device = self._default_device
        if not is_learned:
            self.register_coeff_buffer(name, value, device=device)
            return
        if not 0 < floor <= value:
            raise ValueError(
                f"A learned {name} must start at min_{name} > 0 or above, got {name}={value} and "
                f"min_{name}={floor}."
            )
        log_value = torch.tensor(math.log(value), device=device)
        self.register_parameter(f"log_{name}", nn.Parameter(log_value))

    def _temperature(self, name: str) -> Tensor:
        log_temperature = self._parameters.get(f"log_{name}")
        if log_temperature is None:
            return getattr(self, name)
        return log_temperature.detach().exp().clamp_min(getattr(self, f"min_{name}"))

    def _target_entropy(self, *, auto: float) -> float:
        given = self.target_entropy
        return auto if isinstance(given, str) else given or 0.0

    def _temperature_losses(
        self, lift: Lift, metrics: dict[str, Tensor], tensordict: TensorDictBase
    ) -> dict[str, Tensor]:
        losses = {}
        target_entropy, bound = self._constraints(lift)
        if self.target_kl is not None:
            divergence = self._reduce_loss(metrics["kl_target"], tensordict, reduction="mean")
            excess = ((divergence - bound) / bound).clamp(-1.0, 1.0)
            excess = excess.expand(metrics["kl_target"].shape)
            losses["loss_tau"] = self._dual("tau", excess, tensordict)
        if self.target_entropy is not None:
            excess = target_entropy - metrics["entropy"]
            losses["loss_tau_prime"] = self._dual("tau_prime", excess, tensordict)
        return losses

    def _dual(self, name: str, excess: Tensor, tensordict: TensorDictBase) -> Tensor:
        """At its floor a temperature is not sent further down, lest it should take long to return.

        (Clamping the parameter itself would be a change in place, which a compiled graph forbids.)
        """
        log_temperature = getattr(self, f"log_{name}")
        is_at_floor = log_temperature.detach() <= math.log(getattr(self, f"min_{name}"))
        is_sent_down = self._reduce_loss(excess, tensordict, reduction="mean") < 0
        return temperature_dual(log_temperature, excess.masked_fill(is_at_floor & is_sent_down, 0))

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse a temperature that is learned, and one that is not allowed."""
        is_learned = f"log_{name}" in self.__dict__.get("_parameters", {})
        if is_learned and name in type(self)._all_schedulable_buffers:
            raise AttributeError(
                f"{name} is learned. Build the loss without "
                f"{'target_kl' if name == 'tau' else 'target_entropy'} to set or schedule it."
            )
        super().__setattr__(name, value)

    # ---------------------------------------------------------------------------------- reporting

    def _reduce(self, loss: Tensor, tensordict: TensorDictBase) -> Tensor:
        weights = None
        if self.use_prioritized_weights:
            weights = tensordict.get(self.tensor_keys.priority_weight, None)
        if weights is None:
            return self._reduce_loss(loss, tensordict)
        # TorchRL's weighted mean is NaN where the mask leaves nothing, its mean without weights 0;
        # and it reads the weights of what is masked.
        weights = self._reduce_loss(weights, tensordict, reduction="none")
        if self.reduction != "mean":
            return self._reduce_loss(loss, tensordict, weights=weights)
        count = weights.sum()
        total = self._reduce_loss(loss, tensordict, reduction="sum", weights=weights)
        return total / count.where(count > 0, 1.0)

    def _report(self, metrics: dict[str, Tensor], tensordict: TensorDictBase) -> dict[str, Tensor]:
        """Means over the batch, or one number a state with ``reduction="none"``."""
        tau, tau_prime = self.temperatures()
        temperatures = {"tau": tau, "tau_prime": tau_prime}
        if self.reduction == "none":
            shape = tensordict.shape
            return metrics | {name: value.expand(shape) for name, value in temperatures.items()}
        means = {
            name: self._reduce_loss(value, tensordict, reduction="mean")
            for name, value in metrics.items()
        }
        return means | temperatures

    # --------------------------------------------------------------------------------------- keys

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the loss reads; keywords of a call without a tensordict are these, joined by _."""
        if self._in_keys is None:
            keys = self.tensor_keys
            following = [keys.reward, keys.done, keys.terminated, *self._next_observations]
            self._in_keys = list(
                dict.fromkeys(
                    [
                        keys.action,
                        *self.actor_network.in_keys,
                        *self.qvalue_network.in_keys,
                        *(() if self.value_network is None else self.value_network.in_keys),
                        *(unravel_key(("next", key)) for key in following),
                    ]
                )
            )
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: Sequence[NestedKey]) -> None:
        self._in_keys = list(keys)

    @property
    def out_keys(self) -> list[NestedKey]:
        """What the loss returns, in this order."""
        if self._out_keys is None:
            self._out_keys = list(self._all_out_keys)
        return self._out_keys

    @out_keys.setter
    def out_keys(self, keys: Sequence[NestedKey]) -> None:
        self._out_keys = list(keys)

    @property
    def _all_out_keys(self) -> list[str]:
        learned = [name for name in ("tau", "tau_prime") if f"log_{name}" in self._parameters]
        value = [] if self.value_network is None else ["loss_value"]
        losses = ["loss_actor", "loss_qvalue", *value, *(f"loss_{name}" for name in learned)]
        return [*losses, *self._metric_names, "tau", "tau_prime"]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(**self._value_estimator_keys)
        self._in_keys = None

    @property
    def _value_estimator_keys(self) -> dict[str, NestedKey]:
        keys = self.tensor_keys
        return {
            "value": keys.value,
            "reward": keys.reward,
            "done": keys.done,
            "terminated": keys.terminated,
        }

    def make_value_estimator(
        self,
        value_type: ValueEstimators
        | str
        | ValueEstimatorBase
        | type[ValueEstimatorBase]
        | None = None,
        **hyperparams: Any,
    ) -> ActorCriticLoss:
        """Choose how rewards and soft values make the target of Q, see TorchRL's ``SACLoss``.

        Args:
            value_type: TD(0) by default, the paper's; TD(1) and TD(lambda) on trajectories. A
                member of ``ValueEstimators``, its name (``"td0"``), or an estimator of TorchRL's
                or its class, with ``value_network=None``.
            hyperparams: of the estimator, such as ``gamma`` (0.99 by default).

        Returns:
            The loss itself.

        Raises:
            NotImplementedError: for an estimator that needs more than values.
            ValueError: for an estimator with a value network.
        """
        if isinstance(value_type, type):
            self._check_estimator(value_type, hyperparams.get("value_network"))
        elif isinstance(value_type, ValueEstimatorBase):
            self._check_estimator(type(value_type), value_type.value_network)
        resolved, options = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if resolved is None or options is None:  # an estimator or its class, which is in place now
            self._forward_value_estimator_keys()
            return self
        dispatch_value_estimator(
            self,
            resolved,
            supported=self.SUPPORTED_VALUE_ESTIMATORS,
            tensor_keys=self._value_estimator_keys,
            value_network=None,
            **options,
        )
        return self

    def _check_estimator(self, kind: type, value_network: Any) -> None:
        if not issubclass(kind, ESTIMATORS):
            takes = ", ".join(estimator.__name__ for estimator in ESTIMATORS)
            raise NotImplementedError(
                f"{kind.__name__} is not implemented for {type(self).__name__}, which takes "
                f"{takes}."
            )
        if value_network is not None:
            raise ValueError(
                f"The {kind.__name__} must have value_network=None: the loss itself computes the "
                "soft value of the next state."
            )

    # ------------------------------------------------------------------------------------ critics

    def __getstate__(self) -> dict[str, Any]:
        """Without the vmapped function, which cannot be pickled and holds these networks."""
        state = super().__getstate__()
        return {name: value for name, value in state.items() if name != "_vmap_qvalue"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the function anew, of the networks of the copy."""
        super().__setstate__(state)
        self._make_vmap()

    def _make_vmap(self) -> None:
        self._vmap_qvalue: Any = _vmap_func(
            self.qvalue_network,
            (None, 0),
            randomness=self.vmap_randomness,
        )

    def _each_qvalue(
        self, inputs: TensorDictBase, params: TensorDictParams, key: NestedKey
    ) -> Tensor:
        """What each of the N Q networks writes, ``[N, ...]``."""
        network, name = self.qvalue_network, self._qvalue_key
        if self._knows_each:
            return _written(network.each(inputs, params), name, key, network)
        if not self.deactivate_vmap:
            return _written(self._vmap_qvalue(inputs, params), name, key, network)
        # TorchRL's pseudo-vmap does this too, and stacks all else that is in the inputs.
        outputs = []
        for each in params.unbind(0):
            with each.to_module(network, preserve_module_state=False):
                outputs.append(_written(network(inputs.copy()), name, key, network))
        return torch.stack(outputs)

    @property
    def _knows_each(self) -> bool:
        """Whether the Q network knows a faster way of its own (not what it wraps: DenseNetwork)."""
        return hasattr(type(self.qvalue_network), "each")

    @property
    def _next_observations(self) -> list[NestedKey]:
        """What the value of the next state is computed from."""
        if self.value_network is not None:
            return self.value_network.in_keys
        return [*self.actor_network.in_keys, *self._qvalue_observations]

    @property
    def _qvalue_observations(self) -> list[NestedKey]:
        """What the Q network reads beside the action."""
        return [key for key in self.qvalue_network.in_keys if key != self.tensor_keys.action]

    # ----------------------------------------------------------------------------- bad input

    def _check_networks(self, actor_network: Any, qvalue_network: Any, number: int) -> None:
        if isinstance(qvalue_network, (list, tuple)):
            different = len({id(network) for network in qvalue_network})
            if not 2 <= different == len(qvalue_network) == number:
                # TorchRL takes one network, or the same one twice, for one that is not trained.
                raise ValueError(
                    f"A list of Q networks must hold num_qvalue_nets={number} different ones, at "
                    f"least 2, got {different} in {len(qvalue_network)}. A network by itself, "
                    "without a list, is copied and drawn anew for each."
                )
        for module in reversed(list(actor_network.modules())):
            distribution_class = getattr(module, "distribution_class", None)
            if isinstance(distribution_class, type):
                self._check_policy(distribution_class)
                break

    def _batch_shape(self, tensordict: TensorDictBase) -> torch.Size:
        """[*B] of a batch, from its rewards."""
        shape = tensordict.get(self._reward_key).shape
        if shape[-1:] != (1,):
            raise ValueError(
                f"The reward {self._reward_key!r} must have the shape [*B, 1], got {tuple(shape)}."
            )
        for name in ("done", "terminated"):
            key = unravel_key(("next", getattr(self.tensor_keys, name)))
            if tensordict.get(key).shape != shape:
                raise ValueError(
                    f"The entry {key!r} must have the shape {tuple(shape)} of the reward, got "
                    f"{tuple(tensordict.get(key).shape)}."
                )
        return shape[:-1]

    def _check_policy(self, distribution_class: type) -> None:
        is_composite = issubclass(distribution_class, CompositeDistribution)
        if is_composite or is_discrete(distribution_class) != self._is_discrete:
            self._refuse(distribution_class)

    def _refuse(self, distribution_class: type) -> None:
        one_of_n, many = "one of n actions (Categorical, OneHotCategorical)", "actions with rsample"
        own, other = (one_of_n, many) if self._is_discrete else (many, one_of_n)
        raise ValueError(
            f"{type(self).__name__} is for policies over {own}, got {distribution_class.__name__}. "
            f"For those over {other}, use {self._twin}."
        )

    @staticmethod
    def _check_values(quantities: dict[str, Tensor]) -> None:
        """Refuse values that would silently spoil the networks. One look; none when compiled."""
        if not values_can_be_seen():
            return
        if math.isfinite(sum(values.detach().sum() for values in quantities.values())):
            return
        for name, values in quantities.items():
            strange = ~values.isfinite()
            if strange.any():
                raise ValueError(
                    f"The {name} is NaN or infinite in {int(strange.sum())} of {strange.numel()} "
                    "places. Mend the environment, the observations or the networks that it comes "
                    "from."
                )


class ContinuousActorCriticLoss(ActorCriticLoss):
    """An :class:`ActorCriticLoss` that knows the lift by M actions of the reference policy."""

    _is_discrete = False
    _qvalue_key = "state_action_value"
    _metric_names = (
        "ESS",
        "kl_target",
        "kl_to_reference",
        "entropy",
        "saturation",
        "qvalue",
        "state_value",
    )

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        num_action_samples: int,
        num_next_action_samples: int,
        **options: Any,
    ) -> None:
        super().__init__(actor_network, qvalue_network, value_network, **options)
        check_count("num_action_samples", num_action_samples)
        check_count("num_next_action_samples", num_next_action_samples)
        self.num_action_samples = num_action_samples
        self.num_next_action_samples = num_next_action_samples
        if self.tensor_keys.action not in self.qvalue_network.in_keys:
            raise ValueError(
                f"qvalue_network must read the action {self.tensor_keys.action!r}, its in_keys are "
                f"{self.qvalue_network.in_keys}. A network of the values of all actions belongs to "
                f"{self._twin}."
            )
        self._check_target_kl(self.target_kl or 0.0)

    def _scored_actions(
        self,
        observations: TensorDictBase,
        reference: Distribution,
        qvalue_params: TensorDictParams,
        num_samples: int,
    ) -> tuple[Tensor, Tensor, SampledActions]:
        actions = sample_actions(reference, num_samples)
        score = self._qvalue_of(observations, actions.action, qvalue_params)
        return score, actions.log_prob, actions

    def _qvalue_of(
        self, observations: TensorDictBase, action: Tensor, qvalue_params: TensorDictParams
    ) -> Tensor:
        """The least of the soft Q values ``[M, *B]`` of actions ``[M, *B, A]``."""
        shape = action.shape[:-1]
        # Samples become more rows, not more steps, which a recurrent network would tell apart. What
        # has `each` keeps them apart from the states, which it need not read once for each sample.
        rows = shape if self._knows_each else (-1, *shape[2:])
        inputs = observations.select(*self._qvalue_observations).expand(shape).reshape(rows)
        inputs.set(self.tensor_keys.action, action.reshape(*rows, action.shape[-1]))
        qvalues = self._each_qvalue(inputs, qvalue_params, self.tensor_keys.state_action_value)
        return _squeezed(qvalues.amin(0)).reshape(shape)

    def _chosen_qvalue(self, tensordict: TensorDictBase) -> Tensor:
        inputs = tensordict.select(*self.qvalue_network.in_keys)
        key = self.tensor_keys.state_action_value
        return _squeezed(self._each_qvalue(inputs, self.qvalue_network_params, key))

    def _metrics(
        self, lift: Lift, policy: Distribution, reference: Distribution
    ) -> dict[str, Tensor]:
        entropy = -lift.reference_log_prob.mean(0)
        if policy is reference:
            moved = torch.zeros_like(entropy)
        else:
            moved = (lift.reference_log_prob - log_prob_of(lift.sampled_actions, policy)).mean(0)
        return {
            "kl_target": lift_divergence_estimate(lift.weights, sample_dim=0),
            "kl_to_reference": moved,
            "entropy": entropy,
            "saturation": _saturation(lift.sampled_actions.action, reference),
        }

    def _constraints(self, lift: Lift) -> tuple[float, float]:
        size = lift.sampled_actions.action.shape[-1]
        bound = size * (self.target_kl or 0.0)
        self._check_target_kl(bound)
        return self._target_entropy(auto=-size), bound

    def _check_target_kl(self, bound: float) -> None:
        if self.target_kl is not None and bound >= math.log(self.num_action_samples):
            raise ValueError(
                f"target_kl={self.target_kl} per action dimension bounds KL(target, pi_bar) by "
                f"{bound:.3g} nats, but {self.num_action_samples} samples cannot show more than "
                f"log {self.num_action_samples} = {math.log(self.num_action_samples):.3g}: lower "
                "target_kl or raise num_action_samples."
            )


class DiscreteActorCriticLoss(ActorCriticLoss):
    """An :class:`ActorCriticLoss` that knows the lift exactly: Eq. 8, summed over all actions."""

    _is_discrete = True
    _qvalue_key = "action_value"
    _metric_names = ("ESS", "kl_target", "kl_to_reference", "entropy", "qvalue", "state_value")
    num_action_samples = num_next_action_samples = 0  # nothing is sampled

    def _scored_actions(
        self,
        observations: TensorDictBase,
        reference: Distribution,
        qvalue_params: TensorDictParams,
        num_samples: int,
    ) -> tuple[Tensor, Tensor, None]:
        score = self._qvalues(observations, qvalue_params).amin(0).movedim(-1, 0)
        return score, log_probs_of_all(reference), None

    def _qvalues(self, observations: TensorDictBase, qvalue_params: TensorDictParams) -> Tensor:
        """Soft Q ``[N, *B, n]`` of all actions."""
        inputs = observations.select(*self._qvalue_observations)
        return self._each_qvalue(inputs, qvalue_params, self.tensor_keys.action_value)

    def _chosen_qvalue(self, tensordict: TensorDictBase) -> Tensor:
        qvalues = self._qvalues(tensordict, self.qvalue_network_params)
        action = tensordict.get(self.tensor_keys.action)
        if action.shape == qvalues.shape[1:]:
            return (qvalues * action).sum(-1)
        if action.shape == (*qvalues.shape[1:-1], 1):
            action = action.squeeze(-1)
        if action.shape != qvalues.shape[1:-1] or action.is_floating_point():
            raise ValueError(
                f"The action {self.tensor_keys.action!r} must be one-hot of shape "
                f"{tuple(qvalues.shape[1:])} or an integer of shape {tuple(qvalues.shape[1:-1])}, "
                f"got {action.dtype} of shape {tuple(action.shape)}."
            )
        index = action.long().unsqueeze(-1).expand(*qvalues.shape[:-1], 1)
        return qvalues.gather(-1, index).squeeze(-1)

    def _metrics(
        self, lift: Lift, policy: Distribution, reference: Distribution
    ) -> dict[str, Tensor]:
        log_prob, log_target = lift.reference_log_prob, lift.log_weights.log_softmax(0)
        return {
            "kl_target": (lift.weights * (log_target - log_prob)).sum(0),
            "kl_to_reference": (log_prob.exp() * (log_prob - log_probs_of_all(policy))).sum(0),
            "entropy": -(log_prob.exp() * log_prob).sum(0),
        }

    def _constraints(self, lift: Lift) -> tuple[float, float]:
        return self._target_entropy(auto=0.98 * math.log(len(lift.score))), self.target_kl or 0.0


def log_probs_of_all(policy: Any) -> Tensor:
    """Log-probability of every action of a categorical or one-hot policy, actions first.

    That of an action without probability is :func:`impossible`: minus infinity times 0 is NaN.
    """
    log_probs = policy.logits.log_softmax(-1).movedim(-1, 0)
    return log_probs.masked_fill(log_probs == -torch.inf, impossible(log_probs))


def impossible(like: Tensor) -> float:
    """A log-probability so low that nothing comes of it, and finite."""
    return torch.finfo(like.dtype).min / 4


def _saturation(action: Tensor, policy: Distribution) -> Tensor:
    """Share ``[*B]`` of action components in the outer 5 % of their range; 0 without a range."""
    low, high = getattr(policy, "low", None), getattr(policy, "high", None)
    if low is None or high is None:
        return torch.zeros_like(action[0, ..., 0])
    position = (2 * action - (high + low)) / (high - low)
    return (position.abs() > SATURATED).to(action.dtype).mean((0, -1))


def _blank(entry: Tensor, where: Tensor) -> Tensor:
    """0 in these places, and True in a mask, as that of the actions that may be taken."""
    where = where.reshape(*where.shape, *(1,) * (entry.ndim - where.ndim))
    return entry.masked_fill(where, entry.dtype == torch.bool)


def _written(outputs: TensorDictBase, name: str, key: NestedKey, network: Any) -> Tensor:
    """What a network has written."""
    value = outputs.get(key, None)
    if value is None:
        raise KeyError(
            f"The network writes {list(network.out_keys)}, not {key!r}, its {name}: build it with "
            f"that out_key, or name another with set_keys({name}=...)."
        )
    return value


def _squeezed(qvalues: Tensor) -> Tensor:
    """Without the trailing dimension of 1."""
    if qvalues.shape[-1] != 1:
        raise ValueError(
            f"A soft Q value is one number, [*B, 1], but the Q network writes {qvalues.shape[-1]}."
        )
    return qvalues.squeeze(-1)
