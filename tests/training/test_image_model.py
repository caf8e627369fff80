from __future__ import annotations

import json
import math

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.method.camera_model.exposure import Look
from mrgs.method.camera_model.image_model import (
    Capture,
    FixedPattern,
    ImageModel,
    ImageModelConfig,
    PointSpread,
    ThermalPoses,
)
from mrgs.render import Rendering
from mrgs.scene import Camera

LOOKS = tuple(Look((float(x), 0.0, 0.0), (0.0, 0.0, 1.0)) for x in range(3))
CAPTURE = Capture(LOOKS, (*LOOKS[:2], None), thermal_size=(12, 9), extent=2.0, has_celsius=False)
ALL = ImageModelConfig(
    point_spread=True, fixed_pattern=True, exposure=True, thermal_gain=True, thermal_poses=True
)


JSON = json.loads(json.dumps(CAPTURE._asdict()))


def camera_at(x: float) -> Camera:
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    return Camera(torch.eye(3, dtype=torch.float64), viewmat, 12, 9)


def rendering(seed: int = 0) -> Rendering:
    generator = torch.Generator().manual_seed(seed)
    return Rendering(
        rgb=torch.rand(9, 12, 3, generator=generator),
        thermal=torch.rand(9, 12, 1, generator=generator),
    )


def point_spread(sigma_px: float) -> PointSpread:
    spread = PointSpread()
    spread.log_sigma.data.fill_(math.log(sigma_px))
    return spread


def test_the_width_of_a_spread_is_found_from_photos():
    sharp = torch.rand(30, 40, 1, generator=torch.Generator().manual_seed(1))
    photo = point_spread(1.3)(sharp).detach()
    found = PointSpread()
    adam = torch.optim.Adam(found.parameters(), lr=0.02)
    for _ in range(150):
        adam.zero_grad()
        (found(sharp) - photo).abs().mean().backward()
        adam.step()
    assert found.sigma_px.item() == pytest.approx(1.3, abs=0.01)


def test_a_pattern_adds_offsets_of_mean_zero():
    pattern = FixedPattern((12, 9))
    pattern.columns.data += torch.arange(12)
    pattern.rows.data += 5.0
    offsets = pattern(torch.zeros(9, 12, 1)).detach()[..., 0]
    torch.testing.assert_close(offsets, (torch.arange(12) - 5.5).expand(9, 12))


def test_a_motion_is_a_rotation_and_a_translation_in_extents():
    poses = ThermalPoses(views=2, extent=2.0)
    assert torch.equal(poses(0), torch.eye(4))
    poses.twists[1].data = torch.tensor([0.0, 0.0, math.pi / 2, 0.5, 0.0, 1.0])
    expected = torch.tensor([[0.0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]])
    torch.testing.assert_close(poses(1), expected)


def test_nothing_is_done_unless_it_is_asked_for():
    model, seen = ImageModel(ImageModelConfig(), CAPTURE), rendering()
    assert model(seen, 0) == seen
    assert model.thermal_motion(0) is None
    assert (list(model.parameters()), model.parameter_groups()) == ([], [])


def test_at_the_start_only_the_spread_changes_anything():
    model, seen = ImageModel(ALL, CAPTURE), rendering()
    written = model(seen, 1)
    assert torch.equal(written.rgb, seen.rgb)
    torch.testing.assert_close(written.thermal, PointSpread()(seen.thermal))


def test_a_photo_that_was_not_learned_from_is_exposed_like_those_beside_it():
    looks = tuple(Look((float(x), 0.0, 0.0), (0.0, 0.0, 1.0)) for x in range(20))
    model, seen = (
        ImageModel(ALL, CAPTURE._replace(rgb_looks=looks, thermal_looks=looks)),
        rendering(),
    )
    model.exposure.offsets.data[10:] = 0.2
    model.thermal_gain.offsets.data[10:] = 0.2
    model.fixed_pattern.columns.data += torch.arange(12)
    written = model.expected(seen, camera_at(2 * 15.4))
    torch.testing.assert_close(written.rgb, seen.rgb + 0.1, atol=0.01, rtol=0)
    pattern = model.fixed_pattern(torch.zeros_like(seen.thermal))
    expected = model.point_spread(seen.thermal) + 0.1 + pattern
    torch.testing.assert_close(written.thermal, expected, atol=0.01, rtol=0)
    torch.testing.assert_close(model.expected(seen, camera_at(2 * 15.0)).rgb, model(seen, 15).rgb)


def test_thermal_photos_in_celsius_have_no_gain():
    assert ImageModel(ALL, CAPTURE).thermal_gain is not None
    assert ImageModel(ALL, CAPTURE._replace(has_celsius=True)).thermal_gain is None


def test_without_photos_of_a_modality_nothing_is_learned_of_them():
    model = ImageModel(ALL, CAPTURE._replace(rgb_looks=(None,) * 3))
    assert (model.exposure, model.thermal_gain is None) == (None, False)
    model = ImageModel(ALL, CAPTURE._replace(thermal_looks=(None,) * 3))
    assert (model.exposure is None, model.thermal_gain) == (False, None)
    assert model.expected(rendering(), camera_at(0.3)).thermal is not None


def test_photos_of_several_sizes_have_no_pattern_in_common():
    model = ImageModel(ALL, CAPTURE._replace(thermal_size=None))
    assert model.fixed_pattern is None


def test_a_modality_that_is_not_there_stays_away():
    model = ImageModel(ALL, CAPTURE)
    assert model(rendering()._replace(rgb=None), 0).rgb is None
    assert model(rendering()._replace(thermal=None), 0).thermal is None


def test_every_parameter_has_a_learning_rate():
    model = ImageModel(ALL, CAPTURE)
    grouped = [parameter for group in model.parameter_groups() for parameter in group["params"]]
    assert {id(parameter) for parameter in grouped} == {
        id(parameter) for parameter in model.parameters()
    }
    assert [group["lr"] for group in model.parameter_groups()] == [5e-3, 1e-4, 1e-3, 1e-3, 5e-4]


def test_a_rate_that_is_no_rate_is_named():
    with pytest.raises(
        ConfigError, match="the learning rate exposure_rate must be 0 or more, not -1"
    ):
        ImageModelConfig(exposure_rate=-1.0)


@pytest.mark.parametrize(
    "values",
    [
        {},
        JSON | {"thermal_size": [1]},
        JSON | {"rgb_looks": [[[0, 0], [0, 0, 1]]]},
        JSON | {"rgb_looks": [1]},
    ],
)
def test_what_is_no_capture_is_refused(values):
    with pytest.raises((KeyError, TypeError, ValueError)):
        Capture.from_json(values)


def test_a_capture_comes_back_from_json():
    assert Capture.from_json(JSON) == CAPTURE
