"""TorchRL's collectors with worker processes, ending with a clear error when a worker dies."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import wait
from typing import Any

from tensordict import TensorDictBase
from torchrl.collectors import (
    BaseCollector,
    MultiAsyncCollector,
    MultiCollector,
    MultiSyncCollector,
)

__all__ = ["SupervisedAsyncCollector", "SupervisedSyncCollector", "describe_death", "shut_down"]


class _WorkerDied(BaseException):
    """Passes through what catches errors while it waits for a worker."""


class _Supervised(MultiCollector):
    """Ends with a clear error when a worker process dies.

    TorchRL looks after its workers from time to time. Yet it may wait for ever for what a dead one
    was about to send, such as the acknowledgement of new weights.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        kwargs.setdefault("init_fn", _leave_interrupts_to_the_run)
        super().__init__(*args, **kwargs)

    def iterator(self) -> Iterator[TensorDictBase | None]:
        """Yield batches.

        Raises:
            ChildProcessError: if a worker has died.
        """
        batches = super().iterator()  # pyright: ignore[reportAbstractUsage]
        while True:
            with self._watch():
                try:
                    batch = next(batches)
                except StopIteration:
                    return
            yield batch

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        """Send the weights of the policy, or those given, to the workers.

        Raises:
            ChildProcessError: if a worker has died.
        """
        with self._watch():
            super().update_policy_weights_(*args, **kwargs)

    @contextmanager
    def _watch(self) -> Iterator[None]:
        """Within, the death of a worker is an error at once."""
        try:
            with _call_when_a_child_ends(self._stop_waiting):
                self._stop_waiting()
                yield
        except (_WorkerDied, Exception) as error:
            # A worker's connections end before itself.
            running = {proc.sentinel: proc for proc in self.procs if not proc._closed}
            for ended in wait(list(running), timeout=5.0):
                running[ended].join()
            dead = self._find_dead()
            if dead is None:
                raise
            for process in running.values():
                process.kill()
            self._leave_queues()
            worker, code = dead
            raise ChildProcessError(describe_death(worker, _describe_exit(code))) from error

    def _leave_queues(self) -> None:
        """Let this process end without its queues: a `put` that was interrupted never comes out."""
        for scheme in (self._weight_sync_schemes or {}).values():
            for queue in (getattr(scheme, "_instruction_queues", None) or {}).values():
                queue.cancel_join_thread()

    def _stop_waiting(self, *_: Any) -> None:
        if self._find_dead() is not None:
            raise _WorkerDied

    def _find_dead(self) -> tuple[int, int] | None:
        """The first worker that has ended, and its exit code."""
        for worker, process in enumerate(self.procs):
            if not process._closed and process.exitcode is not None:
                return worker, process.exitcode
        return None


@contextmanager
def _call_when_a_child_ends(handle: Callable[..., None]) -> Iterator[None]:
    """Within, `handle` interrupts whatever this process waits for when a child process ends.

    The system tells so by a signal, which the main thread gets; elsewhere nothing is called.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGCHLD, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGCHLD, previous or signal.SIG_DFL)


def _leave_interrupts_to_the_run() -> None:
    """Ctrl-C reaches all processes of a terminal; the run's own tells the workers when to end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _describe_exit(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}: its own error is printed above"
    hint = ", as the system does when memory runs out" if code == -signal.SIGKILL else ""
    return f"was killed by {signal.Signals(-code).name}{hint}"


def describe_death(worker: int, cause: str) -> str:
    """What happened to a worker, and how to go on.

    Examples:
        >>> describe_death(1, "died in the Ray cluster")[:50]
        'Worker 1 of the collector died in the Ray cluster.'
    """
    return (
        f"Worker {worker} of the collector {cause}. The run cannot go on without it; start the run "
        "again with resume=<run directory> or resume=auto to go on from its last checkpoint."
    )


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


class SupervisedSyncCollector(_Supervised, MultiSyncCollector):
    """TorchRL's ``MultiSyncCollector``; the death of a worker is a ``ChildProcessError`` at once.

    Examples:
        >>> issubclass(SupervisedSyncCollector, MultiSyncCollector)
        True
    """


class SupervisedAsyncCollector(_Supervised, MultiAsyncCollector):
    """TorchRL's ``MultiAsyncCollector``; the death of a worker is a ``ChildProcessError`` at once.

    Examples:
        >>> issubclass(SupervisedAsyncCollector, MultiAsyncCollector)
        True
    """
