from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from functools import partial

import cloudpickle
import pytest
import torch
from tensordict import TensorDict
from tensordict import assert_close as assert_td_close
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
    TensorDictParams,
    TensorDictSequential,
)
from torch import nn
from torch.testing import assert_close
from torchrl.data import (
    Composite,
    LazyTensorStorage,
    NonTensor,
    ReplayBuffer,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import (
    EnvBase,
    GymEnv,
    InitTracker,
    RenameTransform,
    RewardSum,
    StepCounter,
    TensorDictPrimer,
    TransformedEnv,
    VecNormV2,
)
from torchrl.modules import (
    LSTMModule,
    OrnsteinUhlenbeckProcessModule,
    ProbabilisticActor,
    RandomPolicy,
    TanhNormal,
    get_env_transforms_from_module,
)
from torchrl.trainers import Trainer, UpdateWeights

from torchrl_ecpo import ECPOLoss
from torchrl_ecpo.collectors import (
    SupervisedAsyncCollector,
    SupervisedSyncCollector,
    TrajectoryGroupCollector,
    shut_down,
)
from torchrl_ecpo.collectors.workers import Workers, _serve
from torchrl_ecpo.envs import GroupedEnv
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


class Moded(nn.Linear):
    """Says beside its output whether it is in training mode."""

    def forward(self, x):
        output = super().forward(x)
        return output, torch.full_like(output, self.training)


def moded_policy():
    return TensorDictModule(Moded(2, 1, bias=False), ["observation"], ["action", "training"])


def lazy_policy():
    return TensorDictModule(nn.LazyLinear(1), ["observation"], ["action"])


def recurrent_policy():
    torch.manual_seed(0)
    return TensorDictSequential(
        LSTMModule(2, 5, in_key="observation", out_key="features", default_recurrent_mode=False),
        TensorDictModule(nn.Linear(5, 1), ["features"], ["action"]),
    )


def collect(env, policy=None, **options):
    """A first batch, of two groups of three unless said otherwise."""
    options = {"num_groups": 2, "group_size": 3, **options}
    return next(iter(TrajectoryGroupCollector(env, policy, **options)))


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


@pytest.mark.parametrize(
    ("num_groups", "played", "policy"),
    [
        (6, 2, None),
        (2, 2, RandomPolicy),
        (1, 1, linear_policy),
        (6, 2, linear_policy),
        (6, 2, recurrent_policy),
    ],
)
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
    collector.shutdown()
    collector.shutdown()  # once more does no harm


def test_the_policy_sees_active_rows_only():
    seen = []

    class Watch(nn.Module):
        def forward(self, observation):
            seen.append(observation.shape[:-1].numel())
            return observation[..., :1]

    env = Countdown(4, 5)
    policy = TensorDictModule(Watch(), ["observation"], ["action"])
    batch = collect(env, policy, num_groups=4, group_size=5)
    assert seen == batch["collector", "mask"].sum((0, 1)).tolist()
    # The action of each step was made from the observation of that step.
    assert_close(batch["action"], batch["observation"][..., :1])
    assert_close(batch["next", "reward"], batch["action"])


def test_recurrent_policies_keep_their_state_while_rows_drop_out():
    policy = recurrent_policy()
    env = TransformedEnv(Countdown(3, 4), InitTracker())
    batch = collect(env, policy, num_groups=6, group_size=4)
    mask = batch["collector", "mask"]
    assert mask.sum(-1).unique().numel() > 3
    with torch.no_grad():
        features, _ = policy[0].lstm(batch["observation"].flatten(0, 1))
        action = policy[1].module(features).view(*batch.shape, 1)
    assert_close(batch["action"][mask], action[mask])
    assert (batch["is_init"].squeeze(-1) == (torch.arange(batch.shape[-1]) == 0))[mask].all()


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
            batches.append(collect(env, policy, num_groups=6, group_size=4).exclude("group"))
            assert bool(steps) == (env is transformed)
    assert_td_close(*batches)
    first = torch.arange(batches[1].shape[-1]) == 0
    mask = batches[1]["collector", "mask"]
    assert (batches[1]["is_init"].squeeze(-1) == first)[mask].all()


def test_the_primers_of_a_recurrent_policy_may_be_in_the_copies():
    """TorchRL's usual place."""
    torch.manual_seed(0)
    policy = TensorDictSequential(
        LSTMModule(3, 5, in_key="observation", out_key="features", default_recurrent_mode=False),
        TensorDictModule(nn.Linear(5, 1), ["features"], ["action"]),
    )

    def make(primed):
        env = TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(max_steps=6))
        if primed:
            env.append_transform(get_env_transforms_from_module(policy))
        return env

    batches = []
    for primed in (True, False):
        env = GroupedEnv(partial(make, primed), num_groups=1, group_size=2)
        env.set_seed(0)
        batches.append(collect(env, policy, num_groups=1, group_size=2))
    assert_close(batches[0]["features"], batches[1]["features"])
    with torch.no_grad():
        features, _ = policy[0].lstm(batches[0]["observation"].flatten(0, 1))
    assert_close(batches[0]["features"].flatten(0, 1), features)


