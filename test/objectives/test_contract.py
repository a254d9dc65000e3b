"""What TorchRL asks of a LossModule, asked of every group loss."""

from __future__ import annotations

import inspect
import pickle
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict, TensorDictParams
from tensordict.nn import (
    TensorDictModule,
    set_composite_lp_aggregate,
)
from torch.distributions import Categorical
from torch.testing import assert_close
from torchrl.envs.utils import ExplorationType, exploration_type, set_exploration_type
from torchrl.modules import ProbabilisticActor, set_recurrent_mode
from torchrl.modules.tensordict_module.rnn import recurrent_mode
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate, ValueEstimators
from trajectory_problems import (
    ACTOR_KEYS,
    CASES,
    DELAYED,
    MASK,
    as_keywords,
    gradients,
    make_actor,
    move,
    pad,
    sample,
)

ECPO = CASES["ecpo"]  # of which is asked what stands once in the base class
losses = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
KINDS = ("categorical", "composite", "lstm")
kinds = pytest.mark.parametrize("kind", KINDS)
OUT_KEYS = [
    "loss_actor",
    "ESS",
    "max_weight",
    "kl_reference_policy",
    "entropy",
    "return",
    "equal_return_groups",
]


def out_keys(case):
    """In this order."""
    cut = ["clip_fraction"] if case is CASES["grpo"] else []
    return [*OUT_KEYS[:3], *cut, *OUT_KEYS[3:]]


def build(case=ECPO, kind="categorical"):
    """A loss with a delayed reference policy where the loss can have one, and an updater."""
    delayed = case in [CASES[name] for name in DELAYED]
    loss = case.build(make_actor(kind), **({"delay_actor": True} if delayed else {}))
    loss.set_keys(**ACTOR_KEYS.get(kind, {}))
    if delayed:
        SoftUpdate(loss, eps=0.9)
    return loss


# -------------------------------------------------------------------------------------------- keys

RENAMED = {
    "flat": {"action": "deed", "reward": "prize", "sample_log_prob": "log_prob"},
    "nested": {
        "action": ("agents", "deed"),
        "reward": ("agents", "the_prize"),
        "sample_log_prob": ("agents", "log_prob"),
    },
}
DEFAULTS = {"action": "action", "reward": "reward", "sample_log_prob": "action_log_prob"}


def _at(field, key):
    """Where the entry of a field is."""
    if field != "reward":
        return key
    return ("next", *((key,) if isinstance(key, str) else key))


def _rename(batch, keys):
    renamed = batch.exclude(*(_at(f, DEFAULTS[f]) for f in keys))
    for name, key in keys.items():
        renamed[_at(name, key)] = batch[_at(name, DEFAULTS[name])]
    return renamed


@losses
def test_default_keys(case):
    """As documented, in this order: with sets it would depend on the seed of the hashes."""
    loss = build(case)
    assert {f: getattr(loss.tensor_keys, f) for f in DEFAULTS} == DEFAULTS
    rest = ["action", ("next", "reward"), "action_log_prob", MASK, "shifted_valid"]
    rest += [("next", "done"), "group", "steps_to_next_obs"]
    assert loss.in_keys == ["observation", *rest]
    recurrent = ["observation", "recurrent_state_h", "recurrent_state_c", "is_init"]
    assert build(case, "lstm").in_keys == [*recurrent, *rest]
    assert loss.out_keys == out_keys(case)
    with set_composite_lp_aggregate(True):
        assert build(case).tensor_keys.sample_log_prob == "sample_log_prob"


