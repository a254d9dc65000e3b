"""Exploratory Conservative Actor-Critic."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torch.distributions import Distribution

from torchrl_ecpo.checks import as_float, check_choice, check_count
from torchrl_ecpo.functional import (
    Surrogate,
    centred_gaussian_projection,
    gaussian_cross_entropy,
    lifted_gaussian_moments,
    mean_seeking_projection,
)
from torchrl_ecpo.objectives.actions import PairedActions, SampledActions, gaussian_parameters
from torchrl_ecpo.objectives.actor_critic import ActorCriticLoss, Lift, States

PROJECTIONS = ("centred", "paper", "gradient")
NO_SLOPE = (
    'projection="gradient" needs a qvalue_network that is differentiable in the action, but no '
    'gradient comes back through this one: mend it, or take projection="centred".'
)


class ECACLoss(ActorCriticLoss):
    r"""ECAC for continuous actions: lift the reference policy by soft Q, project mean-seeking.

    "On Principled Entropy Exploration in Policy Optimization", Mei et al., IJCAI 2019, Eq. 8 to 11.
    With M actions of the reference policy at each state,

    .. math::
        L(\theta) = -\sum_m w_m \log \pi_\theta(a_m|s), \quad
        w = \mathrm{softmax}_m \frac{Q(s, a_m) - \tau' \log \bar\pi(a_m|s)}{\tau + \tau'}, \quad
        a_m \sim \bar\pi(\cdot|s)

    ``ECACLoss(actor, qvalue)`` takes the place of ``SACLoss(actor, qvalue)``: the same networks and
    entries, another way for the policy to follow Q.

    Args:
        actor_network: a policy with ``get_dist``: a Gaussian or tanh-Gaussian one for
            ``projection="centred"`` and ``"gradient"``, any with ``rsample`` for ``"paper"``.
            Actions are ``[*B, A]``.
        qvalue_network: reads observation and action, writes ``"state_action_value"`` ``[*B, 1]``;
            differentiable in the action for ``"gradient"``. Each of `num_qvalue_nets` is a copy of
            it with weights drawn anew; a list gives the networks one by one, as they are.
        value_network: reads the observation, writes ``"state_value"`` ``[*B, 1]``. With it, the
            value of the next state is that of its delayed copy (the paper, Eq. 9); without
            (default), it is computed from delayed Q and the reference policy (Eq. 8), which learned
            faster in our runs.

    Keyword Args:
        tau: temperature of the divergence from the reference, in the unit of Q. Where it is
            learned, where it starts. Default: 0.3.
        tau_prime: temperature of the entropy, likewise. Default: 1, as SAC's alpha.
        target_kl: KL(target, pi_bar) per action dimension, in nats, that tau is learned to hold
            (``loss_tau``, parameter ``log_tau``). It must be below log M / A, but with
            ``"gradient"``. None: tau is fixed, or scheduled by assignment. Default: 0.083, half a
            nat for six dimensions.
        target_entropy: entropy in nats that tau_prime is learned to hold (``loss_tau_prime``,
            parameter ``log_tau_prime``), as SAC's alpha is; ``"auto"`` (default, SAC's) is -A.
            None: tau_prime is fixed, or scheduled by assignment. It must be below the log-volume of
            the bounds of the actions.
        min_tau: floor of a learned tau, in the unit of Q: lower both floors where rewards are rare.
            Default: 0.001.
        min_tau_prime: floor of a learned tau_prime. Without one it winds down to nothing while
            the policy lags behind its target. Default: 0.003.
        projection: ``"centred"`` (default): the scale is fitted to the variance about the samples'
            own mean, :func:`~torchrl_ecpo.functional.centred_gaussian_projection`. ``"paper"``:
            Eq. 11 to the letter. ``"gradient"``: mean and variance of the same target, from
            antithetic pairs of samples and the gradient of Q there,
            :func:`~torchrl_ecpo.functional.lifted_gaussian_moments`; its coefficient is that of the
            whole batch, so that the states of a batch are not independent.
        width_entropy: phi, from 0 to 1, with ``"gradient"`` only: what part of the entropy term
            widens the policy; it moves the mean as before. Default: 1, the paper's target.
        num_qvalue_nets: the least of so many soft Q values counts. Default: 2 (the paper's).
        num_actor_states: the policy, the value network and the temperatures learn from the first so
            many entries of the batch only, which saves time where M is large. Default: None, all.
        num_action_samples: M, at least 2, and even with ``"gradient"``, for which 4 are enough.
            Default: 8.
        num_next_action_samples: actions at the next state, from which its value is computed where
            there is no value network. Default: 1 (the paper's estimate).
        loss_function: ``"l2"`` (default; Eq. 9 and 10 without their factor 1/2), ``"l1"`` or
            ``"smooth_l1"``.
        delay_actor: if True, the reference policy is ``target_actor_network_params``, to be moved
            by an updater (:class:`~torchrl_ecpo.PeriodicCopy`). If False (default), it is the
            policy of this very update: one step a lift.
        delay_qvalue: whether the next state's value comes from delayed Q networks. Default: True,
            or False with a value network.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"``.
        skip_done_states: if True, next states that are ``done`` are never looked at and count
            nothing, also those of a time limit. Default: False; nothing is expected after
            ``terminated`` states in either case, whatever stands there.
        use_prioritized_weights: whether losses are weighted by the entry ``"priority_weight"``;
            True and ``"auto"`` (default): if it is there.

    The Q networks are called one after another. One with a method ``each``, as
    :class:`~torchrl_ecpo.modules.DenseNetwork` has, is called by it, with the samples along a first
    dimension ``[M, *B]``, along which the states are expanded; other networks read them as more
    rows.

    The outputs are ``loss_actor``, ``loss_qvalue``, ``loss_value`` (with a value network),
    ``loss_tau`` and ``loss_tau_prime`` (where learned), each reaching its own parameters only, so
    that their sum can be backpropagated at once; and, detached, ``ESS`` of the weights,
    ``kl_target_reference`` = KL(target, pi_bar), by samples or, with ``"gradient"``, of Gaussians
    of these moments, ``kl_reference_policy`` = KL(pi_bar, pi_theta),
    ``entropy`` of the reference, ``saturation`` (share of action components in the outer 5 % of
    their range), ``qvalue``, ``state_value``, ``tau`` and ``tau_prime``. The
    temporal difference error is written into the input as ``"td_error"``, 0 where the entry
    ``("collector", "mask")`` says that a transition is not real: such transitions are not looked
    at, whatever stands there. A locked batch keeps the ``"td_error"`` out, unless it has one.

    Raises:
        ValueError: for discrete or hybrid actions, a Q network that reads no action,
            ``delay_qvalue=True`` with a value network, no samples, temperatures that are not
            allowed, an unknown or ill-typed option, an odd number of actions in pairs, a
            width_entropy without ``"gradient"``; when called, for a policy that is no Gaussian or a
            Q network without a gradient where one is needed, a target_kl that M samples cannot show
            or a target_entropy that no policy has, an entry of another shape or type or without a
            transition, actions that are none, weights below 0, and NaN or infinite values.
        TypeError: if ``actor_network`` has no ``get_dist``.
        KeyError: when called, for a missing entry.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_ecpo import PolyakAverage
        >>> from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
        >>> actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
        >>> loss_module = ECACLoss(actor, make_qvalue_network(3, 2))
        >>> updater = PolyakAverage(loss_module, "qvalue_network")
        >>> batch = TensorDict({
        ...     "observation": torch.randn(5, 3),
        ...     "action": torch.rand(5, 2) * 2 - 1,
        ...     "next": {
        ...         "observation": torch.randn(5, 3),
        ...         "reward": torch.rand(5, 1),
        ...         "done": torch.zeros(5, 1, dtype=torch.bool),
        ...         "terminated": torch.zeros(5, 1, dtype=torch.bool),
        ...     },
        ... }, batch_size=[5])
        >>> losses = loss_module(batch)
        >>> sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        >>> updater.step()
    """

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        projection: Literal["centred", "paper", "gradient"] = "centred",
        width_entropy: float = 1.0,
        num_action_samples: int = 8,
        **options: Any,
    ) -> None:
        check_choice("projection", projection, PROJECTIONS)
        is_paired = projection == "gradient"
        width_entropy = as_float("width_entropy", width_entropy, "[0, 1]")
        if width_entropy != 1 and not is_paired:
            raise ValueError(
                'width_entropy is an option of projection="gradient", which has the entropy of '
                f"the width by itself; got {width_entropy} with {projection!r}."
            )
        reason = ": weights are relative to those of the other actions"
        number = check_count("num_action_samples", num_action_samples, least=2, reason=reason)
        if is_paired and number % 2:
            raise ValueError(
                'num_action_samples must be even with projection="gradient", whose actions come '
                f"in pairs, got {number}."
            )
        options |= {"num_action_samples": number}
        super().__init__(actor_network, qvalue_network, value_network, **options)
        self.projection, self.width_entropy = projection, width_entropy

    def lift(
        self,
        observations: TensorDictBase,
        reference: Distribution,
        qvalue_params: TensorDictParams | Tensor | None = None,
        num_samples: int | None = None,
    ) -> Lift:
        """The base's; with ``projection="gradient"``, where the policy learns, by pairs and slopes.

        The arguments are those of :meth:`ActorCriticLoss.lift`; the policy learns where the number
        of samples is left to the loss.
        """
        if self.projection != "gradient" or num_samples is not None:
            return super().lift(observations, reference, qvalue_params, num_samples)
        params = (self.qvalue_network_params if qvalue_params is None else qvalue_params).data
        _, tau_prime = self.temperatures()

        def height(latent: Tensor) -> tuple[Tensor, Tensor]:
            actions = PairedActions.at(latent, reference)
            score = self.score_of(observations, actions, params)
            if not score.requires_grad:
                raise ValueError(NO_SLOPE)
            return (score + tau_prime * actions.log_volume).sum(), score

        with torch.no_grad():
            actions = PairedActions.of(reference, self.num_action_samples)
            if torch.compiler.is_compiling():  # a graph has no place for autograd, which is faster
                slope, score = torch.func.grad(height, has_aux=True)(actions.latent)
            elif torch.is_inference_mode_enabled():
                raise ValueError(
                    'projection="gradient" differentiates Q, which torch.inference_mode() forbids: '
                    "call the loss in torch.no_grad()."
                )
            else:
                with torch.enable_grad():
                    latent = actions.latent.requires_grad_()
                    total, score = height(latent)
                    (slope,) = torch.autograd.grad(total, latent)
                latent.requires_grad_(False)
            return self.lifted(actions, score.detach(), slope)

    def project(self, states: States) -> Surrogate:
        """Eq. 11 with the lift's weights, in nats; centred, to the letter, or by the moments."""
        lift, actions, log_weights = states.lift, states.lift.actions, states.lift.log_weights
        if self.projection == "paper":
            log_prob = actions.log_prob_of(states.policy)
            return mean_seeking_projection(log_prob, log_weights, sample_dim=0)
        loc, scale = gaussian_parameters(states.policy)
        assert isinstance(actions, SampledActions)
        if lift.slope is None:
            return centred_gaussian_projection(
                loc, scale, actions.latent, log_weights, sample_dim=0
            )
        tau, tau_prime = self.temperatures()
        old_loc, old_scale = (x.detach() for x in gaussian_parameters(states.reference))
        shift, width = lifted_gaussian_moments(
            (actions.latent - old_loc) / old_scale,
            old_scale * lift.slope,
            log_weights,
            tau=tau,
            tau_prime=tau_prime,
            width_entropy=self.width_entropy,
            sample_dim=0,
            state_mask=states.mask,
        )
        mean, variance = old_loc + old_scale * shift, old_scale.square() * width
        loss = gaussian_cross_entropy(loc, scale, mean, variance)
        divergence = 0.5 * (shift.square() + width - 1 - width.log()).sum(-1)
        return Surrogate(loss, lift.weights, metrics={"kl_target_reference": divergence})


class DiscreteECACLoss(ECACLoss):
    r"""ECAC for discrete actions: Eq. 8 and 11 summed over all actions, nothing sampled.

    It is :class:`ECACLoss` with ``projection="paper"`` and other defaults.

    .. math::
        L(\theta) = -\sum_a \bar\pi^*(a|s) \log \pi_\theta(a|s), \quad
        \bar\pi^*(a|s) = \mathrm{softmax}_a \frac{Q(s, a) + \tau \log \bar\pi(a|s)}{\tau + \tau'}

    Arguments, errors and outputs are those of :class:`ECACLoss`, without what concerns samples
    (``saturation`` among the outputs), and with these differences:

    Args:
        actor_network: a policy with ``get_dist`` over ``n`` actions: ``Categorical`` or
            ``OneHotCategorical``, TorchRL's masked ones among them: actions that a mask forbids
            have no part in the lift.
        qvalue_network: reads the observation, writes ``"action_value"`` ``[*B, n]``.

    Keyword Args:
        tau_prime: default: 0.1.
        target_kl: KL(target, pi_bar) in nats that tau is learned to hold. Default: 0.1.
        target_entropy: ``"auto"`` is log n times `target_entropy_weight`, as in TorchRL's
            ``DiscreteSACLoss``. Default: None, a fixed tau_prime. n is the number of actions that a
            mask leaves; other targets lie between 0 and its logarithm.
        target_entropy_weight: between 0 and 1. Default: 0.98, TorchRL's.
        min_tau: default: 1e-5. Where rewards are rare, higher floors keep the policy random.
        min_tau_prime: default: 1e-5.

    Raises:
        ValueError: as :class:`ECACLoss` and, when called, for a `target_entropy` that the actions
            cannot have.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torch.distributions import Categorical
        >>> from torchrl.modules import ProbabilisticActor
        >>> net = TensorDictModule(torch.nn.Linear(3, 4), ["observation"], ["logits"])
        >>> actor = ProbabilisticActor(net, ["logits"], distribution_class=Categorical)
        >>> qvalue = TensorDictModule(torch.nn.Linear(3, 4), ["observation"], ["action_value"])
        >>> loss_module = DiscreteECACLoss(actor, qvalue, delay_qvalue=False)
        >>> loss_actor, *_ = loss_module(
        ...     observation=torch.randn(5, 3), action=torch.randint(4, (5,)),
        ...     next_observation=torch.randn(5, 3), next_reward=torch.rand(5, 1),
        ...     next_done=torch.zeros(5, 1, dtype=torch.bool),
        ...     next_terminated=torch.zeros(5, 1, dtype=torch.bool))
        >>> loss_actor.backward()
    """

    takes_choices_only = True

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        tau_prime: float = 0.1,
        target_kl: float | None = 0.1,
        target_entropy: float | Literal["auto"] | None = None,
        target_entropy_weight: float = 0.98,
        min_tau: float = 1e-5,
        min_tau_prime: float = 1e-5,
        projection: Literal["paper"] = "paper",
        **options: Any,
    ) -> None:
        check_choice("projection", projection, ("paper",))
        super().__init__(
            actor_network,
            qvalue_network,
            value_network,
            tau_prime=tau_prime,
            target_kl=target_kl,
            target_entropy=target_entropy,
            min_tau=min_tau,
            min_tau_prime=min_tau_prime,
            projection=projection,
            **options,
        )
        self.target_entropy_weight = as_float(
            "target_entropy_weight", target_entropy_weight, "(0, 1)"
        )
