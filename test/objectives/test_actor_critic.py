"""What the actor-critic losses share: the numbers, TorchRL's contract, temperatures, bad input."""

from __future__ import annotations

import inspect
import math
import pickle
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any
from unittest import mock

import pytest
import torch
from actor_critic_problems import (
    ACTION,
    CASES,
    CHOICES,
    GAMMA,
    LEARNED,
    become,
    call,
    call_by_keywords,
    expected_outputs,
    gradients,
    make_batch,
    make_networks,
    make_qvalue,
    out_keys,
    total,
)
from tensordict import TensorDict, TensorDictParams, lazy_stack
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
    TensorDictModuleWrapper,
    TensorDictSequential,
)
from torch import nn
from torch.distributions import Bernoulli, Categorical, Normal
from torch.testing import assert_close
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import ExplorationType, MultiStepTransform, set_exploration_type
from torchrl.envs.utils import exploration_type
from torchrl.modules import (
    MLP,
    LSTMModule,
    MaskedCategorical,
    MaskedOneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator
from trajectory_problems import MASK, OBSERVATION, make_actor

from torchrl_ecpo import (
    ActorCriticLoss,
    DiscreteECACLoss,
    DiscretePMDACLoss,
    ECACLoss,
    PolyakAverage,
    TemperatureScheduler,
)
from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
from torchrl_ecpo.schedules import linear

every_loss = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
# What stands once in the base is asked of CASE; where it tells kinds of actions or a value network
# apart, of one loss that samples without such a network, and of one that sums with it.
CASE = CASES["ecac"]
BASE = {"ecac": CASE, "discrete_pmd_ac": replace(CASES["discrete_pmd_ac"], value=True)}
losses = pytest.mark.parametrize("case", BASE.values(), ids=BASE)
fixed_and_learned = pytest.mark.parametrize("learned", [{}, LEARNED], ids=["fixed", "learned"])
WEIGHTS = torch.linspace(0.5, 2.0, 6).double()


def _batch(case=CASE, *shape, **options):
    return make_batch(case.kind, *shape, **options)


def _trained(case=CASE, *, dtype=torch.float64, **options):
    """A loss whose networks have moved away from the delayed ones, and both sets of networks."""
    old = make_networks(case.kind, seed=1, dtype=dtype)
    new = make_networks(case.kind, seed=2, dtype=dtype)
    loss = case.build(deepcopy(old), **options)
    become(loss, new)
    return loss, new, old


# ------------------------------------------------------------------------------------- the numbers


@every_loss
@pytest.mark.parametrize(
    ("value", "delay", "num_next_action_samples", "dtype"),
    [
        (False, False, 3, torch.float64),
        (False, True, 1, torch.float32),
        (True, True, 3, torch.float64),
    ],
)
def test_all_outputs_are_the_formulas(case, value, delay, num_next_action_samples, dtype):
    """Losses and metrics of each state, and their gradients, in plain numbers, seed for seed."""
    options = {"num_action_samples": 8, "num_next_action_samples": num_next_action_samples}
    projection = {"projection": "paper"} if case.loss is ECACLoss else {}
    loss, new, old = _trained(
        case,
        dtype=dtype,
        value=value,
        reduction="none",
        delay_actor=delay,
        **({} if case.is_discrete else options | projection),
    )
    batch = _batch(case, dtype=dtype)
    actual = call(loss, batch)
    assert list(actual.keys()) == out_keys(case, value=value) == loss.out_keys
    torch.manual_seed(0)
    expected = expected_outputs(case, new, old, batch, value=value, delay_actor=delay, **options)
    assert_close(batch["td_error"], expected.pop("td_error"))
    assert set(actual.keys()) == set(expected)
    tolerance = {"rtol": 1e-4, "atol": 1e-5} if dtype == torch.float32 else {}
    for name, expected_value in expected.items():
        assert actual[name].shape == batch.shape, name
        assert_close(actual[name].detach(), expected_value.detach(), **tolerance, msg=name)
    networks = {"loss_actor": new.actor, "loss_qvalue": new.qvalues[0], "loss_value": new.value}
    for name in loss.out_keys:
        assert actual[name].requires_grad is name.startswith("loss_"), name
        if name not in networks:
            continue
        by_formula = torch.autograd.grad(expected[name].sum(), list(networks[name].parameters()))
        trained = [
            gradient[0] if "qvalue" in key else gradient
            for key, gradient in gradients(loss, actual[name].sum()).items()
            if key.startswith(name.removeprefix("loss_"))
        ]
        assert_close(trained, list(by_formula), **tolerance, msg=name)


@pytest.mark.parametrize("loss_function", ["l2", "l1", "smooth_l1"])
def test_loss_function(loss_function):
    """Of Q and of V alike."""
    loss, *_ = _trained(value=True, reduction="none", loss_function=loss_function)
    squared, *_ = _trained(value=True, reduction="none")
    actual, squares = call(loss, _batch()), call(squared, _batch())
    error = squares["loss_value"].sqrt()
    expected = {
        "l2": error**2,
        "l1": error,
        "smooth_l1": torch.where(error < 1, error**2 / 2, error - 0.5),
    }[loss_function]
    assert_close(actual["loss_value"], expected)
    assert actual["loss_qvalue"].isfinite().all()
    assert torch.allclose(actual["loss_qvalue"], squares["loss_qvalue"]) is (loss_function == "l2")


@losses
@pytest.mark.parametrize("weights", [None, WEIGHTS], ids=["plain", "weighted"])
def test_reductions(case, weights):
    """One number a state, their mean, their sum, by the weights of replay; metrics are means."""

    def outputs(reduction, **options):
        batch = _batch(case)
        if weights is not None:
            batch["priority_weight"] = weights
        return call(case.build(reduction=reduction, **LEARNED, **options), batch)

    each = call(case.build(reduction="none", **LEARNED), _batch(case))
    assert_close(outputs("none", use_prioritized_weights=False), each)
    share = torch.ones(6).double() if weights is None else weights
    actual = {kind: outputs(kind) for kind in ("none", "mean", "sum")}
    for name, values in each.items():
        expected = {"none": values, "mean": values.mean(), "sum": values.mean()}
        if name.startswith("loss_"):
            weighted = share * values
            mean = weighted.sum() / share.sum()
            expected = {"none": weighted, "mean": mean, "sum": weighted.sum()}
        for kind, value in expected.items():
            assert_close(actual[kind][name], value, msg=f"{kind} of {name}")
    assert_close(outputs(None), actual["mean"])


@losses
@pytest.mark.parametrize(
    ("shape", "batch_size"),
    [((2, 3), (2, 3)), ((3, 1, 2), (3, 1, 2)), ((2, 3), ()), ((2, 3), (2,))],
    ids=str,
)
def test_batches_of_any_shape(case, shape, batch_size):
    """``[*B]`` is a matter of arrangement; the entries say it, where batch_size does not."""
    flat = _batch(case)
    shaped = TensorDict(flat.reshape(shape).to_dict(), batch_size=batch_size)
    expected = call(case.build(reduction="none", **LEARNED), flat)
    actual = call(case.build(reduction="none", **LEARNED), shaped)
    assert actual.shape == shape
    assert_close(actual.reshape(-1), expected)
    assert_close(shaped["td_error"], flat["td_error"].reshape(shape))
    assert_close(call(case.build(**LEARNED), shaped), call(case.build(**LEARNED), flat))


def test_entries_that_are_not_read_may_be_of_any_shape():
    flat = _batch()
    loose = TensorDict({**flat.to_dict(), "extra": torch.zeros(7)}, batch_size=[])
    assert_close(call(CASE.build(), loose), call(CASE.build(), flat))


def test_a_locked_batch_has_room_for_priorities():
    batch = _batch()
    expected = batch.clone()
    call(CASE.build(), expected)
    locked = batch.clone().set("td_error", torch.zeros(*batch.shape, 1, dtype=torch.double)).lock_()
    call(CASE.build(), locked)
    assert_close(locked["td_error"].squeeze(-1), expected["td_error"])
    small = batch.clone().set("td_error", torch.zeros(*batch.shape, 2, dtype=torch.double)).lock_()
    with pytest.raises(ValueError, match=r"room for .* priorities 'td_error'.*unlock"):
        call(CASE.build(), small)


def test_single_numbers_may_be_observations_and_actions():
    """TensorDict takes the last axis of a call without a tensordict for one of the batch then."""
    networks = make_networks()
    networks.actor[0].module[0] = nn.Linear(1, 2).double()  # type: ignore
    qvalue = MLP(in_features=2, out_features=1, num_cells=[5]).double()
    networks.qvalues = ValueOperator(qvalue, ["observation", "action"])  # type: ignore
    loss, batch = CASE.build(networks), _batch()
    for entries, name in (
        (batch, "observation"),
        (batch, "action"),
        (batch["next"], "observation"),
    ):
        entries[name] = entries[name][:, :1]
    expected = call(loss, batch)
    assert_close(call_by_keywords(loss, batch), tuple(expected[name] for name in loss.out_keys))


# ------------------------------------------------------------------------------------ the gradients

REACHES = {
    "loss_actor": "actor_network_params",
    "loss_qvalue": "qvalue_network_params",
    "loss_value": "value_network_params",
    "loss_tau": "log_tau",
    "loss_tau_prime": "log_tau_prime",
}


@losses
@pytest.mark.parametrize("delay", [False, True], ids=["live", "delayed"])
def test_each_loss_reaches_its_own_parameters_only(case, delay):
    """All of them, and none of another network's; nothing delayed; one backward pass serves all."""
    loss, *_ = _trained(case, delay_actor=delay, **LEARNED)
    # At the bound itself a learned temperature has no reason to move.
    outputs = call(loss, _batch(case))
    names = [name for name in loss.out_keys if name in REACHES]
    assert names == [name for name in REACHES if case.value or name != "loss_value"]
    parts = {name: gradients(loss, outputs[name]) for name in names}
    for loss_name, part in parts.items():
        prefix = REACHES[loss_name]
        for name, gradient in part.items():
            is_own = name == prefix or name.startswith(f"{prefix}.")
            assert (gradient.abs().max() > 0) == is_own, (loss_name, name)
    for name, gradient in gradients(loss, total(outputs)).items():
        assert "target" not in name
        assert gradient.norm() > 0, name
        assert_close(gradient, sum(part[name] for part in parts.values()), msg=name)
    tensors = [*loss.parameters(), *loss.buffers()]
    assert len({id(tensor) for tensor in tensors}) == len(tensors)
    assert not any(buffer.requires_grad for buffer in loss.buffers())


# ------------------------------------------------------------------------------- delays, updaters


@pytest.mark.parametrize(
    ("value", "delay_actor", "delay_qvalue"),
    [
        (False, False, None),
        (False, True, False),
        (False, False, True),
        (True, True, None),
        (True, False, False),
    ],
)
def test_delay_flags(value, delay_actor, delay_qvalue):
    """With a flag the target stays where it was, without it the target is the live network."""
    loss, *_ = _trained(value=value, delay_actor=delay_actor, delay_qvalue=delay_qvalue)
    is_delayed = {
        "actor_network": delay_actor,
        "qvalue_network": not value if delay_qvalue is None else delay_qvalue,
        **({"value_network": True} if value else {}),
    }
    for name, delayed in is_delayed.items():
        source = getattr(loss, f"{name}_params").data
        target = getattr(loss, f"target_{name}_params").data
        equal = all(torch.equal(x, target.get(key)) for key, x in source.items(True, True))
        assert equal is not delayed, name
        assert (f"target_{name}_params" in dict(loss.named_children())) is delayed, name
    assert (loss.delay_actor, loss.delay_qvalue) == tuple(is_delayed.values())[:2]
    assert call(loss, _batch())["loss_qvalue"].isfinite()


# -------------------------------------------------------------------------------------- the module


@fixed_and_learned
def test_state_dict_round_trip(learned):
    """Strict, into a loss built alike, also after a forward: delayed networks, temperatures."""
    batch = _batch()
    loss, *_ = _trained(value=True, delay_actor=True, **learned)
    entries = list(loss.state_dict())
    if not learned:
        loss.tau, loss.tau_prime = 0.3, 0.2
    expected = call(loss, batch)
    assert loss.in_keys
    assert loss.out_keys
    assert list(loss.state_dict()) == entries
    for called in (False, True):
        fresh = CASE.build(value=True, delay_actor=True, **learned)
        if called:
            assert not torch.allclose(call(fresh, batch)["loss_actor"], expected["loss_actor"])
        fresh.load_state_dict(loss.state_dict(), strict=True)
        assert_close(call(fresh, batch), expected)


@fixed_and_learned
def test_to_dtype(learned):
    """Parameters, targets and temperatures follow, and keep their kind; the numbers hardly move."""
    loss, *_ = _trained(value=True, **learned)
    batch = _batch()
    outputs = call(loss, batch)
    cast = loss.to(torch.float32)
    assert {t.dtype for t in [*cast.parameters(), *cast.buffers()]} == {torch.float32}
    in_single = batch.apply(lambda x: x.float() if x.is_floating_point() else x)
    assert {v.dtype for v in loss(in_single).values()} == {torch.float32}
    double = cast.double()
    assert {t.dtype for t in [*double.parameters(), *double.buffers()]} == {torch.float64}
    assert isinstance(double.qvalue_network_params, TensorDictParams)
    assert all(isinstance(p, nn.Parameter) for p in double.parameters())
    assert_close(call(double, batch), outputs, rtol=1e-4, atol=1e-5)


@fixed_and_learned
def test_device_is_that_of_the_networks(learned):
    """Also of temperatures and of the discount, before any call of ``to``."""
    networks = make_networks()
    for network in (networks.actor, *networks.qvalues, networks.value):
        network.to("meta")
    options = {"target_kl": None, "target_entropy": None, **learned}
    loss = ECACLoss(networks.actor, networks.qvalues, networks.value, **options)
    assert {t.device.type for t in [*loss.parameters(), *loss.buffers()]} == {"meta"}


def test_exploration_type():
    """Random where the policy is asked; outside what it was before, also after an error."""
    networks, modes = make_networks(), []
    networks.actor[0].module.register_forward_hook(lambda *_: modes.append(exploration_type()))
    loss = CASE.build(networks)
    with set_exploration_type(ExplorationType.MODE):
        call(loss, _batch())
        with pytest.raises(KeyError):
            loss(_batch().exclude("action"))
        assert exploration_type() is ExplorationType.MODE
    assert set(modes) == {ExplorationType.RANDOM}


@every_loss
def test_constructor(case):
    """Networks by position, everything else by keyword; what the class says is what it has."""
    _, *parameters = inspect.signature(case.loss.__init__).parameters.values()
    names = [p.name for p in parameters]
    assert names[:3] == ["actor_network", "qvalue_network", "value_network"]
    assert {*inspect.signature(ActorCriticLoss.__init__).parameters} <= {"self", *names}
    assert all(p.kind is p.KEYWORD_ONLY for p in parameters[3:])
    doc = inspect.getdoc(ECACLoss) or ""
    assert [n for n in names if f"{n}:" not in doc + (inspect.getdoc(case.loss) or "")] == []
    assert issubclass(case.loss, LossModule)
    projection = () if issubclass(case.loss, ECACLoss) else ("projection",)
    for name in ("gamma", "lmbda", "action_key", "alpha_init", *projection):
        with pytest.raises(TypeError, match=name):
            case.build(**{name: 0.9})


@every_loss
def test_an_error_leaves_the_networks_as_they_were(case):
    """tensordict's ``to_module`` would leave delayed parameters in them, which nobody trains."""
    networks = make_networks(case.kind)
    loss = case.build(networks, value=True)
    modules = [networks.actor, networks.value]
    before = [[*map(id, module.parameters())] for module in modules]
    held = dict(loss.qvalue_network.named_parameters())
    batch = make_batch(case.kind)
    for key in ("observation", ("next", "observation")):
        with pytest.raises((ValueError, RuntimeError)):
            call(loss, batch.clone().set(key, batch[key][..., :1]))
    assert [[*map(id, module.parameters())] for module in modules] == before
    assert dict(loss.qvalue_network.named_parameters()).keys() == held.keys()
    deepcopy(loss)


def test_an_interrupt_comes_through(monkeypatch):
    """As it is, and not as an error of the data; the networks are the loss's again."""
    loss, batch = CASE.build(), _batch()
    network, stop = loss.actor_network, KeyboardInterrupt()
    before = [*map(id, network.parameters())]
    monkeypatch.setattr(network, "get_dist", mock.Mock(side_effect=stop))
    with pytest.raises(KeyboardInterrupt) as raised:
        loss(batch)
    assert raised.value is stop
    assert [*map(id, network.parameters())] == before


DEFAULTS = {
    "reduction": "mean",
    "loss_function": "l2",
    "num_qvalue_nets": 2,
    "use_prioritized_weights": "auto",
}
OWN_DEFAULTS = {  # tau, tau_prime, then OWN
    "ecac": (0.3, 1.0, 0.083, "auto", 8, 1, False, 1e-3, 3e-3),
    "pmd_ac": (0.1, 1.0, None, "auto", 1, 1, True, 1e-3, 3e-3),
    "mpo": (1.0, 0.0, None, None, 20, 20, True, 1e-3, 3e-3),
    "discrete_ecac": (0.3, 0.1, 0.1, None, 8, 1, False, 1e-5, 1e-5),
    "discrete_pmd_ac": (0.1, 0.1, None, None, 1, 1, True, 1e-3, 3e-3),
}
OWN = ("target_kl", "target_entropy", "num_action_samples", "num_next_action_samples")
OWN = (*OWN, "delay_actor", "min_tau", "min_tau_prime")


@pytest.mark.parametrize("name", CASES)
def test_defaults(name):
    """As documented; without any option a loss works."""
    case, networks = CASES[name], make_networks(CASES[name].kind)
    loss = case.loss(networks.actor, make_qvalue(case.kind).double())
    tau, tau_prime, *own = OWN_DEFAULTS[name]
    expected = DEFAULTS | dict(zip(OWN, own, strict=True))
    assert {name: getattr(loss, name) for name in expected} == expected
    if case.loss is ECACLoss:
        assert loss.projection == "centred"
    assert loss.value_estimator.gamma == pytest.approx(0.99)
    PolyakAverage(loss)
    outputs = call(loss, _batch(case))
    assert (outputs["tau"].item(), outputs["tau_prime"].item()) == pytest.approx((tau, tau_prime))
    total(outputs).backward()


# -------------------------------------------------------------------------------------------- keys

KEYS = {
    "action": ("action",),
    "reward": ("next", "reward"),
    "done": ("next", "done"),
    "terminated": ("next", "terminated"),
    "priority_weight": ("priority_weight",),
    "priority": ("td_error",),
}
RENAMED = {
    "flat": lambda field: f"the_{field}",
    "nested": lambda field: ("agents", f"the_{field}"),
}


def _renamed_networks(case, keys):
    """Networks that read and write other names."""
    networks = make_networks(case.kind)
    networks.actor = ProbabilisticActor(
        networks.actor[0],  # type: ignore
        in_keys=["logits"] if case.is_discrete else ["loc", "scale"],
        out_keys=[keys["action"]],
        distribution_class=networks.actor[-1].distribution_class,  # type: ignore
    )
    reads = ["observation", *([] if case.is_discrete else [keys["action"]])]
    writes = [keys["action_value" if case.is_discrete else "state_action_value"]]
    networks.qvalues = [TensorDictModule(q.module, reads, writes) for q in networks.qvalues]
    networks.value = TensorDictModule(networks.value.module, ["observation"], [keys["value"]])
    return networks


@losses
def test_default_keys(case):
    """As documented, in this order: with sets it would depend on the seed of the hashes."""
    loss = case.build()
    assert vars(loss.tensor_keys) == {
        "action": "action",
        "reward": "reward",
        "done": "done",
        "terminated": "terminated",
        "value": "state_value",
        "state_action_value": "state_action_value",
        "action_value": "action_value",
        "priority": "td_error",
        "priority_weight": "priority_weight",
    }
    following = ["reward", "done", "terminated", "observation"]
    assert loss.in_keys == ["action", "observation", *(("next", key) for key in following)]
    assert loss.out_keys == out_keys(case, value=case.value)
    learned = case.build(**LEARNED)
    assert learned.out_keys == out_keys(case, value=case.value, learned=True)


@losses
@pytest.mark.parametrize("names", RENAMED)
def test_set_keys(case, names):
    """Every field, where all have other names; None restores the defaults."""
    batch = _batch(case)
    reference = case.build()
    unweighted = call(reference, batch)
    batch["priority_weight"] = WEIGHTS
    expected = call(reference, batch)
    keys = {field: RENAMED[names](field) for field in vars(reference.tensor_keys)}
    renamed = batch.exclude(*KEYS.values())
    places = {}
    for field, place in KEYS.items():
        key = keys[field]
        places[field] = (*place[:-1], *((key,) if isinstance(key, str) else key))
        if field != "priority":
            renamed[places[field]] = batch[place]
    loss = case.build(_renamed_networks(case, keys))
    assert loss.in_keys
    assert loss.set_keys(**keys) is None
    assert vars(loss.tensor_keys) == keys
    assert_close(call(loss, renamed), expected)
    assert_close(renamed[places["priority"]], batch["td_error"])
    # The weights are none of the keywords.
    values = call_by_keywords(loss, renamed)
    assert_close(values, tuple(unweighted[name] for name in loss.out_keys))
    loss.set_keys(**dict.fromkeys(keys))
    assert vars(loss.tensor_keys) == vars(reference.tensor_keys)
    estimator = loss.value_estimator.tensor_keys
    assert (estimator.value, estimator.reward) == ("state_value", "reward")


def test_critics_may_read_what_the_actor_does_not():
    """Their observations of the next state are among the keywords too."""
    networks = make_networks()
    network = MLP(in_features=2 * OBSERVATION + ACTION, out_features=1, num_cells=[5]).double()
    networks.qvalues = ValueOperator(network, ["observation", "secret", "action"])  # type: ignore
    loss, batch = CASE.build(networks), _batch()
    batch["secret"] = torch.randn(6, OBSERVATION).double()
    batch["next", "secret"] = torch.randn(6, OBSERVATION).double()
    expected = call(loss, batch)
    assert_close(call_by_keywords(loss, batch)[1], expected["loss_qvalue"])


@losses
def test_input_is_untouched_but_for_the_priority(case):
    """Which is detached, finite, at least 0, of the shape of the batch."""
    batch = _batch(case, 2, 3)
    batch["next", "state_value"] = torch.full((2, 3, 1), 7.0).double()
    batch["loc"] = torch.full((2, 3, ACTION), 7.0).double()
    before = batch.clone()
    call(case.build(), batch)
    priority = batch.pop("td_error")
    assert set(batch.keys(True)) == set(before.keys(True))
    assert_close(batch, before, rtol=0, atol=0)
    assert priority.shape == batch.shape
    assert not priority.requires_grad
    assert priority.isfinite().all()
    assert (priority > 0).all()


@pytest.mark.parametrize("lock", ["lock_", "memmap_", "share_memory_"])
def test_locked_batches(lock):
    """Where nothing can be added, the priority goes into the entry that is there."""
    batch = _batch()
    expected = call(CASE.build(), batch)
    priority = batch.pop("td_error")
    assert_close(call(CASE.build(), getattr(batch.clone(), lock)()), expected)
    locked = getattr(batch.clone().set("td_error", torch.zeros_like(priority)), lock)()
    assert_close(call(CASE.build(), locked), expected)
    assert_close(locked["td_error"], priority)


# ----------------------------------------------------------------------------------------- copies


@losses
def test_pickle_and_deepcopy(case):
    """The copy gives the same numbers, and shares nothing with the original."""
    loss = case.build(**LEARNED)
    batch = _batch(case)
    expected = call(loss, batch)
    for copy in (deepcopy(loss), pickle.loads(pickle.dumps(loss))):
        assert_close(call(copy, batch), expected)
        own = {id(module) for module in loss.modules()}
        assert not own & {id(module) for module in copy.modules()}
        with torch.no_grad():
            for parameter in copy.parameters():
                parameter.fill_(0.1)
        assert not torch.equal(call(copy, batch)["loss_qvalue"], expected["loss_qvalue"])
        assert_close(call(loss, batch), expected)


def test_a_copy_of_a_compiled_loss_trains_itself():
    """It is not compiled: what was compiled has the original's parameters."""
    loss = CASE.build()
    loss.compile(backend="eager")
    copy = deepcopy(loss)
    call(copy, _batch())["loss_qvalue"].backward()
    assert all(parameter.grad is None for parameter in loss.parameters())
    assert any(parameter.grad is not None for parameter in copy.parameters())
    pickle.dumps(loss)


def _taken(loss, batch):
    """Soft Q ``[N, *B]`` of the actions of a batch."""
    return loss._qvalues(batch.select(*loss.qvalue_network.in_keys), loss.qvalue_network_params)


def test_dropout_of_a_copy_is_its_own():
    """A copy calls its own Q network, not the original's."""
    networks = make_networks()
    size = OBSERVATION + ACTION
    network = MLP(in_features=size, out_features=1, num_cells=[8], dropout=0.5).double()
    networks.qvalues = ValueOperator(network, ["observation", "action"])  # type: ignore
    copy = deepcopy(CASE.build(networks))
    assert not torch.equal(*(_taken(copy, _batch()) for _ in range(2)))
    copy.qvalue_network.eval()
    assert torch.equal(*(_taken(copy, _batch()) for _ in range(2)))


def test_recurrent_q_network():
    """Of sampled actions it gives what it gives of those that were taken: rows stay rows."""
    size = OBSERVATION + ACTION
    memory = LSTMModule(input_size=size, hidden_size=4, in_key="both", out_key="memory")
    networks = make_networks()
    networks.qvalues = TensorDictSequential(
        TensorDictModule(lambda *x: torch.cat(x, -1), ["observation", "action"], ["both"]),
        memory,
        TensorDictModule(nn.Linear(4, 1), ["memory"], ["state_action_value"]),
    ).double()
    loss = CASE.build(networks, delay_qvalue=False)
    batch = _batch(CASE, 3, 5)
    states = torch.randn(2, 3, 5, 1, 4, generator=torch.Generator().manual_seed(0)).double()
    batch["recurrent_state_h"], batch["recurrent_state_c"] = states
    batch["is_init"] = torch.zeros(3, 5, 1, dtype=torch.bool)
    with set_recurrent_mode(True):
        chosen = _taken(loss, batch).amin(0)
        sampled = loss.states(batch).lift.actions._replace(
            action=batch["action"].expand(4, 3, 5, 2)
        )
        of_samples = loss.score_of(batch, sampled, loss.qvalue_network_params)
    assert_close(of_samples, chosen.expand(4, 3, 5))


def test_samples_are_more_rows():
    """A Q network that knows what it reads, [rows, steps, n], is given no other axis."""
    shapes = []

    def over_time(observation, action):
        shapes.append(observation.shape)
        return convolution(torch.cat([observation, action], -1).mT).mT

    convolution = nn.Conv1d(OBSERVATION + ACTION, 1, 1).double()
    networks = make_networks()
    network = TensorDictModule(over_time, ["observation", "action"], ["state_action_value"])
    network.convolution = convolution  # its parameters are the network's
    networks.qvalues = network  # type: ignore
    loss = CASE.build(networks, delay_qvalue=False, num_action_samples=4)
    call(loss, _batch(CASE, 3, 5))
    assert {*shapes} == {(3, 5, OBSERVATION), (4 * 3, 5, OBSERVATION)}


# ----------------------------------------------------------------------------- masks of actions


class _FiniteMask(MaskedCategorical):
    def __init__(self, logits, mask):
        super().__init__(logits, mask=mask, neg_inf=-1e9)


@pytest.mark.parametrize(
    ("name", "distribution", "tau"),
    [
        ("discrete_ecac", _FiniteMask, 0.0),
        ("discrete_ecac", MaskedCategorical, 0.75),
        ("discrete_ecac", MaskedOneHotCategorical, 0.0),
        ("discrete_pmd_ac", MaskedOneHotCategorical, 0.75),
        ("discrete_pmd_ac", MaskedCategorical, 0.0),
    ],
)
def test_forbidden_actions_have_no_part(name, distribution, tau):
    """All numbers and gradients are those of a problem without the forbidden action, the last."""
    case, batch, networks = CASES[name], _batch(CASES[name]), make_networks("categorical")
    for where in (batch, batch["next"]):
        where["action_mask"] = (torch.arange(CHOICES) < CHOICES - 1).expand(6, CHOICES)

    def of_the_first(number, distribution, **mask):
        def module(seed, key):
            torch.manual_seed(seed)
            linear = nn.Linear(OBSERVATION, CHOICES).double()
            linear.weight.data, linear.bias.data = (
                linear.weight.data[:number],
                linear.bias.data[:number],
            )
            return TensorDictModule(linear, ["observation"], [key])

        networks.actor = ProbabilisticActor(
            module(0, "logits"), {"logits": "logits", **mask}, distribution_class=distribution
        )
        networks.qvalues = [module(seed, "action_value") for seed in (1, 2)]
        loss = case.build(networks, tau=tau, delay_actor=False)
        action = torch.eye(CHOICES)[torch.arange(6) % (CHOICES - 1)]
        outputs = call(loss, batch.clone().set("action", action[:, :number]))
        return outputs, gradients(loss, total(outputs))

    actual, gradient = of_the_first(CHOICES, distribution, mask="action_mask")
    expected, of_fewer = of_the_first(CHOICES - 1, Categorical)
    assert_close(actual, expected)
    for key, value in of_fewer.items():
        if "actor" in key:
            assert_close(gradient[key][:-1], value)
            assert (gradient[key][-1] == 0).all()


def test_padding_forbids_no_action():
    """In a transition that is not real all actions may be taken, or the policy would be NaN."""
    loss, batch = _masked("discrete_ecac", CHOICES, delay_actor=False)
    batch[MASK] = torch.arange(6) < 5
    outputs = call(loss, batch)
    assert outputs["entropy"].isfinite()
    assert all(g.isfinite().all() for g in gradients(loss, total(outputs)).values())


# ------------------------------------------------------------------------------ masks and weights


def _shared_noise():
    """Noise that depends on the place in the batch of six alone."""
    noise = torch.randn(16, 6, ACTION, generator=torch.Generator().manual_seed(0)).double()

    def rsample(normal, sample_shape=()):
        batch = normal.loc.shape[0]
        return normal.loc + normal.scale * noise[: sample_shape[0]].repeat(1, 2, 1)[:, :batch]

    return mock.patch.object(torch.distributions.Normal, "rsample", rsample)


@losses
@pytest.mark.parametrize("weighted", [False, True], ids=["[*B]", "[*B, 1], weighted"])
def test_masked_transitions_count_nothing(case, weighted):
    """Whatever stands in them: values, gradients and metrics are those of the others."""
    loss = case.build(**LEARNED)
    real = _batch(case)
    if weighted:
        real["priority_weight"] = WEIGHTS
    spoilt = torch.cat([real, real.clone()])
    for key in spoilt.keys(True, True):
        if spoilt[key].is_floating_point():
            spoilt[key][6:] = math.nan
            spoilt[key][8:] = math.inf
    mask = torch.arange(12) < 6
    spoilt[MASK] = mask.unsqueeze(-1) if weighted else mask
    with _shared_noise():
        expected, actual = loss(real), loss(spoilt)
        outputs = case.build(**LEARNED, reduction="none")(spoilt)
    assert_close(actual, expected)
    assert_close(gradients(loss, total(actual)), gradients(loss, total(expected)))
    assert_close(spoilt["td_error"][:6], real["td_error"])
    assert (spoilt["td_error"][6:] == 0).all()

    assert outputs.shape == (12,)
    for name, output in outputs.items():
        assert output.isfinite().all(), name
        if name in REACHES:
            assert (output[6:] == 0).all(), name
            mean = output[:6].sum() / (WEIGHTS.sum() if weighted else 6)
            assert_close(mean, expected[name], msg=name)

    spoilt[MASK] = torch.zeros(12, dtype=torch.bool)
    nothing = loss(spoilt)
    assert total(nothing) == 0
    assert all((g == 0).all() for g in gradients(loss, total(nothing)).values())


# ------------------------------------------------------------------------------ value estimation


def _fixed_next_value(loss, values):
    """Make the value of the next state known."""
    loss._next_state_value = lambda *_: values
    return loss


def _td_lambda(rewards, values, done, terminated, lmbda):
    """The lambda-return by its recursion, one trajectory ``[T]``."""
    returns = torch.zeros_like(rewards)
    following = values[-1]
    for t in reversed(range(len(rewards))):
        value = values[t] * ~terminated[t]
        bootstrap = value if done[t] or t == len(rewards) - 1 else None
        mixed = value if bootstrap is not None else (1 - lmbda) * value + lmbda * following
        returns[t] = following = rewards[t] + GAMMA * mixed
    return returns


@pytest.mark.parametrize(
    ("estimator", "options", "lmbda"),
    [
        (ValueEstimators.TD0, {}, 0.0),
        (ValueEstimators.TD1, {}, 1.0),
        (ValueEstimators.TDLambda, {"lmbda": 0.6}, 0.6),
        ("td0", {}, 0.0),
    ],
    ids=str,
)
@pytest.mark.parametrize("lengths", [(6, 6, 6), (4, 6, 1)], ids=["whole", "padded"])
def test_value_estimators(estimator, options, lmbda, lengths):
    """Targets along trajectories ``[N, T]`` by the recursion; returns end with what is real."""
    batch = _batch(CASE, 3, 6)
    values = torch.randn(3, 6, generator=torch.Generator().manual_seed(3)).double()
    loss = _fixed_next_value(CASE.build(), values)
    assert loss.make_value_estimator(estimator, gamma=GAMMA, **options) is loss
    mask = torch.arange(6) < torch.tensor(lengths).unsqueeze(-1)
    actual = loss.double().soft_bellman_target(batch, None if mask.all() else mask)
    following = batch["next"]
    for n, length in enumerate(lengths):
        names = ("reward", "done", "terminated")
        reward, done, terminated = (following[name][n, :length, 0] for name in names)
        expected = _td_lambda(reward, values[n, :length], done, terminated, lmbda)
        assert_close(actual[n, :length], expected)


@pytest.mark.parametrize("told", ["names", "time_dim"])
@pytest.mark.parametrize("masked", [False, True])
def test_time_may_be_another_dimension(told, masked):
    """Trajectories ``[T, N]`` have the targets of ``[N, T]``, with a mask too."""
    batch = _batch(CASE, 3, 6)
    if masked:
        batch[MASK] = torch.arange(6) < torch.tensor([[4], [6], [1]])
    values = torch.randn(3, 6, generator=torch.Generator().manual_seed(3)).double()
    options: dict[str, Any] = {"gamma": GAMMA, "lmbda": 0.6}

    def targets(batch, values, **own):
        loss = _fixed_next_value(CASE.build(), values)
        loss.make_value_estimator(ValueEstimators.TDLambda, **options, **own)
        return loss.double().soft_bellman_target(*loss._read(batch))

    expected = targets(batch, values)
    turned, own = batch.transpose(0, 1).contiguous(), {"time_dim": 0}
    if told == "names":
        turned.names, own = ["time", None], {}
    assert_close(targets(turned, values.T, **own).T, expected)


def test_rewards_are_not_standardised_over_masked_ones():
    loss, batch = CASE.build(), _batch()
    batch[MASK] = torch.arange(6) < 4
    loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA, average_rewards=True)
    with pytest.raises(ValueError, match="average_rewards=True counts the rewards that a mask"):
        loss.double()(batch)


