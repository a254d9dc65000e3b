"""Small actors, sampled batches and the losses written out in plain numbers, for the tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict.nn import (
    CompositeDistribution,
    InteractionType,
    NormalParamExtractor,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    set_interaction_type,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.modules import (
    GRUModule,
    IndependentNormal,
    LSTMModule,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
    set_recurrent_mode,
)
from torchrl.objectives import HardUpdate

from torchrl_ecpo.objectives import (
    ECPOLoss,
    GRPOLoss,
    MENTLoss,
    PMDLoss,
    RLOOLoss,
    SquaredPMDLoss,
    TPOLoss,
    TrajectoryGroupLoss,
    UREXLoss,
)

OBSERVATION, ACTIONS, HIDDEN = 3, 4, 5
MASK = ("collector", "mask")

# ------------------------------------------------------------------------------------- the actors


def _probabilistic(
    distribution: type, parameters: list[str], *modules: nn.Module
) -> ProbabilisticActor:
    network = TensorDictModule(nn.Sequential(*modules), ["observation"], parameters)
    return ProbabilisticActor(
        network, in_keys=parameters, distribution_class=distribution, return_log_prob=True
    )


def _composite() -> ProbabilisticTensorDictSequential:
    heads = [("params", "move", "logits"), ("params", "force", "loc"), ("params", "force", "scale")]
    return ProbabilisticTensorDictSequential(
        TensorDictModule(nn.Linear(OBSERVATION, 3), ["observation"], heads[:1]),
        TensorDictModule(
            nn.Sequential(nn.Linear(OBSERVATION, 4), NormalParamExtractor()),
            ["observation"],
            heads[1:],
        ),
        ProbabilisticTensorDictModule(
            in_keys=["params"],
            out_keys=[("action", "move"), "force"],
            distribution_class=CompositeDistribution,
            distribution_kwargs={
                "distribution_map": {"move": Categorical, "force": IndependentNormal},
                "name_map": {"move": ("action", "move"), "force": "force"},
            },
            return_log_prob=True,
        ),
    )


class _AfterMove(nn.Module):
    """Logits of the second part of an action, given the first."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(OBSERVATION + ACTIONS, 3)

    def forward(self, observation: Tensor, move: Tensor) -> Tensor:
        first = nn.functional.one_hot(move, ACTIONS).to(observation.dtype)
        return self.linear(torch.cat([observation, 5 * first], -1))


def _part_by_part() -> ProbabilisticTensorDictSequential:
    def part(name: str) -> ProbabilisticTensorDictModule:
        return ProbabilisticTensorDictModule(
            in_keys={"logits": f"{name}_logits"},
            out_keys=[name],
            distribution_class=Categorical,
            return_log_prob=True,
            log_prob_key=f"{name}_log_prob",
        )

    return ProbabilisticTensorDictSequential(
        TensorDictModule(nn.Linear(OBSERVATION, ACTIONS), ["observation"], ["move_logits"]),
        part("move"),
        TensorDictModule(_AfterMove(), ["observation", "move"], ["write_logits"]),
        part("write"),
    )


def _recurrent(
    module: type[LSTMModule] | type[GRUModule],
) -> ProbabilisticTensorDictSequential:
    return ProbabilisticTensorDictSequential(
        module(input_size=OBSERVATION, hidden_size=HIDDEN, in_key="observation", out_key="memory"),
        TensorDictModule(nn.Linear(HIDDEN, ACTIONS), ["memory"], ["logits"]),
        ProbabilisticTensorDictModule(
            in_keys=["logits"],
            out_keys=["action"],
            distribution_class=Categorical,
            return_log_prob=True,
        ),
    )


ACTORS: dict[str, Callable[[], ProbabilisticTensorDictSequential]] = {
    "categorical": lambda: _probabilistic(Categorical, ["logits"], nn.Linear(OBSERVATION, ACTIONS)),
    "one_hot": lambda: _probabilistic(
        OneHotCategorical, ["logits"], nn.Linear(OBSERVATION, ACTIONS)
    ),
    "normal": lambda: _probabilistic(
        IndependentNormal, ["loc", "scale"], nn.Linear(OBSERVATION, 4), NormalParamExtractor()
    ),
    "tanh_normal": lambda: _probabilistic(
        TanhNormal, ["loc", "scale"], nn.Linear(OBSERVATION, 4), NormalParamExtractor()
    ),
    "composite": _composite,
    "part_by_part": _part_by_part,
    "lstm": lambda: _recurrent(LSTMModule),
    "gru": lambda: _recurrent(GRUModule),
}

