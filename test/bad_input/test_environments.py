"""Bad arguments, actions and states of the environments."""

from __future__ import annotations

import pytest
import torch
from faults import Fault, Subject, check, tensordict_of
from torchrl.envs import GymEnv, TransformedEnv

from torchrl_ecpo.envs import (
    AlgorithmicEnv,
    BanditEnv,
    DeepSeaEnv,
    EpisodeReplay,
    GroupedEnv,
    GroupIdAllocator,
    make_grouped_env,
)

OLD = "of a state written before states had an owner"
SEED = "a seed as any other"


def without(entries, *names):
    return {name: x for name, x in entries.items() if name not in names}


def act(env, entries, *, names=("observation", "reward")):
    """What a step leads to."""
    start = env.reset()
    actions = {"action": entries["action"]} if "action" in entries else {}
    start.update(tensordict_of(actions, start.shape))
    after = env.step(start)["next"]
    return {name: after[name] for name in names}


def bandit(entries):
    env = BanditEnv(**without(entries, "action"))
    default = torch.zeros(env.batch_size, dtype=torch.int64)
    return act(env, {"action": default} | entries), env.features


def play_bandit(entries):
    return act(BanditEnv(num_actions=5, num_groups=2, group_size=3), entries)


def deep_sea(entries):
    env = DeepSeaEnv(**entries)
    return env.right, env.reset()["group"].shape


def dive(entries):
    env = DeepSeaEnv(3, num_groups=2, group_size=3)
    after = env.step(tensordict_of(entries, env.batch_size))["next"]
    return after["observation"], after["reward"]


def expected_reward(entries):
    return BanditEnv(num_actions=4).expected_reward(**entries)


def algorithmic(entries):
    env = AlgorithmicEnv(**without(entries, "instance"))
    start = env.reset(**{name: entries[name] for name in ("instance",) if name in entries})
    return start["observation"], start["level"], env.batch_size


def play_task(entries):
    env = AlgorithmicEnv("copy", num_groups=2, group_size=2, seed=0)
    return act(env, entries)


def make_pendulum():
    return GymEnv("Pendulum-v1")


def grouped(entries):
    env = GroupedEnv(**without(entries, "seed"))
    env.set_seed(entries.get("seed", 0))
    return env.reset()["observation"]


def play_grouped(entries):
    env = GroupedEnv(make_pendulum, num_groups=1, group_size=2)
    env.set_seed(0)
    return act(env, entries)


def vectorised(entries):
    env = make_grouped_env(**without(entries, "seed"))
    env.set_seed(entries.get("seed", 0))
    return env.reset()["observation"]


def play_vectorised(entries):
    env = make_grouped_env("Pendulum-v1", num_groups=1, group_size=2)
    env.set_seed(0)
    return act(env, entries)


def play_cartpole(entries):
    env = make_grouped_env("CartPole-v1", num_groups=1, group_size=2)
    env.set_seed(0)
    return act(env, entries)


def allocate(entries):
    ids = GroupIdAllocator().allocate(**entries)
    return ids - ids[:1]


def identify(entries):
    allocator = GroupIdAllocator()
    return allocator.identify(*entries.values()) - allocator.identify(3)


def resume(make):
    def run(entries):
        env = make()
        torch.manual_seed(0)
        env.load_state_dict(entries if "_extra_state" in entries else {"_extra_state": entries})
        return env.reset()["observation"]

    return run


def make_task():
    return AlgorithmicEnv("copy", num_groups=2, group_size=2, seed=0)


def make_group():
    return GroupedEnv(make_pendulum, num_groups=1, group_size=2)


def make_replay():
    return TransformedEnv(make_pendulum(), EpisodeReplay())


def resume_replay(entries):
    env = make_replay()
    env.transform.set_extra_state(entries)
    return env.transform.get_extra_state()["actions"]


def replayed():
    env = make_replay()
    env.set_seed(0)
    env.rollout(2)
    return env.transform.get_extra_state()


