"""Trajectory groups: packing them to `[G, K, T]`, and drawing them from a replay buffer.

Shapes: `G` groups (problem instances), `K` trajectories of each, `T` steps of the longest one,
`N = G * K` trajectories, `S` steps of all trajectories together.
"""

from __future__ import annotations

import json
import weakref
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict import (
    LazyStackedTensorDict,
    NestedKey,
    TensorDict,
    TensorDictBase,
    is_leaf_nontensor,
    is_non_tensor,
)
from torch import Tensor
from torchrl.data.replay_buffers import ListStorage, RoundRobinWriter, Storage
from torchrl.data.replay_buffers.samplers import Sampler

from torchrl_ecpo._torchrl import buffers_of, generator_of
from torchrl_ecpo.checks import (
    check_flag,
    check_group_size,
    check_kind,
    check_mask,
    check_padding,
    present,
)

__all__ = ["TrajectoryGroupSampler", "pack_groups", "unpack_groups"]

MASK_KEY: NestedKey = ("collector", "mask")
TRAJECTORY_KEY: NestedKey = ("collector", "traj_ids")
DONE_KEY: NestedKey = ("next", "done")
GROUP_KEY: NestedKey = "group"
INIT_KEY: NestedKey = "is_init"


def pack_groups(
    data: TensorDictBase | Sequence[TensorDictBase],
    *,
    group_size: int | None = None,
    group_key: NestedKey = GROUP_KEY,
    traj_key: NestedKey = TRAJECTORY_KEY,
    done_key: NestedKey = DONE_KEY,
    mask_key: NestedKey = MASK_KEY,
) -> TensorDictBase:
    """Arrange complete groups of trajectories as `[G, K, T]` with a mask of the real steps.

    Groups, and the trajectories of a group, keep the order in which they first appear; shorter
    trajectories are padded with zeros at the end. Entries that are no tensors, such as texts,
    repeat their last step there.

    Args:
        data: one of

            - flat steps `[S]`, as ``Collector(trajs_per_batch=...)`` writes them to a buffer. A
              trajectory ends where `done_key` is set; `traj_key` tells trajectories apart whose
              steps are interleaved. One of the two must be there. Steps that `mask_key` marks as
              padding are left out.
            - trajectories of unequal length, one tensordict `[T]` each, in a list or a lazy stack:
              `traj_key` numbers them afterwards,
            - padded trajectories `[N, T]`, one to a row,
            - groups `[*G, K, T]`, which are checked and returned with their mask.

            Padded data may lack `mask_key`: all steps up to the first `done_key` are real then.
        group_size: `K`, at least 2. Default: the size of the largest group.
        group_key: the group of each step, integers of `data`'s shape.
        traj_key: the trajectory of each step, integers of `data`'s shape.
        done_key: the end of a trajectory, of `data`'s shape, with or without a trailing 1.
        mask_key: where the mask is, or is written.

    Raises:
        KeyError: if `group_key`, or all that marks the end of a trajectory, is missing.
        ValueError: if a group has not `K` trajectories, a trajectory has no end or two groups, a
            mask has holes, or `K` is below 2.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> steps = TensorDict(
        ...     {
        ...         "group": torch.tensor([7, 7, 7, 3, 3, 3]),
        ...         "next": {"done": torch.tensor([0, 1, 1, 1, 0, 1]).bool().unsqueeze(-1)},
        ...     },
        ...     [6],
        ... )
        >>> groups = pack_groups(steps, group_size=2)
        >>> groups.shape, groups["group"][:, 0, 0].tolist()
        (torch.Size([2, 2, 2]), [7, 3])
        >>> groups["collector", "mask"].sum(-1).tolist()
        [[2, 1], [1, 2]]
        >>> bool((unpack_groups(groups)["group"] == steps["group"]).all())
        True
    """
    if group_size is not None:
        check_group_size(group_size)
    data = _joined(data, traj_key, group_key)
    if data.ndim == 0:
        raise ValueError("pack_groups needs steps [S], trajectories [N, T] or groups [*G, K, T].")
    mask = data.get(mask_key, None)
    if mask is not None:
        mask = check_mask(mask_key, mask, data.shape)
    if data.ndim == 1 and mask is not None:
        data = unpack_groups(data, mask_key=mask_key)
    if not data.batch_size.numel():
        raise ValueError(f"pack_groups got no steps: data of shape {tuple(data.shape)}.")
    steps: Any = _read_steps(data, group_key, traj_key, done_key)
    order = None
    if data.ndim == 1:
        if "done" not in steps and "trajectory" not in steps:
            raise KeyError(
                f"Flat steps need {done_key!r} or {traj_key!r} to tell one trajectory from the "
                f"next; there are {present(data)}."
            )
        if "trajectory" in steps:
            order = steps["trajectory"].argsort(stable=True)
            order = order[steps["group"][order].argsort(stable=True)]
            steps = steps[order]
        first = _starts(steps)
        first[0] = True
        start = first.nonzero().squeeze(-1)
        length = torch.diff(start, append=start.new_tensor([len(first)]))
    else:
        if mask is None:
            mask = _mask_from_done(steps, traj_key)
        check_padding((mask_key,), mask)
        length = mask.sum(-1).reshape(-1)
        if not length.all():
            empty = int((length == 0).sum())
            raise ValueError(f"{empty} trajectories have no real step. Drop them, or their groups.")
        start = length.cumsum(0) - length
        steps = steps[mask]
    _check_whole(steps, start, length, done_key)
    group = steps["group"][start]
    if data.ndim > 2:
        assert mask is not None
        _check_groups(group.reshape(data.shape[:-1]), group_size)
        return data if mask_key in data.keys(True) else data.copy().set(mask_key, mask)
    if data.ndim == 2:
        data = unpack_groups(data.copy().set(mask_key, mask), mask_key=mask_key)
    if order is not None:
        by_appearance = order[start].argsort()
        start, length, group = (x[by_appearance] for x in (start, length, group))
    by_group, group_size = _sort_by_group(group, group_size)
    return _pad(data, order, start[by_group], length[by_group], group_size, mask_key)