def test_noise_of_a_process_goes_on_from_step_to_step():
    action = TensorDictModule(lambda x: torch.zeros_like(x[..., :1]), ["observation"], ["action"])
    noise = OrnsteinUhlenbeckProcessModule(
        spec=Unbounded(1), annealing_num_steps=10, sigma=1.0, dt=0.1, theta=0.1, safe=False
    )
    env = TransformedEnv(Countdown(1, 4, shortest=60, longest=60), InitTracker())
    batch = collect(env, TensorDictSequential(action, noise), num_groups=1, group_size=4)
    before, after = batch["action"][..., :-1, 0].flatten(), batch["action"][..., 1:, 0].flatten()
    assert torch.corrcoef(torch.stack([before, after]))[0, 1] > 0.7


def count_steps(data):
    """A policy that names no keys, and that remembers in an entry of its own."""
    count = data.get("count", torch.zeros(*data.shape, 1)) + 1
    return data.set("count", count).set("action", count + data["observation"][..., :1])


def test_policies_may_keep_entries_of_their_own():
    batch = collect(Countdown(3, 4), count_steps, num_groups=6, group_size=4)
    check_batch(batch, 6, 4)
    mask = batch["collector", "mask"]
    time = torch.arange(batch.shape[-1]).expand(mask.shape)
    assert mask.sum(-1).unique().numel() > 3
    assert (batch["count"].squeeze(-1) == time + 1)[mask].all()
    assert_close(batch["next", "reward"], batch["count"] + batch["left"])


def add_memory(observation, memory):
    return observation[..., :1] + memory, memory + 1


@pytest.mark.parametrize("is_nested", [False, True])
def test_a_memory_under_one_name_goes_on_and_is_not_recorded(is_nested):
    """A loss would read it as that before the step, and it is that after it."""
    primer = TensorDictPrimer(memory=Unbounded(1), default_value=0.0, expand_specs=True)
    policy = TensorDictModule(add_memory, ["observation", "memory"], ["action", "memory"])
    env = TransformedEnv(Countdown(), primer)
    if is_nested:
        env = TransformedEnv(env, StepCounter(), auto_unwrap=False)
    batch = collect(env, policy)
    mask = batch["collector", "mask"]
    time = torch.arange(batch.shape[-1]).expand(mask.shape)
    assert (batch["action"].squeeze(-1) == batch["left"].squeeze(-1) + time)[mask].all()
    assert "memory" not in batch
    # What the environment shows, here by a transform, is kept as it was acted on.
    double = TensorDictModule(lambda x: 2 * x, ["again"], ["again"])
    policy = TensorDictSequential(double, linear_policy())
    env = TransformedEnv(Countdown(), RenameTransform(["left"], ["again"], create_copy=True))
    batch = collect(env, policy)
    assert (batch["again"] == 2 * batch["left"]).all()


