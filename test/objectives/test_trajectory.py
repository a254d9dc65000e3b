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
from torchrl.data import MultiStep
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import HardUpdate, SoftUpdate
from trajectory_problems import (
    ACTOR_KEYS,
    ACTORS,
    CASES,
    DELAYED,
    MASK,
    Numbers,
    expected_losses,
    gradients,
    make_actor,
    move,
    numbers,
    pad,
    problem,
    sample,
    split,
)

from torchrl_ecpo.objectives.trajectory import _sum_parts
from torchrl_ecpo.schedules import TemperatureScheduler, theorem1_schedules
from torchrl_ecpo.updaters import PeriodicCopy, PolyakAverage

ECPO = CASES["ecpo"]  # of which is asked what stands once in the base class
SHAPE = (2, 2, 3, 4)
losses = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
delayable = pytest.mark.parametrize("case", [CASES[n] for n in DELAYED], ids=DELAYED)


def with_actors(names, kinds=tuple(ACTORS)):
    """Each loss, and ECPO with every kind of actor, whose log-probabilities the base reads."""
    pairs = [(name, "categorical") for name in names]
    pairs += [("ecpo", kind) for kind in kinds if kind != "categorical"]
    return pytest.mark.parametrize(("name", "kind"), pairs)


def with_padding(names):
    """The same with padded steps, and a few without."""
    (pairs,) = with_actors(names).args[1:]
    whole = [("ecpo", kind) for kind in ("categorical", "composite", "lstm")]
    each = [*((*pair, True) for pair in pairs), *((*pair, False) for pair in whole)]
    return pytest.mark.parametrize(("name", "kind", "padded"), each)


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


@with_padding(CASES)
def test_formula(name, kind, padded):
    """Any actor, any lengths, NaN and infinity in every padded step: the formula, unpadded."""
    loss, actor, batch = problem(CASES[name], kind, padded=padded)
    assert_same(loss, actor, batch, expected_losses(CASES[name], actor, batch))


@pytest.mark.parametrize(
    ("name", "shape", "masked"),
    [
        *((name, SHAPE, (1, 5)) for name in CASES),
        *(("ecpo", *each) for each in ((SHAPE, ()), ((3, 4), (1, 5)), ((3, 4), ()))),
    ],
)
def test_group_shapes_and_missing_trajectories(name, shape, masked):
    """A trajectory without a real step is left out of its group, at any place of the batch."""
    case, actor = CASES[name], make_actor()
    masked = tuple(n for n in masked if n < torch.Size(shape[:-1]).numel())
    batch = pad(sample(actor, *shape), masked=masked)
    move(actor)
    assert sum(map(len, split(batch))) == torch.Size(shape[:-1]).numel() - len(masked)
    loss = case.build(actor)
    assert_same(loss, actor, batch, expected_losses(case, actor, batch))
    assert loss(batch)["loss_actor"].shape == shape[:-2]


def test_missing_first_trajectory_of_a_recurrent_actor():
    """The steps that a trajectory without any borrows do not disturb the others, nor its id."""
    loss, actor, batch = problem(ECPO, "lstm", padded=False)
    batch = pad(batch, masked=(0, 3))
    batch["group"] = 7 * batch[MASK].long()
    assert_same(loss, actor, batch, expected_losses(ECPO, actor, batch))


