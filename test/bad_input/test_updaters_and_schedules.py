"""Bad arguments of updaters and schedules, and bad states that they are given."""

from __future__ import annotations

import pytest
import torch
from actor_critic_problems import make_networks
from faults import MISSING, Fault, Subject, check

from torchrl_ecpo import (
    ECACLoss,
    ECPOLoss,
    PeriodicCopy,
    PolyakAverage,
    TemperatureScheduler,
    UpdaterSequence,
    make_softmax_policy,
)
from torchrl_ecpo.schedules import (
    constant,
    exponential,
    linear,
    make_schedule,
    theorem1_schedules,
)

NETWORK = "qvalue_network"
COUNTS = (0, 3, 50)


def make_loss(dtype=torch.float64):
    torch.manual_seed(0)
    networks = make_networks("normal", dtype=dtype)
    return ECACLoss(networks.actor, networks.qvalues[0], tau=0.5, tau_prime=0.5).to(dtype)


def moved(loss, updater):
    """The delayed networks after two updates."""
    with torch.no_grad():
        for parameter in loss.parameters():
            parameter.add_(1.0)
    for _ in range(2):
        updater.step()
    return {name: x.clone() for name, x in loss.state_dict().items() if "target" in name}


def update(kind):
    def run(entries):
        loss = make_loss()
        entries = {name: loss if x is make_loss else x for name, x in entries.items()}
        names = [entries.pop("network")] if "network" in entries else []
        owner = [entries.pop("loss_module")] if "loss_module" in entries else []
        return moved(loss, kind(*owner, *names, **entries))

    return run


def update_in_sequence(entries):
    loss = make_loss()
    made = [entries.get("updaters", MISSING)]
    made = [PolyakAverage(loss) if x is PolyakAverage else x for x in made if x is not MISSING]
    return moved(loss, UpdaterSequence(*made))


def resume(make):
    def run(entries):
        loss = make_loss()
        updater = make(loss)
        updater.load_state_dict(nested(entries))
        return moved(loss, updater)

    return run


def nested(entries):
    """Of entries by their paths."""
    state = {}
    for path, value in entries.items():
        *folders, name = path if isinstance(path, tuple) else (path,)
        inner = state
        for folder in folders:
            inner = inner.setdefault(folder, {})
        inner[name] = value
    return state


def sequence(loss):
    return UpdaterSequence(PeriodicCopy(loss, interval=4))


NO_LIST = [Fault(repr(x), x) for x in (None, "text", 3, [], {}, [{}, {}], [None], ["text"], [3])]
UPDATERS = {
    "PeriodicCopy": Subject(
        update(PeriodicCopy),
        {"loss_module": make_loss, "network": NETWORK, "interval": 2},
        optional=["network"],
    ),
    "PolyakAverage": Subject(
        update(PolyakAverage),
        {"loss_module": make_loss, "network": NETWORK, "weight": 0.25},
        optional=["network", "weight"],
    ),
    "UpdaterSequence": Subject(update_in_sequence, {"updaters": PolyakAverage}),
    "PeriodicCopy.load_state_dict": Subject(
        resume(lambda loss: PeriodicCopy(loss, interval=4)),
        {"initialized": True, "counter": 2},
        fine={("counter", "0"): "just copied"},
    ),
    "PolyakAverage.load_state_dict": Subject(resume(PolyakAverage), {"initialized": True}),
    "UpdaterSequence.load_state_dict": Subject(
        resume(sequence),
        {"updaters": [{"initialized": True, "counter": 2}]},
        faults={"updaters": NO_LIST},
    ),
}


def read(make):
    def run(entries):
        schedules = make(**entries)
        schedules = schedules if isinstance(schedules, dict) else {"": schedules}
        return [[schedule(count) for count in COUNTS] for schedule in schedules.values()]

    return run


def describe(entries):
    return read(make_schedule)({"setting": entries})


def make_actor_loss():
    return ECPOLoss(make_softmax_policy(torch.eye(4)), tau=0.5, tau_prime=0.25)


def schedule(entries):
    made = {name: x() if x is make_actor_loss else x for name, x in entries.items()}
    scheduler = TemperatureScheduler(**made)
    return [getattr(scheduler.loss_module, name) for name in ("tau", "tau_prime")]


def use(method):
    def run(entries):
        scheduler = TemperatureScheduler(make_actor_loss(), tau_prime=linear(0.5, 0.1, 100.0))
        method(scheduler, entries)
        return scheduler.loss_module.tau_prime

    return run


REAL = "the formula holds for any real number"
LINE = {"start": 0.5, "end": 0.25, "duration": 10.0}
SCHEDULES = {
    "constant": Subject(read(constant), {"value": 0.5}),
    "linear": Subject(read(linear), LINE),
    "exponential": Subject(read(exponential), LINE),
    "theorem1_schedules": Subject(
        read(theorem1_schedules),
        {"num_trajectories": 7, "horizon": 10},
        fine=dict.fromkeys((("num_trajectories", "7.5"), ("horizon", "10.5")), REAL),
        optional=["horizon"],
    ),
    "make_schedule": Subject(describe, {"schedule": "linear", **LINE}),
    "make_schedule(number)": Subject(read(make_schedule), {"setting": 0.5}),
    "TemperatureScheduler": Subject(
        schedule,
        {"loss_module": make_actor_loss, "tau": constant(0.5), "tau_prime": constant(0.25)},
        optional=["tau", "tau_prime"],
    ),
    "TemperatureScheduler.step": Subject(
        use(lambda scheduler, entries: scheduler.step(**entries)),
        {"count": 2.0},
        fine={("count", "missing"): "1"},
    ),
    "TemperatureScheduler.load_state_dict": Subject(
        use(TemperatureScheduler.load_state_dict), {"count": 2.0}
    ),
}


@pytest.mark.parametrize("name", [*UPDATERS, *SCHEDULES])
def test_updaters_and_schedules(name):
    check(f"`{name}`", {**UPDATERS, **SCHEDULES}[name])
