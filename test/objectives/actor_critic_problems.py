"""Small networks, transitions and the actor-critic losses in plain numbers, for the tests."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    NormalParamExtractor,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torch.nn.functional import softplus
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from trajectory_problems import ACTORS, OBSERVATION, as_keywords

from torchrl_ecpo import (
    ActorCriticLoss,
    DiscreteECACLoss,
    DiscretePMDACLoss,
    ECACLoss,
    MPOLoss,
    PMDACLoss,
    PolyakAverage,
)

ACTION, CHOICES, GAMMA = 2, 4, 0.9
FIXED = {"target_kl": None, "target_entropy": None}
LEARNED = {"target_kl": 0.05, "target_entropy": 0.6}

# ------------------------------------------------------------------------------------ the networks


def _bounded() -> ProbabilisticTensorDictSequential:
    """Actions from -2 to 3."""
    network = nn.Sequential(nn.Linear(OBSERVATION, 2 * ACTION), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 3.0},
    )


POLICIES: dict[str, Callable[[], ProbabilisticTensorDictSequential]] = {
    **{kind: ACTORS[kind] for kind in ("tanh_normal", "normal", "categorical", "one_hot")},
    "bounded": _bounded,
}
DISCRETE = ("categorical", "one_hot")


def make_qvalue(kind: str) -> TensorDictModule:
    """Q of one action, or of all actions where they are discrete."""
    if kind in DISCRETE:
        network = MLP(in_features=OBSERVATION, out_features=CHOICES, num_cells=[5])
        return TensorDictModule(network, ["observation"], ["action_value"])
    network = MLP(in_features=OBSERVATION + ACTION, out_features=1, num_cells=[5])
    return ValueOperator(network, ["observation", "action"])


@dataclass
class Networks:
    """An actor, two critics that differ, and a value network."""

    actor: ProbabilisticTensorDictSequential
    qvalues: list[TensorDictModule]
    value: TensorDictModule


def make_networks(
    kind: str = "tanh_normal", *, seed: int = 1, dtype: torch.dtype = torch.float64
) -> Networks:
    """The same parameters every time."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = MLP(in_features=OBSERVATION, out_features=1, num_cells=[5])
        return Networks(
            POLICIES[kind]().to(dtype),
            [make_qvalue(kind).to(dtype) for _ in range(2)],
            ValueOperator(network, ["observation"]).to(dtype),
        )


def become(loss: ActorCriticLoss, networks: Networks) -> None:
    """Put other parameters into the trained networks, in place; the delayed ones stay."""
    loss.actor_network_params.data.copy_(TensorDict.from_module(networks.actor).data)
    loss.qvalue_network_params.data.copy_(TensorDict.from_modules(*networks.qvalues).data)
    if loss.value_network is not None:
        loss.value_network_params.data.copy_(TensorDict.from_module(networks.value).data)


# -------------------------------------------------------------------------------------- the losses


@dataclass
class Case:
    """A loss, the policy it is tested with, and temperatures other than its defaults."""

    loss: type[ActorCriticLoss]
    kind: str
    options: dict[str, Any] = field(default_factory=dict)
    value: bool = False
    tau: float = 0.75
    tau_prime: float = 0.25

    @property
    def is_discrete(self) -> bool:
        return self.kind in DISCRETE

    def build(
        self,
        networks: Networks | None = None,
        *,
        value: bool | None = None,
        updater: bool = True,
        **options: Any,
    ) -> ActorCriticLoss:
        """In the dtype of the networks; temperatures are fixed unless options say otherwise."""
        networks = make_networks(self.kind) if networks is None else networks
        has_value = self.value if value is None else value
        temperatures = {"tau": self.tau, "tau_prime": self.tau_prime}
        loss = self.loss(
            networks.actor,
            networks.qvalues,
            networks.value if has_value else None,
            **{**temperatures, **FIXED, **self.options, **options},
        )
        loss.make_value_estimator(gamma=GAMMA)
        loss.to(next(networks.actor.parameters()).dtype)
        if updater and any("target" in name for name, _ in loss.named_children()):
            PolyakAverage(loss)
        return loss


