"""A collector that yields complete trajectory groups.

Shapes: `G` groups, `K` trajectories of each, `T` steps of the longest one; the environment has the
batch size `[*B, K]` with `prod(B)` groups.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import partial
from typing import Any

from tensordict import TensorDict, TensorDictBase, pad
from torch import nn
from torch.nn.parameter import is_lazy
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from torchrl_ecpo.checks import check_choice, check_count, check_flag, check_group_size
from torchrl_ecpo.collectors._base import PlayerCollector, check_makers
from torchrl_ecpo.collectors.rollout import GroupPlayer
from torchrl_ecpo.collectors.workers import Workers

# Arguments of TorchRL's collectors that group collection leaves no room for, and why.
_REFUSED = {
    "frames_per_batch": "a batch is counted in groups: num_groups and group_size",
    "trajs_per_batch": "a batch is counted in groups: num_groups and group_size",
    "split_trajs": "trajectories are not split",
    "init_random_frames": "every action comes from the policy",
    "set_truncated": "trajectories are never cut at the end of a batch",
    "reset_at_each_iter": "all trajectories of a batch start with it",
    "create_env_kwargs": "bind them to the maker, functools.partial(make, **kwargs)",
    "trust_policy": "a policy is called as it is, with a TensorDict",
    "auto_register_policy_transforms": "what the policy needs of the environment is always added",
    "compile_policy": "the number of rows that the policy sees changes",
    "cudagraph_policy": "the number of rows that the policy sees changes",
    "device": "say policy_device, and move the environment to its own",
    "env_device": "move the environment, env.to(device)",
    "storing_device": "move the batches, postproc=lambda batch: batch.to(device)",
    "policy_factory": "policies travel to the workers by value",
    "max_frames_per_traj": "append StepCounter(max_steps=...) to the environment",
    "weight_sync_schemes": "workers are sent the weights with their next batch",
}
# Options of the players, after what the collector itself is told.
_OF_PLAYERS = [*inspect.signature(GroupPlayer).parameters][4:]


class TrajectoryGroupCollector(PlayerCollector):
    """Collects complete groups: `K` trajectories of each of `G` problem instances, `[G, K, T]`.

    One of TorchRL's collectors, for its trainers too, which:

    - yields batches `[G, K, T]` padded to the longest trajectory, with ``("collector", "mask")``,
      or, given a `replay_buffer`, writes their steps flat, for
      :class:`~torchrl_ecpo.groups.TrajectoryGroupSampler`;
    - is on-policy by the letter of Algorithm 1: all trajectories of a batch come from the same
      weights. The collector samples from a copy of the policy, the reference, which changes only
      when :meth:`update_policy_weights_` is called, on every backend, and with the next batch: one
      that is being played keeps its weights. Its training mode is that of the policy at each batch;
    - records the latents of squashed actions, ``"action_latent"``, which a loss evaluates
      (:func:`~torchrl_ecpo.modules.record_latents`);
    - spends nothing on trajectories that have ended: the policy sees the rows of the others, and
      the environment gets ``"_step"``. Nothing runs across batches, so nothing is thrown away;
    - sees to what a recurrent policy needs: the environment may lack `InitTracker` and primers.
      What the collector adds for the policy acts at a reset only; ``is_init`` and what the policy
      hands to its own next step then travel without passing through the environment.

    A batch keeps what the environment and the policy wrote at each step, with two exceptions. What
    the policy hands to its own next step is left out: ``("next", ...)``, such as the state of an
    LSTM, and a memory that its keys name both as read and as written. A loss recomputes it from
    ``is_init``: only modules with a recurrent mode can be evaluated again. Of the environment's
    ``("next", ...)``, by default only reward and done flags stay (`compact_obs`).

    Behind a policy, an exploration module (``EGreedyModule``, ``AdditiveGaussianModule``) changes
    the action and not the log-probability, which stays that of the action before the noise: losses
    over groups are wrong for such batches.

    Args:
        create_env_fn: the environment, or what makes it, of batch size `[*B, K]`; a list of makers
            for as many workers. Workers need makers, which travel by value.
        policy: what acts, a ``TensorDictModule`` or what takes and returns a TensorDict. Default:
            random actions.
        num_groups: `G`, a multiple of the environment's `prod(B)` (of all workers', with `sync`).
        group_size: `K`, at least 2.
        backend: ``"direct"``, in this process, ``"process"``, in worker processes, or ``"ray"``, in
            the actors of a Ray cluster. Default: worker processes if they are asked for.
        backend_options: for Ray, `ray_init_config` (what ``ray.init`` takes) and `remote_configs`
            (what an actor needs, as ``ray.remote`` takes it).
        num_collectors: the number of workers. Default: that of a list of makers, or one.
        sync: with workers, whether a batch is made of all workers' groups, collected at the same
            time (True), or of those of one worker, while the others go on (False, the default, as
            TorchRL's). With False, `G` is that of each worker's batch, which may come from weights
            before the last update, though never from those of two.
        total_frames: stop when this many real steps have been collected. Default: -1, never.
        compact_obs: whether to leave observations out of ``"next"``: they are those of the next
            step. Default: True. A critic that needs the last one wants False.
        exclude_keys: more entries to leave out, with what is nested in them, such as logits and
            features that a loss computes itself.
        max_steps: the length at which a trajectory is taken to be endless. Default: 10,000.
        group_key: the environment's key of the problem instance.
        exploration_type: how actions are drawn. Default: TorchRL's, at random.
        postproc: what is done to each batch before it is handed over or written.
        replay_buffer: where to write the steps of each batch, flat; None is yielded instead.
        policy_device: of the policy, which acts there. Default: where it is.

    Raises:
        TypeError: for an argument that does not go with groups or is of another class, and for an
            environment that writes anything but tensors.
        ValueError: if `K` is below 2 or not the environment's, if `G` is no multiple, or if the
            environment makes groups of another size; for a ``VecNorm`` that is not frozen, which
            would count ended trajectories.
        KeyError: if the environment has no `group_key`.
        RuntimeError: if a trajectory does not end within `max_steps`.
        ChildProcessError: if a worker dies.

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
        postproc: Callable[[TensorDictBase], TensorDictBase] | None = None,
        replay_buffer: ReplayBuffer | None = None,
        **options: Any,
    ) -> None:
        """Make the collector; the class describes the arguments."""
        for name in options.keys() & _REFUSED.keys():
            raise TypeError(f"TrajectoryGroupCollector does not take {name}: {_REFUSED[name]}.")
        if unknown := options.keys() - {*_OF_PLAYERS}:
            raise TypeError(
                f"TrajectoryGroupCollector has no option {', '.join(sorted(unknown))}; beside its "
                f"own it has {', '.join(_OF_PLAYERS)}."
            )
        num_groups = check_count("num_groups", num_groups)
        group_size = check_group_size(group_size)
        check_flag("sync", sync, None)
        if num_collectors is not None:
            num_collectors = check_count("num_collectors", num_collectors)
        backend, makers = _find_makers(create_env_fn, backend, num_collectors, sync)
        if backend_options is not None and backend != "ray":
            raise ValueError(f"backend_options are for backend='ray', got them for {backend!r}.")
        share, left = divmod(num_groups, len(makers) if sync else 1)
        if left:
            raise ValueError(
                f"num_groups={num_groups} must be a multiple of the number of workers, "
                f"{len(makers)}."
            )
        _check_policy(policy)
        super().__init__(policy, total_frames, postproc, replay_buffer)
        self.num_groups, self.group_size = num_groups, group_size
        self.requested_frames_per_batch = num_groups * group_size  # at least
        is_here = backend == "direct"
        options |= {"num_groups": share, "group_size": group_size}
        is_copied = is_here and isinstance(policy, nn.Module)  # what travels is a copy
        options["policy"] = deepcopy(policy) if is_copied else policy
        players = [partial(GroupPlayer, maker, **options) for maker in makers]
        self._workers = Workers(
            players, backend, sync=is_here or bool(sync), **(backend_options or {})
        )
        if is_here:
            self.policy, self.env = self._workers.player.policy, self._workers.player.env

    def rollout(self) -> TensorDictBase:
        """Collect a batch of groups `[G, K, T]`, which is not counted nor written anywhere."""
        played = self._play()
        if len(played) == 1:
            return played[0]
        num_steps = max(batch.shape[-1] for batch in played)
        padding = [[0, 0, 0, 0, 0, num_steps - batch.shape[-1]] for batch in played]
        parts = [pad(batch, own) for batch, own in zip(played, padding, strict=True)]
        groups: Any = TensorDict.cat(parts)
        return groups


