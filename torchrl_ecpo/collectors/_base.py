"""What the package's collectors share: players here or in workers, counted and fed with weights."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator
from types import NoneType
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import BaseCollector
from torchrl.data import ReplayBuffer

from torchrl_ecpo.checks import check_count, check_flag, check_kind, described
from torchrl_ecpo.collectors.workers import Workers, spawn_seeds
from torchrl_ecpo.groups import MASK_KEY, TRAJECTORY_KEY, unpack_groups


class PlayerCollector(BaseCollector):
    """A collector of TorchRL's whose batches are played by players.

    Args:
        policy: whose weights :meth:`update_policy_weights_` copies, unless others are given.
        total_frames: stop when this many real steps have been collected; -1: never.
        postproc: what is done to each batch before it is handed over or written.
        replay_buffer: where to write the steps of each batch, flat.
    """

    init_random_frames = 0
    _workers: Workers

    def __init__(
        self,
        policy: Any,
        total_frames: int,
        postproc: Callable[[Any], Any] | None = None,
        replay_buffer: ReplayBuffer | None = None,
    ) -> None:
        """Count from zero; who extends this makes `_workers`."""
        super().__init__()
        self._learner = self._moded = policy
        self._modes = _modes_of(policy)
        total_frames = check_count("total_frames", total_frames, least=-1)
        self.total_frames: float = float("inf") if total_frames < 0 else total_frames
        for name, value, kind in (
            ("policy", policy, Callable),
            ("postproc", postproc, Callable),
            ("replay_buffer", replay_buffer, ReplayBuffer),
        ):
            check_kind(name, value, kind, NoneType)
        self.postproc, self.replay_buffer = postproc, replay_buffer
        self.closed, self._frames, self._iter = False, 0, -1

    def rollout(self) -> Any:
        """Collect a batch, which is not counted nor written anywhere."""
        raise NotImplementedError

    def _play(self) -> list[Any]:
        """What the players collect, in the training mode that the policy has now."""
        modes = _modes_of(self._moded)
        if modes != self._modes:
            self._modes = modes
            self._workers.tell("set_training", modes)
        played = self._workers.play()
        for worker, batch in played:  # each counts its trajectories for itself
            ids, mask = batch.get(TRAJECTORY_KEY, None), batch.get(MASK_KEY, None)
            if ids is not None:
                ids = ids * len(self._workers) + worker
                batch.set(TRAJECTORY_KEY, ids if mask is None else ids * mask)
        return [batch for _, batch in played]

    def iterator(self) -> Iterator[Any]:
        """Yield batches, or None after each that is written to the replay buffer.

        Raises:
            ChildProcessError: if a worker has died.
            RuntimeError: after :meth:`shutdown`.
        """
        while self._frames < self.total_frames:
            if self.closed:
                raise RuntimeError("The collector was shut down: make another one.")
            self._iter += 1
            if self.pre_collect_hook is not None:
                self.pre_collect_hook()
            batch = self.rollout()
            mask = batch.get(MASK_KEY, None)
            self._frames += batch.numel() if mask is None else int(mask.sum())
            batch = batch if self.replay_buffer is None else unpack_groups(batch)
            batch = batch if self.postproc is None else self.postproc(batch)
            if self.post_collect_hook is not None:
                self.post_collect_hook(batch)
            if self.replay_buffer is None:
                yield batch
            else:
                self.replay_buffer.extend(batch)
                yield None

    def update_policy_weights_(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, policy_or_weights: Any = None, *, weights_dict: dict[str, Any] | None = None
    ) -> None:
        """Copy the weights of the policy, or those given, to the reference that acts.

        They count from the next batch. With workers that do not wait, that is the next one begun.
        The training mode of the policy, ``policy.eval()``, follows by itself.

        Args:
            policy_or_weights: the weights, or a module that has them. Default: the policy.
            weights_dict: the same as TorchRL's trainers may give it, ``{"policy": weights}``.
        """
        if weights_dict is not None:
            if policy_or_weights is not None or [*weights_dict] != ["policy"]:
                raise ValueError("update_policy_weights_ takes the weights of one policy, once.")
            policy_or_weights = weights_dict["policy"]
        source = self._learner if policy_or_weights is None else policy_or_weights
        if isinstance(source, nn.Module) and not isinstance(source, TensorDictBase):
            self._moded = source
            source = TensorDict.from_module(source)
        if isinstance(source, TensorDictBase):
            self._workers.set_weights(source.data)
        elif source is not self._learner:  # which may be a function, without weights
            raise TypeError(
                "policy_or_weights must be a module or a TensorDict of weights, got "
                f"{described(source)}."
            )

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the environments, those of several workers differently; return a seed to go on."""
        seed = check_count("seed", seed, least=0)
        static_seed = check_flag("static_seed", static_seed)
        several = len(self._workers) > 1
        seeds = spawn_seeds(seed, len(self._workers)) if several else [seed]
        return self._workers.call("set_seed", seeds, [static_seed] * len(seeds))[-1]

    def state_dict(self) -> OrderedDict[str, Any]:
        """The policy, the environment and the counters, between two batches.

        Of workers that do not wait, the batches that are under way are left out.
        """
        players = self._workers.call("state_dict")
        return OrderedDict(players=players, frames=self._frames, iter=self._iter)

    def load_state_dict(self, state_dict: OrderedDict[str, Any]) -> None:
        """Go on from what :meth:`state_dict` returned."""
        frames = check_count("frames", state_dict["frames"], least=0)
        count = check_count("iter", state_dict["iter"], least=-1)
        players = state_dict["players"]
        if len(players) != len(self._workers):
            raise ValueError(
                f"players must hold the state of each of {len(self._workers)} workers, got "
                f"{len(players)}. Make the collector with as many as it had."
            )
        self._workers.call("load_state_dict", players)
        self._workers.forget()
        self._frames, self._iter = frames, count

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """End the workers, within `timeout` seconds (default: 5), or close the environment."""
        del close_env, raise_on_error  # as TorchRL calls it
        if not self.closed:
            self.closed = True
            self._workers.stop(timeout)


def check_makers(makers: list[Any], *others: Any) -> None:
    """Refuse what makes no environment."""
    if not makers:
        raise ValueError("create_env_fn must hold a maker of an environment for each worker.")
    for maker in makers:
        check_kind("create_env_fn", maker, Callable, *others)


def _modes_of(policy: Any) -> dict[str, bool]:
    """Whether each module of a policy is in training mode."""
    is_module = isinstance(policy, nn.Module)
    return {name: m.training for name, m in policy.named_modules()} if is_module else {}