def test_what_a_policy_overwrites_is_what_it_acted_on():
    double = TensorDictModule(lambda x: 2 * x, ["observation"], ["observation"])
    policy = TensorDictSequential(double, linear_policy(1.0))
    batch = collect(Countdown(), policy)
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
    batch = collect(env, linear_policy(2.0), num_groups=3, group_size=4, compact_obs=False)
    mask = batch["collector", "mask"]
    time = torch.arange(batch.shape[-1]).expand(mask.shape)
    assert (batch["step_count"].squeeze(-1) == time)[mask].all()
    assert (batch["next", "episode_reward"].squeeze(-1) == 2 * (time + 1))[mask].all()
    assert (batch["next", "left"] == batch["left"] - 1)[mask].all()


def test_what_a_batch_keeps():
    env = TransformedEnv(Countdown(), InitTracker())
    batches = [
        collect(env, recurrent_policy(), **more)
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
        batch = collect(Hiding(), policy, compact_obs=compact_obs)
        keys = [key if isinstance(key, tuple) else (key,) for key in batch.keys(True)]
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
    batch = collect(env, nested_policy(read), exclude_keys=["params"])
    assert ("agents", "features") in batch.keys(True)
    assert not any("params" in key for key in batch.keys(True, True))
    batch = collect(env, nested_policy(read), exclude_keys=["agents"])
    assert ("params", "loc") in batch.keys(True)
    assert not any("agents" in key for key in batch.keys(True, True))


def test_entries_that_are_no_tensors_are_refused():
    env = Countdown()
    spec = env.observation_spec.clone()
    spec["prompt"] = NonTensor(shape=env.batch_size)
    env.observation_spec = spec
    with pytest.raises(TypeError, match=r"Only tensors .*'prompt'.*ExcludeTransform"):
        collect(env)


@pytest.mark.filterwarnings("ignore:Support of VecNormV2:UserWarning")
def test_running_statistics_are_refused():
    """They would count the rows that wait for the longest."""
    env = GroupedEnv(partial(GymEnv, "Pendulum-v1"), num_groups=1, group_size=3)
    with pytest.raises(ValueError, match=r"VecNormV2 would count .*freeze\(\)"):
        collect(TransformedEnv(env, VecNormV2(in_keys=["observation"])))


def test_an_index_is_refused_where_one_hot_actions_are_read():
    """The environment would play action 0 whatever the policy chose."""
    env = GroupedEnv(lambda: GymEnv("CartPole-v1"), num_groups=2, group_size=3)
    network = TensorDictModule(nn.Linear(4, 2), ["observation"], ["logits"])
    actor = ProbabilisticActor(
        network,
        ["logits"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )
    collector = TrajectoryGroupCollector(env, actor, num_groups=2, group_size=3)
    message = r"Got 'action' of shape \(2, 3\).*is OneHot of shape \(2, 3, 2\)"
    with shut_down(collector), pytest.raises(ValueError, match=message):
        next(iter(collector))


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
    collector.shutdown()


def test_the_training_mode_is_the_policys():
    """At each batch, of each of its modules."""
    policy = moded_policy()
    collector = TrajectoryGroupCollector(Countdown(), policy, num_groups=2, group_size=3)
    for training in (True, False, True):
        policy.module.train(training)
        batch = collector.rollout()
        assert (batch["training"][batch["collector", "mask"]] == training).all()
        # Weights that are a module too, as a loss holds them, have no mode of their own.
        collector.update_policy_weights_(TensorDictParams(TensorDict.from_module(policy)))
    collector.shutdown()


def test_latents_of_squashed_actions_are_recorded():
    """What a policy has drawn is known again by the loss, where tanh is long saturated."""
    network = nn.Sequential(nn.Linear(2, 2), NormalParamExtractor())
    network[0].bias.data = torch.tensor([6.0, 4.0])
    policy = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    batch = collect(Countdown(), policy, exclude_keys=["loc", "scale"])
    mask = batch["collector", "mask"]
    assert_close(batch["action_latent"].tanh()[mask], batch["action"][mask], rtol=0, atol=2e-6)
    assert ECPOLoss(policy)(batch)["kl_reference_policy"].item() == pytest.approx(0, abs=1e-4)
    step = policy(batch.select("observation"))
    assert "action_latent" not in step  # the collector's copy records, not the policy


@pytest.mark.parametrize("update_at", [1, 4, 9])
def test_an_update_within_a_batch_counts_from_the_next_one(update_at):
    steps = 0

    def update():
        nonlocal steps
        steps += 1
        if steps == update_at:
            collector.update_policy_weights_(TensorDict.from_module(linear_policy(5.0)).data)

    env = Countdown(shortest=6, longest=6, on_step=update)
    collector = TrajectoryGroupCollector(env, linear_policy(1.0), num_groups=4, group_size=3)
    batches = iter(collector)
    for expected in (1.0, 5.0):
        batch = next(batches)
        check_batch(batch, 4, 3)
        assert (batch["action"][batch["collector", "mask"]] == expected).all()


def test_ways_to_give_weights():
    collector = TrajectoryGroupCollector(Countdown(), linear_policy(), num_groups=2, group_size=3)
    batches = iter(collector)
    others = [linear_policy(weight) for weight in (1.0, 2.0, 3.0)]
    weights = [TensorDict.from_module(other).data for other in others]
    given = [{"policy_or_weights": others[0]}, {"policy_or_weights": weights[1]}]
    given.append({"weights_dict": {"policy": weights[2]}})
    for options, expected in zip(given, (1.0, 2.0, 3.0), strict=True):
        collector.update_policy_weights_(**options)
        batch = next(batches)
        assert (batch["action"][batch["collector", "mask"]] == expected).all()
    for wrong in ({"policy_or_weights": others[0], **given[2]}, {"weights_dict": {"critic": 0}}):
        with pytest.raises(ValueError, match="weights of one policy"):
            collector.update_policy_weights_(**wrong)
    random = TrajectoryGroupCollector(Countdown(), num_groups=2, group_size=3)
    random.update_policy_weights_()  # as trainers do


def test_trainers_take_it():
    env = GroupedEnv(
        lambda: GymEnv("CartPole-v1", categorical_action_encoding=True), num_groups=2, group_size=3
    )
    network = TensorDictModule(nn.Linear(4, 2), ["observation"], ["logits"])
    actor = ProbabilisticActor(
        network, ["logits"], distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
    )  # fmt: skip
    collector = TrajectoryGroupCollector(env, actor, num_groups=2, group_size=3, total_frames=500)
    loss_module = ECPOLoss(actor, tau=1.0)
    with pytest.warns(FutureWarning, match="OptimizationStepper"):
        trainer = Trainer(
            collector=collector, total_frames=500, frame_skip=1, optim_steps_per_batch=1,
            loss_module=loss_module, optimizer=torch.optim.Adam(loss_module.parameters()),
            progress_bar=False, seed=0,
        )  # fmt: skip
    UpdateWeights(collector, 1).register(trainer)
    before = actor[0].module.weight.clone()
    trainer.train()
    assert trainer.collected_frames >= 500
    assert (actor[0].module.weight != before).any()
    assert_close(collector.policy[0].module.weight, actor[0].module.weight)


def test_seed_postproc_and_hooks():
    def collect(seed):
        collector = TrajectoryGroupCollector(
            Countdown(),
            linear_policy(),
            num_groups=2,
            group_size=3,
            postproc=lambda batch: batch.set("seen", torch.ones(batch.shape)),
        )
        collector.pre_collect_hook = lambda: hooks.append("before")
        collector.post_collect_hook = lambda batch: hooks.append(batch.shape[:2])
        collector.set_seed(seed)
        return next(iter(collector))

    hooks = []
    first, again, other = collect(1), collect(1), collect(2)
    assert hooks == ["before", (2, 3)] * 3
    assert first["seen"].all()
    assert_close(first["left"], again["left"])
    assert first.shape != other.shape or (first["left"] != other["left"]).any()


def test_state_dict_resumes_to_the_bit():
    """The environment inside its transforms too, and weights that no batch has come from yet."""

    class Saved(Countdown):
        def get_extra_state(self):
            return self.rng.get_state()

        def set_extra_state(self, state):
            self.rng.set_state(state)

    make = partial(TrajectoryGroupCollector, num_groups=2, group_size=3)
    policy = linear_policy(1.0)
    collector = make(TransformedEnv(Saved(), StepCounter()), policy)
    batches = iter(collector)
    last = [next(batches) for _ in range(2)][-1]
    collector.update_policy_weights_(TensorDict.from_module(linear_policy(4.0)).data)
    state = collector.state_dict()
    expected = next(batches)
    other = make(TransformedEnv(Saved(), StepCounter()), linear_policy())
    other.load_state_dict(state)
    assert other.stats()["frames"] == state["frames"] > 0
    batch = next(iter(other))
    assert_td_close(batch.exclude("group"), expected.exclude("group"))
    assert (batch["action"][batch["collector", "mask"]] == 4.0).all()
    assert batch["collector", "traj_ids"].max() > last["collector", "traj_ids"].max()
    with pytest.raises(ValueError, match="state of each of 1 workers, got 2"):
        other.load_state_dict({**state, "players": state["players"] * 2})


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("make", [Countdown(), [Countdown, Countdown]], ids=["here", "workers"])
def test_random_actions_are_written_to_a_replay_buffer(make):
    sampler = TrajectoryGroupSampler(group_size=3, replacement=False)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(500), sampler=sampler, batch_size=6)
    collector = TrajectoryGroupCollector(
        make, num_groups=4, group_size=3, replay_buffer=buffer, total_frames=90
    )
    written = 0
    with shut_down(collector):
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
    # Workers draw from streams of their own.
    assert len(groups["action"][:, 0, 0].unique()) == len(groups)


class Player:
    """Has played at once."""

    def play(self):
        return "a batch"


def test_no_worker_waits_longer_than_the_others():
    """All have a batch; that of the one that began first is taken."""
    workers = Workers([Player] * 3, backend="direct", sync=False)
    assert [workers.play()[0][0] for _ in range(9)] == [0, 1, 2] * 3


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
        ({"group_size": 1}, ValueError, "group_size must be an integer of at least 2"),
        ({"num_groups": 0}, ValueError, "num_groups must be an integer of at least 1"),
        ({"group_size": 4}, ValueError, r"\[\*B, group_size=4\], got \(2, 3\)"),
        ({"num_groups": 3}, ValueError, "share of num_groups, 3, must be a multiple.*, 2"),
        ({"group_key": "instance"}, KeyError, "no .*instance.*GroupedEnv"),
        ({"frames_per_batch": 10}, TypeError, "frames_per_batch: a batch is counted in groups"),
        ({"init_random_frames": 10}, TypeError, "every action comes from the policy"),
        ({"split_trajs": True}, TypeError, "does not take split_trajs"),
        ({"sync": True}, ValueError, "sync needs num_collectors"),
        ({"backend": "rpc"}, ValueError, "backend must be one of .*'process', 'ray'.*got 'rpc'"),
        ({"backend_options": {}}, ValueError, "backend_options are for backend='ray'"),
        ({"num_collectors": 2, "num_groups": 3, "sync": True}, ValueError, "number of workers, 2"),
        (
            {"num_collectors": 2, "create_env_fn": [Countdown]},
            ValueError,
            "the 1 environment",
        ),
        ({"num_collectors": 1, "create_env_fn": Countdown()}, TypeError, "got an EnvBase"),
        ({"policy_factory": linear_policy}, TypeError, "does not take policy_factory"),
        ({"nonsense": 1}, TypeError, "has no option nonsense; .* it has compact_obs, exclude_keys"),
        ({"policy": lazy_policy()}, ValueError, "lazy layers, whose weights do not exist yet"),
    ],
)
def test_bad_arguments(options, error, match):
    options = {"create_env_fn": Countdown, "num_groups": 2, "group_size": 3, **options}
    with pytest.raises(error, match=match):
        TrajectoryGroupCollector(**{"policy": linear_policy(), **options})


