from __future__ import annotations

import math

import pytest
import torch

from mrgs.method.camera_model.photo_gain import PhotoGain, expected_gains
from mrgs.scene.capture import Viewpoint

AHEAD = (0.0, 0.0, 1.0)


def along_a_line(count: int) -> list[Viewpoint]:
    return [Viewpoint((0.1 * x, 0.0, 0.0), AHEAD) for x in range(count)]


def centred(gains: torch.Tensor) -> torch.Tensor:
    return gains - gains.mean(dim=0)


def test_gains_average_to_none():
    photo_gain = PhotoGain(along_a_line(3))
    photo_gain.log_gains.data = torch.tensor([[0.5], [0.1], [0.0]])
    photo_gain.offsets.data = torch.tensor([[0.1], [0.2], [0.6]])
    every = map(photo_gain.of, torch.arange(3).split(1))
    gains, offsets = (torch.stack(column).detach() for column in zip(*every, strict=True))
    torch.testing.assert_close(offsets.mean(dim=0), torch.zeros(1))
    torch.testing.assert_close(gains.log().mean(dim=0), torch.zeros(1))
    assert (gains[0] / gains[1]).item() == pytest.approx(math.exp(0.4))


def test_a_view_without_a_photo_has_no_gain():
    first, *_, last = along_a_line(7)
    photo_gain = PhotoGain([first, None, None, None, last])
    photo_gain.offsets.data = torch.tensor([[0.3], [0.1]])
    assert photo_gain.of(torch.tensor([4])).offset.item() == pytest.approx(-0.1)
    assert photo_gain.expected(last).offset.item() == pytest.approx(-0.1)
    assert len(photo_gain.offsets) == 2


def test_a_gain_is_a_factor_and_an_offset():
    photo_gain = PhotoGain(along_a_line(2))
    photo_gain.log_gains.data = torch.tensor([[0.2], [-0.2]])
    photo_gain.offsets.data = torch.tensor([[0.05], [-0.05]])
    image = torch.rand(3, 4, 1)
    torch.testing.assert_close(
        photo_gain.of(torch.tensor([0])).apply(image), math.exp(0.2) * image + 0.05
    )


def test_gains_that_change_slowly_are_predicted_by_their_neighbours():
    viewpoints = along_a_line(40)
    gains = centred(torch.sin(torch.arange(40.0) / 6)[:, None].double())
    found = expected_gains(gains, viewpoints, Viewpoint((1.23, 0.0, 0.0), AHEAD))
    exact = math.sin(12.3 / 6) - torch.sin(torch.arange(40.0) / 6).mean().item()
    assert found.item() == pytest.approx(exact, abs=0.05)


def test_random_gains_are_not_predicted():
    generator = torch.Generator().manual_seed(0)
    gains = centred(torch.randn(200, 1, generator=generator, dtype=torch.float64))
    viewpoints = along_a_line(200)
    found = [
        expected_gains(gains, viewpoints, Viewpoint((0.1 * x + 0.05, 0.0, 0.0), AHEAD)).abs()
        for x in range(0, 199, 9)
    ]
    assert torch.cat(found).max() < 0.2 * gains.std()


def test_each_column_is_trusted_by_itself():
    generator = torch.Generator().manual_seed(0)
    slow = torch.arange(200.0, dtype=torch.float64) / 100
    gains = centred(
        torch.stack([slow, torch.randn(200, generator=generator, dtype=torch.float64)], dim=1)
    )
    found = expected_gains(gains, along_a_line(200), Viewpoint((15.03, 0.0, 0.0), AHEAD))
    assert found[0].item() == pytest.approx(0.5, abs=0.02)
    assert abs(found[1].item()) < 0.3


def test_cameras_that_look_elsewhere_are_far_away():
    viewpoints = [
        Viewpoint((0.0, 0.0, 0.01 * x), direction)
        for x in range(10)
        for direction in (AHEAD, (1.0, 0.0, 0.0))
    ]
    gains = centred(torch.tensor([1.0, -1.0]).repeat(10)[:, None].double())
    assert expected_gains(
        gains, viewpoints, Viewpoint((0.0, 0.0, 0.033), AHEAD)
    ).item() == pytest.approx(1)
    assert expected_gains(
        gains, viewpoints, Viewpoint((0.0, 0.0, 0.033), (1.0, 0.0, 0.0))
    ).item() == pytest.approx(-1)


def test_a_photo_that_was_learned_from_keeps_its_own():
    gains = torch.tensor([[1.0], [-1.0], [0.5], [-0.5], [0.0]]).double()
    assert expected_gains(gains, along_a_line(5), Viewpoint((0.2, 0.0, 0.0), AHEAD)).item() == 0.5


def test_photos_from_one_place_predict_nothing():
    gains = centred(
        torch.randn(40, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )
    found = expected_gains(
        gains, [Viewpoint((1.0, 2.0, 3.0), AHEAD)] * 40, Viewpoint((1.0, 2.0, 3.0), AHEAD)
    )
    assert found.abs() < 0.3 * gains.std()


def test_far_from_the_origin_a_photo_is_still_itself():
    viewpoints = [Viewpoint((5_000 + 0.1 * x, -8_000.0, 300.0), AHEAD) for x in range(60)]
    gains = centred(
        torch.randn(60, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    )
    assert [
        expected_gains(gains, viewpoints, viewpoint).item() for viewpoint in viewpoints
    ] == gains[:, 0].tolist()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_photos_predict_nothing(count):
    gains = centred(torch.arange(float(count))[:, None].double())
    assert (
        expected_gains(gains, along_a_line(count), Viewpoint((0.05, 0.0, 0.0), AHEAD)).item() == 0
    )
