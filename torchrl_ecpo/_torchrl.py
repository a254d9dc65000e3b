"""Private names of TorchRL and tensordict, each with the reason why no public one will do."""

from __future__ import annotations

from torchrl.data.replay_buffers import ReplayBuffer, Storage

PRIVATE_NAMES: tuple[tuple[object, str], ...] = ((Storage, "_attached_entities"),)
"""Names used below; ``test/test_private_names.py`` says which one a new version has lost."""


def buffers_of(storage: Storage) -> list[ReplayBuffer]:
    """The buffers that write to a storage.

    A sampler is given the storage alone. Where the oldest step is, and whether another process has
    written, only the buffer's writer knows.
    """
    return storage._attached_entities
