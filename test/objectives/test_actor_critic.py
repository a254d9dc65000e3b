"""What the actor-critic losses share: the numbers, TorchRL's contract, temperatures, bad input."""

from __future__ import annotations

import inspect
import math
import pickle
import warnings
from copy import deepcopy

import pytest
import torch
from actor_critic_problems import (
    ACTION,
    CASES,
    CHOICES,
    CONTINUOUS,
    GAMMA,
    as_keywords,
    become,
    call,
    expected_outputs,
    gradients,
    make_batch,
    make_networks,
    make_qvalue,
    out_keys,
    total,
)
from tensordict import TensorDict, TensorDictParams
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
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import LossModule, SoftUpdate, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator
from trajectory_problems import MASK, OBSERVATION, make_actor

from torchrl_ecpo import (
    ActorCriticLoss,
    ECACLoss,
    PeriodicCopy,
    PolyakAverage,
    TemperatureScheduler,
    UpdaterSequence,
)
from torchrl_ecpo.modules import make_qvalue_network, make_tanh_gaussian_actor
from torchrl_ecpo.schedules import linear

# What stands once in the base is asked of one loss that samples, and one that sums.
every_loss = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
BASE = ("ecac", "discrete_pmd_ac")
losses = pytest.mark.parametrize("case", [CASES[n] for n in BASE], ids=BASE)
continuous = pytest.mark.parametrize("case", [CASES[n] for n in CONTINUOUS], ids=CONTINUOUS)
with_and_without_value = pytest.mark.parametrize("value", [False, True], ids=["no_value", "value"])
with_and_without_delay = pytest.mark.parametrize("delay", [False, True], ids=["live", "delayed"])
LEARNED = {"target_kl": 0.05, "target_entropy": -1.5}


def _cast(batch, dtype):
    """Floating point entries only: done flags stay boolean."""
    return batch.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)


def _batch(case, *shape, **options):
    return make_batch(case.kind, *shape, **options)


def _trained(case, *, dtype=torch.float64, **options):
    """A loss whose networks have moved away from the delayed ones, and both sets of networks."""
    old = make_networks(case.kind, seed=1, dtype=dtype)
    new = make_networks(case.kind, seed=2, dtype=dtype)
    loss = case.build(deepcopy(old), **options)
    become(loss, new)
    return loss, new, old


# ------------------------------------------------------------------------------------- the numbers


@every_loss
@with_and_without_value
@with_and_without_delay
def test_all_outputs_are_the_formulas(case, value, delay, dtype):
    """Losses and metrics of each state, and their gradients, in plain numbers, seed for seed."""
    options = {"num_action_samples": 8, "num_next_action_samples": 3}
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
    for name in loss.out_keys:
        if not name.startswith("loss_"):
            assert not actual[name].requires_grad, name
            continue
        networks = {
            "loss_actor": new.actor,
            "loss_qvalue": new.qvalues[0],
            "loss_value": new.value,
        }
        parameters = list(networks[name].parameters())
        reached = torch.autograd.grad(expected[name].sum(), parameters)
        trained = gradients(loss, actual[name].sum())
        trained = [
            gradient[0] if "qvalue" in key else gradient
            for key, gradient in trained.items()
            if key.startswith(name.removeprefix("loss_"))
        ]
        for gradient, by_formula in zip(trained, reached, strict=True):
            assert_close(gradient, by_formula, **tolerance, msg=name)


@losses
@pytest.mark.parametrize("loss_function", ["l2", "l1", "smooth_l1"])
def test_loss_function(case, loss_function):
    """Of Q and of V alike."""
    loss, *_ = _trained(case, value=True, reduction="none", loss_function=loss_function)
    squared, *_ = _trained(case, value=True, reduction="none")
    batch = _batch(case)
    actual, squares = call(loss, batch), call(squared, batch)
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
def test_reductions(case):
    """One number a state, their mean, their sum; metrics are means either way."""
    batch = _batch(case)
    each = call(_trained(case, value=True, reduction="none")[0], batch)
    mean = call(_trained(case, value=True, reduction="mean")[0], batch)
    by_default = call(_trained(case, value=True)[0], batch)
    added = call(_trained(case, value=True, reduction="sum")[0], batch)
    assert each.batch_size == batch.batch_size
    assert mean.batch_size == added.batch_size == torch.Size([])
    assert_close(by_default, mean)
    for name, values in each.items():
        assert values.shape == batch.shape
        assert mean[name].shape == added[name].shape == ()
        assert_close(mean[name], values.mean(), msg=name)
        is_loss = name.startswith("loss_")
        assert_close(added[name], values.sum() if is_loss else values.mean(), msg=name)


@losses
@pytest.mark.parametrize("shape", [(6,), (2, 3), (3, 1, 2)], ids=str)
def test_batches_of_any_shape(case, shape):
    """``[*B]`` is a matter of arrangement."""
    loss = case.build(value=True, reduction="none", **LEARNED)
    flat = _batch(case, 6)
    expected = call(loss, flat)
    shaped = TensorDict(flat.exclude("td_error").reshape(shape).to_dict(), batch_size=shape)
    actual = call(loss, shaped)
    assert_close(actual.reshape(-1), expected)
    assert_close(shaped["td_error"].reshape(-1), flat["td_error"])
    priority = case.build(value=True, **LEARNED)
    assert_close(call(priority, shaped), call(priority, flat))


@losses
@pytest.mark.parametrize("batch_size", [(), (2,)], ids=str)
def test_batch_size_may_be_understated(case, batch_size):
    """The entries say what the batch is."""
    loss = case.build()
    batch = _batch(case, 2, 3)
    expected = call(loss, batch)
    given = TensorDict(batch.exclude("td_error").to_dict(), batch_size=batch_size)
    assert_close(call(loss, given), expected)
    assert_close(given["td_error"], batch["td_error"])


@losses
def test_single_numbers_may_be_observations_and_actions(case):
    """TensorDict takes the last axis of a call without a tensordict for one of the batch then."""
    actor = nn.Sequential(nn.Linear(1, CHOICES if case.is_discrete else 2))
    kind = CASES["discrete_ecac"].kind if case.is_discrete else case.kind
    networks = make_networks(kind)
    if case.is_discrete:
        networks.actor[0].module[0] = actor
        qvalue = TensorDictModule(MLP(1, CHOICES, num_cells=[5]), ["observation"], ["action_value"])
        action = torch.randint(CHOICES, (5, 1))
    else:
        networks.actor[0].module[0] = actor
        qvalue = ValueOperator(MLP(2, 1, num_cells=[5]), ["observation", "action"])
        action = torch.rand(5, 1).double()
    networks.actor.double()
    networks.qvalues = [qvalue.double(), deepcopy(qvalue)]
    loss = case.build(networks)
    end = torch.zeros(5, 1, dtype=torch.bool)
    batch = TensorDict(
        {
            "observation": torch.rand(5, 1).double(),
            "action": action,
            "next": {
                "observation": torch.rand(5, 1).double(),
                "reward": torch.rand(5, 1).double(),
                "done": end,
                "terminated": end.clone(),
            },
        },
        batch_size=[5],
    )
    expected = call(loss, batch)
    torch.manual_seed(0)
    for name, value in zip(loss.out_keys, loss(**as_keywords(loss, batch)), strict=True):
        assert_close(value, expected[name], msg=name)


# ------------------------------------------------------------------------------------ the gradients

REACHES = {
    "loss_actor": "actor_network_params",
    "loss_qvalue": "qvalue_network_params",
    "loss_value": "value_network_params",
    "loss_tau": "log_tau",
    "loss_tau_prime": "log_tau_prime",
}


@losses
@with_and_without_value
@with_and_without_delay
def test_each_loss_reaches_its_own_parameters_only(case, value, delay):
    """All of them, and none of another network's; nothing delayed is trained."""
    loss, *_ = _trained(case, value=value, delay_actor=delay, **LEARNED)
    # At the bound itself a learned temperature has no reason to move.
    outputs = dict(call(loss, _batch(case)).items())
    assert [name for name in loss.out_keys if name in REACHES] == [
        name for name in REACHES if value or name != "loss_value"
    ]
    for loss_name, prefix in REACHES.items():
        if loss_name not in outputs:
            continue
        for name, gradient in gradients(loss, outputs[loss_name]).items():
            is_own = name == prefix or name.startswith(f"{prefix}.")
            assert (gradient.abs().max() > 0) == is_own, (loss_name, name)
    sum(outputs[name] for name in REACHES if name in outputs).backward()
    names = [name for name, _ in loss.named_parameters()]
    assert not [name for name in names if "target" in name]
    for name, parameter in loss.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.norm() > 0, name
    tensors = [*loss.parameters(), *loss.buffers()]
    assert len({id(tensor) for tensor in tensors}) == len(tensors)
    for name, buffer in loss.named_buffers():
        assert not buffer.requires_grad, name
        assert buffer.grad is None, name


