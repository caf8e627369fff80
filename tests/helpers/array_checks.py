"""Checks arrays against the shapes and types that stand in the signatures."""

from __future__ import annotations

import functools
import importlib.util
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FunctionType
from typing import Any

import jaxtyping

ROOT = Path(__file__).parents[2]
PACKAGES = (
    ROOT / "src" / "mrgs",
    ROOT / "plugins" / "thermonerf" / "src" / "mrgs_thermonerf",
    ROOT / "tools" / "mrgs_synth",
)
UNCHECKED = (
    "mrgs.kernels",
    "mrgs_thermonerf.kernels",
    "mrgs.app",
)
"""The decorators break Numba's cache and Triton's reading of a kernel's source; cli imports what it
annotates only when it is needed."""

CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"
"""An int counts as a float (PEP 484)."""

_is_of_dtype = re.compile(
    rf"\b({'|'.join(name for name, value in vars(jaxtyping).items() if isinstance(value, type))})\["
).search


def check_arrays() -> None:
    """From now on, modules are imported with checks; does nothing without beartype, which a machine
    lent for its GPU may lack."""
    if importlib.util.find_spec("beartype") is not None:
        jaxtyping.jaxtyped = functools.partial(_checked, jaxtyping.jaxtyped)
        jaxtyping.install_import_hook(_checked_modules(), CHECKER)


@contextmanager
def unchecked() -> Iterator[None]:
    """Calls as users make them, to whom the code itself must say which type it wants."""
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def _checked(jaxtyped: Callable, checked: Any = None, **options: Any) -> Any:
    """What jaxtyping's import hook decorates everything with: the functions without an array, which
    mypy checks, are most of the calls, and a call is as cheap as it was."""
    if checked is None:
        return functools.partial(_checked, jaxtyped, **options)
    if isinstance(checked, FunctionType) and not has_arrays(checked):
        return checked
    return jaxtyped(checked, **options)


def has_arrays(function: FunctionType) -> bool:
    """Whether an annotation, or an alias in it, is one of jaxtyping's."""
    annotations = " ".join(map(str, function.__annotations__.values()))
    aliases = (function.__globals__.get(word) for word in re.findall(r"\b[A-Z]\w+", annotations))
    return any(map(_is_of_dtype, (annotations, *(repr(alias) for alias in aliases))))


def _checked_modules() -> list[str]:
    """Every module but the unchecked; never a package, because the hook takes all that is below
    it."""
    paths = [
        path.relative_to(package.parent).with_suffix("")
        for package in PACKAGES
        for path in package.rglob("*.py")
    ]
    names = [".".join(path.parts) for path in paths if path.name != "__init__"]
    return [name for name in sorted(names) if not name.startswith(UNCHECKED)]
