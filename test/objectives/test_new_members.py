"""The members that the tutorial writes: their length, and their numbers; and what members add."""

from __future__ import annotations

import ast
import inspect
import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from actor_critic_problems import become, call, make_batch, make_networks
from actor_critic_problems import gradients as gradients_by_name
from torch.testing import assert_close
from torchrl.objectives import HardUpdate
from trajectory_problems import MASK, as_keywords, gradients, make_actor, move, pad, sample, split

from torchrl_ecpo import ECACLoss, PolyakAverage, TemperatureScheduler, TrajectoryGroupLoss
from torchrl_ecpo import GRPOLoss as PublicGRPOLoss
from torchrl_ecpo import MPOLoss as PublicMPOLoss
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


# ------------------------------------------------------------- the same numbers as the package's

padding = pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])


def both(losses: tuple[Any, Any], batch: Any, names: tuple[str, ...]) -> list[Any]:
    """The outputs of both, which are equal, as are the gradients of the policy."""
    outs = [call(loss, batch) for loss in losses]
    for name in names:
        assert_close(outs[0][name], outs[1][name], msg=name)
    grads = [
        gradients(out["loss_actor"].sum(), loss.actor_network_params)
        for out, loss in zip(outs, losses, strict=True)
    ]
    assert_close(*grads)
    return outs


@padding
def test_grpo_is_the_packages(padded):
    """Which is tested against its formula."""
    actor = make_actor()
    batch = sample(actor, 2, 4, 6)
    batch = pad(batch, masked=(1,)) if padded else batch
    move(actor, 0.1)
    own = build(GRPOLoss, actor, clip=0.1, beta=0.3, reduction="none")
    options = {"clip_epsilon": 0.1, "kl_to_ref_coeff": 0.3, "delay_actor": True}
    public = build(PublicGRPOLoss, actor, **options, reduction="none")
    move(actor, 0.3)
    out, _ = both((own, public), batch, ("loss_actor", "clip_fraction", "kl_reference_policy"))
    assert 0.1 < out["clip_fraction"].mean() < 0.9


@pytest.mark.parametrize("eta", [0.3, 1.0, 4.0])
@padding
def test_reps_is_the_packages(eta, padded):
    """The dual trains log eta alone: of it the package has the slope, not the value."""
    actor = make_actor()
    batch = sample(actor, 5, 6, 4)
    batch = pad(batch) if padded else batch
    losses = build(REPSLoss, actor, epsilon=0.3), build(PublicREPSLoss, actor, epsilon=0.3)
    for loss, name in zip(losses, ("log_eta", "log_tau"), strict=True):
        getattr(loss, name).data.fill_(math.log(eta))
    own, public = both(losses, batch, ("loss_actor", "ESS", "max_weight", "kl_target_reference"))
    values = [
        torch.stack([t["next", "reward"].sum() for t in group]).div(eta).exp().mean().log()
        for group in split(batch)
    ]
    assert_close(own["loss_dual"], eta * (0.3 + torch.stack(values).mean()))
    slopes = [
        torch.autograd.grad(out[name], [of, *actor.parameters()], allow_unused=True)
        for out, name, of in (
            (own, "loss_dual", losses[0].log_eta),
            (public, "loss_tau", losses[1].log_tau),
        )
    ]
    assert_close(slopes[0][0], eta * slopes[1][0])
    assert slopes[0][1:] == (None, None)
    assert "log_eta" in losses[0].state_dict()


def test_mpo_is_the_packages():
    """The dual of the tutorial is in the unit of tau epsilon."""
    losses = []
    for loss_class in (MPOLoss, PublicMPOLoss):
        old = make_networks("normal", seed=1)
        samples = {"num_action_samples": 8, "num_next_action_samples": 1}
        loss = loss_class(old.actor, old.qvalues, reduction="none", **samples).double()
        PolyakAverage(loss)
        become(loss, make_networks("normal", seed=2))
        loss.log_tau.data.fill_(math.log(0.5))
        loss.log_alpha_mean.data.fill_(math.log(3.0))
        losses.append(loss)
    names = ("kl_mean", "kl_scale", "state_value", "loss_alpha_mean", "loss_alpha_scale")
    names = ("loss_actor", "loss_qvalue", *names, "alpha_mean", "kl_target_reference", "tau")
    outs = both(tuple(losses), make_batch("normal"), names)
    slopes = [
        gradients_by_name(loss, out["loss_tau"].mean())["log_tau"]
        for loss, out in zip(losses, outs, strict=True)
    ]
    assert_close(slopes[0], 0.5 * 0.1 * slopes[1])


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
    keywords = as_keywords(loss, batch)
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
    compiled = torch.compile(loss, fullgraph=True, backend="eager")
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


class Renaming(ECACLoss):
    """Reads an option that its signature does not name."""

    def __init__(self, actor: Any, qvalue: Any, **options: Any) -> None:
        super().__init__(actor, qvalue, tau=options.pop("temperature"), **options)


def test_a_member_may_read_what_its_signature_does_not_name():
    networks = make_networks()
    loss = Renaming(networks.actor, networks.qvalues, temperature=2.0)
    assert_close(loss.temperature("tau").item(), 2.0)
    with pytest.raises(TypeError, match="actor_network must have a get_dist method"):
        Renaming(torch.nn.Linear(1, 1), networks.qvalues, temperature=2.0)
    with pytest.raises(
        TypeError, match=r"^Renaming has no option .*'tua'; it has actor, qvalue, proj"
    ):
        Renaming(networks.actor, networks.qvalues, temperature=2.0, tua=1)
    names = [*inspect.signature(Renaming.__init__).parameters]
    assert names[:4] == ["self", "actor", "qvalue", "projection"]
    assert {"tau", "reduction"} < {*names}


class Seeing(TrajectoryGroupLoss):
    """Keeps what it is given."""

    metrics = ()

    def surrogate(self, groups):
        self.groups = groups
        return Surrogate(groups.log_prob.sum(-1), None)


@padding
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
