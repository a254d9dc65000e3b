"""Bad arguments of the policies and critics, and bad input of what they are made of."""

from __future__ import annotations

import math

import pytest
import torch
from faults import Fault, Subject, check, tensordict_of
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import set_recurrent_mode

from torchrl_ecpo.modules import (
    DenseNetwork,
    DistinctHistoryLSTM,
    DistinctWindowNetwork,
    LinearSoftmax,
    OneHotLinear,
    SharedCategorical,
    TupleCategorical,
    make_deterministic_actor,
    make_qvalue_network,
    make_softmax_policy,
    make_tanh_gaussian_actor,
    make_tuple_policy,
    make_value_network,
    record_latents,
)

OBSERVATION = torch.linspace(-1, 1, 12).reshape(4, 3)
ACTION = torch.linspace(-1, 1, 8).reshape(4, 2)
SPEC = Bounded(-2.0, 2.0, shape=(2,))
SPECS = [
    *(Fault(repr(x), x) for x in (None, "text", 3, [], {})),
    Fault("its class", Bounded),
    Fault("unbounded", Unbounded(2)),
    Fault("discrete", Categorical(2)),
    Fault("flags", Binary(2)),
    Fault("integers", Bounded(-2, 2, shape=(2,), dtype=torch.int64)),
    Fault("a number", Bounded(-2.0, 2.0, shape=())),
    Fault("empty", Bounded(-2.0, 2.0, shape=(0,))),
    Fault("a batch", Bounded(-2.0, 2.0, shape=(3, 2))),
    Fault("no width", Bounded(2.0, 2.0, shape=(2,))),
    Fault("infinite", Bounded(-math.inf, 2.0, shape=(2,))),
    Fault("nan", Bounded(torch.full((2,), math.nan), 2.0, shape=(2,))),
    Fault("double", Bounded(-2.0, 2.0, shape=(2,), dtype=torch.float64), SPEC),
]
NO_LAYERS = {("hidden_sizes", "()"): "a linear network"}


def build(make, **inputs):
    """What a network gives on good input."""

    def run(entries):
        torch.manual_seed(0)
        network = make(**entries)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return dict(network(tensordict_of(inputs, (4,))).items())

    return run


def read(make, shape, others=None, *, recurrent=False):
    """What a good network gives on the input."""

    def run(entries):
        torch.manual_seed(0)
        network = make()
        exploration = set_exploration_type(ExplorationType.DETERMINISTIC)
        with torch.no_grad(), exploration, set_recurrent_mode(recurrent):
            out = network(tensordict_of(entries | (others or {}), shape))
        return {key: x for key, x in out.items(True, True) if key not in entries}

    return run


def dense(entries):
    torch.manual_seed(0)
    network = DenseNetwork(**entries)
    out = network(tensordict_of({"observation": OBSERVATION, "action": ACTION}, (4,)))
    return [out[key] for key in network.out_keys]


def of_each(entries):
    torch.manual_seed(0)
    network = make_qvalue_network(3, 2, hidden_sizes=(5,))
    return network.each(tensordict_of(entries, (4,)), TensorDict.from_module(network).expand(2))


def shared(entries):
    value = {name: entries.pop(name) for name in ("value",) if name in entries}
    dist = SharedCategorical(**entries)
    return dist.log_prob(**value), dist.entropy()


def tuples(entries):
    action = entries.pop("action", TUPLES)
    dist = TupleCategorical(**entries)
    return dist.entropy(), dist.log_prob(action)


def linear_softmax(entries):
    return LinearSoftmax(**entries)(torch.ones(4, 1))


def latents(entries):
    policy = make_tanh_gaussian_actor(3, SPEC)
    record_latents(**{name: policy if x is SPEC else x for name, x in entries.items()})
    return policy(tensordict_of({"observation": OBSERVATION}, (4,)))["action_latent"]


