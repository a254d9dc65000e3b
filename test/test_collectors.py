from __future__ import annotations

import os
import signal
import time
from functools import partial

import pytest
import ray
import torch
from tensordict import TensorDict
from tensordict import assert_close as assert_td_close
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.testing import assert_close
from torchrl.data import (
    Composite,
    LazyTensorStorage,
    NonTensor,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import (
    EnvBase,
    InitTracker,
    RenameTransform,
    RewardSum,
    StepCounter,
    TransformedEnv,
)
from torchrl.modules import LSTMModule, RandomPolicy, get_env_transforms_from_module

from torchrl_ecpo.collectors import TrajectoryGroupCollector, shut_down
from torchrl_ecpo.envs._groups import GroupIdAllocator
from torchrl_ecpo.groups import TrajectoryGroupSampler, pack_groups, unpack_groups


class Countdown(EnvBase):
    """Episodes of a random length that only depends on the group; the reward is the action.

    The state is in the tensordict, so that mixed-up rows show in the time of each step.
    """

    def __init__(self, num_groups=2, group_size=3, *, shortest=1, longest=6, on_step=None):
        super().__init__(batch_size=torch.Size([num_groups, group_size]))
        batch = self.batch_size
        self.observation_spec = Composite(
            observation=Unbounded((*batch, 2)),
            left=Unbounded((*batch, 1), dtype=torch.int64),
            group=Unbounded(batch, dtype=torch.int64),
            shape=batch,
        )
        self.action_spec = Unbounded((*batch, 1))
        self.reward_spec = Unbounded((*batch, 1))
        self.lengths = (shortest, longest + 1)
        self.ids = GroupIdAllocator()
        self.on_step = on_step
        self.stepped = 0
        self.rng = torch.Generator().manual_seed(0)

    def _set_seed(self, seed):
        self.rng.manual_seed(seed or 0)

    def _observe(self, group, left, done):
        observation = torch.cat([left.float(), torch.ones(*self.batch_size, 1)], -1)
        data = {"observation": observation, "left": left, "group": group, "done": done}
        return TensorDict(data, self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        group = self.ids.allocate(self.batch_size[0]).unsqueeze(1).expand(self.batch_size)
        left = torch.randint(*self.lengths, (*self.batch_size, 1), generator=self.rng)
        return self._observe(group.clone(), left, torch.zeros_like(left, dtype=torch.bool))

    def _step(self, tensordict):
        if self.on_step is not None:
            self.on_step()
        active = tensordict.get("_step", torch.ones(*self.batch_size, 1, dtype=torch.bool))
        self.stepped += int(active.sum())
        left = tensordict["left"] - active.long()
        step = self._observe(tensordict["group"].clone(), left, left <= 0)
        return step.set("reward", tensordict["action"].clone())


def linear_policy(weight=0.0):
    """Acts with its own weight, whatever it sees."""
    module = nn.Linear(2, 1, bias=False)
    with torch.no_grad():
        module.weight.copy_(torch.tensor([[0.0, weight]]))
    return TensorDictModule(module, ["observation"], ["action"])


def recurrent_policy():
    torch.manual_seed(0)
    return TensorDictSequential(
        LSTMModule(2, 5, in_key="observation", out_key="features", default_recurrent_mode=False),
        TensorDictModule(nn.Linear(5, 1), ["features"], ["action"]),
    )


def check_batch(batch, num_groups, group_size, *, padded_with_zeros=True):
    mask = batch["collector", "mask"]
    length = mask.sum(-1)
    assert batch.shape == (num_groups, group_size, int(length.max()))
    assert batch["group"][..., 0].unique().numel() == num_groups
    assert (batch["group"] == batch["group"][:, :1, :1])[mask].all()
    # Every trajectory is whole, and in order.
    left = length.unsqueeze(-1) - torch.arange(batch.shape[-1])
    assert (batch["left"].squeeze(-1) == left)[mask].all()
    assert ((batch["next", "done"].squeeze(-1) == (left == 1)) | ~mask).all()
    ids = batch["collector", "traj_ids"]
    assert (ids == ids[..., :1])[mask].all()
    assert ids[..., 0].unique().numel() == num_groups * group_size
    if padded_with_zeros:
        for key in ("left", "group", ("collector", "traj_ids")):
            assert not batch[key][~mask].any()


@pytest.mark.parametrize(("num_groups", "played"), [(2, 2), (6, 2), (1, 1)])
@pytest.mark.parametrize("policy", [None, linear_policy, recurrent_policy, RandomPolicy])
def test_batches_of_complete_groups(num_groups, played, policy):
    env = Countdown(played)
    collector = TrajectoryGroupCollector(
        env, policy and policy(), num_groups=num_groups, group_size=3, total_frames=150
    )
    frames, ids, groups = 0, [], []
    for batch in collector:
        check_batch(batch, num_groups, 3)
        frames += int(batch["collector", "mask"].sum())
        ids += batch["collector", "traj_ids"][..., 0].flatten().tolist()
        groups += batch["group"][:, 0, 0].tolist()
    assert 150 <= frames < 150 + num_groups * 3 * 6
    assert env.stepped == frames  # ended episodes cost nothing
    assert len(set(ids)) == len(ids)
    assert len(set(groups)) == len(groups)
    assert collector.restarted_trajectories == 0
    collector.shutdown()


def test_the_policy_sees_active_rows_only():
    seen = []

    class Watch(nn.Module):
        def forward(self, observation):
            seen.append(observation.shape[:-1].numel())
            return observation[..., :1]

    env = Countdown(4, 5)
    policy = TensorDictModule(Watch(), ["observation"], ["action"])
    collector = TrajectoryGroupCollector(env, policy, num_groups=4, group_size=5)
    seen.clear()
    batch = next(iter(collector))
    assert seen == batch["collector", "mask"].sum((0, 1)).tolist()
    # The action of each step was made from the observation of that step.
    assert_close(batch["action"], batch["observation"][..., :1])
    assert_close(batch["next", "reward"], batch["action"])
    collector.shutdown()


def test_recurrent_policies_keep_their_state_while_rows_drop_out():
    policy = recurrent_policy()
    collector = TrajectoryGroupCollector(
        TransformedEnv(Countdown(3, 4), InitTracker()), policy, num_groups=6, group_size=4
    )
    batch = next(iter(collector))
    mask = batch["collector", "mask"]
    assert mask.sum(-1).unique().numel() > 3
    with torch.no_grad():
        features, _ = policy[0].lstm(batch["observation"].flatten(0, 1))
        action = policy[1].module(features).view(*batch.shape, 1)
    assert_close(batch["action"][mask], action[mask])
    assert (batch["is_init"].squeeze(-1) == (torch.arange(batch.shape[-1]) == 0))[mask].all()
    collector.shutdown()


def test_recurrent_policies_need_no_transforms():
    """What the collector appends by itself acts at resets alone, and makes no difference."""
    policy = recurrent_policy()
    transformed = TransformedEnv(Countdown(3, 4), get_env_transforms_from_module(policy))
    plain = Countdown(3, 4)
    steps = []
    tracker_step = InitTracker._call
    batches = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(InitTracker, "_call", lambda *args: steps.append(None) or tracker_step(*args))
        for env in (transformed, plain):
            steps.clear()
            collector = TrajectoryGroupCollector(env, policy, num_groups=6, group_size=4)
            batches.append(next(iter(collector)).exclude("group"))
            assert bool(steps) == (env is transformed)
    assert_td_close(*batches)
    first = torch.arange(batches[1].shape[-1]) == 0
    mask = batches[1]["collector", "mask"]
    assert (batches[1]["is_init"].squeeze(-1) == first)[mask].all()


def test_registration_of_transforms_can_be_refused():
    collector = TrajectoryGroupCollector(
        Countdown(), linear_policy(), num_groups=2, group_size=3,
        auto_register_policy_transforms=False,
    )  # fmt: skip
    assert "is_init" not in set(next(iter(collector)).keys())


def count_steps(data):
    """A policy that names no keys, and that remembers in an entry of its own."""
    count = data.get("count", torch.zeros(*data.shape, 1)) + 1
    return data.set("count", count).set("action", count + data["observation"][..., :1])


def test_policies_may_keep_entries_of_their_own():
    collector = TrajectoryGroupCollector(
        Countdown(3, 4), count_steps, num_groups=6, group_size=4, trust_policy=True
    )
    batch = next(iter(collector))
    check_batch(batch, 6, 4)
    mask = batch["collector", "mask"]
    time = torch.arange(batch.shape[-1]).expand(mask.shape)
    assert mask.sum(-1).unique().numel() > 3
    assert (batch["count"].squeeze(-1) == time + 1)[mask].all()
    assert_close(batch["next", "reward"], batch["count"] + batch["left"])


def test_what_a_policy_overwrites_is_what_it_acted_on():
    double = TensorDictModule(lambda x: 2 * x, ["observation"], ["observation"])
    policy = TensorDictSequential(double, linear_policy(1.0))
    batch = next(iter(TrajectoryGroupCollector(Countdown(), policy, num_groups=2, group_size=3)))
    mask = batch["collector", "mask"]
    assert (batch["observation"][..., 0] == 2 * batch["left"][..., 0])[mask].all()
    assert (batch["action"] == 2.0)[mask].all()


@pytest.mark.parametrize("declared", [False, True])
def test_transforms_and_states_in_the_tensordict_follow_the_right_rows(declared):
    env = Countdown(3, 4)
    if declared:  # that `left` is also what a step reads
        env.state_spec = Composite(left=env.observation_spec["left"].clone(), shape=(3, 4))
    env = TransformedEnv(env, StepCounter())
    env.append_transform(RewardSum())
    collector = TrajectoryGroupCollector(
        env, linear_policy(2.0), num_groups=3, group_size=4, compact_obs=False
    )
    batch = next(iter(collector))
    mask = batch["collector", "mask"]
    time = torch.arange(batch.shape[-1]).expand(mask.shape)
    assert (batch["step_count"].squeeze(-1) == time)[mask].all()
    assert (batch["next", "episode_reward"].squeeze(-1) == 2 * (time + 1))[mask].all()
    assert (batch["next", "left"] == batch["left"] - 1)[mask].all()
    collector.shutdown()


def test_what_a_batch_keeps():
    env = TransformedEnv(Countdown(), InitTracker())
    options = {"num_groups": 2, "group_size": 3}
    batches = [
        next(iter(TrajectoryGroupCollector(env, recurrent_policy(), **options, **more)))
        for more in ({}, {"compact_obs": False, "exclude_keys": ["features", ("next", "left")]})
    ]
    shared = {"observation", "left", "action", "is_init", "group", "done", "terminated"}
    shared |= {("collector", "mask"), ("collector", "traj_ids")}
    outcome = {("next", key) for key in ("reward", "done", "terminated")}
    full = {("next", key) for key in ("observation", "group", "is_init")}
    keys = [set(batch.keys(True, True)) for batch in batches]
    assert keys == [shared | outcome | {"features"}, shared | outcome | full]


def test_what_is_private_is_left_out():
    """A key or a part of it that begins with an underscore, whoever wrote it."""

    class Hiding(Countdown):
        def _observe(self, group, left, done):
            return super()._observe(group, left, done).update({"_cache": left, "a": {"_b": left}})

    hide = TensorDictModule(lambda x: x, ["observation"], ["_seen"])
    policy = TensorDictSequential(hide, linear_policy())
    for compact_obs in (True, False):
        collector = TrajectoryGroupCollector(
            Hiding(), policy, num_groups=2, group_size=3, compact_obs=compact_obs
        )
        keys = [key if isinstance(key, tuple) else (key,) for key in collector.rollout().keys(True)]
        assert ("observation",) in keys
        assert not [key for key in keys if any(part.startswith("_") for part in key)]


def nested_policy(read):
    """What it reads, and all it writes but the action, is nested in `agents` and `params`."""
    network = nn.Linear(2, 1)

    def act(entries):
        features = entries["features"] if read == "agents" else entries
        action = network(features).detach().abs() + 1
        return action, action.clone()

    return TensorDictModule(act, [read], ["action", ("params", "loc")])


@pytest.mark.parametrize("read", ["agents", ("agents", "features")], ids=str)
def test_nested_entries_are_read_and_left_out_by_what_they_are_nested_in(read):
    env = TransformedEnv(Countdown(), RenameTransform(["observation"], [("agents", "features")]))
    options = {"num_groups": 2, "group_size": 3, "exclude_keys": ["params"]}
    batch = next(iter(TrajectoryGroupCollector(env, nested_policy(read), **options)))
    assert ("agents", "features") in batch.keys(True)
    assert not any("params" in key for key in batch.keys(True, True))
    options["exclude_keys"] = ["agents"]
    batch = next(iter(TrajectoryGroupCollector(env, nested_policy(read), **options)))
    assert ("params", "loc") in batch.keys(True)
    assert not any("agents" in key for key in batch.keys(True, True))


def test_entries_that_are_no_tensors_are_refused():
    env = Countdown()
    spec = env.observation_spec.clone()
    spec["prompt"] = NonTensor(shape=env.batch_size)
    env.observation_spec = spec
    with pytest.raises(TypeError, match=r"Only tensors .*'prompt'.*ExcludeTransform"):
        TrajectoryGroupCollector(env, linear_policy(1.0), num_groups=2, group_size=3)


def test_a_batch_is_sampled_from_the_reference():
    policy = linear_policy(1.0)
    collector = TrajectoryGroupCollector(Countdown(), policy, num_groups=2, group_size=3)
    batches = iter(collector)
    for update, expected in [(False, 1.0), (True, 3.0)]:
        with torch.no_grad():
            policy.module.weight[0, 1] = 3.0
        if update:
            collector.update_policy_weights_()
        batch = next(batches)
        assert (batch["action"][batch["collector", "mask"]] == expected).all()
    weights = TensorDict.from_module(linear_policy(7.0)).data
    collector.update_policy_weights_(weights)
    batch = next(batches)
    assert (batch["action"][batch["collector", "mask"]] == 7.0).all()
    assert collector.restarted_trajectories == 0
    collector.shutdown()


@pytest.mark.parametrize("announced", [True, False])
@pytest.mark.parametrize(("update_at", "restarted"), [(1, 6), (4, 6), (9, 12)])
def test_an_update_within_a_batch_restarts_it(announced, update_at, restarted):
    steps = 0

    def update():
        nonlocal steps
        steps += 1
        if steps == update_at:
            if announced:
                collector.update_policy_weights_(TensorDict.from_module(linear_policy(5.0)).data)
            else:  # as another thread does, before it is counted
                with torch.no_grad():
                    collector.policy.module.weight[0, 1] = 5.0

    env = Countdown(shortest=6, longest=6, on_step=update)
    collector = TrajectoryGroupCollector(env, linear_policy(1.0), num_groups=4, group_size=3)
    batch = next(iter(collector))
    check_batch(batch, 4, 3)
    assert (batch["action"][batch["collector", "mask"]] == 5.0).all()
    assert collector.restarted_trajectories == (restarted if announced else 12)
    collector.shutdown()


def test_weights_that_are_not_a_number_are_no_reason_to_restart():
    policy = linear_policy(float("nan"))
    collector = TrajectoryGroupCollector(Countdown(), policy, num_groups=2, group_size=3)
    next(iter(collector))
    assert collector.restarted_trajectories == 0


def test_seed_postproc_and_hooks():
    def collect(seed):
        collector = TrajectoryGroupCollector(
            Countdown(),
            linear_policy(),
            num_groups=2,
            group_size=3,
            postproc=lambda batch: batch.set("seen", torch.ones(batch.shape)),
            pre_collect_hook=lambda: hooks.append("before"),
            post_collect_hook=lambda batch: hooks.append(batch.shape[:2]),
        )
        collector.set_seed(seed)
        return next(iter(collector))

    hooks = []
    first, again, other = collect(1), collect(1), collect(2)
    assert hooks == ["before", (2, 3)] * 3
    assert first["seen"].all()
    assert_close(first["left"], again["left"])
    assert first.shape != other.shape or (first["left"] != other["left"]).any()


def test_state_dict_and_reset():
    make = partial(TrajectoryGroupCollector, num_groups=2, group_size=3)
    collector = make(TransformedEnv(Countdown(), StepCounter()), linear_policy(4.0))
    batches = iter(collector)
    last = [next(batches) for _ in range(2)][-1]
    collector.reset()
    other = make(TransformedEnv(Countdown(), StepCounter()), linear_policy())
    other.load_state_dict(collector.state_dict())
    batch = next(iter(other))
    assert (batch["action"][batch["collector", "mask"]] == 4.0).all()
    assert batch["collector", "traj_ids"].max() > last["collector", "traj_ids"].max()
    assert other._frames > collector._frames


def test_writes_to_a_replay_buffer():
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(500),
        sampler=TrajectoryGroupSampler(group_size=3, replacement=False),
        batch_size=6,
    )
    collector = TrajectoryGroupCollector(
        Countdown(),
        linear_policy(),
        num_groups=4,
        group_size=3,
        replay_buffer=buffer,
        total_frames=90,
    )
    written = 0
    for nothing in collector:
        assert nothing is None
        written += 12
        steps = buffer[:]
        assert ("collector", "mask") not in steps.keys(True)
        groups = pack_groups(steps, group_size=3)
        assert groups.shape[:2].numel() == written
        check_batch(groups, written // 3, 3)
        assert_td_close(unpack_groups(groups), steps)
        check_batch(buffer.sample(), 2, 3, padded_with_zeros=False)
    assert len(buffer) >= 90


class Stranger(Countdown):
    """Resets with a 'group' that is not what it should be."""

    def __init__(self, change):
        super().__init__()
        self.change = change

    def _reset(self, tensordict=None, **kwargs):
        start = super()._reset(tensordict)
        return start.set("group", self.change(start["group"]))


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"group_size": 1}, ValueError, "group_size of at least 2, got num_groups=2, group_size=1"),
        ({"num_groups": 0}, ValueError, "num_groups of at least 1"),
        ({"group_size": 4}, ValueError, r"\[\*B, group_size=4\], got \(2, 3\)"),
        ({"num_groups": 3}, ValueError, "num_groups=3 must be a multiple.*, 2"),
        ({"group_key": "instance"}, KeyError, "no .*instance.*GroupedEnv"),
        ({"frames_per_batch": 10}, TypeError, "frames_per_batch: a batch is counted in groups"),
        ({"init_random_frames": 10}, TypeError, "every action comes from the policy"),
        ({"split_trajs": True}, TypeError, "does not take split_trajs"),
        ({"sync": True}, ValueError, "sync needs num_collectors"),
        ({"backend": "rpc"}, ValueError, "backend='rpc'.*'process' and 'ray'"),
        ({"backend_options": {}}, ValueError, "backend_options are for backend='ray'"),
        ({"backend": "ray", "num_collectors": 2, "sync": False}, ValueError, "with Ray, workers"),
        ({"backend": "ray", "num_collectors": 2, "num_groups": 3}, ValueError, "workers, 2"),
        ({"backend": "ray", "num_collectors": 2, "replay_buffer": []}, TypeError, "extend it"),
        ({"num_collectors": 2, "num_groups": 3, "sync": True}, ValueError, "number of workers, 2"),
        ({"nonsense": 1}, TypeError, "nonsense"),
    ],
)
def test_bad_arguments(options, error, match):
    options = {"num_groups": 2, "group_size": 3, **options}
    with pytest.raises(error, match=match):
        TrajectoryGroupCollector(Countdown, linear_policy(), **options)


