"""Bad input of the equations: types, shapes, temperatures. NaN comes out as NaN."""

from __future__ import annotations

import inspect

import pytest
import torch
from faults import Fault, Subject, check

from torchrl_ecpo import functional

GENERATOR = torch.Generator().manual_seed(0)


def numbers(*shape):
    return torch.randn(*shape, generator=GENERATOR)


GOOD = {
    **{name: numbers(3, 4) for name in ("score", "log_weights", "values", "advantage", "like")},
    **{name: numbers(3, 4) for name in ("log_ratio", "log_target")},
    **{
        name: numbers(3, 4).log_softmax(-1)
        for name in ("log_prob", "reference_log_prob", "control_log_prob", "behaviour_log_prob")
    },
    "weights": numbers(3, 4).softmax(-1),
    "base_weights": numbers(3, 4).softmax(-1),
    "mask": torch.tensor([True, True, False, True]).repeat(3, 1),
    "sample_dim": -1,
    "keepdim": True,
    "tau": 0.5,
    "tau_prime": 0.25,
    "clip_low": 0.2,
    "clip_high": 0.3,
    "normaliser": "mean",
    "log_temperature": torch.tensor(0.5),
    "excess": numbers(3),
    "loc": numbers(3, 2),
    "scale": numbers(3, 2).exp(),
    "samples": numbers(3, 4, 2),
    "slope": numbers(3, 4, 2),
    "mean": numbers(3, 2),
    "variance": numbers(3, 2).exp(),
    "width_entropy": 0.4,
    "state_mask": torch.tensor([True, False, True]),
    "horizon": 10.0,
    "num_trajectories": 7,
    "allow_zero": False,
    "rewards": numbers(3, 4),
    "gamma": 0.9,
    "n_steps": 2,
}
OPTIONAL = (
    *("mask", "sample_dim", "keepdim", "control_log_prob", "behaviour_log_prob", "allow_zero"),
    *("base_weights", "normaliser", "gamma", "n_steps"),
    *("state_mask", "width_entropy"),
)
NAMES = [name for name in functional.__all__ if name not in ("Surrogate", "check_temperatures")]


def call(name):
    return lambda entries: getattr(functional, name)(**entries)


AXES = [Fault(repr(axis), axis) for axis in (2, -3, "1", None, 0.5, [1], 1j)]
LONE = {"effective_sample_size": ["weights"], "temperature_dual": ["log_temperature", "excess"]}

FINE = {("num_trajectories", "7.5"): "the formula holds for any real number"}


@pytest.mark.parametrize("name", NAMES)
def test_functional(name):
    arguments = inspect.signature(getattr(functional, name)).parameters
    entries = {argument: GOOD[argument] for argument in arguments}
    subject = Subject(
        call(name),
        entries,
        faults={"sample_dim": AXES},
        lone=LONE.get(name, ()),
        fine=FINE if name == "theorem1_temperatures" else {},
        optional=OPTIONAL,
        hands_on_nan=True,
    )
    check(f"`{name}`", subject)