@losses
def test_total_gradient_is_the_sum_of_the_parts(case):
    """So that one backward pass serves all."""
    loss, *_ = _trained(case, value=True, **LEARNED)
    outputs = call(loss, _batch(case))
    names = [name for name in REACHES if name in loss.out_keys]
    parts = [gradients(loss, outputs[name]) for name in names]
    whole = gradients(loss, total(outputs))
    for name, gradient in whole.items():
        assert_close(gradient, sum(part[name] for part in parts), msg=name)


@losses
def test_parameters_are_the_users(case):
    """Changed in place, they change the actor that was passed in."""
    networks = make_networks(case.kind)
    loss = case.build(networks)
    for parameter in loss.parameters():
        parameter.data.fill_(0.5)
    assert all((parameter == 0.5).all() for parameter in networks.actor.parameters())
    policy = loss.get_stateful_net("actor_network")
    assert policy is not loss.actor_network
    assert all((parameter == 0.5).all() for parameter in policy.parameters())
    loss.from_stateful_net("actor_network", make_networks(case.kind, seed=2).actor)
    assert not any((parameter == 0.5).all() for parameter in networks.actor.parameters())


# ------------------------------------------------------------------------------- delays, updaters

NETWORKS = ("actor_network", "qvalue_network", "value_network")


@losses
@pytest.mark.parametrize("delay_actor", [False, True])
@pytest.mark.parametrize(
    ("value", "delay_qvalue"),
    [(False, None), (False, False), (False, True), (True, None), (True, False)],
)
def test_delay_flags(case, delay_actor, delay_qvalue, value):
    """With a flag the target stays where it was, without it the target is the live network."""
    loss, *_ = _trained(case, value=value, delay_actor=delay_actor, delay_qvalue=delay_qvalue)
    delayed = {
        "actor_network": delay_actor,
        "qvalue_network": not value if delay_qvalue is None else delay_qvalue,
        "value_network": value,
    }
    for name in NETWORKS[: 3 if value else 2]:
        source = getattr(loss, f"{name}_params").data
        target = getattr(loss, f"target_{name}_params").data
        equal = all(torch.equal(x, target.get(key)) for key, x in source.items(True, True))
        assert equal is not delayed[name], name
        assert (f"target_{name}_params" in dict(loss.named_children())) is delayed[name], name
    assert (loss.delay_actor, loss.delay_qvalue) == tuple(delayed.values())[:2]
    assert call(loss, _batch(case))["loss_qvalue"].isfinite()


@losses
def test_a_live_q_is_what_the_target_sees(case):
    """``delay_qvalue=False``: the online networks, as if they had just been copied."""
    loss, *_ = _trained(case, delay_qvalue=False, delay_actor=False)
    copied, *_ = _trained(case, delay_qvalue=True, delay_actor=False)
    batch = _batch(case)
    expected = call(loss, batch)
    assert not torch.allclose(call(copied, batch)["loss_qvalue"], expected["loss_qvalue"])
    PolyakAverage(copied, weight=1.0).step()
    assert_close(call(copied, batch), expected)


