"""Groups over gymnasium's vector environments, beside what test_grouped.py asks of all groups."""

from __future__ import annotations

import os
import sys
from functools import partial

import cloudpickle
import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from tensordict import TensorDict
from torchrl.envs import GymEnv, GymWrapper, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_ecpo.collectors import TrajectoryGroupCollector
from torchrl_ecpo.envs import GroupedEnv, VectorGroupedEnv, make_grouped_env

SIZES = {"num_groups": 2, "group_size": 3}


def one_by_one(task, **sizes):
    return GroupedEnv(partial(GymEnv, task, categorical_action_encoding=True), **sizes)


def play(env, actions):
    each = iter(actions)
    return env.rollout(len(actions), lambda td: td.update(next(each)), break_when_any_done=False)


def assert_equal(one, other):
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        if "group" not in key:
            assert one[key].dtype == other[key].dtype
            assert torch.equal(one[key], other[key]), key


@pytest.mark.parametrize(
    ("task", "steps"), [("CartPole-v1", 80), ("Pendulum-v1", 220), ("FrozenLake-v1", 30)]
)
def test_all_ways_give_the_same_numbers(task, steps):
    """Observations, rewards and ends, bit by bit, over more than one episode of each copy."""
    ways = [
        VectorGroupedEnv(partial(gymnasium.make, task), **SIZES),
        one_by_one(task, **SIZES),
        VectorGroupedEnv(task, **SIZES),
    ]
    torch.manual_seed(0)
    actions = [TensorDict({"action": ways[0].action_spec.rand()}, [2, 3]) for _ in range(steps)]
    for env in ways:
        env.set_seed(3)
    played, *others = [play(env, actions) for env in ways]
    assert (played["next", "done"].sum(-2) > 1).any() or task == "Pendulum-v1"
    for other in others:
        assert_equal(played, other)


def test_resumed_by_another_way():
    """What one way saved, another goes on with: the next instances are the same."""
    ways = [lambda: one_by_one("CartPole-v1", **SIZES)]
    ways += [lambda: VectorGroupedEnv("CartPole-v1", **SIZES)]
    ways += [lambda: VectorGroupedEnv(partial(gymnasium.make, "CartPole-v1"), **SIZES)]
    for make, other in zip(ways, ways[1:] + ways[:1], strict=True):
        env = make()
        env.set_seed(1)
        env.rollout(60, break_when_any_done=False)
        resumed = other()
        resumed.load_state_dict(env.state_dict())
        for _ in range(2):
            expected, start = env.reset(), resumed.reset()
            assert torch.equal(expected["observation"], start["observation"])
        assert start["observation"].flatten(0, 1).unique(dim=0).shape[0] == 2


def test_a_collector_goes_on_where_it_was():
    def make():
        env = TransformedEnv(make_grouped_env("CartPole-v1", **SIZES), StepCounter())
        return TrajectoryGroupCollector(env, num_groups=4, group_size=3)

    collector, resumed = make(), make()
    collector.set_seed(2)
    collector.rollout()
    resumed.load_state_dict(collector.state_dict())
    batches = []
    for one in (collector, resumed):
        torch.manual_seed(0)
        batches.append(one.rollout())
        one.shutdown()
    for key in ("observation", "action", ("next", "reward"), ("collector", "mask")):
        assert torch.equal(batches[0][key], batches[1][key])


# A worker process cannot import this file by its name.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


class Countdown(gymnasium.Env):
    """Counts down from 2, 3 or 4 to its end; who steps it then, or acts by 2, is told."""

    observation_space = spaces.Discrete(5)
    action_space = spaces.Discrete(3)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = int(self.np_random.integers(2, 5))
        return self.left, {}

    def step(self, action):
        assert self.left > 0, "stepped after its end"
        self.left = 0 if action == 1 else self.left - 1
        return self.left, 10.0 + self.left, self.left == 0, False, {"terminated": "mine"}


