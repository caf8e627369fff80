from __future__ import annotations

import math

import pytest
import torch

from mrgs.method.camera_model.exposure import Exposure, Look, expected_settings

AHEAD = (0.0, 0.0, 1.0)


def along_a_line(count: int) -> list[Look]:
    return [Look((0.1 * x, 0.0, 0.0), AHEAD) for x in range(count)]


def centred(settings: torch.Tensor) -> torch.Tensor:
    return settings - settings.mean(dim=0)


def test_exposures_average_to_none():
    exposure = Exposure(along_a_line(3), channels=2)
    exposure.log_gains.data = torch.tensor([[0.5, 0.0], [0.1, 0.3], [0.0, 0.6]])
    exposure.offsets.data = torch.tensor([[0.1, 0.0], [0.2, 0.0], [0.3, 0.3]])
    gains, offsets = (
        torch.stack(column).detach() for column in zip(*map(exposure.of, range(3)), strict=True)
    )
    torch.testing.assert_close(offsets.mean(dim=0), torch.zeros(2))
    torch.testing.assert_close(gains.log().mean(dim=0), torch.zeros(2))
    assert (gains[0] / gains[1]).tolist() == pytest.approx([math.exp(0.4), math.exp(-0.3)])


def test_a_view_without_a_photo_has_no_setting():
    first, *_, last = along_a_line(7)
    exposure = Exposure([first, None, None, None, last], channels=1)
    exposure.offsets.data = torch.tensor([[0.3], [0.1]])
    assert exposure.of(4).offset.item() == pytest.approx(-0.1)
    assert exposure.expected(last).offset.item() == pytest.approx(-0.1)
    assert len(exposure.offsets) == 2


def test_a_setting_is_a_gain_and_an_offset():
    exposure = Exposure(along_a_line(2), channels=1)
    exposure.log_gains.data = torch.tensor([[0.2], [-0.2]])
    exposure.offsets.data = torch.tensor([[0.05], [-0.05]])
    image = torch.rand(3, 4, 1)
    torch.testing.assert_close(exposure.of(0).expose(image), math.exp(0.2) * image + 0.05)


def test_settings_that_change_slowly_are_told_by_their_neighbours():
    looks = along_a_line(40)
    settings = centred(torch.sin(torch.arange(40.0) / 6)[:, None].double())
    found = expected_settings(settings, looks, Look((1.23, 0.0, 0.0), AHEAD))
    exact = math.sin(12.3 / 6) - torch.sin(torch.arange(40.0) / 6).mean().item()
    assert found.item() == pytest.approx(exact, abs=0.05)


def test_random_settings_are_not_handed_on():
    generator = torch.Generator().manual_seed(0)
    settings = centred(torch.randn(200, 1, generator=generator, dtype=torch.float64))
    looks = along_a_line(200)
    told = [
        expected_settings(settings, looks, Look((0.1 * x + 0.05, 0.0, 0.0), AHEAD)).abs()
        for x in range(0, 199, 9)
    ]
    assert torch.cat(told).max() < 0.2 * settings.std()


def test_each_setting_is_trusted_by_itself():
    generator = torch.Generator().manual_seed(0)
    slow = torch.arange(200.0, dtype=torch.float64) / 100
    settings = centred(
        torch.stack([slow, torch.randn(200, generator=generator, dtype=torch.float64)], dim=1)
    )
    found = expected_settings(settings, along_a_line(200), Look((15.03, 0.0, 0.0), AHEAD))
    assert found[0].item() == pytest.approx(0.5, abs=0.02)
    assert abs(found[1].item()) < 0.3


def test_cameras_that_look_elsewhere_are_far_away():
    looks = [
        Look((0.0, 0.0, 0.01 * x), direction)
        for x in range(10)
        for direction in (AHEAD, (1.0, 0.0, 0.0))
    ]
    settings = centred(torch.tensor([1.0, -1.0]).repeat(10)[:, None].double())
    assert expected_settings(
        settings, looks, Look((0.0, 0.0, 0.033), AHEAD)
    ).item() == pytest.approx(1)
    assert expected_settings(
        settings, looks, Look((0.0, 0.0, 0.033), (1.0, 0.0, 0.0))
    ).item() == pytest.approx(-1)


def test_a_photo_that_was_learned_from_keeps_its_own():
    settings = torch.tensor([[1.0], [-1.0], [0.5], [-0.5], [0.0]]).double()
    assert expected_settings(settings, along_a_line(5), Look((0.2, 0.0, 0.0), AHEAD)).item() == 0.5


def test_photos_from_one_place_cannot_be_told_apart():
    settings = centred(
        torch.randn(40, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )
    found = expected_settings(
        settings, [Look((1.0, 2.0, 3.0), AHEAD)] * 40, Look((1.0, 2.0, 3.0), AHEAD)
    )
    assert found.abs() < 0.3 * settings.std()


def test_far_from_the_origin_a_photo_is_still_itself():
    looks = [Look((5_000 + 0.1 * x, -8_000.0, 300.0), AHEAD) for x in range(60)]
    settings = centred(
        torch.randn(60, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )
    assert [expected_settings(settings, looks, look).item() for look in looks] == settings[
        :, 0
    ].tolist()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_photos_tell_nothing(count):
    settings = centred(torch.arange(float(count))[:, None].double())
    assert (
        expected_settings(settings, along_a_line(count), Look((0.05, 0.0, 0.0), AHEAD)).item() == 0
    )
