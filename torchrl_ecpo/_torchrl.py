"""Private names of TorchRL and tensordict, each with the reason why no public one will do."""

from __future__ import annotations

from torchrl.objectives import LossModule

PRIVATE_NAMES: tuple[tuple[object, str], ...] = ((LossModule, "_all_schedulable_buffers"),)
"""Names used below; ``test/test_private_names.py`` says which one a new version has lost."""


def schedulable_buffers(loss_module: LossModule) -> tuple[str, ...]:
    """Buffers of a loss of TorchRL's that can be assigned numbers.

    A loss declares them in ``_schedulable_buffers``, which its subclasses extend. The union, which
    decides what an assignment does, has no public name.
    """
    return tuple(sorted(type(loss_module)._all_schedulable_buffers))
