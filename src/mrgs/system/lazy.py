"""Names of a package that are imported on first use."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any, cast


def lazy_imports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package, from the imports that its type
    checkers see.

    These stand under ``if TYPE_CHECKING:``, each as ``from module import name as name``, which
    marks the name as exported. Modules of the package itself are no part of ``__all__``::

        __getattr__, __dir__, __all__ = lazy_imports(__name__)

    Args:
        package: name of the package.
    """
    homes = {
        alias.name: statement.module
        for block in ast.parse(_source(package)).body
        if isinstance(block, ast.If) and ast.unparse(block.test) == "TYPE_CHECKING"
        for statement in block.body
        if isinstance(statement, ast.ImportFrom) and statement.module is not None
        for alias in statement.names
        if alias.asname == alias.name
    }

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if homes[name] == package:
            return import_module(f"{package}.{name}")
        return getattr(import_module(homes[name]), name)

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return load, names, sorted(name for name, home in homes.items() if home != package)


def _source(package: str) -> str:
    """The text of a package's ``__init__.py``, which may lie in a zip file."""
    spec = find_spec(package)
    assert spec is not None
    return cast(str, cast(Any, spec.loader).get_source(package))