ACTOR_KEYS: dict[str, dict[str, Any]] = {
    "composite": {
        "action": [("action", "move"), "force"],
        "sample_log_prob": [("action", "move_log_prob"), "force_log_prob"],
    },
    "part_by_part": {
        "action": ["move", "write"],
        "sample_log_prob": ["move_log_prob", "write_log_prob"],
    },
}


def make_actor(
    kind: str = "categorical", *, dtype: torch.dtype = torch.float64
) -> ProbabilisticTensorDictSequential:
    """An actor with the same parameters every time."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return ACTORS[kind]().to(dtype)


def move(actor: nn.Module, size: float = 0.2) -> None:
    """Change the parameters, as some optimiser steps would."""
    generator = torch.Generator().manual_seed(2)
    for parameter in actor.parameters():
        noise = torch.randn(parameter.shape, generator=generator, dtype=parameter.dtype)
        parameter.data.add_(size * noise.to(parameter.device))


# ------------------------------------------------------------------------------------ the batches


def _steps(actor: nn.Module, trajectories: TensorDictBase) -> Iterator[tuple[int, TensorDictBase]]:
    """One step of ``[N, T]`` after another, each with the memory that the last one left."""
    memory = TensorDict({}, trajectories.batch_size[:1])
    for t in range(trajectories.shape[1]):
        step = trajectories[:, t].select("observation", "is_init").update(memory)
        with set_recurrent_mode(False):
            yield t, step
        states = [key for key in getattr(actor, "out_keys", []) if "recurrent_state" in str(key)]
        memory = step.select(*states).get("next", memory)


def sample(actor: ProbabilisticTensorDictSequential, *shape: int, seed: int = 0) -> TensorDict:
    """A batch ``[*G, K, T]`` of the actor's rollouts, every entry as a collector writes it."""
    parameter = next(actor.parameters())
    num_steps = shape[-1]
    num_trajectories = torch.Size(shape[:-1]).numel()
    with torch.random.fork_rng(), torch.no_grad(), set_interaction_type(InteractionType.RANDOM):
        torch.manual_seed(seed)
        size = (num_trajectories, num_steps)
        is_init = torch.zeros(*size, 1, dtype=torch.bool)
        is_init[:, 0] = True
        done = torch.zeros(*size, 1, dtype=torch.bool)
        done[:, -1] = True
        batch = TensorDict(
            {
                "observation": torch.randn(*size, OBSERVATION, dtype=parameter.dtype),
                "is_init": is_init,
                "next": {
                    "reward": torch.randn(*size, 1, dtype=parameter.dtype),
                    "done": done,
                },
            },
            batch_size=size,
        )
        steps = []
        for _, step in _steps(actor, batch):
            parameters = ("logits", "move_logits", "write_logits", "loc", "scale", "params")
            steps.append(actor(step).exclude(*parameters, "memory"))
            for key in ("recurrent_state", "recurrent_state_h", "recurrent_state_c"):
                if ("next", key) in step.keys(True):
                    zeros = torch.zeros_like(step["next", key])
                    steps[-1] = steps[-1].clone(False).set(key, step.get(key, zeros))
        return batch.update(torch.stack([s.exclude("next") for s in steps], 1)).reshape(*shape)


LENGTHS = (4, 1, 3, 2, 4, 3)


def pad(batch: TensorDictBase, *, masked: tuple[int, ...] = ()) -> TensorDict:
    """The batch with trajectories cut to unequal lengths, junk in all padded steps, and the mask.

    ``masked`` numbers trajectories (of the flattened batch) that lose every step.
    """
    num_trajectories = batch.shape[:-1].numel()
    lengths = torch.tensor([LENGTHS[n % len(LENGTHS)] for n in range(num_trajectories)])
    lengths[list(masked)] = 0
    mask = (torch.arange(batch.shape[-1]) < lengths.unsqueeze(-1)).reshape(batch.shape)

    def spoil(values: Tensor) -> Tensor:
        spoilt = values.clone()
        if values.is_floating_point():
            spoilt[~mask] = torch.nan
            spoilt[~mask & (torch.arange(batch.shape[-1]) % 2 == 0)] = -torch.inf
        else:
            spoilt[~mask] = True if values.dtype == torch.bool else -(10**6)
        return spoilt

    return TensorDict.apply(batch, spoil).set(MASK, mask)  # type: ignore[union-attr]


