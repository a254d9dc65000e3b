"""Policy Mirror Descent as an actor-critic."""

from __future__ import annotations

from typing import Any, Literal

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule

from torchrl_ecpo.checks import as_float
from torchrl_ecpo.functional import Surrogate
from torchrl_ecpo.objectives.actions import AllActions, actions_of
from torchrl_ecpo.objectives.actor_critic import ActorCriticLoss, States


class PMDACLoss(ActorCriticLoss):
    r"""PMD-AC for continuous actions: ECAC's lift, and the mode-seeking projection KL(pi, target).

    With one reparameterised action of the policy at each state, in the unit of Q,

    .. math::
        L(\theta) = (\tau + \tau') \log \pi_\theta(a|s) - \tau \log \bar\pi(a|s) - Q(s, a),
        \quad a \sim \pi_\theta(\cdot|s)

    which is :math:`(\tau + \tau') \mathrm{KL}(\pi_\theta \| \bar\pi^*)` up to a constant.
    ``tau_prime=0, target_entropy=None`` is the paper's PMD-AC, a positive tau_prime its
    PMD-AC+entropy. At tau = 0 it is SAC.

    Over one of n actions it is (tau + tau') KL(pi, target) itself, summed over all of them. At
    tau = 0 the policy's loss is SAC's there too, but a state is worth its soft value, the maximum
    over policies, where SAC takes that of the policy.

    Arguments, errors and outputs are those of :class:`~torchrl_ecpo.ECACLoss` without
    ``projection`` and ``width_entropy``, and with these differences:

    Keyword Args:
        tau: temperature of the divergence from the reference, in the unit of Q. The policy's
            loss depends on it with ``delay_actor=True`` only: a policy does not differ from itself.
            Default: 0.1.
        target_kl: needs several ``num_action_samples``. Default: None, a fixed tau.
        num_action_samples: actions of the reference by which lift, metrics and the value network's
            target are estimated; the projection does not need them. Default: 1.
        delay_actor: default: True.

    Raises:
        ValueError: as :class:`~torchrl_ecpo.ECACLoss`.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded
        >>> from torchrl_ecpo import PeriodicCopy, PolyakAverage, UpdaterSequence
        >>> from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
        >>> actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
        >>> loss_module = PMDACLoss(actor, make_qvalue_network(3, 2), tau=0.1)
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

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        tau: float = 0.1,
        target_kl: float | None = None,
        num_action_samples: int = 1,
        delay_actor: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            value_network,
            tau=tau,
            target_kl=target_kl,
            num_action_samples=num_action_samples,
            delay_actor=delay_actor,
            **options,
        )

    def project(self, states: States) -> Surrogate:
        """(tau + tau') KL(pi_theta, target), in the unit of Q: by one action, or summed."""
        tau, tau_prime = self.temperatures()
        actions = actions_of(states.policy, 1)
        if isinstance(actions, AllActions):
            log_target = states.lift.log_weights.log_softmax(0)
            divergence = actions.mean(actions.log_prob - log_target)
            return Surrogate((tau + tau_prime) * divergence, states.lift.weights)
        score = self.score_of(states.observations, actions, self.qvalue_network_params.detach())
        loss = tau_prime * actions.log_prob - score
        if states.reference is not states.policy:  # which does not differ from itself
            loss = loss + tau * (actions.log_prob - actions.log_prob_of(states.reference))
        return Surrogate(loss.squeeze(0), states.lift.weights)


class DiscretePMDACLoss(PMDACLoss):
    r"""PMD-AC for discrete actions: (tau + tau') KL(pi, target), summed over all actions.

    Networks, outputs and the meaning of the constraints are those of
    :class:`~torchrl_ecpo.DiscreteECACLoss`, the other arguments those of :class:`PMDACLoss`.

    Keyword Args:
        tau_prime: default: 0.1.
        target_entropy: default: None, a fixed tau_prime.
        target_entropy_weight: default: 0.98.

    Raises:
        ValueError: as :class:`~torchrl_ecpo.DiscreteECACLoss`.

    Examples:
        >>> import torch
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.modules import OneHotCategorical, ProbabilisticActor
        >>> net = TensorDictModule(torch.nn.Linear(3, 4), ["observation"], ["logits"])
        >>> actor = ProbabilisticActor(net, ["logits"], distribution_class=OneHotCategorical)
        >>> qvalue = TensorDictModule(torch.nn.Linear(3, 4), ["observation"], ["action_value"])
        >>> loss_module = DiscretePMDACLoss(actor, qvalue, delay_actor=False, delay_qvalue=False)
        >>> loss_module.out_keys[:3]
        ['loss_actor', 'loss_qvalue', 'ESS']
    """

    takes_choices_only = True

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        tau_prime: float = 0.1,
        target_entropy: float | Literal["auto"] | None = None,
        target_entropy_weight: float = 0.98,
        **options: Any,
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            value_network,
            tau_prime=tau_prime,
            target_entropy=target_entropy,
            **options,
        )
        self.target_entropy_weight = as_float(
            "target_entropy_weight", target_entropy_weight, "(0, 1)"
        )