@pytest.mark.parametrize(
    ("env", "error", "match"),
    [
        (lambda: Countdown(longest=50), RuntimeError, "max_steps=20.*StepCounter.*max_frames_per"),
        (lambda: Stranger(lambda g: g + torch.arange(3)), ValueError, "equal for the group_size=3"),
        (lambda: Stranger(lambda g: g * 0), ValueError, "different from those of the others"),
    ],
)
def test_bad_environments(env, error, match):
    collector = TrajectoryGroupCollector(
        env(), linear_policy(), num_groups=20, group_size=3, max_steps=20
    )
    with pytest.raises(error, match=match):
        next(iter(collector))


def test_max_frames_per_traj():
    collector = TrajectoryGroupCollector(
        Countdown(shortest=9, longest=50), num_groups=2, group_size=3, max_frames_per_traj=5
    )
    batch = next(iter(collector))
    assert batch.shape[-1] == 5
    assert batch["collector", "mask"].all()
    assert batch["next", "truncated"][..., -1, 0].all()


# Workers import neither this module nor the test tree: what they need travels by value.
def _worker_parts():
    """An environment maker and a policy that a process can be given."""

    class Env(EnvBase):
        def __init__(self):
            super().__init__(batch_size=torch.Size([2, 3]))
            batch = self.batch_size
            self.observation_spec = Composite(
                observation=Unbounded((*batch, 1)),
                left=Unbounded((*batch, 1), dtype=torch.int64),
                group=Unbounded(batch, dtype=torch.int64),
                shape=batch,
            )
            self.action_spec = Unbounded((*batch, 1))
            self.reward_spec = Unbounded((*batch, 1))
            self.ids = GroupIdAllocator()

        def _set_seed(self, seed):
            torch.manual_seed(seed or 0)

        def _observe(self, group, left):
            data = {"observation": torch.ones(*self.batch_size, 1), "left": left, "group": group}
            return TensorDict({**data, "done": left <= 0}, self.batch_size)

        def _reset(self, tensordict=None, **kwargs):
            group = self.ids.allocate(2).unsqueeze(1).expand(2, 3).clone()
            return self._observe(group, torch.randint(1, 7, (2, 3, 1)))

        def _step(self, tensordict):
            time.sleep(2e-3)
            step = self._observe(tensordict["group"].clone(), tensordict["left"] - 1)
            return step.set("reward", tensordict["action"].clone())

    linear = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(linear.weight)
    return Env, TensorDictModule(linear, ["observation"], ["action"])


