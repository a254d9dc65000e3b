"""What the tests of the losses share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from tensordict.nn import set_composite_lp_aggregate


@pytest.fixture(autouse=True)
def _composite_log_prob_parts() -> Iterator[None]:
    """TorchRL's own tests run in this mode: one log-probability for each part of an action."""
    with set_composite_lp_aggregate(False):
        yield


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """Both precisions that the losses are used in."""
    return request.param
