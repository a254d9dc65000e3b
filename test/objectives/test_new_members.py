"""The members that the tutorial writes: their length, and their numbers; and what members add."""

from __future__ import annotations

import ast
import math
import re
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import torch
from actor_critic_problems import become, call, make_batch, make_networks
from actor_critic_problems import gradients as gradients_by_name
from torch.distributions import Normal
from torch.testing import assert_close
from torchrl.objectives import HardUpdate
from trajectory_problems import MASK, gradients, make_actor, move, pad, sample, split

from torchrl_ecpo import ECACLoss, PolyakAverage, TemperatureScheduler, TrajectoryGroupLoss
from torchrl_ecpo import REPSLoss as PublicREPSLoss
from torchrl_ecpo.functional import Surrogate
from torchrl_ecpo.schedules import linear

PAGE = Path(__file__).parents[2] / "docs/tutorials/new_member.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)


def member(name: str) -> Any:
    """A class of the tutorial."""
    namespace: dict[str, Any] = {}
    for block in BLOCKS:
        exec(block, namespace)
        if name in namespace:
            return namespace[name]
    raise AssertionError(f"{PAGE.name} has no {name}")


GRPOLoss, REPSLoss, MPOLoss = member("GRPOLoss"), member("REPSLoss"), member("MPOLoss")


@pytest.mark.parametrize(("name", "most"), [("GRPOLoss", 20), ("REPSLoss", 15), ("MPOLoss", 40)])
def test_a_member_is_short(name, most):
    [block] = [block for block in BLOCKS if f"class {name}" in block]
    [node] = [n for n in ast.parse(block).body if isinstance(n, ast.ClassDef)]
    lines = block.splitlines()[node.lineno - 1 : node.end_lineno]
    assert sum(bool(line.strip()) for line in lines) <= most
    assert max(map(len, lines)) <= 100


def build(loss_class: type, actor: Any, **settings: Any) -> Any:
    loss = loss_class(actor, **settings).double()
    if loss.delay_actor:
        HardUpdate(loss, value_network_update_interval=1)
    return loss


# -------------------------------------------------------------------------------------------- GRPO


def grpo(actor, reference, group, *, clip: float, beta: float):
    """Loss and clip fraction of one group, trajectory by trajectory and step by step."""
    returns = torch.stack([t["next", "reward"].sum() for t in group])
    advantages = (returns - returns.mean()) / returns.std(correction=0)
    losses, fractions = [], []
    for trajectory, advantage in zip(group, advantages, strict=True):
        log_prob = actor.get_dist(trajectory.clone()).log_prob(trajectory["action"])[0]
        ref = reference.get_dist(trajectory.clone()).log_prob(trajectory["action"])[0].detach()
        ratio = (log_prob - trajectory["action_log_prob"][0]).exp()
        terms, clipped = [], []
        for t in range(len(ratio)):
            low, high = 1 - clip, 1 + clip
            limited = min(max(ratio[t], torch.tensor(low)), torch.tensor(high))
            gain = min(ratio[t] * advantage, limited * advantage)
            penalty = (ref[t] - log_prob[t]).exp() - (ref[t] - log_prob[t]) - 1
            terms.append(gain - beta * penalty)
            is_clipped = ratio[t] > high if advantage > 0 else ratio[t] < low
            clipped.append(float(is_clipped))
        losses.append(-sum(terms) / len(terms))
        fractions.append(sum(clipped) / len(clipped))
    return sum(losses) / len(losses), sum(fractions) / len(fractions)


@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_grpo_is_its_formula(padded):
    actor, reference = make_actor(), make_actor()
    batch = sample(actor, 2, 4, 6)
    batch = pad(batch, masked=(1,)) if padded else batch
    move(actor, 0.1)
    loss = build(GRPOLoss, actor, clip=0.1, beta=0.3, reduction="none")
    loss.beta = 0.3
    move(reference, 0.1)
    move(actor, 0.3)
    out = loss(batch)
    expected = [grpo(actor, reference, group, clip=0.1, beta=0.3) for group in split(batch)]
    value = torch.stack([each for each, _ in expected])
    assert_close(out["loss_actor"], value)
    assert_close(gradients(out["loss_actor"].sum(), actor), gradients(value.sum(), actor))
    assert_close(out["clip_fraction"], torch.tensor([f for _, f in expected]).double())
    assert 0.1 < out["clip_fraction"].mean() < 0.9


