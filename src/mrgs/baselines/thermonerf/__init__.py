"""ThermoNeRF as a method to compare with: one neural radiance field for colour and temperature, on
the CPU.

Written from the description in Hassan et al., "ThermoNeRF: Joint RGB and thermal novel view
synthesis for building facades using multimodal neural radiance fields", and from the papers that
each file names.
"""

from mrgs.baselines.thermonerf.config import METHOD, ThermoNerfConfig, from_yaml, make_config
from mrgs.baselines.thermonerf.run import ThermoNerfRun, open_thermonerf, train_thermonerf

__all__ = [
    "METHOD",
    "ThermoNerfConfig",
    "ThermoNerfRun",
    "from_yaml",
    "make_config",
    "open_thermonerf",
    "train_thermonerf",
]