@pytest.mark.parametrize("parallel", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_copy_that_is_over_is_left_alone(parallel):
    """It keeps its last observation and its flags, and earns nothing, until it is reset."""

    def make():
        return gymnasium.wrappers.TimeLimit(Countdown(), 2)

    env = VectorGroupedEnv(make, **SIZES, parallel=parallel)
    env.set_seed(1)
    start = env.reset()
    assert start["observation"].tolist() == [[3] * 3, [4] * 3]
    action = torch.tensor([[1, 0, 0], [0, 1, 0]])
    first = env.step(start.clone().set("action", action))["next"]
    assert first["observation"].tolist() == [[0, 2, 2], [3, 0, 3]]
    assert first["reward"].squeeze(-1).tolist() == [[10, 12, 12], [13, 10, 13]]
    assert first["terminated"].squeeze(-1).tolist() == [[True, False, False], [False, True, False]]
    # One more copy waits, by `_step`.
    step = torch.tensor([[True, True, False], [True, True, True]]).unsqueeze(-1)
    given = first.clone().set("action", torch.zeros(2, 3, dtype=torch.int64)).set("_step", step)
    second = env.step(given)["next"]
    assert second["observation"].tolist() == [[0, 1, 2], [2, 0, 2]]
    assert second["reward"].squeeze(-1).tolist() == [[0, 11, 0], [12, 0, 12]]
    assert second["terminated"].squeeze(-1).tolist() == [[1, 0, 0], [0, 1, 0]]
    assert second["truncated"].squeeze(-1).tolist() == [[0, 1, 0], [1, 0, 1]]
    assert second["done"].squeeze(-1).tolist() == [[1, 1, 0], [1, 1, 1]]
    # The time of the copy that waited stood still.
    third = env.step(second.clone().set("action", torch.ones(2, 3, dtype=torch.int64)))["next"]
    assert third["observation"].tolist() == [[0, 1, 0], [2, 0, 2]]
    assert third["terminated"].squeeze(-1).tolist() == [[1, 0, 1], [0, 1, 0]]
    assert third["truncated"].squeeze(-1).tolist() == [[0, 1, 1], [1, 0, 1]]
    env.close()
    env.close(raise_if_closed=False)


def test_a_reset_is_given_no_options_that_nobody_gave():
    class Level(gymnasium.Env):
        observation_space = gymnasium.spaces.Box(-1, 1, (2,))
        action_space = gymnasium.spaces.Discrete(2)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.level = 1 if options is None else options["level"]
            return np.zeros(2, dtype=np.float32), {}

    env = make_grouped_env(Level, num_groups=1, group_size=2)
    assert env.reset()["observation"].shape == (1, 2, 2)


def test_a_reward_may_be_an_array_of_one_number():
    class Boxed(Countdown):
        def step(self, action):
            observation, reward, *others = super().step(action)
            return observation, np.array([reward]), *others

    for kind in (Countdown, Boxed):
        env = make_grouped_env(kind, **SIZES)
        env.set_seed(1)
        env.reset()
        action = torch.zeros(2, 3, dtype=torch.int64)
        reward = env.step(TensorDict(action=action, batch_size=[2, 3]))["next", "reward"]
        assert reward.flatten().tolist() == [12.0] * 3 + [13.0] * 3


RIGHT = {"x": np.zeros(2, np.float32)}


class Spoilt(gymnasium.Env):
    """Returns what it is told to, which gymnasium does not allow."""

    observation_space = spaces.Dict(x=spaces.Box(-1, 1, (2,)))
    action_space = spaces.Discrete(2)

    def __init__(self, reset=(RIGHT, {}), step=(RIGHT, 0.0, False, False, {}), **own):
        self.out = reset, step
        vars(self).update(own)

    def reset(self, *, seed=None, options=None):
        return self.out[0]

    def step(self, action):
        return self.out[1]


@pytest.mark.parametrize(
    ("spoilt", "match"),
    [
        ({"observation_space": None}, "must have an observation_space .*got None"),
        ({"reset": RIGHT}, r"reset must return \(observation, info\), got {'x'"),
        ({"reset": ({"x": np.zeros(3)}, {})}, r"must be of Dict.*\(2,\).*got {'x': array\(\[0"),
        ({"reset": ({"y": np.zeros(2)}, {})}, "must be of Dict.*got {'y'"),
        ({"step": (RIGHT, 0.0, False, {})}, "step must return .*got a tuple of 4"),
        ({"step": (RIGHT, np.zeros(2), False, False, {})}, "must be one number, got array"),
        ({"step": (RIGHT, None, False, False, {})}, "must be one number, got None"),
    ],
    ids=str,
)
def test_a_copy_that_breaks_the_rules_is_named(spoilt, match):
    with pytest.raises(ValueError, match=f"Spoilt breaks .*{match}.*env_checker.check_env"):
        make_grouped_env(partial(Spoilt, **spoilt), **SIZES).rollout(2)
    make_grouped_env(Spoilt, **SIZES).rollout(2)


def test_each_copy_is_given_options_of_its_own():
    class Taking(Countdown):
        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            return options["levels"].pop(), {}

    start = make_grouped_env(Taking, **SIZES).reset(options={"levels": [1, 2]})
    assert (start["observation"] == 2).all()


TASK = Countdown()


@pytest.mark.parametrize(
    "make",
    [
        lambda: TASK,
        lambda: gymnasium.wrappers.TimeLimit(TASK, 2),
        lambda: TransformedEnv(GymWrapper(TASK), StepCounter()),
    ],
)
def test_a_copy_that_was_made_before_is_refused(make):
    with pytest.raises(ValueError, match=r"must make a new copy at each call.*lambda: MyTask"):
        make_grouped_env(make, **SIZES).reset()


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("when", ["reset", "step"])
def test_the_death_of_a_process_is_told(when):
    class Dying(Countdown):
        def reset(self, **options):
            out = super().reset(**options)
            return os._exit(3) if when == "reset" else out

        def step(self, action):
            return os._exit(3) if action == 2 else super().step(action)

    env = make_grouped_env(Dying, num_groups=1, group_size=2, parallel=True)
    dead = "[01]" if when == "reset" else "1"
    with pytest.raises(ChildProcessError, match=rf"died in a {when} .*{dead}: 3.*make it again"):
        env.step(env.reset().set("action", torch.tensor([[0, 2]])))
    assert not any(process.is_alive() for process in env._vector.processes)
    env.close()


def test_no_step_is_played_for_nothing():
    """Over a batch, copies are stepped as often as it has steps."""
    count = 0

    class Counted(Countdown):
        def step(self, action):
            nonlocal count
            count += 1
            return super().step(action)

    env = make_grouped_env(Counted, **SIZES)
    batch = TrajectoryGroupCollector(env, num_groups=4, group_size=3).rollout()
    assert 12 < count == batch["collector", "mask"].sum()


@pytest.fixture
def short_cartpole():
    name = "ShortCartPole-v0"
    own = gymnasium.spec("CartPole-v1")
    gymnasium.register(
        name,
        own.entry_point,
        max_episode_steps=7,
        vector_entry_point=own.vector_entry_point,
        kwargs={"sutton_barto_reward": True},
    )
    yield name
    del gymnasium.registry[name]


def test_the_vector_entry_point_keeps_the_rules_of_its_task(short_cartpole, monkeypatch):
    """Time limit and arguments are the task's; in processes, the entry point is not taken."""
    seen = []
    step = CartPoleVectorEnv.step
    monkeypatch.setattr(CartPoleVectorEnv, "step", lambda *a: seen.append(0) or step(*a))
    actions = [TensorDict({"action": torch.tensor([[0, 1, i % 2]] * 2)}, [2, 3]) for i in range(20)]
    ways = [VectorGroupedEnv(short_cartpole, **SIZES), one_by_one(short_cartpole, **SIZES)]
    for env in ways:
        env.set_seed(5)
    played, other = (play(env, actions) for env in ways)
    assert len(seen) == 20
    assert_equal(played, other)
    assert played["next", "truncated"].sum() == 2 * 3 * 2
    assert (played["next", "reward"] == 0).all()
    start = [env.reset(options={"low": 0.5, "high": 0.6})["observation"] for env in ways]
    assert torch.equal(*start)
    assert (start[0] >= 0.5).all()


class Arranged(gymnasium.Env):
    """Shows and takes what it is told to; its reward is what it is given."""

    def __init__(self, observation, action=None):
        self.observation_space = observation
        self.action_space = spaces.Discrete(2) if action is None else action

    def reset(self, *, seed=None, options=None):
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        reward = sum(float(np.sum(x)) for x in spaces.flatten(self.action_space, action))
        return self.observation_space.sample(), reward, False, False, {}


def wrapped(space):
    return GymWrapper(Arranged(space), categorical_action_encoding=True)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (spaces.Box(0, 1, (2, 3)), {"observation": ((2, 3), torch.float32)}),
        (spaces.Box(0, 1, (), np.float64), {"observation": ((1,), torch.float64)}),
        (spaces.Box(0, 255, (2, 4), np.uint8), {"observation": ((2, 4), torch.uint8)}),
        (spaces.Box(0, 255, (4, 4, 3), np.uint8), {"pixels": ((4, 4, 3), torch.uint8)}),
        (spaces.Discrete(5), {"observation": ((), torch.int64)}),
        (spaces.MultiDiscrete([2, 3]), {"observation": ((2,), torch.int64)}),
        (spaces.MultiDiscrete([3, 3]), {"observation": ((2,), torch.int64)}),
        (spaces.MultiBinary(4), {"observation": ((4,), torch.int8)}),
        (
            spaces.Dict(state=spaces.Discrete(3), own=spaces.Dict(x=spaces.Box(0, 1, (2,)))),
            {"observation": ((), torch.int64), ("own", "x"): ((2,), torch.float32)},
        ),
        (
            spaces.Tuple([spaces.Discrete(3), spaces.MultiBinary(2)]),
            {
                ("observation", "0"): ((), torch.int64),
                ("observation", "1"): ((2,), torch.int8),
            },
        ),
    ],
    ids=str,
)
def test_observations_of_a_space(space, expected):
    env = make_grouped_env(partial(Arranged, space), **SIZES)
    check_env_specs(env, seed=0)
    env.set_seed(0)
    start = env.reset()
    for key, (shape, dtype) in expected.items():
        assert start[key].shape == (2, 3, *shape)
        assert start[key].dtype == env.observation_spec[key].dtype == dtype
    assert len([*env.observation_spec.keys(True, True)]) == len(expected) + 1
    assert torch.equal(start[key][:, 0], start[key][:, 2])
    if not isinstance(space, spaces.Tuple):  # of which TorchRL's wrapper reads but the first part
        copies = GroupedEnv(partial(wrapped, space), **SIZES)
        copies.set_seed(0)
        assert_equal(start, copies.reset())


