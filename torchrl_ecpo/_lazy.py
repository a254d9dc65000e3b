"""Packages that import nothing until they are asked: torch takes seconds, and ``--help`` none."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any


def importing(package: str, *modules: str) -> Callable[[str], Any]:
    """A package's ``__getattr__``: its modules are imported with a public name that is asked for.

    Its other submodules are found too; any other name is none of its own, and imports nothing.

    Args:
        package: its name; it has an ``__all__``.
        modules: where its public names are.
    """

    def get(name: str) -> Any:
        here = vars(sys.modules[package])
        if name not in here["__all__"]:
            if name.isidentifier() and find_spec(f"{package}.{name}"):
                return import_module(f"{package}.{name}")
        else:
            for module in modules:
                part = vars(import_module(f"{package}.{module}"))
                here.update({each: part[each] for each in here["__all__"] if each in part})
        if name not in here:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return here[name]

    return get
