"""Playing groups of trajectories to their ends, in this process.

Shapes: `G` groups, `K` trajectories of each, `T` steps of the longest one, `S` steps of all
trajectories together; the environment has the batch size `[*B, K]`, `N = prod(B) * K` rows.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import nullcontext
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.data import NonTensor
from torchrl.envs import (
    Compose,
    EnvBase,
    InitTracker,
    TransformedEnv,
    VecNorm,
    VecNormV2,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    OrnsteinUhlenbeckProcessModule,
    RandomPolicy,
    get_env_transforms_from_module,
    set_exploration_modules_spec_from_env,
)

from torchrl_ecpo.checks import check_count, check_flag, check_keys, check_kind, described
from torchrl_ecpo.collectors.workers import set_training
from torchrl_ecpo.envs._groups import check_action_shape
from torchrl_ecpo.groups import GROUP_KEY, MASK_KEY, TRAJECTORY_KEY
from torchrl_ecpo.modules import record_latents


class GroupPlayer:
    """Plays complete groups; its policy changes between two batches, never within one.

    :class:`~torchrl_ecpo.collectors.TrajectoryGroupCollector` describes the arguments. The policy
    is the player's: it is not copied.
    """

    def __init__(
        self,
        create_env_fn: EnvBase | Callable[[], EnvBase],
        policy: Callable[[Any], Any] | None = None,
        *,
        num_groups: int,
        group_size: int,
        compact_obs: bool = True,
        exclude_keys: Collection[NestedKey] = (),
        max_steps: int = 10_000,
        group_key: NestedKey = GROUP_KEY,
        exploration_type: Any = ExplorationType.RANDOM,
        policy_device: torch.device | str | None = None,
    ) -> None:
        """Make the environment."""
        self.num_groups, self.group_size, self.group_key = num_groups, group_size, group_key
        self.compact_obs = check_flag("compact_obs", compact_obs)
        self.exclude_keys = set(check_keys("exclude_keys", exclude_keys) if exclude_keys else ())
        self.max_steps = check_count("max_steps", max_steps)
        try:
            set_exploration_type(exploration_type)
        except ValueError as error:
            raise ValueError(f"exploration_type: {error}.") from None
        self.exploration_type = exploration_type
        self.policy_device = policy_device
        env = create_env_fn if isinstance(create_env_fn, EnvBase) else create_env_fn()
        check_kind("What create_env_fn makes", env, EnvBase)
        self._check_env(env)
        self.policy: Any = RandomPolicy(env.full_action_spec) if policy is None else policy
        if isinstance(self.policy, RandomPolicy):
            self.policy.set_action_spec_from_env(env)
        elif isinstance(self.policy, nn.Module):
            self.policy.to(policy_device)
            record_latents(self.policy)
            set_exploration_modules_spec_from_env(self.policy, env)
        # What the policy needs acts at resets alone. In a step it would cost as much as all else
        # around the rules of a fast environment.
        self.env, self._reset_env = env, _with_transforms(env, self.policy)
        read = [] if isinstance(self.policy, RandomPolicy) else getattr(policy, "in_keys", None)
        self._read = None if read is None else {*map(unravel_key, read), *_read_unsaid(policy)}
        own = env.full_observation_spec.keys(True, True)
        added = self._reset_env.full_observation_spec.keys(True, True)
        self._first_keys = [k for k in added if k not in own and _path(k)[-1] == "is_init"]
        self._flow: _Flow | None = None
        self._next_id = 0
        with torch.no_grad():
            self._reset_env.reset()  # an environment that fails does so here

    def _check_env(self, env: EnvBase) -> None:
        batch = env.batch_size
        if not batch or batch[-1] != self.group_size:
            raise ValueError(
                f"The environment must have the batch size [*B, group_size={self.group_size}], got "
                f"{tuple(batch)}. make_grouped_env makes groups of any environment."
            )
        if self.num_groups % (batch.numel() // self.group_size):
            raise ValueError(
                f"A player's share of num_groups, {self.num_groups}, must be a multiple of the "
                f"groups that its environment plays at a time, {batch.numel() // self.group_size}."
            )
        specs = dict(env.full_observation_spec.items(True, True))
        if self.group_key not in [*specs]:
            raise KeyError(
                f"The environment has no group_key {self.group_key!r}, the problem instance of "
                f"each row; it has {sorted(map(str, specs))}. GroupedEnv adds it to any."
            )
        if "done" not in env.done_keys:
            raise KeyError(f"The environment must have one 'done' a row, it has {env.done_keys}.")
        for module in env.modules():
            if isinstance(module, (VecNorm, VecNormV2)) and not getattr(module, "frozen", False):
                raise ValueError(
                    f"{type(module).__name__} would count trajectories that have ended, which wait "
                    "for the longest. Let it see one environment alone, and freeze() it."
                )
        texts = [key for key, spec in specs.items() if isinstance(spec, NonTensor)]
        if texts:
            raise TypeError(
                f"Only tensors are collected, but the environment writes {texts}. Leave them out "
                "with TorchRL's ExcludeTransform, or sample by a loop of your own: pack_groups "
                "keeps them."
            )

    set_training = set_training

    def set_weights(self, weights: TensorDictBase) -> None:
        """Copy weights to the policy, between two batches."""
        own: Any = TensorDict.from_module(self.policy)
        own.data.update_(weights)

    def set_seed(self, seed: int, static_seed: bool) -> int | None:
        """Seed the environment; return the seed for the next one."""
        return self.env.set_seed(seed, static_seed=static_seed)

    def state_dict(self) -> dict[str, Any]:
        """The policy, the environment and the next trajectory id, between two batches."""
        state = {"env": [env.state_dict() for env in self._levels()], "next_id": self._next_id}
        if isinstance(self.policy, nn.Module):
            state["policy"] = self.policy.state_dict()
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from what :meth:`state_dict` returned."""
        next_id = check_count("next_id", state_dict["next_id"], least=0)
        for env, state in zip(self._levels(), state_dict["env"], strict=True):
            env.load_state_dict(state)
        self._next_id = next_id
        if isinstance(self.policy, nn.Module):
            self.policy.load_state_dict(state_dict["policy"])

    def _levels(self) -> list[EnvBase]:
        """The environment inside its transforms, then with each: a state dict has one level."""
        levels = [self._reset_env]
        while isinstance(env := levels[0], TransformedEnv):
            levels.insert(0, env.base_env)
        return levels

    def close(self) -> None:
        """Close the environment."""
        if not self.env.is_closed:
            self.env.close()

    @torch.no_grad()
    def play(self) -> TensorDictBase:
        """Return a batch of groups `[G, K, T]`, with zeros after the end of a trajectory."""
        steps: list[_Step] = []
        groups: list[Tensor] = []
        constant_weights = getattr(self.policy, "constant_weights", nullcontext)
        with set_exploration_type(self.exploration_type), constant_weights():
            for _ in range(self.num_groups * self.group_size // self.env.batch_size.numel()):
                groups.append(self._play_round(steps, sum(map(len, groups))))
        assert self._flow is not None
        batch = _pad(steps, self._flow, sum(map(len, groups)), self.env.ndim)
        mask = batch[MASK_KEY]
        ids = torch.arange(self._next_id, self._next_id + len(mask), device=mask.device)
        self._next_id += len(mask)
        batch.set(TRAJECTORY_KEY, ids.unsqueeze(-1) * mask)
        batch.set(self.group_key, torch.cat(groups).unsqueeze(-1) * mask)
        laid_out: Any = batch.unflatten(0, (self.num_groups, self.group_size))
        return laid_out

    def _play_round(self, steps: list[_Step], first: int) -> Tensor:
        """Play trajectories `first` to `first + N`, one in each row; return their groups `[N]`."""
        root = self._reset_env.reset()
        group = self._check_groups(root)
        seen = root.copy() if self._read is None else root.select(*self._read, strict=False)
        rows = torch.arange(len(group), device=group.device)  # those that go on
        places: tuple[Tensor, Tensor] | None = None  # None: all go on
        for time in range(self.max_steps):
            acted = self._act(seen, rows)
            step = self.env.step(self._set_inputs(root, acted, places))
            flow = self._flow = self._flow or self._trace_flow(step, acted)
            entries = dict(step.items(True, True))  # quicker than one by one
            kept = [entries[key] for key in flow.kept]
            decided = [acted.get(key).flatten(0, acted.ndim - 1) for key in flow.decided]
            steps.append(_Step(first, time, rows, kept, decided))
            done = entries["next", "done"].reshape(-1).index_select(0, rows)
            going_on = done.logical_not_().nonzero().squeeze(-1)
            if not len(going_on):
                return group
            root = self.env.step_mdp(step)
            if time == 0:
                root.update({key: torch.zeros_like(root[key]) for key in self._first_keys})
            if len(going_on) == len(rows):
                going_on = None
            else:
                rows = rows.index_select(0, going_on)
                places = _find_places(rows, len(group))
            seen = _show(root, acted, None if places is None else rows, going_on, flow)
        raise RuntimeError(
            f"{len(rows)} trajectories, the first one of group {int(group[rows[0]])}, have not "
            f"ended after max_steps={self.max_steps} steps. Limit their length: append "
            "StepCounter(max_steps=...) to the environment."
        )

    def _check_groups(self, root: TensorDictBase) -> Tensor:
        group = root[self.group_key]
        is_laid_out = group.shape in (root.shape, (*root.shape, 1))
        rows = group.reshape(-1, self.group_size) if is_laid_out else None
        if rows is None or (rows != rows[:, :1]).any() or len(rows[:, 0].unique()) < len(rows):
            raise ValueError(
                f"After a reset, {self.group_key!r} must be one integer for each row, equal for "
                f"the group_size={self.group_size} copies of an instance and different from those "
                f"of the others, got {group.tolist()}."
            )
        return group.reshape(-1)

    def _act(self, seen: TensorDictBase, rows: Tensor) -> TensorDictBase:
        """Let the policy act on what it sees of the rows `[n]` that go on."""
        if isinstance(self.policy, RandomPolicy):
            action = self.policy(TensorDict(batch_size=self.env.batch_size, device=seen.device))
            return seen.update(action if len(rows) == action.numel() else action.reshape(-1)[rows])
        if self.policy_device is None:
            return self.policy(seen)
        return self.policy(seen.to(self.policy_device)).to(rows.device)

    def _check_actions(self, acted: TensorDictBase) -> None:
        """Refuse what is no action, and an index where the environment reads one-hot."""
        if not isinstance(acted, TensorDictBase):
            raise TypeError(
                "The policy must return the TensorDict that it is given, with the entries "
                f"{self.env.action_keys}, got {described(acted)}. Wrap a network that returns a "
                "tensor: TensorDictModule(network, in_keys=[...], out_keys=[...])."
            )
        for key, spec in self.env.full_action_spec.items(True, True):
            action = acted.get(key, None)
            if action is not None:
                check_action_shape(key, action, spec)

    def _set_inputs(
        self, root: TensorDictBase, acted: TensorDictBase, places: tuple[Tensor, Tensor] | None
    ) -> TensorDictBase:
        """Let the rows act that go on; the others act as some other one, to no effect."""
        if self._flow is None:
            self._check_actions(acted)
            return root.update(acted.select(*_acted_on(self.env), strict=False))
        for key in self._flow.inputs:
            value = acted.get(key)
            if places is not None:
                value = value.index_select(0, places[1]).unflatten(0, root.batch_size)
            root.set(key, value)
        if places is not None:
            root.set("_step", places[0].view(*root.batch_size, 1))
        return root

    def _trace_flow(self, step: TensorDictBase, acted: TensorDictBase) -> _Flow:
        """Decide from the first step which entries are acted on, carried over and recorded."""
        every = set(step.keys(True, True))
        given = {key for key in every if key[0] != "next"}
        result = {unravel_key(key[1:]) for key in every - given}
        written = set(acted.keys(True, True))
        handed = {key for key in written if key[0] == "next"}
        # What the environment observes counts, as in TorchRL's collector; primers, whose entries
        # are its state too, only pass on.
        own = self._levels()[0]
        observed = set(own.full_observation_spec.keys(True, True))
        observed -= set(own.full_state_spec.keys(True, True))
        carried = {own: key for key in handed if (own := unravel_key(key[1:])) not in observed}
        named = map(unravel_key, getattr(self.policy, "out_keys", self.env.action_keys))
        written -= handed | given.difference(named)
        # A memory under one name: what is recorded would be that after the step, and what a loss
        # reads there is that before it.
        said = map(unravel_key, getattr(self.policy, "in_keys", None) or ())
        primed = set(self.env.full_state_spec.keys(True, True))
        others = set(self.env.full_observation_spec.keys(True, True)) - primed
        memory = written.intersection(said) - others - {*self.env.action_keys}
        dropped = self.exclude_keys | carried.keys() | memory
        read = given | written
        if self._read is not None:
            read = {key for key in read if _is_below(key, self._read)}
        carried |= {key: key for key in (written & read) - result - carried.keys()}
        kept = [
            key
            for key in (*step.keys(True, True), *sorted(written - every, key=str))
            if not _is_left_out(key, dropped, every | written if self.compact_obs else set())
        ]
        return _Flow(
            inputs=[key for key in _acted_on(self.env) if key in written],
            shown=[key for key in given & read if key not in carried],
            carried=carried,
            kept=[key for key in kept if key not in written and key != self.group_key],
            decided=[key for key in kept if key in written],
        )


class _Flow(NamedTuple):
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


class _Step(NamedTuple):
    """What is recorded of a step in `N` rows; which of them count is sorted out at the end."""

    first: int
    """The trajectory in row 0."""
    time: int
    rows: Tensor
    """Those that had not ended, `[n]`."""
    kept: list[Tensor]
    """`[*B, K, *]` each."""
    decided: list[Tensor]
    """`[n, *]` each."""


def _read_unsaid(policy: Any) -> list[NestedKey]:
    """What modules read beside their ``in_keys``: a process of noise, where it stands."""
    modules = policy.modules() if isinstance(policy, nn.Module) else ()
    noises = [each for each in modules if isinstance(each, OrnsteinUhlenbeckProcessModule)]
    return [key for noise in noises for key in (noise.is_init_key, *noise.ou.out_keys)]


def _acted_on(env: EnvBase) -> list[NestedKey]:
    specs = (env.full_action_spec, env.full_state_spec)
    return [key for spec in specs for key in spec.keys(True, True)]


def _with_transforms(env: EnvBase, policy: Any) -> EnvBase:
    """Add what marks a first step, and the primers of a recurrent policy, unless `env` has them."""
    if not isinstance(policy, nn.Module):
        return env
    specs = (env.full_observation_spec, env.full_state_spec)
    present = {key for spec in specs for key in spec.keys(True, True)}
    transforms, missing = [get_env_transforms_from_module(policy)], []
    for transform in transforms:
        if isinstance(transform, Compose):
            transforms.extend(part.clone() for part in transform)
            continue
        if isinstance(transform, InitTracker):
            is_there = any(_path(key)[-1] == "is_init" for key in present)
        else:
            is_there = present.issuperset(transform.primers.keys(True, True))
        if not is_there:
            missing.append(transform)
    return TransformedEnv(env, Compose(*missing), auto_unwrap=False) if missing else env


def _path(key: Any) -> tuple[str, ...]:
    return key if isinstance(key, tuple) else (key,)


def _is_below(key: NestedKey, entries: Collection[NestedKey]) -> bool:
    """Whether an entry, or one that it is nested in, is among `entries`."""
    path = _path(key)
    return any(unravel_key(path[: i + 1]) in entries for i in range(len(path)))


def _is_left_out(
    key: NestedKey, dropped: Collection[NestedKey], doubled: Collection[NestedKey]
) -> bool:
    """Whether a batch does not keep an entry: it is dropped, private, or the next step's again.

    An observation of `doubled` is kept where it is acted upon and not where it results.
    """
    path = _path(key)
    if any(part.startswith("_") for part in path) or _is_below(key, dropped):
        return True
    if path[0] != "next":
        return False
    entry = unravel_key(path[1:])
    is_done = path[-1] in ("done", "terminated", "truncated")
    return _is_below(entry, dropped) or (entry in doubled and not is_done)


def _find_places(rows: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Of `size` rows, which are among `rows` `[n]`, and at which place, 0 for the others."""
    mask = torch.zeros(size, dtype=torch.bool, device=rows.device).index_fill_(0, rows, True)
    place = torch.zeros(size, dtype=torch.int64, device=rows.device)
    return mask, place.index_copy_(0, rows, torch.arange(len(rows), device=rows.device))


def _choose(entry: Tensor, rows: Tensor | None, ndim: int) -> Tensor:
    """Rows `[n]`, None for all, of an entry with `ndim` batch dimensions, counted over them all."""
    entry = entry.flatten(0, ndim - 1)
    return entry if rows is None else entry.index_select(0, rows)


def _show(
    root: TensorDictBase,
    acted: TensorDictBase,
    rows: Tensor | None,
    going_on: Tensor | None,
    flow: _Flow,
) -> TensorDictBase:
    """What the policy sees next: the environment's entries, then what it hands to itself.

    `root` has all rows, of which `rows` `[n]` go on; `acted` has those that were active before, of
    which `going_on` `[n]` go on; None for all.
    """
    if rows is None:
        seen = {key: root.get(key) for key in flow.shown}
        seen |= {key: acted.get(source) for key, source in flow.carried.items()}
        return TensorDict(seen, batch_size=root.batch_size, device=root.device)
    seen = {key: _choose(root.get(key), rows, root.ndim) for key in flow.shown}
    for key, source in flow.carried.items():
        seen[key] = _choose(acted.get(source), going_on, acted.ndim)
    return TensorDict(seen, batch_size=rows.shape, device=root.device)


def _pad(steps: list[_Step], flow: _Flow, num_trajectories: int, ndim: int) -> TensorDictBase:
    """Lay out trajectories as `[G * K, T]`, with their mask and zeros after their ends."""
    shape = torch.Size([num_trajectories, max(step.time for step in steps) + 1])
    place = torch.cat([(step.first + step.rows) * shape[1] + step.time for step in steps])
    mask = torch.zeros(shape.numel(), dtype=torch.bool, device=place.device)
    batch = TensorDict({MASK_KEY: mask.index_fill_(0, place, True).view(shape)}, batch_size=shape)

    def write(key: NestedKey, value: Tensor) -> None:
        padded = value.new_zeros(len(mask), *value.shape[1:]).index_copy_(0, place, value)
        batch.set(key, padded.view(*shape, *value.shape[1:]))

    num_rows = len(steps[0].rows)
    source = torch.cat([step.rows + i * num_rows for i, step in enumerate(steps)])
    for key, *values in zip(flow.kept, *(step.kept for step in steps), strict=True):
        write(key, torch.cat(values).flatten(0, ndim - 1).index_select(0, source))
    for key, *values in zip(flow.decided, *(step.decided for step in steps), strict=True):
        write(key, torch.cat(values))
    return batch