def test_actions_of_several_kinds():
    """What an entry holds is what a copy is given, wherever it stands."""
    space = spaces.Dict(
        a=spaces.MultiDiscrete([2, 3]),
        b=spaces.Tuple([spaces.Box(-1, 1, (2,)), spaces.MultiBinary(2)]),
    )
    env = make_grouped_env(partial(Arranged, spaces.Discrete(2), space), num_groups=1, group_size=2)
    check_env_specs(env, seed=0)
    start = env.reset()
    start["a"] = torch.tensor([[[0, 1], [1, 2]]])
    start["b", "0"] = torch.tensor([[[0.25, 0.5], [-0.5, -0.25]]])
    start["b", "1"] = torch.tensor([[[1, 1], [0, 1]]], dtype=torch.int8)
    # Of a MultiDiscrete, flattened, each choice adds 1.
    assert env.step(start)["next", "reward"].flatten().tolist() == [2 + 0.75 + 2, 2 - 0.75 + 1]


NUMBER = spaces.Box(-1, 1, (1,))


@pytest.mark.parametrize(
    ("space", "match"),
    [
        (spaces.Text(3), r"The space of observation must be Box, .*got Text.*Transform"),
        (
            spaces.Dict(image=spaces.Box(0, 1, (2,)), mission=spaces.Text(3)),
            r"observation\['mission'\] must .*got Text.*gymnasium\.wrappers\.FilterObservation",
        ),
        (spaces.Sequence(spaces.Discrete(2)), "got Sequence.*TransformObservation"),
        (spaces.Graph(spaces.Discrete(2), None), "got Graph.*TransformObservation"),
        (spaces.Discrete(3, start=1), "counted from 0.*got Discrete.*TransformObservation"),
        (spaces.Box(0, 9, (2,), np.uint16), "TorchRL does not read.*TransformObservation"),
        (spaces.Dict(done=spaces.Discrete(2)), r"entries \['done'\], .* itself.*FilterObservation"),
        *(
            (spaces.Dict({name: NUMBER}), rf"entries \['{name}'\], .* itself.*FilterObservation")
            for name in ("next", "_step", "_reset", "is_init", "collector")
        ),
        (spaces.Dict({0: NUMBER}), r"strings as names, got \[0\].*FilterObservation"),
    ],
    ids=str,
)
def test_a_space_that_is_not_read_is_refused(space, match):
    with pytest.raises((TypeError, ValueError), match=match):
        make_grouped_env(partial(Arranged, space), **SIZES)