def test_grpo_by_hand():
    """Two trajectories of one step; ratios 1.5 and 0.5, advantages 1 and -1, d = log 2 and 0."""
    log_prob = torch.tensor([[-1.0], [-2.0]], dtype=torch.float64)
    actor = make_actor()
    loss = build(GRPOLoss, actor, clip=0.2, beta=0.1)
    loss.beta = 0.1
    from torchrl_ecpo.objectives import Steps, TrajectoryGroups

    ratio = torch.tensor([[1.5], [0.5]], dtype=torch.float64)
    d = torch.tensor([[2.0], [1.0]], dtype=torch.float64).log()
    steps = Steps(
        torch.tensor([[1.0], [0.0]]), log_prob, log_prob + d, log_prob - ratio.log(), None
    )
    returns, *log_probs = (values.sum(-1).double() for values in steps[:4])
    groups = TrajectoryGroups(returns, *log_probs, None, steps, returns)
    found = loss.surrogate(groups)
    # min(1.5, 1.2) and min(-0.5, -0.8); penalties 2 - log 2 - 1 and 0.
    penalty = 0.1 * (1 - d[0, 0].item())
    assert_close(found.loss.item(), ((penalty - 1.2) + 0.8) / 2)
    assert found.metrics["clip_fraction"] == 1
    assert found.weights is None


# -------------------------------------------------------------------------------------------- REPS


@pytest.mark.parametrize("epsilon", [0.05, 0.3, 0.6])
@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_the_dual_of_reps_holds_the_bound(epsilon, padded):
    """Where the dual is least, the lift is epsilon nats from the reference, in the mean."""
    actor = make_actor()
    batch = sample(actor, 5, 6, 4)
    batch = pad(batch) if padded else batch
    loss = build(REPSLoss, actor, epsilon=epsilon)
    for _ in range(200):
        out = loss(batch)
        (slope,) = torch.autograd.grad(out["loss_dual"], loss.log_eta)
        # d dual / d log eta = eta (epsilon - KL): checked on the way, not at the end only.
        assert_close(slope, out["eta"] * (epsilon - out["kl_target_reference"]))
        loss.log_eta.data -= 2 * slope / out["eta"]
    assert_close(out["kl_target_reference"].item(), epsilon, atol=1e-6, rtol=0)
    below, least, above = (
        _dual_at(loss, batch, loss.log_eta.item() + shift) for shift in (-0.1, 0.0, 0.1)
    )
    assert least < min(below, above)


def _dual_at(loss: Any, batch: Any, log_eta: float) -> float:
    """Eta epsilon + eta mean log mean exp(r / eta), group by group."""
    eta = torch.tensor(log_eta, dtype=torch.float64).exp()
    values = []
    for group in split(batch):
        returns = torch.stack([t["next", "reward"].sum() for t in group])
        values.append(eta * (returns / eta).exp().mean().log())
    return (eta * loss.epsilon + sum(values) / len(values)).item()


def test_each_loss_of_reps_trains_its_own():
    actor = make_actor()
    loss, batch = build(REPSLoss, actor), sample(actor, 2, 4, 3)
    assert "log_eta" in dict(loss.named_parameters())
    assert "log_eta" in loss.state_dict()
    out = loss(batch)
    for name, trained in (("loss_dual", [loss.log_eta]), ("loss_actor", list(actor.parameters()))):
        grads = torch.autograd.grad(
            out[name], list(loss.parameters()), retain_graph=True, allow_unused=True
        )
        got = [p for p, g in zip(loss.parameters(), grads, strict=True) if g is not None]
        assert {id(p) for p in got} == {id(p) for p in trained}
    assert_close(out["loss_dual"].item(), _dual_at(loss, batch, 0.0))


# ------------------------------------------------------------------ what a member returns and says

OF_GROUPS = ["kl_reference_policy", "entropy", "return", "equal_return_groups"]
OUT_KEYS = {
    GRPOLoss: ["loss_actor", "clip_fraction", *OF_GROUPS],
    REPSLoss: [
        *("loss_actor", "loss_dual", "ESS", "max_weight", "eta", "kl_target_reference"),
        *OF_GROUPS,
    ],
    PublicREPSLoss: [
        *("loss_actor", "loss_tau", "ESS", "max_weight", "tau", "kl_target_reference"),
        *OF_GROUPS,
    ],
}
members = pytest.mark.parametrize("loss_class", OUT_KEYS, ids=str)


