from __future__ import annotations

import math

import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.render import Rendering
from mrgs.training.image_model import (
    Capture,
    Exposure,
    FixedPattern,
    ImageModel,
    ImageModelConfig,
    PointSpread,
    ThermalPoses,
)

CAPTURE = Capture(views=3, thermal_size=(12, 9), extent=2.0)
ALL = ImageModelConfig(point_spread=True, fixed_pattern=True, exposure=True, thermal_gain=True, thermal_poses=True)


def rendering(seed: int = 0) -> Rendering:
    generator = torch.Generator().manual_seed(seed)
    return Rendering(rgb=torch.rand(9, 12, 3, generator=generator), thermal=torch.rand(9, 12, 1, generator=generator))


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


def test_exposures_average_to_none():
    exposure = Exposure(views=3, channels=2)
    exposure.log_gains.data = torch.tensor([[0.5, 0.0], [0.1, 0.3], [0.0, 0.6]])
    exposure.offsets.data = torch.tensor([[0.1, 0.0], [0.2, 0.0], [0.3, 0.3]])
    ones = [exposure(torch.ones(1, 1, 2), view).detach()[0, 0] for view in range(3)]
    zeros = [exposure(torch.zeros(1, 1, 2), view).detach()[0, 0] for view in range(3)]
    torch.testing.assert_close(torch.stack(zeros).mean(dim=0), torch.zeros(2))
    gains = torch.stack(ones) - torch.stack(zeros)
    torch.testing.assert_close(gains.log().mean(dim=0), torch.zeros(2))
    assert (gains[0] / gains[1]).tolist() == pytest.approx([math.exp(0.4), math.exp(-0.3)])


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


def test_a_view_that_was_not_trained_on_has_no_exposure_of_its_own():
    model, seen = ImageModel(ALL, CAPTURE), rendering()
    model.exposure.offsets.data[0] = 0.3
    model.thermal_gain.offsets.data[0] = 0.3
    assert torch.equal(model(seen, None).rgb, seen.rgb)
    assert not torch.equal(model(seen, 0).rgb, seen.rgb)
    torch.testing.assert_close(model(seen, None).thermal, PointSpread()(seen.thermal))


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
    assert {id(parameter) for parameter in grouped} == {id(parameter) for parameter in model.parameters()}
    assert [group["lr"] for group in model.parameter_groups()] == [5e-3, 1e-4, 1e-3, 1e-3, 5e-4]


def test_a_rate_that_is_no_rate_is_named():
    with pytest.raises(ConfigError, match="the learning rate exposure_rate must be 0 or more, not -1"):
        ImageModelConfig(exposure_rate=-1.0)


@pytest.mark.parametrize("values", [{}, {"views": 1, "thermal_size": [1], "extent": 1.0}, {"views": "x"}])
def test_what_is_no_capture_is_refused(values):
    with pytest.raises((KeyError, TypeError, ValueError)):
        Capture.from_json(values)


def test_a_capture_comes_back_from_json():
    assert Capture.from_json({"views": 3, "thermal_size": [12, 9], "extent": 2.0}) == CAPTURE
