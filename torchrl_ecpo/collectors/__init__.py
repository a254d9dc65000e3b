"""Collectors: complete trajectory groups, and worker processes that are looked after."""

from torchrl_ecpo.collectors.groups import TrajectoryGroupCollector
from torchrl_ecpo.collectors.supervised import (
    SupervisedAsyncCollector,
    SupervisedSyncCollector,
    shut_down,
)

__all__ = [
    "SupervisedAsyncCollector",
    "SupervisedSyncCollector",
    "TrajectoryGroupCollector",
    "shut_down",
]
