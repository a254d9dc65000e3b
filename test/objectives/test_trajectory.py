"""Every group loss against its formula, and what all of them do alike."""

from __future__ import annotations

import re

import pytest
import torch
from tensordict import TensorDict, lazy_stack
from tensordict.nn import (
    NormalParamExtractor,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor
from torch.distributions import Categorical
from torch.testing import assert_close
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import HardUpdate, SoftUpdate
from trajectory_problems import (
    ACTOR_KEYS,
    ACTORS,
    CASES,
    LIFTING,
    MASK,
    Numbers,
    gradients,
    make_actor,
    move,
    numbers,
    pad,
    sample,
    split,
)

from torchrl_ecpo.schedules import TemperatureScheduler, theorem1_schedules
from torchrl_ecpo.updaters import PeriodicCopy, PolyakAverage

SHAPES = [(3, 4), (2, 3, 4), (2, 2, 3, 4)]
losses = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
# What stands once in the base class is asked of one member.
base = pytest.mark.parametrize("case", [CASES["ecpo"]], ids=["ecpo"])
lifting = pytest.mark.parametrize("case", [CASES[n] for n in LIFTING], ids=LIFTING)
actors = pytest.mark.parametrize("kind", ACTORS)


def assert_same(loss, actor, batch, expected: Tensor, **tolerance):
    """The loss, before reduction, has the expected value and gradient."""
    loss.reduction = "none"
    value = loss(batch)["loss_actor"].flatten()
    assert_close(value, expected, **tolerance)
    for got, wanted in zip(
        gradients(value.sum(), actor), gradients(expected.sum(), actor), strict=True
    ):
        assert wanted.abs().max() > 1e-4, "the test would not see a wrong gradient"
        assert_close(got, wanted, **tolerance)


# ------------------------------------------------------------------------------ value and gradient


@losses
@actors
@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_formula(case, kind, padded):
    """Any actor, any lengths, NaN and infinity in every padded step: the formula, unpadded."""
    actor = make_actor(kind)
    batch = sample(actor, 2, 3, 4)
    batch = pad(batch) if padded else batch
    move(actor)
    loss = case.build(actor)
    loss.set_keys(**ACTOR_KEYS.get(kind, {}))
    expected = torch.stack([case.expected(actor, group)[0] for group in split(batch)])
    assert_same(loss, actor, batch, expected)


@losses
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("masked", [(), (1, 5)], ids=["all", "some-left-out"])
def test_group_shapes_and_missing_trajectories(case, shape, masked):
    """A trajectory without a real step is left out of its group, at any place of the batch."""
    actor = make_actor()
    masked = tuple(n for n in masked if n < torch.Size(shape[:-1]).numel())
    batch = pad(sample(actor, *shape), masked=masked)
    move(actor)
    groups = split(batch)
    assert sum(map(len, groups)) == torch.Size(shape[:-1]).numel() - len(masked)
    expected = torch.stack([case.expected(actor, group)[0] for group in groups])
    loss = case.build(actor)
    assert_same(loss, actor, batch, expected)
    assert loss(batch)["loss_actor"].shape == shape[:-2]


@base
def test_missing_first_trajectory_of_a_recurrent_actor(case):
    """The steps that a trajectory without any borrows do not disturb the others."""
    actor = make_actor("lstm")
    batch = pad(sample(actor, 2, 3, 4), masked=(0, 3))
    move(actor)
    expected = torch.stack([case.expected(actor, group)[0] for group in split(batch)])
    assert_same(case.build(actor), actor, batch, expected)


@losses
def test_float32(case):
    """In float32 the same numbers, to the precision of float32."""
    values = {}
    for dtype in (torch.float32, torch.float64):
        actor = make_actor(dtype=torch.float64)
        batch = pad(sample(actor, 2, 3, 4))
        move(actor)
        batch = batch.apply(lambda x, d=dtype: x.to(d) if x.is_floating_point() else x)
        loss = case.build(actor.to(dtype))
        out = loss(batch)
        assert {value.dtype for value in out.values()} == {dtype}
        values[dtype] = [out["loss_actor"], *gradients(out["loss_actor"], actor)]
    for single, double in zip(*values.values(), strict=True):
        assert_close(single.double(), double, rtol=1e-5, atol=1e-6)


@losses
@pytest.mark.parametrize("autocast", [False, True], ids=["bfloat16", "autocast"])
def test_half_precision(case, autocast):
    """What an actor gives in half precision is added up, and reckoned with, in single precision."""
    actor = make_actor(dtype=torch.float32 if autocast else torch.bfloat16)
    batch = sample(actor, 1, 8, 300)
    batch["next", "reward"] = torch.zeros(1, 8, 300, 1)
    batch["next", "reward"][0, :, -1, 0] = returns = 10 + 0.01 * torch.arange(8)
    batch["action_log_prob"] = batch["action_log_prob"].bfloat16()
    loss = case.build(actor)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        steps = actor.get_dist(batch).log_prob(batch["action"])
        groups, out = loss._read(batch), loss(batch)
    assert steps.dtype == torch.bfloat16
    assert_close(groups.log_prob, steps.float().sum(-1))
    assert_close(groups.behaviour_log_prob, batch["action_log_prob"].float().sum(-1))
    assert_close(groups.returns, returns.unsqueeze(0))
    for name, value in out.items():
        assert value.dtype == torch.float32, name
        assert value.isfinite(), name
    assert_close(out["loss_actor"], loss.surrogate(groups).loss.mean())  # without autocast


@losses
@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_integer_rewards(case, padded):
    """Everything is reckoned in the dtype of the log-probabilities."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    batch["next", "reward"] = (3 * batch["next", "reward"]).round()
    batch = pad(batch) if padded else batch
    move(actor)
    loss = case.build(actor)
    expected = loss(batch)
    batch["next", "reward"] = batch["next", "reward"].nan_to_num(77.0, neginf=-77.0).long()
    assert_close(loss(batch), expected)


@losses
def test_extreme_returns_stay_finite(case, dtype):
    """Weights are computed in log-space: returns of thousands of temperatures are no problem."""
    actor = make_actor(dtype=dtype)
    batch = sample(actor, 2, 3, 4)
    batch["next", "reward"] *= 1e4
    out = case.build(actor)(batch)
    assert all(value.isfinite().all() for value in out.values())
    assert all(g.isfinite().all() for g in gradients(out["loss_actor"], actor))


@base
def test_recurrent_memory_is_that_of_the_rollout(case):
    """One pass over a trajectory gives the log-probability that was recorded step by step."""
    for kind in ("lstm", "gru"):
        actor = make_actor(kind)
        out = case.build(actor)(pad(sample(actor, 2, 3, 4)))
        assert_close(out["kl_reference_policy"], torch.zeros_like(out["kl_reference_policy"]))


@base
def test_rows_of_several_episodes(case):
    """is_init inside a row resets the memory: the actor is called as TorchRL's losses call it."""
    actor = make_actor("gru")
    batch = sample(actor, 2, 3, 4)
    whole = case.build(actor)(batch)["loss_actor"]
    batch["is_init"][..., 2, :] = True
    batch["recurrent_state"][..., 2, :, :] = 0
    assert case.build(actor)(batch)["loss_actor"] != whole


# ------------------------------------------------------------------------------------------- masks


@base
def test_own_mask_key(case):
    """loss_mask_key names the entry, with or without a trailing dimension; others are ignored."""
    actor = make_actor()
    batch = pad(sample(actor, 2, 3, 4))
    expected = case.build(actor)(batch)
    mask = batch[MASK]
    batch[MASK] = torch.zeros_like(mask)
    for values in (mask, mask.unsqueeze(-1)):
        batch["masks", "valid"] = values
        loss = case.build(actor)
        loss.loss_mask_key = ("masks", "valid")
        assert_close(loss(batch), expected)


@base
def test_mask_key_that_is_not_there(case):
    """A mistyped key must not make padding count."""
    loss = case.build(make_actor())
    loss.loss_mask_key = "vaild"
    with pytest.raises(KeyError, match="'vaild' is missing"):
        loss(sample(make_actor(), 2, 3, 4))


@base
def test_parts_of_an_action_must_all_be_named(case):
    actor = make_actor("part_by_part")
    loss = case.build(actor)
    keys = ACTOR_KEYS["part_by_part"]
    loss.set_keys(action="move", sample_log_prob=keys["sample_log_prob"])
    with pytest.raises(ValueError, match=r"draws the parts.*'move', 'write'.*set_keys"):
        loss(sample(actor, 2, 3, 4))


@lifting
@pytest.mark.parametrize("missing", [0, 1])
def test_parts_of_the_log_probability_must_all_be_there(case, missing):
    """One that is not there does not mean that none was recorded."""
    actor = make_actor("composite")
    loss = case.build(actor, delay_actor=True)
    loss.set_keys(**ACTOR_KEYS["composite"])
    PeriodicCopy(loss, "actor_network", interval=1)
    key = ACTOR_KEYS["composite"]["sample_log_prob"][missing]
    with pytest.raises(KeyError, match=re.escape(repr(key))):
        loss(sample(actor, 2, 3, 4).exclude(key))


@losses
def test_vmap(case):
    """Several batches at once give what each gives."""
    actor = make_actor()
    loss = case.build(actor)
    batches = torch.stack([sample(actor, 2, 3, 4, seed=seed) for seed in range(4)])
    expected = torch.stack([loss(batch)["loss_actor"] for batch in batches])
    assert_close(torch.vmap(lambda batch: loss(batch)["loss_actor"])(batches), expected)


@base
def test_no_mask_key(case):
    """loss_mask_key None: all steps count, whatever ("collector", "mask") says."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = case.build(actor)
    loss.loss_mask_key = None
    expected = loss(batch)
    assert_close(case.build(actor)(batch), expected)
    assert_close(loss(batch.clone().set(MASK, torch.zeros(2, 3, 4, dtype=torch.bool))), expected)


@base
def test_mask_key_is_an_in_key(case):
    """Whenever the mask is named, a call without a tensordict takes it as a keyword."""
    loss = case.build(make_actor())
    assert loss.in_keys[-1] == MASK
    loss.loss_mask_key = "valid"
    assert loss.in_keys[-1] == "valid"
    loss.loss_mask_key = None
    assert loss.in_keys[-1] == "action_log_prob"


# --------------------------------------------------------------------------------------- reference


@lifting
@actors
@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_delayed_reference_and_older_data(case, kind, padded):
    """With delay_actor the target is the reference, corrected for the policy that drew the data."""
    behaviour, actor = make_actor(kind), make_actor(kind)
    batch = sample(behaviour, 2, 3, 4)
    batch = pad(batch) if padded else batch
    move(actor, 0.1)
    loss = case.build(actor, delay_actor=True)
    loss.set_keys(**ACTOR_KEYS.get(kind, {}))
    SoftUpdate(loss, eps=0.9)
    reference = make_actor(kind)
    move(reference, 0.1)
    move(actor)
    expected = [case.expected(actor, group, reference)[0] for group in split(batch)]
    assert_same(loss, actor, batch, torch.stack(expected))


@lifting
def test_delayed_reference_without_recorded_log_prob(case):
    """Nothing recorded: the data is taken to be the reference's, that is, the target's."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = case.build(actor, delay_actor=True)
    HardUpdate(loss, value_network_update_interval=1)
    move(actor)
    assert_close(loss(batch.exclude("action_log_prob")), case.build(actor)(batch))


@lifting
def test_actor_that_rewrites_its_input(case):
    """The reference reads what the data says, not what the policy made of it a moment ago."""
    recorded = make_actor()
    scale = TensorDictModule(lambda x: 2 * x, ["observation"], ["observation"])
    actor = ProbabilisticTensorDictSequential(scale, *make_actor())
    batch = sample(recorded, 2, 3, 4)
    batch["observation"] /= 2
    loss = case.build(actor, delay_actor=True)
    HardUpdate(loss, value_network_update_interval=1)
    assert loss(batch)["kl_reference_policy"].abs() < 1e-12
    assert_close(loss(batch)["loss_actor"], case.build(actor)(batch)["loss_actor"])


@lifting
@pytest.mark.parametrize(
    ("make_updater", "fraction"),
    [
        (lambda loss: SoftUpdate(loss, tau=0.25), 0.25),
        (lambda loss: HardUpdate(loss, value_network_update_interval=0), 1.0),
        (lambda loss: PeriodicCopy(loss, "actor_network", interval=1), 1.0),
        (lambda loss: PolyakAverage(loss, "actor_network", weight=0.25), 0.25),
    ],
    ids=["SoftUpdate", "HardUpdate", "PeriodicCopy", "PolyakAverage"],
)
def test_updaters_move_the_reference(case, make_updater, fraction):
    """After an optimiser step the target is still the old policy; the updater moves it."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = case.build(actor, delay_actor=True)
    updater = make_updater(loss)
    optimizer = torch.optim.SGD(loss.parameters(), lr=0.1)
    old = loss.actor_network_params.data.clone()
    loss(batch)["loss_actor"].backward()
    optimizer.step()
    new = loss.actor_network_params.data
    assert_close(loss.target_actor_network_params.data, old)
    assert loss(batch)["kl_reference_policy"].abs() > 1e-4
    updater.step()
    assert_close(loss.target_actor_network_params.data, old.lerp(new, fraction))


# ------------------------------------------------------------------------------- exact enumeration


class Tabular(torch.nn.Module):
    """Two actions, three steps, probabilities in quarters: 32 samples reproduce it exactly."""

    def __init__(self) -> None:
        super().__init__()
        odds = torch.tensor([[1.0, 3.0], [2.0, 2.0], [3.0, 1.0]], dtype=torch.float64)
        self.logits = torch.nn.Parameter(odds.log())

    def forward(self, time: Tensor) -> Tensor:
        return self.logits[time]


def _tabular_actor():
    network = TensorDictModule(Tabular(), ["time"], ["logits"])
    return ProbabilisticActor(network, in_keys=["logits"], distribution_class=Categorical)


TRAJECTORIES = torch.cartesian_prod(*[torch.arange(2)] * 3)
RETURNS = torch.tensor([0.3, -1.0, 0.0, 2.0, 1.1, 0.4, -0.2, 0.9], dtype=torch.float64)


def _log_prob(actor) -> Tensor:
    """[8], of every trajectory there is."""
    table = next(actor.parameters()).log_softmax(-1)
    return table[torch.arange(3), TRAJECTORIES].sum(-1)


def _enumeration(which: Tensor, log_prob: Tensor) -> TensorDict:
    """The trajectories numbered ``which``, with the log-probability under their sampler."""
    shape = (len(which), 3)
    reward = torch.zeros(*shape, 1, dtype=torch.float64)
    reward[:, -1, 0] = RETURNS[which]
    return TensorDict(
        {
            "time": torch.arange(3).expand(shape),
            "action": TRAJECTORIES[which],
            "action_log_prob": (log_prob[which] / 3).unsqueeze(-1).expand(shape),
            "next": {"reward": reward},
        },
        batch_size=shape,
    )


def _objective(name: str, log_prob: Tensor, reference: Tensor, tau: float, tau_prime: float = 0.0):
    """What the paper minimises, exactly, over all trajectories."""
    prob = log_prob.exp()
    if name == "ment":
        return -(prob * (RETURNS - tau * log_prob)).sum()
    if name == "urex":
        target = (RETURNS / tau).softmax(0)
        return -(prob * RETURNS).sum() - tau * (target * log_prob).sum()
    if name == "ecpo":
        target = ((RETURNS + tau * reference) / (tau + tau_prime)).softmax(0)
        return (target * (target.log() - log_prob)).sum()
    divergence = (prob * (log_prob - reference)).sum()
    return -(prob * RETURNS).sum() + tau * divergence + tau_prime * (prob * log_prob).sum()


@pytest.mark.parametrize("name", CASES)
def test_exact_sample_gives_the_exact_gradient(name):
    """K = 32 samples in the exact proportions of the policy: the gradient of the objective."""
    case, actor = CASES[name], _tabular_actor()
    log_prob = _log_prob(actor)
    counts = (32 * log_prob.detach().exp()).round().long()
    assert counts.sum() == 32
    which = torch.arange(8).repeat_interleave(counts)
    got = gradients(case.build(actor)(_enumeration(which, log_prob.detach()))["loss_actor"], actor)
    objective = _objective(name, log_prob, log_prob.detach(), **case.temperatures)
    assert_close(got, gradients(objective, actor))


@pytest.mark.parametrize("name", LIFTING)
def test_all_trajectories_of_a_uniform_sampler_give_the_exact_gradient(name):
    """K = all trajectories, drawn uniformly; policy, reference and sampler are all different."""
    case, actor = CASES[name], _tabular_actor()
    loss = case.build(actor, delay_actor=True)
    HardUpdate(loss, value_network_update_interval=1)
    reference = _log_prob(actor).detach()
    move(actor, 0.5)
    uniform = torch.full_like(reference, 1 / 8).log()
    out = loss(_enumeration(torch.arange(8), uniform))
    log_prob = _log_prob(actor)
    objective = _objective(name, log_prob, reference, **case.temperatures)
    assert_close(gradients(out["loss_actor"], actor), gradients(objective, actor))
    divergence = (reference.exp() * (reference - log_prob)).sum()
    assert_close(out["kl_reference_policy"], divergence.detach())
    assert_close(out["entropy"], -(log_prob.exp() * log_prob).sum().detach())


# ------------------------------------------------------------------------------------- diagnostics


def _expected_diagnostics(n: Numbers, weights: Tensor) -> dict[str, Tensor]:
    of_reference = (n.reference - n.behaviour).exp()
    of_policy = (n.log_prob - n.behaviour).exp()
    return {
        "ESS": weights.sum() ** 2 / weights.square().sum(),
        "max_weight": weights.max(),
        "kl_reference_policy": (
            (of_reference * (n.reference - n.log_prob)).sum() / of_reference.sum()
        ),
        "entropy": -(of_policy * n.log_prob).sum() / of_policy.sum(),
        "return": n.returns.mean(),
        "equal_return_groups": (n.returns == n.returns[0]).all().to(n.returns),
    }


@losses
@pytest.mark.parametrize("masked", [(), (1, 5)], ids=["all", "some-left-out"])
def test_diagnostics(case, masked):
    """Each diagnostic is its formula, group by group; reduced, the mean over groups."""
    actor = make_actor()
    batch = sample(actor, 3, 3, 4)
    batch["next", "reward"][1] = 0.5  # constant by step, and by trajectory if of equal length
    batch = pad(batch, masked=masked)
    batch["next", "reward"][2].masked_fill_(batch[MASK][2].unsqueeze(-1), 0.0)
    move(actor)
    out = case.build(actor, reduction="none")(batch)
    expected = []
    with torch.no_grad():
        for group in split(batch):
            n = numbers(actor, group)
            weights = case.formula(n, **case.temperatures)[1]
            expected.append(TensorDict(_expected_diagnostics(n, weights)))
    expected = torch.stack(expected)
    assert_close(out.exclude("loss_actor"), expected)
    assert expected["equal_return_groups"].tolist() == [0.0, 0.0, 1.0]
    assert (out["ESS"] >= 1).all()
    assert (out["ESS"] <= 3).all()
    for reduction in ("mean", "sum"):
        means = case.build(actor, reduction=reduction)(batch).exclude("loss_actor")
        assert_close(means, expected.mean(0))


@losses
def test_diagnostics_carry_no_gradient_and_no_loss_name(case):
    """A trainer that sums everything named loss and backpropagates finds only the loss."""
    actor = make_actor()
    for reduction in ("none", "mean", "sum"):
        out = case.build(actor, reduction=reduction)(sample(actor, 2, 3, 4))
        assert [name for name, _ in out.items() if name.startswith("loss")] == ["loss_actor"]
        assert [name for name, value in out.items() if value.requires_grad] == ["loss_actor"]
    batch = sample(actor, 2, 3, 4)
    batch["next", "reward"].requires_grad_()
    out = case.build(actor)(batch)
    assert [name for name, value in out.items() if value.requires_grad] == ["loss_actor"]


@losses
def test_at_the_reference(case):
    """At theta = reference the divergence is 0."""
    actor = make_actor()
    assert case.build(actor)(sample(actor, 2, 3, 4))["kl_reference_policy"].abs() < 1e-12


def test_equal_returns_and_no_entropy_term():
    """Without a preference all weights are 1/K, and the effective sample size is K."""
    actor = make_actor()
    batch = sample(actor, 2, 5, 4)
    batch["next", "reward"].fill_(0.25)
    loss = CASES["ecpo"].build(actor)
    loss.tau_prime = 0.0
    out = loss(batch)
    assert_close(out["ESS"], torch.tensor(5.0).double())
    assert_close(out["max_weight"], torch.tensor(0.2).double())
    assert out["equal_return_groups"] == 1


# --------------------------------------------------------------------------------------- reduction


@losses
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_reduction(case, shape):
    """None is the mean over groups; "none" has a number for each; no groups, no dimensions."""
    actor = make_actor()
    batch = sample(actor, *shape)
    outs = {r: case.build(actor, reduction=r)(batch) for r in (None, "none", "mean", "sum")}
    assert outs["none"].batch_size == shape[:-2]
    assert {value.shape for value in outs["none"].values()} == {torch.Size(shape[:-2])}
    for reduction in (None, "mean", "sum"):
        assert outs[reduction].batch_size == torch.Size([])
        assert {value.shape for value in outs[reduction].values()} == {torch.Size([])}
    each = outs["none"]["loss_actor"]
    assert_close(outs["mean"]["loss_actor"], each.mean())
    assert_close(outs["sum"]["loss_actor"], each.sum())
    assert_close(outs[None], outs["mean"])


# ----------------------------------------------------------------------- what a batch may look like


@base
def test_a_batch_size_of_any_depth(case):
    """The shape is that of the rewards; a replay buffer may give a batch of fewer dimensions."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = case.build(actor)
    expected = loss(batch)
    for dims in range(3):
        shallow = batch.clone().auto_batch_size_(batch_dims=dims)
        assert_close(loss(shallow), expected)
        assert shallow.batch_dims == dims


@base
def test_lazily_stacked_and_locked_batches(case):
    """What collectors and buffers hand out."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = case.build(actor)
    expected = loss(batch)
    assert_close(loss(lazy_stack(list(batch.unbind(0)))), expected)
    assert_close(loss(lazy_stack(list(batch.unbind(1)), 1)), expected)
    assert_close(loss(batch.clone().lock_()), expected)


@base
def test_a_nested_action(case):
    """A multi-agent style action key, and a composite action read as one nested entry."""
    actor = make_actor("composite")
    batch = sample(actor, 2, 3, 4)
    loss = case.build(actor)
    loss.set_keys(**ACTOR_KEYS["composite"])
    expected = loss(batch)
    loss.set_keys(action=["action", "force"])
    assert_close(loss(batch), expected)


@base
def test_a_list_of_one_key(case):
    """A list is a list, also where the action has one part only."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = case.build(actor)
    expected = loss(batch)
    loss.set_keys(action=["action"], sample_log_prob=["action_log_prob"])
    assert_close(loss(batch), expected)


@losses
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("kind", ["categorical", "tanh_normal", "composite", "lstm"])
def test_gpu(case, kind):
    """The same numbers on a GPU, with the loss moved there after it was built."""
    actor = make_actor(kind)
    batch = pad(sample(actor, 2, 3, 4))
    move(actor)
    loss = case.build(actor)
    loss.set_keys(**ACTOR_KEYS.get(kind, {}))
    expected = loss(batch)
    got = loss.to("cuda")(batch.to("cuda"))
    assert got.device is None or got.device.type == "cuda"
    assert_close(got.cpu(), expected)


# --------------------------------------------------------------------------------------- bad input


def _change(**entries):
    return lambda batch: batch.update(entries)


def _without(key):
    return lambda batch: batch.exclude(key)


def _poke(key, value):
    def poke(batch):
        batch[key].view(-1)[1] = value
        return batch

    return poke


BAD_BATCHES = {
    "no action": (
        _without("action"),
        KeyError,
        r"'action' is missing; there are .*'observation'.*set_keys",
    ),
    "no reward": (
        _without(("next", "reward")),
        KeyError,
        r"\('next', 'reward'\) is missing.*set_keys",
    ),
    "no log-prob": (
        _without("action_log_prob"),
        KeyError,
        r"'action_log_prob' is missing.*return_log_prob=True.*set_keys",
    ),
    "no observation": (_without("observation"), KeyError, "observation"),
    "reward without trailing dimension": (
        lambda b: b.set(("next", "reward"), b["next", "reward"].squeeze(-1)),
        ValueError,
        r"reward.*\[\*G, K, T, 1\].*got \(2, 3, 4\)",
    ),
    "reward of one step without trailing dimension": (
        lambda b: b[..., :1].set(("next", "reward"), b["next", "reward"][..., :1, 0]),
        ValueError,
        r"\[\*G, K, T\] = \(2, 3\), that of the reward without its trailing 1, got \(2, 3, 1\)",
    ),
    "no trajectory dimension": (
        lambda b: b[0, 0],
        ValueError,
        r"reward.*\[\*G, K, T, 1\].*got \(4, 1\)",
    ),
    "one trajectory": (
        lambda b: b[:, :1],
        ValueError,
        r"K of the batch \[\*G, K, T\] = \(2, 1, 4\) must be.*at least 2.*got 1",
    ),
    "action of another shape": (
        lambda b: TensorDict(b.to_dict()).set("action", b["action"][..., 0]),
        ValueError,
        r"\[\*G, K, T\] = \(2, 3, 4\) of the reward.*action has shape.*\[2, 3\]",
    ),
    "observation of another shape": (
        lambda b: TensorDict(b.to_dict()).set("observation", b["observation"][:1]),
        ValueError,
        r"\[\*G, K, T\] = \(2, 3, 4\) of the reward.*observation has shape.*\[1, 3, 4, 3\]",
    ),
    "mask of another shape": (
        lambda b: TensorDict(b.to_dict()).set(MASK, torch.ones(2, 3, dtype=torch.bool)),
        ValueError,
        r"mask.*\(2, 3, 4\).*got \(2, 3\)",
    ),
    "mask with a dimension too many": (
        lambda b: b.set(MASK, torch.ones(2, 3, 4, 2, dtype=torch.bool)),
        ValueError,
        r"mask.*\(2, 3, 4\).*got \(2, 3, 4, 2\)",
    ),
    "mask of numbers": (
        lambda b: b.set(MASK, torch.ones(2, 3, 4)),
        ValueError,
        r"mask.*must be boolean.*got torch.float32",
    ),
    "mask of everything": (
        lambda b: b.set(MASK, torch.zeros(2, 3, 4, dtype=torch.bool)),
        ValueError,
        r"mask.*2 group\(s\) with fewer than two trajectories",
    ),
    "mask of everything, over junk": (
        lambda b: b.set(MASK, torch.zeros(2, 3, 4, dtype=torch.bool)).set(
            "observation", b["observation"] * torch.nan
        ),
        ValueError,
        r"mask.*2 group\(s\) with fewer than two trajectories",
    ),
    "mask of one group": (
        lambda b: b.set(MASK, (torch.arange(2) == 0).view(2, 1, 1).expand(2, 3, 4)),
        ValueError,
        r"mask.*1 group\(s\) with fewer than two trajectories",
    ),
    "mask of all but one": (
        lambda b: b.set(MASK, (torch.arange(3) == 0).view(1, 3, 1).expand(2, 3, 4)),
        ValueError,
        r"mask.*2 group\(s\) with fewer than two trajectories.*Drop such groups",
    ),
    "mask with a hole": (
        lambda b: b.set(MASK, (torch.arange(4) != 2).expand(2, 3, 4)),
        ValueError,
        r"mask.*holes in 6 trajectories: their real steps must come first",
    ),
    "mask with a late beginning": (
        lambda b: b.set(MASK, (torch.arange(4) > 0).expand(2, 3, 4)),
        ValueError,
        r"mask.*holes in 6 trajectories",
    ),
    "NaN reward": (
        _poke(("next", "reward"), torch.nan),
        ValueError,
        r"\('next', 'reward'\) is NaN or infinite in 1 of 6 trajectories",
    ),
    "infinite reward": (
        _poke(("next", "reward"), torch.inf),
        ValueError,
        r"\('next', 'reward'\) is NaN or infinite in 1 of 6 trajectories",
    ),
    "NaN log-prob": (
        _poke("action_log_prob", torch.nan),
        ValueError,
        r"'action_log_prob' is NaN or infinite in 1 of 6 trajectories",
    ),
    "infinite log-prob": (
        _poke("action_log_prob", -torch.inf),
        ValueError,
        r"'action_log_prob' is NaN or infinite in 1 of 6 trajectories",
    ),
    "log-prob with a trailing dimension": (
        lambda b: b.set("action_log_prob", b["action_log_prob"].unsqueeze(-1)),
        ValueError,
        r"'action_log_prob'.*\(2, 3, 4\).*got \(2, 3, 4, 1\).*trailing dimension",
    ),
}


@base
@pytest.mark.parametrize("name", BAD_BATCHES)
def test_bad_batch(case, name):
    """Each mistake is named, with what was expected, what came, and how to mend it."""
    spoil, error, message = BAD_BATCHES[name]
    actor = make_actor()
    batch = spoil(sample(actor, 2, 3, 4))
    with pytest.raises(error, match=message):
        case.build(actor)(batch)


@base
def test_actor_with_a_log_prob_of_trailing_dimension(case):
    """A distribution that is not summed over the action's components."""
    network = torch.nn.Sequential(torch.nn.Linear(3, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=torch.distributions.Normal,
    ).double()
    batch = sample(make_actor(), 2, 3, 4)
    batch["action"] = torch.randn(2, 3, 4, 1).double()
    with pytest.raises(ValueError, match=r"Normal gives.*\(6, 4, 1\).*\(6, 4\).*Independent"):
        case.build(actor)(batch)


@base
def test_several_action_keys_for_one_distribution(case):
    """A list of keys belongs to a composite distribution: the others would be left out."""
    actor = make_actor()
    loss = case.build(actor)
    loss.set_keys(action=["action", "is_init"])
    with pytest.raises(ValueError, match=r"\['action', 'is_init'\].*Categorical.*set_keys"):
        loss(sample(actor, 2, 3, 4))


@base
def test_padded_junk_is_no_bad_input(case):
    """NaN in padded steps is refused by nothing, not even where it is all a trajectory has."""
    actor = make_actor()
    assert case.build(actor)(pad(sample(actor, 2, 3, 4), masked=(2,)))["loss_actor"].isfinite()


@base
@pytest.mark.parametrize("reduction", ["bogus", "MEAN", "", 0])
def test_unknown_reduction(case, reduction):
    """Refused at the door, not at the first call."""
    with pytest.raises(ValueError, match=r"reduction must be one of.*none.*mean.*sum.*got"):
        case.build(make_actor(), reduction=reduction)


@base
def test_actor_without_get_dist(case):
    """A bare network is no policy."""
    with pytest.raises(TypeError, match=r"get_dist.*ProbabilisticActor.*got Linear"):
        case.build(torch.nn.Linear(3, 4))


TEMPERATURES = [(name, key) for name, case in CASES.items() for key in case.temperatures]


@pytest.mark.parametrize(("name", "temperature"), TEMPERATURES)
@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf"), -1])
def test_bad_temperature(name, temperature, value):
    """Refused by the constructor and by a schedule, which leaves the old value."""
    case = CASES[name]
    message = rf"{temperature} must be a finite number >= 0, got {value}"
    with pytest.raises(ValueError, match=message):
        case.loss(make_actor(), **{temperature: value})
    loss = case.build(make_actor())
    with pytest.raises(ValueError, match=message):
        setattr(loss, temperature, value)
    assert getattr(loss, temperature).item() == case.temperatures[temperature]


@pytest.mark.parametrize(
    ("name", "temperatures", "message"),
    [
        ("ecpo", {"tau": 0.0, "tau_prime": 0.0}, r"tau \+ tau_prime must be positive"),
        ("pmd", {"tau": 0.0, "tau_prime": 0.0}, r"tau \+ tau_prime must be positive"),
        ("urex", {"tau": 0.0}, "tau must be positive"),
    ],
)
def test_no_regularisation(name, temperatures, message):
    """All temperatures 0: refused by the constructor, and by the schedule's last step."""
    case = CASES[name]
    with pytest.raises(ValueError, match=message):
        case.loss(make_actor(), **temperatures)
    loss = case.build(make_actor())
    *others, last = temperatures
    for other in others:
        setattr(loss, other, 0.0)
    with pytest.raises(ValueError, match=message):
        setattr(loss, last, 0.0)
    assert getattr(loss, last).item() == case.temperatures[last]


def test_one_of_two_temperatures_may_be_zero():
    """tau' = 0 is the paper's ablation, tau = 0 UREX's weights, and MENT's tau = 0 REINFORCE."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    for name, temperature in [("ecpo", "tau"), ("ecpo", "tau_prime"), ("pmd", "tau_prime")]:
        loss = CASES[name].build(actor)
        setattr(loss, temperature, 0.0)
        assert loss(batch)["loss_actor"].isfinite()
    loss = CASES["ment"].build(actor)
    loss.tau = 0
    assert loss(batch)["loss_actor"].isfinite()


@pytest.mark.parametrize(("name", "temperature"), TEMPERATURES)
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (torch.tensor(-1.0), "must be a finite number >= 0, got -1.0"),
        ("warm", "must be a number, got 'warm'"),
        (None, "must be a number, got None"),
        (torch.ones(2), "must be a number, got tensor"),
    ],
)
def test_a_temperature_of_another_type(name, temperature, value, message):
    """Tensors are looked at like numbers, and nothing else is taken."""
    case = CASES[name]
    with pytest.raises(ValueError, match=rf"{temperature} {message}"):
        case.loss(make_actor(), **{temperature: value})
    loss = case.build(make_actor())
    with pytest.raises(ValueError, match=rf"{temperature} {message}"):
        setattr(loss, temperature, value)
    setattr(loss, temperature, torch.tensor(0.25))
    assert getattr(loss, temperature).item() == 0.25
    assert temperature in dict(loss.named_buffers())


@base
@pytest.mark.parametrize("shape", [(0, 4, 5), (3, 4, 0)])
def test_an_empty_batch(case, shape):
    """No groups, or no steps."""
    batch = TensorDict(
        {
            "observation": torch.zeros(*shape, 3),
            "action": torch.zeros(shape, dtype=torch.int64),
            "action_log_prob": torch.zeros(shape),
            "next": {"reward": torch.zeros(*shape, 1)},
        },
        batch_size=shape,
    )
    with pytest.raises(ValueError, match=r"The batch is empty: the reward .* has the shape"):
        case.build(make_actor())(batch)


def test_theorem_1_schedules_the_mode_seeking_loss_too():
    """Whose tau is 0 at the first lift, while its tau' was 0 before."""
    loss = CASES["pmd"].loss(make_actor())
    temperatures = TemperatureScheduler(loss, **theorem1_schedules(10_000))
    assert loss.tau.item() == 0
    assert loss.tau_prime.item() > 0
    temperatures.step()
    assert loss.tau.item() > 0
