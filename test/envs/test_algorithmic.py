"""The algorithmic tasks against recordings of the original implementation, and as a TorchRL env."""

from __future__ import annotations

import copy
import io
import json
import lzma
from collections import defaultdict
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, ParallelEnv, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_ecpo.envs._groups import GroupIdAllocator
from torchrl_ecpo.envs.algorithmic import TASKS, AlgorithmicEnv

DATA = Path(__file__).parents[1] / "data"
GYM_NAMES = {name: name.title().replace("_", "") for name in TASKS}
TASK_NAMES = list(GYM_NAMES)


@cache
def recordings(name: str) -> dict[str, list[dict[str, Any]]]:
    """What was recorded, by gym's name of the task."""
    result = defaultdict(list)
    with lzma.open(DATA / f"{name}.jsonl.xz", "rt") as lines:
        for line in lines:
            recording = json.loads(line)
            result[recording["task"]].append(recording)
    return result


def pad(rows: list[list], width: int, value: Any = -1) -> Tensor:
    """Stack lists of unequal length; an entry may be a list itself."""
    filler = [value] * len(rows[0][0]) if isinstance(rows[0][0], list) else value
    return torch.tensor([row + [filler] * (width - len(row)) for row in rows])


def as_instance(inputs: list[list], batch: tuple[int, int]) -> Tensor:
    """The given inputs, as `reset` takes them."""
    padded = pad(inputs, max(map(len, inputs)))
    return padded.reshape(*batch, *padded.shape[1:])


def read_head(env: AlgorithmicEnv) -> Tensor:
    """Column of the read head, 0 at the start, `[G, K]`, or (column, row), `[G, K, 2]`."""
    head = env.state_dict()["_cursor"][:, :2].view(*env.batch_size, 2) - 1
    return head if env.task.rows > 1 else head[..., 0]


def act(td: TensorDictBase, action: Tensor, active: Tensor | None = None) -> TensorDictBase:
    """Set the action, and which episodes are to take it."""
    td["action"] = action.reshape(*td.batch_size, 3)
    if active is None:
        return td.exclude("_step")
    return td.set("_step", active.reshape(td.batch_size))


@pytest.mark.parametrize("task", TASK_NAMES)
def test_recorded_episodes_are_reproduced(task):
    episodes = recordings("algorithmic")[GYM_NAMES[task]]
    assert len(episodes) == 200
    env = AlgorithmicEnv(task, num_groups=50, group_size=4)
    td = env.reset(instance=as_instance([e["input"] for e in episodes], (50, 4)))
    steps = torch.tensor([len(e["actions"]) for e in episodes])
    longest = int(steps.max())
    actions = pad([e["actions"] for e in episodes], longest, 0)
    observations = pad([e["observations"] for e in episodes], longest + 1)
    recorded = {
        "observation": observations[:, 1:],
        "reward": pad([e["rewards"] for e in episodes], longest, 0.0),
        "done": pad([e["dones"] for e in episodes], longest, True),
        "terminated": pad([e["dones"] for e in episodes], longest, True),
        "previous_action": actions,
        "head": pad([e["read_head_after"] for e in episodes], longest, 0),
    }
    assert td["attainable"].flatten().tolist() == [e["max_reward"] for e in episodes]
    assert td["observation"].flatten().equal(observations[:, 0])
    total = torch.zeros(len(episodes))
    for t in range(longest):
        active = t < steps
        td = env.step(act(td, actions[:, t]))
        following = td["next"]
        assert not following["truncated"].any()
        # Episodes that have ended stay ended.
        assert following["done"].flatten()[~active].all()
        assert not following["reward"].flatten()[~active].any()
        total += following["reward"].flatten()
        now = {**following, "head": read_head(env)}
        for key, value in recorded.items():
            expected = value[active, t]
            assert now[key].flatten(0, 1)[active].reshape(expected.shape).equal(expected)
        td = env.step_mdp(td)
    assert td["done"].all()
    assert total.tolist() == [e["total_reward"] for e in episodes]