@pytest.mark.parametrize("names", RENAMED)
@pytest.mark.parametrize(
    "fields", [["action"], ["reward"], ["sample_log_prob"], [*DEFAULTS]], ids=str
)
def test_set_keys(names, fields):
    """Every field, one at a time and all at once; None restores the default."""
    batch = pad(sample(make_actor(), 2, 3, 4))
    loss, other = build(), build()
    expected, default = loss(batch), loss.in_keys
    keys = {name: RENAMED[names][name] for name in fields}
    assert loss.set_keys(**keys) is None
    assert [getattr(loss.tensor_keys, name) for name in fields] == list(keys.values())
    assert {_at(name, key) for name, key in keys.items()} <= set(loss.in_keys)
    assert_close(loss(_rename(batch, keys)), expected)
    assert len(loss(**as_keywords(loss, _rename(batch, keys)))) == len(OUT_KEYS)
    assert other.in_keys == default  # the keys of one loss are its own
    loss.in_keys = ["observation"]  # the property has a setter, as TorchRL's have
    assert loss.in_keys == ["observation"]
    loss.set_keys(**dict.fromkeys(fields))
    assert loss.in_keys == default
    assert_close(loss(batch), expected)
    with pytest.raises(ValueError, match="value is not an accepted tensordict key"):
        loss.set_keys(value="value")


@kinds
@pytest.mark.parametrize("padded", [False, True], ids=["whole", "padded"])
def test_call_without_tensordict(kind, padded):
    """Keywords are the in_keys joined by _, the tuple is in the order of out_keys."""
    batch = sample(make_actor(kind), 2, 3, 4)
    batch = pad(batch) if padded else batch
    loss = build(kind=kind)
    expected = loss(batch)
    keywords = as_keywords(loss, batch)
    assert ("collector_mask" in keywords) is padded
    values = loss(**keywords)
    assert len(values) == len(OUT_KEYS)
    for name, value in zip(loss.out_keys, values, strict=True):
        assert_close(value, expected[name], msg=name)
    del keywords["next_reward"]
    with pytest.raises(KeyError, match=r"\('next', 'reward'\) is missing"):
        loss(**keywords)


def test_select_out_keys():
    """One, two, all."""
    batch = sample(make_actor(), 2, 3, 4)
    loss = build()
    expected = loss(batch)
    loss.select_out_keys("loss_actor")
    assert list(loss(batch).keys()) == ["loss_actor"]
    assert_close(loss(**as_keywords(loss, batch)), expected["loss_actor"])
    assert loss.reset_out_keys() is loss
    assert loss.select_out_keys("return", "loss_actor") is loss
    assert list(loss(batch).keys()) == ["return", "loss_actor"]
    mean_return, value = loss(**as_keywords(loss, batch))
    assert_close(value, expected["loss_actor"])
    assert_close(mean_return, expected["return"])
    loss.reset_out_keys()
    assert loss.out_keys == OUT_KEYS
    assert_close(loss(batch), expected)
    assert build().out_keys == OUT_KEYS
    for unknown in (["bogus"], ["loss_actor", "bogus"], []):
        with pytest.raises(ValueError, match=r"out_keys \['loss_actor'.*got"):
            loss.select_out_keys(*unknown)


@kinds
@pytest.mark.parametrize("shape", [(3, 4), (2, 3, 4)], ids=str)
def test_input_is_untouched(kind, shape):
    """No new entry, no changed value, at any depth; also not where the actor would write."""
    actor = make_actor(kind)
    batch = pad(sample(actor, *shape))
    with set_recurrent_mode(True), torch.no_grad():
        batch.update(actor.get_dist_params(batch.clone()))
    for batch_size in (shape, shape[:1], ()):
        given = TensorDict(batch.to_dict(), batch_size=batch_size)
        before = given.clone()
        build(kind=kind)(given)
        assert set(given.keys(True)) == set(before.keys(True))
        assert_close(given, before, equal_nan=True, rtol=0, atol=0)
        for key in given.keys(True):
            assert given.get(key).shape == before.get(key).shape, key


# -------------------------------------------------------------------------------------- the module


@pytest.mark.parametrize(
    ("name", "kind"),
    [*((name, KINDS[0]) for name in CASES), *(("ecpo", kind) for kind in KINDS[1:])],
)
def test_every_parameter_gets_a_gradient_and_no_target_does(name, kind):
    """And nothing is listed twice."""
    loss = build(CASES[name], kind)
    move(loss.actor_network)
    loss(sample(make_actor(kind), 2, 3, 4))["loss_actor"].backward()
    names = [name for name, _ in loss.named_parameters()]
    assert names
    assert not any("target" in name for name in names)
    for name, parameter in loss.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.norm() > 0, name
    tensors = [*loss.parameters(), *loss.buffers()]
    assert len({id(t) for t in tensors}) == len(tensors)
    for target in loss.target_actor_network_params.values(True, True):
        assert not target.requires_grad
        assert target.grad is None


