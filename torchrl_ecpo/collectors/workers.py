"""Players in this process, in others of this machine or of a Ray cluster, looked after.

A player is what collects: ``play()`` returns a batch, ``set_weights(weights)`` and
``set_training(modes)`` take what is new between two batches, ``close()`` ends it. A worker does one
thing after another.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    FIRST_EXCEPTION,
    Future,
    ProcessPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from functools import partial
from operator import itemgetter
from typing import Any

import cloudpickle
import numpy as np
import torch
from tensordict import TensorDictBase

try:
    import ray
except ImportError:  # an extra
    ray: Any = None


def spawn_seeds(seed: int, count: int) -> list[int]:
    """Seeds of streams that differ from each other, and from those of other seeds.

    Examples:
        >>> len({*spawn_seeds(0, 2), *spawn_seeds(1, 2)})
        4
    """
    return np.random.SeedSequence(seed).generate_state(count).tolist()


def set_training(player: Any, modes: dict[str, bool]) -> None:
    """Put the modules of a player's policy into these training modes, between two batches."""
    for name, module in player.policy.named_modules():
        module.training = modes.get(name, module.training)


class Workers:
    """Players in this process, in processes of their own, or in the actors of a Ray cluster.

    Args:
        makers: of the players; what they hold travels by value.
        backend: ``"direct"``, ``"process"`` or ``"ray"``.
        sync: whether a batch is everybody's, or one worker's while the others go on.
        ray_init_config: what ``ray.init`` takes.
        remote_configs: what an actor needs, as ``ray.remote`` takes it.

    Raises:
        ChildProcessError: from every method, if a worker has died.
    """

    def __init__(
        self,
        makers: Sequence[Callable[[], Any]],
        backend: str = "process",
        *,
        sync: bool,
        ray_init_config: dict[str, Any] | None = None,
        remote_configs: dict[str, Any] | None = None,
    ) -> None:
        self._sync = sync
        self._news: list[dict[str, Any]] = [{} for _ in makers]
        self._playing: dict[Future[Any], int] = {}
        if backend == "ray" and ray is None:
            raise ModuleNotFoundError("backend='ray' needs the extra 'ray' of this package.")
        self._has_cluster = backend == "ray" and not ray.is_initialized()
        if self._has_cluster:
            ray.init(**(ray_init_config or {}))
        make = {"direct": _Here, "process": _Process, "ray": partial(_Actor, remote_configs or {})}
        self._workers: list[Any] = [make[backend]() for _ in makers]
        try:
            self.call("start", makers, spawn_seeds(torch.initial_seed(), len(makers)))
        except BaseException:
            self._leave()
            raise

    @property
    def player(self) -> Any:
        """The player of this process."""
        return self._workers[0].player

    def __len__(self) -> int:
        return len(self._workers)

    def set_weights(self, weights: TensorDictBase) -> None:
        """Give all players these weights before whatever they do next, or at once."""
        self.tell("set_weights", weights if self._workers[0].is_idle else weights.detach().clone())

    def tell(self, name: str, news: Any) -> None:
        """Call a method of all players with this before whatever they do next, or at once."""
        if self._workers[0].is_idle:
            self.call(name, [news] * len(self))
        else:
            self._news = [{**own, name: news} for own in self._news]

    def play(self) -> list[tuple[int, Any]]:
        """Return all workers' batches, or that of the first one to finish, each with its worker."""
        for worker in sorted(set(range(len(self))) - set(self._playing.values())):
            self._begin(worker)
        until = FIRST_EXCEPTION if self._sync else FIRST_COMPLETED
        done, _ = wait(self._playing, return_when=until)
        for future in done:
            if future.exception() is not None:  # others may be playing still
                self._result(self._playing[future], future)
        # The one that began first: any other could leave it waiting for ever.
        finished = done if self._sync else [next(one for one in self._playing if one in done)]
        played = sorted(((self._playing.pop(one), one) for one in finished), key=itemgetter(0))
        if not self._sync:
            self._begin(played[0][0])
        return [(worker, self._result(worker, future)) for worker, future in played]

    def call(self, name: str, *arguments: Sequence[Any]) -> list[Any]:
        """Call a method of all players, each with an own one of each of the arguments."""
        rows = zip(range(len(self)), *arguments, strict=True)
        futures = [self._submit(worker, name, *row) for worker, *row in rows]
        return [self._result(worker, future) for worker, future in enumerate(futures)]

    def forget(self) -> None:
        """Leave out the batches that are under way."""
        self._playing.clear()

    def stop(self, timeout: float | None = None) -> None:
        """Close the players and end the workers, by force after `timeout` seconds (default: 5)."""
        with suppress(ChildProcessError):
            closed = [self._submit(worker, "close") for worker in range(len(self))]
            wait(closed, timeout=5.0 if timeout is None else timeout)
        self._leave()

    def _leave(self) -> None:
        for worker in self._workers:
            worker.kill()
        self._playing.clear()
        if self._has_cluster:
            ray.shutdown()

    def _begin(self, worker: int) -> None:
        self._playing[self._submit(worker, "play")] = worker

    def _submit(self, worker: int, name: str, *arguments: Any) -> Future[Any]:
        news, self._news[worker] = self._news[worker], {}
        try:
            return self._workers[worker].submit(news, name, *arguments)
        except BrokenProcessPool as error:
            raise self._death(worker) from error

    def _result(self, worker: int, future: Future[Any]) -> Any:
        try:
            return self._workers[worker].read(future.result())
        except self._workers[worker].death as error:
            raise self._death(worker) from error

    def _death(self, worker: int) -> ChildProcessError:
        return ChildProcessError(
            f"Worker {worker} of the collector {self._workers[worker].cause()}. The run cannot go "
            "on without it: resume it from its last checkpoint."
        )