def split(batch: TensorDictBase) -> list[list[TensorDictBase]]:
    """Groups of trajectories ``[1, T_k]`` without padding; those without a step are left out."""
    groups = []
    for group in batch.reshape(-1, *batch.shape[-2:]).unbind(0):
        trajectories = []
        for trajectory in group.unbind(0):
            mask = trajectory.get(MASK, torch.ones(trajectory.shape, dtype=torch.bool))
            if mask.any():
                trajectories.append(trajectory[mask].unsqueeze(0))
        groups.append(trajectories)
    return groups


# --------------------------------------------------------------------------- the losses, in words


@dataclass
class Numbers:
    """One group: a number for each trajectory, ``[K]``; and of each the numbers of its steps."""

    returns: Tensor
    log_prob: Tensor
    reference: Tensor
    behaviour: Tensor
    steps: list[tuple[Tensor, Tensor, Tensor]]
    """Log-probability, reference, behaviour."""


def step_log_probs(actor: ProbabilisticTensorDictSequential, trajectory: TensorDictBase) -> Tensor:
    """``[T]``, one step after another, log pi(a_t | s_t)."""
    log_probs = []
    for t, step in _steps(actor, trajectory):
        if "write" in trajectory:
            first, _, second, _ = actor.module
            step = second(first(step).set("move", trajectory[:, t]["move"]))
            dists = {part: Categorical(logits=step[f"{part}_logits"]) for part in ("move", "write")}
            log_probs.append(sum(d.log_prob(trajectory[:, t][part]) for part, d in dists.items()))
            continue
        dist = actor.get_dist(step)
        if isinstance(dist, CompositeDistribution):
            parts = dist.log_prob(trajectory[:, t])
            assert is_tensor_collection(parts)
            log_probs.append(parts[("action", "move_log_prob")] + parts["force_log_prob"])
        else:
            log_probs.append(dist.log_prob(trajectory[:, t]["action"]))
    return torch.cat(log_probs)


def recorded_log_probs(trajectory: TensorDictBase) -> Tensor:
    """``[T]``: what the sampler wrote, the sum over the parts of an action."""
    entries = trajectory.flatten_keys().items()
    return sum(value.squeeze(0) for key, value in entries if key.endswith("log_prob"))  # type: ignore


def numbers(
    actor: ProbabilisticTensorDictSequential,
    group: list[TensorDictBase],
    reference: ProbabilisticTensorDictSequential | None = None,
) -> Numbers:
    """What the formulas need; the recorded log-probability is the reference's by default."""
    steps = []
    for trajectory in group:
        recorded = recorded_log_probs(trajectory)
        with torch.no_grad():
            of_reference = recorded if reference is None else step_log_probs(reference, trajectory)
        steps.append((step_log_probs(actor, trajectory), of_reference, recorded))
    returns = torch.stack([t["next", "reward"].sum() for t in group])
    totals = (torch.stack([each.sum() for each in kind]) for kind in zip(*steps, strict=True))
    return Numbers(returns, *totals, steps)


def normalise(weights: Tensor) -> Tensor:
    """Weights that sum to one."""
    return weights / weights.sum()


def ecpo(n: Numbers, *, tau: float, tau_prime: float) -> tuple[Tensor, Tensor]:
    """Eq. 6: -sum_k w_k log pi, w ~ pi_bar/beta exp((r - tau' log pi_bar) / (tau + tau'))."""
    lift = ((n.returns - tau_prime * n.reference) / (tau + tau_prime)).exp()
    weights = normalise(lift * (n.reference - n.behaviour).exp())
    return -(weights * n.log_prob).sum(), weights