def unpack_groups(data: TensorDictBase, *, mask_key: NestedKey = MASK_KEY) -> TensorDictBase:
    """Return the real steps of padded trajectories as a flat `[S]`: the inverse of `pack_groups`.

    Args:
        data: trajectories `[..., T]`; without `mask_key`, all of their steps are real.
        mask_key: the mask of the real steps, bool `[..., T]`. It is left out of the result.

    Raises:
        ValueError: if the mask is not boolean, or of another shape.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> mask = torch.tensor([[[True, True], [True, False]]])
        >>> groups = TensorDict({"x": torch.arange(4).view(1, 2, 2)}, [1, 2, 2])
        >>> unpack_groups(groups.set(("collector", "mask"), mask))["x"].tolist()
        [0, 1, 2]
    """
    mask = data.get(mask_key, None)
    if mask is None:
        return data.reshape(-1)
    real = check_mask(mask_key, mask, data.shape).reshape(-1).nonzero().squeeze(-1)
    if isinstance(data, LazyStackedTensorDict):
        data = data.contiguous()
    # A copy of the structure, from which empty entries go: what is nested in it is the caller's.
    return data.exclude(mask_key).copy().filter_empty_().reshape(-1)[real]


def _joined(data: Any, traj_key: NestedKey, group_key: NestedKey) -> TensorDictBase:
    """Several trajectories one after another, numbered; anything else as it is."""
    if isinstance(data, LazyStackedTensorDict) and -1 in data.batch_size:
        data = data.unbind(data.stack_dim)
    if isinstance(data, TensorDictBase):
        return data
    check_kind("data", data, TensorDictBase, list, tuple)
    if not data:
        raise ValueError("pack_groups got no trajectories.")
    rows: Any = []
    for number, row in enumerate(data):
        check_kind("a trajectory", row, TensorDictBase)
        if row.ndim != 1:
            raise ValueError(
                "Each of several trajectories must be a tensordict [T], got one of shape "
                f"{tuple(row.shape)}."
            )
        device = None if (group := row.get(group_key, None)) is None else group.device
        rows.append(row.copy().set(traj_key, torch.full(row.shape, number, device=device)))
    joined: Any = torch.cat(rows)
    return joined