def test_what_a_policy_may_not_return():
    with pytest.raises(TypeError, match=r"must return the TensorDict .* with the entries \['actio"):
        collect(Countdown(), lambda tensordict: tensordict["observation"][..., :1])


def test_a_group_may_have_a_dimension_of_one():
    class Wide(Countdown):
        def __init__(self):
            super().__init__()
            self.observation_spec["group"] = Unbounded((2, 3, 1), dtype=torch.int64)

        def _observe(self, group, left, done):
            return super()._observe(group.reshape(2, 3, 1), left, done)

    check_batch(collect(Wide(), num_groups=4), 4, 3)


def test_what_a_policy_foresees_is_not_what_it_is_shown():
    """The environment's own next observation counts, as in TorchRL's collector."""
    seen = []

    def foresee(observation):
        seen.append(observation.clone())
        return observation[..., :1], torch.full_like(observation, 7.0)

    keys = ["action", ("next", "observation")]
    batch = collect(Countdown(shortest=3), TensorDictModule(foresee, ["observation"], keys))
    assert batch["observation"].shape[-1] == 2
    assert not any((each == 7).any() for each in seen)


def test_a_collector_that_was_shut_down_collects_no_more():
    collector = TrajectoryGroupCollector(Countdown(), num_groups=2, group_size=3)
    next(iter(collector))
    collector.shutdown()
    with pytest.raises(RuntimeError, match="was shut down: make another"):
        next(iter(collector))


