"""Trajectory groups: packing them to `[G, K, T]`, and drawing them from a replay buffer.

Shapes: `G` groups (problem instances), `K` trajectories of each, `T` steps of the longest one,
`N = G * K` trajectories, `S` steps of all trajectories together.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, is_leaf_nontensor, is_non_tensor
from torch import Tensor
from torchrl.data.replay_buffers import RoundRobinWriter, Storage, TensorStorage
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.samplers.base import _SamplerMeta

__all__ = ["TrajectoryGroupSampler", "pack_groups", "unpack_groups"]

MASK_KEY: NestedKey = ("collector", "mask")
TRAJECTORY_KEY: NestedKey = ("collector", "traj_ids")
DONE_KEY: NestedKey = ("next", "done")
GROUP_KEY: NestedKey = "group"


def pack_groups(
    data: TensorDictBase,
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
    _check_group_size(group_size)
    mask = data.get(mask_key, None)
    if data.ndim == 1 and mask is not None and not mask.all():
        data = unpack_groups(data, mask_key=mask_key)
    group = _integer_entry(data, group_key, "pack_groups")
    if data.ndim == 0:
        raise ValueError("pack_groups needs steps [S], trajectories [N, T] or groups [*G, K, T].")
    if data.ndim > 1:
        if mask is None:
            mask = _mask_from_done(data, done_key, traj_key)
        _check_padded(mask, group, data.shape)
        _check_ends(data, mask, done_key)
        if data.ndim > 2:
            _check_groups(group, mask, data.shape[-2], group_size)
            return data if mask_key in data.keys(True) else data.copy().set(mask_key, mask)
        steps = unpack_groups(data.copy().set(mask_key, mask), mask_key=mask_key)
        length = mask.sum(-1)
        start = length.cumsum(0) - length
        group, order = group[:, 0], None
    else:
        order, start, length = _find_trajectories(data, group, traj_key, done_key)
        steps = data.exclude(mask_key)
        group = group[start if order is None else order[start]]
        if order is not None:
            by_appearance = order[start].argsort()
            start, length = start[by_appearance], length[by_appearance]
            group = group[by_appearance]
    by_group, group_size = _sort_by_group(group, group_size)
    return _pad(steps, order, start[by_group], length[by_group], group_size, mask_key)


def unpack_groups(data: TensorDictBase, *, mask_key: NestedKey = MASK_KEY) -> TensorDictBase:
    """Return the real steps of padded trajectories as a flat `[S]`: the inverse of `pack_groups`.

    Args:
        data: trajectories `[..., T]`; without `mask_key`, all of their steps are real.
        mask_key: the mask of the real steps, bool `[..., T]`. It is left out of the result.

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
    real = mask.reshape(-1).nonzero().squeeze(-1)
    # A copy of the structure, from which empty entries go: what is nested in it is the caller's.
    return data.exclude(mask_key).copy().filter_empty_().reshape(-1)[real]


def _check_group_size(group_size: int | None) -> None:
    if group_size is not None and group_size < 2:
        raise ValueError(
            f"group_size must be at least 2, got {group_size}: the lift weighs the trajectories of "
            "a group against each other."
        )


def _names(data: TensorDictBase) -> str:
    keys = data.keys(True, True)
    return ", ".join(sorted(key if isinstance(key, str) else "/".join(key) for key in keys))


def _integer_entry(data: TensorDictBase, key: NestedKey, reader: str) -> Tensor:
    value = data.get(key, None)
    if value is None:
        raise KeyError(
            f"{reader} needs the entry {key!r}, the problem instance that each step belongs to; "
            f"found {_names(data)}. The environment writes it at reset: "
            "GroupedEnv adds it to any environment."
        )
    if value.shape != data.shape or value.is_floating_point() or value.dtype == torch.bool:
        raise ValueError(
            f"The entry {key!r} must hold integers of shape {tuple(data.shape)}, got "
            f"{value.dtype} of shape {tuple(value.shape)}."
        )
    return value