def test_value_estimators_that_are_no_use():
    """The loss has a soft value of its own, needs no more than that, and keeps what it had."""
    loss = CASE.build()
    before = loss.value_estimator
    for estimator in (ValueEstimators.GAE, ValueEstimators.VTrace, ValueEstimators.MAGAE):
        with pytest.raises(NotImplementedError, match="not implemented for loss"):
            loss.make_value_estimator(estimator)
    network = ValueOperator(nn.Linear(OBSERVATION, 1), ["observation"])
    with pytest.raises(ValueError, match="TD0Estimator must have value_network=None"):
        loss.make_value_estimator(TD0Estimator(gamma=GAMMA, value_network=network))
    for named in (TD0Estimator, ValueEstimators.TD0, "td0"):
        with pytest.raises(ValueError, match=r"(TD0Estimator|TD0|td0) must have value_network=N"):
            loss.make_value_estimator(named, gamma=GAMMA, value_network=network)
    with pytest.raises(ValueError, match=r"TD0Estimator that is made has its own \['gamma'\]"):
        loss.make_value_estimator(TD0Estimator(gamma=GAMMA, value_network=None), gamma=0.5)
    with pytest.raises(NotImplementedError, match=r"GAE is not implemented.*takes TD0Estimator"):
        loss.make_value_estimator(GAE(gamma=GAMMA, lmbda=0.9, value_network=None))
    with pytest.raises(NotImplementedError, match="GAE is not implemented"):
        loss.make_value_estimator(GAE, gamma=GAMMA, lmbda=0.9)
    assert loss.value_estimator is before