def _read_steps(
    data: TensorDictBase, group_key: NestedKey, traj_key: NestedKey, done_key: NestedKey
) -> TensorDictBase:
    """What tells trajectories apart: "group", and "trajectory", "done", "is_init" where present."""
    if group_key not in data.keys(True):
        raise KeyError(
            f"The entry {group_key!r} is missing, the problem instance that each step belongs to; "
            f"there are {present(data)}. The environment writes it at reset: GroupedEnv adds it "
            "to any environment."
        )
    steps = TensorDict(batch_size=data.batch_size)
    keys = {"group": group_key, "trajectory": traj_key, "done": done_key, "is_init": INIT_KEY}
    for name, key in keys.items():
        value = data.get(key, None)
        if value is None:
            continue
        is_id = name in ("group", "trajectory")
        kind = "integers" if is_id else "flags, boolean or 0 and 1"
        if not isinstance(value, Tensor):
            raise TypeError(f"The entry {key!r} must hold {kind}, got {type(value).__name__}.")
        if value.shape not in (data.shape, (*data.shape, 1)):
            raise ValueError(
                f"The entry {key!r} must have the shape {tuple(data.shape)} of the steps, with or "
                f"without a trailing 1, got {tuple(value.shape)}."
            )
        dtype = value.dtype
        if is_id:
            is_wrong = dtype.is_floating_point or dtype.is_complex or dtype == torch.bool
        else:
            is_wrong = dtype.is_complex or ((value != 0) & (value != 1)).any()
        if is_wrong:
            raise ValueError(f"The entry {key!r} must hold {kind}, got {dtype}.")
        steps[name] = value.reshape(data.shape).to(torch.int64 if is_id else torch.bool)
    return steps


def _starts(steps: TensorDictBase) -> Tensor:
    """Mark the steps `[S]` that do not go on with the trajectory of the step before them.

    Before the first step is the last one, as in a ring.
    """
    starts = torch.zeros(steps.batch_size, dtype=torch.bool, device=steps["group"].device)
    for name in ("group", "trajectory"):
        if name in steps:
            ids = steps[name]
            starts[1:] |= ids[1:] != ids[:-1]
            starts[0] |= ids[0] != ids[-1]
    if "done" in steps:
        starts |= steps["done"].roll(1)
    return starts | steps["is_init"] if "is_init" in steps else starts


def _mask_from_done(steps: TensorDictBase, traj_key: NestedKey) -> Tensor:
    """The steps `[..., T]` of a row up to its first end; what follows must be padding."""
    if "done" not in steps:
        return torch.ones_like(steps["group"], dtype=torch.bool)
    done = steps["done"]
    mask = done.cumsum(-1) - done.long() == 0
    second = steps.get("is_init", torch.zeros_like(done))
    second = second & ~(done & done[..., :1])  # what repeats a single step, which begins and ends
    if "trajectory" in steps:
        # Padding has the trajectory's own id, or 0.
        ids = steps["trajectory"]
        second = second | ((ids != ids[..., :1]) & (done | (ids != 0)))
    if (second & ~mask).any():
        raise ValueError(
            f"Rows hold several trajectories ({traj_key!r} changes after the end of one, or "
            f"{INIT_KEY!r} is set): pass the steps flat, data.reshape(-1)."
        )
    return mask


def _check_whole(steps: TensorDictBase, start: Tensor, length: Tensor, done_key: NestedKey) -> None:
    """Refuse trajectories of several groups, and those that are not one whole trajectory each."""
    group = steps["group"]
    owner = torch.arange(len(start), device=start.device).repeat_interleave(length)
    none = torch.zeros_like(group, dtype=torch.bool)
    first, last = none.index_fill(0, start, True), none.index_fill(0, start + length - 1, True)
    faults = {"change their group on the way": group != group[start][owner]}
    if "done" in steps:
        faults[f"have no end ({done_key!r} at their last real step)"] = last & ~steps["done"]
        faults[f"go on after their end ({done_key!r})"] = steps["done"] & ~last
    if "is_init" in steps:
        faults[f"have no beginning ({INIT_KEY!r})"] = first & ~steps["is_init"]
        faults[f"begin again on the way ({INIT_KEY!r})"] = steps["is_init"] & ~first
    for fault, where in faults.items():
        if where.any():
            faulty = owner[where].unique()
            raise ValueError(
                f"{len(faulty)} trajectories {fault}, the first one in group "
                f"{int(group[start[faulty[0]]])}. Collect whole ones, "
                "Collector(trajs_per_batch=...), and limit their length, "
                "StepCounter(max_steps=...)."
            )


