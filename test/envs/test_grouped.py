from __future__ import annotations

import gc
import os
import pickle
import re
import sys
from functools import partial
from threading import Lock
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType

import gymnasium
import numpy
import pytest
import torch
from gymnasium.envs.classic_control import CartPoleEnv
from tensordict import TensorDict
from torch.testing import assert_close
from torchrl.collectors import Collector
from torchrl.data import Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    Compose,
    DMControlEnv,
    DoubleToFloat,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    GymWrapper,
    InitTracker,
    PendulumEnv,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_ecpo.envs import (
    AlgorithmicEnv,
    BanditEnv,
    EpisodeReplay,
    GroupedEnv,
    GroupIdAllocator,
    make_grouped_env,
)
from torchrl_ecpo.groups import TrajectoryGroupSampler

# A function of this module could not be imported by worker processes.
cartpole = partial(GymEnv, "CartPole-v1", categorical_action_encoding=True)
CARTPOLES = {
    "one by one": cartpole,
    "SyncVectorEnv": partial(gymnasium.make, "CartPole-v1"),
    "vector entry point": "CartPole-v1",
}
"""Ways to play one task in groups, which give the same numbers."""

each_way = pytest.mark.parametrize("make", CARTPOLES.values(), ids=CARTPOLES)


MAKERS = {
    **{f"CartPole-v1, {way}": (make, "observation") for way, make in CARTPOLES.items()},
    "Pendulum-v1, SyncVectorEnv": ("Pendulum-v1", "observation"),
    "Pendulum-v1": (lambda: GymEnv("Pendulum-v1"), "observation"),
    "dm_control cartpole": (lambda: DMControlEnv("cartpole", "balance"), "position"),
    "torch": (PendulumEnv, "th"),
    "transformed": (lambda: TransformedEnv(cartpole(), StepCounter(max_steps=5)), "observation"),
}