@losses
@with_and_without_value
def test_updaters(case, value):
    """Each delayed network follows its own updater; TorchRL's takes all of them."""
    critic = "value_network" if value else "qvalue_network"
    new = make_networks(case.kind, seed=2)

    def distances(loss):
        return {
            name: sum(
                (source - getattr(loss, f"target_{name}_params").get(key)).abs().sum().item()
                for key, source in getattr(loss, f"{name}_params").data.items(True, True)
            )
            for name in ("actor_network", critic)
        }

    loss = case.build(value=value, delay_actor=True, updater=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        updater = UpdaterSequence(
            PeriodicCopy(loss, "actor_network", interval=2),
            PolyakAverage(loss, critic, weight=0.25),
        )
        call(loss, _batch(case))
    become(loss, new)
    before = distances(loss)
    updater.step()
    after = distances(loss)
    assert after["actor_network"] == before["actor_network"] > 0
    assert after[critic] == pytest.approx(0.75 * before[critic])
    updater.step()
    assert distances(loss)["actor_network"] == 0

    loss = case.build(value=value, delay_actor=True, updater=False)
    updater = SoftUpdate(loss, eps=0.75)
    become(loss, new)
    updater.step()
    assert distances(loss) == pytest.approx({name: 0.75 * d for name, d in before.items()})


@losses
def test_warning_without_an_updater(case):
    """TorchRL's own; a loss without targets never warns."""
    with pytest.warns(UserWarning, match="No target network updater has been associated"):
        case.build(value=True, updater=False)(_batch(case))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loss = case.build(delay_actor=False, delay_qvalue=False, updater=False)
        call(deepcopy(loss), _batch(case))["loss_actor"].backward()


# -------------------------------------------------------------------------------------- the module


@losses
@with_and_without_value
@pytest.mark.parametrize("learned", [{}, LEARNED], ids=["fixed", "learned"])
def test_state_dict_round_trip(case, value, learned):
    """Strict, into a loss built alike, also after a forward: delayed networks, temperatures."""
    batch = _batch(case)
    loss, *_ = _trained(case, value=value, delay_actor=True, **learned)
    entries = list(loss.state_dict())
    if not learned:
        loss.tau, loss.tau_prime = 0.3, 0.2
    expected = call(loss, batch)
    assert loss.in_keys
    assert loss.out_keys
    assert list(loss.state_dict()) == entries
    for called in (False, True):
        fresh = case.build(value=value, delay_actor=True, **learned)
        if called:
            assert not torch.allclose(call(fresh, batch)["loss_actor"], expected["loss_actor"])
        fresh.load_state_dict(loss.state_dict(), strict=True)
        assert_close(call(fresh, batch), expected)


@losses
@pytest.mark.parametrize("learned", [{}, LEARNED], ids=["fixed", "learned"])
def test_to_dtype(case, learned):
    """Parameters, targets and temperatures follow, and keep their kind; the numbers hardly move."""
    loss, *_ = _trained(case, value=True, **learned)
    batch = _batch(case)
    outputs = call(loss, batch)
    cast = loss.to(torch.float32)
    assert {t.dtype for t in [*cast.parameters(), *cast.buffers()]} == {torch.float32}
    outputs_32 = loss(_cast(batch, torch.float32))
    assert {v.dtype for v in outputs_32.values()} == {torch.float32}
    double = cast.double()
    assert {t.dtype for t in [*double.parameters(), *double.buffers()]} == {torch.float64}
    assert isinstance(double.qvalue_network_params, TensorDictParams)
    assert all(isinstance(p, nn.Parameter) for p in double.parameters())
    assert_close(call(double, batch), outputs, rtol=1e-4, atol=1e-5)


@losses
@pytest.mark.parametrize("learned", [{}, LEARNED], ids=["fixed", "learned"])
def test_device_is_that_of_the_networks(case, learned):
    """Also of temperatures and of the discount, before any call of ``to``."""
    networks = make_networks(case.kind)
    for network in (networks.actor, *networks.qvalues, networks.value):
        network.to("meta")
    options = {"target_kl": None, "target_entropy": None, **case.options, **learned}
    loss = case.loss(networks.actor, networks.qvalues, networks.value, **options)
    assert {t.device.type for t in [*loss.parameters(), *loss.buffers()]} == {"meta"}


@losses
@with_and_without_value
def test_reset_parameters_recursive(case, value):
    """Sources and targets both, as TorchRL's test of every loss demands."""
    loss = case.build(value=value, delay_actor=True)
    before = {n: v.clone() for n, v in loss.state_dict().items() if "params" in n and v.numel()}
    loss.reset_parameters_recursive()
    after = loss.state_dict()
    assert [name for name, v in before.items() if (v == after[name]).all()] == []
    assert any("target" in name for name in before)


class _Spy(nn.Module):
    """Remembers in which modes it was called."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.modes: list = []

    def forward(self, observation):
        self.modes.append(exploration_type())
        return self.network(observation)


@losses
def test_exploration_type(case):
    """Random where the policy is asked; outside what it was before, also after an error."""
    networks = make_networks(case.kind)
    spy = _Spy(networks.actor[0].module)
    networks.actor[0].module = spy
    loss = case.build(networks)
    with set_exploration_type(ExplorationType.MODE):
        call(loss, _batch(case))
        with pytest.raises(KeyError):
            loss(_batch(case).exclude("action"))
        assert exploration_type() is ExplorationType.MODE
    assert set(spy.modes) == {ExplorationType.RANDOM}


@every_loss
def test_constructor(case):
    """Networks by position, everything else by keyword; what the class says is what it has."""
    parameters = inspect.signature(case.loss).parameters
    assert list(parameters)[:3] == ["actor_network", "qvalue_network", "value_network"]
    of_base = list(inspect.signature(ActorCriticLoss).parameters.values())[3:]
    assert all(p.kind is p.KEYWORD_ONLY for p in of_base)
    doc = inspect.getdoc(ECACLoss) or ""
    names = {*parameters, *(p.name for p in of_base)} - {"options"}
    assert [n for n in names if f"{n}:" not in doc + (inspect.getdoc(case.loss) or "")] == []
    assert issubclass(case.loss, LossModule)
    for name in ("gamma", "lmbda", "action_key", "alpha_init"):
        with pytest.raises(TypeError, match=name):
            case.build(**{name: 0.9})


@every_loss
@with_and_without_value
def test_defaults(case, value):
    """As documented; without any option a loss works."""
    networks = make_networks(case.kind)
    loss = case.loss(networks.actor, make_qvalue(case.kind).double(), *([networks.value] * value))
    assert (loss.reduction, loss.loss_function, loss.num_qvalue_nets) == ("mean", "l2", 2)
    assert loss.delay_actor is (case.loss.__name__ in ("PMDACLoss", "DiscretePMDACLoss"))
    assert loss.delay_qvalue is not value
    assert loss.value_estimator.gamma == pytest.approx(0.99)
    assert loss.use_prioritized_weights == "auto"
    PolyakAverage(loss)
    total(call(loss, _batch(case))).backward()


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


def _as_tuple(key):
    return (key,) if isinstance(key, str) else tuple(key)


def _rename(batch, keys):
    renamed = batch.exclude(*(KEYS[field] for field in keys))
    for name, key in keys.items():
        if KEYS[name] in batch.keys(True):
            renamed[(*KEYS[name][:-1], *_as_tuple(key))] = batch[KEYS[name]]
    return renamed


def _renamed_case(case, keys, *, value):
    """Networks write and read other names as well."""
    networks = make_networks(case.kind)
    action = keys.get("action", "action")
    networks.actor = type(networks.actor)(
        networks.actor[0],
        in_keys=["logits"] if case.is_discrete else ["loc", "scale"],
        out_keys=[action],
        distribution_class=networks.actor[-1].distribution_class,
    )
    for number, qvalue in enumerate(networks.qvalues):
        if case.is_discrete:
            outs = [keys.get("action_value", "action_value")]
            networks.qvalues[number] = TensorDictModule(qvalue.module, ["observation"], outs)
        else:
            outs = [keys.get("state_action_value", "state_action_value")]
            networks.qvalues[number] = ValueOperator(qvalue.module, ["observation", action], outs)
    outs = [keys.get("value", "state_value")]
    networks.value = ValueOperator(networks.value.module, ["observation"], outs)
    return networks


@losses
@with_and_without_value
def test_default_keys(case, value):
    """As documented, in this order: with sets it would depend on the seed of the hashes."""
    loss = case.build(value=value)
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
    assert loss.out_keys == out_keys(case, value=value)
    learned = case.build(value=value, **LEARNED)
    assert learned.out_keys == out_keys(case, value=value, learned=True)


@losses
@pytest.mark.parametrize("names", RENAMED)
@pytest.mark.parametrize(
    ("field", "value"),
    [
        *((field, False) for field in [*KEYS, "state_action_value", "action_value", "all"]),
        *((field, True) for field in ["value", "all"]),
    ],
)
def test_set_keys(case, value, names, field):
    """Every field, one at a time and all at once; None restores the default."""
    batch = _batch(case)
    batch["priority_weight"] = torch.linspace(0.5, 1.5, 6).double()
    reference = case.build(value=value)
    expected = call(reference, batch)
    fields = [*vars(reference.tensor_keys)] if field == "all" else [field]
    keys = {name: RENAMED[names](name) for name in fields}
    loss = case.build(_renamed_case(case, keys, value=value), value=value)
    assert loss.in_keys
    assert loss.set_keys(**keys) is None
    for name, key in keys.items():
        assert getattr(loss.tensor_keys, name) == key
    given = {name: key for name, key in keys.items() if name in KEYS}
    renamed = _rename(batch, given)
    assert_close(call(loss, renamed), expected)
    assert_close(renamed[keys.get("priority", "td_error")], batch["td_error"])
    torch.manual_seed(0)
    values = loss(**as_keywords(loss, renamed))
    assert len(values) == len(loss.out_keys)
    if field not in ("all", "priority_weight"):
        unweighted = call(reference, batch.exclude("priority_weight"))
        assert_close(values[0], unweighted["loss_actor"])
    loss.set_keys(**dict.fromkeys(keys))
    assert vars(loss.tensor_keys) == vars(reference.tensor_keys)
    estimator = loss.value_estimator.tensor_keys
    assert (estimator.value, estimator.reward) == ("state_value", "reward")


@losses
def test_unknown_key_and_keys_of_its_own(case):
    """TorchRL's ValueError; renaming in one loss leaves another alone."""
    first, second = case.build(), case.build()
    with pytest.raises(ValueError, match="advantage is not an accepted tensordict key"):
        first.set_keys(advantage="advantage")
    first.set_keys(reward="prize")
    assert second.tensor_keys.reward == "reward"
    assert ("next", "prize") in first.in_keys


@losses
def test_in_keys_can_be_given(case):
    """The property has a setter, as TorchRL's have; set_keys makes them anew."""
    loss = case.build()
    keys = loss.in_keys
    loss.in_keys = ["observation"]
    assert loss.in_keys == ["observation"]
    loss.set_keys(reward="reward")
    assert loss.in_keys == keys


@losses
@with_and_without_value
def test_call_without_tensordict(case, value):
    """Keywords are the in_keys joined by _, the tuple is in the order of out_keys."""
    loss = case.build(value=value, **LEARNED)
    batch = _batch(case)
    expected = call(loss, batch)
    torch.manual_seed(0)
    values = loss(**as_keywords(loss, batch))
    for name, actual in zip(loss.out_keys, values, strict=True):
        assert_close(actual, expected[name], msg=name)


@losses
def test_select_out_keys(case):
    """One, two, all."""
    batch = _batch(case)
    loss = case.build()
    expected = call(loss, batch)
    loss.select_out_keys("loss_actor")
    assert list(call(loss, batch).keys()) == ["loss_actor"]
    torch.manual_seed(0)
    assert_close(loss(**as_keywords(loss, batch)), expected["loss_actor"])
    loss.reset_out_keys()
    assert_close(call(loss, batch), expected)
    loss.select_out_keys("loss_qvalue", "ESS")
    torch.manual_seed(0)
    loss_qvalue, ess = loss(**as_keywords(loss, batch))
    assert_close((loss_qvalue, ess), (expected["loss_qvalue"], expected["ESS"]))
    loss.reset_out_keys()
    assert loss.out_keys == list(expected.keys())
    with pytest.raises(ValueError, match="bogus"):
        loss.select_out_keys("bogus")


class _Privileged(nn.Module):
    """A critic that knows more than the actor."""

    def __init__(self, case) -> None:
        super().__init__()
        size = 2 * OBSERVATION + (0 if case.is_discrete else ACTION)
        self.network = MLP(size, CHOICES if case.is_discrete else 1, num_cells=[5]).double()

    def forward(self, *inputs):
        return self.network(torch.cat(inputs, -1))


@losses
def test_critics_may_read_what_the_actor_does_not(case):
    """Their observations of the next state are among the keywords too."""
    networks = make_networks(case.kind)
    if case.is_discrete:
        networks.qvalues = [
            TensorDictModule(_Privileged(case), ["observation", "secret"], ["action_value"])
            for _ in range(2)
        ]
    else:
        networks.qvalues = [
            ValueOperator(_Privileged(case), ["observation", "secret", "action"]) for _ in range(2)
        ]
    loss = case.build(networks)
    batch = _batch(case)
    batch["secret"] = torch.randn(6, OBSERVATION).double()
    batch["next", "secret"] = torch.randn(6, OBSERVATION).double()
    expected = call(loss, batch)
    torch.manual_seed(0)
    assert_close(loss(**as_keywords(loss, batch))[1], expected["loss_qvalue"])


@losses
@with_and_without_value
def test_input_is_untouched_but_for_the_priority(case, value):
    """Which is detached, finite, at least 0, of the shape of the batch."""
    batch = _batch(case, 2, 3)
    batch["next", "state_value"] = torch.full((2, 3, 1), 7.0).double()
    batch["loc"] = torch.full((2, 3, ACTION), 7.0).double()
    before = batch.clone()
    call(case.build(value=value), batch)
    priority = batch.pop("td_error")
    assert set(batch.keys(True)) == set(before.keys(True))
    assert_close(batch, before, rtol=0, atol=0)
    assert priority.shape == batch.shape
    assert not priority.requires_grad
    assert priority.isfinite().all()
    assert (priority > 0).all()


# ----------------------------------------------------------------------------------------- copies


@losses
def test_pickle_and_deepcopy(case):
    """The copy gives the same numbers, and shares nothing with the original."""
    loss = case.build(value=True, **LEARNED)
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
    loss = CASES["ecac"].build()
    loss.compile(backend="eager")
    copy = deepcopy(loss)
    call(copy, _batch(CASES["ecac"]))["loss_qvalue"].backward()
    assert all(parameter.grad is None for parameter in loss.parameters())
    assert any(parameter.grad is not None for parameter in copy.parameters())
    pickle.dumps(loss)


def test_a_learned_temperature_cannot_be_set_in_a_subclass_either():
    class Scheduled(ECACLoss):
        _schedulable_buffers = frozenset({"clip"})

    networks = make_networks("tanh_normal")
    loss = Scheduled(networks.actor, networks.qvalues)
    with pytest.raises(AttributeError, match="tau is learned"):
        loss.tau = 0.7


def test_dropout_of_a_copy_is_its_own():
    """A copy calls its own Q network, not the original's."""
    networks = make_networks("tanh_normal")
    size = OBSERVATION + ACTION
    network = MLP(in_features=size, out_features=1, num_cells=[8], dropout=0.5)
    networks.qvalues = ValueOperator(network, ["observation", "action"]).double()
    copy = deepcopy(CASES["ecac"].build(networks))
    batch = _batch(CASES["ecac"])
    chosen = [copy._chosen_qvalue(batch) for _ in range(2)]
    assert not torch.equal(*chosen)
    copy.qvalue_network.eval()
    chosen = [copy._chosen_qvalue(batch) for _ in range(2)]
    assert torch.equal(*chosen)


@continuous
def test_recurrent_q_network(case):
    """Of sampled actions it gives what it gives of those that were taken: rows stay rows."""
    size = OBSERVATION + ACTION
    memory = LSTMModule(input_size=size, hidden_size=4, in_key="both", out_key="memory")
    networks = make_networks(case.kind)
    networks.qvalues = TensorDictSequential(
        TensorDictModule(lambda *x: torch.cat(x, -1), ["observation", "action"], ["both"]),
        memory,
        TensorDictModule(nn.Linear(4, 1), ["memory"], ["state_action_value"]),
    ).double()
    loss = case.build(networks, delay_qvalue=False)
    batch = _batch(case, 3, 5)
    states = torch.randn(2, 3, 5, 1, 4, generator=torch.Generator().manual_seed(0)).double()
    batch["recurrent_state_h"], batch["recurrent_state_c"] = states
    batch["is_init"] = torch.zeros(3, 5, 1, dtype=torch.bool)
    with set_recurrent_mode(True):
        chosen = loss._chosen_qvalue(batch).amin(0)
        sampled = loss.states(batch).lift.actions._replace(
            action=batch["action"].expand(4, 3, 5, 2)
        )
        of_samples = loss.score_of(batch, sampled, loss.qvalue_network_params)
    assert_close(of_samples, chosen.expand(4, 3, 5))


# ----------------------------------------------------------------------------- masks of actions


@pytest.mark.parametrize("distribution", [MaskedCategorical, MaskedOneHotCategorical])
@pytest.mark.parametrize("name", ["discrete_ecac", "discrete_pmd_ac"])
@pytest.mark.parametrize("tau", [0.75, 0.0])
def test_forbidden_actions_have_no_part(distribution, name, tau):
    """All numbers and gradients are those of a problem without the forbidden action."""
    case = CASES[name]
    forbidden, rest = CHOICES - 1, slice(CHOICES - 1)
    allowed = torch.arange(CHOICES) != forbidden
    networks = make_networks("categorical")
    head = TensorDictModule(nn.Linear(OBSERVATION, CHOICES), ["observation"], ["logits"])
    smaller = TensorDictModule(nn.Linear(OBSERVATION, forbidden), ["observation"], ["logits"])
    qvalues = [make_qvalue("categorical").double() for _ in range(2)]
    for key, value in head.named_parameters():
        smaller.get_parameter(key).data = value.data[rest].clone()
    masked = ProbabilisticActor(
        head,
        {"logits": "logits", "mask": "action_mask"},
        distribution_class=distribution,
    ).double()
    plain = ProbabilisticActor(smaller, ["logits"], distribution_class=Categorical).double()
    fewer = [deepcopy(network) for network in qvalues]
    for network in fewer:
        last = [module for module in network.modules() if isinstance(module, nn.Linear)][-1]
        last.weight.data, last.bias.data = last.weight.data[rest], last.bias.data[rest]

    batch = _batch(case)
    one_hot = torch.eye(CHOICES)[torch.arange(6) % forbidden]
    batch["action"] = one_hot
    for where in (batch, batch["next"]):
        where["action_mask"] = allowed.expand(6, CHOICES)
    options = {"tau": tau, "delay_actor": False}
    results = []
    for actor, critics, action in ((masked, qvalues, one_hot), (plain, fewer, one_hot[:, rest])):
        networks.actor, networks.qvalues = actor, critics
        loss = case.build(networks, **options)
        outputs = call(loss, batch.clone().set("action", action))
        results.append((outputs, gradients(loss, total(outputs))))
    (actual, gradient), (expected, of_fewer) = results
    for key in (
        "loss_actor",
        "loss_qvalue",
        "kl_target_reference",
        "kl_reference_policy",
        "entropy",
        "ESS",
    ):
        assert_close(actual[key], expected[key], msg=key)
    assert_close(actual["state_value"], expected["state_value"])
    for key, value in of_fewer.items():
        if key.endswith("weight") and "actor" in key:
            assert_close(gradient[key][rest], value)
            assert (gradient[key][forbidden] == 0).all()


# ------------------------------------------------------------------------------ masks and weights


@losses
@with_and_without_value
@pytest.mark.parametrize("trailing", [False, True], ids=["[*B]", "[*B, 1]"])
@pytest.mark.parametrize("weighted", [False, True], ids=["", "weighted"])
def test_masked_transitions_count_nothing(case, value, trailing, weighted):
    """Whatever stands in them: values, gradients and metrics are those of the others."""
    loss = case.build(value=value, **{**LEARNED, "reduction": "mean"})
    real = _batch(case)
    weights = torch.linspace(0.5, 2.0, 6).double()
    if weighted:
        real["priority_weight"] = weights
    spoilt = torch.cat([real, real.clone()])
    for key in spoilt.keys(True, True):
        if spoilt[key].is_floating_point():
            spoilt[key][6:] = math.nan
            spoilt[key][8:] = math.inf
    mask = torch.arange(12) < 6
    spoilt[MASK] = mask.unsqueeze(-1) if trailing else mask

    def deterministic(batch):
        """The same noise for the real transitions, however many others there are."""
        with _SharedNoise():
            return loss(batch)

    expected, actual = deterministic(real), deterministic(spoilt)
    assert_close(actual, expected)
    assert_close(gradients(loss, total(actual)), gradients(loss, total(expected)))
    assert_close(spoilt["td_error"][:6], real["td_error"])
    assert (spoilt["td_error"][6:] == 0).all()

    each = case.build(value=value, **LEARNED, reduction="none")
    with _SharedNoise():
        outputs = each(spoilt)
    assert outputs.shape == (12,)
    for name, output in outputs.items():
        assert output.isfinite().all(), name
        if name in REACHES:
            assert (output[6:] == 0).all(), name
            mean = output[:6].sum() / (weights.sum() if weighted else 6)
            assert_close(mean, expected[name], msg=name)

    spoilt[MASK] = torch.zeros(12, dtype=torch.bool)
    nothing = loss(spoilt)
    assert total(nothing) == 0
    assert all((g == 0).all() for g in gradients(loss, total(nothing)).values())


class _SharedNoise:
    """Noise that depends on the place in the batch of six alone."""

    def __enter__(self):
        self.original = torch.distributions.Normal.rsample
        noise = torch.randn(16, 6, ACTION, generator=torch.Generator().manual_seed(0)).double()

        def rsample(normal, sample_shape=()):
            batch = normal.loc.shape[0]
            return normal.loc + normal.scale * noise[: sample_shape[0]].repeat(1, 2, 1)[:, :batch]

        torch.distributions.Normal.rsample = rsample

    def __exit__(self, *_):
        torch.distributions.Normal.rsample = self.original


@losses
def test_mask_can_be_ignored_or_renamed(case):
    """``loss_mask_key`` of TorchRL."""
    loss = case.build()
    batch = _batch(case)
    plain = call(loss, batch)
    batch[MASK] = torch.arange(6) < 3
    masked = call(loss, batch)
    assert not torch.allclose(masked["loss_qvalue"], plain["loss_qvalue"])
    loss.loss_mask_key = None
    assert_close(call(loss, batch), plain)
    loss.loss_mask_key = "valid"
    with pytest.raises(KeyError, match="'valid' is missing"):
        call(loss, batch)
    batch["valid"] = batch[MASK]
    assert_close(call(loss, batch), masked)


@losses
@with_and_without_value
@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_priority_weights(case, value, reduction):
    """The mean is a weighted one, metrics and the divergence that tau holds are not."""
    options = {"value": value, **LEARNED}
    batch = _batch(case)
    each = call(case.build(**options, reduction="none"), batch)
    weights = torch.linspace(0.5, 2.0, 6).double()
    batch["priority_weight"] = weights
    actual = call(case.build(**options, reduction=reduction), batch)
    for name, output in actual.items():
        if not name.startswith("loss_"):
            expected = each[name] if reduction == "none" else each[name].mean()
        elif reduction == "mean":
            expected = (weights * each[name]).sum() / weights.sum()
        else:
            expected = weights * each[name]
            expected = expected.sum() if reduction == "sum" else expected
        assert_close(output, expected, msg=name)
    unweighted = call(
        case.build(**options, reduction=reduction, use_prioritized_weights=False), batch
    )
    assert_close(unweighted, call(case.build(**options, reduction=reduction), _batch(case)))


# ------------------------------------------------------------------------------ value estimation


def _fixed_next_value(case, loss, batch, values):
    """Make the value of the next state known."""
    loss._next_state_value = lambda *_: values.to(batch["next", "reward"].dtype)
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


@losses
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
def test_value_estimators(case, estimator, options, lmbda):
    """Targets along trajectories ``[N, T]`` by the recursion that defines them."""
    batch = _batch(case, 2, 5)
    values = torch.randn(2, 5, generator=torch.Generator().manual_seed(3)).double()
    loss = _fixed_next_value(case, case.build(), batch, values)
    assert loss.make_value_estimator(estimator, gamma=GAMMA, **options) is loss
    actual = loss.double().soft_bellman_target(batch)
    for n in range(2):
        expected = _td_lambda(
            batch["next", "reward"][n, :, 0],
            values[n],
            batch["next", "done"][n, :, 0],
            batch["next", "terminated"][n, :, 0],
            lmbda,
        )
        assert_close(actual[n], expected)
    assert call(case.build(), batch)["loss_qvalue"].isfinite()


@losses
@pytest.mark.parametrize(
    "estimator", [ValueEstimators.GAE, ValueEstimators.VTrace, ValueEstimators.MAGAE], ids=str
)
def test_estimators_of_the_advantage_are_refused(case, estimator):
    """They need a value network of the policy."""
    with pytest.raises(NotImplementedError, match="not implemented for loss"):
        case.build().make_value_estimator(estimator)


@losses
@pytest.mark.parametrize(
    ("estimator", "options"),
    [(ValueEstimators.TD1, {}), (ValueEstimators.TDLambda, {"lmbda": 0.6})],
    ids=["td1", "td_lambda"],
)
def test_returns_end_with_what_is_real(case, estimator, options):
    """Targets of padded trajectories are those of the same without padding, also of cut ones."""
    batch = _batch(case, 3, 6)
    for key in ("done", "terminated"):
        batch["next", key].zero_()
    lengths = (4, 6, 1)
    values = torch.randn(3, 6, generator=torch.Generator().manual_seed(3)).double()
    mask = torch.arange(6) < torch.tensor(lengths).unsqueeze(-1)
    loss = _fixed_next_value(case, case.build().double(), batch, values)
    loss.make_value_estimator(estimator, gamma=GAMMA, **options)
    loss.double()
    padded = loss.soft_bellman_target(batch, mask)
    for n, length in enumerate(lengths):
        row = batch[n : n + 1, :length]
        _fixed_next_value(case, loss, row, values[n : n + 1, :length])
        assert_close(padded[n, :length], loss.soft_bellman_target(row)[0])


@losses
def test_value_estimators_that_are_no_use(case):
    """The loss has a soft value of its own, needs no more than that, and keeps what it had."""
    loss = case.build()
    before = loss.value_estimator
    network = ValueOperator(nn.Linear(OBSERVATION, 1), ["observation"])
    with pytest.raises(ValueError, match="TD0Estimator must have value_network=None"):
        loss.make_value_estimator(TD0Estimator(gamma=GAMMA, value_network=network))
    with pytest.raises(NotImplementedError, match=r"GAE is not implemented.*takes TD0Estimator"):
        loss.make_value_estimator(GAE(gamma=GAMMA, lmbda=0.9, value_network=None))
    with pytest.raises(NotImplementedError, match="GAE is not implemented"):
        loss.make_value_estimator(GAE, gamma=GAMMA, lmbda=0.9)
    assert loss.value_estimator is before


@losses
def test_value_estimator_of_the_users_reads_the_keys_of_the_loss(case):
    batch = _batch(case)
    expected = call(case.build(), batch)
    loss = case.build()
    loss.set_keys(reward="r")
    batch["next"].rename_key_("reward", "r")
    loss.make_value_estimator(TD0Estimator, gamma=GAMMA, value_network=None)
    assert_close(call(loss.double(), batch), expected)


@losses
def test_value_estimator_of_the_users(case):
    """An instance or a class is taken as it is."""
    loss, batch = case.build(), _batch(case)
    expected = call(loss, batch)
    own = TD0Estimator(gamma=GAMMA, value_network=None).double()
    assert loss.make_value_estimator(own) is loss
    assert loss.value_estimator is own
    assert_close(call(loss, batch), expected)
    assert loss.make_value_estimator(TD0Estimator, gamma=GAMMA, value_network=None) is loss
    assert_close(call(loss.double(), batch), expected)


@losses
@pytest.mark.parametrize("n", [1, 3])
def test_n_step_returns(case, n):
    """Of TorchRL's transform: the discount of the value is gamma to the number of steps."""
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(10),
        transform=MultiStepTransform(n_steps=n, gamma=GAMMA),
        batch_size=4,
    )
    trajectory = _batch(case, 8)
    trajectory["next", "done"].zero_()
    trajectory["next", "terminated"].zero_()
    buffer.extend(trajectory)
    stored = buffer[:].exclude("index")
    assert (stored["steps_to_next_obs"] == n).all()
    values = torch.arange(1.0, len(stored) + 1).double()
    loss = case.build(value=True)
    plain = call(loss, stored.clone())
    _fixed_next_value(case, loss, stored, values)
    expected = stored["next", "reward"].squeeze(-1) + GAMMA**n * values
    # The transform discounts in float32.
    assert_close(loss.soft_bellman_target(stored), expected, rtol=1e-5, atol=1e-6)
    one_step = call(case.build(value=True), stored.exclude("steps_to_next_obs"))
    assert torch.allclose(plain["loss_qvalue"], one_step["loss_qvalue"]) is (n == 1)


