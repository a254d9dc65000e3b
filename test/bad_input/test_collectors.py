"""Bad arguments and states of the collectors."""

from __future__ import annotations

from functools import partial
from itertools import islice

import pytest
import torch
from faults import Fault, Subject, check
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv
from torchrl.envs.utils import ExplorationType

from torchrl_ecpo import BanditEnv, TrajectoryGroupCollector, make_softmax_policy
from torchrl_ecpo.collectors import SupervisedAsyncCollector, SupervisedSyncCollector, shut_down
from torchrl_ecpo.collectors.supervised import Workers

FEATURES = torch.linspace(-1, 1, 15).reshape(5, 3)


def make_env():
    return BanditEnv(num_actions=5, num_features=3, num_groups=2, group_size=3)


def make_policy():
    return make_softmax_policy(FEATURES)


def make_buffer():
    return TensorDictReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)


def same(batch):
    return batch


def collect(entries):
    torch.manual_seed(0)
    made = {name: x() if x in (make_policy, make_buffer) else x for name, x in entries.items()}
    collector = TrajectoryGroupCollector(**made)
    with shut_down(collector):
        batches = [batch for batch in islice(collector, 2) if batch is not None]
        batches += [made["replay_buffer"][:]] if "replay_buffer" in entries else []
        return [batch["action"] for batch in batches]


def use(method):
    """Some method of a collector, and then a batch."""

    def run(entries):
        torch.manual_seed(0)
        collector = TrajectoryGroupCollector(make_env, make_policy(), num_groups=2, group_size=3)
        with shut_down(collector):
            method(collector, entries)
            batch = next(iter(collector))
            state = collector.state_dict()
        counts = state["frames"], state["iter"]
        return batch["action_log_prob"], batch["collector", "traj_ids"], counts

    return run


def load_state(collector, entries):
    (player,) = collector.state_dict()["players"]
    next_id = {"next_id": entries.pop("next_id")} if "next_id" in entries else {}
    player = {name: x for name, x in player.items() if name != "next_id"} | next_id
    collector.load_state_dict({"players": [player], **entries})


def make_cart():
    return GymEnv("CartPole-v1")


def supervise(kind):
    def run(entries):
        torch.manual_seed(0)
        collector = kind(**entries)
        with shut_down(collector):
            return [batch.numel() for batch in islice(collector, 2)]

    return run


NOT_MADE = [Fault(repr(x), x) for x in (None, "text", 3, [], {}, [None], ["text"])]
NOT_MADE += [Fault("makes text", lambda: "text")]
NO_MAKERS = [Fault(repr(x), x) for x in (None, "text", 3, (), {}, (None,), ("text",), make_cart)]
STATE = {"next_id": 6, "frames": 6, "iter": 1}
ZEROS = {(name, "0"): "before the first batch" for name in STATE}
ALL = {("exclude_keys", name): "nothing is left out" for name in ("[]", "{}")}
COUNTS = [Fault(repr(x), x) for x in (-2, 6.5, "6", None, True, [6], 1j, float("nan"))]
MANY = {
    "create_env_fn": (make_cart,),
    "frames_per_batch": 4,
    "total_frames": 8,
    "init_random_frames": 4,
}


def supervised(kind):
    return Subject(
        supervise(kind),
        MANY,
        faults={"create_env_fn": NO_MAKERS, "total_frames": COUNTS},
        fine={("init_random_frames", "0"): "none"},
        optional=["total_frames", "init_random_frames"],
    )


SUBJECTS = {
    "TrajectoryGroupCollector": Subject(
        collect,
        {
            "create_env_fn": make_env,
            "policy": make_policy,
            "num_groups": 2,
            "group_size": 3,
            "backend": "direct",
            "total_frames": 6,
            "postproc": same,
            "replay_buffer": make_buffer,
            "compact_obs": True,
            "exclude_keys": ["logits"],
            "max_steps": 5,
            "group_key": "group",
            "exploration_type": ExplorationType.MODE,
        },
        faults={"create_env_fn": NOT_MADE, "total_frames": COUNTS},
        fine=ALL,
        optional=[
            "policy",
            "backend",
            "total_frames",
            "postproc",
            "replay_buffer",
            "compact_obs",
            "exclude_keys",
            "max_steps",
            "group_key",
            "exploration_type",
        ],
    ),
    "TrajectoryGroupCollector.set_seed": Subject(
        use(lambda collector, entries: collector.set_seed(**entries)),
        {"seed": 3, "static_seed": True},
        fine={("seed", "0"): "a seed as any other"},
        optional=["static_seed"],
    ),
    "TrajectoryGroupCollector.update_policy_weights_": Subject(
        use(lambda collector, entries: collector.update_policy_weights_(**entries)),
        {"policy_or_weights": make_policy()},
        optional=["policy_or_weights"],
    ),
    "TrajectoryGroupCollector.load_state_dict": Subject(
        use(load_state), STATE, fine=ZEROS | {("iter", "-1"): "before the first batch"}
    ),
    "SupervisedSyncCollector": supervised(SupervisedSyncCollector),
    "SupervisedAsyncCollector": supervised(SupervisedAsyncCollector),
}


@pytest.mark.parametrize("name", SUBJECTS)
def test_collectors(name, monkeypatch):
    here = partial(Workers, backend="direct")
    monkeypatch.setattr("torchrl_ecpo.collectors.supervised.Workers", here)
    check(f"`{name}`", SUBJECTS[name])