def pmd(n: Numbers, *, tau: float, tau_prime: float) -> tuple[Tensor, Tensor]:
    """Footnote 1: the score function of r - tau log(pi/pi_bar) - tau' log pi, ratios pi/beta."""
    log_prob = n.log_prob.detach()
    ratios = normalise((log_prob - n.behaviour).exp())
    advantage = n.returns - tau * (log_prob - n.reference) - tau_prime * log_prob
    centred = advantage - (ratios * advantage).sum()
    return -(ratios * centred * n.log_prob).sum(), ratios


def urex(n: Numbers, *, tau: float) -> tuple[Tensor, Tensor]:
    """-mean_k (S - mean S) log pi with S = r + tau K softmax(r / tau - log pi)."""
    log_prob = n.log_prob.detach()
    weights = normalise((n.returns / tau - log_prob).exp())
    signal = n.returns + tau * len(weights) * weights
    return -((signal - signal.mean()) * n.log_prob).mean(), weights


def ment(n: Numbers, *, tau: float) -> tuple[Tensor, Tensor]:
    """-mean_k (S - mean S) log pi with S = r - tau log pi."""
    signal = n.returns - tau * n.log_prob.detach()
    uniform = torch.full_like(signal, 1 / len(signal))
    return -((signal - signal.mean()) * n.log_prob).mean(), uniform


def rloo(n: Numbers, *, tau: float) -> tuple[Tensor, Tensor]:
    """MENT's, the baseline without the trajectory itself."""
    signal = n.returns - tau * n.log_prob.detach()
    others = [torch.cat([signal[:k], signal[k + 1 :]]).mean() for k in range(len(signal))]
    return -((signal - torch.stack(others)) * n.log_prob).mean(), ment(n, tau=tau)[1]


def scores(n: Numbers, score: str) -> Tensor:
    """Returns less their mean, in units of their deviation if there is one."""
    centred = n.returns - n.returns.mean()
    return centred / n.returns.std(correction=0).clamp_min(1e-9) if score == "group" else centred


def scored(groups: list[Numbers], score: str) -> list[Numbers]:
    """The groups of a batch, with scores for returns."""
    distances = [n.returns - n.returns.mean() for n in groups]
    within = [torch.cat(distances)] * len(groups) if score == "batch" else distances
    return [
        replace(n, returns=distance / of.square().mean().sqrt())
        for n, distance, of in zip(groups, distances, within, strict=True)
    ]


def grpo(
    n: Numbers,
    *,
    kl_to_ref_coeff: float,
    clip_epsilon: float | tuple[float, float],
    score: str,
    aggregation: str,
    ratio: str,
) -> tuple[Tensor, Tensor]:
    """min(rho A, clip(rho) A) - beta (e^d - d - 1), added up over steps and trajectories."""
    low, high = clip_epsilon if isinstance(clip_epsilon, tuple) else (clip_epsilon, clip_epsilon)
    totals, lengths = [], torch.tensor([float(len(log_prob)) for log_prob, *_ in n.steps])
    for (log_prob, reference, behaviour), advantage in zip(n.steps, scores(n, score), strict=True):
        rho = (log_prob - behaviour).exp()
        if ratio == "trajectory":
            rho = (rho.prod() ** (1 / len(rho))).expand(len(rho))
        gain = torch.minimum(rho * advantage, rho.clamp(1 - low, 1 + high) * advantage)
        penalty = (reference - log_prob).exp() - (reference - log_prob) - 1
        totals.append((gain - kl_to_ref_coeff * penalty).sum())
    total, weights = torch.stack(totals), normalise((n.log_prob - n.behaviour).exp()).detach()
    if aggregation == "token_mean":
        return -total.sum() / lengths.sum(), weights
    return -(total / lengths if aggregation == "prompt_mean" else total).mean(), weights


def tpo(n: Numbers, *, tau: float, score: str, length_norm: bool) -> tuple[Tensor, Tensor]:
    """-sum q log p, q ~ pi_bar exp(u / tau) and p ~ pi within the group."""
    powers = [1 / len(log_prob) if length_norm else 1 for log_prob, *_ in n.steps]
    q = normalise((scores(n, score) / tau).exp() * n.reference.exp() ** torch.tensor(powers))
    p = normalise(n.log_prob.exp() ** torch.tensor(powers))
    return -(q * p.log()).sum(), q