CASES = {
    "ecac": Case(ECACLoss, "tanh_normal"),
    "pmd_ac": Case(PMDACLoss, "tanh_normal", {"num_action_samples": 4}),
    "mpo": Case(MPOLoss, "tanh_normal", {"epsilon": 0.2, "min_tau": 1e-9}),
    "discrete_ecac": Case(DiscreteECACLoss, "categorical"),
    "discrete_pmd_ac": Case(DiscretePMDACLoss, "one_hot"),
}


def out_keys(case: Case, *, value: bool, learned: bool = False) -> list[str]:
    """As documented."""
    losses = ["loss_actor", "loss_qvalue", *(["loss_value"] if value else [])]
    losses += ["loss_tau", "loss_tau_prime"] if learned else []
    losses += case.loss.losses
    metrics = ["ESS", "kl_target_reference", "kl_reference_policy", "entropy"]
    metrics += [] if case.is_discrete else ["saturation"]
    return [*losses, *metrics, "qvalue", "state_value", *case.loss.metrics, "tau", "tau_prime"]


def total(losses: TensorDictBase) -> Tensor:
    """The sum of all that is to be minimised."""
    return sum(value.sum() for name, value in losses.items() if name.startswith("loss_"))  # type: ignore


def gradients(loss: ActorCriticLoss, value: Tensor) -> dict[str, Tensor]:
    """Of every parameter, by name; zero where there is none."""
    names, parameters = zip(*loss.named_parameters(), strict=True)
    values = torch.autograd.grad(value, parameters, allow_unused=True, retain_graph=True)
    return {
        name: torch.zeros_like(parameter) if value is None else value
        for name, parameter, value in zip(names, parameters, values, strict=True)
    }


def call(loss: ActorCriticLoss, batch: TensorDictBase, seed: int = 0) -> TensorDictBase:
    """With the same random numbers every time."""
    torch.manual_seed(seed)
    return loss(batch)


# ---------------------------------------------------------------------------------- the transitions