def _pickled(loss):
    """As a loss is sent to another process."""
    return pickle.loads(pickle.dumps(loss))


def _restored(loss):
    """Strict, into a loss built alike."""
    fresh = build(next(case for case in CASES.values() if type(loss) is case.loss))
    fresh.load_state_dict(loss.state_dict(), strict=True)
    return fresh


@losses
@pytest.mark.parametrize("copy", [deepcopy, _pickled, _restored])
def test_copies(case, copy):
    """The same numbers: parameters, targets, temperatures; and nothing is shared."""
    loss, batch = build(case), sample(make_actor(), 2, 3, 4)
    first = loss(batch)
    entries = set(loss.state_dict())
    assert set(case.temperatures) <= entries
    move(loss.actor_network)
    for name in case.temperatures:
        setattr(loss, name, 0.123)
    expected = loss(batch)
    assert not torch.allclose(first["loss_actor"], expected["loss_actor"])
    copied = copy(loss)
    assert_close(copied(batch), expected)
    assert set(loss.state_dict()) == entries  # also after a forward
    tensors = {t.data_ptr() for t in [*loss.parameters(), *loss.buffers()]}
    assert not tensors & {t.data_ptr() for t in [*copied.parameters(), *copied.buffers()]}
    copied.tau = 0.01
    copied.set_keys(action="deed")
    copied.actor_network_params.data.mul_(2.0)
    assert_close(loss(batch), expected)


def test_parameters():
    """Those of the actor that was passed in, not a copy, and reset together with the targets."""
    actor = make_actor()
    loss = ECPO.build(actor)
    assert {id(p) for p in loss.parameters()} == {id(p) for p in actor.parameters()}
    loss = build()
    before = {n: v.clone() for n, v in loss.state_dict().items() if "params" in n and v.numel()}
    loss.reset_parameters_recursive()
    after = loss.state_dict()
    assert [name for name, value in before.items() if (value != after[name]).any()] == [*before]
    assert any("target" in name for name in before)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64], ids=str)
def test_to_dtype(dtype):
    """Parameters, targets and temperatures follow, and keep their kind."""
    loss = build()
    for cast in (loss.to(dtype), loss.half().to(dtype)):
        assert {t.dtype for t in [*cast.parameters(), *cast.buffers()]} == {dtype}
        assert isinstance(cast.actor_network_params, TensorDictParams)
        assert len(list(cast.parameters())) == 2
        assert all(isinstance(p, torch.nn.Parameter) for p in cast.parameters())


@losses
def test_schedule_by_assignment(case):
    """loss.tau = x writes into the buffer: same tensor, dtype and place; the next call uses it."""
    loss = case.build(make_actor())
    batch = sample(make_actor(), 2, 3, 4)
    move(loss.actor_network)
    assert loss.temperature_names == tuple(case.temperatures)
    for name in case.temperatures:
        before = loss(batch)["loss_actor"]
        buffer = getattr(loss, name)
        earlier = loss(batch)["loss_actor"]
        setattr(loss, name, 2)
        earlier.backward()  # which is not disturbed
        assert getattr(loss, name) is buffer
        assert dict(loss.named_buffers())[name] is buffer
        assert name not in dict(loss.named_parameters())
        assert (buffer.item(), buffer.dtype, buffer.shape) == (2.0, torch.float64, torch.Size([]))
        assert not torch.allclose(loss(batch)["loss_actor"], before)
        with pytest.raises(TypeError, match=rf"would not be trained: learn it by learn\('{name}'"):
            setattr(loss, name, torch.nn.Parameter(torch.tensor(0.5)))


# ------------------------------------------------------------------------------------- the targets