@losses
@with_and_without_value
def test_nothing_is_expected_after_a_terminated_state(case, value):
    """Whatever stands there; after a time limit the value counts."""
    loss = case.build(value=value)
    batch = _batch(case)
    expected = call(loss, batch)
    batch["next", "observation"][1] = math.nan
    actual = call(loss, batch)
    assert_close(actual, expected)
    assert_close(gradients(loss, total(actual)), gradients(loss, total(expected)))
    target = loss.soft_bellman_target(batch)
    reward = batch["next", "reward"].squeeze(-1)
    assert target[1] == reward[1]
    assert target[2] != reward[2]


@losses
@with_and_without_value
def test_skip_done_states(case, value):
    """Next states of time limits too are not looked at; the others are as before."""
    batch = _batch(case)
    expected = call(case.build(value=value, reduction="none"), batch)
    loss = case.build(value=value, reduction="none", skip_done_states=True)
    target = loss.soft_bellman_target(batch)
    assert_close(target[1:3], batch["next", "reward"][1:3, 0])
    batch["next", "observation"][1:3] = math.nan
    actual = call(loss, batch)
    others = [0, 1, 3, 4, 5]
    assert_close(actual["loss_qvalue"][others], expected["loss_qvalue"][others])
    assert actual["loss_qvalue"].isfinite().all()
    with pytest.raises(ValueError, match="target of the soft Q value is NaN or infinite in 1 of 6"):
        case.build(value=value)(batch)


