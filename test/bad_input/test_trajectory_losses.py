"""Bad batches and options of the losses over groups of trajectories."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from faults import NO_NETWORKS, Subject, check, tensordict_of
from test_trust_pcl import TEMPERATURES, make_value
from trajectory_problems import CASES, DELAYED, MASK, Case, ecpo, make_actor, sample

from torchrl_ecpo import REPSLoss, TrustPCLLoss

OPTIONS = (
    *("tau", "tau_prime", "delay_actor", "reduction", "control_variate", "epsilon", "normaliser"),
    *("clip_epsilon", "score", "aggregation", "ratio", "kl_to_ref_coeff", "length_norm"),
    *("gamma", "n_steps", "entropy"),
)
NETWORKS = ("actor_network", "value_network")
SHAPE = (2, 3, 4)
SUBJECTS = CASES | {
    "reps": Case(REPSLoss, {"tau": 0.7, "tau_prime": 0.3}, ecpo, {"epsilon": 0.4}),
    "trust_pcl": SimpleNamespace(loss=TrustPCLLoss, temperatures=TEMPERATURES, options={}),
}
WHOLE = ("ecpo", "grpo", "trust_pcl")
"""Of these the networks and the batch are spoilt too, which the base reads for all: sums of each
trajectory, single steps, and a value network. The base reads actions of another kind, too."""
NAMES = "names of groups, which agree within each"
FINE = {("group", fault): NAMES for fault in ("text", "halves", "flags")}


def good(kind, *, dtype=torch.float64):
    batch = sample(make_actor(kind, dtype=dtype), *SHAPE)
    keys = ("observation", "action", "action_log_prob", ("next", "reward"))
    mask = torch.arange(4) < torch.tensor([[4, 1, 3], [2, 4, 3]]).unsqueeze(-1)
    return {key: batch[key] for key in keys} | {
        MASK: mask,
        "group": torch.tensor([[0], [1]]).unsqueeze(-1).expand(SHAPE),
    }


def call(case):
    def run(entries):
        options = {name: entries[name] for name in OPTIONS if name in entries}
        networks = {name: entries[name]() for name in NETWORKS if name in entries}
        loss_module = case.loss(**networks, **options)
        batch = {key: x for key, x in entries.items() if key not in (*OPTIONS, *NETWORKS)}
        losses = loss_module(tensordict_of(batch, SHAPE))
        sum(losses[name].sum() for name in ("loss_actor", *loss_module.losses)).backward()
        gradients = [parameter.grad for parameter in loss_module.parameters()]
        return {name: value.detach() for name, value in losses.items()}, gradients

    return run


def subject(name, kind):
    case = SUBJECTS[name]
    options = {"score": "return", **case.temperatures, **case.options, "reduction": "none"}
    if name in (*DELAYED, "reps"):
        options["delay_actor"] = False
    if name in ("ecpo", "reps"):
        options |= {"control_variate": False, "entropy": "nats"}
    if name == "trust_pcl":
        options |= {"delay_actor": False, "gamma": 0.9, "n_steps": 2}
        del options["score"]  # it is of rewards, not of returns
    networks = dict.fromkeys(NETWORKS[: 1 + (name == "trust_pcl")], NO_NETWORKS)
    made = {"actor_network": lambda: make_actor(kind), "value_network": make_value}
    others, run = good(kind) | {network: made[network] for network in networks}, call(case)
    if name not in WHOLE:
        return Subject(lambda entries: run({**others, **entries}), options, optional=options)
    return Subject(
        run,
        others | options,
        faults=networks,
        fine=FINE,
        optional=(MASK, "group", *options),
    )


@pytest.mark.parametrize(
    ("name", "kind"), [("ecpo", "normal"), *((name, "categorical") for name in WHOLE)]
)
def test_trajectory_losses(name, kind):
    check(f"`{SUBJECTS[name].loss.__name__}`, {kind} policy", subject(name, kind))


@pytest.mark.parametrize("name", [name for name in SUBJECTS if name not in WHOLE])
def test_options_of_trajectory_losses(name):
    check(f"`{SUBJECTS[name].loss.__name__}`, options", subject(name, "categorical"))