def _per_step(data: TensorDictBase, key: NestedKey) -> Tensor | None:
    """An entry of one number a step, with or without a trailing dimension of 1."""
    value = data.get(key, None)
    return None if value is None else value.reshape(data.shape)


def _mask_from_done(data: TensorDictBase, done_key: NestedKey, traj_key: NestedKey) -> Tensor:
    done, trajectory = _per_step(data, done_key), _per_step(data, traj_key)
    if done is None:
        return torch.ones(data.shape, dtype=torch.bool, device=data.device)
    mask = (done.cumsum(-1) - done.long()) == 0
    if trajectory is not None:
        # Padding has the trajectory's own id, or 0.
        other = ~mask & (trajectory != trajectory[..., :1]) & (done | (trajectory != 0))
        if other.any():
            raise ValueError(
                f"Rows of the {data.ndim}-dimensional data hold several trajectories ({traj_key!r} "
                "changes after the end of one): pass the steps flat, data.reshape(-1)."
            )
    return mask


def _check_padded(mask: Tensor, group: Tensor, shape: torch.Size) -> None:
    if mask.shape != shape:
        raise ValueError(f"The mask must have the shape {tuple(shape)}, got {tuple(mask.shape)}.")
    if mask.dtype != torch.bool:
        raise ValueError(f"The mask must be boolean (True: the step is real), got {mask.dtype}.")
    if not mask.numel():
        raise ValueError(f"pack_groups got no steps: data of shape {tuple(shape)}.")
    if not mask.any(-1).all():
        empty = int((~mask.any(-1)).sum())
        raise ValueError(f"{empty} trajectories have no real step. Drop them, or their groups.")
    if (mask[..., 1:] & ~mask[..., :-1]).any():
        raise ValueError("The mask has holes: trajectories are padded at their end, nowhere else.")
    mixed = (mask & (group != group[..., :1])).any(-1)
    if mixed.any():
        raise ValueError(
            f"{int(mixed.sum())} trajectories change their group on the way, the first one from "
            f"group {int(group[mixed][0, 0])}."
        )


def _check_ends(data: TensorDictBase, mask: Tensor, done_key: NestedKey) -> None:
    """Refuse rows that were cut, as at the end of a batch: their return is not all of it."""
    done = _per_step(data, done_key)
    if done is None:
        return
    last = (mask.sum(-1, keepdim=True) - 1).clamp_min(0)
    endless = ~done.gather(-1, last)
    if endless.any():
        raise ValueError(
            f"{int(endless.sum())} trajectories have no end ({done_key!r} at their last real step)."
        )


def _check_groups(group: Tensor, mask: Tensor, size: int, group_size: int | None) -> None:
    _check_group_size(size)
    if group_size is not None and size != group_size:
        raise ValueError(f"Groups of {size} trajectories, expected group_size={group_size}.")
    first = group[..., :1, :1]
    mixed = (mask & (group != first)).flatten(-2).any(-1)
    if mixed.any():
        members = group[mixed][0, :, 0]
        raise ValueError(
            f"Trajectories of different groups share a row: groups {members.unique().tolist()}."
        )


def _find_trajectories(
    data: TensorDictBase, group: Tensor, traj_key: NestedKey, done_key: NestedKey
) -> tuple[Tensor | None, Tensor, Tensor]:
    """Return the order that makes trajectories contiguous (None: as is), starts, lengths `[N]`."""
    done, trajectory = _per_step(data, done_key), _per_step(data, traj_key)
    if not group.numel():
        raise ValueError("pack_groups got no steps.")
    if done is None and trajectory is None:
        raise KeyError(
            f"Flat steps need {done_key!r} or {traj_key!r} to tell one trajectory from the next; "
            f"found {_names(data)}."
        )
    order = None
    if trajectory is not None:
        order = trajectory.argsort(stable=True)
        order = order[group[order].argsort(stable=True)]
        trajectory, group = trajectory[order], group[order]
        done = None if done is None else done[order]
    starts = _run_starts(group, trajectory, done)
    start = starts.nonzero().squeeze(-1)
    length = torch.diff(start, append=start.new_tensor([group.numel()]))
    if done is not None:
        unfinished = ~done[start + length - 1]
        if unfinished.any():
            raise ValueError(
                f"{int(unfinished.sum())} trajectories have no end, the first one in group "
                f"{int(group[start[unfinished][0]])}: its last step has no {done_key!r}. Collect "
                "whole trajectories, Collector(trajs_per_batch=...), and limit their length, "
                "StepCounter(max_steps=...)."
            )
    return order, start, length


