"""Collectors that yield complete trajectory groups.

Shapes: `G` groups, `K` trajectories of each, `T` steps of the longest one, `S` steps of all
trajectories together; the environment has the batch size `[*B, K]` with `prod(B)` groups.
"""

from __future__ import annotations

import inspect
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence, Set
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.collectors import Collector, MultiCollector
from torchrl.collectors.distributed import RayCollector
from torchrl.collectors.utils import _maybe_normalize_replay_buffer_tensordict_device
from torchrl.data import NonTensor
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import RandomPolicy

try:
    import ray
except ImportError:  # an extra, which TorchRL asks for in its own words
    ray: Any = None

from torchrl_ecpo.collectors.supervised import (
    SupervisedAsyncCollector,
    SupervisedSyncCollector,
    describe_death,
)
from torchrl_ecpo.groups import GROUP_KEY, MASK_KEY, TRAJECTORY_KEY, pack_groups, unpack_groups

__all__ = ["TrajectoryGroupCollector"]

_DONE_NAMES = ("done", "terminated", "truncated")

# Collector's own arguments that group collection leaves no room for, and why.
_REFUSED = {
    "frames_per_batch": "a batch is counted in groups: num_groups and group_size",
    "trajs_per_batch": "a batch is counted in groups: num_groups and group_size",
    "traj_format": "batches are padded; a replay buffer is written flat",
    "split_trajs": "trajectories are not split",
    "init_random_frames": "every action comes from the policy",
    "set_truncated": "trajectories are never cut at the end of a batch",
    "preemptive_threshold": "a batch holds whole trajectories only",
    "use_buffers": "batches differ in length",
    "cat_results": "the groups of all workers are concatenated",
    "return_same_td": "every batch is new",
    "extend_buffer": "a buffer is written one batch at a time",
    "reset_at_each_iter": "all trajectories of a batch start with it",
    "track_traj_ids": "trajectories always have ids",
    "cudagraph_policy": "the number of rows that the policy sees changes",
}


class _GroupCollectorMeta(type(Collector)):
    """Makes the collector of the backend asked for, as TorchRL's metaclass does for its own."""

    def __call__(
        cls,
        *args: Any,
        backend: str | None = None,
        backend_options: dict[str, Any] | None = None,
        num_collectors: int | None = None,
        sync: bool | None = None,
        **kwargs: Any,
    ) -> Any:
        several = isinstance(args[0] if args else kwargs.get("create_env_fn"), Sequence)
        if backend is None:
            backend = "process" if several or num_collectors is not None else "direct"
        if backend not in ("direct", "process", "ray"):
            raise ValueError(
                f"backend={backend!r} does not collect groups; 'direct', 'process' and 'ray' do."
            )
        if backend_options is not None and backend != "ray":
            raise ValueError(f"backend_options are for backend='ray', got them for {backend!r}.")
        if backend == "direct":
            if several or num_collectors is not None or sync is not None:
                raise ValueError(
                    "sync, num_collectors and lists of environment makers are for worker "
                    "processes: sync needs num_collectors, the number of workers."
                )
            return super().__call__(*args, **kwargs)
        if backend == "ray" and sync is False:
            raise ValueError("sync=False is for backend='process': with Ray, workers wait.")
        make: Any = _SyncGroups if sync else _AsyncGroups
        if backend == "ray":
            make, sync = partial(_RayGroups, **(backend_options or {})), True
        return _make_multi_collector(
            make, *args, num_collectors=num_collectors, is_sync=bool(sync), **kwargs
        )