def _check_groups(group: Tensor, group_size: int | None) -> None:
    """Refuse rows `[*G, K]` of several groups, and of another size."""
    size = group.shape[-1]
    check_group_size(size)
    if group_size is not None and size != group_size:
        raise ValueError(f"Groups of {size} trajectories, expected group_size={group_size}.")
    mixed = (group != group[..., :1]).any(-1)
    if mixed.any():
        members = group[mixed][0].unique().tolist()
        raise ValueError(f"Trajectories of different groups share a row: groups {members}.")


def _sort_by_group(group: Tensor, group_size: int | None) -> tuple[Tensor, int]:
    """Return the order `[N]` of trajectories by the first appearance of their group, and `K`."""
    ids, member_of, count = group.unique(return_inverse=True, return_counts=True)
    size = int(count.max()) if group_size is None else group_size
    check_group_size(size)
    wrong = count != size
    if wrong.any():
        raise ValueError(
            f"Group {int(ids[wrong][0])} has {int(count[wrong][0])} trajectories, expected {size}"
            f" ({int(wrong.sum())} of {len(ids)} groups are of the wrong size)."
        )
    position = torch.arange(group.numel(), device=group.device)
    first = torch.full_like(ids, group.numel()).scatter_reduce(0, member_of, position, "amin")
    return first[member_of].argsort(stable=True), size


