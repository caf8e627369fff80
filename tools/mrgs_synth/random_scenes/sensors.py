"""The thermal cameras of random scenes."""

from __future__ import annotations

from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.sensor import ThermalSensor


def drawn_sensor(draw: Draw) -> ThermalSensor:
    """From a good camera (30 mK) to a phone's (150 mK), sharp to soft."""
    netd_c = draw.scale(0.03, 0.15)
    return ThermalSensor(
        point_spread_px=draw.between(1.05, 1.8),
        netd_c=netd_c,
        column_noise_c=netd_c * draw.between(0.1, 0.5),
    )