def test_value_estimator_of_the_users():
    """An instance or a class is taken as it is, and reads the keys of the loss."""
    loss, batch = CASE.build(), _batch()
    expected = call(loss, batch)
    own = TD0Estimator(gamma=GAMMA, value_network=None).double()
    assert loss.make_value_estimator(own) is loss
    assert loss.value_estimator is own
    assert_close(call(loss, batch), expected)
    loss.set_keys(reward="r")
    batch["next"].rename_key_("reward", "r")
    assert loss.make_value_estimator(TD0Estimator, gamma=GAMMA, value_network=None) is loss
    assert_close(call(loss.double(), batch), expected)


@every_loss
def test_lazy_stacks(case):
    """Of as many transitions as an observation has numbers, so that a slice would fit too."""
    batch = _batch(case)[:3]
    loss = case.build(skip_done_states=True)
    lazy = lazy_stack(list(batch.clone().unbind(0)))
    assert_close(call(loss, lazy), call(loss, batch))


def test_n_step_returns():
    """Of TorchRL's transform: the discount of the value is gamma to the number of steps."""
    transform = MultiStepTransform(n_steps=3, gamma=GAMMA)
    storage = LazyTensorStorage(10)
    buffer = TensorDictReplayBuffer(storage=storage, transform=transform, batch_size=4)
    trajectory = _batch(CASE, 8)
    for key in ("done", "terminated"):
        trajectory["next", key].zero_()
    buffer.extend(trajectory)
    stored = buffer[:].exclude("index")
    assert (stored["steps_to_next_obs"] == 3).all()
    values = torch.arange(1.0, len(stored) + 1).double()
    loss = _fixed_next_value(CASE.build(), values)
    expected = stored["next", "reward"].squeeze(-1) + GAMMA**3 * values
    # The transform discounts in float32.
    assert_close(loss.soft_bellman_target(stored), expected, rtol=1e-5, atol=1e-6)


