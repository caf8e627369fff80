"""What is imported on first use: names of a package, and packages of extras."""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import Any, cast

from mrgs.errors import ConfigError


def lazy_imports(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package, from the imports that its type
    checkers see.

    These stand under ``if TYPE_CHECKING:``, each as ``from module import name as name``, which
    marks the name as exported. Modules of the package itself are not part of ``__all__``::

        __getattr__, __dir__, __all__ = lazy_imports(__name__)
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


def optional_package(name: str, what: str, extra: str) -> ModuleType:
    """Import a package that the extra of mrgs installs; ``what`` needs it, in the plural.
    ConfigError if it is not installed."""
    try:
        return import_module(name)
    except ImportError:
        raise ConfigError(f'{what} need the package {name}: pip install "mrgs[{extra}]"') from None
