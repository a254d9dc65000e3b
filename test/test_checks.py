"""Checks that more than one module makes, and that the constructors make them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict, tensorclass
from torchrl.envs import GymEnv

from torchrl_ecpo import ECPOLoss, PMDLoss, TrajectoryGroupCollector
from torchrl_ecpo.checks import check_count, check_flag, get_entry, unreadable
from torchrl_ecpo.envs import BanditEnv
from torchrl_ecpo.envs.algorithmic import AlgorithmicEnv
from torchrl_ecpo.envs.grouped import GroupedEnv
from torchrl_ecpo.groups import TrajectoryGroupSampler
from torchrl_ecpo.modules import make_softmax_policy, make_tuple_policy

GROUPS = {"num_groups": 1, "group_size": 2}


def _actor():
    return make_softmax_policy(torch.eye(3))


def _cart_pole():
    return GymEnv("CartPole-v1")


def _collector(**options):
    return TrajectoryGroupCollector(BanditEnv(num_actions=3, **GROUPS), **{**GROUPS, **options})


COUNTS = {
    "group_size": (
        _collector,
        lambda **o: TrajectoryGroupSampler(**o),
        lambda **o: GroupedEnv(_cart_pole, num_groups=1, **o),
        lambda **o: BanditEnv(num_actions=3, **o),
    ),
    "num_groups": (_collector, lambda **o: TrajectoryGroupSampler(group_size=2, **o)),
    "max_steps": (_collector,),
    "max_frames_per_traj": (_collector,),
    "hidden_size": (
        lambda **o: make_tuple_policy(6, (2, 2, 5), **o),
        lambda **o: make_tuple_policy(6, (2, 2, 5), distinct_histories=False, **o),
    ),
    "min_length": (lambda **o: AlgorithmicEnv("copy", **GROUPS, **o),),
}
FLAGS = {
    "control_variate": (lambda **o: ECPOLoss(_actor(), **o),),
    "delay_actor": (lambda **o: PMDLoss(_actor(), **o),),
    "replacement": (lambda **o: TrajectoryGroupSampler(group_size=2, **o),),
    "parallel": (lambda **o: GroupedEnv(_cart_pole, **GROUPS, **o),),
    "compact_obs": (_collector,),
    "sync": (_collector,),
    "distinct_histories": (lambda **o: make_tuple_policy(6, (2, 2, 5), **o),),
}


def _cases(table):
    return [pytest.param(name, make, id=name) for name, makers in table.items() for make in makers]


@pytest.mark.parametrize("value", [3, np.int64(3), np.uint8(3)], ids=repr)
def test_integers_of_numpy_are_integers(value):
    count = check_count("n", value)
    assert (count, type(count)) == (3, int)


@tensorclass
class _Graph:
    nodes: torch.Tensor


def test_entries_are_tensors_or_collections_of_them():
    graph = _Graph(torch.zeros(2), batch_size=[2])
    entries = TensorDict({"graph": graph, "text": "north"}, [2])
    assert isinstance(get_entry(entries, "graph"), _Graph)
    with pytest.raises(TypeError, match="'text' must be a tensor, got "):
        get_entry(entries, "text")


def test_errors_without_a_message_have_a_name():
    """As that of a distribution without log_prob."""
    error = unreadable("actor", TensorDict(), ["action"], NotImplementedError())
    assert str(error) == "The actor cannot be evaluated on 'action' (missing): NotImplementedError"


@pytest.mark.parametrize(("name", "make"), _cases(COUNTS))
def test_counts(name, make):
    """numpy's are taken; others refused by name, True among them."""
    make(**{name: np.int64(2)})
    for value in (2.5, "2", True, -1):
        with pytest.raises(ValueError, match=f"{name} must be an integer of at .*got {value!r}"):
            make(**{name: value})


@pytest.mark.parametrize(("name", "make"), _cases(FLAGS))
@pytest.mark.parametrize("value", ["no", 1, [], np.int64(0)], ids=repr)
def test_flags(name, make, value):
    """Which would be taken for its truth, as "no" for yes."""
    with pytest.raises(ValueError, match=f"{name} must be one of True, False.*, got"):
        make(**{name: value})


def test_flags_of_numpy():
    assert check_flag("f", np.bool_(False)) is False
    assert check_flag("f", "auto", "auto") == "auto"
    assert check_flag("f", None, None) is None