@pytest.mark.parametrize("sync", [True, False])
def test_worker_processes(sync):
    make, policy = _worker_parts()
    collector = TrajectoryGroupCollector(
        make, policy, num_groups=4 if sync else 2, group_size=3, sync=sync,
        num_collectors=2 if sync else 1,
        total_frames=250, postproc=lambda batch: batch.set("seen", torch.ones(batch.shape)),
    )  # fmt: skip
    frames, groups, weights = 0, [], []
    try:
        for i, batch in enumerate(collector, start=1):
            check_batch(batch, 4 if sync else 2, 3)
            assert batch["seen"].all()
            frames += int(batch["collector", "mask"].sum())
            groups += batch["group"][:, 0, 0].tolist()
            acted = batch["action"][batch["collector", "mask"]]
            assert (acted == acted[0]).all()  # one policy for the whole batch
            weights.append(float(acted[0]))
            with torch.no_grad():
                policy.module.weight.fill_(i)
            collector.update_policy_weights_()
        restarted = collector.restarted_trajectories
        os.kill(collector.procs[0].pid, signal.SIGKILL)
        with pytest.raises(ChildProcessError, match=r"Worker 0 .* by SIGKILL.* resume=auto"):
            collector.update_policy_weights_()
        # Else a process that was interrupted while it wrote to one would never end.
        schemes = collector._weight_sync_schemes.values()
        queues = [queue for each in schemes for queue in each._instruction_queues.values()]
        assert queues
        assert all(queue._joincancelled for queue in queues)
    finally:
        collector.shutdown()
    assert not any(process.is_alive() for process in collector.procs)
    assert 250 <= frames < 250 + (4 if sync else 2) * 3 * 6  # a batch's groups, copies and steps
    assert len(set(groups)) == len(groups)
    if sync:
        assert restarted == 0
        assert weights == list(range(len(weights)))
    else:
        assert restarted > 0
        assert restarted % 6 == 0
        assert weights == sorted(weights)
        assert len(set(weights)) > 2


