"""The uncertainty of ΔT against a Monte Carlo over everything that two marks are computed from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest

from mrgs.marks import Marks
from mrgs.marks.emissivity import CaptureSettings, SurfaceSettings
from mrgs.marks.uncertainty import Budget, InputQuantity, Uncertainty, shared_difference
from mrgs.scene.radiometry import ObjectParameters, Planck
from tests.marks.test_uncertainty import BOX, SETTINGS, meter_of, of_place

R, B, F = 21_106.77 / 0.012545258, 1501.0, 1.0
LAW = Planck(21_106.77, 0.012545258, B, F, 0.0)
DRAWS = 200_000
SIGMA = {"emissivity": 0.02, "reflected": 2.0, "distance": 0.1, "air": 2.0}


def signal_of(celsius):
    return R / (np.exp(B / (celsius + 273.15)) - F)


def celsius_of(signal):
    return B / np.log(R / signal + F) - 273.15


def transmission(metres, air_c, humidity):
    """FLIR's formula, with the constants that its cameras store."""
    water = humidity * np.exp(
        1.5587 + 0.06939 * air_c - 2.7816e-4 * air_c**2 + 6.8455e-7 * air_c**3
    )
    near, far = (
        np.exp(-np.sqrt(metres) * (alpha + beta * np.sqrt(water)))
        for alpha, beta in ((0.006569, -0.002276), (0.01262, -0.00667))
    )
    return 1.9 * near - 0.9 * far


@dataclass(frozen=True)
class Pair:
    """Two marks: the settings of their photos and surfaces, what the photos give, °C, and what the
    photos and the model alone do not know better than to, K."""

    photos: ObjectParameters
    surfaces: Sequence[SurfaceSettings]
    in_photos: Sequence[float]
    own: Sequence[float]

    def stated(self) -> float:
        """± of ΔT as the program has it."""
        capture = CaptureSettings(
            SurfaceSettings(self.photos.emissivity, self.photos.reflected_c), LAW
        )
        budget = Budget(capture, self.photos, accuracy=(2.0, 2.0))
        one, two = (
            of_place(budget, Uncertainty(photos=own), celsius, surface)
            for own, celsius, surface in zip(self.own, self.in_photos, self.surfaces, strict=True)
        )
        return one.of_difference(two)

    def drawn(self) -> float:
        """Half the width of the interval that holds 95 % of the drawn errors of ΔT."""
        rng = np.random.default_rng(0)
        camera = rng.uniform(-1, 1, DRAWS)  # in limits of error
        errors: dict[tuple[str, float], np.ndarray] = {}

        def true(name: str, value: float) -> np.ndarray:
            """A setting as it may really be, the same for both marks where they share it."""
            if (name, value) not in errors:
                errors[name, value] = SIGMA[name] * rng.normal(size=DRAWS)
            error = errors[name, value]
            return value * (1 + error) if name == "distance" else value + error

        at = self.photos
        tau = transmission(at.distance_m, at.atmospheric_c, at.humidity)
        metres, air_c = true("distance", at.distance_m), true("air", at.atmospheric_c)
        true_tau = transmission(metres, air_c, at.humidity)
        air, true_air = signal_of(at.atmospheric_c), signal_of(air_c)
        ends = []
        for own, celsius, surface in zip(self.own, self.in_photos, self.surfaces, strict=True):
            read = celsius + own / 2 * rng.normal(size=DRAWS)
            read += camera * np.maximum(2.0, 0.02 * celsius)
            left = at.emissivity * signal_of(read) + (1 - at.emissivity) * signal_of(at.reflected_c)
            left = (tau * left + (1 - tau) * air - (1 - true_tau) * true_air) / true_tau
            emissivity = true("emissivity", surface.emissivity)
            reflected = signal_of(true("reflected", surface.reflected_c))
            ends.append(celsius_of((left - (1 - emissivity) * reflected) / emissivity))
        low, high = np.percentile(ends[0] - ends[1], [2.5, 97.5])
        return (high - low) / 2