@members
def test_what_a_member_adds_is_treated_like_the_rest(loss_class):
    """Known before the first call, in order, reduced, selected, and without gradient."""
    batch = pad(sample(make_actor(), 3, 4, 5))
    losses = {
        reduction: build(loss_class, make_actor(), reduction=reduction)
        for reduction in ("none", "mean", "sum")
    }
    assert losses["mean"].out_keys == OUT_KEYS[loss_class]
    outs = {reduction: loss(batch) for reduction, loss in losses.items()}
    for key in OUT_KEYS[loss_class]:
        each = outs["none"][key]
        assert each.shape == (3,)
        assert each.requires_grad is key.startswith("loss_")
        assert_close(outs["mean"][key], each.mean())
        assert_close(outs["sum"][key], each.sum() if key.startswith("loss_") else each.mean())
    loss, last = losses["mean"], OUT_KEYS[loss_class][1]
    keywords = {"_".join(k) if isinstance(k, tuple) else k: batch[k] for k in loss.in_keys}
    values = loss(**keywords)
    assert_close(list(values), list(outs["mean"].values()))
    loss.select_out_keys(last)
    assert_close(loss(**keywords), outs["mean"][last])
    assert loss.reset_out_keys().out_keys == OUT_KEYS[loss_class]


@members
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_member_compiles_without_a_graph_break(loss_class):
    torch._dynamo.reset()
    loss, batch = build(loss_class, make_actor()), pad(sample(make_actor(), 2, 3, 4))
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
    expected, got = loss(batch), compiled(batch)
    assert_close(got, expected)
    grads = [gradients(out["loss_actor"], loss.actor_network_params) for out in (got, expected)]
    assert_close(*grads)


class Speaking(TrajectoryGroupLoss):
    """Returns what it is told to."""

    losses, metrics = ("loss_more",), ("found",)
    returned = Surrogate(torch.zeros(()), None)

    def surrogate(self, groups):
        zero = groups.log_prob.sum(-1) * 0
        return self.returned._replace(loss=zero)


@pytest.mark.parametrize(
    ("losses", "metrics", "weights", "message"),
    [
        (["loss_more"], ["found"], False, None),
        (["loss_more"], ["found"], True, None),
        ([], ["found"], False, r"declares the losses \['loss_more'\].*returned \[\]"),
        (["loss_more", "loss_x"], ["found"], False, r"losses \['loss_more'\].*'loss_x'"),
        (["loss_more"], [], False, r"declares the metrics \['found'\].*returned \[\]"),
        (["loss_more"], ["found", "y"], True, r"metrics \['found'\].*'y'"),
    ],
)
def test_what_is_returned_must_be_declared(losses, metrics, weights, message):
    loss = Speaking(make_actor())
    zero = torch.zeros(())
    loss.returned = Surrogate(
        zero,
        torch.full((2, 3), 1 / 3) if weights else None,
        dict.fromkeys(losses, zero),
        dict.fromkeys(metrics, torch.tensor(True)),
    )
    batch = sample(make_actor(), 2, 3, 4)
    if message is not None:
        with pytest.raises(ValueError, match=message):
            loss(batch)
        return
    out = loss(batch)
    assert list(out.keys()) == ["loss_actor", "loss_more", "found", *OF_GROUPS]
    assert out["found"] == 1


def test_weights_are_demanded_where_their_metrics_are_declared():
    class Weightless(Speaking):
        losses, metrics = (), ("ESS", "max_weight")

    with pytest.raises(ValueError, match=r"\['ESS', 'max_weight'\].*returned \[\]"):
        Weightless(make_actor())(sample(make_actor(), 2, 3, 4))


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"losses": ("dual",)}, "begins with 'loss_', got 'dual'"),
        ({"losses": ("loss_actor",)}, r"declared twice: \['loss_actor'\]"),
        ({"metrics": ("entropy", "x", "x")}, r"declared twice: \['entropy', 'x'\]"),
    ],
)
def test_names_that_cannot_be_declared(names, message):
    bad = type("Bad", (Speaking,), names)
    with pytest.raises(ValueError, match=message):
        bad(make_actor())
    networks = make_networks()
    bad = type("Bad", (ECACLoss,), names)
    with pytest.raises(ValueError, match=message):
        bad(networks.actor, networks.qvalues)


