"""ThermoNeRF as a method to compare with: one neural radiance field for colour and temperature, on
the CPU.

Written from the description in Hassan et al., "ThermoNeRF: Joint RGB and thermal novel view
synthesis for building facades using multimodal neural radiance fields", and from the papers that
each file names. The names below are imported on first use: the command line lists ``METHOD``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mrgs.runs.registry import Method, imported
from mrgs.system.lazy import lazy_imports

if TYPE_CHECKING:
    from mrgs_thermonerf.config import ThermoNerfConfig as ThermoNerfConfig
    from mrgs_thermonerf.config import from_yaml as from_yaml
    from mrgs_thermonerf.config import make_config as make_config
    from mrgs_thermonerf.run import ThermoNerfRun as ThermoNerfRun
    from mrgs_thermonerf.run import open_thermonerf as open_thermonerf
    from mrgs_thermonerf.run import train_thermonerf as train_thermonerf

METHOD = Method(
    "thermonerf",
    "a neural radiance field, on the CPU",
    imported("mrgs_thermonerf.config", "make_config"),
    imported("mrgs_thermonerf.run", "train_thermonerf"),
    imported("mrgs_thermonerf.run", "open_thermonerf"),
    imported("mrgs_thermonerf.config", "from_yaml"),
    has_gaussians=False,
    uses_gpu=False,
)
"""The entry point of the group ``mrgs.methods``."""

__getattr__, __dir__, __all__ = lazy_imports(__name__)
__all__ += ["METHOD"]
