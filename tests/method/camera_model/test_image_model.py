from __future__ import annotations

import json
import math
from dataclasses import asdict, replace

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.method.camera_model.point_spread import PointSpread
from mrgs.scene import RGB, THERMAL, Blend, Camera, Rendering, TemperatureRange
from mrgs.scene.air import AirPath
from mrgs.scene.capture import Capture, Viewpoint
from mrgs.scene.radiometry import BandRadiance, ObjectParameters, PhotoRecord
from mrgs.system.typed_json import from_json


def along_a_line(count: int) -> tuple[Viewpoint, ...]:
    return tuple(Viewpoint((float(x), 0.0, 0.0), (0.0, 0.0, 1.0)) for x in range(count))


CAPTURE = Capture((*along_a_line(2), None), extent=2.0, has_celsius=False, finest_focal_px=80.0)
ALL = ImageModelConfig(point_spread=True, thermal_gain=True)


JSON = json.loads(json.dumps(asdict(CAPTURE)))


def camera_at(x: float) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    return Camera(torch.eye(3, dtype=torch.float64), viewmat, 12, 9)


def rendering(seed: int = 0) -> Rendering:
    generator = torch.Generator().manual_seed(seed)
    return Rendering(
        {
            modality: Blend(
                torch.rand(9, 12, modality.channels, generator=generator),
                torch.ones(9, 12),
                torch.ones(9, 12),
            )
            for modality in (RGB, THERMAL)
        }
    )


def point_spread(sigma_px: float) -> PointSpread:
    spread = PointSpread()
    spread.log_sigma.data.fill_(math.log(sigma_px))
    return spread


def test_air_is_between_the_object_and_the_lens():
    radiance = BandRadiance.of(TemperatureRange(-20.0, 100.0))
    noted = ObjectParameters(0.95, 1.0, 20.0, 5.0, 0.5)
    air = AirPath.of([PhotoRecord(parameters=noted)], radiance, farthest=500.0)
    capture = replace(CAPTURE, has_celsius=True, radiance=radiance, air=air)
    assert from_json(Capture, json.loads(json.dumps(asdict(capture)))) == capture
    seen, view = rendering(), torch.zeros(1, dtype=torch.int64)
    far = seen[THERMAL]._replace(depth=torch.linspace(2.0, 90.0, 12).expand(9, 12))
    config = replace(ALL, radiance=True, air=True)
    model = ImageModel(config, capture)
    received = air.received(radiance.of_value(far.image), far)
    expected = radiance.to_value(model.point_spread(received))
    found = model(Rendering({THERMAL: far}), view)[THERMAL].image
    torch.testing.assert_close(found, expected)
    colder = model(Rendering({THERMAL: far._replace(image=torch.ones(9, 12, 1))}), view)
    across = colder[THERMAL].image[4, 2:-2, 0].diff()
    assert (across < 0).all(), "the farther the colder, of a hot wall in cold air"
    for without in (replace(config, air=False), replace(config, radiance=False)):
        assert ImageModel(without, capture).air is None


@pytest.mark.parametrize("start_px", [0.8, 0.01])
def test_the_width_of_a_spread_is_found_from_photos(start_px):
    sharp = torch.rand(30, 40, 1, generator=torch.Generator().manual_seed(1))
    photo = point_spread(1.3)(sharp).detach()
    found = point_spread(start_px)
    adam = torch.optim.Adam(found.parameters(), lr=0.02)
    for _ in range(150):
        adam.zero_grad()
        (found(sharp) - photo).abs().mean().backward()
        adam.step()
        found.limit()
    assert found.sigma_px.item() == pytest.approx(1.3, abs=0.01)


def test_the_lens_blurs_radiance_in_scenes_with_celsius():
    radiance = BandRadiance.of(TemperatureRange(-20.0, 100.0))
    capture = replace(CAPTURE, has_celsius=True, radiance=radiance)
    config, seen, view = replace(ALL, radiance=True), rendering(), torch.zeros(1, dtype=torch.int64)
    model, sharp = ImageModel(config, capture), seen[THERMAL].image
    expected = radiance.to_value(model.point_spread(radiance.of_value(sharp)))
    found = model(seen, view)[THERMAL].image
    torch.testing.assert_close(found, expected)
    assert (found - model.point_spread(sharp)).abs().max() > 0.01
    for other in (ImageModel(ALL, capture), ImageModel(config, replace(capture, radiance=None))):
        torch.testing.assert_close(other(seen, view)[THERMAL].image, other.point_spread(sharp))