@losses
def test_skipped_states_keep_their_dtype(case):
    """Integer observations, such as pixels or tokens, stay integers."""
    networks = make_networks(case.kind)
    networks.actor[0].module.insert(0, nn.Embedding(10, OBSERVATION).double())  # type: ignore
    for qvalue in networks.qvalues:
        qvalue.module = _Embedded(nn.Embedding(10, OBSERVATION).double(), qvalue.module)
    loss = case.build(networks, skip_done_states=True)
    batch = _batch(case)
    batch["observation"] = torch.randint(10, (6,))
    batch["next", "observation"] = torch.randint(10, (6,))
    assert call(loss, batch)["loss_qvalue"].isfinite()


class _Embedded(nn.Module):
    def __init__(self, table, network) -> None:
        super().__init__()
        self.table, self.network = table, network

    def forward(self, token, *rest):
        return self.network(self.table(token), *rest)


# ------------------------------------------------------------------------------- num_actor_states


@losses
@with_and_without_value
@pytest.mark.parametrize("n", [1, 4, 100])
def test_num_actor_states(case, value, n):
    """All but the Q networks learn from the first n states; Q learns from all."""
    options = {"value": value, "delay_actor": False, **LEARNED}
    batch = _batch(case)
    with _SharedNoise():
        actual = case.build(**options, num_actor_states=n)(batch)
        whole = case.build(**options)(batch)
        first = case.build(**options)(batch[:n].clone())
    assert_close(actual["loss_qvalue"], whole["loss_qvalue"])
    assert_close(actual.exclude("loss_qvalue"), first.exclude("loss_qvalue"))
    assert batch["td_error"].shape == (6,)


