from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hydra.core.config_store import ConfigStore

# pytest's importlib mode does not make a test's neighbours importable.
sys.path.insert(0, str(Path(__file__).parent))

# Hydra would take TorchRL's configs, which stay in its store, for the schemas of the scripts' files
# of the same names: only the tests that ask for them have them.
STORE = ConfigStore.instance()
groups = set(STORE.repo)
import torchrl_ecpo.trainers  # noqa: E402, F401

CONFIGS = {group: STORE.repo.pop(group) for group in STORE.repo.keys() - groups}


@pytest.fixture
def torchrl_configs(monkeypatch):
    """The configs that importing `torchrl_ecpo.trainers` registers."""
    monkeypatch.setattr(STORE, "repo", STORE.repo | CONFIGS)
