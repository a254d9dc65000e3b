"""The algorithmic tasks of gym 0.19 (Copy, Reverse, ...) as one batched TorchRL environment.

Shapes: `G` rows (problem instances), `K` copies that play the same instance, `N = G * K` episodes
flattened, `n` of them selected, `L` = 32 columns of input, `R` rows of input, `M` target positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Categorical, Composite, MultiCategorical, Unbounded
from torchrl.envs import EnvBase

from torchrl_ecpo.checks import check_choice, check_count, check_kind, described, get_entry
from torchrl_ecpo.envs._groups import GroupIdAllocator, check_owner

# gym's curriculum ends at min_length 30, and a length is min_length plus 0, 1 or 2.
_TOP_LEVEL = 30
_LENGTH_SPREAD = 3
_MAX_LENGTH = _TOP_LEVEL + _LENGTH_SPREAD - 1
_PADDING = -1
# What a step amounts to: silent, wrong, right, out of time.
_REWARDS = (0.0, -0.5, 1.0, -1.0)
_RIGHT, _LATE = 2, 3
# Left, right and, on the grid, up, down: the change of (column, row).
_MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))

Curricula = Literal["group", "batch", "gym"]
_TargetFn = Callable[[Tensor, Tensor, int], "tuple[Tensor, Tensor]"]


# Targets: characters [n, L, R] (0 beyond the input), its length [n] and the base
# -> target [n, M] (anything beyond its length), its length [n].


def _copy(characters: Tensor, length: Tensor, base: int) -> tuple[Tensor, Tensor]:
    return characters[..., 0], length


def _every_second(characters: Tensor, length: Tensor, base: int) -> tuple[Tensor, Tensor]:
    return characters[:, ::2, 0], length // 2


def _reverse(characters: Tensor, length: Tensor, base: int) -> tuple[Tensor, Tensor]:
    position = torch.arange(characters.shape[1], device=characters.device)
    source = length.unsqueeze(-1) - 1 - position
    return characters[..., 0].gather(1, source.clamp(min=0)), length


def _there_back_and_there(characters: Tensor, length: Tensor, base: int) -> tuple[Tensor, Tensor]:
    position = torch.arange(3 * characters.shape[1], device=characters.device)
    size = length.unsqueeze(-1)
    turn, offset = position // size, position % size
    source = torch.where(turn == 1, size - 1 - offset, offset)
    return characters[..., 0].gather(1, source), 3 * length


def _sum(characters: Tensor, length: Tensor, base: int) -> tuple[Tensor, Tensor]:
    # The rows are numbers, lowest digit first; 3 * 3**32 fits an int64.
    powers = base ** torch.arange(characters.shape[1] + 1, device=characters.device)
    total = (characters.sum(-1) * powers[:-1]).sum(-1)
    carry = total >= powers[length]
    return total.unsqueeze(-1) // powers % base, length + carry


@dataclass(frozen=True)
class AlgorithmicTask:
    """What sets one task apart; the values are gym's.

    Attributes:
        base: number of characters; `base` itself stands for a blank.
        target: makes the target from the input.
        rows: rows of the input; more than one makes a grid, with moves up and down.
        min_length: where the curriculum starts.
        last: successes in a row that raise `min_length` by one.
        threshold: an episode succeeds if its return minus the target's length is at least this.
        duplication: each character stands so many times in a row on the tape.

    Examples:
        >>> TASKS["reverse"].base, TASKS["reverse"].min_length
        (2, 1)
    """

    base: int
    target: _TargetFn
    rows: int = 1
    min_length: int = 2
    last: int = 10
    threshold: float = -1.0
    duplication: int = 1


TASKS: dict[str, AlgorithmicTask] = {
    "copy": AlgorithmicTask(5, _copy),
    "duplicated_input": AlgorithmicTask(5, _every_second, duplication=2),
    "repeat_copy": AlgorithmicTask(5, _there_back_and_there, last=50, threshold=-0.1),
    "reverse": AlgorithmicTask(2, _reverse, min_length=1, last=50, threshold=-0.1),
    "reversed_addition": AlgorithmicTask(3, _sum, rows=2),
    "reversed_addition3": AlgorithmicTask(3, _sum, rows=3),
}


def _indices(mask: Tensor) -> Tensor:
    """Where a mask is set, `[n]`, counted over all its dimensions."""
    return mask.reshape(-1).nonzero().squeeze(-1)


class _Curriculum(nn.Module):
    """Levels (min_length), each raised by one after `last` successes in a row.

    gym keeps the last `last` episodes, promotes when all of them succeeded, and then forgets
    them: that is a count of successes in a row, here `streaks`.
    """

    levels: Tensor
    streaks: Tensor

    def __init__(
        self,
        kind: Curricula | None,
        batch_size: tuple[int, int],
        level: int,
        last: int,
        device: torch.device | None,
    ) -> None:
        super().__init__()
        self.kind, self.last, self.batch_size = kind, last, batch_size
        num_groups, group_size = batch_size
        shape = {"group": (num_groups, 1), "gym": (num_groups, group_size)}.get(kind or "", (1, 1))
        self.register_buffer("levels", torch.full(shape, level, device=device))
        self.register_buffer("streaks", torch.zeros(shape, dtype=torch.int64, device=device))

    def current(self) -> Tensor:
        """The level of each copy, `[N]`."""
        return self.levels.expand(self.batch_size).reshape(-1)

    def record(self, rows: Tensor, success: Tensor, level: Tensor, ended: Tensor) -> None:
        """Count the last episodes of the copies `rows` (ascending); all arguments are `[n]`."""
        if self.kind is None:
            return
        if self.kind != "gym":
            # One entry for each instance, and none for one of a level that has been passed.
            counted = ended & (level == self.current()[rows])
            counted &= rows % self.batch_size[1] == 0
            rows, success = rows[counted], success[counted]
        if not rows.numel():
            return
        if self.kind == "batch":
            units, success = torch.zeros_like(rows[:1]), success.unsqueeze(0)
        else:
            units = rows if self.kind == "gym" else rows // self.batch_size[1]
            success = success.unsqueeze(1)
        levels, streaks = self.levels.view(-1), self.streaks.view(-1)
        order = torch.arange(1, success.shape[1] + 1, device=rows.device)
        before = torch.where(success, -streaks[units].unsqueeze(1), order)
        streak = order - before.cummax(1).values
        promoted = (streak >= self.last).any(1)
        streaks[units] = streak[:, -1].masked_fill(promoted, 0)
        levels[units] = (levels[units] + promoted).clamp(max=_TOP_LEVEL)


class _InstanceQueue(nn.Module):
    """For each row, the instances that not all of its copies have taken yet.

    The i-th instance of a row stands in slot `i % slots` of a ring, which doubles when one copy
    runs further ahead of another than the ring holds.
    """

    characters: Tensor  # [G, slots, L, R]
    extra_length: Tensor  # [G, slots], as are the next two
    level: Tensor
    group: Tensor
    drawn: Tensor  # [G]
    taken: Tensor  # [G, K]
    _RINGS = ("characters", "extra_length", "level", "group")

    def __init__(
        self,
        task: AlgorithmicTask,
        batch_size: tuple[int, int],
        id_stride: int,
        device: torch.device | None,
    ) -> None:
        super().__init__()
        self.task, self.id_stride = task, id_stride
        self.ids = GroupIdAllocator()
        self.generator = torch.Generator()
        num_groups = batch_size[0]
        for name, shape in {
            "characters": (num_groups, 1, _MAX_LENGTH, task.rows),
            "extra_length": (num_groups, 1),
            "level": (num_groups, 1),
            "group": (num_groups, 1),
            "drawn": (num_groups,),
            "taken": batch_size,
        }.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.int64, device=device))

    def clear(self) -> None:
        """Forget what is pending: the copies of a row go on together with a new instance."""
        self.taken.copy_(self.drawn.unsqueeze(-1).expand_as(self.taken))

    def take(self, rows: Tensor, level: Tensor) -> list[Tensor]:
        """The next instance of each of the copies `rows` `[n]`, drawn at `level` `[N]` if new.

        Returns:
            Characters `[n, L, R]`, extra length, level and group `[n]`.
        """
        group_size = self.taken.shape[1]
        taken, row = self.taken.view(-1), rows // group_size
        turn = taken[rows]
        missing = torch.zeros_like(self.drawn, dtype=torch.bool)
        missing[row[turn == self.drawn[row]]] = True
        self._draw(_indices(missing), level.view_as(self.taken)[:, 0])
        taken[rows] = turn + 1
        slot = turn % self.level.shape[1]
        return [getattr(self, name)[row, slot] for name in self._RINGS]

    def _draw(self, row: Tensor, level: Tensor) -> None:
        count, task = row.numel(), self.task
        if not count:
            return
        if (self.drawn - self.taken.min(1).values)[row].max() >= self.level.shape[1]:
            self._grow()
        # On the CPU: the same seed then gives the same episodes on every device.
        size = (count, _MAX_LENGTH // task.duplication, task.rows)
        extra_length = torch.randint(_LENGTH_SPREAD, (count,), generator=self.generator)
        characters = torch.randint(task.base, size, generator=self.generator)
        slot = self.drawn[row] % self.level.shape[1]
        self.characters[row, slot] = characters.repeat_interleave(task.duplication, 1).to(
            row.device
        )
        self.extra_length[row, slot] = extra_length.to(row.device)
        self.level[row, slot] = level[row]
        ids = self.ids.allocate(count, stride=self.id_stride)
        self.group[row, slot] = ids.to(row.device)
        self.drawn[row] += 1

    def _grow(self) -> None:
        num_groups, slots = self.level.shape
        row = torch.arange(num_groups, device=self.drawn.device).unsqueeze(-1)
        turn = self.drawn.unsqueeze(-1) - slots + torch.arange(slots, device=self.drawn.device)
        for name in self._RINGS:
            ring = getattr(self, name)
            larger = ring.new_zeros(num_groups, 2 * slots, *ring.shape[2:])
            larger[row, turn % (2 * slots)] = ring[row, turn % slots]
            setattr(self, name, larger)

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *args: object) -> None:
        for name in self._RINGS:
            saved, ring = state_dict.get(prefix + name), getattr(self, name)
            if saved is not None and saved.ndim == ring.ndim:
                slots = saved.shape[1]
                setattr(self, name, ring.new_zeros(ring.shape[0], slots, *ring.shape[2:]))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def get_extra_state(self) -> Tensor:
        """The state of the random generator, uint8."""
        return self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        """Put the random generator back to `state`."""
        if state.shape != self.get_extra_state().shape:
            raise ValueError(f"_queue._extra_state is no state of a generator: {described(state)}.")
        self.generator.set_state(state.cpu())


class AlgorithmicEnv(EnvBase):
    """The algorithmic tasks of gym 0.19: read a tape with a moving head, write the right answer.

    Batched on tensors: `batch_size` is `[num_groups, group_size]`, and the `group_size` copies of
    a row play the same problem instance, as the trajectory-group losses need it. A right character
    is worth 1, a wrong one -0.5 and the end; the episode also ends with the last character of the
    target. The step that exceeds the time limit is the last, worth -1 instead of what it earned; it
    counts as `terminated` (`truncated` is never set).

    The action is int64 `[..., 3]`: move (left, right and, if the input has several rows, up,
    down), write (0 or 1), character. Besides `done`, `terminated`, `truncated` and, after a step,
    `reward`, all `[..., 1]`, the environment returns

    - `observation`, int64: the character under the head, `base` for a blank;
    - `previous_action`, int64 `[..., 3]`: the last action; after a reset the extra class of each
      part, which is the number of its actions;
    - `group`, int64: the problem instance, unique across environments and processes;
    - `level`, int64: the `min_length` that the instance was drawn at;
    - `attainable`, float32: the largest return, which is the length of the target.

    Instances have `min_length` plus 0, 1 or 2 columns of uniform characters (DuplicatedInput:
    of pairs; an odd column is dropped). When the copies of a row are reset at different times, the
    n-th episode of each is still the n-th instance of the row. A reset of the whole environment
    (without a `"_reset"` entry) and `set_seed` drop what is pending and bring the copies back in
    step. In a step, episodes that have ended, and those that a `"_step"` entry leaves out, stay as
    they are, earn nothing and cost nothing.

    **Given instances.** `reset(instance=...)` plays what it is given: int64 `[*batch, L]`, or
    `[*batch, L, rows]` if the input has several rows, L at most 32, the characters first and then
    -1 as padding. Identical instances in a row get one `group`. They count for the curriculum like
    drawn ones, at the present level, and leave the row's sequence of drawn instances alone.

    **Curriculum.** `min_length` goes up by one, to 30 at most, after `last` successes in a row (see
    `TASKS`). A success is, in effect, a perfect episode, counted when a reset follows.

    - `"group"`: a level for each row. An instance counts once, by its first copy.
    - `"batch"`: one level for all rows. Each instance counts once, in order of reset, then of row,
      with at most one promotion a reset.
    - `"gym"`: a level for each copy, by gym's rule to the letter. The copies of a row share the
      random draw; those at one level play the identical instance, and `group` tells them apart.
    - `None`: `min_length` stays.

    `"group"` and `"batch"` count no interrupted episodes, nor instances drawn before the latest
    promotion.

    `state_dict` holds all that is needed to go on identically: tapes and heads, pending instances,
    `curriculum.levels`, `curriculum.streaks` (successes in a row) and the random generator's
    state. Only the group ids of instances drawn later differ.

    Args:
        task: a key of `TASKS`.

    Keyword Args:
        num_groups: rows of the batch. Default: 1.
        group_size: copies that play the same instance. Default: 1.
        min_length: where the curriculum starts, 1 to 30 (DuplicatedInput: from 2). Default: gym's.
        curriculum: `"group"`, `"batch"`, `"gym"` or `None`, see above. Default: `"group"`.
        seed: seeds the environment's own generator. Default: from torch's global generator.
        device: where the tensors live. Instances are drawn on the CPU, so a seed means the same
            episodes on every device. Default: the CPU.

    Raises:
        ValueError: if an argument, a given instance or an action is out of range, and for the state
            of another environment.

    Examples:
        >>> import torch
        >>> env = AlgorithmicEnv("reverse", num_groups=2, group_size=3, seed=0)
        >>> env.rollout(4, break_when_any_done=False)["observation"].shape
        torch.Size([2, 3, 4])
        >>> env = AlgorithmicEnv("copy")
        >>> td = env.reset(instance=torch.tensor([[[3, 1]]]))
        >>> td["action"] = torch.tensor([[[1, 1, 3]]])  # move right, write a 3
        >>> env.step(td)["next", "reward"].item()
        1.0
    """

    _tape: Tensor  # [N, (L + 2) * (R + 2)], the input within a border of blanks
    _target: Tensor  # [N, M + 1], padded with -1
    _cursor: Tensor  # [N, 4]: column and row on the tape (the border is 0), written, clock
    _bound: Tensor  # [N, 2]: where `written` and `clock` end the episode
    _return: Tensor  # [N]
    _ended: Tensor  # [N]
    _observation: Tensor  # [N]
    _previous_action: Tensor  # [N, 3]
    _group: Tensor  # [N]
    _level: Tensor  # [N]
    _every_row: Tensor  # [N], from here on constants
    _starts: Tensor  # [N, 2]: where a row begins in the flattened tape and target
    _moves: Tensor  # by outcome and move, the change of the cursor
    _rewards: Tensor
    _origin: Tensor  # the least and the greatest column and row
    _corner: Tensor
    _lowest_action: Tensor
    _highest_action: Tensor

    def __init__(
        self,
        task: str,
        *,
        num_groups: int = 1,
        group_size: int = 1,
        min_length: int | None = None,
        curriculum: Curricula | None = "group",
        seed: int | None = None,
        device: torch.device | str | int | None = None,
    ) -> None:
        """Make the environment; the class describes the arguments."""
        if not isinstance(task, str) or task not in TASKS:
            raise ValueError(f"Unknown task {task!r}: expected one of {', '.join(TASKS)}.")
        self.task_name, self.task = task, TASKS[task]
        self._check_arguments(min_length, curriculum)
        batch_size = (check_count("num_groups", num_groups), check_count("group_size", group_size))
        super().__init__(batch_size=batch_size, device=device)
        if seed is not None:
            seed = check_count("seed", seed, least=0)
        level = self.task.min_length if min_length is None else min_length
        self.curriculum = _Curriculum(curriculum, batch_size, level, self.task.last, self.device)
        # In gym's curriculum the copies of a draw may differ in level: room for an id a level.
        id_stride = _TOP_LEVEL + 1 if curriculum == "gym" else 1
        self._queue = _InstanceQueue(self.task, batch_size, id_stride, self.device)
        self._make_specs()
        self._make_state()
        self.set_seed(int(torch.empty((), dtype=torch.int64).random_()) if seed is None else seed)
        if curriculum == "gym":
            self._start(self._every_row)

    def _check_arguments(self, min_length: int | None, curriculum: str | None) -> None:
        lowest = self.task.duplication
        if min_length is not None and not (
            lowest <= check_count("min_length", min_length, least=0) <= _TOP_LEVEL
        ):
            raise ValueError(
                f"min_length of {self.task_name} must lie in {lowest}..{_TOP_LEVEL}, "
                f"got {min_length}."
            )
        check_choice("curriculum", curriculum, ("group", "batch", "gym", None))

    def get_extra_state(self) -> dict[str, str]:
        """Which environment the state is of."""
        kind, batch = self.curriculum.kind, tuple(self.batch_size)
        return {"env": f"{self.task_name} in a batch {batch} with the curriculum {kind!r}"}

    def set_extra_state(self, state: dict[str, str]) -> None:
        """It was checked before anything was loaded."""

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *args: object) -> None:
        own = self.get_extra_state()
        check_owner(state_dict.setdefault(f"{prefix}_extra_state", own), own["env"])
        for name, value in self.state_dict(prefix=prefix).items():
            given = state_dict.get(name, value)
            if isinstance(value, Tensor) and getattr(given, "dtype", None) != value.dtype:
                raise ValueError(f"{name!r} must be {value.dtype}, got {described(given)}.")
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _make_specs(self) -> None:
        batch, device, base = self.batch_size, self.device, self.task.base
        parts = torch.tensor([2 if self.task.rows == 1 else 4, 2, base], device=device)
        self._action_shape, column = torch.Size([*batch, 3]), torch.Size([*batch, 1])

        def actions(nvec: Tensor) -> MultiCategorical:
            return MultiCategorical(nvec, shape=self._action_shape, device=device)

        def flag() -> Categorical:
            return Categorical(2, shape=column, dtype=torch.bool, device=device)

        self.action_spec = actions(parts)
        self.observation_spec = Composite(
            observation=Categorical(base + 1, shape=batch, device=device),
            previous_action=actions(parts + 1),
            group=Unbounded(shape=batch, dtype=torch.int64, device=device),
            level=Categorical(_TOP_LEVEL + 1, shape=batch, device=device),
            attainable=Unbounded(shape=batch, device=device),
            shape=batch,
        )
        self.reward_spec = Unbounded(shape=column, device=device)
        self.done_spec = Composite(
            done=flag(), terminated=flag(), truncated=flag(), shape=batch, device=device
        )
        self.register_buffer("_lowest_action", torch.zeros_like(parts), persistent=False)
        self.register_buffer("_highest_action", parts - 1, persistent=False)

    def _make_state(self) -> None:
        count, rows, device = self.numel(), self.task.rows, self.device
        ones = torch.ones(1, dtype=torch.int64, device=device)
        whole = ones.new_zeros(1, _MAX_LENGTH, rows)
        target_width = self.task.target(whole, _MAX_LENGTH * ones, self.task.base)[0].shape[1] + 1
        cells = (_MAX_LENGTH + 2) * (rows + 2)
        every_row = torch.arange(count, device=device)
        for name, value in {
            "_tape": ones.new_zeros(count, cells),
            "_target": ones.new_zeros(count, target_width),
            "_cursor": ones.new_zeros(count, 4),
            "_bound": ones.new_zeros(count, 2),
            "_return": torch.zeros(count, device=device),
            "_ended": torch.zeros(count, dtype=torch.bool, device=device),
            "_observation": ones.new_zeros(count),
            "_previous_action": ones.new_zeros(count, 3),
            "_group": ones.new_zeros(count),
            "_level": ones.new_zeros(count),
        }.items():
            self.register_buffer(name, value)
        for name, value in {
            "_every_row": every_row,
            "_starts": torch.stack([every_row * cells, every_row * target_width], -1),
            "_moves": ones.new_tensor(
                [(*move, outcome == _RIGHT, 1) for outcome in range(_LATE) for move in _MOVES]
            ),
            "_rewards": torch.tensor(_REWARDS, device=device),
            "_origin": ones.new_zeros(2),
            "_corner": ones.new_tensor([_MAX_LENGTH + 1, rows + 1]),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            seed = check_count("seed", seed, least=0)
        self._queue.clear()
        if seed is None:
            self._queue.generator.seed()
        else:
            self._queue.generator.manual_seed(seed)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        instance: Tensor | None = None,
        **kwargs: object,
    ) -> TensorDictBase:
        selected = None if tensordict is None else tensordict.get("_reset", None)
        rows = self._every_row if selected is None else _indices(selected)
        given = None if instance is None else self._check_instance(instance, rows)
        shortfall = self._return[rows] - self._bound[rows, 0]
        self.curriculum.record(
            rows, shortfall >= self.task.threshold, self._level[rows], self._ended[rows]
        )
        if instance is not None and given is not None:
            level, group = self.curriculum.current()[rows], self._groups_of(instance)[rows]
            self._play(rows, *given, level, group)
        else:
            if selected is None:
                self._queue.clear()
            self._start(rows)
        return self._output()

    def _start(self, rows: Tensor) -> None:
        """Start the next drawn instance of the copies `rows` `[n]`."""
        levels = self.curriculum.current()
        characters, extra_length, level, group = self._queue.take(rows, levels)
        if self.curriculum.kind == "gym":
            level = levels[rows]
            group = group + level
        length = level + extra_length
        length = length - length % self.task.duplication
        self._play(rows, characters, length, level, group)

    def _play(
        self, rows: Tensor, characters: Tensor, length: Tensor, level: Tensor, group: Tensor
    ) -> None:
        """Start episodes of `characters` `[n, L, R]`, of which the first `length` `[n]` count."""
        task, count = self.task, rows.numel()
        column = torch.arange(characters.shape[1], device=rows.device)
        outside = (column >= length.unsqueeze(-1)).unsqueeze(-1)
        target, target_length = task.target(characters.masked_fill(outside, 0), length, task.base)
        position = torch.arange(target.shape[1], device=rows.device)
        target = target.masked_fill(position >= target_length.unsqueeze(-1), _PADDING)
        tape = characters.new_full((count, _MAX_LENGTH + 2, task.rows + 2), task.base)
        tape[:, 1:-1, 1:-1] = characters.masked_fill(outside, task.base)
        time_limit = length + (target_length if task.rows == 1 else length) + 4
        self._tape.index_copy_(0, rows, tape.flatten(1))
        self._target.index_copy_(0, rows, nn.functional.pad(target, (0, 1), value=_PADDING))
        self._cursor[rows] = self._cursor.new_tensor([1, 1, 0, 0])
        self._bound[rows] = torch.stack([target_length, time_limit + 1], -1)
        self._return[rows] = 0.0
        self._ended[rows] = False
        self._observation[rows] = tape[:, 1, 1]
        self._previous_action[rows] = self._highest_action + 1
        self._level[rows] = level
        self._group[rows] = group

    def _check_instance(self, instance: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """The given instances that the copies `rows` play: characters `[n, L, R]`, length `[n]`."""
        check_kind("instance", instance, Tensor)
        base, height = self.task.base, self.task.rows
        columns = instance.shape[2] if instance.ndim > 2 else 0
        tail = (columns,) if height == 1 else (columns, height)
        if instance.shape != (*self.batch_size, *tail) or not 1 <= columns <= _MAX_LENGTH:
            wanted = ", ".join(map(str, (*self.batch_size, "L", *tail[1:])))
            raise ValueError(
                f"'instance' of {self.task_name} must have the shape [{wanted}] with L in "
                f"1..{_MAX_LENGTH}, got {list(instance.shape)}."
            )
        if instance.dtype != torch.int64:
            raise ValueError(f"'instance' must be of dtype torch.int64, got {instance.dtype}.")
        characters = nn.functional.pad(
            instance.reshape(self.numel(), columns, height)[rows],
            (0, 0, 0, _MAX_LENGTH - columns),
            value=_PADDING,
        )
        length = (characters[..., 0] != _PADDING).sum(1)
        inside = torch.arange(_MAX_LENGTH, device=instance.device) < length.unsqueeze(-1)
        is_character = (characters >= 0) & (characters < base)
        right = torch.where(inside.unsqueeze(-1), is_character, characters == _PADDING).all(-1)
        if self.task.duplication == 2:
            right[:, ::2] &= characters[:, ::2, 0] == characters[:, 1::2, 0]
        right = right.all(-1) & (length > 0)
        if not right.all():
            raise ValueError(
                f"'instance' of {self.task_name} must hold characters in 0..{base - 1}, at least "
                f"one, then {_PADDING} as padding, in all rows of the input alike (each character "
                f"twice for duplicated_input), got {characters[~right][0].squeeze(-1).tolist()}."
            )
        return characters, length

    def _groups_of(self, instances: Tensor) -> Tensor:
        """New group ids `[N]`, the same for identical given instances of a row."""
        copies = instances.reshape(*self.batch_size, -1)
        first = (copies.unsqueeze(1) == copies.unsqueeze(2)).all(-1).int().argmax(-1)
        ids = self._queue.ids.allocate(self.numel()).to(instances.device)
        return ids.view(self.batch_size).gather(1, first).view(-1)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = get_entry(tensordict, "action")
        if action.shape != self._action_shape or action.dtype != torch.int64:
            raise ValueError(
                f"'action' must be int64 of shape {list(self._action_shape)}, "
                f"got {action.dtype} of shape {list(action.shape)}."
            )
        active, selected = ~self._ended, tensordict.get("_step", None)
        if selected is not None:
            active &= selected.reshape(-1)
        rows = active.nonzero().squeeze(-1)
        reward = torch.zeros_like(self._return)
        reward.index_copy_(
            0, rows, self._advance(rows, action.reshape(-1, 3).index_select(0, rows))
        )
        return self._output().set("reward", reward.view(*self.batch_size, 1))

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        """What a step returns is complete, so that there is nothing to add."""
        return next_tensordict_out

    def _advance(self, rows: Tensor, action: Tensor) -> Tensor:
        """Act in the episodes `rows`, return the rewards: the tasks' rules are here."""
        # On few rows the number of operations counts; indexing takes twice as long as index_select.
        self._check_action(action)
        move, write, character = action.unbind(-1)
        cursor = self._cursor.index_select(0, rows)
        tape_start, target_start = self._starts.index_select(0, rows).unbind(-1)
        expected = self._target.take(target_start + cursor[:, 2])
        outcome = torch.addcmul(write, write, character == expected)
        cursor += self._moves.index_select(0, torch.add(move, outcome, alpha=len(_MOVES)))
        place, counts = cursor.split(2, -1)
        complete, late = (counts >= self._bound.index_select(0, rows)).unbind(-1)
        reward = self._rewards.take(outcome.masked_fill_(late, _LATE))
        column, row = torch.clamp(place, self._origin, self._corner).unbind(-1)
        cell = torch.add(tape_start + row, column, alpha=self.task.rows + 2)
        self._observation.index_copy_(0, rows, self._tape.take(cell))
        self._cursor.index_copy_(0, rows, cursor)
        self._previous_action.index_copy_(0, rows, action)
        self._return.index_add_(0, rows, reward)
        self._ended.index_copy_(0, rows, complete | (reward < 0))
        return reward

    def _check_action(self, action: Tensor) -> None:
        if torch.equal(torch.clamp(action, self._lowest_action, self._highest_action), action):
            return
        strange = ((action < 0) | (action > self._highest_action)).any(-1)
        raise ValueError(
            f"'action' (move, write, character) of {self.task_name} must lie between [0, 0, 0] and "
            f"{self._highest_action.tolist()}, got {action[strange][0].tolist()}."
        )

    def _output(self) -> TensorDictBase:
        """What a step or a reset returns: copies, as the state goes on changing in place."""
        batch = self.batch_size
        done = self._ended.view(*batch, 1)
        return TensorDict(
            {
                "observation": self._observation.view(batch).clone(),
                "previous_action": self._previous_action.view(*batch, 3).clone(),
                "group": self._group.view(batch).clone(),
                "level": self._level.view(batch).clone(),
                "attainable": self._bound[:, 0].view(batch).float(),
                "done": done.clone(),
                "terminated": done.clone(),
                "truncated": torch.zeros_like(done),
            },
            batch_size=batch,
            device=self.device,
        )
