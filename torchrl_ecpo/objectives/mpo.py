"""Maximum a Posteriori Policy Optimisation."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch.distributions import Normal, kl_divergence

from torchrl_ecpo.checks import as_float
from torchrl_ecpo.functional import Surrogate, mean_seeking_projection
from torchrl_ecpo.objectives.actions import SampledActions, gaussian_parameters
from torchrl_ecpo.objectives.actor_critic import ActorCriticLoss, States


class MPOLoss(ActorCriticLoss):
    r"""MPO: ECAC's lift with bounded divergences instead of temperatures.

    Abdolmaleki et al., "Maximum a Posteriori Policy Optimisation", ICLR 2018, with the decoupled
    bounds of "Relative Entropy Regularized Policy Iteration", 2018. With M actions of the delayed
    policy at each state, the target is at most epsilon nats from it in the mean over states,

    .. math::
        w = \mathrm{softmax}_m \frac{Q(s, a_m)}{\tau}, \quad
        \tau = \arg\min_\tau \; \tau \epsilon + \tau \, \mathbb{E}_s
            \log \frac1M \sum_m \exp \frac{Q(s, a_m)}{\tau}, \quad a_m \sim \bar\pi(\cdot|s)

    and mean and scale of a Gaussian policy each follow it with the other held at the reference's,

    .. math::
        L(\theta) = \sum_{j \in \{\mu, \sigma\}} \Big[ -\sum_m w_m \log \pi_j(a_m|s)
            + \alpha_j D_{KL}(\bar\pi \| \pi_j) \Big], \quad
        \pi_\mu = N(\mu_\theta, \bar\sigma), \quad \pi_\sigma = N(\bar\mu, \sigma_\theta)

    The dual's derivative is :math:`\epsilon - D_{KL}(w \| \bar\pi)`: tau is learned as each
    multiplier alpha is, up where its divergence exceeds its bound, else down, in log-space
    (``dual``, of the divergence in units of its bound less 1). So tau goes where ECAC's does
    with ``target_kl`` = epsilon / A. While the policy is the reference the gradients of mean and
    scale are those of ``ECACLoss(projection="paper")``; the farther it is, the more the bounds say.

    Arguments, errors and outputs are those of :class:`~torchrl_ecpo.ECACLoss` without
    ``projection``, ``width_entropy`` and ``target_kl``, and with these differences. A state is
    worth the delayed policy's mean of Q: there is no entropy in Q. Of a tanh-Gaussian policy mean,
    scale and divergences are those before the transform.

    Keyword Args:
        epsilon: bound of KL(target, pi_bar) in nats, below log M. Default: 0.1 (Acme's).
        epsilon_mean: bound of KL(pi_bar, pi_mu) in nats, over all dimensions of an action. Default:
            0.01, ours; Acme has 0.001 or 0.0025 a dimension.
        epsilon_scale: bound of KL(pi_bar, pi_sigma), likewise. Default: 0.001, ours; Acme's 1e-6 a
            dimension keeps the scale all but fixed on runs as short as ours.
        tau: where the temperature starts. Default: 1. The multipliers start at 1, too.
        tau_prime: temperature of an entropy term in the target, ECPO's. Default: 0 (the paper).
        target_entropy: default: None, a fixed tau_prime.
        num_action_samples: M. Default: 20 (Acme's).
        num_next_action_samples: default: 20 (Acme's).
        delay_actor: default: True. The bounds are from the delayed policy, which an updater moves;
            without a delay they are from the policy itself, and nothing holds it.

    Further outputs are ``loss_tau``, ``loss_alpha_mean`` and ``loss_alpha_scale`` (parameters
    ``log_tau``, ``log_alpha_mean`` and ``log_alpha_scale``) and the metrics ``kl_mean``,
    ``kl_scale``, ``alpha_mean`` and ``alpha_scale``.

    Raises:
        ValueError: also for a bound that is not above 0, an epsilon that M samples cannot show, a
            ``target_kl``, and, when called, a policy that is no diagonal Gaussian.

    Examples:
        >>> from torchrl.data import Bounded
        >>> from torchrl_ecpo import PeriodicCopy, PolyakAverage, UpdaterSequence
        >>> from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
        >>> actor = make_tanh_gaussian_actor(3, Bounded(-1.0, 1.0, shape=(2,)))
        >>> loss_module = MPOLoss(actor, make_qvalue_network(3, 2))
        >>> updater = UpdaterSequence(
        ...     PeriodicCopy(loss_module, "actor_network", interval=100),
        ...     PolyakAverage(loss_module, "qvalue_network"))
        >>> losses = loss_module(
        ...     observation=torch.randn(5, 3), action=torch.rand(5, 2) * 2 - 1,
        ...     next_observation=torch.randn(5, 3), next_reward=torch.rand(5, 1),
        ...     next_done=torch.zeros(5, 1, dtype=torch.bool),
        ...     next_terminated=torch.zeros(5, 1, dtype=torch.bool))
        >>> loss_module.out_keys[:5]
        ['loss_actor', 'loss_qvalue', 'loss_tau', 'loss_alpha_mean', 'loss_alpha_scale']
        >>> sum(losses[:5]).backward()
    """

    losses = ("loss_tau", "loss_alpha_mean", "loss_alpha_scale")
    metrics = ("kl_mean", "kl_scale", "alpha_mean", "alpha_scale")
    has_soft_value = False

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        value_network: TensorDictModule | None = None,
        *,
        epsilon: float = 0.1,
        epsilon_mean: float = 0.01,
        epsilon_scale: float = 0.001,
        tau: float = 1.0,
        tau_prime: float = 0.0,
        target_kl: None = None,
        target_entropy: float | Literal["auto"] | None = None,
        num_action_samples: int = 20,
        num_next_action_samples: int = 20,
        delay_actor: bool = True,
        **options: Any,
    ) -> None:
        if target_kl is not None:
            raise ValueError(f"MPO's lift has the bound epsilon; got target_kl={target_kl}.")
        super().__init__(
            actor_network,
            qvalue_network,
            value_network,
            tau=tau,
            tau_prime=tau_prime,
            target_kl=None,
            target_entropy=target_entropy,
            num_action_samples=num_action_samples,
            num_next_action_samples=num_next_action_samples,
            delay_actor=delay_actor,
            **options,
        )
        bounds = {"epsilon": epsilon, "epsilon_mean": epsilon_mean, "epsilon_scale": epsilon_scale}
        self.bounds = {name: as_float(name, bound) for name, bound in bounds.items()}
        for name, bound in self.bounds.items():
            most = math.log(self.num_action_samples) if name == "epsilon" else math.inf
            if not 0 < bound < most:
                raise ValueError(
                    f"{name} must be above 0 and below {most:.3g}, in nats (epsilon below what "
                    f"num_action_samples={self.num_action_samples} can show), got {bound}."
                )
        self.learn("tau", float(tau), floor=self.min_tau)
        for name in ("alpha_mean", "alpha_scale"):
            self.learn(name, 1.0)

    def project(self, states: States) -> Surrogate:
        """Fit mean and scale to the lift's weights, each within its bound of the reference."""
        lift, actions, bound = states.lift, states.lift.actions, self.bounds
        loc, scale = gaussian_parameters(states.policy)
        assert isinstance(actions, SampledActions)
        old_loc, old_scale = (x.detach() for x in gaussian_parameters(states.reference))
        reference = Normal(old_loc, old_scale, validate_args=False)
        divergence = actions.divergence_of(lift.weights, lift.log_weights)
        losses = {"loss_tau": self.dual("tau", divergence / bound["epsilon"] - 1, states.mask)}
        loss, metrics = torch.zeros_like(divergence), {}
        for name, parameters in {"mean": (loc, old_scale), "scale": (old_loc, scale)}.items():
            part = Normal(*parameters, validate_args=False)
            alpha, divergence = f"alpha_{name}", kl_divergence(reference, part).sum(-1)
            log_prob = part.log_prob(actions.latent).sum(-1)
            fit = mean_seeking_projection(log_prob, lift.log_weights, sample_dim=0).loss
            loss = loss + fit + self.temperature(alpha) * divergence
            excess = divergence / bound[f"epsilon_{name}"] - 1
            losses[f"loss_{alpha}"] = self.dual(alpha, excess, states.mask)
            metrics |= {f"kl_{name}": divergence, alpha: self.temperature(alpha)}
        return Surrogate(loss, lift.weights, losses, metrics)
