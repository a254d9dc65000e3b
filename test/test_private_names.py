"""Private names of other packages stand in one file for each, and are there."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from types import ModuleType

import pytest

from torchrl_ecpo import _torch, _torchrl

ROOT = Path(__file__).parents[1]
SOURCES = [
    path
    for folder in ("torchrl_ecpo", "sota-implementations")
    for path in sorted((ROOT / folder).rglob("*.py"))
]
FOR_PRIVATE_NAMES = {"torchrl_ecpo/_torch.py", "torchrl_ecpo/_torchrl.py"}
EXTENSION_POINTS = {
    # Documented as what a subclass has to define or may override.
    "_forward_value_estimator_keys",
    "_exit",  # os._exit
    # Of NamedTuple, whose public methods begin with an underscore.
    "_replace",
}


@pytest.mark.parametrize("module", [_torch, _torchrl], ids=lambda module: module.__name__)
def test_every_private_name_is_there(module):
    for owner, name in module.PRIVATE_NAMES:
        is_named = isinstance(owner, type | ModuleType)
        kind = owner if is_named else type(owner)
        package = str(getattr(kind, "__module__", None) or kind.__name__).partition(".")[0]
        assert hasattr(owner, name), (
            f"{package} {version(package)} has no {name!r} in {kind.__name__} any more. "
            f"{Path(module.__file__).name} says what it was needed for: mend it there."
        )


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name != "_"


def is_assigned_to_self(node: ast.Attribute) -> bool:
    return isinstance(node.ctx, ast.Store) and ast.unparse(node.value) == "self"


def defined_names(tree: ast.AST) -> Iterator[str]:
    """Functions, classes, variables and attributes that a source defines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
            yield node.name
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.Attribute) and is_assigned_to_self(node):
            yield node.attr


def is_foreign(node: ast.ImportFrom) -> bool:
    return node.level == 0 and not str(node.module).startswith("torchrl_ecpo")


def foreign_private_names(tree: ast.AST, ours: set[str]) -> list[str]:
    """Uses of private names that no source of ours defines, as ``line: name``."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            if node.attr not in ours | EXTENSION_POINTS:
                found.append(f"{node.lineno}: {node.attr}")
        elif isinstance(node, ast.ImportFrom) and is_foreign(node):
            names = [alias.name for alias in node.names]
            modules = str(node.module).split(".")
            found += [f"{node.lineno}: {name}" for name in [*modules, *names] if is_private(name)]
    return found


def test_private_names_of_others_stand_in_one_file():
    trees = {str(path.relative_to(ROOT)): ast.parse(path.read_text()) for path in SOURCES}
    ours = {name for tree in trees.values() for name in defined_names(tree)}
    found = {path: foreign_private_names(tree, ours) for path, tree in trees.items()}
    assert {path for path, names in found.items() if names} <= FOR_PRIVATE_NAMES, found


def test_a_private_name_of_others_is_found():
    source = """
from torchrl.objectives.utils import _vmap_func
from torchrl_ecpo.objectives._base import PolicyLoss

class Loss(PolicyLoss):
    def _own(self):
        self._also_own = self._own()
        return self._reduce_loss(self._also_own), batch.writer._rng
"""
    tree = ast.parse(source)
    found = foreign_private_names(tree, set(defined_names(tree)))
    assert sorted(found) == ["2: _vmap_func", "8: _reduce_loss", "8: _rng"]