class _Host:
    """What a worker has: a player, with random numbers from a stream of its own."""

    player: Any

    def call(self, news: dict[str, Any], name: str, *arguments: Any) -> Any:
        """Let the player take news, such as new weights, and do something."""
        if name == "start":
            make, seed = arguments
            torch.manual_seed(seed)
            self.player = make()
            return None
        for method, value in news.items():
            getattr(self.player, method)(value)
        return getattr(self.player, name)(*arguments)


class _Worker:
    """What hosts of all kinds do, unless they say otherwise."""

    death: Any = ()
    is_idle = False  # as far as is known

    def read(self, answer: Any) -> Any:
        return answer

    def kill(self) -> None:
        """End at once."""


class _Here(_Worker, _Host):
    """This process, which has done a thing before it is asked for the result."""

    is_idle = True

    def submit(self, news: dict[str, Any], name: str, *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if name == "start":  # the random numbers are this process's
            self.player = arguments[0]()
            future.set_result(None)
            return future
        self.is_idle = False
        try:
            future.set_result(self.call(news, name, *arguments))
        finally:
            self.is_idle = True
        return future


_host = _Host()  # of a worker process


def _serve(request: bytes) -> bytes:
    try:
        return cloudpickle.dumps(_host.call(*cloudpickle.loads(request)))
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # it could not travel, and would count as the death of the worker
            lines = traceback.format_exc()
            raise RuntimeError(f"{type(error).__name__}: {error}\n{lines}") from None
        raise


def _begin_process() -> None:
    # Ctrl-C reaches all processes of a terminal; the run's own tells the workers when to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


class _Process(_Worker):
    """A worker process of this machine."""

    death = BrokenProcessPool

    def __init__(self) -> None:
        spawn = multiprocessing.get_context("spawn")  # a fork would inherit locked threads
        self._pool = ProcessPoolExecutor(1, spawn, initializer=_begin_process)
        others = set(multiprocessing.active_children())
        self._pool.submit(os.getpid)
        (self.process,) = set(multiprocessing.active_children()) - others

    def submit(self, *request: Any) -> Future[Any]:
        # As bytes: tensors would be shared, which takes an open file for each of them.
        return self._pool.submit(_serve, cloudpickle.dumps(request))

    def read(self, answer: bytes) -> Any:
        return cloudpickle.loads(answer)

    def cause(self) -> str:
        """How the process ended."""
        code = self._exit_code(5.0)
        if code is None or code >= 0:
            return f"ended with exit code {code}: its own error is printed above"
        hint = ", as the system does when memory runs out" if code == -signal.SIGKILL else ""
        return f"was killed by {signal.Signals(-code).name}{hint}"

    def kill(self) -> None:
        """End the process, at once if it is busy."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._exit_code(0.5)
        self.process.kill()
        self._exit_code(5.0)

    def _exit_code(self, seconds: float) -> int | None:
        """The exit code, waited for. A join returns at once where the pool's thread joins."""
        deadline = time.monotonic() + seconds
        while self.process.exitcode is None and time.monotonic() < deadline:
            time.sleep(0.002)
        return self.process.exitcode


class _Actor(_Worker):
    """An actor of a Ray cluster."""

    def __init__(self, needs: dict[str, Any]) -> None:
        self.death = ray.exceptions.RayActorError
        self.actor = ray.remote(_Host).options(**needs).remote()

    def submit(self, *request: Any) -> Future[Any]:
        return self.actor.call.remote(*request).future()

    def cause(self) -> str:
        """Ray's own error, from which this one is raised, says more."""
        return "died in the Ray cluster"

    def kill(self) -> None:
        """End the actor."""
        ray.kill(self.actor)