def _run_starts(group: Tensor, trajectory: Tensor | None, done: Tensor | None) -> Tensor:
    """Mark the steps `[S]` at which another trajectory starts, given contiguous trajectories."""
    changes = group[1:] != group[:-1]
    if trajectory is not None:
        changes = changes | (trajectory[1:] != trajectory[:-1])
    if done is not None:
        changes = changes | done[:-1]
    return torch.cat([changes.new_ones(1), changes])


def _sort_by_group(group: Tensor, group_size: int | None) -> tuple[Tensor, int]:
    """Return the order `[N]` of trajectories by the first appearance of their group, and `K`."""
    ids, member_of, count = group.unique(return_inverse=True, return_counts=True)
    size = int(count.max()) if group_size is None else group_size
    _check_group_size(size)
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
    mask = time < length.unsqueeze(-1)
    real_or_last = start.unsqueeze(-1) + time.minimum(length.unsqueeze(-1) - 1)
    real_or_last = real_or_last if order is None else order[real_or_last]
    source, target = real_or_last[mask], mask.reshape(-1).nonzero().squeeze(-1)

    def place(value: Any) -> Any:
        if is_non_tensor(value):
            return value[real_or_last.reshape(-1)].reshape(shape)
        padded = value.new_zeros(mask.numel(), *value.shape[1:])
        return padded.index_copy_(0, target, value[source]).view(*shape, *value.shape[1:])

    padded = steps.apply(place, batch_size=shape, is_leaf=is_leaf_nontensor)
    assert padded is not None
    return padded.set(mask_key, mask.view(shape))


class _Pool:
    """A set of integers that adds, removes and draws in constant time for each item."""

    def __init__(self, items: Iterable[int] = ()) -> None:
        self.items: list[int] = []
        self._position: dict[int, int] = {}
        for item in items:
            self.add(item)

    def __len__(self) -> int:
        return len(self.items)

    def __contains__(self, item: int) -> bool:
        return item in self._position

    def add(self, item: int) -> None:
        self._position[item] = len(self.items)
        self.items.append(item)

    def remove(self, item: int) -> None:
        position, last = self._position.pop(item), self.items.pop()
        if last != item:
            self.items[position] = last
            self._position[last] = position

    def draw(self, uniforms: Sequence[float]) -> list[int]:
        """Draw distinct items, one for each number in [0, 1), by a partial Fisher-Yates shuffle."""
        items, size = self.items, len(self.items)
        for i, uniform in enumerate(uniforms):
            j = min(i + int(uniform * (size - i)), size - 1)
            items[i], items[j] = items[j], items[i]
            self._position[items[i]], self._position[items[j]] = i, j
        return items[: len(uniforms)]