def _check_policy(policy: Any) -> None:
    """Refuse a policy whose copy would draw other weights."""
    if isinstance(policy, nn.Module) and any(map(is_lazy, policy.parameters())):
        raise ValueError(
            "The policy has lazy layers, whose weights do not exist yet: the collector's copy "
            "would draw others. Call it once before, policy(env.reset())."
        )


def _find_makers(
    create_env_fn: Any, backend: str | None, num_collectors: int | None, sync: bool | None
) -> tuple[str, list[Any]]:
    """Return the backend, and what makes the environment of each worker, or is it."""
    several = isinstance(create_env_fn, Sequence) and not isinstance(create_env_fn, str)
    makers = list(create_env_fn) if several else [create_env_fn] * (num_collectors or 1)
    check_makers(makers, EnvBase)
    has_workers = several or num_collectors is not None
    if backend is None:
        backend = "process" if has_workers else "direct"
    check_choice("backend", backend, ("direct", "process", "ray"))
    if backend == "direct" and (has_workers or sync is not None):
        raise ValueError(
            "sync, num_collectors and lists of environment makers are for workers: sync needs "
            "num_collectors, the number of workers."
        )
    if num_collectors not in (None, len(makers)):
        raise ValueError(
            f"num_collectors={num_collectors} does not match the {len(makers)} environment makers."
        )
    if backend != "direct" and any(isinstance(maker, EnvBase) for maker in makers):
        raise TypeError("Workers make their environments: pass functions that do, got an EnvBase.")
    return backend, makers
