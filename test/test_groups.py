from __future__ import annotations

import gc
import pickle
import random
import re
import weakref

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from processes import FORKED
from tensordict import (
    LazyStackedTensorDict,
    NonTensorData,
    NonTensorStack,
    TensorDict,
    assert_close,
)
from torchrl.data import (
    LazyMemmapStorage,
    LazyStackStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    TensorDictMaxValueWriter,
    TensorDictReplayBuffer,
    TensorStorage,
)

from torchrl_ecpo.groups import TrajectoryGroupSampler, pack_groups, unpack_groups

MASK, DONE, TRAJECTORY = ("collector", "mask"), ("next", "done"), ("collector", "traj_ids")


def make_steps(trajectories, *, first_id=0, ended=True, traj_ids=True, is_init=False):
    """Flat steps of (group, length) trajectories; `x` counts them, `time` within each."""
    rows = []
    for i, (group, length) in enumerate(trajectories):
        done = torch.zeros(length, 1, dtype=torch.bool)
        done[-1] = ended
        data = {
            "group": torch.full((length,), group),
            "time": torch.arange(length),
            "next": {"done": done, "reward": torch.ones(length, 1)},
        }
        if traj_ids:
            data["collector"] = {"traj_ids": torch.full((length,), first_id + i)}
        if is_init:
            data["is_init"] = (data["time"] == 0).unsqueeze(-1)
        rows.append(TensorDict(data, [length]))
    steps = torch.cat(rows)
    return steps.set("x", torch.arange(len(steps)) + 1000 * first_id)


@pytest.mark.parametrize("as_lazy_stack", [False, True])
def test_trajectories_of_unequal_length(as_lazy_stack):
    """One tensordict each; they are not taken for one where the first has no end."""
    lengths = ((7, 3), (7, 2), (3, 1), (3, 4))
    rows = [make_steps([each], traj_ids=False) for each in lengths]
    groups = pack_groups(LazyStackedTensorDict.lazy_stack(rows) if as_lazy_stack else rows)
    assert groups[MASK].sum(-1).tolist() == [[3, 2], [1, 4]]
    assert_close(unpack_groups(groups).exclude("collector"), torch.cat(rows))
    rows[0][DONE][-1] = False
    assert pack_groups([row.exclude(DONE) for row in rows])[MASK].sum(-1).tolist() == [
        [3, 2],
        [1, 4],
    ]
    with pytest.raises(ValueError, match=r"must be a tensordict \[T\], got one of shape \(1, 3\)"):
        pack_groups([rows[0].unsqueeze(0)])
    with pytest.raises(TypeError, match="a trajectory must be a TensorDictBase, got"):
        pack_groups([1])
    with pytest.raises(TypeError, match="data must be a TensorDictBase or list or tuple, got"):
        pack_groups(1)
    with pytest.raises(ValueError, match="got no trajectories"):
        pack_groups([])


def make_buffer(size=100, *, storage=LazyTensorStorage, seed=0, batch_size=4, **options):
    return TensorDictReplayBuffer(
        storage=storage(size),
        sampler=TrajectoryGroupSampler(**{"group_size": 2, **options}),
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )


TRAJECTORIES = [(5, 3), (5, 1), (2, 4), (2, 2), (9, 1), (9, 1)]


