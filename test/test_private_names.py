"""Names of other packages that begin with an underscore are still there."""

from __future__ import annotations

import pytest

from torchrl_ecpo import _torchrl

NAMES = [name for _, name in _torchrl.PRIVATE_NAMES]


@pytest.mark.parametrize(("owner", "name"), _torchrl.PRIVATE_NAMES, ids=NAMES)
def test_private_names_of_torchrl_are_still_there(owner, name):
    where = owner.__name__ if isinstance(owner, type) else type(owner).__name__
    assert hasattr(owner, name), f"TorchRL's {where} has lost {name}: see torchrl_ecpo/_torchrl.py."
