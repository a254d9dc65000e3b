"""What every loss over groups of trajectories shares: reading, checking, reducing, reporting."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import (
    LazyStackedTensorDict,
    TensorDictBase,
    TensorDictParams,
    is_tensor_collection,
)
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    TensorDictSequential,
    composite_lp_aggregate,
    dispatch,
)
from tensordict.nn import ProbabilisticTensorDictModule as _Head
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torchrl.modules import MaskedOneHotCategorical, OneHotCategorical

from torchrl_ecpo._torchrl import holding
from torchrl_ecpo.checks import (
    UNREADABLE,
    check_choice,
    check_group_size,
    check_integers,
    check_padding,
    check_real,
    get_entry,
    unreadable,
    values_can_be_seen,
)
from torchrl_ecpo.functional import (
    Surrogate,
    effective_sample_size,
    lifted_log_weights,
    self_normalised_weights,
    standardised,
    standardised_in_batch,
    uniform_weights,
    widened,
)
from torchrl_ecpo.groups import DONE_KEY, GROUP_KEY
from torchrl_ecpo.llm.completions import check_actor, is_language_model, read_completions
from torchrl_ecpo.modules.distinct import take_rows
from torchrl_ecpo.modules.latents import (
    is_lost,
    latent_key,
    latent_of,
    log_prob_of_latent,
    may_squash,
    parts_of,
    split,
)
from torchrl_ecpo.objectives._base import PolicyLoss, Reduction

SCORES = {
    "return": lambda returns, mask: returns,
    "group": standardised,
    "batch": standardised_in_batch,
}
Score = Literal["return", "group", "batch"]
SPAN_KEY = "steps_to_next_obs"
ONE_HOT = (OneHotCategorical, MaskedOneHotCategorical)
OF_WEIGHTS = ("ESS", "max_weight")
OF_GROUPS = ("kl_reference_policy", "entropy", "return", "equal_return_groups")


class Steps(NamedTuple):
    """The steps of the trajectories: numbers are ``[*G, K, T]``, 0 in padded steps.

    Examples:
        >>> steps = Steps(*torch.zeros(4, 2, 3, 5), mask=None)  # [*G, K, T]
        >>> steps.rewards.sum(-1).shape
        torch.Size([2, 3])
    """

    rewards: Tensor
    log_prob: Tensor
    """log pi_theta(a_t | s_t), under the policy being trained; carries the gradient."""
    reference_log_prob: Tensor
    """log pi_bar(a_t | s_t), under the reference policy."""
    behaviour_log_prob: Tensor
    """log beta(a_t | s_t), under the policy that drew the trajectories."""
    mask: Tensor | None
    """True where the step is real; None where all are."""
    inputs: TensorDictBase | None = None
    """What networks read, ``[N, T]`` with the N trajectories of all groups in one row; a padded
    step is a copy of the last real one. Copy it before a network writes into it."""


class TrajectoryGroups(NamedTuple):
    """Groups of K trajectories: sums over the real steps, ``[*G, K]``, and the steps themselves.

    Examples:
        >>> steps = Steps(*torch.zeros(4, 2, 3, 5), mask=None)  # [*G, K, T]
        >>> sums = torch.zeros(4, 2, 3)
        >>> groups = TrajectoryGroups(*sums, mask=None, steps=steps, scores=sums[0])
        >>> groups.num_steps[0].tolist()
        [5.0, 5.0, 5.0]
    """

    returns: Tensor
    """The return r(rho), the sum of the rewards."""
    log_prob: Tensor
    """log pi_theta(rho), under the policy being trained; carries the gradient."""
    reference_log_prob: Tensor
    """log pi_bar(rho), under the reference policy."""
    behaviour_log_prob: Tensor
    """log beta(rho), under the policy that drew the trajectories."""
    mask: Tensor | None
    """True where the trajectory has a real step; None where all have."""
    steps: Steps
    """What was summed, for losses of single steps."""
    scores: Tensor
    """What is to be maximised, the returns, or what the loss's ``score`` makes of them."""

    @property
    def num_steps(self) -> Tensor:
        """Number of real steps ``[*G, K]``, in the dtype of the returns."""
        if self.steps.mask is None:
            return torch.full_like(self.returns, self.steps.rewards.shape[-1])
        return self.steps.mask.sum(-1, dtype=self.returns.dtype)