LOGITS = torch.linspace(-1, 1, 36).reshape(4, 9)
TUPLES = torch.tensor([[1, 1, 3], [0, 1, 4], [1, 0, 0], [0, 0, 0]])
NVEC = (2, 2, 5)
STEP = {
    "observation": torch.tensor([5, 1, 0, 3]),
    "previous_action": torch.tensor([[2, 2, 5], [1, 1, 4], [0, 0, 0], [1, 1, 2]]),
    "is_init": torch.tensor([[True], [False], [False], [False]]),
}
STATE = {f"recurrent_state_{x}": torch.linspace(-1, 1, 32).reshape(4, 1, 8) for x in "hc"}
WINDOW = {"window": torch.tensor([[0], [1], [324], [7]])}
SEQUENCES = {
    "observation": torch.tensor([[5, 1, 0], [3, 4, 0]]),
    "previous_action": torch.tensor([[[2, 2, 5], [1, 1, 4], [0, 0, 0]]]).repeat(2, 1, 1),
    "is_init": torch.tensor([True, False, False]).reshape(1, 3, 1).repeat(2, 1, 1),
    ("collector", "mask"): torch.tensor([[True, True, True], [True, True, False]]),
}
FEATURES = torch.linspace(-1, 1, 12).reshape(4, 3)


ALIKE = "the same distribution in each row"
LENGTHS = [f"too {size} in axis {axis}" for size in ("short", "long") for axis in (0, 1)]
SHAPES = {
    "logits": ["an axis behind", "an axis less", "transposed", *LENGTHS],
    "value": ["empty", "an axis less", "one number", *LENGTHS[::2]],
}
OTHERS = {("features", name): "other features" for name in [*LENGTHS, "transposed"]}
CLASSES = {(name, "flags"): "classes 0 and 1" for name in ("observation", "previous_action")}
MORE_ROWS = "there may be more than are used"
NAMES = {("out_key", name): "a name" for name in ("'embedx'", "'EMBED'", "''")}


def make_lstm():
    return DistinctHistoryLSTM((6, 3, 3, 6), 8, in_keys=["observation", "previous_action"])


def make_window():
    layer = OneHotLinear((6, 3, 3, 6) * 2, 8)
    return DistinctWindowNetwork(
        (6, 3, 3, 6), layer, window=2, in_keys=["observation", "previous_action"]
    )


def make_tuples():
    return make_tuple_policy(6, NVEC, hidden_size=8)