def random_pair(seed: int) -> Pair:
    """Surfaces of up to 60 °C, each with settings of its own, those of the photos, or those of the
    other."""
    rng = np.random.default_rng(seed)
    photos = ObjectParameters(
        emissivity=rng.uniform(0.85, 0.97),
        distance_m=rng.uniform(2, 60),
        reflected_c=rng.uniform(-10, 25),
        atmospheric_c=rng.uniform(-5, 30),
        humidity=rng.uniform(0.3, 0.9),
    )

    def surface() -> SurfaceSettings:
        own = rng.random(2) < (0.6, 0.4)
        return SurfaceSettings(
            rng.uniform(0.3, 0.97) if own[0] else photos.emissivity,
            rng.uniform(-20, 25) if own[1] else photos.reflected_c,
        )

    def shown(surface: SurfaceSettings) -> float:
        """What the photos give, °C."""
        parts = surface.emissivity * signal_of(rng.uniform(5, 60))
        parts += (1 - surface.emissivity) * signal_of(surface.reflected_c)
        parts -= (1 - photos.emissivity) * signal_of(photos.reflected_c)
        return float(celsius_of(parts / photos.emissivity))

    one = surface()
    surfaces = one, one if rng.random() < 0.4 else surface()
    return Pair(photos, surfaces, [shown(each) for each in surfaces], rng.uniform(0.05, 0.5, 2))


@pytest.mark.parametrize("seed", range(30))
def test_the_uncertainty_of_a_difference_is_that_of_a_monte_carlo(seed: int):
    pair = random_pair(seed)
    assert pair.stated() == pytest.approx(pair.drawn(), rel=0.05)


PHOTOS = ObjectParameters(0.9, 10.0, 0.0, 10.0, 0.5)
WALL, METAL = SurfaceSettings(0.9, 0.0), SurfaceSettings(0.3, 0.0)


@pytest.mark.parametrize(
    ("surfaces", "in_photos", "around"),
    [
        ((WALL, WALL), (12.0, 14.0), 0.21),
        ((METAL, WALL), (12.0, 12.0), 7.64),
        ((WALL, WALL), (150.0, 20.0), 3.78),
    ],
)
def test_differences_of_the_decision_page(surfaces, in_photos, around):
    pair = Pair(PHOTOS, surfaces, in_photos, (0.14, 0.14))
    assert pair.stated() == pytest.approx(around, abs=0.005)
    assert pair.drawn() == pytest.approx(around, rel=0.05)


CLEAR_SKY = SurfaceSettings(0.95, -20.0)
BUDGET = Budget(CaptureSettings(CLEAR_SKY), replace(SETTINGS, reflected_c=-20.0))


@pytest.mark.parametrize(("other", "shared"), [(0.6, True), (0.61, False)])
def test_marks_on_surfaces_of_the_same_settings_share_their_errors(other: float, shared: bool):
    beside = replace(BOX, name="B2", points=tuple((x - 1.5, y, z) for x, y, z in BOX.points))
    boxes = replace(BOX, emissivity=0.6), replace(beside, emissivity=other)
    one, two = meter_of(BUDGET).measure(Marks(boxes, reference="B1"))
    own = math.hypot(one.uncertainty.own, two.uncertainty.own)
    emissivities = [each.uncertainty.known["emissivity"] for each in (one, two)]
    if shared:
        assert own < two.difference_uncertainty < 1.05 * own
    else:
        assert two.difference_uncertainty > math.hypot(own, *emissivities) > 2 * own


def test_the_mean_over_two_surfaces_has_of_each_what_its_share_contributes():
    half = replace(BOX, emissivity=0.3, points=tuple((x / 2, y, z) for x, y, z in BOX.points))
    whole = replace(BOX, name="B2")
    found = meter_of(BUDGET).measure(Marks((half, whole)))[1].uncertainty
    shiny = BUDGET.contributions(np.array([21.0]), SurfaceSettings(0.3, -20.0))
    plain = BUDGET.contributions(np.array([22.0]), CLEAR_SKY)
    assert found.shared.keys() == {*shiny, *plain}
    for quantity, part in found.shared.items():
        wanted = sum(each[quantity][0] / 2 for each in (shiny, plain) if quantity in each)
        assert part == pytest.approx(wanted, rel=0.05, abs=0.01)


def test_what_both_share_counts_once():
    emissivity, camera = InputQuantity("emissivity", 0.9), InputQuantity("camera", 1.0)
    other = InputQuantity("camera", 2.0)
    found = shared_difference({emissivity: 0.7, other: 1.9}, {emissivity: 0.5, camera: 1.9})
    assert found == pytest.approx({emissivity: 0.2, camera: -1.9, other: 1.9})
