"""Bad transitions and options of the actor-critic losses."""

from __future__ import annotations

import inspect
from copy import deepcopy
from typing import Any

import pytest
import torch
from actor_critic_problems import CASES, FIXED, make_batch, make_networks
from faults import NO_NETWORKS, Subject, check, tensordict_of

from torchrl_ecpo import ActorCriticLoss, PolyakAverage

OPTIONS = {
    "tau": 0.75,
    "tau_prime": 0.25,
    "gamma": 0.9,
    "num_qvalue_nets": 2,
    "num_action_samples": 4,
    "num_next_action_samples": 1,
    "num_actor_states": None,
    "loss_function": "l2",
    "delay_actor": False,
    "delay_qvalue": True,
    "target_entropy": None,
    "target_entropy_weight": 0.5,
    "target_kl": None,
    "width_entropy": 1.0,
    "epsilon": 0.2,
    "epsilon_mean": 0.01,
    "epsilon_scale": 0.001,
    "reduction": "mean",
}

NETWORKS = ("actor_network", "qvalue_network")
WHOLE = ("ecac", "discrete_ecac")
"""Of these the networks and the batch are spoilt too, which the base reads for all: with actions
that are vectors and numbers. DiscretePMDACLoss is given one-hot actions."""


def spoilt_options(name):
    """Those of the loss's own constructor; the base's, which it hands on, are spoilt of ECAC."""
    own: Any = CASES[name].loss.__init__
    names = {*inspect.signature(own.__wrapped__).parameters}
    if name == "ecac":
        names |= {*inspect.signature(ActorCriticLoss.__init__).parameters, "gamma"}
    return {key: x for key, x in OPTIONS.items() if key in names and x is not None}


def batch(case):
    entries = make_batch(case.kind).flatten_keys(".").to_dict()
    entries = {tuple(key.split(".")) if "." in key else key: x for key, x in entries.items()}
    return entries | {
        "priority_weight": torch.tensor([1.0, 2, 1, 1, 0.5, 1], dtype=torch.float64),
        ("collector", "mask"): torch.tensor([True, True, True, True, False, True]),
    }


def call(case, entries):
    names = [name for name in entries if name in OPTIONS]
    options = {name: entries[name] for name in names}
    gamma = {"gamma": options.pop("gamma")} if "gamma" in options else {}
    networks = {network: entries[network]() for network in NETWORKS if network in entries}
    torch.manual_seed(0)
    loss = case.loss(**networks, **{**FIXED, **options})
    loss.make_value_estimator(**gamma)
    loss.to(torch.float64)
    if any("target" in name for name, _ in loss.named_children()):
        PolyakAverage(loss)
    others = (*names, *NETWORKS)
    data = tensordict_of({key: x for key, x in entries.items() if key not in others}, (6,))
    losses = loss(data)
    total = sum(value.sum() for name, value in losses.items() if name.startswith("loss_"))
    total.backward()
    gradients = [parameter.grad for parameter in loss.parameters()]
    return {name: value.detach() for name, value in losses.items()}, gradients


@pytest.mark.parametrize("name", CASES)
def test_actor_critic_losses(name):
    case, spoilt = CASES[name], spoilt_options(name)
    others, networks = batch(case), make_networks(case.kind)
    others["actor_network"] = lambda: deepcopy(networks.actor)
    others["qvalue_network"] = lambda: deepcopy(networks.qvalues[0])
    is_one_hot = case.kind == "one_hot"
    if name in WHOLE:
        spoilt, others = spoilt | others, {}
    elif is_one_hot:
        spoilt["action"] = others.pop("action")
    subject = Subject(
        lambda entries: call(case, {**others, **entries}),
        spoilt,
        faults=dict.fromkeys(NETWORKS, NO_NETWORKS),
        fine={("action", "flags"): "one-hot"} if is_one_hot else {},
        optional=[*OPTIONS, "priority_weight", ("collector", "mask")],
    )
    what = "" if name in WHOLE else ", options and one-hot actions" if is_one_hot else ", options"
    check(f"`{case.loss.__name__}`{what}", subject)