# ------------------------------------------------------------------------------------ temperatures


@losses
def test_temperatures_are_scheduled_by_assignment(case):
    """loss.tau = x writes into the buffer: same tensor, dtype and place; the next call uses it."""
    loss, *_ = _trained(case, value=True, delay_actor=True)
    batch = _batch(case)
    for name in ("tau", "tau_prime"):
        before = call(loss, batch)["loss_actor"]
        buffer = getattr(loss, name)
        setattr(loss, name, 2)
        assert getattr(loss, name) is buffer
        assert dict(loss.named_buffers())[name] is buffer
        assert (buffer.item(), buffer.dtype, buffer.shape) == (2.0, torch.float64, torch.Size([]))
        outputs = call(loss, batch)
        assert not torch.allclose(outputs["loss_actor"], before)
        assert outputs[name] == 2.0
    scheduler = TemperatureScheduler(loss, tau_prime=linear(0.5, 0.0, 10))
    assert loss.tau_prime == 0.5
    scheduler.step(5)
    assert loss.tau_prime == 0.25
    scheduler.step(5)
    assert loss.tau_prime == 0.0
    assert call(loss, batch)["loss_actor"].isfinite()


BAD = [-0.1, math.nan, math.inf, torch.tensor(-1.0), torch.tensor(math.nan)]


@losses
@pytest.mark.parametrize("name", ["tau", "tau_prime"])
@pytest.mark.parametrize("bad", BAD, ids=str)
def test_bad_temperatures_are_refused(case, name, bad):
    """At the door and when they are set: then the old one stays."""
    message = f"{name} must be a finite number >= 0, got"
    with pytest.raises(ValueError, match=message):
        case.build(**{name: bad})
    loss = case.build()
    with pytest.raises(ValueError, match=message):
        setattr(loss, name, bad)
    assert getattr(loss, name).item() == getattr(case, name)
    assert isinstance(dict(loss.named_buffers())[name], torch.Tensor)


@losses
def test_some_regularisation_there_must_be(case):
    """One of two temperatures may be 0; not both, also where one is scheduled."""
    for zero, other in (("tau", "tau_prime"), ("tau_prime", "tau")):
        loss = case.build(**{zero: 0.0})
        assert call(loss, _batch(case))["loss_actor"].isfinite()
        message = r"tau \+ tau_prime must be positive, got 0.*Set a temperature above 0"
        with pytest.raises(ValueError, match=message):
            setattr(loss, other, 0.0)
        assert getattr(loss, other).item() == getattr(case, other)
        with pytest.raises(ValueError, match=message):
            case.build(tau=0.0, tau_prime=0.0)
    loss = case.build(target_entropy=-1.0)  # tau_prime is learned, so positive
    loss.tau = 0
    assert call(loss, _batch(case))["tau"] == 0
    with pytest.raises(ValueError, match="tau must be a finite number"):
        loss.tau = -1.0


@losses
@pytest.mark.parametrize(
    ("name", "option", "value"),
    [("tau", "target_kl", 0.05), ("tau_prime", "target_entropy", -1.5)],
)
def test_learned_temperature(case, name, option, value):
    """A parameter in log-space, whose loss is the dual's; it cannot be assigned."""
    loss = case.build(**{option: value})
    assert dict(loss.named_parameters())[f"log_{name}"].shape == ()
    assert name not in dict(loss.named_buffers())
    outputs = call(loss, _batch(case))
    assert_close(outputs[name].item(), getattr(case, name))
    with pytest.raises(AttributeError, match=f"{name} is learned.*without {option}"):
        setattr(loss, name, 0.5)
    with pytest.raises(AttributeError, match=f"{name} is learned"):
        TemperatureScheduler(loss, **{name: linear(1.0, 0.0, 10)})
    assert_close(call(loss, _batch(case)), outputs)
    loss.load_state_dict(loss.state_dict(), strict=True)
    with torch.no_grad():
        getattr(loss, f"log_{name}").add_(math.log(2))
    assert_close(call(loss, _batch(case))[name].item(), 2 * getattr(case, name))


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
    """-log tau' (target entropy - entropy): SAC's, up where entropy is short."""
    batch = _batch(case)
    entropy = call(case.build(), batch)["entropy"].item()
    for excess in (0.3, -0.4):
        loss = case.build(target_entropy=entropy + excess)
        value = call(loss, batch)["loss_tau_prime"]
        assert_close(value.item(), -math.log(case.tau_prime) * excess)
        assert_close(gradients(loss, value)["log_tau_prime"].item(), -excess)


@losses
def test_target_entropy_auto(case):
    """SAC's: minus the number of action dimensions, 0.98 log n of discrete ones."""
    expected = 0.98 * math.log(CHOICES) if case.is_discrete else -float(ACTION)
    batch = _batch(case)
    auto = call(case.build(target_entropy="auto"), batch)
    assert_close(auto, call(case.build(target_entropy=expected), batch))


@losses
@pytest.mark.parametrize(
    ("name", "option", "far_above", "far_below"),
    [("tau", "target_kl", 1e-9, 0.3), ("tau_prime", "target_entropy", 9.0, -9.0)],
)
def test_learned_temperatures_stop_at_their_floor(case, name, option, far_above, far_below):
    """However far below the parameter may be: it is sent up from there, and down no further."""
    floor, batch = 0.125, _batch(case)
    for value in (far_above, far_below):
        loss = case.build(**{option: value, f"min_{name}": floor, name: 0.25})
        log = getattr(loss, f"log_{name}")
        for start, reads in ((0.25, 0.25), (0.125, 0.125), (1e-9, 0.125)):
            log.data.fill_(math.log(start))
            outputs = call(loss, batch)
            assert_close(outputs[name].item(), reads)
            gradient = gradients(loss, outputs[f"loss_{name}"])[f"log_{name}"]
            if value == far_above:
                assert gradient < 0
            else:
                assert (gradient > 0) == (start > floor)
        log.data.fill_(math.log(0.25))
        for _ in range(20):
            log.data.sub_(0.1 * gradients(loss, total(call(loss, batch)))[f"log_{name}"].sign())
        if value == far_below:
            assert math.log(floor) - 0.1 < log.item() <= math.log(floor)
        else:
            assert log.item() > math.log(0.25)


@losses
@pytest.mark.parametrize(
    ("name", "option"), [("tau", "target_kl"), ("tau_prime", "target_entropy")]
)
@pytest.mark.parametrize(("start", "least"), [(0.1, 0.125), (0.1, 0.0), (0.1, -1.0)])
def test_floors_are_checked_at_the_door(case, name, option, start, least):
    with pytest.raises(ValueError, match=f"learned {name} must start at min_{name} > 0"):
        case.build(**{option: 0.1, name: start, f"min_{name}": least})