def test_a_member_names_its_temperatures_once():
    """Then they are buffers, assigned to, scheduled, checked, and part of the state."""
    loss = build(GRPOLoss, make_actor(), beta=0.5)
    assert loss.temperature_names == ("beta",)
    buffer = loss.beta
    loss.beta = 0.1
    assert loss.beta is buffer
    assert_close(buffer.item(), 0.1)
    scheduler = TemperatureScheduler(loss, beta=linear(0.4, 0.0, 10))
    scheduler.step(5)
    assert_close(loss.state_dict()["beta"].item(), 0.2)
    with pytest.raises(ValueError, match=r"beta must be a finite number >= 0, got -1"):
        loss.beta = -1
    assert_close(loss.beta.item(), 0.2)
    loss.beta = 0.0  # which a member allows
    with pytest.raises(ValueError, match=r"no temperature 'tau'.*\['beta'\]"):
        TemperatureScheduler(loss, tau=linear(1.0, 0.0, 10))


class Seeing(TrajectoryGroupLoss):
    """Keeps what it is given."""

    metrics = ()

    def surrogate(self, groups):
        self.groups = groups
        return Surrogate(groups.log_prob.sum(-1), None)


@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_steps_are_what_is_summed(padded):
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    batch = pad(batch) if padded else batch
    move(actor, 0.1)
    loss = build(Seeing, actor, delay_actor=True)
    move(actor, 0.1)
    loss(batch)
    groups, steps = loss.groups, loss.groups.steps
    for total, each in zip(groups[:4], steps[:4], strict=True):
        assert each.shape == (2, 3, 4)
        assert_close(total, each.sum(-1), rtol=0, atol=0)
    mask = batch.get(MASK, torch.ones(2, 3, 4, dtype=torch.bool))
    assert (steps.mask is None) is not padded
    assert all((each[~mask] == 0).all() for each in steps[:4])
    assert_close(steps.rewards[mask], batch["next", "reward"].squeeze(-1)[mask])
    assert_close(steps.behaviour_log_prob[mask], batch["action_log_prob"][mask])
    assert_close(groups.num_steps, mask.sum(-1).double())
    assert steps.log_prob.requires_grad
    assert not steps.reference_log_prob.requires_grad


# --------------------------------------------------------------------------------------------- MPO


def test_mpo_in_plain_numbers():
    """Its five numbers at each state, and what each reaches."""
    new, old = make_networks("normal", seed=2), make_networks("normal", seed=1)
    loss = MPOLoss(deepcopy(old.actor), deepcopy(old.qvalues), reduction="none").double()
    PolyakAverage(loss)
    become(loss, new)
    loss.log_tau.data.fill_(math.log(0.5))
    loss.log_alpha_mean.data.fill_(math.log(3.0))
    batch = make_batch("normal")
    out = call(loss, batch)
    lift = call_lift(loss, batch)
    weights = (lift.score / 0.5).softmax(0)
    (loc, scale), (old_loc, old_scale) = (
        [network.actor[0](batch.select("observation"))[key] for key in ("loc", "scale")]
        for network in (new, old)
    )
    of_mean = (0.5 * ((loc - old_loc) / old_scale) ** 2).sum(-1)
    ratio = old_scale / scale
    of_scale = (0.5 * ratio**2 - 0.5 - ratio.log()).sum(-1)
    assert_close((out["kl_mean"], out["kl_scale"]), (of_mean.detach(), of_scale.detach()))
    fits = [Normal(loc, old_scale), Normal(old_loc, scale)]
    fit = sum((weights * f.log_prob(lift.actions.latent).sum(-1)).sum(0) for f in fits)
    assert_close(out["loss_actor"], -fit + 3.0 * of_mean + 1.0 * of_scale)
    assert_close(out["state_value"], lift.score.mean(0))
    divergence = out["kl_target_reference"].mean()
    gradient = gradients_by_name(loss, out["loss_tau"].mean())["log_tau"]
    assert_close(gradient, 0.5 * (0.1 - divergence))  # of tau: epsilon - KL
    gradient = gradients_by_name(loss, out["loss_alpha_mean"].mean())["log_alpha_mean"]
    assert_close(gradient, -(of_mean.detach() / 0.01 - 1).mean())
    loss.select_out_keys("loss_tau", "kl_scale")
    assert list(call(loss, batch).keys()) == ["loss_tau", "kl_scale"]


def call_lift(loss, batch):
    """That of a call: the action of the next state was drawn before it."""
    torch.manual_seed(0)
    loss.states(batch["next"].clone()).reference.rsample((1,))
    return loss.states(batch).lift