SUBJECTS = {
    "DenseNetwork": Subject(
        dense,
        {
            "in_keys": ["observation", "action"],
            "out_keys": ["loc", "scale"],
            "sizes": (5, 7, 4),
            "head": lambda x: x.chunk(2, -1),
            "final_gain": 0.5,
            "layer_norm": True,
        },
        optional=["final_gain", "layer_norm"],
    ),
    "DenseNetwork.forward": Subject(
        read(lambda: make_qvalue_network(3, 2, hidden_sizes=(5,)), (4,)),
        {"observation": OBSERVATION, "action": ACTION},
        hands_on_nan=True,
    ),
    "DenseNetwork.each": Subject(
        of_each, {"observation": OBSERVATION, "action": ACTION}, hands_on_nan=True
    ),
    "make_tanh_gaussian_actor": Subject(
        build(make_tanh_gaussian_actor, observation=OBSERVATION),
        {"observation_size": 3, "action_spec": SPEC, "hidden_sizes": (5, 6), "final_gain": 0.5},
        faults={"action_spec": SPECS},
        fine=NO_LAYERS,
        optional=["hidden_sizes", "final_gain"],
    ),
    "make_deterministic_actor": Subject(
        build(make_deterministic_actor, observation=OBSERVATION),
        {"observation_size": 3, "action_spec": SPEC, "hidden_sizes": (5, 6)},
        faults={"action_spec": SPECS},
        fine=NO_LAYERS,
        optional=["hidden_sizes"],
    ),
    "make_qvalue_network": Subject(
        build(make_qvalue_network, observation=OBSERVATION, action=ACTION),
        {
            "observation_size": 3,
            "action_size": 2,
            "hidden_sizes": (5, 6),
            "layer_norm": True,
            "num_outputs": 1,
        },
        fine=NO_LAYERS,
        optional=["hidden_sizes", "layer_norm", "num_outputs"],
    ),
    "make_value_network": Subject(
        build(make_value_network, observation=OBSERVATION),
        {"observation_size": 3, "hidden_sizes": (5, 6), "layer_norm": True},
        fine=NO_LAYERS,
        optional=["hidden_sizes", "layer_norm"],
    ),
    "make_softmax_policy": Subject(
        build(make_softmax_policy, observation=torch.ones(4, 1)),
        {"features": FEATURES},
        fine=OTHERS,
    ),
    "LinearSoftmax": Subject(linear_softmax, {"features": FEATURES}, fine=OTHERS),
    "SharedCategorical": Subject(
        shared,
        {"logits": LOGITS[:1].repeat(4, 1), "value": torch.zeros(4, dtype=torch.int64)},
        fine={(name, fault): ALIKE for name, faults in SHAPES.items() for fault in faults},
        hands_on_nan=True,
    ),
    "TupleCategorical": Subject(
        tuples,
        {"logits": LOGITS, "nvec": NVEC, "action": TUPLES, "validate_args": True},
        fine={("logits", "an axis less"): ALIKE, ("logits", "-inf"): "never taken"},
        optional=["action", "validate_args"],
    ),
    "TupleCategorical, rows": Subject(
        tuples,
        {
            "logits": LOGITS,
            "nvec": NVEC,
            "rows": torch.tensor([3, 0, 0, 1]),
            "action": TUPLES,
            "validate_args": True,
        },
        lone=["rows"],
        fine={("logits", "too long in axis 0"): MORE_ROWS, ("logits", "-inf"): "never taken"},
        optional=["rows", "action", "validate_args"],
    ),
    "make_tuple_policy": Subject(
        build(make_tuple_policy, **STEP, **STATE),
        {"num_observations": 6, "nvec": NVEC, "hidden_size": 8},
        optional=["hidden_size"],
    ),
    "make_tuple_policy, window": Subject(
        build(make_tuple_policy, **STEP, **STATE, **WINDOW),
        {"num_observations": 6, "nvec": NVEC, "hidden_size": 8, "window": 2},
        optional=["hidden_size", "window"],
    ),
    "make_tuple_policy()(step)": Subject(read(make_tuples, (4,), STATE), STEP, fine=CLASSES),
    "make_tuple_policy()(sequences)": Subject(
        read(make_tuples, (2, 3), recurrent=True),
        SEQUENCES,
        fine=CLASSES,
        optional=[("collector", "mask")],
    ),
    "DistinctHistoryLSTM": Subject(
        build(DistinctHistoryLSTM, **STEP, **STATE),
        {
            "num_classes": (6, 3, 3, 6),
            "hidden_size": 8,
            "readout": torch.nn.Identity(),
            "in_keys": ["observation", "previous_action"],
            "out_key": "embed",
        },
        fine=NAMES,
        optional=["hidden_size", "readout", "out_key"],
    ),
    "DistinctHistoryLSTM.forward": Subject(
        read(make_lstm, (4,)), STEP | STATE, fine=CLASSES, hands_on_nan=True
    ),
    "DistinctWindowNetwork": Subject(
        build(DistinctWindowNetwork, **STEP, **WINDOW),
        {
            "num_classes": (6, 3, 3, 6),
            "network": OneHotLinear((6, 3, 3, 6) * 2, 8),
            "window": 2,
            "in_keys": ["observation", "previous_action"],
            "out_key": "embed",
        },
        fine=NAMES,
        optional=["window", "out_key"],
    ),
    "DistinctWindowNetwork.forward": Subject(read(make_window, (4,)), STEP | WINDOW, fine=CLASSES),
    "record_latents": Subject(latents, {"policy": SPEC}),
}


@pytest.mark.parametrize("name", SUBJECTS)
def test_modules(name):
    check(f"`{name}`", SUBJECTS[name])