@every_loss
def test_nothing_is_expected_after_a_terminated_state(case):
    """Whatever stands there; after a time limit the value counts."""
    loss, batch = case.build(), _batch(case)
    expected = call(loss, batch)
    batch["next", "observation"][1] = math.nan
    actual = call(loss, batch)
    assert_close(actual, expected)
    assert_close(gradients(loss, total(actual)), gradients(loss, total(expected)))
    target, reward = loss.soft_bellman_target(batch), batch["next", "reward"].squeeze(-1)
    assert target[1] == reward[1]
    assert target[2] != reward[2]


@losses
def test_skip_done_states(case):
    """Next states of time limits too are not looked at; the others are as before."""
    batch = _batch(case)
    expected = call(case.build(reduction="none"), batch)
    loss = case.build(reduction="none", skip_done_states=True)
    target = loss.soft_bellman_target(batch)
    assert_close(target[1:3], batch["next", "reward"][1:3, 0])
    batch["next", "observation"][1:3] = math.nan
    actual = call(loss, batch)
    others = [0, 1, 3, 4, 5]
    assert_close(actual["loss_qvalue"][others], expected["loss_qvalue"][others])
    assert actual["loss_qvalue"].isfinite().all()
    name = r"entry \('next', 'observation'\) is NaN or infinite"
    with pytest.raises(ValueError, match=name):
        case.build()(batch)