@pytest.mark.parametrize(
    ("space", "match"),
    [
        (spaces.Dict(hand=spaces.Text(2)), r"action\['hand'\].*got Text.*TransformAction"),
        (spaces.MultiDiscrete([[2, 3], [4, 5]]), r"(?s)got MultiDiscrete.*TransformAction"),
        (spaces.Dict(seen=NUMBER), r"\['seen'\], which the observation .*TransformAction"),
    ],
    ids=str,
)
def test_actions_that_are_not_played_are_refused(space, match):
    with pytest.raises((TypeError, ValueError), match=match):
        make_grouped_env(partial(Arranged, spaces.Dict(seen=NUMBER), space), **SIZES)


@pytest.mark.parametrize("make", ["CartPole-v1", Countdown], ids=str)
@pytest.mark.parametrize(
    ("action", "match"),
    [
        (torch.full((2, 3), 5), r"'action' must be of MultiDiscrete.*got \[5"),
        (torch.full((2, 3), -1), r"'action' must be of MultiDiscrete.*got \[-1"),
        (torch.full((2, 3), 0.5), "'action' must hold integers, got torch.float32"),
        (torch.zeros(2, 3, 1, dtype=torch.int64), r"'action' must have the shape \[2, 3\], got"),
    ],
    ids=str,
)
def test_what_is_no_action_is_refused(make, action, match):
    env = make_grouped_env(make, **SIZES)
    start = env.reset()
    with pytest.raises(ValueError, match=match):
        env.step(start.set("action", action))
    missing = env.reset()
    with pytest.raises(KeyError, match="The entry 'action' is missing"):
        env.step(missing)
