"""The actor-critic loss: it lifts a policy by its soft Q, and a member says how to project."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torch.distributions import Distribution
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator, distance_loss
from torchrl.objectives.value import TD0Estimator, TD1Estimator, TDLambdaEstimator
from torchrl.objectives.value.advantages import ValueEstimatorBase

from torchrl_ecpo._torchrl import holding, time_dim_of
from torchrl_ecpo.checks import (
    UNREADABLE,
    as_float,
    check_choice,
    check_count,
    check_flag,
    check_network,
    check_real,
    get_entry,
    unreadable,
    values_can_be_seen,
)
from torchrl_ecpo.functional import (
    Surrogate,
    effective_sample_size,
    self_normalised_weights,
    widened,
)
from torchrl_ecpo.objectives._base import PolicyLoss, Reduction
from torchrl_ecpo.objectives.actions import (
    Actions,
    AllActions,
    SampledActions,
    actions_of,
    check_policy,
    is_discrete,
)

LOSS_FUNCTIONS = ("l2", "l1", "smooth_l1")
SATURATED = 0.95
ESTIMATORS: tuple[type, ...] = (TD0Estimator, TD1Estimator, TDLambdaEstimator)


class Lift(NamedTuple):
    """The lifted policy at each state, on the actions that stand for it; without gradients.

    Examples:
        >>> from torch.distributions import Categorical
        >>> actions = AllActions.of(Categorical(logits=torch.zeros(2, 3)))  # 3 actions at 2 states
        >>> score = torch.tensor([0.0, 0.0, 1.0]).expand(2, 3).T
        >>> log_weights, value = actions.lift(score, torch.tensor(0.1), torch.tensor(0.1))
        >>> lift = Lift(actions, score, log_weights, log_weights.softmax(0), value)
        >>> lift.weights.argmax(0).tolist()
        [2, 2]
    """

    actions: Actions
    """Those of the reference policy."""
    score: Tensor
    """``[M, *B]``, the least of the soft Q values of each action."""
    log_weights: Tensor
    """``[M, *B]``, log-weight of the target, relative to whatever proposed the actions."""
    weights: Tensor
    """``[M, *B]``, :attr:`log_weights` normalised."""
    value: Tensor
    """``[*B]``, the value of the state."""
    slope: Tensor | None = None
    """``[M, *B, A]``, gradient by the latents of the score, and of tau' times the log-volume."""


@dataclass(eq=False)
class States:
    """What a member is given: the states ``[*B]`` at which the policy learns.

    Examples:
        >>> from tensordict import TensorDict
        >>> from torch.distributions import Categorical
        >>> policy = Categorical(logits=torch.zeros(2, 3))
        >>> States(TensorDict({}, [2]), policy, policy, lambda *_: "made once").lift
        'made once'
    """

    observations: TensorDictBase
    """What the networks read there."""
    policy: Distribution
    """The policy being trained; carries the gradient."""
    reference: Distribution
    """The policy that is lifted, a delayed copy or the policy itself."""
    make_lift: Callable[[TensorDictBase, Distribution], Lift]
    mask: Tensor | None = None
    """``[*B]``, True where a state is real; None: all are."""
    made: Lift | None = None

    @property
    def lift(self) -> Lift:
        """The lift of the reference; made where it is first asked for, and once."""
        if self.made is None:
            self.made = self.make_lift(self.observations, self.reference)
        return self.made