class TrajectoryGroupCollector(Collector, metaclass=_GroupCollectorMeta):
    """Collects complete groups: `K` trajectories of each of `G` problem instances, `[G, K, T]`.

    Takes what TorchRL's ``Collector`` takes, except what would cut trajectories, and:

    - yields batches `[G, K, T]` padded to the longest trajectory, with ``("collector", "mask")``,
      or, given a `replay_buffer`, writes their steps flat, for
      :class:`~torchrl_ecpo.groups.TrajectoryGroupSampler`;
    - is on-policy by the letter of Algorithm 1: all trajectories of a batch come from the same
      weights. The collector samples from a copy of the policy, the reference, which changes only
      when :meth:`update_policy_weights_` is called, on every backend. If that happens within a
      batch, its trajectories are restarted, and counted in :attr:`restarted_trajectories`;
    - spends nothing on trajectories that have ended: the policy sees the rows of the others, and
      the environment gets ``"_step"``. Nothing runs across batches, so nothing is thrown away;
    - sees to what a recurrent policy needs: the environment may lack `InitTracker` and primers.
      What the collector adds for the policy acts at a reset only; ``is_init`` and what the policy
      hands to its own next step then travel without passing through the environment.

    A batch keeps what the environment and the policy wrote at each step, with two exceptions. What
    the policy hands to its own next step, ``("next", ...)`` such as the state of an LSTM, is left
    out: a loss recomputes it from ``is_init``. Of the environment's ``("next", ...)``, by default
    only reward and done flags stay (`compact_obs`).

    Args:
        create_env_fn: the environment, or what makes it, of batch size `[*B, K]`; a list of makers
            for as many worker processes.
        policy: what acts. Default: random actions.
        num_groups: `G`, a multiple of the environment's `prod(B)` (of all workers', with `sync`).
        group_size: `K`, at least 2.
        backend: ``"direct"``, in this process, ``"process"``, in worker processes, or ``"ray"``, in
            the actors of a Ray cluster. Default: worker processes if they are asked for.
        backend_options: for Ray, TorchRL's `ray_init_config` (what ``ray.init`` takes) and
            `remote_configs` (what an actor needs, as ``ray.remote`` takes it).
        num_collectors: run this many worker processes. Default: none, or one for each of a list
            of makers.
        sync: with workers, whether a batch is made of all workers' groups, collected at the same
            time (True), or of those of one worker, while the others go on (False, the default, as
            TorchRL's). With False, `G` is that of each worker's batch, and a batch may come from
            the weights before the last update, though never from both.
        total_frames: stop when this many real steps have been collected. Default: -1, never.
        compact_obs: whether to leave observations out of ``"next"``: they are those of the next
            step. Default: True. A critic that needs the last one wants False.
        exclude_keys: more entries to leave out, with what is nested in them, such as logits and
            features that a loss computes anew.
        max_steps: the length at which a trajectory is taken to be endless. Default: 10,000.
        group_key: the environment's key of the problem instance.
        kwargs: everything else that ``Collector`` takes, such as `policy_factory`, devices,
            `max_frames_per_traj`, `exploration_type`, `postproc`, `replay_buffer`,
            `compile_policy`.

    Raises:
        TypeError: for an argument that does not go with groups, and for an environment that writes
            anything but tensors.
        ValueError: if `K` is below 2 or not the environment's, if `G` is no multiple, or if the
            environment makes groups of another size.
        KeyError: if the environment has no `group_key`.
        RuntimeError: if a trajectory does not end within `max_steps`.
        ChildProcessError: if a worker process dies.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_ecpo.envs.grouped import GroupedEnv
        >>> env = GroupedEnv(lambda: GymEnv("CartPole-v1"), num_groups=2, group_size=3)
        >>> collector = TrajectoryGroupCollector(env, num_groups=4, group_size=3)
        >>> batch = next(iter(collector))
        >>> batch.shape[:2], batch["group"][..., 0].unique().numel()
        (torch.Size([4, 3]), 4)
        >>> length = batch["collector", "mask"].sum(-1)
        >>> bool((length == batch["next", "reward"].sum((-2, -1))).all())
        True
        >>> collector.shutdown()
    """

    def __init__(
        self,
        create_env_fn: EnvBase | Callable[[], EnvBase] | Sequence[Callable[[], EnvBase]],
        policy: Callable[[TensorDictBase], TensorDictBase] | None = None,
        *,
        num_groups: int,
        group_size: int,
        backend: str | None = None,
        backend_options: dict[str, Any] | None = None,
        num_collectors: int | None = None,
        sync: bool | None = None,
        total_frames: int = -1,
        compact_obs: bool = True,
        exclude_keys: Sequence[NestedKey] = (),
        max_steps: int = 10_000,
        group_key: NestedKey = GROUP_KEY,
        **kwargs: Any,
    ) -> None:
        """Make the collector; the class describes the arguments."""
        del backend, backend_options, num_collectors, sync  # the metaclass has read them
        _check_arguments(num_groups, group_size, kwargs)
        self.num_groups, self.group_size = num_groups, group_size
        self.exclude_keys = set(map(unravel_key, exclude_keys))
        self.max_steps, self.group_key = max_steps, group_key
        self._restarted = torch.zeros((), dtype=torch.int64)
        self._weight_updates = 0
        self._yield_flat = kwargs.get("replay_buffer") is not None
        kwargs.setdefault("auto_register_policy_transforms", True)
        super().__init__(
            create_env_fn,  # pyright: ignore[reportArgumentType]
            policy,  # pyright: ignore[reportArgumentType]
            frames_per_batch=1,
            use_buffers=False,
            compact_obs=compact_obs,
            **kwargs,
        )
        if total_frames >= 0:  # TorchRL's own setter warns unless it is a multiple of a batch
            self.total_frames = total_frames
        try:
            self._check_env()
            self._prepare_steps()
        except Exception:
            self.shutdown(raise_on_error=False)
            raise

    def _check_env(self) -> None:
        env = self.env
        batch = env.batch_size
        if not batch or batch[-1] != self.group_size:
            raise ValueError(
                f"The environment must have the batch size [*B, group_size={self.group_size}], got "
                f"{tuple(batch)}. GroupedEnv makes groups of any environment."
            )
        if self.num_groups % (batch.numel() // self.group_size):
            raise ValueError(
                f"num_groups={self.num_groups} must be a multiple of the number of groups that the "
                f"environment plays at a time, {batch.numel() // self.group_size}."
            )
        if self.group_key not in env.full_observation_spec.keys(True, True):
            raise KeyError(
                f"The environment has no {self.group_key!r}, the problem instance of each row; it "
                f"has {sorted(map(str, env.full_observation_spec.keys(True, True)))}. GroupedEnv "
                "adds it to any environment."
            )
        if "done" not in env.done_keys:
            raise KeyError(f"The environment must have one 'done' a row, it has {env.done_keys}.")
        specs = env.full_observation_spec.items(True, True)
        texts = [key for key, spec in specs if isinstance(spec, NonTensor)]
        if texts:
            raise TypeError(
                f"Only tensors are collected, but the environment writes {texts}. Leave them out "
                "with TorchRL's ExcludeTransform, or sample by a loop of your own: pack_groups "
                "keeps them."
            )

    def _maybe_setup_policy_env_transforms(self, env: EnvBase, policy: Any) -> EnvBase:
        """Append what the policy needs, an `InitTracker` and its primers, for resets alone.

        In a step they would cost as much as all else around the rules of a fast environment.
        """
        self._stepped_env = env
        self._reset_env = super()._maybe_setup_policy_env_transforms(env, policy)
        return self._reset_env

    def _prepare_steps(self) -> None:
        """Find the environment to step, and what it and the policy read and write."""
        if self.env is not self._reset_env:  # more was appended, such as a StepCounter
            self._stepped_env = self.env
        env, policy = self._stepped_env, self._wrapped_policy_uncompiled
        acted_on = (env.full_action_spec, env.full_state_spec)
        self._acted_on = [key for spec in acted_on for key in spec.keys(True, True)]
        own = env.full_observation_spec.keys(True, True)
        self._start_keys = [
            key
            for key in self.env.full_observation_spec.keys(True, True)
            if key not in own and (key if isinstance(key, str) else key[-1]) == "is_init"
        ]
        read = [] if isinstance(policy, RandomPolicy) else getattr(policy, "in_keys", None)
        self._read = None if read is None else [unravel_key(key) for key in read]
        written = getattr(policy, "out_keys", env.action_keys)
        self._written = [unravel_key(key) for key in written]
        self._flow: _Flow | None = None

    def _setup_frames_per_batch(self, frames_per_batch: int) -> None:
        """Steps are not counted ahead: one at a time, in all rows."""
        self.frames_per_batch, self.requested_frames_per_batch = frames_per_batch, self.n_env

    def _get_policy_and_device(self, policy: Any = None, **kwargs: Any) -> tuple[Any, Any]:
        """Take a copy of the policy, so that training it does not change who acts."""
        moved, get_weights = super()._get_policy_and_device(policy, **kwargs)
        if moved is policy and isinstance(policy, nn.Module):
            moved = deepcopy(policy)
        return moved, get_weights

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Copy the weights of the policy, or those given, to the reference that acts."""
        super().update_policy_weights_(*args, **kwargs)
        self._weight_updates += 1

    def state_dict(self) -> OrderedDict[str, Any]:
        """The reference policy, the environment and the counters, between two batches."""
        state = super().state_dict()
        state["env_state_dict"] = self.env.state_dict()
        state["base_env_state_dict"] = _base_env(self.env).state_dict()
        return state

    def load_state_dict(self, state_dict: OrderedDict[str, Any], **kwargs: Any) -> None:
        """Go on from what :meth:`state_dict` returned."""
        _base_env(self.env).load_state_dict(state_dict["base_env_state_dict"], **kwargs)
        super().load_state_dict(state_dict, **kwargs)

    def iterator(self) -> Iterator[TensorDictBase | None]:
        """Yield batches, or None after each that is written to the replay buffer."""
        while self._frames < self.total_frames:
            self._iter += 1
            groups = self.rollout()
            self._increment_frames(int(groups[MASK_KEY].sum()))
            batch = self._postproc(unpack_groups(groups) if self._yield_flat else groups)
            if self.post_collect_hook is not None:
                self.post_collect_hook(batch)
            if self.replay_buffer is None:
                yield batch
                continue
            batch = _maybe_normalize_replay_buffer_tensordict_device(batch, self.replay_buffer)
            self.replay_buffer.extend(batch)
            yield None

    @torch.no_grad()
    def rollout(self) -> TensorDictBase:
        """Collect a batch of groups `[G, K, T]`."""
        if self.pre_collect_hook is not None:
            self.pre_collect_hook()
        while True:
            updates = self._weight_updates
            weights = [weight.detach().clone() for weight in self._weights()]
            rounds: list[_Round | None] = []
            while len(rounds) * self.n_env < self.num_groups * self.group_size:
                rounds.append(self._play_round(updates))
                if rounds[-1] is None:
                    break
            played = [one for one in rounds if one is not None]
            # A worker's weights are written by another thread: the count of updates may come late.
            if len(played) == len(rounds) and self._has_weights(weights):
                return self._pack(played)
            self._restarted += len(rounds) * self.n_env

    def _weights(self) -> Iterator[nn.Parameter]:
        module = self.policy if isinstance(self.policy, nn.Module) else nn.Module()
        return module.parameters()

    def _has_weights(self, weights: list[Tensor]) -> bool:
        return all(
            torch.equal(new, old) or torch.allclose(new, old, rtol=0.0, atol=0.0, equal_nan=True)
            for new, old in zip(self._weights(), weights, strict=True)
        )

    def _play_round(self, updates: int) -> _Round | None:
        """Play one trajectory in each row; None if the weights were updated meanwhile."""
        root = self.env.reset()
        played = _Round(self._check_groups(root))
        seen = root.copy() if self._read is None else root.select(*self._read, strict=False)
        rows = torch.arange(self.n_env, device=played.group.device)  # those that have not ended
        active: _Active | None = None
        with set_exploration_type(self.exploration_type):
            for _ in range(self.max_steps):
                if self._weight_updates != updates:
                    return None
                acted = self._act(seen, rows)
                step = self._stepped_env.step(self._set_inputs(root, acted, active))
                if self._flow is None:
                    self._flow = self._trace_flow(step, acted)
                played.append(step, acted, rows, self._flow)
                done = step.get(("next", "done")).reshape(-1).index_select(0, rows)
                going_on = done.logical_not_().nonzero().squeeze(-1)
                if not len(going_on):
                    return played
                root = self._stepped_env.step_mdp(step)
                if len(played) == 1:
                    root.update({key: torch.zeros_like(root[key]) for key in self._start_keys})
                if len(going_on) == len(rows):
                    going_on = None
                else:
                    rows = rows.index_select(0, going_on)
                    active = _Active(rows, self.n_env)
                seen = _show(root, acted, rows, going_on, self._flow)
        raise RuntimeError(
            f"{len(rows)} trajectories, the first one of group "
            f"{int(played.group.reshape(-1)[rows[0]])}, have not ended after "
            f"max_steps={self.max_steps} steps. Limit their length: append "
            "StepCounter(max_steps=...) to the environment, or pass max_frames_per_traj."
        )

    def _check_groups(self, root: TensorDictBase) -> Tensor:
        group = root[self.group_key]
        rows = group.reshape(-1, self.group_size) if group.shape == root.shape else None
        if rows is None or (rows != rows[:, :1]).any() or len(rows[:, 0].unique()) < len(rows):
            raise ValueError(
                f"After a reset, {self.group_key!r} must be one integer for each row, equal for "
                f"the group_size={self.group_size} copies of an instance and different from those "
                f"of the others, got {group.tolist()}."
            )
        return group

    def _act(self, seen: TensorDictBase, rows: Tensor) -> TensorDictBase:
        """Let the policy act on what it sees of the active rows."""
        if isinstance(self.policy, RandomPolicy):
            action = self.policy(TensorDict(batch_size=self.env.batch_size, device=seen.device))
            return seen.update(action if len(rows) == self.n_env else action.reshape(-1)[rows])
        cast = self._cast_to_policy_device and self.policy_device is not None
        acted: Any = self._wrapped_policy(seen.to(self.policy_device) if cast else seen)
        return acted.to(rows.device) if cast else acted

    def _set_inputs(
        self, root: TensorDictBase, acted: TensorDictBase, active: _Active | None
    ) -> TensorDictBase:
        """Let the active rows act; those that have ended act as some other one, to no effect."""
        if self._flow is None:
            return root.update(acted.select(*self._acted_on, strict=False))
        batch = root.batch_size
        for key in self._flow.inputs:
            value = acted.get(key)
            if active is not None:
                value = value.index_select(0, active.place).unflatten(0, batch)
            root.set(key, value)
        if active is not None:
            root.set("_step", active.mask.view(*batch, 1))
        return root

    def _trace_flow(self, step: TensorDictBase, acted: TensorDictBase) -> _Flow:
        """Tell from a first step what becomes of each entry."""
        every = set(step.keys(True, True))
        given = {key for key in every if key[0] != "next"}
        result = {unravel_key(key[1:]) for key in every - given}
        written = set(acted.keys(True, True))
        carried = {unravel_key(key[1:]): key for key in written if key[0] == "next"}
        dropped = self.exclude_keys | carried.keys()
        written -= set(carried.values()) | (given - set(self._written))
        read = given | written
        if self._read is not None:
            read = {key for key in read if _is_below(key, self._read)}
        carried |= {key: key for key in (written & read) - result - carried.keys()}
        recorded = step.copy().update(acted.select(*written))
        kept = _recorded_keys(recorded, dropped, self.compact_obs)
        return _Flow(
            inputs=[key for key in self._acted_on if key in written],
            shown=[key for key in given & read if key not in carried],
            carried=carried,
            kept=[key for key in kept if key not in written | {self.group_key}],
            decided=[key for key in kept if key in written],
        )

    def _pack(self, rounds: list[_Round]) -> TensorDictBase:
        num_steps = max(map(len, rounds))
        padded = []
        for one in rounds:
            steps = one.pad(num_steps)
            mask = steps[MASK_KEY]
            ids = self._traj_pool.get_traj_and_increment(self.n_env, device=mask.device)
            steps.set(self.group_key, one.group.reshape(-1, 1) * mask)
            padded.append(steps.set(TRAJECTORY_KEY, ids.unsqueeze(-1) * mask))
        groups: Any = padded[0] if len(padded) == 1 else TensorDict.cat(padded)
        groups = groups.unflatten(0, (self.num_groups, self.group_size))
        return groups if self.storing_device is None else groups.to(self.storing_device)

    @property
    def restarted_trajectories(self) -> int:
        """Trajectories begun and thrown away because the weights changed within a batch."""
        return int(self._restarted)


def _base_env(env: EnvBase) -> EnvBase:
    """The environment without its transforms, whose state dict leaves it out."""
    while isinstance(env, TransformedEnv):
        env = env.base_env
    return env


def _recorded_keys(
    step: TensorDictBase, dropped: Set[NestedKey], compact_obs: bool
) -> list[NestedKey]:
    """Choose what a batch keeps of a step: nothing `dropped`, nothing private.

    With `compact_obs`, an observation is kept where it is acted upon and not where it results.
    """
    kept: list[NestedKey] = []
    keys = list(step.keys(True, True))
    present = set(keys)
    for key in keys:
        path = key if isinstance(key, tuple) else (key,)
        is_next = path[0] == "next"
        entry = unravel_key(path[1:] if is_next else path)
        is_dropped = _is_below(key, dropped) or _is_below(entry, dropped)
        if is_dropped or any(part.startswith("_") for part in path):
            continue
        if is_next and compact_obs and entry in present and path[-1] not in _DONE_NAMES:
            continue
        kept.append(key)
    return kept


def _is_below(key: NestedKey, entries: Collection[NestedKey]) -> bool:
    """Whether an entry, or one that it is nested in, is among `entries`."""
    path = key if isinstance(key, tuple) else (key,)
    return any(unravel_key(path[: i + 1]) in entries for i in range(len(path)))


@dataclass
class _Flow:
    """What becomes of each entry of a step."""

    inputs: list[NestedKey]
    """What the policy writes and the environment acts on."""
    shown: list[NestedKey]
    """What the policy reads of the environment's entries."""
    carried: dict[NestedKey, NestedKey]
    """What the policy reads of its own, and where it wrote that in the step before."""
    kept: list[NestedKey]
    """What a batch keeps of the environment's entries."""
    decided: list[NestedKey]
    """What a batch keeps of the policy's."""


class _Active:
    """The rows `[n]` of `size` that go on: which, and where a row stands among them."""

    def __init__(self, rows: Tensor, size: int) -> None:
        self.mask = torch.zeros(size, dtype=torch.bool, device=rows.device)
        self.mask.index_fill_(0, rows, True)
        self.place = torch.zeros(size, dtype=torch.int64, device=rows.device)  # 0 if it is not
        self.place.index_copy_(0, rows, torch.arange(len(rows), device=rows.device))


def _show(
    root: TensorDictBase,
    acted: TensorDictBase,
    rows: Tensor,
    going_on: Tensor | None,
    flow: _Flow,
) -> TensorDictBase:
    """What the policy sees next: the environment's entries, then what it hands to itself.

    `root` has all rows, of which `rows` `[n]` go on; `acted` has those that were active before, of
    which `going_on` `[n]` go on, None for all.
    """
    whole = len(rows) == root.numel()
    seen = {key: _choose(root.get(key), None if whole else rows, root.ndim) for key in flow.shown}
    for key, source in flow.carried.items():
        seen[key] = _choose(acted.get(source), going_on, acted.ndim)
    shape = root.batch_size if whole else rows.shape
    return TensorDict(seen, batch_size=shape, device=root.device)


def _choose(entry: Any, rows: Tensor | None, ndim: int) -> Any:
    """Rows `[n]`, None for all, of an entry with `ndim` batch dimensions, counted over them all."""
    if rows is None:
        return entry
    if not isinstance(entry, Tensor):
        return entry.reshape(-1)[rows]
    return (entry.flatten(0, ndim - 1) if ndim > 1 else entry).index_select(0, rows)


class _Round:
    """One trajectory in each row, `N = prod(B) * K` rows: all begin, fewer and fewer go on.

    The environment's entries are recorded of all rows, the policy's of those that it saw; which
    ones count is sorted out once, at the end.
    """

    flow: _Flow

    def __init__(self, group: Tensor) -> None:
        self.group = group  # [*B, K]
        self._whole: list[list[Tensor]] = []  # [*B, K, *] each
        self._partial: list[list[Tensor]] = []  # [n, *] each
        self._rows: list[Tensor] = []  # [n] each

    def __len__(self) -> int:
        return len(self._rows)

    def append(
        self, step: TensorDictBase, acted: TensorDictBase, rows: Tensor, flow: _Flow
    ) -> None:
        self.flow = flow
        self._whole.append([step.get(key) for key in flow.kept])
        last = acted.ndim - 1
        self._partial.append([acted.get(key).flatten(0, last) for key in flow.decided])
        self._rows.append(rows)

    def pad(self, num_steps: int) -> TensorDictBase:
        """Return trajectories `[N, num_steps]`, with zeros after their ends, and their mask."""
        row, shape = torch.cat(self._rows), (self.group.numel(), num_steps)
        time = [torch.full_like(rows, t) for t, rows in enumerate(self._rows)]
        place = row * num_steps + torch.cat(time)
        mask = torch.zeros(shape, dtype=torch.bool, device=row.device)
        mask.view(-1).index_fill_(0, place, True)
        groups = TensorDict({MASK_KEY: mask}, batch_size=shape)
        ended = ~mask[:, : len(self)]
        for key, steps in zip(self.flow.kept, zip(*self._whole, strict=True), strict=True):
            value = torch.stack(steps, self.group.ndim).flatten(0, self.group.ndim - 1)
            value.masked_fill_(ended.view(*ended.shape, *(1,) * (value.ndim - 2)), 0)
            if len(self) < num_steps:
                padding = (0, 0) * (value.ndim - 2) + (0, num_steps - len(self))
                value = nn.functional.pad(value, padding)
            groups.set(key, value)
        for key, steps in zip(self.flow.decided, zip(*self._partial, strict=True), strict=True):
            value = torch.cat(steps)
            padded = value.new_zeros(mask.numel(), *value.shape[1:]).index_copy_(0, place, value)
            groups.set(key, padded.view(*shape, *value.shape[1:]))
        return groups


def _check_arguments(num_groups: int, group_size: int, options: dict[str, Any]) -> None:
    if group_size < 2 or num_groups < 1:
        raise ValueError(
            "Collecting groups needs num_groups of at least 1 and group_size of at least 2, got "
            f"num_groups={num_groups}, group_size={group_size}."
        )
    for name in options:
        if name in _REFUSED:
            raise TypeError(f"TrajectoryGroupCollector does not take {name}: {_REFUSED[name]}.")


def _accepted(options: dict[str, Any]) -> dict[str, Any]:
    """What TorchRL's collectors pass on to a worker, but for what groups leave no room for."""
    return {name: value for name, value in options.items() if name not in _REFUSED}


def _packer(options: dict[str, Any]) -> Callable[[TensorDictBase], TensorDict]:
    """What makes groups of the steps of workers."""
    return partial(pack_groups, group_size=options["group_size"], group_key=options["group_key"])


class _Worker:
    """Makes the collector of a worker process, which hands over its batches flat."""

    def __init__(self, num_workers: int, options: dict[str, Any]) -> None:
        self.restarted = torch.zeros(num_workers, dtype=torch.int64).share_memory_()
        self.options = options

    def __call__(self, *args: Any, **kwargs: Any) -> TrajectoryGroupCollector:
        collector = TrajectoryGroupCollector(*args, **{**_accepted(kwargs), **self.options})
        collector._yield_flat = True
        collector._restarted = self.restarted[kwargs["worker_idx"]]
        return collector


class _GroupsOfWorkers(MultiCollector):
    """What the collectors with worker processes share."""

    def __init__(self, *args: Any, num_groups: int, options: dict[str, Any], **kwargs: Any) -> None:
        """Start the workers, each for groups of `num_groups`."""
        create_env_fn = args[0]
        num_workers = len(create_env_fn)
        self._worker = _Worker(num_workers, {"num_groups": num_groups, **options})
        self._pack = _packer(options)
        total_frames = kwargs.pop("total_frames")
        writes = kwargs.get("replay_buffer") is not None
        # What a worker writes to a buffer it processes itself; what it hands over is packed first.
        self._process = None if writes else kwargs.pop("postproc", None)
        super().__init__(
            *args,
            frames_per_batch=num_workers,
            collector_class=self._worker,
            trajs_per_batch=1 if writes else None,  # has the storage made for flat steps
            **kwargs,
        )
        if total_frames >= 0:  # TorchRL's own setter warns unless it is a multiple of a batch
            self.total_frames = total_frames

    @property
    def restarted_trajectories(self) -> int:
        """Trajectories begun and thrown away because the weights changed within a batch."""
        return int(self._worker.restarted.sum())

    def _flatten(self, steps: TensorDictBase) -> Any:
        """Return the steps `[S]` that TorchRL's collector hands over."""
        return steps

    def _add_collector_outputs_to_fake_td(self, fake_td: TensorDictBase) -> TensorDictBase:
        """Describe a step as the workers write it, for the storage."""
        step = super()._add_collector_outputs_to_fake_td(fake_td)
        out_keys = getattr(self.policy, "out_keys", ())
        handed_on = (unravel_key(key[1:]) for key in out_keys if key[0] == "next")
        options = self._worker.options
        dropped = {*map(unravel_key, options["exclude_keys"]), *handed_on}
        return step.select(*_recorded_keys(step, dropped, options["compact_obs"]))

    def iterator(self) -> Iterator[TensorDictBase | None]:
        """Yield batches, or None after each that is written to the replay buffer."""
        buffer = self.replay_buffer
        start = 0 if buffer is None else buffer.write_count - self._frames
        for steps in super().iterator():  # pyright: ignore[reportAbstractUsage]
            if buffer is not None:
                self._frames = buffer.write_count - start
                yield None
                continue
            batch = self._pack(self._flatten(steps))
            yield batch if self._process is None else self._process(batch)


class _SyncGroups(_GroupsOfWorkers, SupervisedSyncCollector):
    """All workers' groups in one batch."""

    def _flatten(self, steps: TensorDictBase) -> Any:
        return TensorDict.cat(steps.unbind(0))  # one entry for each worker


class _AsyncGroups(_GroupsOfWorkers, SupervisedAsyncCollector):
    """One worker's groups in each batch."""


class _RayWorker(TrajectoryGroupCollector):
    """The collector of a Ray actor, which hands over its batches flat."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **_accepted(kwargs))
        self._yield_flat = True

    def __repr__(self) -> str:
        """Ray writes it before each line that an actor prints."""
        return f"worker {self.worker_idx}"


class _RayGroups(RayCollector):
    """All actors' groups in one batch.

    An actor does one thing after another, so that its weights never change within a batch.
    """

    def __init__(
        self,
        create_env_fn: Sequence[Callable[[], EnvBase]],
        policy: Any,
        *,
        num_groups: int,
        options: dict[str, Any],
        total_frames: int,
        **kwargs: Any,
    ) -> None:
        """Start the actors, each for groups of `num_groups`."""
        if kwargs.get("replay_buffer") is not None:
            raise TypeError("backend='ray' does not write to a replay_buffer: extend it yourself.")
        taken = inspect.signature(RayCollector.__init__).parameters
        passed_on = {key: kwargs.pop(key) for key in list(kwargs) if key not in taken}
        self._pack = _packer(options)
        super().__init__(
            list(create_env_fn),
            policy,
            frames_per_batch=len(create_env_fn),
            total_frames=total_frames,
            sync=True,
            collector_class=_RayWorker,
            # TorchRL writes into the dictionaries: one for each actor.
            collector_kwargs=[
                {"num_groups": num_groups, **options, **passed_on} for _ in create_env_fn
            ],
            **kwargs,
        )

    restarted_trajectories = 0

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Send the weights of the policy, or those given, to the actors.

        Raises:
            ChildProcessError: if an actor has died.
        """
        with self._watch():
            super().update_policy_weights_(*args, **kwargs)

    def _sync_iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches; their parts differ in length, which TorchRL's own cannot stack."""
        while not 0 <= self.total_frames <= self.collected_frames:
            with self._watch():
                tasks = [actor.next.remote() for actor in self.remote_collectors]
                parts = ray.get(tasks)
            for worker, part in enumerate(parts):  # each counts its trajectories for itself
                part.set(TRAJECTORY_KEY, part[TRAJECTORY_KEY] * len(parts) + worker)
            steps: Any = TensorDict.cat(parts)
            groups = self._pack(steps)
            self.collected_frames += int(groups[MASK_KEY].sum())
            yield groups

    @contextmanager
    def _watch(self) -> Iterator[None]:
        """Within, the death of an actor is an error that says what to do."""
        try:
            yield
        except (RuntimeError, ray.exceptions.RayActorError):
            for worker, actor in enumerate(self.remote_collectors):
                try:
                    ray.get(actor.__ray_ready__.remote(), timeout=10.0)
                except ray.exceptions.RayActorError as dead:
                    died = describe_death(worker, "died in the Ray cluster")
                    raise ChildProcessError(died) from dead
            raise


def _make_multi_collector(
    make: Callable[..., Any],
    create_env_fn: Callable[[], EnvBase] | Sequence[Callable[[], EnvBase]],
    policy: Any = None,
    *,
    num_collectors: int | None,
    is_sync: bool,
    num_groups: int,
    group_size: int,
    total_frames: int = -1,
    compact_obs: bool = True,
    exclude_keys: Sequence[NestedKey] = (),
    max_steps: int = 10_000,
    group_key: NestedKey = GROUP_KEY,
    **kwargs: Any,
) -> Any:
    _check_arguments(num_groups, group_size, kwargs)
    if not isinstance(create_env_fn, Sequence):
        create_env_fn = [create_env_fn] * (num_collectors or 1)
    num_workers = len(create_env_fn)
    if num_collectors not in (None, num_workers):
        raise ValueError(
            f"num_collectors={num_collectors} does not match the {num_workers} environment makers."
        )
    if is_sync and num_groups % num_workers:
        raise ValueError(
            f"num_groups={num_groups} must be a multiple of the number of workers, {num_workers}."
        )
    options = {
        "group_size": group_size,
        "compact_obs": compact_obs,
        "exclude_keys": exclude_keys,
        "max_steps": max_steps,
        "group_key": group_key,
    }
    kwargs.setdefault("auto_register_policy_transforms", True)
    return make(
        create_env_fn,
        policy,
        num_groups=num_groups // num_workers if is_sync else num_groups,
        options=options,
        total_frames=total_frames,
        **kwargs,
    )