ANY_BATCH = ("empty", "an axis less", "too long in axis 0")
MAKERS = [Fault(repr(x), x) for x in (None, "text", 3, [], {})]
MAKERS += [Fault("makes text", lambda: "text"), Fault("an environment", make_pendulum())]
MAKERS += [Fault("a batch", make_task)]
INSTANCE = torch.tensor([[[0, 3, -1], [0, 3, -1]], [[1, 1, 2], [1, 1, 2]]])
SUBJECTS = {
    "BanditEnv": Subject(
        bandit,
        {
            "num_actions": 5,
            "num_features": 3,
            "exponent": 8.0,
            "instance_seed": 1,
            "num_groups": 2,
            "group_size": 3,
        },
        optional=[
            "num_actions",
            "num_features",
            "exponent",
            "instance_seed",
            "num_groups",
            "group_size",
        ],
        fine={("instance_seed", "0"): SEED},
    ),
    "BanditEnv.step": Subject(play_bandit, {"action": torch.tensor([[0, 1, 2], [4, 1, 0]])}),
    "BanditEnv.expected_reward": Subject(
        expected_reward,
        {"probabilities": torch.full((2, 4), 0.25)},
        hands_on_nan=True,
        fine={("probabilities", name): "any batch" for name in ANY_BATCH},
    ),
    "DeepSeaEnv": Subject(
        deep_sea,
        {"size": 3, "instance_seed": 1, "num_groups": 2, "group_size": 3},
        optional=["size", "instance_seed", "num_groups", "group_size"],
        fine={("instance_seed", "0"): SEED},
    ),
    "DeepSeaEnv.step": Subject(
        dive,
        {
            "observation": torch.tensor([[0, 3, 4], [6, 7, 8]]),
            "action": torch.tensor([[0, 1, 1], [0, 1, 0]]),
        },
    ),
    "AlgorithmicEnv": Subject(
        algorithmic,
        {
            "task": "copy",
            "num_groups": 2,
            "group_size": 2,
            "min_length": 4,
            "curriculum": "group",
            "seed": 1,
        },
        optional=["num_groups", "group_size", "min_length", "curriculum", "seed"],
        fine={("seed", "0"): SEED},
    ),
    "AlgorithmicEnv.reset": Subject(
        algorithmic,
        {"instance": INSTANCE, "task": "copy", "num_groups": 2, "group_size": 2},
        fine={("instance", "too short in axis 2"): "shorter instances"},
        optional=["instance", "num_groups", "group_size"],
    ),
    "AlgorithmicEnv.step": Subject(
        play_task, {"action": torch.tensor([[[1, 1, 3], [0, 0, 0]], [[1, 1, 2], [0, 1, 4]]])}
    ),
    "AlgorithmicEnv.load_state_dict": lambda: Subject(
        resume(make_task),
        make_task().state_dict(),
        fine={("_extra_state", "{}"): OLD},
        hands_on_nan=True,
    ),
    "GroupedEnv": Subject(
        grouped,
        {
            "create_env_fn": make_pendulum,
            "num_groups": 1,
            "group_size": 2,
            "parallel": False,
            "seed": 1,
        },
        faults={"create_env_fn": MAKERS},
        optional=["parallel", "seed"],
        fine={("seed", "0"): SEED},
    ),
    "GroupedEnv.step": Subject(
        play_grouped, {"action": torch.tensor([[[0.5], [-0.5]]])}, hands_on_nan=True
    ),
    "make_grouped_env": Subject(
        vectorised,
        {"env": "Pendulum-v1", "num_groups": 1, "group_size": 2, "parallel": False, "seed": 1},
        faults={"env": MAKERS},
        optional=["parallel", "seed"],
        fine={("seed", "0"): SEED},
    ),
    "make_grouped_env().step": Subject(
        play_vectorised, {"action": torch.tensor([[[0.5], [-0.5]]])}, hands_on_nan=True
    ),
    "make_grouped_env().step, choices": Subject(play_cartpole, {"action": torch.tensor([[1, 0]])}),
    "GroupedEnv.load_state_dict": lambda: Subject(
        resume(make_group),
        {**make_group().get_extra_state(), "seed": 1},
        fine={("env", "missing"): OLD, ("seed", "0"): SEED},
    ),
    "EpisodeReplay.load_state_dict": lambda: Subject(
        resume_replay,
        replayed(),
        fine={("env", "missing"): OLD, ("actions", "[]"): "an episode that begins"},
    ),
    "GroupIdAllocator.allocate": Subject(
        allocate, {"count": 3, "stride": 2}, fine={("count", "0"): "none"}, optional=["stride"]
    ),
    "GroupIdAllocator.identify": Subject(
        identify, {"key": 3}, fine={("key", "0"): "a key"}, optional=["key"]
    ),
}


@pytest.mark.parametrize("name", SUBJECTS)
def test_environments(name):
    subject = SUBJECTS[name]
    check(f"`{name}`", subject() if callable(subject) else subject)
