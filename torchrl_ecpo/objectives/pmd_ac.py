"""Policy Mirror Descent as an actor-critic."""

from __future__ import annotations

from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torch.distributions import Distribution

from torchrl_ecpo.objectives.actions import log_prob_of, sample_actions
from torchrl_ecpo.objectives.actor_critic import (
    ContinuousActorCriticLoss,
    DiscreteActorCriticLoss,
    Lift,
    log_probs_of_all,
)

__all__ = ["DiscretePMDACLoss", "PMDACLoss"]


class PMDACLoss(ContinuousActorCriticLoss):
    r"""PMD-AC for continuous actions: ECAC's lift, and the mode-seeking projection KL(pi, target).

    With one reparameterised action of the policy at each state, in the unit of Q,

    .. math::
        L(\theta) = (\tau + \tau') \log \pi_\theta(a|s) - \tau \log \bar\pi(a|s) - Q(s, a),
        \quad a \sim \pi_\theta(\cdot|s)

    which is :math:`(\tau + \tau') \mathrm{KL}(\pi_\theta \| \bar\pi^*)` up to a constant.
    ``tau_prime=0, target_entropy=None`` is the paper's PMD-AC, a positive tau_prime its
    PMD-AC+entropy. At tau = 0 it is SAC.

    Args:
        actor_network: as for :class:`~torchrl_ecpo.ECACLoss`, with ``rsample``.
        qvalue_network: as for :class:`~torchrl_ecpo.ECACLoss`.
        value_network: as for :class:`~torchrl_ecpo.ECACLoss`.

    Keyword Args:
        tau: temperature of the divergence from the reference, in the unit of Q. It has an effect
            with ``delay_actor=True`` only: a policy does not differ from itself. Default: 0.1.
        tau_prime: temperature of the entropy, in the unit of Q; where it is learned, where it
            starts. Default: 1, as ECAC's.
        target_kl: as for :class:`~torchrl_ecpo.ECACLoss`; needs several ``num_action_samples``.
            Default: None, a fixed tau.
        target_entropy: as for :class:`~torchrl_ecpo.ECACLoss`. Default: ``"auto"``.
        min_tau: as for :class:`~torchrl_ecpo.ECACLoss`.
        min_tau_prime: as for :class:`~torchrl_ecpo.ECACLoss`.
        num_qvalue_nets: as for :class:`~torchrl_ecpo.ECACLoss`.
        num_actor_states: as for :class:`~torchrl_ecpo.ECACLoss`.
        num_action_samples: actions of the reference by which lift, metrics and the value network's
            target are estimated; the projection does not need them. Default: 1.
        num_next_action_samples: as for :class:`~torchrl_ecpo.ECACLoss`.
        loss_function: as for :class:`~torchrl_ecpo.ECACLoss`.
        delay_actor: as for :class:`~torchrl_ecpo.ECACLoss`. Default: True.
        delay_qvalue: as for :class:`~torchrl_ecpo.ECACLoss`.
        delay_value: as for :class:`~torchrl_ecpo.ECACLoss`.
        separate_losses: as for :class:`~torchrl_ecpo.ECACLoss`.
        reduction: as for :class:`~torchrl_ecpo.ECACLoss`.
        skip_done_states: as for :class:`~torchrl_ecpo.ECACLoss`.
        use_prioritized_weights: as for :class:`~torchrl_ecpo.ECACLoss`.
        deactivate_vmap: as for :class:`~torchrl_ecpo.ECACLoss`.

    The outputs are those of :class:`~torchrl_ecpo.ECACLoss`.

    Raises:
        ValueError: as for :class:`~torchrl_ecpo.ECACLoss`.

    Examples:
        >>> import torch
        >>> from tensordict.nn import NormalParamExtractor, TensorDictModule
        >>> from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
        >>> from torchrl_ecpo import PeriodicCopy, PolyakAverage, UpdaterSequence
        >>> net = torch.nn.Sequential(torch.nn.Linear(3, 4), NormalParamExtractor())
        >>> module = TensorDictModule(net, ["observation"], ["loc", "scale"])
        >>> actor = ProbabilisticActor(module, ["loc", "scale"], distribution_class=TanhNormal)
        >>> qvalue = ValueOperator(
        ...     MLP(in_features=5, out_features=1, num_cells=[8]), ["observation", "action"])
        >>> loss_module = PMDACLoss(actor, qvalue, tau=0.1)
        >>> updater = UpdaterSequence(
        ...     PeriodicCopy(loss_module, "actor_network", interval=100),
        ...     PolyakAverage(loss_module, "qvalue_network"))
        >>> losses = loss_module(
        ...     observation=torch.randn(5, 3), action=torch.rand(5, 2) * 2 - 1,
        ...     next_observation=torch.randn(5, 3), next_reward=torch.rand(5, 1),
        ...     next_done=torch.zeros(5, 1, dtype=torch.bool),
        ...     next_terminated=torch.zeros(5, 1, dtype=torch.bool))
        >>> loss_module.out_keys[:3]
        ['loss_actor', 'loss_qvalue', 'loss_tau_prime']
        >>> sum(losses[:3]).backward()
    """

    _twin = "DiscretePMDACLoss"

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        tau: float = 0.1,
        tau_prime: float = 1.0,
        target_kl: float | None = None,
        target_entropy: float | Literal["auto"] | None = "auto",
        min_tau: float = 0.001,
        min_tau_prime: float = 0.003,
        num_qvalue_nets: int = 2,
        num_actor_states: int | None = None,
        num_action_samples: int = 1,
        num_next_action_samples: int = 1,
        loss_function: str = "l2",
        delay_actor: bool = True,
        delay_qvalue: bool | None = None,
        delay_value: bool = True,
        separate_losses: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
        skip_done_states: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        deactivate_vmap: bool = False,
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            value_network,
            tau=tau,
            tau_prime=tau_prime,
            target_kl=target_kl,
            target_entropy=target_entropy,
            min_tau=min_tau,
            min_tau_prime=min_tau_prime,
            num_qvalue_nets=num_qvalue_nets,
            num_actor_states=num_actor_states,
            num_action_samples=num_action_samples,
            num_next_action_samples=num_next_action_samples,
            loss_function=loss_function,
            delay_actor=delay_actor,
            delay_qvalue=delay_qvalue,
            delay_value=delay_value,
            separate_losses=separate_losses,
            reduction=reduction,
            skip_done_states=skip_done_states,
            use_prioritized_weights=use_prioritized_weights,
            deactivate_vmap=deactivate_vmap,
        )

    def project(
        self, tensordict: TensorDictBase, policy: Distribution, reference: Distribution
    ) -> tuple[Tensor, Lift]:
        """(tau + tau') KL(pi_theta, target) by one reparameterised action, in the unit of Q."""
        actions = sample_actions(policy, 1)
        score = self._qvalue_of(tensordict, actions.action, self.qvalue_network_params.data)
        tau, tau_prime = self.temperatures()
        loss = tau_prime * actions.log_prob - score
        if reference is not policy:  # which does not differ from itself
            loss = loss + tau * (actions.log_prob - log_prob_of(actions, reference))
        lift = self.lift(tensordict, reference, self.qvalue_network_params, self.num_action_samples)
        return loss.squeeze(0), lift