@pytest.mark.parametrize("task", TASK_NAMES)
def test_recorded_targets_and_time_limits(task):
    episodes = recordings("algorithmic")[GYM_NAMES[task]]
    batch = (200, 1)
    instance = as_instance([e["input"] for e in episodes], batch)
    env = AlgorithmicEnv(task, num_groups=200)

    targets = pad([e["target"] for e in episodes], 100, 0)
    td, total = env.reset(instance=instance), torch.zeros(200)
    for t in range(96):
        character = targets[:, t]
        blind = torch.stack([character * 0, character * 0 + 1, character], -1)
        td = env.step(act(td, blind, ~td["done"].flatten()))
        total += td["next", "reward"].flatten()
        td = env.step_mdp(td)
    assert total.equal(torch.tensor([float(len(e["target"])) for e in episodes]))

    td, clock = env.reset(instance=instance), torch.zeros(200, dtype=torch.int64)
    while not td["done"].all():
        clock += ~td["done"].flatten()
        idle = torch.zeros(200, 3, dtype=torch.int64)
        td = env.step(act(td, idle, ~td["done"].flatten()))
        assert td["next", "reward"].equal(-1.0 * (td["next", "done"] & ~td["done"]))
        td = env.step_mdp(td)
    assert clock.equal(torch.tensor([e["time_limit"] + 1 for e in episodes]))


def input_of(task: str, length: int, target_length: int) -> list:
    """Some input of so many columns, with such a target."""
    rows = TASKS[task].rows
    if rows == 1:
        return [1] * length
    return [[2 if target_length > length else 0] * rows] * length