def make_batch(
    kind: str = "tanh_normal",
    *shape: int,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> TensorDict:
    """Transitions ``[*B]``; the second is terminated, the third cut off by a time limit."""
    shape = shape or (6,)
    generator = torch.Generator().manual_seed(seed)

    def normal(size: int) -> Tensor:
        return torch.randn(*shape, size, generator=generator, dtype=dtype)

    if kind in DISCRETE:
        action = torch.randint(CHOICES, shape, generator=generator)
        if kind == "one_hot":
            action = nn.functional.one_hot(action, CHOICES)
    else:
        action = normal(ACTION).tanh()
    terminated = torch.zeros(*shape, 1, dtype=torch.bool)
    done = terminated.clone()
    terminated.view(-1)[1] = True
    done.view(-1)[1:3] = True
    return TensorDict(
        {
            "observation": normal(OBSERVATION),
            "action": action,
            "next": {
                "observation": normal(OBSERVATION),
                "reward": normal(1),
                "done": done,
                "terminated": terminated,
            },
        },
        batch_size=shape,
    )


def call_by_keywords(loss: ActorCriticLoss, batch: TensorDictBase, seed: int = 0) -> Any:
    """As :func:`call`, without a tensordict: the outputs in the order of the out_keys."""
    torch.manual_seed(seed)
    return loss(**as_keywords(loss, batch))


# ------------------------------------------------------------------------------ in plain numbers
#
# Written from the paper, with nothing of the package: the networks, and sums over actions.


def _observing(observation: Tensor, **entries: Tensor) -> TensorDict:
    return TensorDict({"observation": observation, **entries}, batch_size=observation.shape[:-1])


def _draw(actor: ProbabilisticTensorDictSequential, observation: Tensor, m: int):
    """M pre-tanh samples ``[M, B, A]`` of the Gaussian that the actor's network describes."""
    parameters = actor[0](_observing(observation))
    loc, scale = parameters["loc"], parameters["scale"]
    return loc + scale * torch.randn(m, *loc.shape, dtype=loc.dtype)


def gaussian_log_prob(actor, observation: Tensor, latent: Tensor) -> Tensor:
    """Log-density ``[M, B]`` of tanh(latent), as SAC's appendix C has it."""
    parameters = actor[0](_observing(observation))
    loc, scale = parameters["loc"], parameters["scale"]
    normal = -0.5 * ((latent - loc) / scale) ** 2 - scale.log() - 0.5 * math.log(2 * math.pi)
    log_volume = 2 * (math.log(2) - latent - softplus(-2 * latent))
    return (normal - log_volume).sum(-1)


def smallest_qvalue(qvalues: list[TensorDictModule], observation: Tensor, action: Tensor) -> Tensor:
    """``[M, B]`` of actions ``[M, B, A]``."""
    observation = observation.expand(*action.shape[:-1], -1)
    inputs = TensorDict({"observation": observation, "action": action}, action.shape[:-1])
    values = [q(inputs.clone())["state_action_value"].squeeze(-1) for q in qvalues]
    return torch.stack(values).min(0).values


@dataclass
class Lifted:
    """The lift by M samples, or by all actions."""

    score: Tensor
    reference: Tensor
    weights: Tensor
    value: Tensor
    latent: Tensor | None = None


def lift_by_samples(
    actor, qvalues, observation: Tensor, m: int, *, tau: float, tau_prime: float
) -> Lifted:
    """The display above Eq. 9, with actions of the actor."""
    with torch.no_grad():
        latent = _draw(actor, observation, m)
        reference = gaussian_log_prob(actor, observation, latent)
        score = smallest_qvalue(qvalues, observation, latent.tanh())
        ratio = ((score - tau_prime * reference) / (tau + tau_prime)).exp()
        value = (tau + tau_prime) * ratio.mean(0).log()
    return Lifted(score, reference, ratio / ratio.sum(0), value, latent)


def probabilities(actor, observation: Tensor) -> Tensor:
    """``[n, B]``."""
    return actor[0](_observing(observation))["logits"].softmax(-1).movedim(-1, 0)


def lift_by_summation(
    actor, qvalues, observation: Tensor, *, tau: float, tau_prime: float
) -> Lifted:
    """Eq. 8, over all actions."""
    with torch.no_grad():
        reference = probabilities(actor, observation)
        values = [q(_observing(observation))["action_value"] for q in qvalues]
        score = torch.stack(values).min(0).values.movedim(-1, 0)
        target = ((score + tau * reference.log()) / (tau + tau_prime)).exp()
        value = (tau + tau_prime) * target.sum(0).log()
    return Lifted(score, reference.log(), target / target.sum(0), value)


def chosen_qvalues(kind: str, qvalues: list[TensorDictModule], batch: TensorDictBase) -> Tensor:
    """``[2, B]``."""
    outputs = [q(batch.select("observation", "action")) for q in qvalues]
    if kind not in DISCRETE:
        return torch.stack([output["state_action_value"].squeeze(-1) for output in outputs])
    values = torch.stack([output["action_value"] for output in outputs])
    action = batch["action"] if kind == "categorical" else batch["action"].argmax(-1)
    return torch.stack([values[:, i, a] for i, a in enumerate(action)], -1)


def mpo_outputs(case: Case, actor, reference, observation: Tensor, lifted: Lifted):
    """The M-step, at multipliers of 1, and what is learned beside it."""
    (loc, scale), (old_loc, old_scale) = (
        [each[0](_observing(observation))[key] for key in ("loc", "scale")]
        for each in (actor, reference)
    )
    of_mean = 0.5 * ((loc - old_loc) / old_scale) ** 2
    of_scale = 0.5 * (old_scale / scale) ** 2 - 0.5 + (scale / old_scale).log()
    fit_mean = 0.5 * ((lifted.latent - loc) / old_scale) ** 2 + old_scale.log()
    fit_scale = 0.5 * ((lifted.latent - old_loc) / scale) ** 2 + scale.log()
    each = (fit_mean + fit_scale + math.log(2 * math.pi)).sum(-1)
    divergence = (lifted.weights * (lifted.weights * len(lifted.weights)).log()).sum(0)
    one = torch.ones_like(divergence)
    return {
        "loss_actor": (lifted.weights * each).sum(0) + of_mean.sum(-1) + of_scale.sum(-1),
        "loss_tau": -math.log(case.tau) * (divergence / case.options["epsilon"] - 1),
        "kl_mean": of_mean.sum(-1),
        "kl_scale": of_scale.sum(-1),
        **dict.fromkeys(("loss_alpha_mean", "loss_alpha_scale"), 0 * one),
        **dict.fromkeys(("alpha_mean", "alpha_scale"), one),
    }


def expected_outputs(
    case: Case,
    new: Networks,
    old: Networks,
    batch: TensorDictBase,
    *,
    value: bool,
    delay_actor: bool,
    num_action_samples: int = 8,
    num_next_action_samples: int = 1,
) -> dict[str, Tensor]:
    """All losses and metrics of each transition; ``old`` are the delayed networks."""
    temperatures = {"tau": case.tau, "tau_prime": case.tau_prime}
    state, following = batch["observation"], batch["next", "observation"]
    reference = old.actor if delay_actor else deepcopy(new.actor).requires_grad_(False)

    def lift(qvalues: list[TensorDictModule], observation: Tensor, m: int) -> Lifted:
        if case.is_discrete:
            return lift_by_summation(reference, qvalues, observation, **temperatures)
        lifted = lift_by_samples(reference, qvalues, observation, m, **temperatures)
        return replace(lifted, value=lifted.score.mean(0)) if case.loss is MPOLoss else lifted

    with torch.no_grad():
        if value:
            next_value = old.value(_observing(following))["state_value"].squeeze(-1)
        else:
            next_value = lift(old.qvalues, following, num_next_action_samples).value
        is_terminated = batch["next", "terminated"].squeeze(-1)
        target = batch["next", "reward"].squeeze(-1) + GAMMA * next_value * ~is_terminated

    qvalue = chosen_qvalues(case.kind, new.qvalues, batch)
    outputs = {
        "loss_qvalue": ((qvalue - target) ** 2).sum(0),
        "td_error": (qvalue - target).abs().max(0).values.detach(),
    }

    if case.loss is PMDACLoss:
        latent = _draw(new.actor, state, 1)
        log_prob = gaussian_log_prob(new.actor, state, latent)
        score = smallest_qvalue(new.qvalues, state, latent.tanh())
        divergence = log_prob - gaussian_log_prob(reference, state, latent)
        if not delay_actor:
            divergence = 0.0
        lifted = lift(new.qvalues, state, num_action_samples)
        loss = case.tau * divergence + case.tau_prime * log_prob - score
        outputs["loss_actor"] = loss.squeeze(0)
    elif case.loss is MPOLoss:
        lifted = lift(new.qvalues, state, num_action_samples)
        outputs |= mpo_outputs(case, new.actor, reference, state, lifted)
    else:
        lifted = lift(new.qvalues, state, num_action_samples)
        if case.is_discrete:
            probability = probabilities(new.actor, state)
            log_prob = probability.log()
        else:
            log_prob = gaussian_log_prob(new.actor, state, lifted.latent)
        if case.loss is DiscretePMDACLoss:
            divergence = (probability * (log_prob - lifted.weights.log())).sum(0)
            outputs["loss_actor"] = (case.tau + case.tau_prime) * divergence
        else:  # to the letter; ECAC's centred gradients have tests of their own
            outputs["loss_actor"] = -(lifted.weights * log_prob).sum(0)

    if value:
        error = new.value(_observing(state))["state_value"].squeeze(-1) - lifted.value
        outputs["loss_value"] = error**2
    weights = lifted.weights
    if case.is_discrete:
        probability = lifted.reference.exp()
        log_prob = probabilities(new.actor, state).log().detach()
        outputs |= {
            "kl_target_reference": (weights * (weights.log() - lifted.reference)).sum(0),
            "kl_reference_policy": (probability * (lifted.reference - log_prob)).sum(0),
            "entropy": -(probability * lifted.reference).sum(0),
            "qvalue": (probability * lifted.score).sum(0),
        }
    else:
        log_prob = gaussian_log_prob(new.actor, state, lifted.latent).detach()
        outputs |= {
            "kl_target_reference": (weights * (weights * len(weights)).log()).sum(0),
            "kl_reference_policy": (lifted.reference - log_prob).mean(0),
            "entropy": -lifted.reference.mean(0),
            "qvalue": lifted.score.mean(0),
            "saturation": (lifted.latent.tanh().abs() > 0.95)
            .to(batch["observation"].dtype)
            .mean((0, -1)),
        }
    return outputs | {
        "ESS": 1 / (weights**2).sum(0),
        "state_value": lifted.value,
        "tau": torch.full_like(lifted.value, case.tau),
        "tau_prime": torch.full_like(lifted.value, case.tau_prime),
    }