@every_loss
def test_learned_temperatures_settle_where_the_constraints_hold(case):
    """Gradient descent on the two losses alone, with the networks as they are."""
    size = 1 if case.is_discrete else ACTION
    networks = make_networks(case.kind)
    for qvalue in networks.qvalues:
        for parameter in qvalue.parameters():
            parameter.data.mul_(2.0)
    options = {} if case.is_discrete else {"num_action_samples": 32}
    loss = case.build(networks, target_kl=0.05 / size, **options)
    batch = _batch(case, 64)
    for step in range(60):
        gradient = gradients(loss, call(loss, batch)["loss_tau"])["log_tau"]
        loss.log_tau.data.sub_(0.5 * 0.95**step * gradient)
    assert call(loss, batch)["kl_target_reference"].item() == pytest.approx(0.05, rel=1e-2)


# --------------------------------------------------------------------------------------- bad input


@losses
def test_q_network_of_another_kind(case):
    """At the door: one of one action needs a policy to sample, one of all a policy over n."""
    networks = make_networks(case.kind)
    networks.actor = make_networks("tanh_normal" if case.is_discrete else "categorical").actor
    own, says = ("actions with rsample", "read") if case.is_discrete else ("one of n", "write")
    with pytest.raises(ValueError, match=f"For a policy over {own}.* qvalue_network must {says}"):
        case.build(networks)


@losses
def test_policies_of_neither_kind(case):
    """Several coins are not one of n actions, and cannot be drawn by rsample either."""
    network = TensorDictModule(nn.Linear(OBSERVATION, CHOICES), ["observation"], ["logits"])
    coins = ProbabilisticActor(network, ["logits"], distribution_class=Bernoulli).double()
    networks = make_networks(case.kind)
    for networks.actor, name in ((coins, "Bernoulli"), (make_actor("composite"), "Composite")):
        with pytest.raises(ValueError, match=f"got {name}|For a policy over"):
            case.build(networks)(_batch(case))


@losses
def test_entries_of_the_wrong_shape(case):
    """Named, before anything broadcasts."""
    loss = case.build()
    batch = _batch(case)
    batch["next", "reward"] = batch["next", "reward"].squeeze(-1)
    with pytest.raises(ValueError, match=r"'reward'\) must have the shape \[\*B, 1\], got \(6,\)"):
        loss(batch)
    for name in ("done", "terminated"):
        batch = _batch(case)
        batch["next", name] = batch["next", name].squeeze(-1)
        message = rf"{name}'\) must have the shape \(6, 1\) of the reward, got \(6,\)"
        with pytest.raises(ValueError, match=message):
            loss(batch)


@losses
@with_and_without_value
def test_networks_that_write_another_entry(case, value):
    """TorchRL's ``ValueOperator`` does so, where the action has another name than "action"."""
    networks = make_networks(case.kind)
    changed = networks.value if value else networks.qvalues[1]
    key, name = (
        changed.out_keys[0],
        "value" if value else ("action_value" if case.is_discrete else "state_action_value"),
    )
    for network in [networks.value] if value else networks.qvalues:
        network.out_keys[0] = "v"
        network.module.out_keys = ["v"] if hasattr(network, "module") else None
    loss = case.build(networks, value=value)
    with pytest.raises(KeyError, match=rf"writes \['v'\], not '{key}'.*set_keys\({name}=...\)"):
        loss(_batch(case))
    loss.set_keys(**{name: "v"})
    assert loss(_batch(case))["loss_qvalue"].isfinite()


def test_log_probabilities_and_values_that_do_not_match():
    networks = make_networks("tanh_normal")
    network = TensorDictModule(
        nn.Sequential(nn.Linear(OBSERVATION, 2 * ACTION), NormalParamExtractor()),
        ["observation"],
        ["loc", "scale"],
    )
    networks.actor = ProbabilisticActor(network, ["loc", "scale"], distribution_class=Normal)
    networks.actor.double()
    case = CASES["ecac"]
    message = r"values.*shape \(1, 6\), their log-probabilities \(1, 6, 2\).*Independent"
    with pytest.raises(ValueError, match=message):
        case.build(networks, projection="paper")(_batch(case))
    networks = make_networks("tanh_normal")
    two = MLP(in_features=OBSERVATION + ACTION, out_features=2, num_cells=[5])
    networks.qvalues = ValueOperator(two, ["observation", "action"]).double()
    with pytest.raises(ValueError, match=r"one number, .*but the Q network writes 2"):
        case.build(networks)(_batch(case))


@losses
def test_actor_without_a_distribution(case):
    networks = make_networks(case.kind)
    networks.actor = networks.actor[0]
    with pytest.raises(TypeError, match="actor_network must have a get_dist method"):
        case.build(networks)


@losses
@pytest.mark.parametrize(("copies", "number"), [(1, 1), (1, 2), (2, 3), ("same", 2)])
def test_lists_of_q_networks(case, copies, number):
    """TorchRL would leave one network, or the same one twice, untrained."""
    networks = make_networks(case.kind)
    networks.qvalues = networks.qvalues[:1] * 2 if copies == "same" else networks.qvalues[:copies]
    with pytest.raises(ValueError, match=f"must hold num_qvalue_nets={number} different ones"):
        case.build(networks, num_qvalue_nets=number)
    networks.qvalues = networks.qvalues[0]
    loss = case.build(networks, num_qvalue_nets=number)
    trained = gradients(loss, call(loss, _batch(case))["loss_qvalue"])
    assert all(g.shape[0] == number for name, g in trained.items() if "qvalue" in name)
    assert any(g.abs().max() > 0 for name, g in trained.items() if "qvalue" in name)


@losses
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"reduction": "bogus"}, r"reduction must be one of \('none', 'mean', 'sum'\).*'bogus'"),
        ({"loss_function": "huber"}, r"loss_function must be one of \('l2',.*got 'huber'"),
        ({"num_actor_states": 0}, "num_actor_states must be an integer of at least 1, got 0"),
        ({"num_actor_states": 2.5}, "num_actor_states must be an integer of at least 1, got 2.5"),
        ({"num_qvalue_nets": True}, "num_qvalue_nets must be an integer of at least 1, got True"),
        ({"use_prioritized_weights": "yes"}, "use_prioritized_weights must be.*got 'yes'"),
        ({"target_kl": "a"}, "target_kl must be a number, got 'a'"),
        ({"target_entropy": [1.0]}, r"target_entropy must be a number, got \[1.0\]"),
        ({"num_actor_states": 3, "reduction": "none"}, "num_actor_states must be None.*got 3"),
        ({"target_kl": 0.0}, "target_kl must be above 0, in nats, or None, got 0.0"),
        ({"target_kl": -1.0}, "target_kl must be above 0"),
        ({"target_kl": math.nan}, "target_kl must be above 0.*got nan"),
        ({"target_kl": math.inf}, "target_kl must be above 0.*got inf"),
        ({"target_entropy": "car"}, r"target_entropy must be one of \('auto',\), got 'car'"),
        ({"target_entropy": math.nan}, "target_entropy must be.*finite.*got nan"),
        ({"num_qvalue_nets": 0}, "num_qvalue_nets must be an integer of at least 1, got 0"),
        ({"value": True, "delay_qvalue": True}, "With a value_network.*delay_qvalue=None.*True"),
    ],
    ids=str,
)
def test_options_are_checked_at_the_door(case, options, message):
    with pytest.raises(ValueError, match=message):
        case.build(**options)


@losses
@pytest.mark.parametrize("name", ["tau", "tau_prime"])
@pytest.mark.parametrize("value", ["a", None, torch.ones(2)], ids=["string", "none", "two"])
def test_temperatures_must_be_numbers(case, name, value):
    """Given to the constructor or assigned; the old one stays."""
    message = f"{name} must be a number, got ('a'|None|tensor)"
    with pytest.raises(ValueError, match=message):
        case.build(**{name: value})
    loss = case.build()
    with pytest.raises(ValueError, match=message):
        setattr(loss, name, value)
    assert getattr(loss, name).item() == getattr(case, name)


@losses
@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (torch.ones(5, dtype=torch.bool), r"must have the shape \(6,\).*got \(5,\)"),
        (torch.ones(6), "must be boolean.*got torch.float32"),
    ],
    ids=["shape", "dtype"],
)
def test_wrong_masks(case, mask, message):
    batch = TensorDict(_batch(case).to_dict()).set(MASK, mask)
    with pytest.raises(ValueError, match=rf"The mask \('collector', 'mask'\) {message}"):
        case.build()(batch)