@pytest.mark.parametrize(
    ("env", "error", "match"),
    [
        (lambda: Countdown(longest=50), RuntimeError, "max_steps=20.*append StepCounter"),
        (lambda: Stranger(lambda g: g + torch.arange(3)), ValueError, "equal for the group_size=3"),
        (lambda: Stranger(lambda g: g * 0), ValueError, "different from those of the others"),
    ],
)
def test_bad_environments(env, error, match):
    with pytest.raises(error, match=match):
        collect(env(), num_groups=20, max_steps=20)


# Workers do not find this module: what they need of it travels by value.
cloudpickle.register_pickle_by_value(sys.modules[__name__])


@pytest.mark.parametrize("sync", [True, False])
def test_worker_processes(sync, request):
    if not sync:
        request.getfixturevalue("forked_workers")
    policy = moded_policy()
    policy.module.weight.data.zero_()
    collector = TrajectoryGroupCollector(
        Countdown, policy, num_groups=4 if sync else 2, group_size=3, sync=sync,
        num_collectors=2 if sync else 1,
        total_frames=250, postproc=lambda batch: batch.set("seen", torch.ones(batch.shape)),
    )  # fmt: skip
    assert isinstance(collector, TrajectoryGroupCollector)
    workers = sorted(multiprocessing.active_children(), key=lambda process: process.pid)
    frames, groups, ids, weights, modes = 0, [], [], [], []
    with shut_down(collector):
        collector.set_seed(0)
        for i, batch in enumerate(collector, start=1):
            check_batch(batch, 4 if sync else 2, 3)
            assert batch["seen"].all()
            frames += int(batch["collector", "mask"].sum())
            groups += batch["group"][:, 0, 0].tolist()
            ids += batch["collector", "traj_ids"][..., 0].flatten().tolist()
            acted = batch["action"][batch["collector", "mask"]]
            assert (acted == acted[0]).all()  # one policy for the whole batch
            weights.append(float(acted[0]))
            modes.append(bool(batch["training"][0, 0, 0]))
            policy.train(i % 2 == 0)
            with torch.no_grad():
                policy.module.weight[0, 1] = i
            collector.update_policy_weights_()
        assert len(collector.state_dict()["players"]) == len(workers)
        collector.total_frames = float("inf")
        os.kill(workers[0].pid, signal.SIGKILL)
        with pytest.raises(ChildProcessError, match=r"Worker 0 .* by SIGKILL.* last checkpoint"):
            list(collector)
    assert not any(process.is_alive() for process in workers)
    assert 250 <= frames < 250 + (4 if sync else 2) * 3 * 6  # a batch's groups, copies and steps
    assert len(set(groups)) == len(groups)
    assert len(set(ids)) == len(ids)
    # A worker that does not wait has begun the next batch when it hands over one.
    assert weights == [max(i - (not sync), 0) for i in range(len(weights))]
    assert modes == [weight % 2 == 0 for weight in weights]


