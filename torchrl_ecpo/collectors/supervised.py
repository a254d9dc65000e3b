"""TorchRL's ``Collector`` in several worker processes, the death of which is an error at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from torchrl_ecpo.checks import check_count, check_kind
from torchrl_ecpo.collectors._base import PlayerCollector, check_makers
from torchrl_ecpo.collectors.workers import Workers, set_training


class _FramePlayer(Collector):
    """TorchRL's collector, called as the players are."""

    play = Collector.next
    set_weights = Collector.update_policy_weights_
    set_training = set_training
    close = Collector.shutdown


class SupervisedSyncCollector(PlayerCollector):
    """TorchRL's ``Collector`` in worker processes, all of which play each batch.

    As TorchRL's ``MultiSyncCollector``; yet a worker takes new weights between two batches, the
    death of one is a ``ChildProcessError`` at once, its errors are raised here, and a batch is flat
    ``[frames]``, worker by worker, for replay buffers. Value estimators need the time dimension
    last: ``batch.reshape(num_workers, -1)``, if the environments have no batch size.

    Args:
        create_env_fn: a maker of an environment for each worker; they travel by value.
        policy: what acts, as ``Collector`` takes it.
        frames_per_batch: `B`, of which the workers play equal shares.
        total_frames: stop when this many have been collected. Default: -1, never.
        init_random_frames: how many actions are random at first, over all workers. Default: 0.
        postproc: called with each batch, in this process. Default: None.
        replay_buffer: extended by each batch, in place of which None is yielded. Default: None.
        options: what else ``Collector`` takes, but for ``split_trajs=True``.

    Raises:
        TypeError: if `create_env_fn` is no sequence of functions, or `policy` no function.
        ValueError: for numbers of frames that are none, and for ``split_trajs=True``.
        ChildProcessError: if a worker dies.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> makers = [lambda: GymEnv("Pendulum-v1")] * 2
        >>> collector = SupervisedSyncCollector(makers, frames_per_batch=8)  # doctest: +SKIP
        >>> with shut_down(collector):  # doctest: +SKIP
        ...     next(iter(collector)).numel()
        8
    """

    _sync = True

    def __init__(
        self,
        create_env_fn: Sequence[Callable[[], EnvBase]],
        policy: Callable[[TensorDictBase], TensorDictBase] | None = None,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        init_random_frames: int = 0,
        postproc: Callable[[Any], Any] | None = None,
        replay_buffer: ReplayBuffer | None = None,
        **options: Any,
    ) -> None:
        """Start the workers; the class describes the arguments."""
        super().__init__(policy, total_frames, postproc, replay_buffer)
        if options.get("split_trajs"):
            raise ValueError(
                "split_trajs must be left out, for a batch is flat [frames], got "
                f"{options['split_trajs']!r}. TorchRL's MultiSyncCollector splits trajectories."
            )
        frames_per_batch = check_count("frames_per_batch", frames_per_batch)
        init_random_frames = check_count("init_random_frames", init_random_frames, least=0)
        check_kind("create_env_fn", create_env_fn, Sequence)
        check_makers([*create_env_fn])
        num_workers = len(create_env_fn)
        shares = num_workers if self._sync else 1
        self.policy, self.init_random_frames = policy, init_random_frames
        self.requested_frames_per_batch = frames_per_batch
        options |= {
            "policy": policy,
            "frames_per_batch": -(frames_per_batch // -shares),
            "init_random_frames": -(init_random_frames // -num_workers),
        }
        players = [partial(_FramePlayer, make, **options) for make in create_env_fn]
        self._workers = Workers(players, sync=self._sync)

    def rollout(self) -> Any:
        """Collect a batch of frames `[B]`, worker by worker."""
        return TensorDict.cat([frames.reshape(-1) for frames in self._play()])


class SupervisedAsyncCollector(SupervisedSyncCollector):
    """The same, but each batch is one worker's, while the others go on.

    As TorchRL's ``MultiAsyncCollector``: a batch may come from weights before the last update. It
    is flat ``[frames]`` too, so that of environments without a batch size it is one row of time.

    Raises:
        ValueError: as :class:`SupervisedSyncCollector`.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> makers = [lambda: GymEnv("Pendulum-v1")] * 2
        >>> collector = SupervisedAsyncCollector(makers, frames_per_batch=8)  # doctest: +SKIP
        >>> with shut_down(collector):  # doctest: +SKIP
        ...     next(iter(collector)).numel()
        8
    """

    _sync = False


@contextmanager
def shut_down(collector: BaseCollector) -> Iterator[None]:
    """End a collector however the block ends: its workers would keep the process alive.

    Examples:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import GymEnv
        >>> collector = Collector(GymEnv("Pendulum-v1"), frames_per_batch=2, total_frames=2)
        >>> with shut_down(collector):
        ...     next(iter(collector)).shape
        torch.Size([2])
    """
    try:
        yield
    finally:
        collector.shutdown()
