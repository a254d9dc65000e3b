"""The files of a checkpoint: hashed when they are written, compared before they are read."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from torchrl.checkpoint import Checkpoint, CheckpointError, StateDictCheckpointAdapter

MANIFEST = "manifest.json"


class StateFile(StateDictCheckpointAdapter):
    """One file, from which nothing but tensors and plain data is unpickled; no other is read.

    TorchRL's own adapter reads whichever of its formats it finds, some of which run code.
    """

    def __init__(self) -> None:
        super().__init__("torch")

    def save(self, component: Any, path: Path, **options: Any) -> Any:
        """Write a component; refuse what could not be read."""
        state = super().save(component, path, **options)
        strange = torch.serialization.get_unsafe_globals_in_checkpoint(path / self.state_torch)
        if strange:
            raise TypeError(
                f"the state of {type(component).__name__} must be tensors, numbers, texts and "
                f"containers of these, got what needs {', '.join(sorted(strange))}: make numpy's "
                "numbers Python's own by .item(), and its arrays tensors"
            )
        return state

    def load(self, component: Any, path: Path, **_: Any) -> None:
        """Restore a component."""
        component.load_state_dict(torch.load(path / self.state_torch, weights_only=True))


def seal(path: Path) -> None:
    """Write hashes of all files of a new checkpoint, and of the manifest itself, into it."""
    manifest = Checkpoint.manifest(path)
    manifest["files"] = {name: _hash(path / name) for name in _contents(path)}
    (path / MANIFEST).write_bytes(_sealed(manifest))


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a checkpoint.

    Raises:
        CheckpointError: if it is not, byte for byte, what was written.
    """
    try:
        content = (path / MANIFEST).read_bytes()
        manifest = json.loads(content)
        is_whole = content == _sealed(manifest)
    except (FileNotFoundError, ValueError, AttributeError):
        raise _damaged(path, f"{MANIFEST} is missing or cannot be read") from None
    if "sha256" not in manifest:
        raise CheckpointError(
            f"{path} is no checkpoint of a run of this script, or one of an earlier version: its "
            f"{MANIFEST} has no sha256."
        )
    if not is_whole:
        raise _damaged(path, f"{MANIFEST} has changed")
    return manifest


def check_files(path: Path, manifest: dict[str, Any]) -> None:
    """Compare the files of a checkpoint with its manifest; what is not in it is not opened.

    Raises:
        CheckpointError: naming files that are missing, have changed, or do not belong to it.
    """
    hashes, present = manifest["files"], _contents(path)
    more = present - hashes.keys()
    wrong = [f"{name} is missing" for name in sorted(hashes.keys() - present)]
    wrong += [
        f"{name} does not belong to it"
        for name in sorted(more)
        if name.rpartition("/")[0] not in more  # nor is what is in such a folder named
    ]
    wrong += [
        f"{name} has changed"
        for name in sorted(hashes.keys() & present)
        if _hash(path / name) != hashes[name]
    ]
    if wrong:
        raise _damaged(path, ", ".join(wrong))


def _contents(path: Path) -> set[str]:
    """Files and folders, but for the manifest."""
    return {entry.relative_to(path).as_posix() for entry in path.rglob("*")} - {MANIFEST}


def _hash(path: Path) -> str:
    if path.is_dir():
        return "folder"
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _sealed(manifest: dict[str, Any]) -> bytes:
    """A manifest as it is written."""
    body = {name: value for name, value in manifest.items() if name != "sha256"}
    digest = hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
    return json.dumps({**body, "sha256": digest}, indent=2, sort_keys=True).encode()


def _damaged(path: Path, what: str) -> CheckpointError:
    return CheckpointError(
        f"{path} is damaged: {what}. Nothing was restored or removed. Put back what was there, or "
        "remove this checkpoint: the run then goes on from the one before it, or begins anew if "
        "there is none."
    )
