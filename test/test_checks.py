"""Checks that more than one module makes, and that the constructors make them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict, tensorclass

from torchrl_ecpo import TrajectoryGroupCollector
from torchrl_ecpo.checks import check_count, check_flag, get_entry, unreadable
from torchrl_ecpo.envs import BanditEnv


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


def test_an_error_that_announces_another_one_is_told_with_it():
    error = unreadable("actor", TensorDict(), ["action"], TypeError("Got this: \nno logits\nat x"))
    assert str(error).endswith("(missing): Got this:  no logits")


def test_flags_of_numpy():
    assert check_flag("f", np.bool_(False)) is False
    assert check_flag("f", "auto", "auto") == "auto"
    assert check_flag("f", None, None) is None


@pytest.mark.parametrize("value", ["no", 1, [], np.int64(0)], ids=repr)
def test_flags(value):
    """Which would be taken for its truth, as "no" for yes."""
    env = BanditEnv(num_actions=3, num_groups=1, group_size=2)
    with pytest.raises(ValueError, match=r"sync must be one of True, False.*, got"):
        TrajectoryGroupCollector(env, num_groups=1, group_size=2, sync=value)