def squared_pmd(
    n: Numbers, *, tau: float, tau_prime: float, normaliser: str
) -> tuple[Tensor, Tensor]:
    """(r - tau' log pi_bar - eta log Z - eta log(pi/pi_bar))^2 / (2 eta), eta = tau + tau'."""
    eta, ratios = tau + tau_prime, normalise((n.reference - n.behaviour).exp())
    score = n.returns - tau_prime * n.reference
    value = (ratios * score).sum()
    if normaliser == "soft":
        value = eta * (ratios * (score / eta).exp()).sum().log()
    residual = score - value - eta * (n.log_prob - n.reference)
    return (ratios * residual**2).sum() / (2 * eta), ratios


def reinforce(n: Numbers) -> Tensor:
    """The score function of the return, with the group's mean as baseline."""
    return -((n.returns - n.returns.mean()) * n.log_prob).mean()


@dataclass
class Case:
    """A loss, the temperatures it is tested with (not its defaults), and its formula."""

    loss: type[TrajectoryGroupLoss]
    temperatures: dict[str, float]
    formula: Callable[..., tuple[Tensor, Tensor]]
    options: dict[str, Any] = field(default_factory=dict)

    def build(self, actor: nn.Module, **kwargs: Any) -> TrajectoryGroupLoss:
        """The loss, in the dtype of the actor, with temperatures exact in that dtype."""
        loss = self.loss(actor, **self.temperatures, **self.options, **kwargs)  # type: ignore
        loss.to(next(actor.parameters()).dtype)
        for name, value in self.temperatures.items():
            setattr(loss, name, value)
        return loss

    def expected(self, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor]:
        """Loss and weights of one group, by the formula."""
        return self.formula(numbers(*args, **kwargs), **self.temperatures, **self.options)


CASES = {
    "ecpo": Case(ECPOLoss, {"tau": 0.7, "tau_prime": 0.3}, ecpo),
    "pmd": Case(PMDLoss, {"tau": 0.7, "tau_prime": 0.3}, pmd),
    "urex": Case(UREXLoss, {"tau": 0.6}, urex),
    "ment": Case(MENTLoss, {"tau": 0.4}, ment),
    "rloo": Case(RLOOLoss, {"tau": 0.4}, rloo),
    "grpo": Case(
        GRPOLoss,
        {"kl_to_ref_coeff": 0.3},
        grpo,
        {"clip_epsilon": 0.1, "score": "group", "aggregation": "prompt_mean", "ratio": "step"},
    ),
    "tpo": Case(TPOLoss, {"tau": 0.7}, tpo, {"score": "group", "length_norm": False}),
    "squared_pmd": Case(
        SquaredPMDLoss, {"tau": 0.7, "tau_prime": 0.3}, squared_pmd, {"normaliser": "mean"}
    ),
}
DELAYED = ("ecpo", "pmd", "grpo", "tpo", "squared_pmd")  # may have a reference of their own


def problem(
    case: Case,
    kind: str = "categorical",
    *,
    padded: bool = True,
    lag: float = 0.0,
    **options: Any,
) -> tuple[TrajectoryGroupLoss, Any, TensorDict]:
    """A loss, its actor after some optimiser steps, and a batch ``[2, 3, 4]`` from before them.

    With ``delay_actor`` the loss's reference is ``lag`` away from the policy that drew the batch.
    """
    actor = make_actor(kind)
    batch = sample(actor, 2, 3, 4)
    move(actor, lag)
    loss = case.build(actor, **options)
    loss.set_keys(**ACTOR_KEYS.get(kind, {}))
    if loss.delay_actor:
        HardUpdate(loss, value_network_update_interval=1)
    move(actor)
    return loss, actor, pad(batch) if padded else batch


def expected_losses(case: Case, actor: Any, batch: TensorDictBase, *reference: Any) -> Tensor:
    """The formula, one number for each group."""
    return torch.stack([case.expected(actor, group, *reference)[0] for group in split(batch)])


def gradients(value: Tensor, actor: nn.Module) -> list[Tensor]:
    """With respect to every parameter."""
    return list(torch.autograd.grad(value, list(actor.parameters())))


def as_keywords(loss: TrajectoryGroupLoss, batch: TensorDictBase) -> dict[str, Tensor]:
    """The keywords of a call without a tensordict."""
    return {
        "_".join((key,) if isinstance(key, str) else key): batch[key]
        for key in loss.in_keys
        if key in batch.keys(True, True)
    }
