"""Packages that an extra of mrgs installs, imported when they are needed."""

from __future__ import annotations

import importlib
from types import ModuleType

from mrgs.errors import ConfigError


def optional_package(name: str, what: str, extra: str) -> ModuleType:
    """Import a package.

    Args:
        name: of the package.
        what: needs it, in the plural.
        extra: of mrgs, which installs it.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ConfigError(f'{what} need the package {name}: pip install "mrgs[{extra}]"') from None
