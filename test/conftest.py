from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from hydra.core.config_store import ConfigStore

# pytest's importlib mode does not make a test's neighbours importable.
sys.path.insert(0, str(Path(__file__).parent))

STUDY = Path(__file__).parents[1] / "sota-implementations/study"


@pytest.fixture(scope="module")
def study():
    """The modules of the study, which are scripts beside each other."""
    names = [path.stem for path in sorted(STUDY.glob("*.py"))]
    sys.path.insert(0, str(STUDY))
    try:
        yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
    finally:
        sys.path.remove(str(STUDY))
        for name in names:
            sys.modules.pop(name, None)


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
