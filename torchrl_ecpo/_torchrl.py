"""Private names of TorchRL and tensordict, and a defect, each with the reason for it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data.replay_buffers import ReplayBuffer, Storage
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule
from torchrl.objectives.value import ValueEstimatorBase

PRIVATE_NAMES: tuple[tuple[object, str], ...] = (
    (LossModule, "_all_schedulable_buffers"),
    (LossModule, "_make_vmap"),  # overridden by losses of ours: they have nothing to make
    (LossModule(), "_has_update_associated"),  # of each instance
    (ValueEstimatorBase, "_get_time_dim"),
    (EnvBase, "_step_proc_data"),  # overridden by environments of ours: saves a tenth of a step
    (Storage, "_attached_entities"),
    (Sampler, "_rng"),
    (Collector, "_make_carrier"),  # which makes each instance's `_carrier`
)
"""Names used here; ``test/test_private_names.py`` says which one a new version has lost."""


def schedulable_buffers(loss_module: LossModule) -> tuple[str, ...]:
    """Buffers of a loss of TorchRL's that can be assigned numbers.

    A loss declares them in ``_schedulable_buffers``, which its subclasses extend. The union, which
    decides what an assignment does, has no public name.
    """
    return tuple(sorted(type(loss_module)._all_schedulable_buffers))


def networks_with_updater(loss_module: LossModule) -> dict[str, bool]:
    """For each network of a loss, whether an updater follows it; true where nothing is delayed.

    An updater marks its networks in this dict, and the loss warns of those that are not marked.
    TorchRL's own constructor marks all of them, and there is no public name for one.
    """
    return loss_module._has_update_associated


def time_dim_of(estimator: ValueEstimatorBase, tensordict: TensorDictBase) -> int:
    """Along which dimension an estimator follows a trajectory: its own, or what the names tell."""
    return estimator._get_time_dim(None, tensordict)


def buffers_of(storage: Storage) -> list[ReplayBuffer]:
    """The buffers that write to a storage.

    A sampler is given the storage alone. Where the oldest step is, and whether another process has
    written, only the buffer's writer knows.
    """
    return storage._attached_entities


def generator_of(sampler: Sampler) -> torch.Generator | None:
    """The random generator that a buffer was built with, ``ReplayBuffer(generator=...)``.

    The buffer hands it to its sampler under this name alone.
    """
    return sampler._rng


@contextmanager
def holding(network: Any, params: Any) -> Iterator[None]:
    """Let a network have these parameters, and its own again afterwards.

    That is ``params.to_module``, which gives back nothing where an error leaves its block: the
    user's network would keep delayed parameters, and no optimiser would reach it any more.
    """
    error = None
    with params.to_module(network, preserve_module_state=False):
        try:
            yield
        except BaseException as caught:  # Ctrl-C too
            error = caught
    if error is not None:
        raise error


def carrier_of(collector: Collector) -> TensorDictBase:
    """What one step of a collector hands to the next.

    A collector's state dict leaves it out, so that one that is loaded would begin a new episode.
    """
    return collector._carrier


def set_carrier(collector: Collector, carrier: TensorDictBase) -> None:
    """Let a collector go on from there."""
    collector._carrier = carrier