@pytest.mark.usefixtures("forked_workers")
def test_an_error_in_a_worker_process_is_raised_here():
    def fail():
        raise ZeroDivisionError("in the rules")

    make = partial(Countdown, on_step=fail)
    collector = TrajectoryGroupCollector(make, num_groups=2, group_size=3, num_collectors=1)
    with shut_down(collector), pytest.raises(ZeroDivisionError, match="in the rules"):
        next(iter(collector))


@pytest.mark.usefixtures("forked_workers")
def test_what_is_loaded_leaves_out_what_was_under_way():
    """The workers go on from the state, not with batches that they played before it was loaded."""
    collector = TrajectoryGroupCollector([Countdown, Countdown], num_groups=2, group_size=3)
    with shut_down(collector):
        batches = iter(collector)
        next(batches)
        state = collector.state_dict()
        for _ in range(3):
            next(batches)
        collector.load_state_dict(state)
        firsts = {}
        for _ in range(2):
            ids = next(batches)["collector", "traj_ids"].flatten()
            firsts.setdefault(int(ids[0]) % 2, int(ids[0]))
    for worker, first in firsts.items():
        assert first == state["players"][worker]["next_id"] * 2 + worker


class Unlicensed(Exception):
    def __init__(self, what, code):
        super().__init__(f"{what}: {code}")


