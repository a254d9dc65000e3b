"""Trust-PCL: its numbers, its optimum, and what its value network adds to the contract."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torch.testing import assert_close
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from trajectory_problems import MASK, OBSERVATION, make_actor, move, pad, sample, split

from torchrl_ecpo import PolyakAverage, TrustPCLLoss

TEMPERATURES: Any = {"tau": 0.75, "tau_prime": 0.25}


def make_value():
    with torch.random.fork_rng():
        torch.manual_seed(3)
        network = MLP(in_features=OBSERVATION, out_features=1, num_cells=[5])
        return ValueOperator(network.double(), in_keys=["observation"])


def build(actor=None, value=None, **options):
    actor, value = actor or make_actor(), value or make_value()
    loss = TrustPCLLoss(actor, value, **{**TEMPERATURES, **options}).double()
    if loss.delay_actor:
        PolyakAverage(loss, weight=0.5)
    return loss


def residuals(actor, value, reference, trajectory, *, gamma, n_steps):
    """Step by step, of one trajectory ``[1, T]``."""
    dists = [each.get_dist(trajectory.clone()) for each in (actor, reference)]
    log_prob, ref = (dist.log_prob(trajectory["action"])[0] for dist in dists)
    v = [*value(trajectory.clone())["state_value"][0, :, 0], 0.0]
    rewards, found = trajectory["next", "reward"][0, :, 0], []
    for t in range(len(rewards)):
        end = min(t + n_steps, len(rewards))
        residual = gamma**n_steps * v[end] - v[t]
        for i in range(t, end):
            gain = rewards[i] - 1.0 * log_prob[i] + 0.75 * ref[i].detach()
            residual = residual + gamma ** (i - t) * gain
        found.append(residual)
    return torch.stack(found)


def test_a_trajectory_may_be_alone():
    """They are not compared."""
    batch = sample(make_actor(), 2, 3, 4)
    loss = build(reduction="none")
    expected = loss(batch)["loss_actor"]
    each = [loss(batch[:, k : k + 1])["loss_actor"] for k in range(3)]
    assert_close(torch.stack(each).mean(0), expected)
    alone = batch.set(MASK, (torch.arange(3) == 1).view(1, 3, 1).expand(2, 3, 4))
    assert_close(loss(alone)["loss_actor"], each[1])


@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
@pytest.mark.parametrize(("gamma", "n_steps"), [(1.0, 10), (0.9, 2)])
def test_is_its_formula(padded, gamma, n_steps):
    """Half the mean squared residual; the gradients of each network are its own."""
    actor, value, reference = make_actor(), make_value(), make_actor()
    batch = sample(actor, 2, 3, 4)
    batch = pad(batch, masked=(1,)) if padded else batch
    loss = build(actor, value, gamma=gamma, n_steps=n_steps, reduction="none")
    move(actor)
    options = {"gamma": gamma, "n_steps": n_steps}
    expected = torch.stack(
        [
            torch.cat([residuals(actor, value, reference, t, **options) for t in group])
            .square()
            .mean()
            / 2
            for group in split(batch)
        ]
    )
    outputs = loss(batch)
    assert loss.out_keys[:3] == ["loss_actor", "loss_value", "state_value"] == [*outputs.keys()][:3]
    names, parameters = ("loss_actor", "loss_value"), list(loss.parameters())
    both = torch.autograd.grad(expected.sum(), parameters)
    parts = [
        torch.autograd.grad(outputs[name].sum(), parameters, allow_unused=True, retain_graph=True)
        for name in names
    ]
    for name in names:
        assert_close(outputs[name], expected)
    for own, of_actor, of_value in zip(both, *parts, strict=True):
        (found,) = [each for each in (of_actor, of_value) if each is not None]  # one reaches it
        assert_close(found, own)
    assert all(each is not None for each in parts[0][:2])
    assert not outputs["state_value"].requires_grad


def test_gradient_by_hand():
    """One step, two actions at even odds, r = 1, 0 and V = 0.5: C = r + 0.25 log 2 - 0.5."""
    logits, value = nn.Linear(1, 2, bias=False).double(), nn.Linear(1, 1, bias=False).double()
    logits.weight.data.zero_(), value.weight.data.fill_(0.5)
    actor = ProbabilisticActor(
        TensorDictModule(logits, ["observation"], ["logits"]),
        in_keys=["logits"],
        distribution_class=Categorical,
    )
    loss = build(actor, ValueOperator(value, in_keys=["observation"]))
    batch = {"observation": torch.ones(1, 2, 1, 1), "action": torch.tensor([[[0], [1]]])}
    batch |= {"next": {"reward": torch.tensor([1.0, 0.0]).reshape(1, 2, 1, 1)}}
    batch = TensorDict(batch, [1, 2, 1]).double().set("action", batch["action"])
    outputs = loss(batch)
    bonus = 0.25 * torch.tensor(2.0).log().item()
    first, second = 0.5 + bonus, bonus - 0.5
    assert_close(outputs["loss_actor"].item(), (first**2 + second**2) / 4)
    (outputs["loss_actor"] + outputs["loss_value"]).backward()
    assert_close(value.weight.grad.item(), -(first + second) / 2)
    # dC/dlogit of the action taken is -(tau + tau') / 2, of the other its opposite.
    slope = -(first - second) / 4
    assert_close(logits.weight.grad.flatten(), torch.tensor([slope, -slope]).double())


def test_keys_state_and_copies():
    """The value's entry is renamed; observations of the value network are in_keys; state_dict."""
    value = make_value()
    value.out_keys = ["worth"]
    loss, batch = build(value=value), sample(make_actor(), 2, 3, 4)
    batch["extra"] = batch["observation"]
    loss.set_keys(value="worth")
    expected = build()(batch)
    assert_close(loss(batch), expected)
    other = make_value()
    other.in_keys = ["extra"]
    loss = build(value=other)
    assert "extra" in loss.in_keys
    assert_close(loss(batch), expected)
    with pytest.raises(KeyError, match=r"value network cannot be evaluated on.*extra.*missing"):
        loss(batch.exclude("extra"))
    move(loss.value_network)
    fresh = build(value=make_value())
    fresh.load_state_dict(loss.state_dict(), strict=True)
    assert_close(fresh(batch), loss(batch))
    recorded = build(delay_actor=False)
    assert_close(recorded(batch)["loss_actor"], expected["loss_actor"])


def two_numbers():
    return ValueOperator(nn.Linear(OBSERVATION, 2).double(), in_keys=["observation"])


def not_finite():
    value = make_value()
    next(value.parameters()).data.fill_(torch.nan)
    return value


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"gamma": 1.1}, ValueError, r"gamma must be in \[0, 1\], got 1\.1"),
        ({"value": two_numbers()}, ValueError, r"one number for each step.*\(6, 4, 1\).*4, 2\)"),
        ({"value": not_finite()}, ValueError, "The value 'state_value' is NaN or infinite"),
    ],
    ids=lambda x: str(x)[:20],
)
def test_bad_input_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        build(**options)(sample(make_actor(), 2, 3, 4))


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_compiles_without_a_graph_break():
    torch._dynamo.reset()
    loss, batch = build(), pad(sample(make_actor(), 2, 3, 4))
    assert_close(torch.compile(loss, fullgraph=True, backend="eager")(batch), loss(batch))
