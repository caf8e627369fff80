from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.data.radiometric.measurement import Measurement
from mrgs.scene import Blend, TemperatureRange
from mrgs.scene.air import USUAL_AIR, AirPath
from mrgs.scene.radiometry import BandRadiance, ObjectParameters, PhotoRecord, Planck

LAW = Planck(r1=17_000.0, r2=0.012, b=1_430.0, f=1.0, o=-6_000.0)
NOTED = ObjectParameters(0.9, 5.0, 18.0, 12.0, 0.6)
SCALE = TemperatureRange(-20.0, 80.0)
RADIANCE = BandRadiance.of(SCALE, LAW)
RECORDS = [PhotoRecord(parameters=NOTED, planck=LAW)] * 3


def measurement(distance_m: float) -> Measurement:
    tau = USUAL_AIR.transmission(distance_m, NOTED.atmospheric_c, NOTED.humidity)
    return Measurement(LAW, NOTED, tau)


def signal(celsius: np.ndarray, at: Measurement) -> np.ndarray:
    """What the camera's detector gives, by the measurement formula forwards."""
    p, tau = at.parameters, at.transmission
    own = tau * (p.emissivity * LAW.signals(celsius) + (1 - p.emissivity) * LAW.signal(18.0))
    return own + (1 - tau) * LAW.signal(12.0)


def blend(metres: torch.Tensor, alpha: float = 1.0) -> Blend:
    return Blend(torch.zeros(*metres.shape, 1), alpha * metres, torch.full(metres.shape, alpha))


@pytest.mark.parametrize("alpha", [1.0, 0.7])
def test_a_camera_set_to_another_distance_reads_what_its_formula_says(alpha):
    celsius = np.array([[-15.0, 5.0, 20.0], [40.0, 60.0, 79.0]])
    metres = np.array([[1.0, 5.0, 20.0], [50.0, 100.0, 300.0]])
    expected = [
        [measurement(5.0).celsius(signal(c, measurement(m))) for c, m in zip(*rows, strict=True)]
        for rows in zip(celsius, metres, strict=True)
    ]
    path = AirPath.of(RECORDS, RADIANCE)
    truth = torch.tensor(SCALE.from_celsius(celsius))[:, :, None]
    received = path.received(RADIANCE.of_value(truth), blend(torch.tensor(metres), alpha))
    read = SCALE.to_celsius(RADIANCE.to_value(received))[:, :, 0]
    assert read.numpy() == pytest.approx(np.array(expected), abs=1e-3)
    assert read[0, 1].item() == pytest.approx(5.0, abs=1e-4), "at the noted distance nothing"
    assert read[1, 0].item() < 39.5, "50 m of cold air"


def test_where_nothing_is_seen_nothing_changes():
    path = AirPath.of(RECORDS, RADIANCE)
    radiance = torch.rand(2, 3, 1)
    for seen in (blend(torch.full((2, 3), 90.0), alpha=0.3), Blend.of_image(radiance)):
        assert torch.equal(path.received(radiance, seen), radiance)


def test_the_sky_is_left_as_the_photo_says():
    path, radiance = AirPath.of(RECORDS, RADIANCE, farthest=100.0), torch.rand(1, 2, 1)
    received = path.received(radiance, blend(torch.tensor([[99.0, 101.0]])))
    assert (received == radiance).flatten().tolist() == [False, True]


def test_the_depth_gets_no_gradient():
    path = AirPath.of(RECORDS, RADIANCE)
    depth, radiance = torch.full((2, 3), 40.0, requires_grad=True), torch.rand(2, 3, 1)
    radiance.requires_grad_()
    path.received(radiance, Blend(radiance, depth, torch.ones(2, 3))).sum().backward()
    assert depth.grad is None
    assert (radiance.grad < 1).all()


def test_air_as_cameras_are_delivered_is_not_known():
    delivered = ObjectParameters(0.95, 1.0, 20.0, 20.0, 0.5)
    assert AirPath.of([PhotoRecord(parameters=delivered)], RADIANCE) is None
    given = PhotoRecord(parameters=delivered, given={"atmospheric_c": 20.0})
    assert AirPath.of([given], RADIANCE) is not None, "somebody has said so"
    set_ = replace(delivered, atmospheric_c=-5.0)
    assert AirPath.of([PhotoRecord(parameters=set_)], RADIANCE) is not None


def test_kilometres_of_damp_air_let_something_through():
    damp = ObjectParameters(0.95, 5.0, 18.0, 30.0, 0.9)
    path = AirPath.of([PhotoRecord(parameters=damp)], RADIANCE)
    received = path.received(
        RADIANCE.of_value(torch.full((1, 1, 1), 0.5)), blend(torch.full((1, 1), 5e3))
    )
    assert -20 < SCALE.to_celsius(RADIANCE.to_value(received)).item() < 40
    far = replace(damp, distance_m=3000.0)
    assert AirPath.of([PhotoRecord(parameters=far)], RADIANCE) is None


def test_photos_without_parameters_have_no_known_air():
    assert AirPath.of([PhotoRecord()], RADIANCE) is None
    assert AirPath.of(RECORDS, None) is None
    far = PhotoRecord(parameters=replace(NOTED, distance_m=100.0))
    assert AirPath.of([*RECORDS, far], RADIANCE) == AirPath.of(RECORDS, RADIANCE), "medians"
