"""The package as others depend on it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

import torchrl_ecpo

tomllib = pytest.importorskip("tomllib", reason="Python 3.11 brings it")

ROOT = Path(__file__).parents[1]
LIBRARY = """
import sys
for name in {absent}:
    sys.modules[name] = None  # importing it fails
import torchrl_ecpo
from torchrl_ecpo import collectors, envs, functional, groups, modules, objectives
env = torchrl_ecpo.BanditEnv(num_actions=10, group_size=4)
actor = torchrl_ecpo.make_softmax_policy(env.features)
collector = torchrl_ecpo.TrajectoryGroupCollector(env, actor, num_groups=2, group_size=4)
loss_module = torchrl_ecpo.ECPOLoss(actor)
loss_module(next(iter(collector)))["loss_actor"].backward()
"""


def test_what_a_package_has_not_is_told_without_an_import(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchrl_ecpo.envs.vector", None)  # importing it fails
    assert not hasattr(torchrl_ecpo.envs, "nonsense")
    assert not hasattr(torchrl_ecpo, "nonsense")
    assert torchrl_ecpo.functional.__name__ == "torchrl_ecpo.functional"


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_library_needs_no_extra(project):
    extra = [re.match(r"[\w-]+", line)[0] for line in project["optional-dependencies"]["scripts"]]
    of_torch = ("filelock", "tqdm")  # and of TorchRL
    absent = [{"hydra-core": "hydra"}.get(name, name) for name in extra if name not in of_torch]
    code = LIBRARY.format(absent=absent)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_version_is_the_same_everywhere(project):
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["version"] == torchrl_ecpo.__version__ == citation["version"]


def test_its_types_are_for_others_too(project):
    assert (Path(torchrl_ecpo.__file__).parent / "py.typed").is_file()
    assert "Typing :: Typed" in project["classifiers"]


def test_the_workflow_tries_every_python_that_is_promised(project):
    workflow = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())
    tried = workflow["jobs"]["test"]["strategy"]["matrix"]["python"]
    prefix = "Programming Language :: Python :: 3."
    promised = [line.removeprefix(prefix) for line in project["classifiers"] if prefix in line]
    assert tried == [f"3.{minor}" for minor in promised]
    assert project["requires-python"] == f">={tried[0]}"