@losses
def test_float32(case):
    """In float32 the same numbers, to the precision of float32."""
    loss, actor, batch = problem(case)
    double = loss(batch)["loss_actor"]
    double = [double, *gradients(double, actor)]
    out = loss.float()(batch.apply(lambda x: x.float() if x.is_floating_point() else x))
    assert {value.dtype for value in out.values()} == {torch.float32}
    single = [out["loss_actor"], *gradients(out["loss_actor"], actor)]
    for found, expected in zip(single, double, strict=True):
        assert_close(found.double(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("case", [ECPO, CASES["grpo"]], ids=["of trajectories", "of steps"])
@pytest.mark.parametrize("autocast", [False, True], ids=["bfloat16", "autocast"])
def test_half_precision(case, autocast):
    """What an actor gives in half precision is added up, and reckoned with, in single precision."""
    actor = make_actor(dtype=torch.float32 if autocast else torch.bfloat16)
    batch = torch.cat([sample(actor, 1, 8, 30)] * 10, -1)
    batch["next", "done"][..., :-1, :] = False
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


@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_integer_rewards(padded):
    """Everything is reckoned in the dtype of the log-probabilities."""
    loss, _, batch = problem(ECPO, padded=padded)
    batch["next", "reward"] = (3 * batch["next", "reward"]).round()
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


@pytest.mark.parametrize("kind", ["lstm", "gru"])
def test_recurrent_memory_is_that_of_the_rollout(kind):
    """One pass over a trajectory gives the log-probability that was recorded step by step."""
    actor = make_actor(kind)
    out = ECPO.build(actor)(pad(sample(actor, 2, 3, 4)))
    assert_close(out["kl_reference_policy"], torch.zeros_like(out["kl_reference_policy"]))


def test_rows_of_several_episodes():
    """is_init inside a row resets the memory: the actor is called as TorchRL's losses call it."""
    loss, _, batch = problem(ECPO, "gru", padded=False)
    whole = loss(batch)["loss_actor"]
    batch["is_init"][..., 2, :] = True
    batch["recurrent_state"][..., 2, :, :] = 0
    assert loss(batch)["loss_actor"] != whole


@losses
def test_vmap(case):
    """Several batches at once give what each gives."""
    actor = make_actor()
    loss = case.build(actor)
    batches = torch.stack([sample(actor, 2, 3, 4, seed=seed) for seed in range(4)])
    expected = torch.stack([loss(batch)["loss_actor"] for batch in batches])
    assert_close(torch.vmap(lambda batch: loss(batch)["loss_actor"])(batches), expected)


# ------------------------------------------------------------------------------------------- masks


def test_own_mask_key():
    """loss_mask_key names the entry, with or without a trailing dimension; others are ignored."""
    loss, _, batch = problem(ECPO)
    expected, mask = loss(batch), batch[MASK]
    assert MASK in loss.in_keys
    batch[MASK] = torch.zeros_like(mask)
    loss.loss_mask_key = ("masks", "valid")
    assert ("masks", "valid") in loss.in_keys
    assert MASK not in loss.in_keys
    for values in (mask, mask.unsqueeze(-1)):
        batch["masks", "valid"] = values
        assert_close(loss(batch), expected)
    loss.loss_mask_key = "vaild"  # a mistyped key must not make padding count
    with pytest.raises(KeyError, match="'vaild' is missing"):
        loss(batch)


def test_no_mask_key():
    """loss_mask_key None: all steps count, whatever ("collector", "mask") says."""
    loss, _, batch = problem(ECPO, padded=False)
    expected = loss(batch)
    loss.loss_mask_key = None
    assert MASK not in loss.in_keys
    assert_close(loss(batch.set(MASK, torch.zeros(2, 3, 4, dtype=torch.bool))), expected)


# --------------------------------------------------------------------------------------- reference


@with_padding(DELAYED)
def test_delayed_reference_and_older_data(name, kind, padded):
    """With delay_actor the target is the reference, corrected for the policy that drew the data."""
    case = CASES[name]
    loss, actor, batch = problem(case, kind, padded=padded, lag=0.1, delay_actor=True)
    reference = make_actor(kind)
    move(reference, 0.1)
    assert_same(loss, actor, batch, expected_losses(case, actor, batch, reference))


@delayable
def test_an_error_leaves_the_actor_as_it_was(case):
    """tensordict's ``to_module`` would leave the delayed parameters in it, which nobody trains."""
    loss, actor, batch = problem(case, padded=False, delay_actor=True)
    before = [*map(id, actor.parameters())]
    with pytest.raises(ValueError, match="cannot be evaluated on"):
        loss(batch.set("observation", batch["observation"][..., :1]))
    assert [*map(id, actor.parameters())] == before


@delayable
def test_delayed_reference_without_recorded_log_prob(case):
    """Nothing recorded: the data is taken to be the reference's, that is, the target's."""
    loss, actor, batch = problem(case, padded=False, delay_actor=True)
    assert_close(loss(batch.exclude("action_log_prob")), case.build(actor)(batch))


def test_steps_of_a_policy_may_have_names():
    loss, actor, batch = problem(ECPO, "part_by_part")
    named = ProbabilisticTensorDictSequential({str(n): step for n, step in enumerate(actor.module)})
    other = ECPO.build(named)
    other.set_keys(**ACTOR_KEYS["part_by_part"])
    assert_close(other(batch)["loss_actor"], loss(batch)["loss_actor"])


def test_nested_parts_of_an_action_are_summed():
    parts = TensorDict({"move": torch.tensor([1.0]), "hand": {"grip": torch.tensor([2.0])}}, [1])
    parts["hand", "force"] = torch.tensor([4.0])
    assert _sum_parts(parts).tolist() == [7.0]


@pytest.mark.parametrize("missing", [0, 1])
def test_parts_of_the_log_probability_must_all_be_there(missing):
    """One that is not there does not mean that none was recorded."""
    loss, _, batch = problem(ECPO, "composite", delay_actor=True)
    key = ACTOR_KEYS["composite"]["sample_log_prob"][missing]
    with pytest.raises(KeyError, match=re.escape(repr(key))):
        loss(batch.exclude(key))


def test_actor_that_rewrites_its_input():
    """The reference reads what the data says, not what the policy made of it a moment ago."""
    recorded = make_actor()
    scale = TensorDictModule(lambda x: 2 * x, ["observation"], ["observation"])
    actor = ProbabilisticTensorDictSequential(scale, *make_actor())
    batch = sample(recorded, 2, 3, 4)
    batch["observation"] /= 2
    loss = ECPO.build(actor, delay_actor=True)
    HardUpdate(loss, value_network_update_interval=1)
    assert loss(batch)["kl_reference_policy"].abs() < 1e-12
    assert_close(loss(batch)["loss_actor"], ECPO.build(actor)(batch)["loss_actor"])


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
def test_updaters_move_the_reference(make_updater, fraction):
    """After an optimiser step the target is still the old policy; the updater moves it."""
    actor = make_actor()
    batch = sample(actor, 2, 3, 4)
    loss = ECPO.build(actor, delay_actor=True)
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


def _steps(actor) -> Tensor:
    """[8, 3], log-probability of each step of every trajectory there is."""
    return next(actor.parameters()).log_softmax(-1)[torch.arange(3), TRAJECTORIES]


def _enumeration(which: Tensor, steps: Tensor) -> TensorDict:
    """The trajectories numbered ``which``, with the log-probability under their sampler."""
    shape = (len(which), 3)
    reward = torch.zeros(*shape, 1, dtype=torch.float64)
    reward[:, -1, 0] = RETURNS[which]
    return TensorDict(
        {
            "time": torch.arange(3).expand(shape),
            "action": TRAJECTORIES[which],
            "action_log_prob": steps[which].detach(),
            "next": {"reward": reward},
        },
        batch_size=shape,
    )


def _objective(
    name: str, log_prob: Tensor, reference: Tensor, tau: float = 0.0, tau_prime: float = 0.0, **_
):
    """What is minimised, exactly, over all trajectories; of GRPO at the reference."""
    prob, old = log_prob.exp(), reference.exp()
    if name in ("ment", "rloo"):
        size = 1 if name == "ment" else 32 / 31
        return -(prob * (RETURNS - tau * log_prob)).sum() * size
    deviation = (old * (RETURNS - (old * RETURNS).sum()) ** 2).sum().sqrt()
    if name == "grpo":
        return -(prob * RETURNS).sum() / deviation / 3  # the mean over three steps
    if name == "tpo":  # the old policy counts twice
        target = (2 * reference + RETURNS / deviation / tau).softmax(0)
        return -(target * log_prob).sum() + (old * prob).sum().log()
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
    steps = _steps(actor)
    log_prob = steps.sum(-1)
    counts = (32 * log_prob.detach().exp()).round().long()
    assert counts.sum() == 32
    which = torch.arange(8).repeat_interleave(counts)
    got = gradients(case.build(actor)(_enumeration(which, steps))["loss_actor"], actor)
    objective = _objective(name, log_prob, log_prob.detach(), **case.temperatures)
    assert_close(got, gradients(objective, actor))


@pytest.mark.parametrize("name", ["ecpo", "pmd"])
def test_all_trajectories_of_a_uniform_sampler_give_the_exact_gradient(name):
    """K = all trajectories, drawn uniformly; policy, reference and sampler are all different."""
    case, actor = CASES[name], _tabular_actor()
    loss = case.build(actor, delay_actor=True)
    HardUpdate(loss, value_network_update_interval=1)
    reference = _steps(actor).sum(-1).detach()
    move(actor, 0.5)
    uniform = torch.full((8, 3), 0.5).double().log()
    out = loss(_enumeration(torch.arange(8), uniform))
    log_prob = _steps(actor).sum(-1)
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


@pytest.mark.parametrize(("name", "masked"), [("ecpo", ()), *((name, (1, 5)) for name in CASES)])
def test_diagnostics(name, masked):
    """Each diagnostic is its formula, group by group; reduced, the mean over groups."""
    case, actor = CASES[name], make_actor()
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
            weights = case.formula(n, **case.temperatures, **case.options)[1]
            expected.append(TensorDict(_expected_diagnostics(n, weights)))
    expected = torch.stack(expected)
    own = ("loss_actor", "clip_fraction")
    assert_close(out.exclude(*own), expected)
    assert expected["equal_return_groups"].tolist() == [0.0, 0.0, 1.0]
    assert (out["ESS"] >= 1).all()
    assert (out["ESS"] <= 3).all()
    for reduction in ("mean", "sum"):
        means = case.build(actor, reduction=reduction)(batch)
        assert_close(means.exclude(*own), expected.mean(0))


def test_equal_returns_and_no_entropy_term():
    """Without a preference all weights are 1/K, and the effective sample size is K."""
    loss, _, batch = problem(ECPO, padded=False)
    batch["next", "reward"].fill_(0.25)
    loss.tau_prime = 0.0
    out = loss(batch)
    assert_close(out["ESS"], torch.tensor(3.0).double())
    assert_close(out["max_weight"], torch.tensor(1 / 3).double())
    assert out["equal_return_groups"] == 1


# --------------------------------------------------------------------------------------- reduction


@pytest.mark.parametrize(("name", "shape"), [("ecpo", (3, 4)), *((name, SHAPE) for name in CASES)])
def test_reduction(name, shape):
    """None is the mean over groups; "none" has a number for each; only the loss has a gradient.

    A trainer that sums everything named loss and backpropagates finds only the loss.
    """
    case, actor = CASES[name], make_actor()
    batch = sample(actor, *shape)
    batch["next", "reward"].requires_grad_()
    outs = {r: case.build(actor, reduction=r)(batch) for r in (None, "none", "mean", "sum")}
    for reduction, out in outs.items():
        size = shape[:-2] if reduction == "none" else ()
        assert out.batch_size == size
        assert {value.shape for value in out.values()} == {torch.Size(size)}
        assert [name for name, _ in out.items() if name.startswith("loss")] == ["loss_actor"]
        assert [name for name, value in out.items() if value.requires_grad] == ["loss_actor"]
    each = outs["none"]["loss_actor"]
    assert_close(outs["mean"]["loss_actor"], each.mean())
    assert_close(outs["sum"]["loss_actor"], each.sum())
    assert_close(outs[None], outs["mean"])


# ----------------------------------------------------------------------- what a batch may look like


def test_batches_of_any_kind():
    """What collectors and buffers hand out: any depth (the rewards' shape counts), lazy, locked."""
    loss, _, batch = problem(ECPO, padded=False)
    expected = loss(batch)
    for dims in range(3):
        shallow = batch.clone().auto_batch_size_(batch_dims=dims)
        assert_close(loss(shallow), expected)
        assert shallow.batch_dims == dims
    whole = {MASK: torch.ones(2, 3, 4, dtype=torch.bool)}
    for dim in (0, 1):
        assert_close(loss(lazy_stack(list(batch.unbind(dim)), dim)), expected)
        masked = list(batch.clone().update(whole).unbind(dim))
        assert_close(loss(lazy_stack(masked, dim)), expected)
    rows = [TensorDict(row.to_dict(), row.shape[:1]) for row in batch.unbind(0)]
    assert_close(loss(lazy_stack(rows)), expected)
    for lock in ("lock_", "memmap_", "share_memory_"):
        assert_close(loss(getattr(batch.clone(), lock)()), expected)


def test_lists_of_keys():
    """A composite action as one nested entry, and a list of one key."""
    loss, _, batch = problem(ECPO, "composite")
    expected = loss(batch)
    loss.set_keys(action=["action", "force"])
    assert_close(loss(batch), expected)
    loss, _, batch = problem(ECPO)
    expected = loss(batch)
    loss.set_keys(action=["action"], sample_log_prob=["action_log_prob"])
    assert_close(loss(batch), expected)


@with_actors(CASES, kinds=("tanh_normal", "composite", "lstm"))
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_gpu(name, kind):
    """The same numbers on a GPU, with the loss moved there after it was built."""
    loss, _, batch = problem(CASES[name], kind)
    expected = loss(batch)
    got = loss.to("cuda")(batch.to("cuda"))
    assert got.device is None or got.device.type == "cuda"
    assert_close(got.cpu(), expected)


# --------------------------------------------------------------------------------------- bad input


def _without(key):
    return lambda batch: batch.exclude(key)


def _set(key, value):
    """An entry in the place of another, of any shape."""

    def change(batch):
        loose = TensorDict(batch.to_dict())
        return loose.set(key, value(batch[key]) if callable(value) else value)

    return change


def _poke(key, value):
    def poke(batch):
        batch[key].view(-1)[1] = value
        return batch

    return poke


REWARD, T = ("next", "reward"), torch.arange(4)
FEW = r"mask.*{} group\(s\) with fewer than two trajectories"
NOT_FINITE = r"{} is NaN or infinite in 1 of 6 trajectories"
BAD_BATCHES = {
    "no action": (
        *(_without("action"), KeyError),
        r"'action' is missing; there are .*'observation'.*set_keys",
    ),
    "no reward": (
        *(_without(REWARD), KeyError),
        r"\('next', 'reward'\) is missing.*set_keys",
    ),
    "no log-prob": (
        *(_without("action_log_prob"), KeyError),
        r"'action_log_prob' is missing.*return_log_prob=True.*set_keys",
    ),
    "no observation": (_without("observation"), KeyError, "observation"),
    "reward without trailing dimension": (
        *(_set(REWARD, lambda x: x.squeeze(-1)), ValueError),
        r"reward.*\[\*G, K, T, 1\].*got \(2, 3, 4\)",
    ),
    "reward of one step without trailing dimension": (
        *(lambda b: b[..., :1].set(REWARD, b[REWARD][..., :1, 0]), ValueError),
        r"\[\*G, K, T\] = \(2, 3\), that of the reward without its trailing 1, got \(2, 3, 1\)",
    ),
    "no trajectory dimension": (
        *(lambda b: b[0, 0], ValueError),
        r"reward.*\[\*G, K, T, 1\].*got \(4, 1\)",
    ),
    "one trajectory": (
        *(lambda b: b[:, :1], ValueError),
        r"K of the batch \[\*G, K, T\] = \(2, 1, 4\) must be.*at least 2.*got 1",
    ),
    "no groups": (lambda b: b[:0], ValueError, r"The batch is empty: the reward .* has the shape"),
    "no steps": (lambda b: b[..., :0], ValueError, r"The batch is empty: the reward .* has the"),
    "action of another shape": (
        *(_set("action", lambda x: x[..., 0]), ValueError),
        r"\[\*G, K, T\] = \(2, 3, 4\) of the reward.*action has shape.*\[2, 3\]",
    ),
    "observation of another shape": (
        *(_set("observation", lambda x: x[:1]), ValueError),
        r"\[\*G, K, T\] = \(2, 3, 4\) of the reward.*observation has shape.*\[1, 3, 4, 3\]",
    ),
    "mask of another shape": (
        *(_set(MASK, torch.ones(2, 3, 4, 2, dtype=torch.bool)), ValueError),
        r"mask.*\(2, 3, 4\).*got \(2, 3, 4, 2\)",
    ),
    "mask of numbers": (
        *(_set(MASK, torch.ones(2, 3, 4)), ValueError),
        r"mask.*must be boolean.*got torch.float32",
    ),
    "mask of everything, over junk": (
        lambda b: b.set(MASK, torch.zeros(2, 3, 4, dtype=torch.bool)).set(
            "observation", b["observation"] * torch.nan
        ),
        *(ValueError, FEW.format(2)),
    ),
    "mask of one group": (
        _set(MASK, (torch.arange(2) == 0).view(2, 1, 1).expand(2, 3, 4)),
        *(ValueError, FEW.format(1)),
    ),
    "mask of all but one": (
        _set(MASK, (torch.arange(3) == 0).view(1, 3, 1).expand(2, 3, 4)),
        *(ValueError, FEW.format(2) + ".*Drop such groups"),
    ),
    "mask with a hole": (
        *(_set(MASK, (T != 2).expand(2, 3, 4)), ValueError),
        r"mask.*holes in 6 trajectories: their real steps must come first",
    ),
    "mask with a late beginning": (
        *(_set(MASK, (T > 0).expand(2, 3, 4)), ValueError),
        r"mask.*holes in 6 trajectories",
    ),
    "NaN reward": (
        *(_poke(REWARD, torch.nan), ValueError),
        NOT_FINITE.format(r"\('next', 'reward'\)"),
    ),
    "infinite log-prob": (
        *(_poke("action_log_prob", -torch.inf), ValueError),
        NOT_FINITE.format("'action_log_prob'"),
    ),
    "complex reward": (
        *(_set(REWARD, lambda x: x.cfloat()), ValueError),
        r"\('next', 'reward'\) must hold real numbers, got torch.complex64",
    ),
    "trajectories of two groups": (
        *(_set("group", torch.arange(3).expand(2, 3)), ValueError),
        r"4 rows of the batch.* are of another group \('group'\) than others",
    ),
    "rows of two groups": (
        *(_set("group", torch.arange(3).expand(2, 3).unsqueeze(-1).expand(2, 3, 4)), ValueError),
        r"4 rows of the batch.* are of another group \('group'\) than others",
    ),
    "one-step rows of two groups": (
        lambda b: b[..., -1:].set("group", torch.arange(3).expand(2, 3).unsqueeze(-1)),
        *(ValueError, r"4 rows of the batch.* are of another group"),
    ),
    "rows that go on after an end": (
        *(_poke(("next", "done"), True), ValueError),
        r"1 rows of the batch.* go on after an end \(\('next', 'done'\)\)",
    ),
    "rows of unequal length": (
        lambda b: lazy_stack([b[0, 0], b[0, 1, :2]]),
        *(ValueError, r"rows of the batch \(2, -1\) are of unequal length: .*pack_groups"),
    ),
    "observation of another length": (
        *(_set("observation", lambda x: x[..., :2]), ValueError),
        r"cannot be evaluated on 'observation' torch.float64 \(6, 4, 2\), 'action'",
    ),
    "action out of range": (
        *(_poke("action", 9), ValueError),
        r"actor cannot be evaluated on .*'action' torch.int64 \(6, 4\).*out of bounds",
    ),
    "action that is no index": (
        *(_set("action", lambda x: x + 0.5), ValueError),
        "'action' must hold integers, got torch.float32",
    ),
    "complex log-prob": (
        *(_set("action_log_prob", lambda x: x.cfloat()), ValueError),
        "'action_log_prob' must hold real numbers",
    ),
    "NaN observation": (
        *(_poke("observation", torch.nan), ValueError),
        r"of the entries \['action'\], given \['observation'\], under.* is NaN or infinite in 1",
    ),
    "rewards of several steps": (
        lambda b: MultiStep(gamma=1.0, n_steps=2)(b),
        *(ValueError, r"\('next', 'reward'\) are sums over up to 2 steps.*Leave MultiStep"),
    ),
    "log-prob with a trailing dimension": (
        *(_set("action_log_prob", lambda x: x.unsqueeze(-1)), ValueError),
        r"'action_log_prob'.*\(2, 3, 4\).*got \(2, 3, 4, 1\).*trailing dimension",
    ),
}


@pytest.mark.parametrize("name", BAD_BATCHES)
def test_bad_batch(name):
    """Each mistake is named, with what was expected, what came, and how to mend it."""
    spoil, error, message = BAD_BATCHES[name]
    actor = make_actor()
    batch = spoil(sample(actor, 2, 3, 4))
    with pytest.raises(error, match=message):
        ECPO.build(actor)(batch)


@pytest.mark.parametrize(
    ("kind", "action", "expected"),
    [
        ("one_hot", torch.zeros(2, 3, 4, dtype=torch.int64), "6, 4, 4"),
        ("one_hot", torch.zeros(2, 3, 4, 1), "6, 4, 4"),
        ("normal", torch.zeros(2, 3, 4, 1), "6, 4, 2"),
        ("normal", torch.zeros(2, 3, 4, 3), "6, 4, 2"),
    ],
)
def test_action_of_another_shape(kind, action, expected):
    """It might broadcast to what the distribution takes."""
    loss, _, batch = problem(ECPO, kind, padded=False)
    with pytest.raises(ValueError, match=rf"'action' must have the shape \({expected}\) of what a"):
        loss(batch.set("action", action))


@pytest.mark.parametrize("masked", [False, True])
def test_one_step_problems_without_a_time_axis(masked):
    """[G, K] of steps that are ends all: groups of K, not one group of G."""
    loss, _, batch = problem(ECPO, padded=False)
    batch = batch[..., 0].clone()
    batch["next", "done"] = torch.ones(2, 3, 1, dtype=torch.bool)
    if masked:
        batch[MASK] = torch.tensor([[True, True, True], [True, False, True]])
    loss.reduction = "none"
    out = loss(batch)
    assert out.shape == (2,)
    assert_close(out, loss(batch.unsqueeze(-1)))
    assert_close(out, loss(batch.select(*loss.in_keys, strict=False)))
    given = {key if isinstance(key, str) else "_".join(key): batch.get(key) for key in loss.in_keys}
    by_keywords = loss(**{name: value for name, value in given.items() if value is not None})
    assert_close(by_keywords[0], out["loss_actor"])
    shallow = TensorDict(batch.to_dict()).set("epoch", torch.tensor(3))
    assert_close(loss(shallow)["loss_actor"], out["loss_actor"])


def test_one_group_of_one_step_problems():
    loss, _, batch = problem(ECPO, padded=False)
    batch = batch[:1, :, 0].clone()
    batch["next", "done"] = torch.ones(1, 3, 1, dtype=torch.bool)
    assert_close(loss(batch), loss(batch.unsqueeze(-1)))


def test_actor_with_a_log_prob_of_trailing_dimension():
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
        ECPO.build(actor)(batch)


@pytest.mark.parametrize(
    ("kind", "action", "message"),
    [
        ("categorical", ["action", "is_init"], r"\['action', 'is_init'\].*Categorical.*set_keys"),
        ("part_by_part", "move", r"draws the parts.*'move', 'write'.*set_keys"),
    ],
)
def test_action_keys_are_those_of_the_distributions(kind, action, message):
    """Parts too many, or too few, would be left out."""
    loss, _, batch = problem(ECPO, kind)
    loss.set_keys(action=action)
    with pytest.raises(ValueError, match=message):
        loss(batch)


def test_bad_arguments():
    """Refused at the door, not at the first call."""
    for reduction in ("bogus", "MEAN", "", 0):
        with pytest.raises(ValueError, match=r"reduction must be one of.*none.*mean.*sum.*got"):
            ECPO.build(make_actor(), reduction=reduction)
    with pytest.raises(TypeError, match=r"get_dist.*ProbabilisticActor.*got Linear"):
        ECPO.build(torch.nn.Linear(3, 4))


TEMPERATURES = [(name, key) for name, case in CASES.items() for key in case.temperatures]
NEGATIVE = [(*entry, -0.1, "must be a finite number >= 0, got -0.1") for entry in TEMPERATURES]


@pytest.mark.parametrize(
    ("name", "temperature", "value", "message"),
    [
        *NEGATIVE,
        ("ecpo", "tau", float("nan"), "must be a finite number >= 0, got nan"),
        ("ecpo", "tau", float("inf"), "must be a finite number >= 0, got inf"),
        ("ecpo", "tau", torch.tensor(-1.0), "must be a finite number >= 0, got -1.0"),
        ("ecpo", "tau", "warm", "must be a number, got 'warm'"),
        ("ecpo", "tau", None, "must be a number, got None"),
        ("ecpo", "tau", torch.ones(2), "must be a number, got tensor"),
    ],
)
def test_bad_temperature(name, temperature, value, message):
    """Refused by the constructor and by a schedule, which leaves the old value."""
    case = CASES[name]
    with pytest.raises(ValueError, match=rf"{temperature} {message}"):
        case.loss(make_actor(), **{temperature: value})
    loss = case.build(make_actor())
    with pytest.raises(ValueError, match=rf"{temperature} {message}"):
        setattr(loss, temperature, value)
    assert getattr(loss, temperature).item() == case.temperatures[temperature]
    setattr(loss, temperature, torch.tensor(0.25))
    assert dict(loss.named_buffers())[temperature].item() == 0.25


@pytest.mark.parametrize("temperature", ["tau", "tau_prime"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_bad_temperature_written_or_loaded(temperature, value):
    """In place it is seen at the next call; of a state dict nothing is loaded."""
    loss, _, batch = problem(ECPO)
    state = {**loss.state_dict(), temperature: torch.tensor(value)}
    message = rf"{temperature} must be a finite number >= 0, got"
    before = getattr(loss, temperature).item()
    with pytest.raises(ValueError, match=message):
        torch.nn.ModuleList([loss]).load_state_dict({f"0.{k}": v for k, v in state.items()})
    assert getattr(loss, temperature).item() == before
    getattr(loss, temperature).fill_(value)
    with pytest.raises(ValueError, match=message):
        loss(batch)


@losses
def test_temperatures_of_zero(case):
    """All 0 are refused by the constructor and by the schedule's last step; one of two may be 0.

    tau' = 0 is the paper's ablation, tau = 0 UREX's weights, and MENT's tau = 0 REINFORCE; GRPO's
    coefficient of the penalty is none.
    """
    loss, _, batch = problem(case)
    *others, last = case.temperatures
    for other in others:
        setattr(loss, other, 0.0)
        assert loss(batch)["loss_actor"].isfinite()
    if case in (CASES["ment"], CASES["rloo"], CASES["grpo"]):
        setattr(loss, last, 0)
        assert loss(batch)["loss_actor"].isfinite()
        return
    message = re.escape(" + ".join(case.temperatures)) + " must be positive"
    with pytest.raises(ValueError, match=message):
        case.loss(make_actor(), **dict.fromkeys(case.temperatures, 0.0))
    with pytest.raises(ValueError, match=message):
        setattr(loss, last, 0.0)
    assert getattr(loss, last).item() == case.temperatures[last]


def test_theorem_1_schedules_the_mode_seeking_loss_too():
    """Whose tau is 0 at the first lift, while its tau' was 0 before."""
    loss = CASES["pmd"].loss(make_actor())
    temperatures = TemperatureScheduler(loss, **theorem1_schedules(10_000))
    assert loss.tau.item() == 0
    assert loss.tau_prime.item() > 0
    temperatures.step()
    assert loss.tau.item() > 0