def test_the_lift_of_the_next_state_is_given_what_the_networks_read(monkeypatch):
    """And nothing else of what stands there."""
    loss, given = CASE.build(), []
    lift = loss.lift

    def watched(observations, *args):
        given.append([*observations.keys()])
        return lift(observations, *args)

    monkeypatch.setattr(loss, "lift", watched)
    loss.soft_bellman_target(_batch())
    assert given == [["observation"]]


def test_an_integer_after_a_terminated_state_need_not_be_a_token():
    batch = _batch(CASE)
    batch["token"] = torch.zeros(len(batch), dtype=torch.int64)
    batch["next", "token"] = torch.full((len(batch),), 3)
    batch["next", "terminated"][1] = batch["next", "done"][1] = True
    networks = make_networks()
    embedding = nn.Sequential(nn.Embedding(10, 4), nn.Linear(4, 1)).double()
    networks.value = ValueOperator(embedding, ["token"])
    loss = CASE.build(networks, value=True)
    expected = call(loss, batch)
    batch["next", "token"][1] = -1
    assert_close(call(loss, batch), expected)


def test_skipped_states_keep_their_dtype():
    """Integer observations, such as pixels or tokens, stay integers."""
    networks = make_networks()
    embedding = nn.Sequential(nn.Embedding(10, 4), nn.Linear(4, 1)).double()
    networks.value = ValueOperator(embedding, ["token"])
    batch = _batch()
    batch["token"] = batch["next", "token"] = torch.arange(6)
    loss = CASE.build(networks, value=True, skip_done_states=True)
    assert call(loss, batch)["loss_qvalue"].isfinite()


