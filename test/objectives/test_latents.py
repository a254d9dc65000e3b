"""Squashed actions in the group losses: evaluated at the latents that were drawn."""

from __future__ import annotations

import pickle
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    set_composite_lp_aggregate,
)
from torch import nn
from torch.distributions import (
    AffineTransform,
    ComposeTransform,
    Independent,
    Normal,
    StickBreakingTransform,
    TanhTransform,
    TransformedDistribution,
)
from torch.testing import assert_close
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import ProbabilisticActor, TanhNormal
from trajectory_problems import as_keywords

from torchrl_ecpo import ECPOLoss, MENTLoss, PMDLoss
from torchrl_ecpo.modules import record_latents
from torchrl_ecpo.modules.latents import latent_of

G, K, T, A = 2, 4, 20, 2


def _of_torch(*transforms):
    return lambda loc, scale: TransformedDistribution(
        Independent(Normal(loc, scale), 1), list(transforms)
    )


def _nested(loc, scale):
    return Independent(TransformedDistribution(Normal(loc, scale), TanhTransform()), 1)


DISTRIBUTIONS = {
    "torchrl": TanhNormal,
    "torchrl, bounded": lambda loc, scale: TanhNormal(loc, scale, low=-2.0, high=3.0),
    "torchrl, bounds in single": lambda loc, scale: TanhNormal(
        loc, scale, low=torch.zeros(A), high=torch.ones(A)
    ),
    "torch": _of_torch(TanhTransform()),
    "torch, cached": _of_torch(TanhTransform(cache_size=1)),
    "torch, two": _of_torch(TanhTransform(), AffineTransform(0.5, 2.5)),
    "torch, composed": _of_torch(ComposeTransform([TanhTransform(), AffineTransform(0.5, 2.5)])),
    "torch, independent": _nested,
}
DTYPES = [torch.float64, torch.float32, torch.bfloat16]
HEADS = [*(("torchrl's", dtype) for dtype in DTYPES), ("tensordict's", torch.float32)]


class Head(nn.Module):
    """The same mean and scale, whatever is observed."""

    def __init__(self, loc: float, log_scale: float, dtype: torch.dtype) -> None:
        super().__init__()
        self.p = nn.Parameter(torch.tensor([loc, log_scale], dtype=dtype))

    def forward(self, observation):
        return self.p[0].expand_as(observation), self.p[1].exp().expand_as(observation)


def make_actor(distribution=TanhNormal, loc=8.0, log_scale=0.0, dtype=torch.float32, plain=False):
    network = TensorDictModule(Head(loc, log_scale, dtype), ["observation"], ["loc", "scale"])
    options = {"distribution_class": distribution, "return_log_prob": True}
    if plain:  # tensordict's own evaluates what it has drawn, TorchRL's draws and evaluates at once
        head = ProbabilisticTensorDictModule(["loc", "scale"], ["action"], **options)
        return ProbabilisticTensorDictSequential(network, head)
    return ProbabilisticActor(network, ["loc", "scale"], **options)


def draw(actor, dtype=torch.float32):
    torch.manual_seed(0)
    observation = torch.zeros(G, K, T, A, dtype=dtype)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = actor(TensorDict(observation=observation, batch_size=[G, K, T]))
    batch["next", "reward"] = torch.rand(G, K, T, 1)
    return batch


@pytest.mark.parametrize("recorded", ["latents", "parameters"])
@pytest.mark.parametrize(("head", "dtype"), HEADS, ids=str)
@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_policy_that_drew_the_batch_is_known_again(name, head, dtype, recorded):
    """KL 0 and K effective trajectories: in the middle and at the ends, in any precision."""
    for loc, log_scale in ((0.0, -2.0), (0.0, 1.5), (8.0, 0.0), (20.0, -1.0)):
        actor = make_actor(DISTRIBUTIONS[name], loc, log_scale, dtype, head == "tensordict's")
        if recorded == "latents":
            record_latents(actor)
        batch = draw(actor, dtype)
        if recorded == "latents":
            batch = batch.exclude("loc", "scale")
        kl = ECPOLoss(actor)(batch)["kl_reference_policy"].item()
        assert kl == pytest.approx(0, abs=1e-4)
        assert PMDLoss(actor)(batch)["ESS"].item() == pytest.approx(K, abs=1e-4)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_another_action_than_was_drawn_is_evaluated_itself(name):
    """As noise behind the policy makes it: the latent is then none of that action."""
    actor = make_actor(DISTRIBUTIONS[name], 0.0, 0.0)
    record_latents(actor)
    batch = draw(actor)
    span = batch["action"].amax() - batch["action"].amin()
    other = batch.clone()
    other["action"] = batch["action"].flip(2) * 0.9 + 0.1 * batch["action"].mean()
    assert (other["action"] - batch["action"]).abs().amax() > 0.1 * span
    expected = PMDLoss(actor)(other.exclude("action_latent"))
    assert_close(PMDLoss(actor)(other), expected)
    other["action"][0, 0, 0] = torch.nan
    with pytest.raises(ValueError, match="NaN"):
        PMDLoss(actor)(other)