def _pad(
    steps: TensorDictBase,
    order: Tensor | None,
    start: Tensor,
    length: Tensor,
    group_size: int,
    mask_key: NestedKey,
) -> TensorDictBase:
    """Lay out trajectories `[N]`, runs in `order` of the `steps` `[S]`, as `[G, K, T]`."""
    shape = torch.Size([start.numel() // group_size, group_size, int(length.max())])
    time = torch.arange(shape[-1], device=start.device)
    mask = (time < length.unsqueeze(-1)).reshape(-1)
    source = (start.unsqueeze(-1) + time.minimum(length.unsqueeze(-1) - 1)).reshape(-1)
    source = source if order is None else order[source]

    def place(value: Any) -> Any:
        placed = value[source]
        if not is_non_tensor(value):
            placed[~mask] = 0
        return placed.reshape(*shape, *placed.shape[1:])

    padded = steps.apply(place, batch_size=shape, is_leaf=is_leaf_nontensor)
    assert padded is not None
    return padded.set(mask_key, mask.view(shape))


class _KeepReplacement(type(Sampler)):
    """Leaves `replacement` to the constructor; TorchRL's own metaclass would swap the class."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        return type.__call__(cls, *args, **kwargs)


class _Whole(NamedTuple):
    """The whole trajectories of a storage `[N]`, group by group, and its complete groups `[R]`."""

    start: Tensor
    length: Tensor
    group: Tensor  # [R]: the id, the first trajectory and the number of trajectories of each
    first: Tensor
    count: Tensor
    waiting: int  # groups with fewer than K
    torn: int  # trajectories without beginning or end
    num_slots: int


_NONE = torch.zeros(0, dtype=torch.long)
_NOTHING = _Whole(_NONE, _NONE, _NONE, _NONE, _NONE, waiting=0, torn=0, num_slots=0)


class TrajectoryGroupSampler(Sampler, metaclass=_KeepReplacement):
    """Draws complete groups of whole trajectories from a flat replay buffer, as `[G, K, T]`.

    A batch has `G` = batch size / `K` distinct groups, uniformly drawn, and `K` distinct
    trajectories of each. Groups with fewer than `K` trajectories wait; of larger ones `K` are
    drawn. Group ids must be unique within the storage: trajectories that share one are drawn as one
    group.

    The storage holds steps, trajectory after trajectory, as
    ``Collector(trajs_per_batch=..., replay_buffer=...)`` and
    :class:`~torchrl_ecpo.collectors.TrajectoryGroupCollector` write them. A trajectory is drawn if
    its beginning and its end are there. The end is `done_key`. The beginning is ``"is_init"``,
    where that is recorded; otherwise it follows the end of another one, unless that has been
    written over what came before it. If trajectories were written in pieces between each other,
    which `traj_key` tells, only ``"is_init"`` counts.

    ``TensorDictReplayBuffer.sample()`` returns `[G, K, T]` with ``("collector", "mask")``; padded
    steps repeat the last real one. A plain ``ReplayBuffer`` puts the mask in the ``info`` of
    ``sample(return_info=True)`` and not in the data: give it ``transform=pack_groups``, which
    writes it.

    The first draw after a write, of this process or another, reads the ids and ends of the whole
    storage; further ones cost the same whatever its size. After an edit in place of these entries,
    call ``buffer.mark_update(index)``.

    Args:
        group_size: `K`, the number of trajectories drawn from a group, at least 2.
        replacement: if True (default), each batch is drawn from all complete groups. If False, no
            group is drawn twice in a pass; a pass ends, and ``ran_out`` is set, when fewer than
            `G` groups are left. Groups that are completed on the way join it.
        group_key: the group of each step, integers of shape `[S]`.
        traj_key: the trajectory of each step, integers of shape `[S]`; may be missing.
        done_key: the end of a trajectory.

    .. note:: The buffer's ``batch_size`` counts trajectories: `G * K`. (TorchRL's ``SliceSampler``
       counts steps, its ``PromptGroupSampler`` rows.) ``ReplayBufferEnsemble``, which counts rows,
       cannot draw groups: draw from each of its buffers.

    Raises:
        ValueError: if `group_size` is below 2, the batch size is not `G * K`, the storage or what
            is written has more than one dimension, or the steps written hold padding.
        TypeError: if the storage does not hold a tensordict, or is not written round and round.
        KeyError: when data without `group_key` or `done_key` is written.
        RuntimeError: at a draw, if there are fewer than `G` complete groups, or a storage that
            is not full was written over.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(100),
        ...     sampler=TrajectoryGroupSampler(group_size=2),
        ...     batch_size=2,
        ... )
        >>> done = torch.tensor([0, 1, 1, 0, 0, 1]).bool().unsqueeze(-1)
        >>> group = torch.tensor([7, 7, 7, 3, 3, 3])
        >>> _ = buffer.extend(TensorDict({"group": group, "next": {"done": done}}, [6]))
        >>> sample = buffer.sample()  # group 3 has only one trajectory
        >>> sample.shape, sample["group"].unique().tolist()
        (torch.Size([1, 2, 2]), [7])
        >>> sample["collector", "mask"].sum().item()
        3
    """

    ran_out: bool = False  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]
    """Whether the last draw ended a pass. Always False with replacement."""

    def __init__(
        self,
        *,
        group_size: int,
        replacement: bool = True,
        group_key: NestedKey = GROUP_KEY,
        traj_key: NestedKey = TRAJECTORY_KEY,
        done_key: NestedKey = DONE_KEY,
    ) -> None:
        """Make the sampler; the class describes the arguments."""
        self.group_size = check_group_size(group_size)
        self.replacement = check_flag("replacement", replacement)
        self.group_key, self.traj_key, self.done_key = group_key, traj_key, done_key
        self._empty()

    def _empty(self) -> None:
        self.ran_out = False
        self._drawn: list[int] = []  # the groups of this pass
        # After how many steps written the newest trajectory had ended, for the oldest step's sake.
        self._ends, self._seen = deque([0]), 0
        self._storage: Any = None  # a reference to the one that `_ends` is about
        self._state: Any = None  # of the storage, when this was found in it:
        self._whole: Any = None

    # What is whole

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Look at the steps at `index` again: the writer calls this, you after an edit in place."""
        assert storage is not None, "the buffer passes its storage"
        self._attach(storage)
        size, self._state = storage.max_size, None
        index = torch.as_tensor(index).reshape(-1)[-size:].cpu()
        done = self._read(storage, index)["done"]
        for cursor, written, is_own in self._writers(storage):
            newest = torch.arange(cursor - len(index), cursor) % size
            if is_own and written > self._seen and torch.equal(index, newest):
                self._ends.extend((written - len(index) + 1 + done.nonzero()).flatten().tolist())
                self._seen = written
                while self._ends and self._ends[0] < written - size:
                    self._ends.popleft()

    def _attach(self, storage: Storage) -> None:
        """Refuse a second storage: the ends of one say nothing of the other."""
        known = None if self._storage is None else self._storage()
        if known is storage:
            return
        if known is not None:
            raise ValueError(
                f"A {type(self).__name__} serves one storage, and this one has another: make one "
                "for each buffer."
            )
        if self._storage is not None:  # which is gone
            self._empty()
        self._storage = weakref.ref(storage)

    def _writers(self, storage: Storage) -> list[tuple[int, int, bool]]:
        """Return of each that has written: the next slot, the number of steps, whether ours."""
        writers = []
        for buffer in buffers_of(storage):
            if not isinstance(buffer.writer, RoundRobinWriter):
                raise TypeError(
                    f"{type(self).__name__} needs a RoundRobinWriter, got "
                    f"{type(buffer.writer).__name__}."
                )
            state = buffer.writer.state_dict()
            writers.append((state["_cursor"], state["_write_count"], buffer.sampler is self))
        return [writer for writer in writers if writer[1]]

    def _read(self, storage: Storage, index: Tensor | slice) -> TensorDictBase:
        data = storage[:]
        if isinstance(storage, ListStorage) or not isinstance(data, TensorDictBase):
            raise TypeError(
                f"{type(self).__name__} needs a storage that holds a tensordict, such as "
                f"LazyTensorStorage or LazyMemmapStorage, got {type(storage).__name__}."
            )
        if data.ndim != 1:
            raise ValueError(
                f"{type(self).__name__} needs flat steps [S], got data of shape "
                f"{tuple(data.shape)}. Write buffer.extend(unpack_groups(data))."
            )
        keys = (self.group_key, self.traj_key, self.done_key, INIT_KEY, MASK_KEY)
        data = data.select(*keys, strict=False)[index].cpu()
        if not data.get(MASK_KEY, torch.ones(())).all():
            raise ValueError(
                f"The steps hold padding ({MASK_KEY!r} is False), which would be taken for steps "
                "of trajectories. Write buffer.extend(unpack_groups(data))."
            )
        if self.done_key not in data.keys(True):
            raise KeyError(
                f"The entry {self.done_key!r} is missing, where a trajectory ends; there are "
                f"{present(storage[:])}."
            )
        return _read_steps(data, self.group_key, self.traj_key, self.done_key)

    def _find(self, storage: Storage) -> _Whole:
        self._attach(storage)
        filled, writers = len(storage), self._writers(storage)  # pyright: ignore[reportArgumentType]
        state = (filled, writers)
        if state != self._state:
            self._whole = self._scan(storage, filled, writers) if filled else _NOTHING
            self._state = state
        return self._whole

    def _scan(self, storage: Storage, filled: int, writers: list[tuple[int, int, bool]]) -> _Whole:
        steps, size = self._read(storage, slice(None)), storage.max_size
        starts, begins = _starts(steps), steps["done"].roll(1)
        for cursor, written, is_own in writers or [(0, 0, False)]:
            if written and cursor < filled < size:
                # A storage counts what is written over as new, up to memory that nobody wrote.
                raise RuntimeError(
                    f"The storage counts {filled} steps, but a buffer around it went on writing at "
                    f"slot {cursor - written}, over the steps of another: the rest may never have "
                    "been written. Restore the writer with the storage (load_state_dict, loads), "
                    "or extend a new buffer with the old steps."
                )
            if written <= size or filled < size:
                starts[0] = begins[0] = True  # no trajectory goes round
            if written and cursor < filled:
                # The oldest step; what came before it is no longer there.
                starts[cursor] = True
                begins[cursor] = written - size in (self._ends if is_own else (0,))
        start = starts.nonzero().squeeze(-1)
        length = torch.diff(start, append=start[:1] + filled)
        end = (start + length - 1) % filled
        ended = steps["done"][end]
        if "is_init" in steps:
            begins = steps["is_init"]
        else:
            newest = torch.tensor([(cursor - 1) % size for cursor, _, _ in writers])
            cut = start[~ended][torch.isin(end[~ended], newest, invert=True)]
            if _in_pieces(steps, start, cut):
                begins = torch.zeros_like(begins)
        whole = (ended & begins[start]).nonzero().squeeze(-1)
        group = steps["group"][start[whole]]
        order = group.argsort(stable=True)
        group, count = group[order].unique_consecutive(return_counts=True)
        first, complete = count.cumsum(0) - count, count >= self.group_size
        return _Whole(
            start[whole][order],
            length[whole][order],
            *(entry[complete] for entry in (group, first, count)),
            waiting=int((~complete).sum()),
            torn=len(start) - len(whole),
            num_slots=filled,
        )

    # Drawing

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Draw a batch: the slots of its steps `[G, K, T]`, and the mask in the info.

        Args:
            storage: the buffer's storage.
            batch_size: the number of trajectories, `G * K`.
        """
        num_groups, whole = self._num_groups(batch_size), self._find(storage)
        left = self._left(whole)
        if len(left) < num_groups:
            raise RuntimeError(
                f"Cannot draw {num_groups} group(s) of {self.group_size} trajectories: the storage "
                f"holds {len(whole.group)} complete group(s), {len(whole.group) - len(left)} of "
                f"them drawn in this pass, and {whole.waiting} with fewer than {self.group_size} "
                f"whole trajectories, which wait. {whole.torn} trajectories have no end "
                f"({self.done_key!r}) or no beginning: collect whole ones, "
                "Collector(trajs_per_batch=...), and limit their length, "
                "StepCounter(max_steps=...). Collect more, or ask for less."
            )
        groups = left[self._shuffle(len(left))[:num_groups]]
        members = torch.stack(
            [
                first + self._shuffle(count)[: self.group_size]
                for first, count in zip(
                    whole.first[groups].tolist(), whole.count[groups].tolist(), strict=True
                )
            ]
        )
        if not self.replacement:
            rest = len(left) - num_groups
            self.ran_out = rest < num_groups
            self._drawn = [] if self.ran_out else self._drawn + whole.group[groups].tolist()
            self._remaining_batches = rest // num_groups  # more are not to be prefetched
        start, length = whole.start[members].unsqueeze(-1), whole.length[members].unsqueeze(-1)
        time = torch.arange(int(length.max()))
        return (start + time.minimum(length - 1)) % whole.num_slots, {MASK_KEY: time < length}

    def can_sample(self, storage: Storage, batch_size: int) -> bool:
        """Whether a batch of `batch_size` trajectories can be drawn."""
        return len(self._left(self._find(storage))) >= self._num_groups(batch_size)

    def _left(self, whole: _Whole) -> Tensor:
        """The complete groups that this pass has not drawn yet, as positions among all."""
        drawn = torch.tensor(self._drawn, dtype=torch.long)
        return torch.isin(whole.group, drawn, invert=True).nonzero().squeeze(-1)

    def _shuffle(self, number: int) -> Tensor:
        generator = generator_of(self)
        device = None if generator is None else generator.device
        return torch.randperm(number, generator=generator, device=device).cpu()

    def _num_groups(self, batch_size: int) -> int:
        num_groups, rest = divmod(batch_size, self.group_size)
        if rest or not num_groups:
            raise ValueError(
                f"The batch size counts trajectories, num_groups * group_size={self.group_size}, "
                f"got {batch_size}."
            )
        return num_groups

    # Saving

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the pass: a restored sampler draws the same batches."""
        return {
            "group_size": self.group_size,
            "drawn": list(self._drawn),
            "ends": list(self._ends),
            "seen": self._seen,
            "ran_out": self.ran_out,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if it is that of a sampler of groups of another size.
        """
        if state_dict["group_size"] != self.group_size:
            raise ValueError(
                f"The state is that of a sampler with group_size={state_dict['group_size']}, this "
                f"one has group_size={self.group_size}."
            )
        self._drawn, self._ends = list(state_dict["drawn"]), deque(state_dict["ends"])
        self._seen, self.ran_out = state_dict["seen"], state_dict["ran_out"]
        self._state = None

    def dumps(self, path: str | Path) -> None:
        """Write the state to the folder `path`."""
        Path(path).mkdir(exist_ok=True, parents=True)
        (Path(path) / "trajectory_groups.json").write_text(json.dumps(self.state_dict()))

    def loads(self, path: str | Path) -> None:
        """Read the state from the folder `path`."""
        self.load_state_dict(json.loads((Path(path) / "trajectory_groups.json").read_text()))

    def __getstate__(self) -> dict[str, Any]:
        """Leave behind what the storage tells: a copy looks at its own."""
        return {**super().__getstate__(), "_storage": None, "_state": None, "_whole": None}


def _in_pieces(steps: TensorDictBase, start: Tensor, cut: Tensor) -> bool:
    """Whether a run of steps that was cut, known by its first step, goes on in another run."""
    if "trajectory" not in steps or not len(cut):
        return False
    ids = steps["trajectory"]
    suspects = start[torch.isin(ids[start], ids[cut])]
    names = torch.stack([steps["group"][suspects], ids[suspects]])
    return names.unique(dim=1).shape[1] < len(suspects)