class ActorCriticLoss(PolicyLoss):
    """Base class of the actor-critic losses: lift the reference policy by soft Q, and project.

    A member implements :meth:`project`, and declares in :attr:`losses` and :attr:`metrics` what
    else that returns. Where the policy is over one of n actions, all of them are looked at; where
    it is not, M samples of it are.

    The arguments are documented where users meet them: :class:`~torchrl_ecpo.ECACLoss`.

    Raises:
        ValueError: as :class:`~torchrl_ecpo.ECACLoss`.

    Examples:
        ECAC by Eq. 11, without its options:

        >>> from torchrl.data import Bounded
        >>> from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
        >>> class PlainECACLoss(ActorCriticLoss):
        ...     def project(self, states):
        ...         lift = states.lift
        ...         log_prob = lift.actions.log_prob_of(states.policy)
        ...         return Surrogate(-(lift.weights * log_prob).sum(0), lift.weights)
        >>> actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
        >>> PlainECACLoss(actor, make_qvalue_network(3, 2)).out_keys[:2]
        ['loss_actor', 'loss_qvalue']
    """

    takes_choices_only: ClassVar[bool] = False
    """Whether the policy must be over one of n actions."""
    target_entropy_weight: float = 0.98
    """Of log n, the part that ``target_entropy="auto"`` asks of a policy over n actions."""
    has_soft_value: ClassVar[bool] = True
    """Whether a state is worth its soft value (Eq. 8), or else the reference's mean of Q."""

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
            state_action_value: written by a Q network that reads the action. Defaults to
                ``"state_action_value"``.
            action_value: written by a Q network of all actions. Defaults to ``"action_value"``.
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

    qvalue_network: Any
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams
    value_network: TensorDictModule | None
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        tau: float = 0.3,
        tau_prime: float = 1.0,
        target_kl: float | None = 0.083,
        target_entropy: float | Literal["auto"] | None = "auto",
        min_tau: float = 0.001,
        min_tau_prime: float = 0.003,
        num_qvalue_nets: int = 2,
        num_actor_states: int | None = None,
        num_action_samples: int = 8,
        num_next_action_samples: int = 1,
        loss_function: Literal["l2", "l1", "smooth_l1"] = "l2",
        delay_actor: bool = False,
        delay_qvalue: bool | None = None,
        reduction: Literal["none", "mean", "sum"] | None = None,
        skip_done_states: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
    ) -> None:
        super().__init__(
            actor_network,
            delay_actor=delay_actor,
            reduction=reduction,
            temperatures={"tau": tau, "tau_prime": tau_prime},
        )
        check_choice("loss_function", loss_function, LOSS_FUNCTIONS)
        self.num_qvalue_nets = check_count("num_qvalue_nets", num_qvalue_nets)
        self.num_action_samples = check_count("num_action_samples", num_action_samples)
        samples = check_count("num_next_action_samples", num_next_action_samples)
        self.num_next_action_samples = samples
        if num_actor_states is not None:
            num_actor_states = check_count("num_actor_states", num_actor_states)
            if self.reduction == "none":
                raise ValueError(
                    "num_actor_states must be None with reduction='none', where each state has its "
                    f"number; got {num_actor_states}."
                )
        check_flag("delay_qvalue", delay_qvalue, None)
        if value_network is not None and delay_qvalue:
            raise ValueError(
                "With a value_network the value of the next state comes from its delayed copy: "
                f"leave delay_qvalue=None, got {delay_qvalue}."
            )
        self.min_tau = as_float("min_tau", min_tau)
        self.min_tau_prime = as_float("min_tau_prime", min_tau_prime)
        self.num_actor_states = num_actor_states
        self.loss_function = loss_function
        self.skip_done_states = check_flag("skip_done_states", skip_done_states)
        self.use_prioritized_weights = check_flag(
            "use_prioritized_weights", use_prioritized_weights, "auto"
        )
        self.delay_qvalue = value_network is None if delay_qvalue is None else delay_qvalue
        self._add_critics(qvalue_network, num_qvalue_nets, value_network)
        self._set_constraints(target_kl, target_entropy)
        if target_kl is not None:
            self.learn("tau", float(tau), floor=self.min_tau, instead="target_kl")
        if target_entropy is not None:
            floor, instead = self.min_tau_prime, "target_entropy"
            self.learn("tau_prime", float(tau_prime), floor=floor, instead=instead)
        self.make_value_estimator(device=self._device)
        action_keys = getattr(actor_network, "dist_sample_keys", None)
        if action_keys:
            self.set_keys(action=action_keys[0])
        self._check_policy(actor_network)
        self._check_names()

    def _add_critics(
        self,
        qvalue_network: Any,
        num_qvalue_nets: int,
        value_network: TensorDictModule | None,
    ) -> None:
        is_list = isinstance(qvalue_network, (list, tuple))
        for network in qvalue_network if is_list else [qvalue_network]:
            check_network("qvalue_network", network)
        if is_list:
            different = len({id(network) for network in qvalue_network})
            if not 2 <= different == len(qvalue_network) == num_qvalue_nets:
                # TorchRL takes one network, or the same one twice, for one that is not trained.
                raise ValueError(
                    f"A list as qvalue_network must hold num_qvalue_nets={num_qvalue_nets} "
                    f"different ones, at least 2, got {different} in {len(qvalue_network)}. A "
                    "network by itself, without a list, is copied and drawn anew for each."
                )
        if value_network is None:
            self.value_network = None
        else:
            check_network("value_network", value_network)
            self.convert_to_functional(value_network, "value_network", create_target_params=True)
        self.convert_to_functional(
            qvalue_network,  # pyright: ignore[reportArgumentType] - a list is allowed
            "qvalue_network",
            num_qvalue_nets,
            create_target_params=self.delay_qvalue,
        )

    def _set_constraints(self, target_kl: float | None, target_entropy: float | str | None) -> None:
        if isinstance(target_entropy, str):
            check_choice("target_entropy", target_entropy, ("auto",))
        elif target_entropy is not None:
            target_entropy = as_float("target_entropy", target_entropy)
            if not math.isfinite(target_entropy):
                raise ValueError(
                    f'target_entropy must be finite, in nats, "auto" or None, got {target_entropy}.'
                )
        if target_kl is not None:
            target_kl = as_float("target_kl", target_kl)
            if not 0 < target_kl < math.inf:
                raise ValueError(f"target_kl must be above 0, in nats, or None, got {target_kl}.")
        self.target_kl, self.target_entropy = target_kl, target_entropy
        self._reachable: float | str | None = None  # the last target_entropy that was looked at

    # ------------------------------------------------------------------------------- one method

    @abstractmethod
    def project(self, states: States) -> Surrogate:
        """How far the policy is from its target at each state ``[*B]``, up to a constant (Eq. 11).

        The weights are those of the lift, ``[M, *B]``. Further losses and metrics, ``[*B]`` or
        0-d, have the names that :attr:`losses` and :attr:`metrics` declare. A metric
        ``kl_target_reference`` stands for the estimate from the weights, and tau is learned by it.
        """

    # The rewards tell the batch size: entries of a single number each would be taken for a batch.
    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute all losses of a batch of transitions ``[*B]``.

        Args:
            tensordict: with the entries of :attr:`in_keys`; the priority is written into it,
                unless it is locked and has none.

        Returns:
            The entries of :attr:`out_keys`, losses and, detached, metrics; with
            ``reduction="none"`` each has the shape of the batch.
        """
        transitions, mask = self._read(tensordict)
        weights = self._priority_weights(transitions, mask)
        try:
            outputs, td_error = self._outputs(transitions, mask, weights)
        except (*UNREADABLE, ValueError) as error:
            if values_can_be_seen():
                self._explain(error, transitions)
            raise
        priority = td_error if mask is None else td_error.where(mask, 0.0)
        key = self.tensor_keys.priority
        if not tensordict.is_locked:
            tensordict.set(key, priority)
        elif (entry := tensordict.get(key, None)) is not None:
            if entry.numel() != priority.numel():
                raise ValueError(
                    f"The locked batch has room for {list(entry.shape)} priorities {key!r}, which "
                    f"are {list(priority.shape)}: leave it out, or unlock the batch."
                )
            tensordict.set_(key, priority.reshape(entry.shape))
        return self._selected(outputs, transitions.shape)

    def _outputs(
        self, transitions: TensorDictBase, mask: Tensor | None, weights: Tensor | None
    ) -> tuple[dict[str, Tensor], Tensor]:
        """All outputs, checked, and the temporal difference error ``[*B]``."""
        target = self.soft_bellman_target(transitions, mask)
        inputs = transitions.select(*self.qvalue_network.in_keys)
        qvalues = self._qvalues(inputs, self.qvalue_network_params)
        qvalue = self._chosen_qvalue(qvalues, transitions, mask)
        td_error = (qvalue.detach() - target).abs().amax(0)
        errors = distance_loss(qvalue, target.expand_as(qvalue), self.loss_function)  # Eq. 10
        states = self.states(transitions, mask)
        if not self._reads_action:  # the network has valued all actions: it is not asked twice
            first = qvalues.detach()[:, : self.num_actor_states]
            states.make_lift = lambda observations, reference: self.lift(
                observations, reference, first
            )
        surrogate = self.project(states)
        own = {name: x for name, x in surrogate.metrics.items() if name != "kl_target_reference"}
        self._check_declared(surrogate.losses, own)
        lift = states.lift
        of_all = Reduction(self.reduction, target.shape, mask, weights)
        of_states = of_all.first(self.num_actor_states)
        losses = {"loss_actor": surrogate.loss, **surrogate.losses}
        if self.value_network is not None:  # Eq. 9
            value = self._state_value(states.observations, self.value_network_params)
            losses["loss_value"] = distance_loss(value, lift.value, self.loss_function)
        with torch.no_grad():
            metrics = self._metrics(states, surrogate)
        losses |= self._temperature_losses(states, metrics, of_states)
        outputs = {
            "loss_qvalue": of_all.loss(errors.sum(0)),
            **{name: of_states.loss(loss) for name, loss in losses.items()},
        }
        source = f"computed from {self._reward_key!r} and Q"
        action = transitions.get(self.tensor_keys.action)
        self._check_values(
            {
                f"entry {self.tensor_keys.action!r}": action,
                "target of the soft Q value": target,
                "soft Q value": lift.score,
                "log-probability of the reference policy": lift.actions.log_prob,
                "temporal difference error": td_error,
                "loss of the policy": surrogate.loss,
                **{f"{name}, {source},": loss for name, loss in outputs.items()},
            }
        )
        metrics["tau"], metrics["tau_prime"] = self.temperatures()
        outputs |= {name: of_states.metric(value) for name, value in metrics.items()}
        return outputs, td_error

    # ---------------------------------------------------------------------------------- the lift

    def lift(
        self,
        observations: TensorDictBase,
        reference: Distribution,
        qvalue_params: TensorDictParams | Tensor | None = None,
        num_samples: int | None = None,
    ) -> Lift:
        """Lift the reference policy at each state ``[*B]``: Eq. 8, by samples or over all actions.

        Args:
            observations: what the Q network reads beside the action.
            reference: the policy at these states.
            qvalue_params: of the Q networks; those that are trained by default. Or the values
                ``[N, *B, n]`` of all n actions, where they are known.
            num_samples: M; ``num_action_samples`` by default.
        """
        number = self.num_action_samples if num_samples is None else num_samples
        params = self.qvalue_network_params if qvalue_params is None else qvalue_params
        with torch.no_grad():
            actions = actions_of(reference, number)
            return self.lifted(actions, self.score_of(observations, actions, params))

    def lifted(self, actions: Actions, score: Tensor, slope: Tensor | None = None) -> Lift:
        """The lift, of actions that have been valued."""
        if actions.log_prob.shape != score.shape:
            raise ValueError(
                f"The soft Q values of the actions have the shape {tuple(score.shape)}, their "
                f"log-probabilities {tuple(actions.log_prob.shape)}: actor and Q network must "
                "know the same actions, and an action of several numbers has one "
                "log-probability, as with torch.distributions.Independent or TanhNormal."
            )
        actions = actions._replace(log_prob=widened(actions.log_prob))
        log_weights, value = actions.lift(score, *self.temperatures())
        weights = self_normalised_weights(log_weights, sample_dim=0)
        if not self.has_soft_value:
            value = actions.mean(score)
        return Lift(actions, score, log_weights, weights, value, slope)

    def score_of(
        self,
        observations: TensorDictBase,
        actions: Actions,
        qvalue_params: TensorDictParams | Tensor,
    ) -> Tensor:
        """The least of the soft Q values ``[M, *B]`` of actions at each state ``[*B]``.

        The arguments are those of :meth:`lift`.
        """
        self._check_kind(isinstance(actions, AllActions))
        observations = observations.select(*self._qvalue_observations)
        if not isinstance(actions, SampledActions):
            return self._qvalues(observations, qvalue_params).amin(0).movedim(-1, 0)
        shape = actions.action.shape[:-1]
        # Samples become more rows, not more steps, which a recurrent network would tell apart. What
        # has `each` keeps them apart from the states, which it need not read once for each sample.
        rows = shape if self._knows_each else (-1, *shape[2:])
        inputs = observations.expand(shape).reshape(rows)
        inputs.set(self.tensor_keys.action, actions.action.reshape(*rows, actions.action.shape[-1]))
        return self._qvalues(inputs, qvalue_params).amin(0).reshape(shape)

    def states(self, transitions: Any, mask: Tensor | None = None) -> States:
        """Where the policy learns, the policy, and the reference: its delayed copy, or itself.

        The mask ``[*B]`` is True where a transition is real; None: all are.
        """
        if self.num_actor_states is not None:
            if not transitions.ndim:
                raise ValueError(
                    f"num_actor_states={self.num_actor_states} takes the first of a batch, but "
                    "this is one transition, without a batch dimension: build the loss with "
                    "num_actor_states=None."
                )
            transitions = transitions[: self.num_actor_states]
            mask = None if mask is None else mask[: self.num_actor_states]
        policy = reference = self._distribution(transitions, self.actor_network_params)
        if self.delay_actor:
            with torch.no_grad():
                reference = self._distribution(transitions, self.target_actor_network_params)
        return States(transitions, policy, reference, self.lift, mask)

    def _distribution(self, tensordict: TensorDictBase, params: TensorDictParams) -> Distribution:
        inputs = tensordict.select(*self.actor_network.in_keys)
        with (
            set_exploration_type(ExplorationType.RANDOM),
            holding(self.actor_network, params),
        ):
            return self.actor_network.get_dist(inputs)

    def _temperature_losses(
        self, states: States, metrics: Mapping[str, Tensor], reduction: Reduction
    ) -> dict[str, Tensor]:
        losses, actions = {}, states.lift.actions
        if self.target_kl is not None:
            bound = actions.divergence_bound(self.target_kl)
            excess = ((reduction.mean(metrics["kl_target_reference"]) - bound) / bound).clamp(-1, 1)
            losses["loss_tau"] = self.dual("tau", excess.expand(reduction.shape), states.mask)
        if self.target_entropy is not None:
            if self.target_entropy != self._reachable and values_can_be_seen():
                self._check_target_entropy(actions, states.reference, reduction)
            excess = self._entropy_asked_for(actions) - metrics["entropy"]
            losses["loss_tau_prime"] = self.dual("tau_prime", excess, states.mask)
        return losses

    # ------------------------------------------------------------------------------- the critics

    def soft_bellman_target(self, tensordict: TensorDictBase, mask: Tensor | None = None) -> Tensor:
        """The target of soft Q, ``[*B]``: r + gamma V(s') of Eq. 10, by the value estimator.

        Args:
            tensordict: the transitions ``[*B]``.
            mask: ``[*B]``, True where a transition is real; None: all are.
        """
        with torch.no_grad():
            next_tensordict = tensordict.get("next")
            ended = self._ended(next_tensordict)
            value = self._next_state_value(next_tensordict, ended.squeeze(-1))
            # Nothing is to come, whatever stands there: NaN times 0 would be NaN.
            value = value.unsqueeze(-1).masked_fill(ended, 0.0)
            valued = tensordict.copy()
            valued.set(unravel_key(("next", self.tensor_keys.value)), value)
            if mask is not None and mask.ndim:
                averages = getattr(self.value_estimator, "average_rewards", False)
                if averages and not (values_can_be_seen() and mask.all()):
                    raise ValueError(
                        "A value estimator with average_rewards=True counts the rewards that a "
                        "mask leaves out too. Leave out average_rewards, or the masked transitions."
                    )
                # What is not real follows on nothing: TD(1) and TD(lambda) look no further.
                time = time_dim_of(self.value_estimator, valued)
                is_followed = (mask & mask.roll(-1, time)).unsqueeze(-1)
                done = unravel_key(("next", self.tensor_keys.done))
                valued.set(done, tensordict.get(done) | ~is_followed)
            return self.value_estimator.value_estimate(valued).squeeze(-1)

    def _ended(self, next_tensordict: TensorDictBase) -> Tensor:
        """Where nothing is to come, ``[*B, 1]``."""
        keys = self.tensor_keys
        return next_tensordict.get(keys.done if self.skip_done_states else keys.terminated)

    def _next_state_value(self, tensordict: TensorDictBase, ended: Tensor) -> Tensor:
        """V(s') ``[*B]`` of the delayed value network, or from delayed Q and the reference."""
        # Distributions refuse NaN, also where nothing comes of it.
        observations: Any = tensordict.select(*self._next_observations)
        # With a batch size also a lazy stack is taken as a whole, as `ended` is.
        observations = observations.apply(
            lambda x: _blank(x, ended, only_strange=not self.skip_done_states),
            batch_size=observations.batch_size,
        )
        if self.value_network is not None:
            return self._state_value(observations, self.target_value_network_params)
        params = self.target_actor_network_params if self.delay_actor else self.actor_network_params
        policy = self._distribution(observations, params)
        number, critics = self.num_next_action_samples, self.target_qvalue_network_params
        return self.lift(observations, policy, critics, number).value

    def _chosen_qvalue(
        self, qvalues: Tensor, tensordict: TensorDictBase, mask: Tensor | None
    ) -> Tensor:
        """Soft Q ``[N, *B]`` of the actions that were taken."""
        if self._reads_action:
            return qvalues
        action = tensordict.get(self.tensor_keys.action)
        no_index = action.is_floating_point() or action.dtype == torch.bool
        is_index = qvalues.shape[-1] == 1 and not no_index  # of the one action
        if action.shape == qvalues.shape[1:] and not is_index:
            is_one = action == 1
            is_strange = (is_one.sum(-1) != 1) | (is_one != (action != 0)).any(-1)
            self._check_action(is_strange, mask, qvalues)
            return (qvalues * action).sum(-1)
        if action.shape == (*qvalues.shape[1:-1], 1):
            action = action.squeeze(-1)
        if action.shape != qvalues.shape[1:-1] or no_index:
            raise ValueError(
                f"The action {self.tensor_keys.action!r} must be one-hot of shape "
                f"{tuple(qvalues.shape[1:])} or an integer of shape {tuple(qvalues.shape[1:-1])}, "
                f"got {action.dtype} of shape {tuple(action.shape)}."
            )
        self._check_action((action < 0) | (action >= qvalues.shape[-1]), mask, qvalues)
        index = action.long().unsqueeze(-1).expand(*qvalues.shape[:-1], 1)
        return qvalues.gather(-1, index).squeeze(-1)

    def _check_action(self, is_strange: Tensor, mask: Tensor | None, qvalues: Tensor) -> None:
        is_strange = is_strange if mask is None else is_strange & mask
        if values_can_be_seen() and is_strange.any():
            number = qvalues.shape[-1]
            raise ValueError(
                f"The action {self.tensor_keys.action!r} must be one of the {number} that the Q "
                f"network values, 0 to {number - 1}, or one-hot with a single 1; "
                f"{int(is_strange.sum())} of {is_strange.numel()} are not."
            )

    def _qvalues(self, inputs: TensorDictBase, params: TensorDictParams | Tensor) -> Tensor:
        """Soft Q of each of the N networks: ``[N, *B]``, or of all actions, ``[N, *B, n]``.

        In single precision at least: half has no room for what is squared, or divided by a small
        tau + tau'.
        """
        if isinstance(params, Tensor):  # which are known
            return params
        network = self.qvalue_network
        name = "state_action_value" if self._reads_action else "action_value"
        key = getattr(self.tensor_keys, name)
        if self._knows_each:
            qvalues = _written(network.each(inputs, params), name, key, network)
        else:
            outputs = []
            for each in params.unbind(0):
                with holding(network, each):
                    outputs.append(_written(network(inputs.copy()), name, key, network))
            qvalues = torch.stack(outputs)
        qvalues = widened(qvalues)
        if not self._reads_action:
            return qvalues
        if qvalues.shape[-1] != 1:
            raise ValueError(
                "A soft Q value is one number, [*B, 1], but the Q network writes "
                f"{qvalues.shape[-1]}."
            )
        return qvalues.squeeze(-1)

    def _state_value(self, observations: TensorDictBase, params: TensorDictParams) -> Tensor:
        """V ``[*B]`` of the value network."""
        network = self.value_network
        assert network is not None
        observations = observations.select(*network.in_keys)
        with holding(network, params):
            outputs = network(observations)
        return widened(_written(outputs, "value", self.tensor_keys.value, network).squeeze(-1))

    @property
    def _knows_each(self) -> bool:
        """Whether the Q network knows a faster way of its own (not what it wraps: DenseNetwork)."""
        return hasattr(type(self.qvalue_network), "each")

    @property
    def _reads_action(self) -> bool:
        """Whether the Q network values one action, which it reads; else it values all."""
        return self.tensor_keys.action in self.qvalue_network.in_keys

    @property
    def _qvalue_observations(self) -> list[NestedKey]:
        """What the Q network reads beside the action."""
        return [key for key in self.qvalue_network.in_keys if key != self.tensor_keys.action]

    @property
    def _next_observations(self) -> list[NestedKey]:
        """What the value of the next state is computed from."""
        if self.value_network is not None:
            return self.value_network.in_keys
        return [*self.actor_network.in_keys, *self._qvalue_observations]

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
            ValueError: for an estimator with a value network, hyperparameters beside one that is
                made, and a ``gamma`` or ``lmbda`` that is not in [0, 1].
        """
        for name in ("gamma", "lmbda"):
            if name in hyperparams:
                hyperparams[name] = as_float(name, hyperparams[name], "[0, 1]")
        value_type = self.default_value_estimator if value_type is None else value_type
        network, name = hyperparams.get("value_network"), str(value_type)
        if is_named := isinstance(value_type, (ValueEstimators, str)):
            hyperparams["value_network"] = network
        else:
            kind = value_type if isinstance(value_type, type) else type(value_type)
            name = kind.__name__
            if not issubclass(kind, ESTIMATORS):
                takes = ", ".join(estimator.__name__ for estimator in ESTIMATORS)
                raise NotImplementedError(
                    f"{name} is not implemented for {type(self).__name__}, which takes {takes}."
                )
            if isinstance(value_type, kind):
                network = value_type.value_network
                if hyperparams:
                    raise ValueError(f"A {name} that is made has its own {sorted(hyperparams)}.")
        if network is not None:
            raise ValueError(
                f"The {name} must have value_network=None: the loss itself computes the soft value "
                "of the next state."
            )
        if is_named:
            supported = self.SUPPORTED_VALUE_ESTIMATORS
            dispatch_value_estimator(self, value_type, supported=supported, **hyperparams)
        else:
            super().make_value_estimator(value_type, **hyperparams)  # pyright: ignore
        self._forward_value_estimator_keys()
        return self

    # ---------------------------------------------------------------------------------- reporting

    def _metrics(self, states: States, surrogate: Surrogate) -> dict[str, Tensor]:
        lift, actions = states.lift, states.lift.actions
        moved = torch.zeros_like(lift.value)
        if states.policy is not states.reference:
            moved = actions.mean(actions.log_prob - actions.log_prob_of(states.policy))
        weights = lift.weights if surrogate.weights is None else surrogate.weights
        metrics = {
            "ESS": effective_sample_size(weights, sample_dim=0),
            "kl_target_reference": actions.divergence_of(lift.weights, lift.log_weights),
            "kl_reference_policy": moved,
            "entropy": actions.mean(-actions.log_prob),
            "qvalue": actions.mean(lift.score),
            "state_value": lift.value,
            **surrogate.metrics,
        }
        if isinstance(actions, SampledActions):
            metrics["saturation"] = _saturation(actions.action, states.reference)
        return metrics

    # --------------------------------------------------------------------------------------- keys

    @property
    def _all_in_keys(self) -> list[NestedKey]:
        keys = self.tensor_keys
        following = [keys.reward, keys.done, keys.terminated, *self._next_observations]
        return [
            keys.action,
            *self.actor_network.in_keys,
            *self.qvalue_network.in_keys,
            *(() if self.value_network is None else self.value_network.in_keys),
            *(unravel_key(("next", key)) for key in following),
        ]

    @property
    def _all_out_keys(self) -> list[Any]:
        of_value = () if self.value_network is None else ("loss_value",)
        of_tau = () if self.target_kl is None else ("loss_tau",)
        of_tau_prime = () if self.target_entropy is None else ("loss_tau_prime",)
        losses = ["loss_actor", "loss_qvalue", *of_value, *of_tau, *of_tau_prime, *self.losses]
        metrics = ["ESS", "kl_target_reference", "kl_reference_policy", "entropy"]
        metrics += ["saturation"] if self._reads_action else []
        return [*losses, *metrics, "qvalue", "state_value", *self.metrics, "tau", "tau_prime"]

    # ----------------------------------------------------------------------------------- reading

    def _read(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, Tensor | None]:
        """The transitions ``[*B]``, and the mask of the real ones where there is one.

        Those that are not real are blank: the gradient of NaN is NaN, also of one that counts 0.
        """
        for key in self.in_keys:
            get_entry(tensordict, key)
        shape = self._batch_shape(tensordict)
        mask = self._mask(tensordict, shape)
        for key in self._all_in_keys if tensordict.shape != shape else ():
            entry = tensordict.get(key)
            if entry.shape[: len(shape)] != shape:
                raise ValueError(
                    f"The entry {key!r} must begin with the shape {list(shape)} of the reward "
                    f"without its trailing 1, got {list(entry.shape)}."
                )
        if mask is None and tensordict.shape == shape:
            return tensordict, None

        def only_real(entry: Tensor) -> Tensor:
            return entry if mask is None else _blank(entry, ~mask)

        several_steps = self.value_estimator.tensor_keys.steps_to_next_obs
        further = (self.tensor_keys.priority_weight, several_steps)
        read = tensordict.select(*self._all_in_keys, *further, strict=False)
        names = read.names if read.shape == shape else None  # which may tell where time is
        transitions: Any = read.apply(only_real, batch_size=shape, names=names)
        return transitions, mask

    def _priority_weights(self, tensordict: TensorDictBase, mask: Tensor | None) -> Tensor | None:
        key = self.tensor_keys.priority_weight
        if not self.use_prioritized_weights or key not in tensordict.keys(True):
            return None
        weights, shape = get_entry(tensordict, key), tensordict.shape
        check_real(key, weights)
        if weights.shape not in (shape, (*shape, 1)):
            raise ValueError(
                f"The entry {key!r} must have the shape {list(shape)} of the batch, got "
                f"{list(weights.shape)}."
            )
        weights = weights.reshape(shape)
        weights = weights if mask is None else weights.where(mask, 0.0)
        if values_can_be_seen():
            strange = ~((weights >= 0) & (weights < math.inf))
            if strange.any():
                raise ValueError(
                    f"The entry {key!r} must be finite and at least 0, got "
                    f"{weights[strange][0]:.3g} and the like in {int(strange.sum())} of "
                    f"{strange.numel()} places."
                )
        return weights

    def _batch_shape(self, tensordict: TensorDictBase) -> torch.Size:
        """[*B] of a batch, from its rewards."""
        reward = tensordict.get(self._reward_key)
        shape = reward.shape
        if shape[-1:] != (1,) or not shape.numel() or reward.is_complex():
            raise ValueError(
                f"The reward {self._reward_key!r} must be real and have the shape [*B, 1], of one "
                f"transition at least, got {reward.dtype} of shape {tuple(shape)}."
            )
        for name in ("done", "terminated"):
            key = unravel_key(("next", getattr(self.tensor_keys, name)))
            flag = tensordict.get(key)
            if flag.shape != shape or flag.dtype != torch.bool:
                raise ValueError(
                    f"The entry {key!r} must be boolean and have the shape {tuple(shape)} of the "
                    f"reward, got {flag.dtype} of shape {tuple(flag.shape)}."
                )
        return shape[:-1]

    # ----------------------------------------------------------------------------- bad input

    def _check_policy(self, actor_network: ProbabilisticTensorDictSequential) -> None:
        """Refuse at the door what the class of the distribution tells, if the actor names it."""
        for module in reversed(list(actor_network.modules())):
            kind = getattr(module, "distribution_class", None)
            if isinstance(kind, type):
                check_policy(kind)
                self._check_kind(is_discrete(kind))
                return

    def _check_target_entropy(
        self, actions: Actions, reference: Distribution, reduction: Reduction
    ) -> None:
        """Refuse what no policy can have at these states; once, since masks differ by batch."""
        target = self.target_entropy
        is_empty = reduction.mask is not None and not reduction.mask.any()
        if target is None or is_empty or (target == "auto" and not self._reads_action):
            return  # "auto" follows the mask
        value, (low, high) = self._entropy_asked_for(actions), actions.entropy_range(reference)
        bound = float(reduction.mean(high))
        if not low < value < bound:
            raise ValueError(
                f"target_entropy={target!r} asks for {value:.3g} nats, which no policy has at "
                f"these states: their actions leave {low:.3g} to {bound:.3g}. Lower or raise it."
            )
        self._reachable = target

    def _entropy_asked_for(self, actions: Actions) -> Any:
        if self.target_entropy != "auto":
            return self.target_entropy
        auto = actions.auto_entropy()
        return auto if self._reads_action else self.target_entropy_weight * auto

    def _explain(self, error: Exception, transitions: TensorDictBase) -> None:
        """Name the entry, or the parameter, that an error comes from, if there is one."""
        ended = self._ended(transitions.get("next")).squeeze(-1)
        entries = {key: transitions.get(key) for key in dict.fromkeys(self._all_in_keys)}
        values = dict(entries)
        for key in map(unravel_key, (("next", key) for key in self._next_observations)):
            values[key] = _blank(values[key], ended)  # is not looked at after the end
        quantities = {f"entry {key!r}": value for key, value in values.items()}
        self._check_values(quantities | dict(self.named_parameters()) | dict(self.named_buffers()))
        if not isinstance(error, (ValueError, KeyError)):  # ours, which name what they mean
            raise unreadable("loss", transitions, list(entries), error) from error

    def _check_kind(self, is_discrete: bool) -> None:
        if self.takes_choices_only and not is_discrete:
            name = type(self).__name__
            raise ValueError(
                f"{name} is for policies over one of n actions (Categorical, OneHotCategorical): "
                f"for others take {name.removeprefix('Discrete')}."
            )
        if is_discrete == self._reads_action:
            network = self.qvalue_network
            policy = "one of n actions (Categorical)" if is_discrete else "actions with rsample"
            action = self.tensor_keys.action
            raise ValueError(
                f"For a policy over {policy} qvalue_network must "
                + (
                    f"write the values of all, and not read the action {action!r}"
                    if is_discrete
                    else f"read the action {action!r}"
                )
                + f"; its in_keys are {network.in_keys}."
            )


def _saturation(action: Tensor, policy: Distribution) -> Tensor:
    """Share ``[*B]`` of action components in the outer 5 % of their range; 0 without a range."""
    low, high = getattr(policy, "low", None), getattr(policy, "high", None)
    if low is None or high is None:
        return torch.zeros_like(action[0, ..., 0])
    position = (2 * action - (high + low)) / (high - low)
    return (position.abs() > SATURATED).to(action.dtype).mean((0, -1))


def _blank(entry: Tensor, where: Tensor, *, only_strange: bool = False) -> Tensor:
    """0 in these places, and True in a mask of actions; or only what no network could read there.

    That is what is NaN or infinite, and all integers: one may be no token, and nothing tells.
    """
    where = where.reshape(*where.shape, *(1,) * (entry.ndim - where.ndim))
    if only_strange and (entry.is_floating_point() or entry.dtype == torch.bool):
        where = where & ~entry.isfinite()
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