# ------------------------------------------------------------------------------- num_actor_states


@losses
@pytest.mark.parametrize("n", [1, 4, 100])
def test_num_actor_states(case, n):
    """All but the Q networks learn from the first n states; Q learns from all."""
    options = {"delay_actor": False, **LEARNED}
    batch = _batch(case)
    batch["priority_weight"] = WEIGHTS
    batch[MASK] = torch.arange(6) != 2
    with _shared_noise():
        actual = case.build(**options, num_actor_states=n)(batch)
        whole = case.build(**options)(batch)
        first = case.build(**options)(batch[:n].clone())
    assert_close(actual["loss_qvalue"], whole["loss_qvalue"])
    assert_close(actual.exclude("loss_qvalue"), first.exclude("loss_qvalue"))
    assert batch["td_error"].shape == (6,)
    with pytest.raises(ValueError, match=f"num_actor_states={n} takes the first of a batch"):
        case.build(**options, num_actor_states=n)(_batch(case)[0])


# ------------------------------------------------------------------------------------ temperatures


def test_temperatures_are_scheduled():
    """By assignment or a scheduler; the next call uses them. One may be 0 where one is learned."""
    loss, *_ = _trained(delay_actor=True)
    for name in ("tau", "tau_prime"):
        before = call(loss, _batch())["loss_actor"]
        outputs = call(loss, _batch())
        held = outputs[name].item()
        setattr(loss, name, 2)
        assert outputs[name] == held, "what was reported stays"
        outputs["loss_actor"].backward()
        outputs = call(loss, _batch())
        assert not torch.allclose(outputs["loss_actor"], before)
        assert outputs[name] == 2.0
    scheduler = TemperatureScheduler(loss, tau_prime=linear(0.5, 0.0, 10))
    for expected in (0.5, 0.25, 0.0):
        assert loss.tau_prime == expected
        scheduler.step(5)
    assert call(loss, _batch())["loss_actor"].isfinite()
    with pytest.raises(ValueError, match=r"tau \+ tau_prime must be positive, got 0"):
        loss.tau = 0.0
    loss = CASE.build(target_entropy=-1.0)
    loss.tau = 0
    assert call(loss, _batch())["tau"] == 0
    with pytest.raises(ValueError, match="tau must be a finite number"):
        loss.tau = -1.0


@pytest.mark.parametrize(
    ("name", "option", "value"),
    [("tau", "target_kl", 0.05), ("tau_prime", "target_entropy", -1.5)],
)
def test_learned_temperature(name, option, value):
    """A parameter in log-space, whose loss is the dual's; it cannot be assigned."""
    loss = CASE.build(**{option: value})
    assert dict(loss.named_parameters())[f"log_{name}"].shape == ()
    assert name not in dict(loss.named_buffers())
    outputs = call(loss, _batch())
    assert_close(outputs[name].item(), getattr(CASE, name))
    with pytest.raises(AttributeError, match=f"{name} is learned.*without {option}"):
        setattr(loss, name, 0.5)
    with pytest.raises(AttributeError, match=f"{name} is learned"):
        TemperatureScheduler(loss, **{name: linear(1.0, 0.0, 10)})
    assert_close(call(loss, _batch()), outputs)
    with torch.no_grad():
        getattr(loss, f"log_{name}").add_(math.log(2))
    assert_close(call(loss, _batch())[name].item(), 2 * getattr(CASE, name))


@losses
@pytest.mark.parametrize("reduction", ["mean", "none"])
def test_loss_of_a_learned_tau(case, reduction):
    """-log tau clip((KL - bound) / bound, -1, 1): up above the bound, down below it."""
    batch = _batch(case)
    kl = call(case.build(), batch)["kl_target_reference"].item()
    size = 1 if case.is_discrete else ACTION
    for factor, excess in ((1 / 1.25, 0.25), (2.0, -0.5), (1 / 50, 1.0)):
        loss = case.build(target_kl=factor * kl / size, reduction=reduction)
        value = call(loss, batch)["loss_tau"].mean()
        assert_close(value.item(), -math.log(case.tau) * excess)
        assert_close(gradients(loss, value)["log_tau"].item(), -excess)


@losses
def test_loss_of_a_learned_tau_prime(case):
    """-log tau' (target entropy - entropy): SAC's, up where entropy is short; its auto too."""
    entropy = call(case.build(), _batch(case))["entropy"].item()
    for excess in (0.2, -0.4):
        loss = case.build(target_entropy=entropy + excess)
        value = call(loss, _batch(case))["loss_tau_prime"]
        assert_close(value.item(), -math.log(case.tau_prime) * excess)
        assert_close(gradients(loss, value)["log_tau_prime"].item(), -excess)
    auto = 0.98 * math.log(CHOICES) if case.is_discrete else -float(ACTION)
    expected = call(case.build(target_entropy=auto), _batch(case))
    assert_close(call(case.build(target_entropy="auto"), _batch(case)), expected)


@pytest.mark.parametrize(
    ("name", "option", "far_above", "far_below"),
    [("tau", "target_kl", 1e-9, 0.3), ("tau_prime", "target_entropy", 1.38, -9.0)],
)
def test_learned_temperatures_stop_at_their_floor(name, option, far_above, far_below):
    """However far below the parameter may be: it is sent up from there, and down no further."""
    floor = 0.125
    for value in (far_above, far_below):
        loss = CASE.build(**{option: value, f"min_{name}": floor, name: 0.25})
        log = getattr(loss, f"log_{name}")
        for start, reads in ((0.25, 0.25), (0.125, 0.125), (1e-9, 0.125)):
            log.data.fill_(math.log(start))
            outputs = call(loss, _batch())
            assert_close(outputs[name].item(), reads)
            gradient = gradients(loss, outputs[f"loss_{name}"])[f"log_{name}"]
            if value == far_above:
                assert gradient < 0
            else:
                assert (gradient > 0) == (start > floor)


# --------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        (
            "ecac",
            {"projection": "bogus"},
            r"projection must be one of \('centred', 'paper', 'gradient'\), got",
        ),
        ("ecac", {"num_actor_states": 0}, "num_actor_states must be an integer of at least 1"),
        ("ecac", {"num_action_samples": 1}, "num_action_samples.*least 2: weights are relative.*1"),
        ("ecac", {"use_prioritized_weights": "yes"}, "use_prioritized_weights must be.*got 'yes'"),
        ("ecac", {"delay_qvalue": 0}, "delay_qvalue must be one of True, False, None, got 0"),
        ("ecac", {"skip_done_states": "no"}, "skip_done_states must be one of True, False, got"),
        ("ecac", {"num_actor_states": 3, "reduction": "none"}, "num_actor_states must be None.*3"),
        ("ecac", {"value": True, "delay_qvalue": True}, "With a value_network.*None.*True"),
        ("ecac", {"target_kl": "a"}, "target_kl must be a number, got 'a'"),
        ("ecac", {"target_kl": 0.0}, "target_kl must be above 0, in nats, or None, got 0.0"),
        ("ecac", {"target_kl": math.nan}, "target_kl must be above 0.*got nan"),
        ("ecac", {"target_kl": math.inf}, "target_kl must be above 0.*got inf"),
        ("ecac", {"target_entropy": [1.0]}, r"target_entropy must be a number, got \[1.0\]"),
        ("ecac", {"target_entropy": "car"}, r"target_entropy must be one of \('auto',\), got"),
        ("ecac", {"target_entropy": math.nan}, "target_entropy must be.*finite.*got nan"),
        ("ecac", {"target_kl": 0.1, "tau": 0.1, "min_tau": 0.125}, "must start at min_tau > 0"),
        ("ecac", {"target_kl": 0.1, "min_tau": 0.0}, "learned tau must start at min_tau > 0"),
        ("ecac", {"target_entropy": 0.1, "min_tau_prime": -1.0}, "must start at min_tau_prime > 0"),
    ],
    ids=str,
)
def test_options_are_checked_at_the_door(name, options, message):
    with pytest.raises(ValueError, match=message):
        CASES[name].build(**options)


def test_a_target_kl_that_the_samples_cannot_show():
    """log M, at the first call; per action dimension."""
    loss = CASE.build(target_kl=0.7, num_action_samples=4)
    with pytest.raises(ValueError, match=r"by 1\.4 nats.*log 4 = 1\.39.*lower"):
        call(loss, _batch())
    call(CASE.build(target_kl=0.69, num_action_samples=4), _batch())
    with pytest.raises(ValueError, match="1 samples cannot show more than log 1 = 0"):
        CASES["pmd_ac"].build(target_kl=0.1, num_action_samples=1)(_batch())