@pytest.fixture(autouse=True)
def headless(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")


@pytest.mark.parametrize("maker", MAKERS)
def test_groups_of_any_environment(maker):
    make, key = MAKERS[maker]
    env = make_grouped_env(make, num_groups=2, group_size=2)
    check_env_specs(env, seed=0)
    if maker != "transformed":
        transforms = [InitTracker(), RewardSum(), StepCounter(max_steps=4), DoubleToFloat()]
        env = TransformedEnv(env, Compose(*transforms))
        check_env_specs(env, seed=0)
    groups, starts = [], []
    for _ in range(3):
        start = env.reset()
        assert start.shape == (2, 2)
        assert (start[key] == start[key][:, :1]).all()
        assert (start["group"] == start["group"][:, :1]).all()
        groups.append(start["group"][:, 0])
        starts.append(start[key][:, 0].double().reshape(2, -1))
    assert torch.cat(groups).unique().numel() == 6
    assert torch.cat(starts).unique(dim=0).shape[0] == 6
    rollout = env.rollout(12, break_when_any_done=False)
    assert rollout.shape == (2, 2, 12)
    assert rollout["next", "done"].any()
    # The group changes where an episode starts, and nowhere else.
    changed = rollout["group"][..., 1:] != rollout["group"][..., :-1]
    assert (changed == rollout["next", "done"][..., :-1, 0]).all()
    assert (rollout["next", "group"] == rollout["group"]).all()
    env.close()


@each_way
def test_nth_episodes_agree_though_copies_reset_at_different_times(make):
    env = make_grouped_env(make, num_groups=2, group_size=3)
    rollout = env.rollout(120, break_when_any_done=False)
    first = torch.cat(
        [torch.ones(2, 3, 1, dtype=torch.bool), rollout["next", "done"][..., :-1, 0]], -1
    )
    seen = {}
    for row in range(2):
        for copy in range(3):
            starts = rollout[row, copy][first[row, copy]]
            for group, start in zip(starts["group"].tolist(), starts["observation"], strict=True):
                seen.setdefault(group, []).append((row, start))
    assert max(map(len, seen.values())) == 3
    for starts in seen.values():
        assert len({row for row, _ in starts}) == 1
        assert all(torch.equal(start, starts[0][1]) for _, start in starts)
    # The second episodes did start at different times.
    second = (first.cumsum(-1) == 2).int().argmax(-1)
    assert second.unique().numel() > 2
    full = env.reset()
    assert (full["group"] == full["group"][:, :1]).all()
    assert set(full["group"].unique().tolist()).isdisjoint(seen)
    env.close()


@each_way
def test_seed_decides_the_instances(make):
    env, other = (make_grouped_env(make, num_groups=2, group_size=2) for _ in range(2))

    def starts(env, seed):
        env.set_seed(seed)
        return torch.stack([env.reset()["observation"] for _ in range(2)])

    assert (starts(env, 3) == starts(other, 3)).all()
    assert (starts(env, 3) != starts(other, 4)).any()
    groups = [e.reset()["group"][0, 0].item() for e in (env, other)]
    env.set_seed(3)
    groups.append(env.reset()["group"][0, 0].item())
    assert len(set(groups)) == 3  # the same start under the same seed is another instance
    env.close()
    other.close()


@pytest.mark.parametrize("make", [*CARTPOLES.values(), PendulumEnv])
def test_reset_leaves_the_random_state_alone(make):
    env = make_grouped_env(make, num_groups=2, group_size=2)
    env.reset()  # the copies are made here
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    env.reset()
    env.reset()
    assert (torch.rand(3) == expected).all()
    env.close()


@each_way
def test_partial_steps_and_resets_leave_the_others_where_they_are(make):
    env = make_grouped_env(make, num_groups=1, group_size=2)
    start = env.reset()
    td = env.rand_action(start.clone())
    step = torch.tensor([[[True], [False]]])
    following = env.step(td.set("_step", step))["next"]
    moved = (following["observation"] != start["observation"]).any(-1)
    assert moved.tolist() == [[True, False]]
    again = env.reset(start.clone().set("_reset", step))
    assert (again["group"] == start["group"]).tolist() == [[False, True]]
    env.close()


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("make", [cartpole, "CartPole-v1"], ids=["ParallelEnv", "AsyncVectorEnv"])
def test_parallel(make):
    env = make_grouped_env(make, num_groups=1, group_size=2, parallel=True)
    serial = make_grouped_env(make, num_groups=1, group_size=2)
    for e in (env, serial):
        e.set_seed(1)
    rollouts = [
        e.rollout(
            40,
            policy=lambda td: td.set("action", torch.tensor([[1, 0]])),
            break_when_any_done=False,
        )
        for e in (env, serial)
    ]
    assert (rollouts[0]["observation"] == rollouts[1]["observation"]).all()
    assert (rollouts[0]["next", "done"].sum(-2) > 1).all()
    env.close()
    serial.close()


@each_way
def test_collector_and_sampler(make):
    env = TransformedEnv(make_grouped_env(make, num_groups=2, group_size=3), StepCounter())
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(1000),
        sampler=TrajectoryGroupSampler(group_size=3),
        batch_size=6,
    )
    collector = Collector(
        env,
        frames_per_batch=60,
        total_frames=1200,
        trajs_per_batch=1,
        replay_buffer=buffer,
    )
    for _ in collector:
        if not buffer.can_sample():
            continue
        sample = buffer.sample()
        mask = sample["collector", "mask"]
        assert (sample["step_count"][..., 0, :] == 0).all()
        first = sample["observation"][..., 0, :]
        assert (first == first[:, :1]).all()
        assert (sample["group"] == sample["group"][:, :1, :1]).all()
        assert (sample["next", "done"].squeeze(-1) & mask).sum(-1).eq(1).all()
    assert buffer.can_sample()


@pytest.mark.parametrize(
    ("make", "sizes", "match"),
    [
        (cartpole, (1, 1), r"group_size must be .* at least 2.*got 1"),
        (cartpole, (0, 2), r"num_groups must be .* at least 1, got 0"),
        (lambda: SerialEnv(2, cartpole), (1, 2), r"batch size \(\), got \(2,\)"),
        ("CartPole-v1", (1, 2), "create_env_fn must be a function that makes a copy"),
        (GymEnv("CartPole-v1"), (1, 2), "create_env_fn must be a function that makes a copy"),
        (lambda: None, (1, 2), "must make an environment of TorchRL .* got None"),
    ],
)
def test_bad_input(make, sizes, match):
    with pytest.raises((TypeError, ValueError), match=match):
        GroupedEnv(make, num_groups=sizes[0], group_size=sizes[1])


@pytest.mark.parametrize(
    ("make", "sizes", "match"),
    [
        ("CartPole-v1", (1, 1), r"group_size must be .* at least 2.*got 1"),
        ("CartPole-v1", (0, 2), r"num_groups must be .* at least 1, got 0"),
        ("CartPol-v1", (1, 2), "env='CartPol-v1' is no task of gymnasium: .*doesn't exist"),
        (3, (1, 2), "env must be an id .* or a function that makes a copy, got 3"),
        (GymEnv("CartPole-v1"), (1, 2), "env must be .* a function that makes a copy"),
        (lambda: None, (1, 2), "What env makes must be an Env or EnvBase, got None"),
    ],
)
def test_bad_input_of_the_front(make, sizes, match):
    with pytest.raises((TypeError, ValueError), match=match):
        make_grouped_env(make, num_groups=sizes[0], group_size=sizes[1])