def test_an_error_of_a_worker_that_cannot_travel_is_told():
    """It would count as the death of the worker, and its own words be lost."""

    def make():
        raise Unlicensed("no licence", 3)

    request = cloudpickle.dumps(({}, "start", make, 0))
    with pytest.raises(RuntimeError, match=r"Unlicensed: no licence: 3\nTraceback"):
        _serve(request)


@pytest.mark.parametrize("kind", [SupervisedSyncCollector, SupervisedAsyncCollector])
def test_frames_are_not_split(kind):
    with pytest.raises(ValueError, match=r"split_trajs .* batch is flat .*got True.*MultiSyncColl"):
        kind([partial(GymEnv, "Pendulum-v1")], frames_per_batch=8, split_trajs=True)


@pytest.mark.usefixtures("forked_workers")
def test_workers_that_play_frames_number_their_own_trajectories():
    """And fill a buffer, by way of what a user does to a batch."""
    buffer = ReplayBuffer(storage=LazyTensorStorage(100), batch_size=4)
    collector = SupervisedSyncCollector(
        [partial(GymEnv, "Pendulum-v1")] * 2,
        frames_per_batch=8,
        total_frames=8,
        replay_buffer=buffer,
        postproc=lambda batch: batch.exclude("observation"),
    )
    with shut_down(collector):
        assert [*collector] == [None]
    assert buffer[:]["collector", "traj_ids"].tolist() == [0] * 4 + [1] * 4
    assert "observation" not in {*buffer.sample().keys()}


def test_ray_workers():
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    policy = linear_policy()
    collector = TrajectoryGroupCollector(
        Countdown, policy, num_groups=4, group_size=3, backend="ray", num_collectors=2, sync=True,
        backend_options={
            "ray_init_config": {"address": "local", "num_cpus": 2, "include_dashboard": False},
            "remote_configs": {"num_cpus": 1, "num_gpus": 0},
        },
    )  # fmt: skip
    groups = []
    with shut_down(collector):
        collector.set_seed(0)
        for i, batch in enumerate(collector, start=1):
            check_batch(batch, 4, 3)
            groups += batch["group"][:, 0, 0].tolist()
            # All workers sampled from the weights of the last update.
            assert (batch["action"][batch["collector", "mask"]] == i - 1).all()
            with torch.no_grad():
                policy.module.weight[0, 1] = i
            collector.update_policy_weights_()
            if i == 4:
                break
        assert len(set(groups)) == len(groups)
        ray.kill(collector._workers._workers[1].actor)
        with pytest.raises(ChildProcessError, match=r"Worker 1 .* Ray cluster.* last checkpoint"):
            next(iter(collector))
    assert not ray.is_initialized()