def test_a_capture_remembers_its_radiance_and_older_ones_have_none():
    capture = replace(CAPTURE, radiance=BandRadiance.of(TemperatureRange(-20.0, 100.0)))
    written = json.loads(json.dumps(asdict(capture)))
    assert from_json(Capture, written) == capture
    del written["radiance"]
    assert from_json(Capture, written).radiance is None


def test_what_cameras_write_does_not_change_their_model():
    model = ImageModel(ALL, CAPTURE)
    model.point_spread = point_spread(0.1)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    model(rendering(), torch.tensor([1]))
    model.expected(rendering(), camera_at(0.3))
    after = model.state_dict()
    assert [name for name in before if not torch.equal(after[name], before[name])] == []


def test_nothing_is_done_unless_it_is_asked_for():
    model, seen = ImageModel(ImageModelConfig(), CAPTURE), rendering()
    written = model(seen, torch.tensor([0]))
    assert all(torch.equal(written[each].image, seen[each].image) for each in (RGB, THERMAL))
    assert (list(model.parameters()), model.parameter_groups()) == ([], [])


def test_at_the_start_only_the_spread_changes_anything():
    model, seen = ImageModel(ALL, CAPTURE), rendering()
    written = model(seen, torch.tensor([1]))
    assert written[RGB].image is seen[RGB].image
    torch.testing.assert_close(written[THERMAL].image, PointSpread()(seen[THERMAL].image))
    assert model.point_spread.sigma_px.item() == pytest.approx(0.8)


def test_a_photo_that_was_not_learned_from_is_expected_to_have_its_neighbours_gain():
    model = ImageModel(ALL, replace(CAPTURE, thermal_viewpoints=along_a_line(20)))
    seen = rendering()
    model.thermal_gain.offsets.data[10:] = 0.2
    written = model.expected(seen, camera_at(2 * 15.4))
    assert written[RGB].image is seen[RGB].image
    expected = model.point_spread(seen[THERMAL].image) + 0.1
    torch.testing.assert_close(written[THERMAL].image, expected, atol=0.01, rtol=0)
    at_a_photo = model.expected(seen, camera_at(2 * 15.0))[THERMAL].image
    torch.testing.assert_close(at_a_photo, model(seen, torch.tensor([15]))[THERMAL].image)


def test_thermal_photos_in_celsius_have_no_gain():
    assert ImageModel(ALL, CAPTURE).thermal_gain is not None
    assert ImageModel(ALL, replace(CAPTURE, has_celsius=True)).thermal_gain is None


def test_without_thermal_photos_there_is_no_gain():
    model = ImageModel(ALL, replace(CAPTURE, thermal_viewpoints=(None,) * 3))
    assert model.thermal_gain is None
    assert model.expected(rendering(), camera_at(0.3))[THERMAL].image.isfinite().all()


def test_a_modality_that_is_not_there_stays_away():
    model = ImageModel(ALL, CAPTURE)
    seen = rendering()
    for modality in (RGB, THERMAL):
        assert set(model(Rendering({modality: seen[modality]}), torch.tensor([0]))) == {modality}


def test_every_parameter_has_a_learning_rate():
    model = ImageModel(ALL, CAPTURE)
    grouped = [parameter for group in model.parameter_groups() for parameter in group.parameters]
    assert {id(parameter) for parameter in grouped} == {
        id(parameter) for parameter in model.parameters()
    }
    assert [group.rate for group in model.parameter_groups()] == [5e-3, 1e-3]


def test_a_rate_that_is_no_rate_is_named():
    with pytest.raises(ConfigError, match=r"thermal_gain_rate .*-1"):
        ImageModelConfig(thermal_gain_rate=-1.0)


@pytest.mark.parametrize(
    "values",
    [
        {},
        JSON | {"thermal_viewpoints": [[[0, 0], [0, 0, 1]]]},
        JSON | {"thermal_viewpoints": [1]},
        JSON | {"finest_focal_px": 0.0},
    ],
)
def test_what_is_no_capture_is_refused(values):
    with pytest.raises((KeyError, TypeError, ValueError)):
        from_json(Capture, values)


def test_a_capture_comes_back_from_json():
    assert from_json(Capture, JSON) == CAPTURE


def test_a_capture_of_an_older_version_knows_no_focal_length():
    del (older := dict(JSON))["finest_focal_px"]
    assert from_json(Capture, older) == replace(CAPTURE, finest_focal_px=None)