class SeveralActions(gymnasium.Env):
    observation_space = gymnasium.spaces.MultiDiscrete([4, 5])
    action_space = gymnasium.spaces.MultiDiscrete([2, 3])

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.integers([4, 5]), {}

    def step(self, action):
        return numpy.array([0, 0]), float(action @ [1, 10]), True, False, {}


@pytest.mark.parametrize(("categorical", "width"), [(True, 2), (False, 5)])
def test_groups_over_several_discrete_actions(categorical, width):
    def make():
        return GymWrapper(SeveralActions(), categorical_action_encoding=categorical)

    env = GroupedEnv(make, num_groups=2, group_size=30)
    check_env_specs(env, seed=0)
    played = env.rollout(2)
    assert played["action"].shape == (2, 30, 1, width)
    assert sorted(played["next", "reward"].unique()) == [0, 1, 10, 11, 20, 21], "each action"
    assert (played["observation"] == played["observation"][:, :1]).all()


@pytest.mark.parametrize(
    ("make", "other"),
    [
        *(
            (
                partial(make_grouped_env, make, num_groups=2, group_size=2),
                partial(make_grouped_env, make, num_groups=1, group_size=2),  # would be broadcast
            )
            for make in CARTPOLES.values()
        ),
        (
            lambda: GroupedEnv(cartpole, num_groups=1, group_size=2),
            lambda: GroupedEnv(lambda: GymEnv("Acrobot-v1"), num_groups=1, group_size=2),
        ),
        (
            lambda: TransformedEnv(GymEnv("Pendulum-v1"), EpisodeReplay()),
            lambda: TransformedEnv(GymEnv("MountainCarContinuous-v0"), EpisodeReplay()),
        ),
        (lambda: AlgorithmicEnv("copy"), lambda: AlgorithmicEnv("reverse")),
        (lambda: AlgorithmicEnv("copy", num_groups=2), lambda: AlgorithmicEnv("copy")),
        (
            lambda: AlgorithmicEnv("copy"),
            lambda: AlgorithmicEnv("copy", curriculum="batch"),  # of as many levels
        ),
    ],
)
def test_the_state_of_another_environment_is_refused(make, other):
    env = make()
    env.reset()
    before = str(env.state_dict())
    strange = other()
    strange.rollout(2)
    with pytest.raises(ValueError, match=r"The state is of another environment: of .*, and"):
        env.load_state_dict(strange.state_dict())
    assert str(env.state_dict()) == before
    env.load_state_dict(make().state_dict())


def test_a_state_from_before_states_had_an_owner_is_taken():
    env = AlgorithmicEnv("copy")
    state = {name: value for name, value in env.state_dict().items() if name != "_extra_state"}
    AlgorithmicEnv("copy").load_state_dict(state)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: SerialEnv(2, cartpole), r"got SerialEnv\. Put"),
        (lambda: GymEnv("CartPole-v1", num_envs=2), r"got GymEnv of batch size \(2,\)\. Put"),
    ],
)
def test_episodes_of_other_environments_are_not_replayed(make, match):
    env = TransformedEnv(make(), EpisodeReplay(), auto_unwrap=True)
    with pytest.raises(TypeError, match=rf"one task of gymnasium or dm_control, {match}"):
        env.reset()
    env.close(raise_if_closed=False)


def test_an_index_is_refused_where_one_hot_actions_are_read():
    env = GroupedEnv(lambda: GymEnv("CartPole-v1"), num_groups=1, group_size=2)
    start = env.reset()
    with pytest.raises(ValueError, match=r"'action' of shape \(1, 2\),.*OneHot .*categorical_act"):
        env.step(start.set("action", torch.zeros(1, 2, dtype=torch.int64)))


@pytest.mark.parametrize("env", [AlgorithmicEnv("copy"), BanditEnv(num_actions=3)], ids=type)
def test_a_seed_is_counted(env):
    for seed in (-1, 0.5, "3"):
        with pytest.raises(ValueError, match="seed must be an integer of at least 0"):
            env.set_seed(seed)


