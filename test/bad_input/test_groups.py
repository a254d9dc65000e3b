"""Bad input of what packs and draws groups."""

from __future__ import annotations

import math

import pytest
import torch
from faults import Subject, check, tensordict_of
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from torchrl_ecpo.groups import TrajectoryGroupSampler, pack_groups, unpack_groups

DONE, MASK, TRAJECTORY = ("next", "done"), ("collector", "mask"), ("collector", "traj_ids")
# Two groups of two trajectories, 3, 2, 1 and 2 steps long.
STEPS = {
    "group": torch.tensor([5, 5, 5, 5, 5, 2, 2, 2]),
    TRAJECTORY: torch.tensor([7, 7, 7, 8, 8, 9, 4, 4]),
    DONE: torch.tensor([0, 0, 1, 0, 1, 1, 0, 1]).bool().unsqueeze(-1),
    "is_init": torch.tensor([1, 0, 0, 1, 0, 1, 1, 0]).bool().unsqueeze(-1),
}
ROWS = {
    "group": torch.tensor([[5, 5, 5], [5, 5, 5], [2, 2, 2], [2, 2, 2]]),
    MASK: torch.tensor([[1, 1, 1], [1, 1, 0], [1, 0, 0], [1, 1, 0]]).bool(),
    DONE: torch.tensor([[0, 0, 1], [0, 1, 0], [1, 0, 0], [0, 1, 0]]).bool().unsqueeze(-1),
}


OPTIONS = ("group_size", "replacement")


def steps(entries, *shape):
    x = {"x": torch.arange(math.prod(shape)).reshape(shape)}
    return tensordict_of(x | {key: entries[key] for key in entries if key not in OPTIONS}, shape)


def options(entries):
    return {name: entries[name] for name in OPTIONS if name in entries}


def pack_flat(entries):
    packed = pack_groups(steps(entries, 8), **options(entries))
    return packed["x"], packed[MASK]


def pack_rows(entries):
    packed = pack_groups(steps(entries, 4, 3))
    return packed["x"], packed[MASK]


def unpack(entries):
    return unpack_groups(steps(entries, 4, 3))["x"]


def draw(entries):
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(20),
        sampler=TrajectoryGroupSampler(**options(entries)),
        batch_size=4,
        generator=torch.Generator().manual_seed(0),
    )
    buffer.extend(steps(entries, 8))
    return buffer.sample()["x"]


SUBJECTS = {
    "`pack_groups`, steps": Subject(
        pack_flat, {**STEPS, "group_size": 2}, optional=(TRAJECTORY, DONE, "is_init", "group_size")
    ),
    "`pack_groups`, rows": Subject(pack_rows, ROWS, optional=(MASK, DONE)),
    "`unpack_groups`": Subject(unpack, {MASK: ROWS[MASK]}, optional=(MASK,)),
    "`TrajectoryGroupSampler`": Subject(
        draw,
        {**STEPS, "group_size": 2, "replacement": True},
        optional=(TRAJECTORY, "is_init", "replacement"),
    ),
}


@pytest.mark.parametrize("name", SUBJECTS)
def test_groups(name):
    check(name, SUBJECTS[name])
