"""Private names of torch, each with the reason why no public one will do."""

from __future__ import annotations

import torch

PRIVATE_NAMES: tuple[tuple[object, str], ...] = (
    (torch, "_C"),
    (torch._C, "_are_functorch_transforms_active"),
)
"""Names used below; ``test/test_private_names.py`` says which one a new version has lost."""


def is_transformed() -> bool:
    """Whether a ``torch.func`` transform runs, as ``torch.vmap``: tensors then have no values.

    The public ``torch.func`` has no such question; reading a value inside ``vmap`` is an error.
    """
    return torch._C._are_functorch_transforms_active()