@losses
def test_policies_of_another_kind(case):
    """At the door: a Q of one action needs a policy to sample, one of all a policy over n.

    Several coins are not one of n actions, and cannot be drawn by rsample either.
    """
    networks = make_networks(case.kind)
    network = TensorDictModule(nn.Linear(OBSERVATION, CHOICES), ["observation"], ["logits"])
    coins = ProbabilisticActor(network, ["logits"], distribution_class=Bernoulli).double()
    other = make_networks("tanh_normal" if case.is_discrete else "categorical").actor
    own, says = ("actions with rsample", "read") if case.is_discrete else ("one of n", "write")
    for networks.actor, message in (
        (
            other,
            f"For a policy over {own}.* qvalue_network must {says}|is for policies over one of n",
        ),
        (coins, "got Bernoulli|For a policy over"),
        (make_actor("composite"), "got CompositeDistribution.*hybrid ones are for the losses of g"),
    ):
        with pytest.raises(ValueError, match=message):
            case.build(networks)(_batch(case))


@pytest.mark.parametrize("kind", [DiscreteECACLoss, DiscretePMDACLoss])
def test_a_loss_over_choices_takes_no_other_policy(kind):
    networks = make_networks("tanh_normal")
    with pytest.raises(ValueError, match=f"{kind.__name__} is for policies over one of n actions"):
        kind(networks.actor, networks.qvalues)


@pytest.mark.parametrize(
    ("key", "entry", "message"),
    [
        (("next", "reward"), torch.ones(6, 1) * 1j, "must be real .*got torch.complex64"),
        (("next", "reward"), torch.ones(0, 1), r"of one transition at least, got .*\(0, 1\)"),
        (("next", "terminated"), torch.zeros(6, 1), "must be boolean .* got torch.float32"),
        (MASK, torch.ones(5).bool(), r"have the shape \(6,\).*got \(5,\)"),
        (("next", "observation"), torch.ones(5, OBSERVATION), r"must begin with .*\[6\].*got \[5"),
        (
            "observation",
            torch.ones(6, OBSERVATION + 1).double(),
            r"evaluated on.*'observation' .*\(6",
        ),
        ("observation", torch.ones(6, OBSERVATION), r"evaluated on.*'observation' .*float32"),
        (
            "action",
            torch.ones(6, ACTION + 1).double(),
            r"cannot be evaluated on 'action' .*\(6, 3\)",
        ),
        ("action", torch.full((6, ACTION), math.nan).double(), "is NaN or infinite in 12 of 12"),
        ("priority_weight", torch.tensor([1.0, -2, 1, 1, 1, 1]), "at least 0, got -2 .* 1 of 6"),
        ("priority_weight", torch.ones(6, 2), r"must have the shape \[6\].*got \[6, 2\]"),
    ],
    ids=str,
)
def test_entries_of_the_wrong_kind(key, entry, message):
    """Named, before anything broadcasts; nothing is written."""
    batch = TensorDict(_batch().to_dict()).set(key, entry)
    with pytest.raises(ValueError, match=message) as info:
        CASE.build()(batch)
    assert repr(key) in str(info.value)
    assert batch.get("td_error", None) is None


@pytest.mark.parametrize("scale", [1e30, 1e19], ids=["of each", "in sum"])
def test_losses_that_overflow(scale):
    batch = _batch(dtype=torch.float32)
    batch["next", "reward"] = torch.full((6, 1), scale)
    loss = CASE.build(make_networks(dtype=torch.float32))
    with pytest.raises(ValueError, match=r"loss_qvalue, computed from \('next', 'reward'\)"):
        loss(batch)


def test_parameters_that_are_not_finite_are_named():
    loss = CASE.build()
    loss.actor_network_params["module", "0", "module", "0", "bias"].data.fill_(math.nan)
    with pytest.raises(ValueError, match=r"actor_network_params.*bias is NaN or infinite in 4"):
        loss(_batch())


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.zeros(6, CHOICES + 1), "one-hot of shape"),
        (torch.zeros(6, 6, 1), "one-hot of shape"),
        (torch.tensor([0, 1, 2, 3, 4, -1]), "0 to 3, or one-hot.*; 2 of 6 are not"),
        (torch.tensor([0, 1, 1, 0]).expand(6, CHOICES), "single 1; 6 of 6 are not"),
        (torch.tensor([1, -1, 0, 1]).expand(6, CHOICES), "single 1; 6 of 6 are not"),
        (torch.tensor([1, 0.5, 0, 0]).expand(6, CHOICES), "single 1; 6 of 6 are not"),
    ],
    ids=lambda x: str(tuple(x.shape)) if isinstance(x, torch.Tensor) else "",
)
def test_wrong_discrete_actions(action, message):
    case = CASES["discrete_ecac"]
    with pytest.raises(ValueError, match=f"The action 'action' must be.*{message}"):
        case.build()(_batch(case).set("action", action))


def test_a_mask_of_indices_is_refused():
    """MaskedCategorical takes one, but Q has the values of all n actions."""
    loss, batch = _masked("discrete_ecac", CHOICES)
    network: Any = loss.actor_network[-1]
    network.distribution_class = partial(_by_indices, MaskedCategorical)
    with pytest.raises(ValueError, match=r"MaskedCategorical with indices: give it a boolean mask"):
        loss(batch)


def _by_indices(kind, logits, mask):
    return kind(logits=logits, indices=torch.arange(CHOICES).expand_as(logits))


@pytest.mark.parametrize("dtype", [torch.bool, torch.int64, torch.float64])
def test_a_single_action_may_be_one_hot(dtype):
    case, batch = CASES["discrete_ecac"], _batch(CASES["discrete_ecac"])
    qvalues = torch.zeros(2, 6, 1).double()
    one = torch.full((6, 1), dtype != torch.int64, dtype=dtype)  # the index is 0
    chosen = case.build()._chosen_qvalue(qvalues, batch.set("action", one), None)
    assert chosen.shape == (2, 6)


@pytest.mark.parametrize(
    ("name", "allowed", "target"),
    [
        ("discrete_ecac", CHOICES, 1.4),
        ("discrete_ecac", CHOICES, 0.0),
        ("discrete_pmd_ac", CHOICES, -1.0),
        ("discrete_ecac", 2, 0.7),
        ("ecac", CHOICES, 1.4),
        ("tiny", CHOICES, "auto"),
    ],
)
def test_entropies_that_no_policy_has(name, allowed, target):
    """Above log n of what a mask leaves, not above 0, above the log-volume of the bounds."""
    loss, batch = _masked(name, allowed, target_entropy=target)
    with pytest.raises(ValueError, match=f"target_entropy={target!r} asks for .* nats, which no"):
        loss(batch)


@pytest.mark.parametrize("allowed", [2, CHOICES])
@pytest.mark.parametrize(("name", "weight"), [("discrete_ecac", 0.98), ("discrete_pmd_ac", 0.3)])
def test_auto_follows_the_mask(name, allowed, weight):
    options = {} if weight == 0.98 else {"target_entropy_weight": weight}
    loss, batch = _masked(name, allowed, target_entropy="auto", **options)
    outputs = loss(batch)
    excess = weight * math.log(allowed) - outputs["entropy"]
    assert_close(outputs["loss_tau_prime"], -loss.log_tau_prime * excess)


def _masked(name, allowed, **options):
    """A loss with a mask that leaves the first actions, or with actions in a tiny box."""
    networks, batch = make_networks(), _batch(CASES.get(name, CASE))
    if name == "tiny":
        bounds = {"low": -0.05, "high": 0.05}
        networks.actor = ProbabilisticActor(
            networks.actor[0],  # type: ignore
            ["loc", "scale"],
            distribution_class=TanhNormal,
            distribution_kwargs=bounds,
        )
    elif name != "ecac":
        networks = make_networks("categorical")
        networks.actor = ProbabilisticActor(
            networks.actor[0],  # type: ignore
            {"logits": "logits", "mask": "action_mask"},
            distribution_class=MaskedCategorical,
        )
        for where in (batch, batch["next"]):
            where["action_mask"] = (torch.arange(CHOICES) < allowed).expand(6, CHOICES)
    return CASES.get(name, CASE).build(networks, **options), batch


