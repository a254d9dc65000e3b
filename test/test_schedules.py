from __future__ import annotations

import pickle
from functools import partial

import pytest
import torch
from torchrl.objectives import LossModule

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.functional import theorem1_temperatures
from torchrl_ecpo.modules import make_softmax_policy
from torchrl_ecpo.schedules import (
    TemperatureScheduler,
    constant,
    exponential,
    linear,
    make_schedule,
    theorem1_schedules,
)


class Loss(LossModule):
    _schedulable_buffers = frozenset({"tau", "tau_prime"})

    def __init__(self):
        super().__init__()
        self.register_coeff_buffer("tau", 0.5)
        self.register_coeff_buffer("tau_prime", 0.1)

    def __setattr__(self, name, value):
        super().__setattr__(name, value)
        if name in self._schedulable_buffers:  # as the losses of the package do
            assert self.tau + self.tau_prime > 0


@pytest.mark.parametrize(
    ("schedule", "expected"),
    [
        (constant(0.3), [0.3, 0.3, 0.3, 0.3]),
        (linear(0.4, 0.2, 10), [0.4, 0.3, 0.2, 0.2]),
        (linear(0.0, 1.0, 10), [0.0, 0.5, 1.0, 1.0]),
        (exponential(1.0, 0.01, 10), [1.0, 0.1, 0.01, 0.01]),
    ],
)
def test_values_at_start_half_end_and_after(schedule, expected):
    for each in (schedule, pickle.loads(pickle.dumps(schedule))):
        assert [each(count) for count in (0, 5, 10, 1_000)] == pytest.approx(expected, rel=1e-12)
        assert each(10) == expected[2]  # exactly


@pytest.mark.parametrize("lift", [1, 2, 50])
def test_theorem1_counts_lifts_from_one(lift):
    schedules = theorem1_schedules(7)
    expected = theorem1_temperatures(lift, 7)
    assert (schedules["tau"](lift - 1), schedules["tau_prime"](lift - 1)) == expected
    constant_choice = theorem1_schedules(7, horizon=50)
    assert constant_choice["tau"](lift - 1) == theorem1_temperatures(50, 7)[0]


def test_scheduler_writes_the_loss_and_counts_what_it_is_told():
    loss = Loss()
    temperatures = TemperatureScheduler(loss, tau_prime=linear(0.2, 0.0, 100))
    assert loss.tau_prime.item() == pytest.approx(0.2)
    temperatures.step(25)
    temperatures.step(25)
    assert loss.tau_prime.item() == pytest.approx(0.1)
    assert loss.tau.item() == 0.5
    assert temperatures.values() == {"tau_prime": pytest.approx(0.1)}


def test_temperatures_may_change_places():
    """At no moment are both 0, although each is at some time."""
    loss = Loss()
    swap = {"tau": linear(0.5, 0.0, 1), "tau_prime": linear(0.0, 0.5, 1)}
    temperatures = TemperatureScheduler(loss, **swap)
    assert (loss.tau.item(), loss.tau_prime.item()) == (0.5, 0.0)
    temperatures.step()
    assert (loss.tau.item(), loss.tau_prime.item()) == (0.0, 0.5)


def test_scheduler_continues_from_its_state():
    schedules = {"tau": exponential(1.0, 0.1, 40), "tau_prime": linear(0.2, 0.0, 100)}
    uninterrupted = TemperatureScheduler(Loss(), **schedules)
    uninterrupted.step(30)
    resumed = TemperatureScheduler(Loss(), **schedules)
    resumed.load_state_dict(uninterrupted.state_dict())
    for scheduler in (uninterrupted, resumed):
        scheduler.step(3)
    for name in schedules:
        assert torch.equal(
            getattr(uninterrupted.loss_module, name), getattr(resumed.loss_module, name)
        )


@pytest.mark.parametrize(
    ("schedules", "message"),
    [
        ({"tau": (0.5, 0.0), "tau_prime": (0.2, 0.0)}, r"end: tau \+ tau_prime must be positive"),
        ({"tau": (0.5, 0.0)}, r"end: tau \+ tau_prime must be positive"),  # the other is 0
    ],
)
def test_schedules_that_end_where_the_loss_is_not_defined(schedules, message):
    """Refused at once, not when they have come there; a function may end anywhere."""
    loss = ECPOLoss(make_softmax_policy(torch.eye(3)), tau_prime=0.0)
    lines = {name: linear(*ends, 10) for name, ends in schedules.items()}
    before = loss.tau.item(), loss.tau_prime.item()
    with pytest.raises(ValueError, match=message):
        TemperatureScheduler(loss, **lines)
    assert (loss.tau, loss.tau_prime) == before
    TemperatureScheduler(loss, tau=linear(0.5, 0.0, 10), tau_prime=lambda count: 0.1)
    with pytest.raises(TypeError, match=r"schedule of tau must be a function.*constant\(0.5\)"):
        TemperatureScheduler(loss, tau=0.5)


def test_a_step_that_is_refused_changes_nothing():
    loss = ECPOLoss(make_softmax_policy(torch.eye(4)), tau=0.5, tau_prime=0.1)
    schedules = {"tau": linear(0.5, 0.1, 10), "tau_prime": lambda count: 0.1 if count < 5 else -1}
    temperatures = TemperatureScheduler(loss, **schedules)
    for move in (temperatures.step, lambda count: temperatures.load_state_dict({"count": count})):
        with pytest.raises(ValueError, match="tau_prime must be"):
            move(7)
        assert temperatures.state_dict() == {"count": 0.0}
        assert (loss.tau.item(), loss.tau_prime.item()) == pytest.approx((0.5, 0.1))
    temperatures.step(4)
    assert loss.tau.item() == pytest.approx(0.34)


@pytest.mark.parametrize(
    ("setting", "at_five"),
    [
        (0.3, 0.3),
        (1, 1.0),
        ({"schedule": "constant", "value": 0.3}, 0.3),
        ({"schedule": "linear", "start": 1.0, "end": 0.0, "duration": 10}, 0.5),
        ({"schedule": "exponential", "start": 1.0, "end": 0.01, "duration": 10}, 0.1),
    ],
)
def test_schedule_from_a_configuration(setting, at_five):
    assert make_schedule(setting)(5) == pytest.approx(at_five)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: linear(1.0, 0.0, 0), "duration must be positive, got 0"),
        (lambda: exponential(1.0, 0.0, 10), "Use a linear one to reach 0"),
        (lambda: make_schedule({"schedule": "cosine"}), "one of .*linear.*, got 'cosine'"),
        (lambda: make_schedule({"schedule": "linear", "start": 1.0}), "Wrong arguments.*'end'"),
        (lambda: TemperatureScheduler(Loss(), tua=constant(1.0)), r"no temperature 'tua'.*'tau'"),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_schedule_of_one_s_own_may_have_any_options():
    """Its `end` need not be a temperature."""
    loss = ECPOLoss(make_softmax_policy(torch.eye(4)))
    TemperatureScheduler(loss, tau=partial(lambda count, end: 0.5 + count * end, end=-1))
