"""MrGS: posed RGB and thermal photos in, one 3D Gaussian model out that renders novel views in
colour and in °C.

The names below are imported on first use, so that ``import mrgs`` stays cheap.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mrgs.data import load_scene
    from mrgs.errors import MrgsError
    from mrgs.method.density import Strategy
    from mrgs.method.losses.term import Term
    from mrgs.runs.open import Run, load_run, open_run
    from mrgs.runs.registry import Method, register
    from mrgs.scene import Camera
    from mrgs.training import make_config, train

__version__ = "0.1.0"
__all__ = [
    "Camera",
    "Method",
    "MrgsError",
    "Run",
    "Strategy",
    "Term",
    "load_run",
    "load_scene",
    "make_config",
    "open_run",
    "register",
    "train",
]

_HOMES = {
    "Camera": "mrgs.scene",
    "MrgsError": "mrgs.errors",
    "Method": "mrgs.runs.registry",
    "Run": "mrgs.runs.open",
    "Strategy": "mrgs.method.density",
    "Term": "mrgs.method.losses.term",
    "load_run": "mrgs.runs.open",
    "open_run": "mrgs.runs.open",
    "load_scene": "mrgs.data",
    "make_config": "mrgs.training",
    "register": "mrgs.runs.registry",
    "train": "mrgs.training",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'mrgs' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)
