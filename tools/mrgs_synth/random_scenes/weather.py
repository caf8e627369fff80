"""Weather of random outdoor scenes: light, air, sky and sun-warmed or radiating surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from mrgs_synth import outdoor
from mrgs_synth.random_scenes.draw import Draw
from mrgs_synth.stage import TemperatureField


@dataclass(frozen=True)
class Weather:
    """Temperatures in °C.

    Attributes:
        air_c: of the air and of what lies far away.
        zenith_c: of the sky's radiation straight above.
        sun_c: how much warmer than the air sunlit opaque surfaces are; negative at night, when
            surfaces radiate to the sky.
        indoors_c: within heated or cooled houses.
    """

    air_c: float
    zenith_c: float
    sun_c: float
    indoors_c: float

    @classmethod
    def drawn(cls, draw: Draw) -> Weather:
        """A frosty night, an overcast day, or a sunny one."""
        kind = draw.one_of("frost", "frost", "overcast", "sun")
        if kind == "frost":
            air_c = draw.between(-10.0, 6.0)
            return cls(
                air_c,
                air_c - draw.between(18.0, 32.0),
                -draw.between(1.0, 3.5),
                draw.between(18.0, 22.0),
            )
        if kind == "overcast":
            air_c = draw.between(2.0, 20.0)
            return cls(
                air_c,
                air_c - draw.between(2.0, 5.0),
                draw.between(0.0, 0.8),
                draw.between(19.0, 22.0),
            )
        air_c = draw.between(14.0, 32.0)
        return cls(
            air_c,
            air_c - draw.between(14.0, 28.0),
            draw.between(6.0, 26.0),
            draw.between(20.0, 25.0),
        )

    def sky_c(self, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """The sky's radiation: near the air's temperature at the horizon, coldest overhead."""
        up = directions[:, 2].clip(0.0, 1.0)
        return self.zenith_c + 0.7 * (self.air_c - self.zenith_c) * np.exp(-up / 0.15)

    def surroundings_c(self, normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """The mean that a surface faces: sky above and ground below, in equal parts for a wall."""
        share = 0.5 + 0.5 * normals[:, 2]
        mean_sky = self.zenith_c + 0.2 * (self.air_c - self.zenith_c)
        return share * mean_sky + (1.0 - share) * (self.air_c + 0.4 * self.sun_c)

    def facing(self, share: float) -> TemperatureField:
        """Temperature of an opaque surface that gets a share of the sun (or sees a share of the
        sky)."""
        return lambda points: np.full(len(points), self.air_c + share * self.sun_c)

    def light(self, draw: Draw) -> Float[np.ndarray, "h w 3"]:
        """A panorama of the sky's light: clear with a glow somewhere, or grey."""
        glow = (draw.between(100.0, 260.0), draw.between(12.0, 60.0))
        clear = outdoor.clear_sky(glow, draw.rng, (64, 128))
        grey = clear.mean(axis=2, keepdims=True).clip(0.2, 1.1)
        cloud = draw.between(0.0, 1.0)
        return (1.0 - cloud) * clear + cloud * grey
