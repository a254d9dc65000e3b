"""Bad batches and options of the losses over groups of trajectories."""

from __future__ import annotations

import pytest
import torch
from faults import NO_NETWORKS, Subject, check, tensordict_of
from trajectory_problems import CASES, LIFTING, MASK, make_actor, sample

OPTIONS = ("tau", "tau_prime", "delay_actor", "reduction", "control_variate")
SHAPE = (2, 3, 4)
NAMES = "names of groups, which agree within each"
FINE = {("group", fault): NAMES for fault in ("text", "complex", "halves", "flags")}


def good(kind, *, dtype=torch.float64):
    batch = sample(make_actor(kind, dtype=dtype), *SHAPE)
    keys = ("observation", "action", "action_log_prob", ("next", "reward"))
    mask = torch.arange(4) < torch.tensor([[4, 1, 3], [2, 4, 3]]).unsqueeze(-1)
    return {key: batch[key] for key in keys} | {
        MASK: mask,
        "group": torch.tensor([[0], [1]]).unsqueeze(-1).expand(SHAPE),
    }


def call(case, kind):
    def run(entries):
        options = {name: entries[name] for name in OPTIONS if name in entries}
        networks = {n: entries[n]() for n in ("actor_network",) if n in entries}
        loss_module = case.loss(**networks, **options)
        batch = {key: x for key, x in entries.items() if key not in (*OPTIONS, "actor_network")}
        losses = loss_module(tensordict_of(batch, SHAPE))
        losses["loss_actor"].sum().backward()
        gradients = [parameter.grad for parameter in loss_module.parameters()]
        return {name: value.detach() for name, value in losses.items()}, gradients

    return run


def subject(name, kind):
    case = CASES[name]
    options = {**case.temperatures, "reduction": "none"}
    if name in LIFTING:
        options["delay_actor"] = False
    if name == "ecpo":
        options["control_variate"] = False
    entries = good(kind) | options | {"actor_network": lambda: make_actor(kind)}
    return Subject(
        call(case, kind),
        entries,
        faults={"actor_network": NO_NETWORKS},
        fine=FINE,
        optional=(MASK, "group", *options),
    )


@pytest.mark.parametrize("kind", ["categorical", "normal"])
@pytest.mark.parametrize("name", CASES)
def test_trajectory_losses(name, kind):
    check(f"`{CASES[name].loss.__name__}`, {kind} policy", subject(name, kind))