def test_an_error_in_a_worker_process_ends_the_run():
    make, policy = _worker_parts()

    def make_failing():
        env = make()
        env._step = lambda tensordict: 1 / 0
        return env

    collector = TrajectoryGroupCollector(
        make_failing, policy, num_groups=2, group_size=3, num_collectors=1, sync=True
    )
    with shut_down(collector), pytest.raises(ChildProcessError, match=r"Worker 0 .* exit code 1"):
        next(iter(collector))


def test_ray_workers():
    make, policy = _worker_parts()
    collector = TrajectoryGroupCollector(
        make, policy, num_groups=4, group_size=3, backend="ray", num_collectors=2,
        total_frames=250, postproc=lambda batch: batch.set("seen", torch.ones(batch.shape)),
        backend_options={
            "ray_init_config": {"address": "local", "num_cpus": 2, "include_dashboard": False},
            "remote_configs": {"num_cpus": 1, "num_gpus": 0},
        },
    )  # fmt: skip
    frames, groups = 0, []
    with shut_down(collector):
        collector.set_seed(0)
        collector.update_policy_weights_()
        for i, batch in enumerate(collector, start=1):
            check_batch(batch, 4, 3)
            assert batch["seen"].all()
            frames += int(batch["collector", "mask"].sum())
            groups += batch["group"][:, 0, 0].tolist()
            # All workers sampled from the weights of the last update.
            assert (batch["action"][batch["collector", "mask"]] == i - 1).all()
            with torch.no_grad():
                policy.module.weight.fill_(i)
            collector.update_policy_weights_()
            if frames >= 200:  # at its end, TorchRL shuts the collector down
                break
        assert len(set(groups)) == len(groups)
        assert collector.restarted_trajectories == 0
        ray.kill(collector.remote_collectors[1])
        with pytest.raises(ChildProcessError, match=r"Worker 1 .* Ray cluster.* resume=auto"):
            collector.update_policy_weights_()


@pytest.mark.slow
def test_worker_processes_write_to_a_replay_buffer():
    make, policy = _worker_parts()
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(1000),
        sampler=TrajectoryGroupSampler(group_size=3),
        batch_size=6,
        shared=True,
    )
    collector = TrajectoryGroupCollector(
        [make, make], policy, num_groups=4, group_size=3, sync=True, total_frames=80,
        replay_buffer=buffer,
    )  # fmt: skip
    try:
        for i, nothing in enumerate(collector, start=1):
            assert nothing is None
            assert pack_groups(buffer[:], group_size=3).shape[0] == 4 * i
            sample = buffer.sample()
            check_batch(sample, 2, 3, padded_with_zeros=False)
            assert ("next", "observation") not in sample.keys(True)
    finally:
        collector.shutdown()
    assert 80 <= len(buffer) < 160