@continuous
@pytest.mark.parametrize("name", ["num_action_samples", "num_next_action_samples"])
@pytest.mark.parametrize("value", [0, -1, 2.5, None])
def test_number_of_samples_is_checked_at_the_door(case, name, value):
    least = "1"
    if case.loss is ECACLoss and name == "num_action_samples":
        least = "2: weights are relative to those of the other actions"
    message = f"{name} must be an integer of at least {least}, got {value}"
    with pytest.raises(ValueError, match=message):
        case.build(**{name: value})


def test_one_sample_has_all_the_weight():
    """It would be imitated, whatever its soft Q."""
    with pytest.raises(
        ValueError, match=r"num_action_samples.*at least 2: weights are relative.* 1"
    ):
        CASES["ecac"].build(num_action_samples=1)
    assert CASES["pmd_ac"].build(num_action_samples=1)


@continuous
def test_a_target_kl_that_the_samples_cannot_show(case):
    """log M, at the first call; per action dimension."""
    loss = case.build(target_kl=0.7, num_action_samples=4)
    with pytest.raises(ValueError, match=r"by 1\.4 nats.*log 4 = 1\.39.*lower"):
        call(loss, _batch(case))
    call(case.build(target_kl=0.69, num_action_samples=4), _batch(case))


@losses
@pytest.mark.parametrize(
    ("key", "message"),
    [
        (("next", "reward"), r"The reward \('next', 'reward'\) is NaN or infinite in 1 of 6"),
        (("next", "observation"), "The target of the soft Q value is NaN or infinite in 1 of 6"),
        (("observation",), "(soft Q value|policy) is NaN or infinite"),
    ],
    ids=str,
)
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_values_that_are_not_finite(case, key, message, bad):
    """The entry is named, and nothing is written."""
    batch = _batch(case)
    batch[key][4] = bad
    with pytest.raises(ValueError, match=message):
        case.build(value=True)(batch)
    assert batch.get("td_error", None) is None


@losses
def test_networks_that_have_diverged(case):
    networks = make_networks(case.kind)
    networks.qvalues[1].module[-1].bias.data.fill_(math.nan)  # type: ignore
    with pytest.raises(ValueError, match=r"is NaN or infinite in \d+ of \d+ places. Mend"):
        case.build(networks)(_batch(case))


@losses
@with_and_without_value
@pytest.mark.parametrize(
    "key",
    [
        "observation",
        "action",
        ("next", "observation"),
        ("next", "reward"),
        ("next", "done"),
        ("next", "terminated"),
    ],
    ids=str,
)
def test_missing_entries_are_named(case, value, key):
    """With a tensordict and without one."""
    loss, batch = case.build(value=value), _batch(case)
    name = r"\('next', '" + key[1] + r"'\)" if isinstance(key, tuple) else f"'{key}'"
    with pytest.raises(KeyError, match=f"{name} is missing"):
        loss(batch.exclude(key))
    keywords = as_keywords(loss, batch)
    del keywords["_".join(key) if isinstance(key, tuple) else key]
    with pytest.raises(KeyError, match=f"{name} is missing"):
        loss(**keywords)


@pytest.mark.parametrize("name", ["discrete_ecac", "discrete_pmd_ac"])
@pytest.mark.parametrize(
    "action",
    [torch.zeros(6, CHOICES + 1), torch.zeros(6, 2).long(), torch.rand(6), torch.zeros(6, 6, 1)],
    ids=lambda action: str(tuple(action.shape)),
)
def test_wrong_shape_of_a_discrete_action(name, action):
    case = CASES[name]
    batch = _batch(case).set("action", action)
    with pytest.raises(ValueError, match=r"must be one-hot of shape \(6, 4\) or an integer"):
        case.build()(batch)


# --------------------------------------------------------------------------------------- extremes


@every_loss
@with_and_without_value
@pytest.mark.parametrize("scale", [1e6, -1e6])
def test_extremes_stay_finite(case, value, scale, dtype):
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


@continuous
def test_saturated_actions(case, dtype):
    """Where tanh is 1 to the last digit the log-probability is still that of the latent."""
    networks = make_networks(case.kind, dtype=dtype)
    networks.actor[0].module[0].bias.data[:ACTION] = 40.0  # type: ignore
    loss = case.build(networks, delay_actor=True)
    outputs = call(loss, _batch(case, dtype=dtype))
    assert outputs["saturation"] == 1.0
    assert all(output.isfinite() for output in outputs.values())
    # -log of (1 - tanh^2) at 40 is about 80 - log 4, in each of two dimensions
    assert -200 < outputs["entropy"] < -100
    assert all(g.isfinite().all() for g in gradients(loss, total(outputs)).values())


def _dense_case(**options):
    """ECACLoss with the package's networks, wide enough for what makes them fast."""
    torch.manual_seed(0)
    spec = Bounded(-1.0, 1.0, shape=(2,))
    actor = make_tanh_gaussian_actor(40, spec, hidden_sizes=[40])
    qvalue = make_qvalue_network(40, 2, hidden_sizes=[40])
    loss = ECACLoss(actor, options.pop("wrap", lambda network: network)(qvalue), **options)
    SoftUpdate(loss, tau=0.1)
    never = torch.zeros(50, 1, dtype=torch.bool)
    batch = TensorDict(
        observation=torch.randn(50, 40),
        action=torch.rand(50, 2),
        next={
            "observation": torch.randn(50, 40),
            "reward": torch.randn(50, 1),
            "done": never,
            "terminated": never.clone(),
        },
        batch_size=[50],
    )
    return loss, batch


def test_a_wrapped_network_is_not_taken_for_what_it_wraps():
    values = []
    for wrap in (lambda network: network, TensorDictModuleWrapper):
        loss, batch = _dense_case(wrap=wrap)
        for parameter in loss.qvalue_network_params.values(True, True):
            parameter.data.fill_(0.01)
        SoftUpdate(loss, tau=0.1)
        torch.manual_seed(1)
        values.append(loss(batch)["qvalue"])
    assert_close(*values)


def test_the_first_states_of_a_single_transition_are_refused():
    loss, batch = _dense_case(num_actor_states=4)
    with pytest.raises(ValueError, match="num_actor_states=4 takes the first of a batch"):
        loss(batch[0])


# ----------------------------------------------------------------------------------------- compile


def compiler_warnings(test):
    """Tensordict and torch warn of their own ways into the compiler."""
    for category in ("FutureWarning", "DeprecationWarning"):
        test = pytest.mark.filterwarnings(f"ignore::{category}")(test)
    return test


def _assert_compiled_is_eager(case, backend, **options):
    """Same numbers and gradients, without a graph break, temperatures scheduled or learned."""
    torch._dynamo.reset()
    loss, *_ = _trained(case, **options)
    batch = _batch(case)

    def update(batch):
        outputs = loss(batch)
        return outputs, total(outputs)

    compiled = torch.compile(update, fullgraph=True, backend=backend)
    for step in range(2):
        torch.manual_seed(step)
        expected, value = update(batch)
        torch.manual_seed(step)
        actual, compiled_value = compiled(batch)
        assert list(actual.keys()) == list(expected.keys())
        assert_close(actual, expected)
        assert_close(gradients(loss, compiled_value), gradients(loss, value))
        if "target_kl" not in options:
            loss.tau = 0.5
        torch._dynamo.config.error_on_recompile = True


ALL = {"value": True, "delay_actor": True, **LEARNED}


@pytest.mark.parametrize(
    ("name", "options"),
    [("ecac", LEARNED), ("pmd_ac", {}), ("discrete_ecac", ALL)],
    ids=["ecac-learned", "pmd_ac-scheduled", "discrete_ecac-all"],
)
@compiler_warnings
def test_compile(name, options):
    with torch._dynamo.config.patch(error_on_recompile=False):
        _assert_compiled_is_eager(CASES[name], "eager", **options)


@compiler_warnings
def test_compile_with_dense_networks():
    torch._dynamo.reset()
    loss, batch = _dense_case(num_actor_states=40)
    compiled = torch.compile(loss, fullgraph=True, backend="eager")
    outputs = []
    for update in (loss, compiled):
        torch.manual_seed(1)
        outputs.append(update(batch.copy()))
    assert_close(*outputs)


@pytest.mark.slow
@every_loss
@pytest.mark.parametrize("options", [{}, ALL], ids=["scheduled", "all"])
@pytest.mark.parametrize("backend", ["eager", "aot_eager", "inductor"])
@compiler_warnings
def test_compile_with_other_backends(case, backend, options):
    """Inductor is the one that generates code; told to, it draws the same random numbers."""
    with (
        torch._dynamo.config.patch(error_on_recompile=False),
        torch._inductor.config.patch(fallback_random=True),
    ):
        _assert_compiled_is_eager(case, backend, **options)