class TrajectoryGroupLoss(PolicyLoss):
    """Base class of the losses over groups of K trajectories of one problem instance.

    It reads a batch ``[*G, K, T]`` (any number of group dimensions, also none; of one-step
    trajectories also ``[*G, K]`` with one at least), sums rewards and
    log-probabilities over the real steps of each trajectory, in single precision at least, hands
    the numbers to :meth:`surrogate`, and reduces and reports what comes back. A new member of the
    family implements that one method, and declares in :attr:`losses` and :attr:`metrics` what else
    it returns.

    ``torch.compile(fullgraph=True)`` takes it with feed-forward actors; with recurrent ones PyTorch
    and TorchRL break the graph. Compiled or mapped over, it looks at no values: give it one-step
    trajectories with their time, ``[*G, K, 1]``.

    Real steps are those that :attr:`loss_mask_key` marks, by default TorchRL's own
    ``("collector", "mask")`` where it is present. A trajectory without a real step is left out of
    its group. Whatever stands in padded steps has no influence. Where every step is an end, as
    ``("next", "done")`` tells, the batch is one of one-step trajectories, ``[*G, K]``.

    A squashed action (``TanhNormal``, any ``TransformedDistribution``) is evaluated at the latent
    that was drawn, where that is recorded: ``"action_latent"`` for ``"action"``, as
    :func:`~torchrl_ecpo.modules.record_latents` lets a policy write it and the package's collector
    does. Otherwise, and where noise behind the policy has made another action of it, the transform
    is inverted, which near the ends of the range, and in half precision everywhere, gives another
    latent. Where the distribution's parameters are recorded beside the action (an actor writes
    them), the policy that drew it is then evaluated at that latent too, so that its ratio to itself
    is 1; the gradient is not that of the latent.

    Args:
        actor_network: a policy with ``get_dist``: feed-forward or recurrent (it is called in
            recurrent mode on ``[N, T]``), with any action distribution whose log-probability has
            the shape of the batch, also a composite one (the parts are added up), or several
            distributions, each of which may read what those before it have drawn. Or a wrapper of a
            language model, ``TransformersWrapper(..., generate=False)``: then the batch is one of
            completions, ``[B]`` or ``[*G, K]``, as TorchRL's own ``GRPOLoss`` takes it
            (:mod:`torchrl_ecpo.llm`), and the T steps are their tokens.

    Keyword Args:
        temperatures: initial values by name; each becomes a buffer that is scheduled by assignment
            (``loss.tau = 0.1``) and by :class:`~torchrl_ecpo.TemperatureScheduler`. In the unit of
            the score.
        allow_zero: whether all temperatures may be 0 together. Defaults to False.
        score: what takes the place of the return: ``"return"`` (default), itself; or its distance
            from the mean of its group, in units of the standard deviation of the ``"group"``
            (:func:`~torchrl_ecpo.functional.standardised`) or of the ``"batch"``, within its
            groups (:func:`~torchrl_ecpo.functional.standardised_in_batch`). These two are without
            a unit, and so are the temperatures then. The batch is that of one call.
        delay_actor: if True, the loss keeps ``target_actor_network_params`` as reference policy, to
            be moved by an updater (:mod:`torchrl_ecpo.updaters`), and corrects for the policy that
            drew the trajectories where its log-probability is recorded. If False (default, and
            Algorithm 1's case), the recorded log-probability *is* the reference's.
        reduction: ``"mean"`` over the groups (default), ``"sum"``, or ``"none"`` for one number
            for each group.

    Raises:
        ValueError: for an unknown score or reduction or a temperature that is not allowed; when
            called, for a wrong shape, a group of one, also one that the mask leaves, a mask with a
            hole, rows that mix groups (``"group"``) or go on after an end (``("next", "done")``),
            a reward, log-probability or temperature that is not finite. (``torch.compile`` and
            ``torch.vmap`` look at shapes only: NaN then gives NaN, and a mask without a real step
            gives 0.)
        TypeError: if ``actor_network`` has no ``get_dist``.
        KeyError: when called, for a missing entry.

    Examples:
        A member in a few lines, REINFORCE with the mean of the other trajectories as baseline:

        >>> from torchrl_ecpo.functional import leave_one_out, score_function_loss
        >>> class RLOOLoss(TrajectoryGroupLoss):
        ...     metrics = ("advantage",)
        ...     def surrogate(self, groups):
        ...         advantage = leave_one_out(groups.scores, mask=groups.mask)
        ...         loss = score_function_loss(groups.log_prob, advantage, mask=groups.mask)
        ...         return Surrogate(loss, None, metrics={"advantage": advantage.abs().mean(-1)})
    """

    metrics: ClassVar[tuple[str, ...]] = OF_WEIGHTS
    """Names of the metrics that are the member's own.

    ``"ESS"`` and ``"max_weight"``, the default, are computed from the weights that
    :meth:`surrogate` returns. A member without weights declares its own metrics only, or none.
    """

    reads_steps: bool = True
    """Whether ``surrogate`` reads ``groups.steps`` or ``groups.num_steps``. Of a loss that does
    not, the sums over a trajectory's steps may be handed in as a trajectory of one step."""

    least_group: ClassVar[int] = 2
    """How many trajectories a group has at least, as weights are relative to the others."""

    further_in_keys: Sequence[NestedKey] = ()
    """Entries that networks of the member's own read from ``groups.steps.inputs``."""

    @dataclass
    class _AcceptedKeys:
        """Entries of the input tensordict, all of leading shape ``[*G, K, T]``.

        Attributes:
            action: what was done; a list of keys for a composite action.
            reward: ``[*G, K, T, 1]``, read from ``"next"``.
            sample_log_prob: log-probability of the action under the policy that drew it,
                ``[*G, K, T]``; a list of keys is added up. Defaults to ``"action_log_prob"``, or
                to ``"sample_log_prob"`` if ``composite_lp_aggregate()`` is True, as in TorchRL.
            prompt: of completions ``[B]`` of a language model, what those of one group have in
                common: texts, integers or tokens. Defaults to ``"query"``, as in TorchRL.
        """

        action: NestedKey | list[NestedKey] = "action"
        reward: NestedKey = "reward"
        sample_log_prob: NestedKey | list[NestedKey] | None = None
        prompt: NestedKey = "query"

        def __post_init__(self) -> None:
            if self.sample_log_prob is None:
                self.sample_log_prob = (
                    "sample_log_prob" if composite_lp_aggregate(nowarn=True) else "action_log_prob"
                )

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        temperatures: Mapping[str, float] | None = None,
        allow_zero: bool = False,
        score: Score = "return",
        delay_actor: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(
            actor_network,
            temperatures=temperatures,
            allow_zero=allow_zero,
            delay_actor=delay_actor,
            reduction=reduction,
        )
        check_choice("score", score, tuple(SCORES))
        self.score = score
        if self._reads_completions:
            actor: Any = actor_network
            self.set_keys(
                action=(actor.tokens_key, "full"), sample_log_prob=(actor.log_probs_key, "full")
            )
        self._check_names()
        self._may_squash = not self._reads_completions and any(map(may_squash, self._heads))

    def _take(self, actor_network: Any) -> None:
        """A language model stays a part of the loss, as it is: one too large for a second copy."""
        self._reads_completions = is_language_model(actor_network)
        if not self._reads_completions:
            super()._take(actor_network)
            return
        check_actor(actor_network)
        if self.delay_actor:
            raise ValueError(
                "delay_actor=True would keep a second copy of the language model. Leave it out: "
                "the reference policy is the one that the log-probabilities were recorded of."
            )
        self.actor_network = actor_network

    # ------------------------------------------------------------------------------- one method

    @abstractmethod
    def surrogate(self, groups: TrajectoryGroups) -> Surrogate:
        """The loss of each group ``[*G]``, and its trajectories' weights ``[*G, K]`` after a lift.

        Further losses and metrics, ``[*G]`` or 0-d, have the names that :attr:`losses` and
        :attr:`metrics` declare.
        """

    @dispatch  # pyright: ignore[reportArgumentType] - it is typed for its other use, with arguments
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the loss of a batch of groups.

        Args:
            tensordict: ``[*G, K, T]`` with the entries of :attr:`in_keys`; nothing is written.

        Returns:
            ``loss_actor`` and, detached, the diagnostics of :attr:`out_keys`, means over groups
            or one number a group (``[*G]``) with ``reduction="none"``.
        """
        groups = self._read(tensordict)
        found = self.surrogate(groups)
        metrics = dict(found.metrics)
        if found.weights is not None:  # how evenly a lift weighs the trajectories
            ess, largest = effective_sample_size(found.weights), found.weights.amax(-1)
            of_weights = {"ESS": ess, "max_weight": largest}
            metrics |= {name: x for name, x in of_weights.items() if name in self.metrics}
        self._check_declared(found.losses, metrics)
        metrics |= _of_groups(groups)
        reduction = Reduction(self.reduction, found.loss.shape)
        losses = {"loss_actor": found.loss, **found.losses}
        outputs = {name: reduction.loss(value) for name, value in losses.items()}
        for name, value in metrics.items():
            outputs[name] = reduction.metric(value.to(found.loss.dtype))
        return self._selected(outputs, found.loss.shape)

    # ------------------------------------------------------------------------------------- keys

    @property
    def _all_in_keys(self) -> list[NestedKey]:
        actor: Any = self.actor_network
        if self._reads_completions:
            further = () if self.loss_mask_key == "auto" else self.mask_keys  # prompts tell
            further += ((actor.tokens_key, "prompt"), (actor.masks_key, "all_attention_mask"))
            further += (self.tensor_keys.prompt,)
        else:
            further = (*self.mask_keys, DONE_KEY, GROUP_KEY, SPAN_KEY)
        return [
            *actor.in_keys,
            *self.further_in_keys,
            *_as_list(self.tensor_keys.action),
            self._reward_key,
            *_as_list(self.tensor_keys.sample_log_prob),
            *further,
            *self._squashed_keys,
        ]

    @property
    def _all_out_keys(self) -> list[Any]:
        return ["loss_actor", *self.losses, *self.metrics, *OF_GROUPS]

    @property
    def _heads(self) -> list[_Head]:
        return [m for m in self.actor_network.modules() if isinstance(m, _Head)]

    @property
    def _latent_keys(self) -> list[NestedKey]:
        """Where what was drawn before a squashing may be recorded."""
        return [latent_key(k) for k in _as_list(self.tensor_keys.action) if self._may_squash]

    @property
    def _squashed_keys(self) -> list[NestedKey]:
        """Those, and where the parameters may be recorded of the distribution it was drawn from."""
        of_heads = [key for head in self._heads for key in head.in_keys if self._may_squash]
        return [*self._latent_keys, *of_heads]

    def make_value_estimator(self, *args: Any, **hyperparams: Any) -> Any:
        """Refused: there are no values to estimate."""
        raise NotImplementedError(
            f"{type(self).__name__} has no value estimator: the return of a trajectory is the "
            f"undiscounted sum of {self._reward_key!r}. To discount by gamma, multiply the reward "
            "of step t by gamma ** t before calling the loss."
        )

    # ---------------------------------------------------------------------------------- reading

    def _read(self, tensordict: TensorDictBase) -> TrajectoryGroups:
        """Sum rewards and log-probabilities over the real steps of each trajectory."""
        steps = self._read_steps(tensordict)
        reference = behaviour = steps.reference_log_prob.sum(-1)
        if steps.behaviour_log_prob is not steps.reference_log_prob:
            behaviour = steps.behaviour_log_prob.sum(-1)
        returns, log_prob = steps.rewards.sum(-1), steps.log_prob.sum(-1)
        mask = None if steps.mask is None else steps.mask.any(-1)
        quantities = {f"entry {self._reward_key!r}": returns}
        if behaviour is not reference or not self.delay_actor:  # else it is not there
            quantities[f"entry {self.tensor_keys.sample_log_prob!r}"] = behaviour
        read = f"log-probability of the entries {_as_list(self.tensor_keys.action)}, given "
        read += f"{self.actor_network.in_keys}, under the "
        quantities[read + "reference policy"] = reference
        quantities[read + "actor"] = log_prob
        self._check_values(quantities, of="trajectories")
        scores = SCORES[self.score](returns, mask=mask)
        return TrajectoryGroups(returns, log_prob, reference, behaviour, mask, steps, scores)

    def _read_completions(self, tensordict: TensorDictBase) -> Steps:
        keys: Any = self.tensor_keys
        rewards, log_prob, recorded, mask = read_completions(
            self.actor_network,
            tensordict,
            tokens_key=keys.action,
            log_prob_key=keys.sample_log_prob,
            reward_key=self._reward_key,
            prompt_key=keys.prompt,
            mask_key=self.loss_mask_key,
        )
        if values_can_be_seen():
            self._check_left(self.loss_mask_key, mask)
        return Steps(rewards, log_prob, recorded, recorded, mask)

    def _read_steps(self, tensordict: TensorDictBase) -> Steps:
        if self._reads_completions:
            return self._read_completions(tensordict)
        if -1 in tensordict.batch_size:
            raise ValueError(
                f"The rows of the batch {tuple(tensordict.batch_size)} are of unequal length: "
                "torchrl_ecpo.groups.pack_groups(...) pads them."
            )
        reward = get_entry(tensordict, self._reward_key)
        shape = _batch_shape(reward, self._reward_key)
        mask = self._mask(tensordict, shape)
        if values_can_be_seen():
            every = torch.ones(shape, dtype=torch.bool, device=reward.device)
            if self._lacks_time(tensordict, every if mask is None else mask):
                steps = tensordict.select(*self._all_in_keys, strict=False).copy()
                steps.batch_size = shape
                return self._read_steps(steps.unsqueeze(-1))
            if mask is not None:
                check_padding(self.mask_keys, mask)
                self._check_left(self.mask_keys, mask)
            self._check_single_steps(tensordict)
        if self.least_group > 1:
            check_group_size(shape[-2], f"K of the batch [*G, K, T] = {tuple(shape)}")

        def real(values: Tensor) -> Tensor:
            # A sum over a completion of 1,000 tokens would be off by nats in half precision, and
            # returns that differ by little would be equal.
            values = widened(values)
            return values if mask is None else values.where(mask, 0.0)

        recorded = self._recorded_log_prob(tensordict, shape)
        inputs = self._actor_inputs(tensordict, shape, mask)
        log_prob = real(self._log_prob(inputs, self.actor_network_params, shape))
        if recorded is not None and self._may_squash:
            recorded = self._drawn_log_prob(inputs, recorded)
        if self.delay_actor:
            with torch.no_grad():
                reference = real(self._log_prob(inputs, self.target_actor_network_params, shape))
            behaviour = reference if recorded is None else real(recorded)
        elif recorded is not None:
            reference = behaviour = real(recorded)
        else:
            raise KeyError(
                f"The entry {self.tensor_keys.sample_log_prob!r} is missing: the log-probability "
                "of each action under the policy that drew it. Build the actor with "
                "return_log_prob=True, or name the entry with set_keys(sample_log_prob=...); the "
                "lift-and-project losses can also be built with delay_actor=True and evaluate a "
                "reference policy of their own."
            )
        rewards = real(reward.squeeze(-1).to(log_prob.dtype))
        return Steps(rewards, log_prob, reference, behaviour, mask, inputs)

    def _check_single_steps(self, tensordict: TensorDictBase) -> None:
        """Refuse rewards that multi-step transforms have summed: a return sums them again."""
        steps = tensordict.get(SPAN_KEY, None)
        if steps is not None and (steps > 1).any():
            raise ValueError(
                f"The rewards {self._reward_key!r} are sums over up to {int(steps.max())} steps "
                f"({SPAN_KEY!r}), and a return would count each reward several times. Leave "
                "MultiStep and MultiStepTransform out: a group is compared by whole trajectories."
            )

    def _actor_inputs(
        self, tensordict: TensorDictBase, shape: torch.Size, step_mask: Tensor | None
    ) -> TensorDictBase:
        """What the actor read and did, as a new tensordict ``[N, T]`` without padding.

        A padded step becomes a copy of the last real one before it: valid input to any network and
        distribution, whatever stood there. (NaN would reach the gradient as 0 * NaN; a zero may be
        outside the support of the actions.) The mask goes along, so that an actor may save work.
        """
        action_keys = _as_list(self.tensor_keys.action)
        for key in action_keys:
            get_entry(tensordict, key)
        keys = [*self.actor_network.in_keys, *self.further_in_keys]
        keys += [*action_keys, *self._squashed_keys]
        inputs = tensordict.select(*keys, strict=False)
        if isinstance(inputs, LazyStackedTensorDict):  # its members may have a smaller batch size
            inputs = inputs.contiguous()
        inputs = inputs.copy()  # entries that are tensordicts would get the batch size below
        try:
            inputs.batch_size = shape
        except RuntimeError as error:
            raise ValueError(
                f"What the actor reads and did must have the leading shape [*G, K, T] = "
                f"{tuple(shape)} of the reward: {error}"
            ) from error
        inputs = inputs.reshape(-1, shape[-1])
        if step_mask is not None:
            step_mask = step_mask.reshape(-1, shape[-1])
            last = _last_real_step(step_mask)
            # With a batch size also a lazy stack is taken as a whole, as `last` is.
            inputs = inputs.apply(
                lambda entry: take_rows(entry.flatten(0, 1), last), batch_size=inputs.batch_size
            )
            inputs.set(self.mask_keys[0], step_mask)
        return inputs

    def _log_prob(
        self, inputs: TensorDictBase, params: TensorDictParams, shape: torch.Size
    ) -> Tensor:
        """Log-probability ``[*G, K, T]`` of the recorded actions under given parameters."""
        inputs = inputs.copy()  # the actor writes its intermediate results into its input
        action_keys = _as_list(self.tensor_keys.action)
        steps = list(_steps_of(self.actor_network))
        with holding(self.actor_network, params):
            try:
                if sum(isinstance(step, _Head) for step in steps) > 1:
                    return self._log_prob_of_parts(steps, inputs, action_keys).reshape(shape)
                dist = self.actor_network.get_dist(inputs)
                return self._log_prob_of_action(dist, inputs, action_keys).reshape(shape)
            except UNREADABLE as error:
                keys = (*self.actor_network.in_keys, *action_keys)
                raise unreadable("actor", inputs, keys, error) from error

    def _log_prob_of_parts(
        self, steps: list[Any], inputs: TensorDictBase, action_keys: list[NestedKey]
    ) -> Tensor:
        """Of an action drawn part by part, each given those before it.

        The actor's own ``get_dist`` would draw the parts anew, to hand them to the next.
        """
        log_prob, drawn = torch.zeros(()), []
        for step in steps:
            if not isinstance(step, _Head):
                inputs = step(inputs)
                continue
            keys = list(step.dist_sample_keys)
            drawn += keys
            if not set(keys) <= set(action_keys):
                break
            log_prob = log_prob + self._log_prob_of_action(step.get_dist(inputs), inputs, keys)
        if set(drawn) != set(action_keys):
            raise ValueError(
                f"The actor draws the parts {drawn} of an action, one after the other, but the "
                f"action is {action_keys}. Name all of them with set_keys(action=[...])."
            )
        return log_prob

    @staticmethod
    def _log_prob_of_action(
        dist: Any, inputs: TensorDictBase, action_keys: list[NestedKey]
    ) -> Tensor:
        """Log-probability ``[N, T]`` of recorded actions, under one distribution."""
        is_composite = isinstance(dist, CompositeDistribution)
        if len(action_keys) > 1 and not is_composite:
            raise ValueError(
                f"The action has several parts {action_keys}, but the actor's distribution is a "
                f"{type(dist).__name__}, which has one. Name it with set_keys(action=...)."
            )
        log_prob: Any = 0.0
        for key, part in parts_of(dist, action_keys):
            of_part = _log_prob_of_part(part, inputs, key)
            if is_composite and of_part.ndim > inputs.ndim:
                of_part = of_part.flatten(inputs.ndim).sum(-1)
            log_prob = log_prob + of_part
        if log_prob.shape != inputs.shape:
            raise ValueError(
                f"The actor's distribution {type(dist).__name__} gives log-probabilities of shape "
                f"{tuple(log_prob.shape)} for a batch of shape {tuple(inputs.shape)}. They must "
                "have one number for each step: sum over the parts of an action, for example with "
                "torch.distributions.Independent or IndependentNormal."
            )
        return log_prob

    def _recorded_log_prob(self, tensordict: TensorDictBase, shape: torch.Size) -> Tensor | None:
        """Log-probability ``[*G, K, T]`` under the policy that drew the actions, if it is there."""
        keys = _as_list(self.tensor_keys.sample_log_prob)
        if all(tensordict.get(key, None) is None for key in keys):
            return None
        total = torch.zeros(())
        for key in keys:
            value = _sum_parts(get_entry(tensordict, key))
            check_real(key, value)
            if value.shape != shape:
                raise ValueError(
                    f"The log-probability {key!r} must have the shape [*G, K, T] = {tuple(shape)}, "
                    f"that of the reward without its trailing 1, got {tuple(value.shape)}: one "
                    "number for each step, without a trailing dimension. Squeeze it, or sum it "
                    "over the parts of the action."
                )
            total = total + value.detach()
        return total

    def _drawn_log_prob(self, inputs: TensorDictBase, recorded: Tensor) -> Tensor:
        """The recorded log-probability; of lost latents, that at the ones that stand for them.

        It is computed from recorded parameters of the distribution, if they are there.
        """
        given = [key for head in self._heads for key in head.in_keys]
        is_known = all(inputs.get(key, None) is not None for key in self._latent_keys)
        if is_known or any(inputs.get(key, None) is None for key in given):
            return recorded
        log_prob: Any = 0.0
        lost = torch.zeros(inputs.shape, dtype=torch.bool, device=recorded.device)
        with torch.no_grad():
            for head in self._heads:
                several = len(self._heads) > 1
                keys = head.dist_sample_keys if several else _as_list(self.tensor_keys.action)
                dist = head.get_dist(inputs)
                parameters = [*inputs.select(*head.in_keys).values(True, True)]
                log_prob = log_prob + self._log_prob_of_action(dist, inputs, keys)
                for key, part in parts_of(dist, keys):
                    if split(part)[1] and inputs.get(latent_key(key), None) is None:
                        lost = lost | is_lost(part, inputs.get(key), parameters)
        lost, log_prob = lost.reshape(recorded.shape), log_prob.reshape(recorded.shape)
        return log_prob.to(recorded.dtype).where(lost, recorded)

    def _lacks_time(self, tensordict: TensorDictBase, real: Tensor) -> bool:
        """Whether every step is an end: one-step trajectories ``[*G, K]``.

        Refuses other rows that are no trajectories of one group, as far as entries tell. One look.
        """
        faults = {}
        done, group = (tensordict.get(key, None) for key in (DONE_KEY, GROUP_KEY))
        if isinstance(done, Tensor) and done.numel() == real.numel():
            done = done.reshape(real.shape).bool()
            faults[f"go on after an end ({DONE_KEY!r})"] = done[..., :-1] & real[..., 1:]
        if isinstance(group, Tensor):
            of_row = real.shape[: group.ndim]
            if group.shape == of_row:  # of each group or trajectory
                group = group.reshape(*of_row, *[1] * (real.ndim - group.ndim)).expand_as(real)
        if isinstance(group, Tensor) and group.numel() == real.numel():
            check_real(GROUP_KEY, group)
            group = group.reshape(real.shape)
            first = group.where(real, group.max()).amin((-2, -1), keepdim=True)
            other = (group != first) & real
            faults[f"are of another group ({GROUP_KEY!r}) than others"] = other
        if not faults or not torch.stack([where.any() for where in faults.values()]).any():
            return False
        fault, where = next((f, where) for f, where in faults.items() if where.any())
        if done is not None and where.shape != real.shape and (done | ~real).all():
            return True
        raise ValueError(
            f"{int(where.any(-1).sum())} rows of the batch [*G, K, T] = {tuple(real.shape)} "
            f"{fault}. Each row is one trajectory, and the K rows of a group are of one problem "
            "instance."
        )

    def _check_left(self, name: Any, mask: Tensor) -> None:
        """Refuse groups of which a mask leaves too little."""
        is_small = mask.any(-1).sum(-1) < self.least_group
        if is_small.any():
            few = "fewer than two trajectories" if self.least_group > 1 else "no trajectories"
            raise ValueError(
                f"The mask ({name}) leaves {int(is_small.sum())} group(s) with "
                f"{few} that have a real step. Drop such groups before calling the loss."
            )


class LiftProjectLoss(TrajectoryGroupLoss):
    """A :class:`TrajectoryGroupLoss` that lifts a reference policy by Eq. 5 and projects onto it.

    Keyword Args:
        tau: temperature of the divergence from the reference policy, in the unit of the score.
            Defaults to 0.5, the middle of the values searched on the algorithmic tasks.
        tau_prime: temperature of the entropy, in the unit of the score. Defaults to 0.
        score: see :class:`TrajectoryGroupLoss`. Defaults to ``"return"``.

    Raises:
        ValueError: for temperatures below 0 or both 0, and as :class:`TrajectoryGroupLoss`.

    Examples:
        ECPO without its options:

        >>> from torchrl_ecpo.envs import BanditEnv
        >>> from torchrl_ecpo.functional import mean_seeking_projection
        >>> from torchrl_ecpo.modules import make_softmax_policy
        >>> class PlainECPOLoss(LiftProjectLoss):
        ...     def surrogate(self, groups):
        ...         lift = self.lift(groups)
        ...         return mean_seeking_projection(groups.log_prob, lift, mask=groups.mask)
        >>> env = BanditEnv(num_actions=6, num_groups=3, group_size=4)
        >>> actor = make_softmax_policy(env.features)
        >>> loss = PlainECPOLoss(actor, tau=0.5, reduction="none")(env.rollout(1, actor))
        >>> loss["loss_actor"].shape
        torch.Size([3])
    """

    reads_steps = False
    tau: Tensor
    tau_prime: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        *,
        tau: float = 0.5,
        tau_prime: float = 0.0,
        score: Score = "return",
        delay_actor: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
    ) -> None:
        super().__init__(
            actor_network,
            temperatures={"tau": tau, "tau_prime": tau_prime},
            score=score,
            delay_actor=delay_actor,
            reduction=reduction,
        )

    def lift(self, groups: TrajectoryGroups) -> Tensor:
        """Log-weight ``[*G, K]`` of the lifted policy relative to the reference: Eq. 5."""
        tau, tau_prime = self.temperatures()
        return lifted_log_weights(
            groups.scores, groups.reference_log_prob, tau=tau, tau_prime=tau_prime
        )


# ------------------------------------------------------------------------------------- small parts


def _log_prob_of_part(distribution: Any, inputs: TensorDictBase, key: NestedKey) -> Tensor:
    """Of an action, a squashed one at its latent, recorded or not."""
    action = get_entry(inputs, key)
    check_real(key, action)
    if isinstance(distribution, Categorical) and action.shape == distribution.batch_shape:
        check_integers(key, action)
    if isinstance(distribution, Distribution):
        _check_shape(distribution, key, action)
    if not split(distribution)[1]:
        return distribution.log_prob(action)
    recorded = inputs.get(latent_key(key), None)
    return log_prob_of_latent(distribution, latent_of(distribution, action, recorded))


def _check_shape(distribution: Distribution, key: NestedKey, action: Tensor) -> None:
    """Refuse an action of vectors of another shape, which might broadcast."""
    event = distribution.event_shape
    if isinstance(distribution, ONE_HOT):  # TorchRL's have no event_shape
        event = distribution.param_shape[-1:]
        if action.shape[:-1] == distribution.batch_shape and action.shape[-1] > event[0]:
            event = action.shape[-1:]  # of those whose mask are indices, which leave fewer
    if event and action.shape != distribution.batch_shape + event:
        raise ValueError(
            f"The action {key!r} must have the shape {tuple(distribution.batch_shape + event)} of "
            f"what a {type(distribution).__name__} of the actor draws, got {tuple(action.shape)}."
        )


def _steps_of(module: Any) -> Iterator[Any]:
    """The modules that a policy calls one after the other."""
    if isinstance(module, TensorDictSequential):
        steps = module.module  # a ModuleDict, where they have names
        for each in steps.values() if isinstance(steps, nn.ModuleDict) else steps:
            yield from _steps_of(each)
    else:
        yield module


def _as_list(keys: NestedKey | list[NestedKey] | None) -> list[NestedKey]:
    return list(keys) if isinstance(keys, list) else [keys]  # type: ignore[list-item]


def _sum_parts(log_prob: Any) -> Tensor:
    """Log-probability of an action, from those of its independent parts if it is composite."""
    if not is_tensor_collection(log_prob):
        return log_prob
    return torch.stack(list(log_prob.values(True, True))).sum(0)


def _batch_shape(reward: Tensor, key: NestedKey) -> torch.Size:
    """[*G, K, T] of a batch, from its rewards."""
    if reward.ndim < 3 or reward.shape[-1] != 1:
        raise ValueError(
            f"The reward {key!r} must have the shape [*G, K, T, 1] (groups, K trajectories of one "
            f"problem instance, T steps), got {tuple(reward.shape)}."
        )
    if 0 in reward.shape:
        raise ValueError(
            f"The batch is empty: the reward {key!r} has the shape {tuple(reward.shape)}."
        )
    check_real(key, reward)
    return reward.shape[:-1]


def _last_real_step(step_mask: Tensor) -> Tensor:
    """Index ``[N, T]``, counted over all steps, of the last real one at or before each step.

    Trajectories without a real step borrow those of the first trajectory that has one.
    """
    steps = torch.arange(step_mask.shape[-1], device=step_mask.device)
    columns = steps.minimum(step_mask.sum(-1, keepdim=True) - 1)
    has_steps = step_mask.any(-1)
    rows = torch.arange(step_mask.shape[0], device=step_mask.device)
    rows = rows.where(has_steps, has_steps.int().argmax())
    return rows.unsqueeze(-1) * step_mask.shape[-1] + columns[rows]


def _of_groups(groups: TrajectoryGroups) -> dict[str, Tensor]:
    """What to watch, ``[*G]`` each.

    KL(reference, policy) and the entropy of the policy are estimates from K trajectories, so the
    former may come out below 0.
    """
    mask = groups.mask
    log_prob, returns = groups.log_prob.detach(), groups.returns.detach()
    log_ratio = groups.reference_log_prob - groups.behaviour_log_prob
    of_reference = self_normalised_weights(log_ratio, mask=mask)
    of_policy = self_normalised_weights(log_prob - groups.behaviour_log_prob, mask=mask)
    highest = returns if mask is None else returns.where(mask, -torch.inf)
    lowest = returns if mask is None else returns.where(mask, torch.inf)
    is_equal = highest.amax(-1) == lowest.amin(-1)
    return {
        "kl_reference_policy": (of_reference * (groups.reference_log_prob - log_prob)).sum(-1),
        "entropy": -(of_policy * log_prob).sum(-1),
        "return": (uniform_weights(returns, mask=mask) * returns).sum(-1),
        "equal_return_groups": is_equal.to(returns.dtype),
    }