class TestPack:
    def test_unpacking_leaves_its_input_alone(self):
        groups = pack_groups(make_steps(TRAJECTORIES))
        groups["next", "info"] = TensorDict({}, groups.shape)
        unpack_groups(groups.lock_())
        assert groups.get(("next", "info")) is not None
        assert groups.get(MASK) is not None

    @pytest.mark.parametrize("traj_ids", [True, False])
    def test_flat_round_trip_is_exact(self, traj_ids):
        steps = make_steps(TRAJECTORIES, traj_ids=traj_ids)
        groups = pack_groups(steps, group_size=2)
        assert groups.shape == (3, 2, 4)
        assert groups["group"][..., 0].tolist() == [[5, 5], [2, 2], [9, 9]]
        assert groups[MASK].sum(-1).tolist() == [[3, 1], [4, 2], [1, 1]]
        assert groups["x"][0, 0].tolist() == [0, 1, 2, 0]
        assert_close(unpack_groups(groups), steps, rtol=0, atol=0)
        assert_close(pack_groups(unpack_groups(groups)), groups, rtol=0, atol=0)
        assert_close(pack_groups(groups.reshape(-1)), groups, rtol=0, atol=0)

    @pytest.mark.parametrize("traj_ids", [True, False])
    def test_what_a_sampler_pads_is_packed(self, traj_ids):
        """Also a trajectory of one step, whose padding begins and ends at every step."""
        steps = make_steps([(5, 1), (5, 3)], is_init=True, traj_ids=traj_ids)
        padded = steps[torch.tensor([[0, 0, 0], [1, 2, 3]])]
        assert pack_groups(padded)[MASK].sum(-1).tolist() == [[1, 3]]
        with pytest.raises(ValueError, match="Rows hold several trajectories"):
            pack_groups(steps[torch.tensor([[0, 1, 2]])])

    def test_interleaved_steps_of_any_kind(self):
        """Texts go with their step, and padding repeats the last one."""
        steps = make_steps([(1, 2), (0, 3), (1, 1), (0, 1)], is_init=True)
        steps = steps[torch.tensor([2, 0, 6, 3, 5, 1, 4])]  # in time order within each
        steps["next", "text"] = NonTensorStack(*(f"step {x}" for x in steps["x"].tolist()))
        steps["task"] = NonTensorData("sums", batch_size=[7])
        groups = pack_groups(steps)
        assert groups["group"][:, 0, 0].tolist() == [0, 1]
        assert groups["x"].tolist() == [[[2, 3, 4], [6, 0, 0]], [[0, 1, 0], [5, 0, 0]]]
        real = unpack_groups(groups)
        assert real["next", "text"] == [f"step {x}" for x in real["x"].tolist()]
        assert groups["next", "text"][0][1] == ["step 6"] * 3
        assert groups["task"] == "sums"

    @given(
        st.lists(
            st.tuples(st.integers(0, 99), st.lists(st.integers(1, 6), min_size=3, max_size=3)),
            min_size=1,
            max_size=6,
            unique_by=lambda group: group[0],
        ),
        st.randoms(use_true_random=False),
    )
    @settings(max_examples=40)
    def test_any_lengths_and_order(self, groups, random):
        trajectories = [(group, length) for group, lengths in groups for length in lengths]
        random.shuffle(trajectories)
        steps = make_steps(trajectories)
        packed = pack_groups(steps, group_size=3)
        first_seen = list(dict.fromkeys(group for group, _ in trajectories))
        assert packed["group"][:, 0, 0].tolist() == first_seen
        assert sorted(unpack_groups(packed)["x"].tolist()) == steps["x"].tolist()
        mask = packed[MASK]
        assert (packed["time"][mask] == torch.arange(mask.shape[-1]).expand(mask.shape)[mask]).all()
        assert (packed[DONE][mask].squeeze(-1).sum()) == len(trajectories)

    def test_padded_rows_and_groups(self):
        groups = pack_groups(make_steps(TRAJECTORIES, is_init=True))
        lazy = LazyStackedTensorDict(*groups.unbind(0))
        assert_close(unpack_groups(lazy), unpack_groups(groups), rtol=0, atol=0)
        lazy = LazyStackedTensorDict(*groups.reshape(6, 4).unbind(0))
        assert_close(pack_groups(lazy), groups, rtol=0, atol=0)
        rows = groups.reshape(6, 4)[torch.tensor([0, 2, 1, 4, 3, 5])]
        assert_close(pack_groups(rows), groups, rtol=0, atol=0)
        assert pack_groups(groups, group_size=2) is groups
        assert_close(pack_groups(groups.exclude(MASK)), groups, rtol=0, atol=0)

    @pytest.mark.parametrize("dtype", [torch.int64, torch.int32, torch.uint8, torch.float32])
    def test_flags_and_ids_of_other_types(self, dtype):
        """They are what they say, in packing and in drawing."""
        steps = make_steps(TRAJECTORIES)
        expected = pack_groups(steps)
        steps[DONE] = steps[DONE].to(dtype)
        if not dtype.is_floating_point:
            steps["group"] = steps["group"].to(dtype)
            steps[TRAJECTORY] = steps[TRAJECTORY].to(dtype).unsqueeze(-1)
        assert (pack_groups(steps)["x"] == expected["x"]).all()
        buffer = make_buffer(batch_size=6)
        buffer.extend(steps)
        sample = buffer.sample()
        assert sorted(sample["x"][sample[MASK]].tolist()) == list(range(12))

    @pytest.mark.parametrize(
        ("change", "error", "match"),
        [
            (lambda s: s.exclude("group"), KeyError, "'group'.*'next', 'done'.*GroupedEnv"),
            (lambda s: s[3:], ValueError, r"Group 5 has 1 trajectories, expected 2 \(1 of 3"),
            (lambda s: s[:-1], ValueError, "Group 9 has 1 trajectories"),
            (lambda s: s[:9], ValueError, "1 trajectories have no end.*group 2.*StepCounter"),
            (lambda s: s[1:], ValueError, "1 trajectories have no beginning.*is_init.*group 5"),
            (
                lambda s: torch.cat([s[:2], s[3:]]).exclude(TRAJECTORY),
                ValueError,
                r"have no end \(\('next', 'done'\)|begin again",
            ),
            (lambda s: s[:0], ValueError, "no steps"),
            (lambda s: s[0], ValueError, r"steps \[S\]"),
            (lambda s: s.exclude(DONE, TRAJECTORY), KeyError, "tell one trajectory from the next"),
        ],
    )
    def test_bad_steps(self, change, error, match):
        with pytest.raises(error, match=match):
            pack_groups(change(make_steps(TRAJECTORIES, is_init=True)), group_size=2)

    def test_bad_sizes(self):
        steps = make_steps(TRAJECTORIES)
        with pytest.raises(ValueError, match=r"at least 2.*got 1"):
            pack_groups(make_steps([(0, 2), (1, 2)]))
        with pytest.raises(ValueError, match="Groups of 2 trajectories, expected group_size=3"):
            pack_groups(pack_groups(steps), group_size=3)
        with pytest.raises(ValueError, match=r"Group 2 has 2 trajectories, expected 3 \(3 of 3"):
            pack_groups(steps, group_size=3)

    @pytest.mark.parametrize(
        ("key", "where", "value", "match"),
        [
            (MASK, (0, 0, 0), False, "holes"),
            (MASK, (0, 0), False, "1 trajectories have no real step"),
            ("group", (0, 1), 4, re.escape("groups [4, 5]")),
            ("group", (0, 0, 1), 4, "1 trajectories change their group"),
            (DONE, (1, 0), False, r"1 trajectories have no end .*'done'"),
            (DONE, (1, 0), True, "1 trajectories go on after their end"),
            ("is_init", (1, 0), False, "1 trajectories have no beginning"),
            ("is_init", (1, 0), True, "1 trajectories begin again"),
        ],
    )
    def test_bad_padding(self, key, where, value, match):
        groups = pack_groups(make_steps(TRAJECTORIES, is_init=True)).clone()
        groups[key][where] = value
        for data in (groups,) if "groups" in match else (groups, groups.reshape(6, 4)):
            with pytest.raises(ValueError, match=match):
                pack_groups(data)

    @pytest.mark.parametrize(
        ("ids", "done", "is_init"),
        [
            ([3, 3, 0, 0, 0], [0, 1, 0, 0, 1], None),  # the second one has the id 0
            ([3, 3, 4, 4, 4], [0, 1, 0, 0, 0], None),  # the second one has no end
            ([0, 0, 4, 4, 0], [0, 1, 0, 1, 0], None),
            ([3, 3, 3, 3, 3], [0, 1, 0, 1, 0], [1, 0, 1, 0, 0]),
        ],
    )
    def test_a_second_trajectory_in_a_padded_row_is_refused(self, ids, done, is_init):
        row = TensorDict(
            {
                "group": torch.full((5,), 7),
                "is_init": torch.tensor(is_init or [1, 0, 0, 0, 0]).bool(),
                "collector": {"traj_ids": torch.tensor(ids)},
                "next": {"done": torch.tensor(done).bool().unsqueeze(-1)},
            },
            [5],
        )
        whole = row.clone()
        for key in ("is_init", TRAJECTORY, DONE):
            whole[key][2:] = 0
        assert pack_groups(torch.stack([whole, whole])).shape == (1, 2, 2)
        with pytest.raises(ValueError, match=r"several trajectories.*flat"):
            pack_groups(torch.stack([whole, row]))