def test_delay_flag():
    """With it the target stays where it was, without it the target is the live policy.

    TorchRL warns of targets that no updater moves, and of nothing else.
    """
    batch = sample(make_actor(), 2, 3, 4)
    for delayed in (True, False):
        loss = ECPO.build(make_actor(), delay_actor=delayed)
        if delayed:
            with pytest.warns(UserWarning, match="No target network updater has been associated"):
                loss(batch)
            HardUpdate(loss, value_network_update_interval=1)
        loss(batch)
        move(loss.actor_network)
        source = loss.actor_network_params["module", "0", "module", "0", "weight"]
        target = loss.target_actor_network_params["module", "0", "module", "0", "weight"]
        assert torch.equal(source, target) is not delayed
        assert ("target_actor_network_params" in dict(loss.named_children())) is delayed


def test_no_targets():
    """Built, called, trained and copied in silence; a stock updater says there are no targets."""
    loss = ECPO.build(make_actor())
    deepcopy(loss)(sample(make_actor(), 2, 3, 4))["loss_actor"].backward()
    with pytest.raises(RuntimeError, match="not find any target param"):
        SoftUpdate(loss, eps=0.9)


# ------------------------------------------------------------------------- what a group loss is not


@losses
def test_constructor(case):
    """The network first, everything else by keyword; what the class says is what it has.

    Returns are sums of rewards: there is nothing to estimate and no discount.
    """
    parameters = list(inspect.signature(case.loss.__init__).parameters.values())[1:]
    assert parameters[0].name == "actor_network"
    assert all(p.kind is p.KEYWORD_ONLY for p in parameters[1:])
    doc = inspect.getdoc(case.loss) or ""
    assert all(f"{p.name}:" in doc for p in parameters)
    assert issubclass(case.loss, LossModule)
    with pytest.raises(TypeError, match="gamma"):
        case.loss(make_actor(), gamma=0.9)
    with pytest.raises(NotImplementedError, match=r"undiscounted sum of \('next', 'reward'\)"):
        case.build(make_actor()).make_value_estimator(ValueEstimators.TD0)


class _Spy(torch.nn.Module):
    """Remembers in which modes it was called."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(3, 4)
        self.modes = []

    def forward(self, observation):
        self.modes.append((exploration_type(), recurrent_mode()))
        return self.linear(observation)


def test_modes_inside_and_after():
    """Deterministic and recurrent inside; outside what it was before, also after an error."""
    spy = _Spy().double()
    network = TensorDictModule(spy, ["observation"], ["logits"])
    loss = ECPO.build(
        ProbabilisticActor(network, in_keys=["logits"], distribution_class=Categorical)
    )
    batch = sample(make_actor(), 2, 3, 4)
    with set_exploration_type(ExplorationType.RANDOM), set_recurrent_mode(False):
        loss(batch)
        with pytest.raises(KeyError):
            loss(batch.exclude("action"))
        assert exploration_type() is ExplorationType.RANDOM
        assert recurrent_mode() is False
    assert set(spy.modes) == {(ExplorationType.DETERMINISTIC, True)}


# ----------------------------------------------------------------------------------------- compile


COMPILED = ("ecpo", "grpo")  # of trajectories, of steps; equations compile in test_functional


@pytest.mark.parametrize(
    "name",
    [name if name in COMPILED else pytest.param(name, marks=pytest.mark.slow) for name in CASES],
)
@pytest.mark.parametrize(
    "backend",
    [
        "eager",  # the graph is whole; then its backward pass, then code
        pytest.param("aot_eager", marks=pytest.mark.slow),
        pytest.param("inductor", marks=pytest.mark.slow),
    ],
)
@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_compile(name, backend):
    """Same numbers and gradients, without a graph break, and one compilation for a whole run."""
    torch._dynamo.reset()
    case = CASES[name]
    loss, batch = build(case), pad(sample(make_actor(), 2, 3, 4))
    compiled = torch.compile(loss, fullgraph=True, backend=backend)
    with torch._dynamo.config.patch(error_on_recompile=False):
        for step in range(3):
            expected, got = loss(batch), compiled(batch)
            assert list(got.keys()) == out_keys(case)
            assert_close(got, expected)
            found, wanted = (gradients(out["loss_actor"], loss) for out in (got, expected))
            assert_close(found, wanted)
            move(loss.actor_network)
            for name in case.temperatures:
                setattr(loss, name, 0.25 / (1 + step))
            torch._dynamo.config.error_on_recompile = True