@pytest.mark.parametrize("episodes", [60, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("task", TASK_NAMES)
def test_recorded_curricula_are_reproduced(task, episodes):
    """The first 60 episodes have successes, failures and, in all tasks, some rise of the level."""
    runs = recordings("algorithmic_curriculum")[GYM_NAMES[task]]
    batch = (len(runs), 1)
    first = torch.tensor([run["init_reset_target_len"] for run in runs])

    def make(seed: int) -> AlgorithmicEnv:
        return AlgorithmicEnv(task, num_groups=len(runs), curriculum="gym", seed=seed)

    # The recording's episode from before the first reset is drawn, here as there.
    env = next(e for e in map(make, range(10_000)) if e.state_dict()["_bound"][:, 0].equal(first))
    for played in zip(*(run["episodes"][:episodes] for run in runs), strict=True):
        levels, lengths, target_lengths, returns = (
            torch.tensor(x) for x in zip(*played, strict=True)
        )
        inputs = [
            input_of(task, int(length), int(target_length))
            for length, target_length in zip(lengths, target_lengths, strict=True)
        ]
        td = env.reset(instance=as_instance(inputs, batch))
        assert td["level"].flatten().tolist() == levels.tolist()
        assert td["attainable"].flatten().tolist() == target_lengths.tolist()
        total, targets = torch.zeros(len(runs)), env.state_dict()["_target"]
        right_until = torch.where(returns == target_lengths, target_lengths, target_lengths - 1)
        for t in range(int(target_lengths.max())):
            character = (targets[:, t] + (t >= right_until)).clamp(min=0) % TASKS[task].base
            action = torch.stack([character * 0, character * 0 + 1, character], -1)
            active = ~td["done"].flatten()
            if not active.any():
                break
            td = env.step(act(td, action, active))
            total += td["next", "reward"].flatten()
            td = env.step_mdp(td)
        assert td["done"].all()
        assert total.tolist() == returns.tolist()


RIGHT = 1


def read_tape(env: AlgorithmicEnv, columns: int) -> tuple[TensorDictBase, Tensor]:
    """Reset, then read so many columns of the first row of the input."""
    td, seen = env.reset(), []
    start = td.clone()
    for _ in range(columns):
        seen.append(td["observation"])
        td = env.step_mdp(env.step(act(td, torch.tensor([RIGHT, 0, 0]).expand(env.numel(), 3))))
    return start, torch.stack(seen, -1)


@pytest.mark.parametrize("task", [name for name in TASK_NAMES if name != "reversed_addition3"])
def test_lengths_and_characters_are_uniform(task):
    count, base = 6000, TASKS[task].base
    env = AlgorithmicEnv(task, num_groups=count, min_length=6, curriculum=None, seed=3)
    start, tape = read_tape(env, 9)
    length = (tape < base).sum(-1)[:, 0]
    shares = (
        {6: 2 / 3, 7: 0, 8: 1 / 3}
        if task == "duplicated_input"
        else dict.fromkeys((6, 7, 8), 1 / 3)
    )
    assert torch.isin(length, torch.tensor([*shares])).all()
    for size, share in shares.items():
        assert (length == size).float().mean().item() == pytest.approx(share, abs=0.03)
    if task == "duplicated_input":
        assert tape[..., :6:2].equal(tape[..., 1:6:2])
        tape = tape[..., ::2]
    pairs = (tape[..., 0] * base + tape[..., 2]).flatten()
    frequency = torch.bincount(pairs, minlength=base**2) / count
    spread = 5 * (1 / base**2 / count) ** 0.5
    assert (frequency - 1 / base**2).abs().max() < spread
    assert start["group"].unique().numel() == count


def test_the_seed_decides_the_episodes():
    def episodes(env: AlgorithmicEnv) -> Tensor:
        return torch.stack([read_tape(env, 4)[1] for _ in range(3)])

    make = partial(AlgorithmicEnv, "copy", num_groups=20, group_size=2)
    env = make(seed=5)
    first = episodes(env)
    assert first[:, :, 0].equal(first[:, :, 1])
    assert first.equal(episodes(make(seed=5)))
    assert not first.equal(episodes(make(seed=6)))
    assert not first.equal(episodes(env))
    env.set_seed(5)
    assert first.equal(episodes(env))
    torch.manual_seed(0)
    unseeded = episodes(make())
    torch.manual_seed(0)
    assert unseeded.equal(episodes(make()))


def random_policy(env: AlgorithmicEnv, generator: torch.Generator) -> Tensor:
    """Uniform actions that write now and then."""
    count, base = env.numel(), env.task.base
    moves = 2 if env.task.rows == 1 else 4
    return torch.stack(
        [
            torch.randint(moves, (count,), generator=generator),
            (torch.rand(count, generator=generator) < 0.3).long(),
            torch.randint(base, (count,), generator=generator),
        ],
        -1,
    )


@pytest.mark.parametrize("curriculum", ["group", "batch", "gym", None])
def test_copies_share_instances_when_they_are_reset_at_different_times(curriculum):
    env = AlgorithmicEnv("copy", num_groups=4, group_size=3, curriculum=curriculum, seed=0)
    generator = torch.Generator().manual_seed(0)
    td, tapes = env.reset(), {}
    played = [[[] for _ in range(3)] for _ in range(4)]
    for _ in range(120):
        tape = env.state_dict()["_tape"].view(4, 3, -1).clone()
        for row in range(4):
            for k in range(3):
                group = int(td["group"][row, k])
                if played[row][k][-1:] != [group]:
                    played[row][k].append(group)
                assert tapes.setdefault(group, tape[row, k]).equal(tape[row, k])
        td = env.step_and_maybe_reset(act(td, random_policy(env, generator)))[1]
    ids = set()
    for row in played:
        assert len({len(groups) for groups in row}) > 1, "the copies should have drifted apart"
        common = min(map(len, row))
        assert common > 5
        assert row[0][:common] == row[1][:common] == row[2][:common]
        own = {group for groups in row for group in groups}
        assert not ids & own
        ids |= own
    td = env.reset()  # brings all in step
    assert td["group"].equal(td["group"][:, :1].expand(-1, 3))


def partial_reset(
    env: AlgorithmicEnv, td: TensorDictBase, copies: Tensor, **options: Tensor
) -> TensorDictBase:
    return env.reset(td.clone().set("_reset", copies.unsqueeze(-1)), **options)


@pytest.mark.parametrize("task", ["copy", "reversed_addition"])
def test_partial_steps_leave_the_others_alone(task):
    make = partial(AlgorithmicEnv, task, num_groups=5, group_size=4, min_length=20)
    env, whole = make(), make()
    generator = torch.Generator().manual_seed(1)
    td = env.reset()
    for _ in range(12):
        active = torch.rand(5, 4, generator=generator) < 0.4
        actions = random_policy(env, generator) * torch.tensor([1, 0, 1])
        before, head = td.clone(), read_head(env)
        whole.load_state_dict(env.state_dict())
        stepped = whole.step(act(td.clone(), actions))["next"]
        td = env.step(act(td, actions, active))
        for key in ("observation", "previous_action", "group", "level", "attainable", "done"):
            assert td["next", key][active].equal(stepped[key][active])
            assert td["next", key][~active].equal(before[key][~active])
        assert read_head(env)[active].equal(read_head(whole)[active])
        assert read_head(env)[~active].equal(head[~active])
        assert not td["next", "reward"][~active].any()
        td = env.step_mdp(td)


def finish(env: AlgorithmicEnv, td: TensorDictBase, perfect: Tensor) -> TensorDictBase:
    """Play the Copy episodes to their end: perfectly, or with a mistake at once."""
    while not (done := td["done"][..., 0]).all():
        seen = td["observation"].clamp(max=4)
        character = torch.where(perfect, seen, (seen + 1) % 5)
        one = torch.ones_like(seen)
        td = env.step_mdp(env.step(act(td, torch.stack([one, one, character], -1), ~done)))
    return td


def levels_after(env: AlgorithmicEnv, perfect: Tensor, episodes: int) -> Tensor:
    """The levels that are drawn at, `[G, K]`, after so many episodes."""
    td = env.reset()
    for _ in range(episodes):
        finish(env, td, perfect)
        td = env.reset()
    return td["level"]


FIRST_COPY = torch.tensor([[True, False]] * 3)
SECOND_COPY = ~FIRST_COPY
LAST_ROW_FAILS = torch.tensor([[True, True], [True, True], [False, False]])


@pytest.mark.parametrize(
    ("curriculum", "perfect", "episodes", "levels"),
    [
        ("group", FIRST_COPY, 9, [[2, 2], [2, 2], [2, 2]]),
        ("group", FIRST_COPY, 10, [[3, 3], [3, 3], [3, 3]]),
        ("group", FIRST_COPY, 20, [[4, 4], [4, 4], [4, 4]]),
        ("group", SECOND_COPY, 20, [[2, 2], [2, 2], [2, 2]]),
        ("group", LAST_ROW_FAILS, 10, [[3, 3], [3, 3], [2, 2]]),
        ("gym", FIRST_COPY, 10, [[3, 2], [3, 2], [3, 2]]),
        ("gym", SECOND_COPY, 19, [[2, 3], [2, 3], [2, 3]]),
        ("batch", FIRST_COPY, 3, [[2, 2], [2, 2], [2, 2]]),
        ("batch", FIRST_COPY, 4, [[3, 3], [3, 3], [3, 3]]),
        ("batch", FIRST_COPY, 8, [[4, 4], [4, 4], [4, 4]]),
        ("batch", LAST_ROW_FAILS, 30, [[2, 2], [2, 2], [2, 2]]),
        (None, FIRST_COPY | SECOND_COPY, 20, [[2, 2], [2, 2], [2, 2]]),
    ],
)
def test_levels_rise_after_successes_in_a_row(curriculum, perfect, episodes, levels):
    env = AlgorithmicEnv("copy", num_groups=3, group_size=2, curriculum=curriculum, seed=0)
    assert levels_after(env, perfect, episodes).tolist() == levels


def test_in_gyms_curriculum_copies_at_different_levels_play_different_groups():
    env = AlgorithmicEnv("copy", num_groups=3, group_size=2, curriculum="gym", seed=0)
    levels_after(env, FIRST_COPY, 10)
    td, tape = read_tape(env, 5)
    assert (td["group"][:, 0] != td["group"][:, 1]).all()
    assert (td["attainable"][:, 0] - td["attainable"][:, 1]).tolist() == [1, 1, 1]
    both = tape < 5
    assert tape[:, 0][both[:, 1]].equal(tape[:, 1][both[:, 1]])
    levels_after(env, SECOND_COPY, 10)
    td, tape = read_tape(env, 5)
    assert td["group"][:, 0].equal(td["group"][:, 1])
    assert tape[:, 0].equal(tape[:, 1])


@pytest.mark.parametrize(
    ("options", "played", "levels"),
    [
        ({}, (9, -1, 9, 1), [2, 2, 2, 3]),  # a failure starts the count again
        ({"min_length": 29}, (10, 10, 10), [30, 30, 30]),  # the last level
        # An episode that is interrupted counts in gym's curriculum only.
        ({"curriculum": "group"}, (5, 0, 5), [2, 2, 3]),
        ({"curriculum": "batch"}, (5, 0, 5), [2, 2, 3]),
        ({"curriculum": "gym"}, (5, 0, 5), [2, 2, 2]),
    ],
)
def test_levels_after_so_many_successes_or_a_failure(options, played, levels):
    env = AlgorithmicEnv("copy", seed=0, **options)
    right = torch.tensor([[True]])
    assert [levels_after(env, right ^ (n < 0), abs(n)).item() for n in played] == levels


def test_stale_instances_do_not_count():
    env = AlgorithmicEnv("copy", group_size=2, seed=0)
    both = torch.tensor([[True, True]])
    follower = torch.tensor([[False, True]])
    td = env.reset()
    for _ in range(5):  # five instances, drawn at level 2, wait for the first copy
        td = partial_reset(env, td, follower)
    for episode in range(15):
        td = partial_reset(env, finish(env, td, both), ~follower)
        assert td["level"][0, 0] == (2 if episode < 9 else 3)
    # Those of the 15 that counted: ten at level 2, then five at level 3.
    assert env.curriculum.streaks.item() == 5


CONTINUED = ("observation", "previous_action", "level", "attainable", "done", ("next", "reward"))


@pytest.mark.parametrize("curriculum", ["group", "batch", "gym"])
def test_a_restored_environment_goes_on_identically(curriculum):
    make = partial(AlgorithmicEnv, "reverse", num_groups=3, group_size=2, curriculum=curriculum)
    env, other = make(seed=0), make(seed=1)

    def go_on(env: AlgorithmicEnv, td: TensorDictBase, steps: int) -> tuple[Any, TensorDictBase]:
        generator = torch.Generator().manual_seed(steps)
        result = []
        for _ in range(steps):
            stepped, td = env.step_and_maybe_reset(act(td, random_policy(env, generator)))
            result.append(stepped)
        return torch.stack(result), td

    go_on(env, env.reset(), 53)
    assert env.state_dict()["_queue.level"].shape[1] > 1, "instances should be pending"
    _, td = go_on(env, env.reset(), 21)
    file = io.BytesIO()
    torch.save(env.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    twin = copy.deepcopy(env)
    assert other.curriculum.levels.equal(env.curriculum.levels)
    expected, _ = go_on(env, td.clone(), 200)
    for continued in (other, twin):
        got, _ = go_on(continued, td.clone(), 200)
        for key in CONTINUED:
            assert got[key].equal(expected[key]), key
        assert got["group"][0].equal(expected["group"][0])
        late = set(got["group"][-1].flatten().tolist())
        assert not late & set(expected["group"].flatten().tolist())


def test_given_instances_share_a_group_where_they_are_the_same():
    env = AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=0)
    drawn = AlgorithmicEnv("copy", num_groups=2, group_size=3, seed=0)
    inputs = [[1, 2], [1, 2], [1, 2, 3], [1, 2], [0], [0]]
    td = env.reset(instance=as_instance(inputs, (2, 3)))
    (a, b, c), (d, e, f) = td["group"].tolist()
    assert a == b
    assert e == f
    assert len({a, c, d, e}) == 4
    assert td["attainable"].tolist() == [[2, 2, 3], [2, 1, 1]]
    # The drawn instances are not used up, and other copies not disturbed.
    some = torch.tensor([[False, True, False], [False, False, False]])
    td = partial_reset(env, td, some, instance=as_instance([[4]] * 6, (2, 3)))
    assert td["attainable"].tolist() == [[2, 1, 3], [2, 1, 1]]
    assert td["observation"].tolist() == [[1, 4, 1], [1, 0, 0]]
    for _ in range(3):
        keys = ("observation", "attainable")
        assert (env.reset().select(*keys) == drawn.reset().select(*keys)).all()


def test_instances_are_given_through_transforms():
    env = TransformedEnv(AlgorithmicEnv("copy", num_groups=2), RewardSum())
    instance = torch.tensor([[[1, 2, 3]], [[4, 4, -1]]])
    assert env.reset(instance=instance)["attainable"].tolist() == [[3], [2]]


@pytest.mark.parametrize("task", TASK_NAMES)
def test_specs(task):
    env = AlgorithmicEnv(task, num_groups=3, group_size=2)
    check_env_specs(env)
    check_env_specs(env, break_when_any_done="both")
    transformed = TransformedEnv(env, Compose(StepCounter(10), RewardSum()))
    check_env_specs(transformed, break_when_any_done="both")
    blank, moves = env.task.base, 2 if env.task.rows == 1 else 4
    td = env.reset()
    assert td["previous_action"].flatten(0, 1).unique(dim=0).tolist() == [[moves, 2, blank]]
    assert env.action_spec.rand().shape == (3, 2, 3)
    assert {key: td[key].dtype for key in ("observation", "group", "level", "attainable")} == {
        "observation": torch.int64,
        "group": torch.int64,
        "level": torch.int64,
        "attainable": torch.float32,
    }


def test_partial_steps_of_parallel_environments():
    # TorchRL lets a "_step" mask choose among workers, not within one.
    makers = [partial(AlgorithmicEnv, "copy", seed=seed) for seed in (0, 1)]
    env = ParallelEnv(2, makers, mp_start_method="fork")
    try:
        rollout = env.rollout(30, break_when_any_done=False, break_when_all_done=True)
        for maker, first in zip(makers, rollout["observation"][..., 0], strict=True):
            assert first.equal(maker().reset()["observation"])
    finally:
        env.close()
    assert rollout["next", "done"][..., -1, :].all()
    assert rollout.shape[-1] < 30
    assert rollout["group"].unique().numel() == 2


def test_group_ids_are_unique():
    allocator = GroupIdAllocator()
    others = [GroupIdAllocator(), copy.deepcopy(allocator), copy.copy(allocator)]
    ids = torch.cat([a.allocate(1000) for a in (allocator, *others, allocator)])
    assert ids.dtype == torch.int64
    assert ids.min() >= 0
    assert ids.unique().numel() == 5000
    # The counter of an allocator runs over without a repetition.
    half = 1 << 23
    starts = [allocator.allocate(2, stride=half // 2)[0].item() for _ in range(5)]
    assert len(set(starts)) == 5
    with pytest.raises(ValueError, match="at most 16777216 in one call, got 16777217"):
        allocator.allocate((1 << 24) + 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "sort"}, "Unknown task 'sort'.*copy, duplicated_input.*reversed_addition3"),
        ({"min_length": 31}, r"min_length of copy must lie in 1\.\.30, got 31"),
        (
            {"task": "duplicated_input", "min_length": 1},
            r"min_length of duplicated_input must lie in 2\.\.30, got 1",
        ),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        AlgorithmicEnv(**{"task": "copy", **arguments})


@pytest.mark.parametrize(
    ("task", "instance", "message"),
    [
        ("copy", torch.zeros(1, 2, 0, dtype=torch.int64), r"L in 1\.\.32, got \[1, 2, 0\]"),
        ("copy", torch.zeros(1, 2, 33, dtype=torch.int64), r"L in 1\.\.32, got \[1, 2, 33\]"),
        ("copy", torch.tensor([[[1, 2], [5, 1]]]), r"characters in 0\.\.4, .* got \[5, 1, -1"),
        ("copy", torch.tensor([[[1, 2], [-1, -1]]]), r"at least one, .* got \[-1, -1"),
        ("copy", torch.tensor([[[1, 2, 0], [1, -1, 1]]]), r"then -1 as padding, .* got \[1, -1, 1"),
        (
            "reversed_addition",
            torch.tensor([[[[1, 2], [0, -1]], [[1, 2], [0, 0]]]]),
            r"in all rows of the input alike .* got \[\[1, 2\], \[0, -1\]",
        ),
        ("reversed_addition", torch.zeros(1, 2, 4, dtype=torch.int64), r"\[1, 2, L, 2\]"),
        ("duplicated_input", torch.tensor([[[1, 1], [1, 2]]]), r"twice .* got \[1, 2, -1"),
        ("duplicated_input", torch.tensor([[[1, 1, 1], [1, 1, -1]]]), r"got \[1, 1, 1, -1"),
    ],
)
def test_malformed_instances_are_refused(task, instance, message):
    env = AlgorithmicEnv(task, group_size=2, seed=0)
    before = env.state_dict()["_tape"].clone()
    with pytest.raises(ValueError, match=message):
        env.reset(instance=instance)
    assert env.state_dict()["_tape"].equal(before)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ([2, 0, 0], r"of copy must lie between \[0, 0, 0\] and \[1, 1, 4\], got \[2, 0, 0\]"),
        ([0, -1, 0], r"got \[0, -1, 0\]"),
    ],
)
def test_actions_outside_the_spec_are_refused(action, message):
    env = AlgorithmicEnv("copy", group_size=2, seed=0)
    td = env.reset()
    td["action"] = torch.stack([torch.tensor(action) * 0, torch.tensor(action)]).unsqueeze(0)
    with pytest.raises(ValueError, match=message):
        env.step(td)


def test_only_the_actions_that_are_taken_are_checked():
    env = AlgorithmicEnv("copy", group_size=2, seed=0)
    td = act(env.reset(), torch.tensor([[0, 0, 0], [9, 9, 9]]), torch.tensor([True, False]))
    assert not env.step(td)["next", "done"].any()