@pytest.mark.parametrize(
    ("kind", "name", "key"),
    [
        ("ecac", "state_action_value", "state_action_value"),
        ("discrete_pmd_ac", "action_value", "action_value"),
        ("ecac", "value", "state_value"),
    ],
)
def test_networks_that_write_another_entry(kind, name, key):
    """TorchRL's ``ValueOperator`` does so, where the action has another name than "action"."""
    case, networks = CASES[kind], make_networks(CASES[kind].kind)
    changed = [networks.value] if name == "value" else networks.qvalues
    for network in changed:
        network.out_keys[0] = "v"
    loss = case.build(networks, value=name == "value")
    with pytest.raises(KeyError, match=rf"writes \['v'\], not '{key}'.*set_keys\({name}=...\)"):
        loss(_batch(case))
    loss.set_keys(**{name: "v"})
    assert loss(_batch(case))["loss_qvalue"].isfinite()


def test_log_probabilities_and_values_that_do_not_match():
    networks = make_networks()
    network = nn.Sequential(nn.Linear(OBSERVATION, 2 * ACTION), NormalParamExtractor()).double()
    head = TensorDictModule(network, ["observation"], ["loc", "scale"])
    networks.actor = ProbabilisticActor(head, ["loc", "scale"], distribution_class=Normal)
    message = r"values.*shape \(1, 6\), their log-probabilities \(1, 6, 2\).*Independent"
    with pytest.raises(ValueError, match=message):
        CASE.build(networks, projection="paper")(_batch())
    networks = make_networks()
    two = MLP(in_features=OBSERVATION + ACTION, out_features=2, num_cells=[5]).double()
    networks.qvalues = ValueOperator(two, ["observation", "action"])  # type: ignore
    with pytest.raises(ValueError, match=r"one number, .*but the Q network writes 2"):
        CASE.build(networks)(_batch())


@pytest.mark.parametrize(("copies", "number"), [(1, 1), (1, 2), (2, 3), ("same", 2)])
def test_lists_of_q_networks(copies, number):
    """TorchRL would leave one network, or the same one twice, untrained."""
    networks = make_networks()
    networks.qvalues = networks.qvalues[:1] * 2 if copies == "same" else networks.qvalues[:copies]
    with pytest.raises(ValueError, match=f"must hold num_qvalue_nets={number} different ones"):
        CASE.build(networks, num_qvalue_nets=number)
    networks.qvalues = networks.qvalues[0]  # type: ignore
    loss = CASE.build(networks, num_qvalue_nets=number)
    trained = gradients(loss, call(loss, _batch())["loss_qvalue"])
    assert all(g.shape[0] == number for name, g in trained.items() if "qvalue" in name)
    assert any(g.abs().max() > 0 for name, g in trained.items() if "qvalue" in name)


# --------------------------------------------------------------------------------------- extremes


@every_loss
@pytest.mark.parametrize(
    ("scale", "value", "dtype"),
    [(1e6, False, torch.float32), (-1e6, True, torch.float32), (-1e6, False, torch.float64)],
)
def test_extremes_stay_finite(case, scale, value, dtype):
    """Q of a million at temperatures of a millionth, and a saturated, nearly certain policy."""
    networks = make_networks(case.kind, dtype=dtype)
    for qvalue in networks.qvalues:
        qvalue.module[-1].weight.data.mul_(scale)  # type: ignore
        qvalue.module[-1].bias.data.fill_(scale)  # type: ignore
    for parameter in networks.actor.parameters():
        parameter.data.mul_(30.0)
    loss = case.build(networks, value=value, tau=1e-6, tau_prime=1e-6, delay_actor=True)
    batch = _batch(case, dtype=dtype)
    outputs = call(loss, batch)
    for name, output in outputs.items():
        assert output.isfinite(), name
    for name, gradient in gradients(loss, total(outputs)).items():
        assert gradient.isfinite().all(), name
    assert outputs["ESS"] >= 1 - 1e-5
    assert batch["td_error"].isfinite().all()


# ----------------------------------------------------------------------------------------- compile


@losses
def test_half_precision_has_room_for_the_lift(case):
    """Q of 800 at temperatures of 0.02: what is divided is beyond the numbers of 16 bits."""
    networks = make_networks(case.kind, dtype=torch.float16)
    for qvalue in networks.qvalues:
        last = [module for module in qvalue.modules() if isinstance(module, nn.Linear)][-1]
        last.bias.data += 800
    batch = _batch(case, dtype=torch.float16)
    given = {"tau": 0.02, "tau_prime": 0.005, "reduction": "none"}
    half, whole = (
        case.build(deepcopy(networks), **given).to(dtype)
        for dtype in (torch.float16, torch.float32)
    )
    in_single = batch.apply(lambda x: x.float() if x.is_floating_point() else x)
    outputs, expected = call(half, batch), call(whole, in_single)
    assert_close(outputs["state_value"], expected["state_value"], atol=0.5, rtol=0)
    assert outputs["loss_qvalue"].dtype == torch.float32
    many = _batch(case, 256, dtype=torch.float16)
    many[MASK] = torch.arange(256) < 255
    assert call(case.build(deepcopy(networks)).half(), many)["qvalue"] == pytest.approx(800, abs=2)


def test_vmap_randomness_may_be_chosen():
    """As of TorchRL's losses; here nothing is vmapped."""
    loss, batch = CASE.build(), _batch()
    expected = call(loss, batch)
    loss.set_vmap_randomness("different")
    assert_close(call(loss, batch), expected)


def _dense(wrap=lambda network: network, **options):
    """ECACLoss with the package's networks, which know a faster way for many actions."""
    networks = make_networks()
    spec = Bounded(-1.0, 1.0, shape=(ACTION,))
    torch.manual_seed(0)
    networks.actor = make_tanh_gaussian_actor(OBSERVATION, spec, hidden_sizes=[8]).double()
    qvalue = make_qvalue_network(OBSERVATION, ACTION, hidden_sizes=[8]).double()
    networks.qvalues = wrap(qvalue)  # type: ignore
    return CASE.build(networks, **options)


def test_a_wrapped_network_is_not_taken_for_what_it_wraps():
    values = []
    for wrap in (lambda network: network, TensorDictModuleWrapper):
        loss = _dense(wrap)
        for parameter in loss.qvalue_network_params.values(True, True):
            parameter.data.fill_(0.01)
        values.append(call(loss, _batch())["qvalue"])
    assert_close(*values)


def compiler_warnings(test):
    """Tensordict and torch warn of their own ways into the compiler."""
    for category in ("FutureWarning", "DeprecationWarning"):
        test = pytest.mark.filterwarnings(f"ignore::{category}")(test)
    return test


def _assert_compiled_is_eager(loss, batch, backend):
    """Same numbers and gradients, without a graph break, temperatures scheduled or learned."""
    torch._dynamo.reset()

    def update(batch):
        outputs = loss(batch)
        return outputs, total(outputs)

    compiled = torch.compile(update, fullgraph=True, backend=backend)
    with torch._dynamo.config.patch(error_on_recompile=False):
        for step in range(2):
            torch.manual_seed(step)
            expected, value = update(batch)
            torch.manual_seed(step)
            actual, compiled_value = compiled(batch)
            assert list(actual.keys()) == list(expected.keys())
            assert_close(actual, expected)
            assert_close(gradients(loss, compiled_value), gradients(loss, value))
            if not hasattr(loss, "log_tau"):
                loss.tau = 0.5
            torch._dynamo.config.error_on_recompile = True


@pytest.mark.parametrize(
    "options",
    [
        {},
        pytest.param(
            {"projection": "gradient", "width_entropy": 0.4}, id="gradient", marks=pytest.mark.slow
        ),
    ],
)
@compiler_warnings
def test_compile(options):
    """The whole of one loss, with the package's networks; what the others add is slow to ask."""
    loss = _dense(num_actor_states=4, target_kl=0.05, **options)
    _assert_compiled_is_eager(loss, _batch(), "eager")


@pytest.mark.slow
@every_loss
@pytest.mark.parametrize(
    "options",
    [{}, {"value": True, "delay_actor": True, **LEARNED}],
    ids=["scheduled", "all"],
)
@pytest.mark.parametrize("backend", ["eager", "inductor"])
@compiler_warnings
def test_compile_with_other_backends(case, backend, options):
    """Inductor is the one that generates code; told to, it draws the same random numbers."""
    learns_tau = "loss_tau" in case.loss.losses  # and has no target_kl
    options = {name: x for name, x in options.items() if not learns_tau or name != "target_kl"}
    loss, *_ = _trained(case, **options)
    with torch._inductor.config.patch(fallback_random=True):
        _assert_compiled_is_eager(loss, _batch(case), backend)