def is_whole(sample):
    """Every trajectory of the sample runs from its first step to its end."""
    mask = sample[MASK]
    done = sample[DONE].squeeze(-1)
    last = done.gather(-1, mask.sum(-1, keepdim=True) - 1)
    right_time = sample["time"] == torch.arange(mask.shape[-1])
    return bool(last.all() and (done & mask).sum(-1).eq(1).all() and right_time[mask].all())


def drawn_groups(buffer, draws=30):
    samples = [buffer.sample() for _ in range(draws)]
    assert all(map(is_whole, samples))
    return {int(group) for sample in samples for group in sample["group"].flatten()}


class TestSampler:
    def test_draws_complete_groups(self):
        buffer = make_buffer()
        buffer.extend(make_steps([*TRAJECTORIES, (7, 2)]))
        for _ in range(30):
            sample = buffer.sample()
            assert sample.shape[:2] == (2, 2)
            group = sample["group"][..., 0]
            assert (group[:, 0] == group[:, 1]).all()
            assert group[0, 0] != group[1, 0]
            assert (sample["x"][..., 0].unique().numel()) == 4
            assert pack_groups(sample, group_size=2) is sample
        assert drawn_groups(buffer) == {5, 2, 9}  # 7 waits
        buffer.extend(make_steps([(7, 1)], first_id=50))
        assert 7 in drawn_groups(buffer)

    @pytest.mark.parametrize("what", ["groups", "members"])
    def test_draws_are_uniform_and_independent(self, what):
        """Ordered pairs of 4 groups, or of 4 members: each pair follows each equally often."""
        groups = what == "groups"
        buffer = make_buffer(seed=1)
        buffer.extend(make_steps([(i // 2, 1) for i in range(8)] if groups else [(7, 1)] * 4))
        size = 4 if groups else 2
        draws = [buffer.sampler.sample(buffer.storage, size)[0].flatten() for _ in range(6000)]
        pairs = torch.stack(draws)
        first, second = (pairs[:, ::2] // 2 if groups else pairs).unbind(1)
        assert (first != second).all()
        pair = 4 * first + second
        counts = (16 * pair[:-1] + pair[1:]).bincount(minlength=256)
        possible = torch.arange(16)[torch.arange(16) // 4 != torch.arange(16) % 4]
        counts = counts.view(16, 16)[possible][:, possible].double()
        expected = 5999 / 144
        chi_square = ((counts - expected) ** 2 / expected).sum()
        assert chi_square < 143 + 5 * (2 * 143) ** 0.5

    def test_without_replacement(self):
        buffer = make_buffer(replacement=False)
        buffer.extend(make_steps([(g, 1 + g % 3) for g in range(7) for _ in range(2)]))
        for _ in range(3):
            drawn = torch.cat([sample["group"][:, 0, 0] for sample in buffer])
            assert drawn.numel() == drawn.unique().numel() == 6
        half = buffer.sample()["group"][:, 0, 0].tolist()
        buffer.extend(make_steps([(50, 2), (50, 2)], first_id=100))
        rest = [int(g) for _ in range(3) for g in buffer.sample()["group"][:, 0, 0]]
        assert sorted(half + rest) == [0, 1, 2, 3, 4, 5, 6, 50]

    def test_passes_do_not_repeat_when_prefetched(self):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(100),
            sampler=TrajectoryGroupSampler(group_size=2, replacement=False),
            batch_size=2,
            prefetch=3,
        )
        buffer.extend(make_steps([(g, 2) for g in range(7) for _ in range(2)]))
        for _ in range(5):
            assert sorted(int(sample["group"][0, 0, 0]) for sample in buffer) == list(range(7))

    @pytest.mark.parametrize("is_init", [True, False])
    @pytest.mark.parametrize("traj_ids", [True, False])
    def test_whole_or_not_at_all(self, traj_ids, is_init):
        """Whatever the lengths, fragments and sizes; nothing whole is left out, either."""
        draw = random.Random(0)
        drawn = 0
        for _ in range(20):
            lengths = [draw.randint(1, 5) for _ in range(30)]
            size = draw.randint(5, 9)
            steps = make_steps([(7, n) for n in lengths], traj_ids=traj_ids, is_init=is_init)
            end = torch.tensor(lengths).cumsum(0)
            buffer = make_buffer(size, batch_size=2)
            written = 0
            while written < len(steps):
                part = steps[written : written + draw.randint(1, size + 3)]
                buffer.extend(part) if len(part) > 1 else buffer.add(part[0])
                written += len(part)
                whole = (end <= written) & (end - torch.tensor(lengths) >= written - size)
                if len(part) <= size:  # otherwise the beginning of the oldest was not seen
                    assert buffer.can_sample() == (whole.sum() >= 2)
                if buffer.can_sample():
                    assert is_whole(buffer.sample())
                    drawn += 1
        assert drawn > 50

    @pytest.mark.parametrize("parts", [(2, 4), (6,), (3, 3), (1, 2, 3), (5, 1)])
    def test_what_just_fits_the_storage_is_drawn(self, parts):
        buffer = make_buffer(6, batch_size=2)
        for lap in range(3):
            for part in make_steps([(7, 3), (7, 3)], first_id=2 * lap).split(parts):
                buffer.extend(part)
            drawn = buffer.sample()["x"].sort().values[0].tolist()
            first = 2000 * lap
            assert sorted(drawn) == [[first + i for i in (0, 1, 2)], [first + i for i in (3, 4, 5)]]

    @pytest.mark.parametrize("lengths", [(2, 4, 4, 2), (4, 4, 2, 2), (2, 5, 3, 2)])
    def test_a_torn_trajectory_is_not_whole_after_a_reindex(self, lengths):
        """The oldest steps follow the end of the newest trajectory in the storage."""
        size = 6
        buffer = make_buffer(size, batch_size=2)
        for part in make_steps([(7, length) for length in lengths]).split(size):
            buffer.extend(part)
        again = pickle.loads(pickle.dumps(buffer))
        buffer.set_sampler(TrajectoryGroupSampler(group_size=2))
        around = TensorDictReplayBuffer(
            storage=buffer.storage, sampler=TrajectoryGroupSampler(group_size=2), batch_size=2
        )
        for other in (again, buffer, around):
            if other.can_sample():
                assert drawn_groups(other) == {7}
                lengths_drawn = other.sample()[MASK].sum(-1).flatten().tolist()
                assert sorted(lengths_drawn) == sorted(lengths[-2:])
        around.extend(make_steps([(8, 1), (8, 1)], first_id=60))
        assert drawn_groups(around) == {8}

    def test_pieces_between_each_other_are_left_out(self):
        """As batches [4 environments, 5 steps] of episodes of 3 and 7 steps, written flat."""
        for is_init in (True, False):
            buffer = make_buffer(1000)
            episodes = [
                make_steps([(n, 3 + 4 * (n % 2)) for n in range(12)], first_id=9 * e, is_init=True)
                for e in range(4)
            ]
            batches = torch.stack([e if is_init else e.exclude("is_init") for e in episodes])
            for time in range(0, 60, 5):
                buffer.extend(batches[:, time : time + 5].reshape(-1))
            if is_init:  # Some of the short ones lie within a batch.
                assert drawn_groups(buffer) <= set(range(0, 12, 2))
            else:
                with pytest.raises(RuntimeError, match=r"0 complete.*no beginning"):
                    buffer.sample()

    def test_a_missing_beginning(self):
        whole = make_steps([(7, 3), (7, 3), (7, 3)], is_init=True)
        for steps in (whole[1:], torch.cat([whole[:3], whole[4:]])):
            buffer = make_buffer(batch_size=2)
            buffer.extend(steps)
            assert drawn_groups(buffer) == {7}

    @pytest.mark.filterwarnings("ignore:Loading the storage on an uninitialized")
    @pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
    @pytest.mark.parametrize("replacement", [True, False])
    @pytest.mark.parametrize("on_disk", [True, False])
    def test_restored_buffer_draws_the_same(self, storage, replacement, on_disk, tmp_path):
        def fill(buffer, first):
            for i in range(first, first + 9):
                buffer.extend(make_steps([(i, 2), (i, 3)], first_id=2 * i))

        buffer, other = (
            make_buffer(40, storage=storage, seed=seed, replacement=replacement) for seed in (0, 1)
        )
        fill(buffer, 0)
        buffer.extend(make_steps([(100, 2)], ended=False, first_id=100))
        buffer.sample()
        if on_disk:
            buffer.dumps(tmp_path / "buffer")
            other.loads(tmp_path / "buffer")
        else:
            other.load_state_dict(buffer.state_dict())
        for _ in range(3):
            assert_close(buffer.sample(), other.sample())
        with pytest.raises(ValueError, match=r"group_size=2, this one has group_size=3"):
            TrajectoryGroupSampler(group_size=3).load_state_dict(buffer.sampler.state_dict())
        for b in (buffer, other):
            fill(b, 20)
        for _ in range(3):
            assert_close(buffer.sample(), other.sample())

    def test_another_process_writes(self):
        sampler = TrajectoryGroupSampler(group_size=2)
        storage = LazyMemmapStorage(20)
        buffer = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=2)
        buffer.extend(make_steps([(0, 3), (0, 3), (1, 4), (1, 4)]))
        assert drawn_groups(buffer) == {0, 1}
        steps = make_steps([(2, 4), (2, 4)], first_id=9)
        process = FORKED.Process(target=buffer.extend, args=(steps,))
        process.start()
        process.join()
        assert process.exitcode == 0
        assert drawn_groups(buffer) == {1, 2}  # half of a trajectory of group 0 is overwritten
        buffer.extend(make_steps([(3, 1), (3, 1)], first_id=99))
        assert drawn_groups(buffer) == {1, 2, 3}

    def test_storage_with_data(self):
        steps = torch.cat(
            [make_steps([(1, 3), (1, 3)]), make_steps([(1, 2)], first_id=9, ended=False)]
        )
        buffer = TensorDictReplayBuffer(
            storage=TensorStorage(steps), sampler=TrajectoryGroupSampler(group_size=2), batch_size=2
        )
        assert drawn_groups(buffer) == {1}
        steps = make_steps([(1, 3), (1, 3), (2, 2), (2, 2)])
        sampler = TrajectoryGroupSampler(group_size=2)
        full = TensorDictReplayBuffer(storage=TensorStorage(steps), sampler=sampler, batch_size=4)
        assert drawn_groups(full) == {1, 2}
        storage = LazyTensorStorage(20)
        storage.set(torch.arange(10), steps)
        part = TensorDictReplayBuffer(
            storage=storage, sampler=TrajectoryGroupSampler(group_size=2), batch_size=2
        )
        assert drawn_groups(part) == {1, 2}
        for buffer in (full, part):  # Then the first one loses its beginning.
            buffer.extend(make_steps([(3, 1), (3, 1)], first_id=9))
        assert drawn_groups(full) == {2, 3}
        # TorchRL takes slots 10 and 11 for written now.
        with pytest.raises(RuntimeError, match=r"counts 12 steps.*at slot 0, over the steps"):
            part.sample()

    def test_edit_in_place(self):
        buffer = make_buffer(batch_size=2)
        buffer.extend(make_steps([(1, 2), (1, 2), (3, 1)]))
        buffer.extend(make_steps([(3, 2)], first_id=10, ended=False))
        assert drawn_groups(buffer) == {1}
        buffer[0:4] = buffer[0:4].clone().set("group", torch.full((4,), 8))
        for index in (torch.arange(4), torch.arange(3, -1, -1), torch.tensor([1]), 6):
            buffer.mark_update(index)
            assert drawn_groups(buffer) == {8}
        buffer.extend(make_steps([(3, 1)], first_id=10))  # goes on with the last one
        buffer.mark_update(buffer.sample()["index"])
        assert {len(buffer.sample()[MASK][0, 0]) for _ in range(30)} == {2, 3}

    def test_nothing_to_draw(self):
        buffer = make_buffer(replacement=False)
        buffer.extend(make_steps(TRAJECTORIES))
        buffer.empty()
        with pytest.raises(RuntimeError, match=r"2 group\(s\) of 2.*0 complete"):
            buffer.sample()
        buffer.extend(make_steps([(1, 2), (1, 2), (2, 2)]))
        buffer.extend(make_steps([(2, 5)], first_id=9, ended=False))
        with pytest.raises(
            RuntimeError,
            match=r"1 complete group.*0 of them drawn.*1 with fewer than 2.*1 trajectories have no "
            r"end.*StepCounter",
        ):
            buffer.sample()

    def test_padding_is_refused(self):
        groups = pack_groups(make_steps(TRAJECTORIES))
        for padded, message in (
            (groups, r"needs flat steps \[S\], got data of shape .*Write buffer.extend\(unpack"),
            (groups.reshape(-1), r"hold padding .*Write buffer.extend\(unpack_groups"),
        ):
            with pytest.raises(ValueError, match=message):
                make_buffer().extend(padded)
        buffer = make_buffer()
        buffer.extend(unpack_groups(groups))
        assert buffer.sample().shape[:2] == (2, 2)

    def test_plain_replay_buffer(self):
        buffer = ReplayBuffer(
            storage=LazyTensorStorage(100),
            sampler=TrajectoryGroupSampler(group_size=2),
            transform=pack_groups,
            batch_size=4,
        )
        buffer.extend(make_steps(TRAJECTORIES))
        sample, info = buffer.sample(return_info=True)
        assert (sample[MASK] == info[MASK]).all()

    @pytest.mark.parametrize(
        ("options", "error", "match"),
        [
            ({"group_size": 1}, ValueError, "group_size must be an integer of at least 2.*got 1"),
            ({"batch_size": 5}, ValueError, r"num_groups \* group_size=2, got 5"),
            ({"group_key": "instance"}, KeyError, "'instance' is missing.*problem instance"),
            ({"done_key": ("next", "end")}, KeyError, "end.*where a trajectory ends"),
            ({"storage": ListStorage}, TypeError, "LazyTensorStorage.*got ListStorage"),
            ({"storage": LazyStackStorage}, TypeError, "LazyTensorStorage.*got LazyStackStorage"),
            ({"storage": lambda n: LazyTensorStorage(n, ndim=2)}, ValueError, "needs flat steps"),
        ],
    )
    def test_bad_options(self, options, error, match):
        steps = make_steps(TRAJECTORIES)
        flat = options.get("storage") in (None, ListStorage, LazyStackStorage)

        def use():
            buffer = make_buffer(**options)
            buffer.extend(steps if flat else steps.reshape(2, 6))
            buffer.sample()

        with pytest.raises(error, match=match):
            use()

    def test_one_storage_for_each_sampler(self):
        """Where the trajectories of one end would pass for ends in the other."""
        buffer = make_buffer(batch_size=2)
        buffer.extend(make_steps(TRAJECTORIES))
        other = TensorDictReplayBuffer(storage=LazyTensorStorage(9), sampler=buffer.sampler)
        with pytest.raises(ValueError, match="serves one storage, and this one has another"):
            other.extend(make_steps(TRAJECTORIES[:1]))
        assert buffer.sample()["group"].shape[:2] == (1, 2)
        sampler, storage = buffer.sampler, weakref.ref(buffer.storage)
        del buffer, other
        gc.collect()
        assert storage() is None
        again = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=sampler)
        again.extend(make_steps(TRAJECTORIES))
        copied = pickle.loads(pickle.dumps(sampler))  # which has none yet
        fresh = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=copied)
        fresh.extend(make_steps(TRAJECTORIES))

    def test_writers_that_go_round_alone(self):
        buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(20),
            sampler=TrajectoryGroupSampler(group_size=2),
            writer=TensorDictMaxValueWriter(rank_key=("next", "reward")),
            batch_size=2,
        )
        with pytest.raises(TypeError, match="RoundRobinWriter, got TensorDictMaxValueWriter"):
            buffer.extend(make_steps(TRAJECTORIES))