@pytest.mark.parametrize("nested", [False, True])
def test_episodes_of_unseen_steps_are_not_replayed(nested):
    """Behind a transform that steps by itself; in front of it they are."""
    replay, skip = EpisodeReplay(), FrameSkipTransform(3)
    transform = Compose(skip, Compose(replay)) if nested else Compose(skip, replay)
    with pytest.raises(TypeError, match=r"behind FrameSkipTransform, .* put it in front"):
        TransformedEnv(GymEnv("Pendulum-v1"), transform).reset()
    env, other = (
        TransformedEnv(
            GymEnv("Pendulum-v1"), Compose(EpisodeReplay(), FrameSkipTransform(3), StepCounter())
        )
        for _ in range(2)
    )
    state = env.rollout(3)[-1]["next"]
    other.load_state_dict(env.state_dict())
    after = [each.step(state.clone().set("action", torch.ones(1))) for each in (env, other)]
    assert_close(after[0]["next", "observation"], after[1]["next", "observation"], rtol=0, atol=0)


def test_an_episode_of_a_seed_given_to_its_reset_is_replayed():
    env, other = (TransformedEnv(GymEnv("Pendulum-v1"), EpisodeReplay()) for _ in range(2))
    start = env.reset(seed=3)
    env.step(start.set("action", torch.zeros(1)))
    other.load_state_dict(env.state_dict())
    action = TensorDict({"action": torch.ones(1)})
    after, again = (each.step(action.clone())["next"] for each in (env, other))
    assert (after["observation"] == again["observation"]).all()


def test_the_copies_move_with_their_environment():
    class Still(EnvBase):
        def __init__(self):
            super().__init__()
            self.observation_spec = Composite(observation=Unbounded(2))
            self.action_spec = self.reward_spec = Unbounded(1)

        def _reset(self, tensordict=None, **kwargs):
            return TensorDict(observation=torch.zeros(2), device=self.device)

        def _step(self, tensordict):
            return self._reset().set("reward", tensordict["action"])

        def _set_seed(self, seed):
            pass

    env = GroupedEnv(Still, num_groups=1, group_size=2)
    assert env.to("meta") is env
    assert env.copies.device == env.device == torch.device("meta")
    assert env._group.device == env.device


class Careless(gymnasium.Env):
    """Draws its start from a generator that its reset does not seed."""

    observation_space = gymnasium.spaces.Box(0, 1, (1,), dtype="float64")
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return numpy.random.rand(1), {}


@pytest.mark.parametrize(
    ("make", "advice"),
    [(lambda: GymWrapper(Careless()), r", or from torch's\.$"), (Careless, r"\.$")],
)
def test_copies_that_start_differently_are_refused(make, advice):
    env = make_grouped_env(make, num_groups=1, group_size=2)
    match = rf"differ in 'observation' at their start.*self\.np_random{advice}"
    with pytest.raises(RuntimeError, match=match):
        env.reset()
    with pytest.raises(TypeError, match=r"seeded by set_seed\(\.\.\.\).*got seed=3"):
        env.reset(seed=3)
    env.close()


@each_way
def test_episodes_that_are_over_are_forgotten(make):
    """Copies that are reset one by one, and never all together, keep no record of the past."""
    env = make_grouped_env(make, num_groups=1, group_size=2)
    start = env.reset()

    def episodes(number):
        for _ in range(number):
            for mask in ([True], [False]), ([False], [True]):
                env.reset(start.clone().set("_reset", torch.tensor([mask])))

    def kept():
        """Bytes of the environment, our modules, and all that they refer to, but others' code."""
        code = (type, ModuleType, FunctionType, MethodType, BuiltinFunctionType)
        is_ours = re.compile(r"torchrl_ecpo\b").match
        sizes = {}
        left = [env, *(vars(module) for name, module in sys.modules.items() if is_ours(name))]
        while left:
            each = left.pop()
            is_code = isinstance(each, code) and not is_ours(f"{getattr(each, '__module__', '')}")
            if id(each) not in sizes and not is_code:
                sizes[id(each)] = sys.getsizeof(each)
                left += gc.get_referents(each)
        return sum(sizes.values())

    episodes(10)
    before = kept()
    episodes(100)
    assert (kept() - before) / (2 * 100) < 5, "bytes an episode"
    env.close()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that are forked")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_ids_of_forked_processes_differ():
    allocator = GroupIdAllocator()
    allocator.allocate(1)
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.write(writer, str(int(allocator.allocate(1))).encode())
        os._exit(0)
    os.waitpid(child, 0)
    assert int(os.read(reader, 100)) != int(allocator.allocate(1))
    os.close(reader)
    os.close(writer)


class Locked(CartPoleEnv):
    """A task that cannot be pickled."""

    def __init__(self) -> None:
        super().__init__()
        self.lock = Lock()


def test_copies_go_into_no_pickle():
    env = GroupedEnv(lambda: GymWrapper(Locked()), num_groups=1, group_size=2)
    assert pickle.loads(pickle.dumps(env)).reset()["observation"].shape == (1, 2, 4)
    env.reset(seed=None)
    env.close()