@pytest.mark.parametrize("recorded", ["latents", "parameters"])
def test_an_action_on_a_simplex_has_a_number_more_than_its_latent(recorded):
    actor = make_actor(_of_torch(StickBreakingTransform()), 0.0, 0.0)
    record_latents(actor)
    batch = draw(actor)
    assert batch["action"].shape == (G, K, T, A + 1)
    batch = batch.exclude("action_latent" if recorded == "parameters" else "loc")
    out = ECPOLoss(actor)(batch)
    out["loss_actor"].backward()
    assert out["kl_reference_policy"].item() == pytest.approx(0, abs=1e-4)
    if recorded == "latents":  # and another action is evaluated itself
        batch["action"] = batch["action"].flip(2)
        expected = PMDLoss(actor)(batch.exclude("action_latent"))
        assert_close(PMDLoss(actor)(batch), expected)


def test_parts_of_an_action_are_compared_each_by_its_own_size():
    high, latent = torch.tensor([1e6, 1.0]), torch.tensor([[1.0, 0.0]])
    drawn = TanhNormal(torch.zeros(1, 2), torch.ones(1, 2), low=-high, high=high)
    action = high * latent.tanh() + torch.tensor([0.0, 0.5])  # noise is added to the second
    found = latent_of(drawn, action, latent)
    assert_close(found, torch.tensor([[1.0, 0.5]]).where(latent == 1, torch.tensor(0.5).atanh()))


@pytest.mark.parametrize(("loc", "log_scale"), [(0.0, 0.0), (8.0, 0.0), (0.0, 2.0)])
@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_gradients_are_those_of_the_latent_gaussian(name, loc, log_scale):
    """MENT with tau = 0 is REINFORCE, however near the actions are to the ends."""
    actor = make_actor(DISTRIBUTIONS[name], loc, log_scale)
    record_latents(actor)
    batch = draw(actor)
    MENTLoss(actor, tau=0.0)(batch)["loss_actor"].backward()
    p = torch.tensor([loc, log_scale], requires_grad=True)
    log_prob = Normal(p[0], p[1].exp()).log_prob(batch["action_latent"]).sum((-1, -2))
    returns = batch["next", "reward"].sum((-1, -2))
    advantage = returns - returns.mean(-1, keepdim=True)
    (-(advantage * log_prob).mean(-1)).mean().backward()
    assert_close(dict(actor.named_parameters())["module.0.module.p"].grad, p.grad)


@set_composite_lp_aggregate(True)
def test_a_composite_action_has_latents_of_its_own():
    """Each squashed part at the key of its action; with parameters alone, the ratio is 1 too."""
    parts = {"force": TanhNormal, "gain": Normal}
    actor = ProbabilisticTensorDictSequential(
        *(
            TensorDictModule(
                Head(8.0, 0.0, torch.float32),
                ["observation"],
                [("params", part, "loc"), ("params", part, "scale")],
            )
            for part in parts
        ),
        ProbabilisticTensorDictModule(
            in_keys=["params"],
            out_keys=[("agent", "force"), "gain"],
            distribution_class=CompositeDistribution,
            distribution_kwargs={
                "distribution_map": parts,
                "name_map": {"force": ("agent", "force"), "gain": "gain"},
            },
            return_log_prob=True,
        ),
    )
    for latents in (False, True):
        if latents:
            record_latents(actor)
        batch = draw(actor)
        assert (("agent", "force_latent") in batch.keys(True)) is latents
        loss = ECPOLoss(actor)
        loss.set_keys(action=[("agent", "force"), "gain"])
        assert ("agent", "force_latent") in loss.in_keys
        batch = batch.exclude("params") if latents else batch
        assert loss(batch)["kl_reference_policy"].item() == pytest.approx(0, abs=1e-4)


def test_recording_changes_nothing_else():
    """The same random numbers and actions; a copy records too; a second call is none."""
    actor, other = make_actor(log_scale=1.5), make_actor(log_scale=1.5)
    record_latents(other)
    record_latents(other)
    plain, batch = draw(actor), draw(other)
    assert_close(batch.exclude("action_latent"), plain, rtol=0, atol=0)
    assert_close(batch["action_latent"].tanh().clamp(-0.999999, 0.999999), batch["action"])
    other(batch.select("observation"))  # with gradients, which a copy must not hold on to
    other.get_dist(batch.select("observation"))
    for copy in (deepcopy(other), pickle.loads(pickle.dumps(other))):
        assert_close(draw(copy), batch, rtol=0, atol=0)
    loss = ECPOLoss(actor)
    assert "action_latent" in loss.in_keys
    assert_close(loss(**as_keywords(loss, batch))[0], loss(batch)["loss_actor"])


def test_an_action_out_of_its_range_is_refused():
    """Such as one in the environment's own units."""
    actor = make_actor(loc=0.0)
    batch = draw(actor)
    batch["action"] = 2 * batch["action"]
    with pytest.raises(ValueError, match=r"of the entries \['action'\].* is NaN or infinite"):
        ECPOLoss(actor)(batch)


def test_parameters_count_only_where_rounding_has_lost_the_latent():
    """Others that were written over them leave valid data as it is."""
    actor = make_actor(loc=0.0, dtype=torch.float64)
    batch, loss = draw(actor, torch.float64), PMDLoss(actor)
    actor[0].module.p.data += 0.3
    expected = loss(batch.exclude("loc", "scale"))
    assert expected["kl_reference_policy"].abs() > 0.1
    batch["loc"] = batch["loc"] + 0.3  # as actor.get_dist(batch) would
    assert_close(loss(batch), expected, rtol=0, atol=0)
