from __future__ import annotations

import importlib
import inspect
import multiprocessing
import sys
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hypothesis import settings
from omegaconf import OmegaConf
from processes import FORKED
from torch import multiprocessing as torch_multiprocessing

from torchrl_ecpo.experiment import compose_options

# The same examples at every run, and none kept.
settings.register_profile("tests", derandomize=True, deadline=None, database=None, max_examples=25)
settings.load_profile("tests")

SCRIPTS = Path(__file__).parents[1] / "sota-implementations"
STUDY = SCRIPTS / "study"


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


def forget_scripts():
    """Modules of the scripts have the same names in several folders."""
    for name, module in sys.modules.copy().items():
        if str(vars(module).get("__file__")).startswith(str(SCRIPTS)):
            del sys.modules[name]


@pytest.fixture
def beside(monkeypatch):
    """Imports a module of a script's folder, as if the script were started from there."""
    forget_scripts()

    def load(folder, name):
        monkeypatch.syspath_prepend(str(SCRIPTS / folder))
        return importlib.import_module(name)

    yield load
    forget_scripts()


@pytest.fixture
def script(beside):
    """Imports what is beside ecpo.py."""
    return partial(beside, "ecpo")


@pytest.fixture
def run_here(beside, monkeypatch):
    """Runs a script in this process, in a directory, without a picture: a third of the time.

    A `bare` main is that without hydra and without what tidies up after a refused run.
    """
    monkeypatch.setattr("torchrl_ecpo.experiment.run.plot_learning_curve", lambda *_, **__: "")

    def run(directory, script, *options, bare=False):
        forget_scripts()
        main = beside(script, script).main
        main = inspect.unwrap(main) if bare else main.__wrapped__
        options = ["checkpoint.interval=null", *options]
        config = compose_options(SCRIPTS / script, options)
        directory.mkdir(exist_ok=True)
        monkeypatch.chdir(directory)
        runtime = {"cwd": str(directory), "config_sources": []}
        own = {"overrides": {"task": options}, "mode": None, "runtime": runtime}
        monkeypatch.setattr(HydraConfig.instance(), "cfg", OmegaConf.create({"hydra": own}))
        main(config)

    return run


@pytest.fixture
def forked_workers(monkeypatch):
    """Worker processes start from one that has imported torch, and not afresh: in no time."""
    for module in (multiprocessing, torch_multiprocessing):
        monkeypatch.setattr(module, "get_context", lambda method=None: FORKED)