class _KeepReplacement(_SamplerMeta):
    """Leaves `replacement` to the constructor; TorchRL's own metaclass would swap the class."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        return type.__call__(cls, *args, **kwargs)


class TrajectoryGroupSampler(Sampler, metaclass=_KeepReplacement):
    """Draws complete groups of whole trajectories from a flat replay buffer, as `[G, K, T]`.

    The storage holds steps, trajectory after trajectory, as
    ``Collector(trajs_per_batch=..., replay_buffer=...)`` and
    :class:`~torchrl_ecpo.collectors.TrajectoryGroupCollector` write them. A batch has `G` distinct
    groups, uniformly drawn, and `K` distinct trajectories of each. Groups with fewer than `K`
    trajectories wait; of larger ones `K` are drawn. A trajectory that has not ended, or that the
    writer has begun to overwrite, is never returned. A group needs a number of its own for as long
    as it is in the storage: trajectories that share one are drawn as one group.

    ``TensorDictReplayBuffer.sample()`` returns `[G, K, T]` with ``("collector", "mask")``; padded
    steps repeat the last real one. A plain ``ReplayBuffer`` puts the mask in the ``info`` of
    ``sample(return_info=True)`` and not in the data: give it ``transform=pack_groups``, which
    writes it.

    The index follows every write of this process, at a cost proportional to what is written, and
    catches up with the writes of other processes at the next draw; a draw costs the same whatever
    the size of the storage. It takes 24 bytes for each slot of the storage. After an edit in place
    of group, trajectory or done entries, call ``buffer.mark_update(index)`` with at least one step
    of each edited trajectory. One that was not whole before stays so.

    Args:
        group_size: `K`, the number of trajectories drawn from a group, at least 2.
        num_groups: `G`. Default: batch size / `K`.
        replacement: if True (default), each batch is drawn from all complete groups. If False, no
            group is drawn twice in a pass; a pass ends, and ``ran_out`` is set, when fewer than
            `G` groups are left. Groups that are completed on the way join it.
        group_key: the group of each step, integers of shape `[S]`.
        traj_key: the trajectory of each step, integers of shape `[S]`; may be missing.
        done_key: the end of a trajectory.

    .. note:: The buffer's ``batch_size`` counts trajectories: `G * K`. (TorchRL's ``SliceSampler``
       counts steps, its ``PromptGroupSampler`` rows.)

    Raises:
        ValueError: if `group_size` is below 2, the batch size is not `G * K`, the storage or what
            is written has more than one dimension, or the steps written hold padding.
        TypeError: if the storage does not hold a tensordict.
        KeyError: when data without `group_key` or `done_key` is written.
        RuntimeError: at a draw, if there are fewer than `G` complete groups.

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

    def __init__(
        self,
        *,
        group_size: int,
        num_groups: int | None = None,
        replacement: bool = True,
        group_key: NestedKey = GROUP_KEY,
        traj_key: NestedKey = TRAJECTORY_KEY,
        done_key: NestedKey = DONE_KEY,
    ) -> None:
        """Make the sampler; the class describes the arguments."""
        _check_group_size(group_size)
        if num_groups is not None and num_groups < 1:
            raise ValueError(f"num_groups must be at least 1, got {num_groups}.")
        self.group_size = group_size
        self.num_groups = num_groups
        self.replacement = replacement
        self.group_key = group_key
        self.traj_key = traj_key
        self.done_key = done_key
        self._ran_out = False
        self._empty()

    def _empty(self) -> None:
        self._allocate(0)
        self._members: dict[int, _Pool] = {}  # group -> its trajectories
        self._ready, self._drawn = _Pool(), _Pool()  # the complete groups
        # The trajectory that is being written: (start, length, group, trajectory id).
        self._tail: tuple[int, int, int, int | None] | None = None
        self._unfinished = 0
        self._seen: int | None = None  # the writer's count of steps that the index accounts for

    def _allocate(self, size: int) -> None:
        # A trajectory is known by the slot of its first step, where its length and group are.
        self._length = torch.zeros(size, dtype=torch.long)
        self._group = torch.zeros(size, dtype=torch.long)
        self._owner = torch.full((size,), -1, dtype=torch.long)  # the slot's trajectory, or -1

    # Writing

    def mark_update(self, index: int | Tensor, *, storage: Storage | None = None) -> None:
        """Index the steps written at `index`: the buffer's writer calls this on every write."""
        assert storage is not None, "the buffer passes its storage"
        storage, writer = self._parts(storage)
        index = torch.as_tensor(index, dtype=torch.long).reshape(-1).cpu()
        written = writer._write_count
        if written == self._seen:
            self._edit(storage, index)
            return
        if self._seen is None:
            if len(storage) > index.numel():
                return  # the storage was not empty: the first draw indexes all of it
        elif written - self._seen != index.numel():
            return  # another process has written too: the next draw indexes both
        if index.numel():
            self._index(storage, index)
        self._seen = written

    def _edit(self, storage: TensorStorage, index: Tensor) -> None:
        """Index anew the trajectories that a change in place concerns, whole and in order.

        What was none stays none.
        """
        edited = self._owner[index].unique()
        edited = edited[edited >= 0]
        index, _ = self._slots(edited, self._length[edited])
        if index.numel():
            tail, self._tail = self._tail, None  # whatever is being written goes on after it
            self._index(storage, index)
            self._tail = tail

    def _parts(self, storage: Storage) -> tuple[TensorStorage, RoundRobinWriter]:
        """Return the storage and its writer, if they are of the kind that can be followed."""
        buffers = (buffer for buffer in storage._attached_entities if buffer.sampler is self)
        writer = next((buffer.writer for buffer in buffers), None)
        if writer is None:
            raise RuntimeError(
                f"{type(self).__name__} works for the replay buffer that it was given to, "
                "ReplayBuffer(sampler=...)."
            )
        if not isinstance(storage, TensorStorage) or not isinstance(writer, RoundRobinWriter):
            raise TypeError(
                f"{type(self).__name__} needs a storage that holds a tensordict, such as "
                "LazyTensorStorage or LazyMemmapStorage, and a RoundRobinWriter, got "
                f"{type(storage).__name__} and {type(writer).__name__}."
            )
        if storage.ndim != 1:
            raise ValueError(
                f"{type(self).__name__} needs a flat storage of steps, ndim=1, got ndim="
                f"{storage.ndim}."
            )
        return storage, writer

    def _catch_up(self, storage: Storage) -> None:
        """Index what was written unseen: by other processes, or before this one kept an index."""
        storage, writer = self._parts(storage)
        size, written = storage.max_size, writer._write_count
        if written == self._seen:
            return
        missed = size if self._seen is None else written - self._seen
        overwritten = False
        if missed >= size:
            self._empty()
            missed, overwritten = len(storage), written > size
        if missed:
            end = writer._cursor + size
            slots = torch.arange(end - missed, end) % size
            self._index(storage, slots, overwritten=overwritten)
        self._seen = written

    def _index(self, storage: TensorStorage, index: Tensor, *, overwritten: bool = False) -> None:
        """Index the steps at `index`; `overwritten`: what preceded them is no longer there."""
        size = storage.max_size
        overwritten |= index.numel() > size
        index = index[-size:]
        group, trajectory, done = self._read(storage, index)
        if not self._owner.numel():
            self._allocate(size)
        self._forget(self._owner[index].unique())
        starts = _run_starts(group, trajectory, done)
        starts[1:] |= index[1:] != (index[:-1] + 1) % size
        run = starts.nonzero().squeeze(-1)
        length = torch.diff(run, append=run.new_tensor([index.numel()]))
        ended = done[run + length - 1]
        start, group = index[run], group[run]
        self._continue_tail(start, length, group, trajectory, size)
        self._unfinished += int((~ended[:-1]).sum())
        # What is longer than the storage has overwritten its own beginning: never whole. The first
        # trajectory may have lost its beginning too.
        length[0] += size * overwritten
        if not ended[-1]:
            last_id = None if trajectory is None else int(trajectory[-1])
            self._tail = (int(start[-1]), int(length[-1]), int(group[-1]), last_id)
        whole = ended & (length <= size)
        self._register(start[whole], length[whole], group[whole])

    def _read(self, storage: TensorStorage, index: Tensor) -> tuple[Tensor, Tensor | None, Tensor]:
        """Return group, trajectory (if there) and done, each `[n]`, of the steps at `index`."""
        data = storage[:]
        if not isinstance(data, TensorDictBase):
            raise TypeError(f"{type(self).__name__} needs tensordicts, got {type(data).__name__}.")
        if data.ndim != 1:
            raise ValueError(
                f"{type(self).__name__} needs flat steps [S], got data of shape "
                f"{tuple(data.shape)}. Write buffer.extend(unpack_groups(data))."
            )
        mask = _per_step(data, MASK_KEY)
        if mask is not None and not mask[index.to(mask.device)].all():
            raise ValueError(
                f"The steps hold padding ({MASK_KEY!r} is False), which would be taken for steps "
                "of trajectories. Write buffer.extend(unpack_groups(data))."
            )
        done = data.get(self.done_key, None)
        if done is None:
            raise KeyError(
                f"{type(self).__name__} needs the entry {self.done_key!r} to know where a "
                f"trajectory ends; found {_names(data)}."
            )
        group = _integer_entry(data, self.group_key, type(self).__name__)
        trajectory = _per_step(data, self.traj_key)
        index = index.to(group.device)
        return (
            group[index].cpu(),
            None if trajectory is None else trajectory[index].cpu(),
            done[index].reshape(-1).cpu(),
        )

    def _continue_tail(
        self, start: Tensor, length: Tensor, group: Tensor, trajectory: Tensor | None, size: int
    ) -> None:
        """Join the first run written to the trajectory that had not ended, if it goes on there."""
        tail, self._tail = self._tail, None
        if tail is None:
            return
        tail_start, tail_length, tail_group, tail_id = tail
        same_id = tail_id is None if trajectory is None else tail_id == int(trajectory[0])
        if (tail_start + tail_length) % size == start[0] and tail_group == group[0] and same_id:
            # What goes round to the trajectory's own beginning overwrites it: never whole.
            is_overwritten = tail_length + int(length.sum()) > size
            start[0] = tail_start
            length[0] += tail_length + size * is_overwritten
        else:
            self._unfinished += 1

    def _slots(self, start: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slots of the trajectories, one after the other, and the start of each."""
        owner = start.repeat_interleave(length)
        first = (length.cumsum(0) - length).repeat_interleave(length)
        time = torch.arange(owner.numel()) - first
        return (owner + time) % self._owner.numel(), owner

    def _register(self, start: Tensor, length: Tensor, group: Tensor) -> None:
        self._length[start], self._group[start] = length, group
        slots, owner = self._slots(start, length)
        self._owner[slots] = owner
        for trajectory, key in zip(start.tolist(), group.tolist(), strict=True):
            members = self._members.get(key)
            if members is None:
                members = self._members[key] = _Pool()
            members.add(trajectory)
            if len(members) == self.group_size:
                self._ready.add(key)

    def _forget(self, start: Tensor) -> None:
        """Drop the trajectories that start at `start`, of which -1 means none."""
        start = start[start >= 0]
        slots, _ = self._slots(start, self._length[start])
        self._owner[slots] = -1
        for trajectory, key in zip(start.tolist(), self._group[start].tolist(), strict=True):
            members = self._members[key]
            if len(members) == self.group_size:
                (self._ready if key in self._ready else self._drawn).remove(key)
            members.remove(trajectory)
            if not len(members):
                del self._members[key]

    # Drawing

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict]:
        """Draw a batch: the slots of its steps `[G, K, T]`, and the mask in the info.

        Args:
            storage: the buffer's storage.
            batch_size: the number of trajectories, `G * K`.
        """
        num_groups = self._num_groups(batch_size)
        self._catch_up(storage)
        self._check_drawable(num_groups)
        size = self.group_size
        device = None if self._rng is None else self._rng.device
        uniforms = torch.rand(
            num_groups, size + 1, generator=self._rng, dtype=torch.float64, device=device
        ).tolist()
        groups = list(self._ready.draw([row[0] for row in uniforms]))
        drawn = [
            self._members[group].draw(row[1:]) for group, row in zip(groups, uniforms, strict=True)
        ]
        if not self.replacement:
            self._take(groups, num_groups)
        start = torch.tensor(drawn)
        length = self._length[start].unsqueeze(-1)
        time = torch.arange(int(length.max()))
        index = (start.unsqueeze(-1) + time.minimum(length - 1)) % self._owner.numel()
        return index, {MASK_KEY: time < length}

    def _num_groups(self, batch_size: int) -> int:
        num_groups, rest = divmod(batch_size, self.group_size)
        wanted = self.num_groups or num_groups
        if rest or num_groups != wanted or not num_groups:
            groups = "num_groups" if self.num_groups is None else f"num_groups={self.num_groups}"
            raise ValueError(
                f"The batch size counts trajectories, {groups} * group_size={self.group_size}, "
                f"got {batch_size}."
            )
        return num_groups

    def _check_drawable(self, num_groups: int) -> None:
        ready = len(self._ready)
        if ready >= num_groups:
            return
        waiting = len(self._members) - ready - len(self._drawn)
        message = (
            f"Cannot draw {num_groups} group(s) of {self.group_size} trajectories: the storage "
            f"holds {ready + len(self._drawn)} complete group(s), and {waiting} with fewer than "
            f"{self.group_size} whole trajectories, which wait. "
        )
        if len(self._drawn):
            message += f"{len(self._drawn)} complete group(s) have been drawn in this pass. "
        if self._unfinished or self._tail is not None:
            message += (
                f"{self._unfinished + (self._tail is not None)} trajectories never ended "
                f"({self.done_key!r}): limit their length with StepCounter(max_steps=...). "
            )
        raise RuntimeError(message + "Collect more, or ask for less.")

    def _take(self, groups: list[int], num_groups: int) -> None:
        for group in groups:
            self._ready.remove(group)
            self._drawn.add(group)
        self._ran_out = len(self._ready) < num_groups
        if self._ran_out:
            for group in self._drawn.items:
                self._ready.add(group)
            self._drawn = _Pool()

    def can_sample(self, storage: Storage, batch_size: int) -> bool:
        """Whether a batch of `batch_size` trajectories can be drawn."""
        self._catch_up(storage)
        return len(self._ready) >= self._num_groups(batch_size)

    @property
    def ran_out(self) -> bool:
        """Whether the last draw ended a pass. Always False with replacement."""
        return self._ran_out

    @ran_out.setter
    def ran_out(self, value: bool) -> None:
        self._ran_out = value

    # Saving

    def state_dict(self) -> dict[str, Any]:
        """Return the index and the state of the pass: a restored sampler draws the same batches."""
        start = torch.tensor(
            [item for pool in self._members.values() for item in pool.items], dtype=torch.long
        )
        return {
            "group_size": self.group_size,
            "start": start,
            "length": self._length[start],
            "group": self._group[start],
            "max_size": self._owner.numel(),
            "ready": list(self._ready.items),
            "drawn": list(self._drawn.items),
            "tail": self._tail,
            "unfinished": self._unfinished,
            "seen": self._seen,
            "ran_out": self._ran_out,
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
        self._empty()
        self._allocate(state_dict["max_size"])
        self._register(*(state_dict[key] for key in ("start", "length", "group")))
        self._ready, self._drawn = _Pool(state_dict["ready"]), _Pool(state_dict["drawn"])
        self._tail = state_dict["tail"]
        self._unfinished = state_dict["unfinished"]
        self._seen = state_dict["seen"]
        self._ran_out = state_dict["ran_out"]

    def dumps(self, path: str | Path) -> None:
        """Write the state to the folder `path`."""
        folder = Path(path)
        folder.mkdir(exist_ok=True, parents=True)
        torch.save(self.state_dict(), folder / "trajectory_groups.pt")

    def loads(self, path: str | Path) -> None:
        """Read the state from the folder `path`."""
        self.load_state_dict(torch.load(Path(path) / "trajectory_groups.pt", weights_only=True))

    def __getstate__(self) -> dict[str, Any]:
        """Leave the index behind: a copy builds its own at its first draw."""
        copy = type(self).__new__(type(self))
        copy._empty()
        return {**super().__getstate__(), **vars(copy)}

    def __repr__(self) -> str:
        """Show the settings and what is in the storage."""
        return (
            f"{type(self).__name__}(group_size={self.group_size}, num_groups={self.num_groups}, "
            f"replacement={self.replacement}, groups={len(self._members)}, "
            f"complete={len(self._ready) + len(self._drawn)})"
        )