class DiscretePMDACLoss(DiscreteActorCriticLoss):
    r"""PMD-AC for discrete actions: (tau + tau') KL(pi, target), summed over all actions.

    Args:
        actor_network: as for :class:`~torchrl_ecpo.DiscreteECACLoss`.
        qvalue_network: as for :class:`~torchrl_ecpo.DiscreteECACLoss`.
        value_network: as for :class:`~torchrl_ecpo.DiscreteECACLoss`.

    Keyword Args:
        tau: as for :class:`PMDACLoss`. Default: 0.1.
        tau_prime: as for :class:`PMDACLoss`. Default: 0.1.
        target_kl: as for :class:`~torchrl_ecpo.DiscreteECACLoss`. Default: None, a fixed tau.
        target_entropy: as for :class:`~torchrl_ecpo.DiscreteECACLoss`. Default: None.
        min_tau: as for :class:`~torchrl_ecpo.ECACLoss`.
        min_tau_prime: as for :class:`~torchrl_ecpo.ECACLoss`.
        num_qvalue_nets: as for :class:`~torchrl_ecpo.ECACLoss`.
        num_actor_states: as for :class:`~torchrl_ecpo.ECACLoss`.
        loss_function: as for :class:`~torchrl_ecpo.ECACLoss`.
        delay_actor: as for :class:`PMDACLoss`. Default: True.
        delay_qvalue: as for :class:`~torchrl_ecpo.ECACLoss`.
        delay_value: as for :class:`~torchrl_ecpo.ECACLoss`.
        separate_losses: as for :class:`~torchrl_ecpo.ECACLoss`.
        reduction: as for :class:`~torchrl_ecpo.ECACLoss`.
        skip_done_states: as for :class:`~torchrl_ecpo.ECACLoss`.
        use_prioritized_weights: as for :class:`~torchrl_ecpo.ECACLoss`.
        deactivate_vmap: as for :class:`~torchrl_ecpo.ECACLoss`.

    The outputs are those of :class:`~torchrl_ecpo.DiscreteECACLoss`.

    Raises:
        ValueError: as for :class:`~torchrl_ecpo.DiscreteECACLoss`.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import OneHotCategorical, ProbabilisticActor
        >>> net = TensorDictModule(torch.nn.Linear(3, 4), ["observation"], ["logits"])
        >>> actor = ProbabilisticActor(net, ["logits"], distribution_class=OneHotCategorical)
        >>> qvalue = TensorDictModule(torch.nn.Linear(3, 4), ["observation"], ["action_value"])
        >>> loss_module = DiscretePMDACLoss(actor, qvalue, delay_actor=False, delay_qvalue=False)
        >>> loss_actor, *_ = loss_module(
        ...     observation=torch.randn(5, 3), action=torch.eye(4)[torch.randint(4, (5,))],
        ...     next_observation=torch.randn(5, 3), next_reward=torch.rand(5, 1),
        ...     next_done=torch.zeros(5, 1, dtype=torch.bool),
        ...     next_terminated=torch.zeros(5, 1, dtype=torch.bool))
        >>> loss_actor.backward()
    """

    _twin = "PMDACLoss"

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        tau: float = 0.1,
        tau_prime: float = 0.1,
        target_kl: float | None = None,
        target_entropy: float | Literal["auto"] | None = None,
        min_tau: float = 0.001,
        min_tau_prime: float = 0.003,
        num_qvalue_nets: int = 2,
        num_actor_states: int | None = None,
        loss_function: str = "l2",
        delay_actor: bool = True,
        delay_qvalue: bool | None = None,
        delay_value: bool = True,
        separate_losses: bool = False,
        reduction: Literal["none", "mean", "sum"] | None = None,
        skip_done_states: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        deactivate_vmap: bool = False,
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            value_network,
            tau=tau,
            tau_prime=tau_prime,
            target_kl=target_kl,
            target_entropy=target_entropy,
            min_tau=min_tau,
            min_tau_prime=min_tau_prime,
            num_qvalue_nets=num_qvalue_nets,
            num_actor_states=num_actor_states,
            loss_function=loss_function,
            delay_actor=delay_actor,
            delay_qvalue=delay_qvalue,
            delay_value=delay_value,
            separate_losses=separate_losses,
            reduction=reduction,
            skip_done_states=skip_done_states,
            use_prioritized_weights=use_prioritized_weights,
            deactivate_vmap=deactivate_vmap,
        )

    def project(
        self, tensordict: TensorDictBase, policy: Distribution, reference: Distribution
    ) -> tuple[Tensor, Lift]:
        """(tau + tau') KL(pi_theta, target), in the unit of Q."""
        lift = self.lift(tensordict, reference, self.qvalue_network_params, self.num_action_samples)
        log_prob = log_probs_of_all(policy)
        tau, tau_prime = self.temperatures()
        divergence = (log_prob.exp() * (log_prob - lift.log_weights.log_softmax(0))).sum(0)
        return (tau + tau_prime) * divergence, lift
