from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from mrgs.evaluation.metrics import (
    Missing,
    fill_invalid,
    mean_absolute_error,
    mean_absolute_error_after_offset,
    otsu_threshold,
    psnr,
    psnr_matched,
    ssim,
    ssim_pair_range,
)

Metric = Callable[..., float]


@pytest.fixture(scope="module")
def theirs() -> ModuleType:
    """The metrics of torchmetrics, which takes a second to import."""
    return importlib.import_module("torchmetrics.functional.image")


def pair(channels: int = 3, low: float = 0.2, high: float = 0.7) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(7)
    target = low + (high - low) * torch.rand(30, 40, channels, generator=generator)
    return (target + 0.05 * torch.randn(target.shape, generator=generator)).clamp(0, 1), target


def as_batch(image: Tensor) -> Tensor:
    return image.permute(2, 0, 1)[None].double()


def test_psnr_of_a_constant_error() -> None:
    target = torch.full((4, 5, 3), 0.5)
    assert psnr(target + 0.1, target) == pytest.approx(20.0, abs=1e-5)
    assert psnr(target, target) == math.inf


def test_psnr_clamps_the_rendering() -> None:
    target = torch.ones(4, 5, 1)
    assert psnr(target * 3, target) == math.inf


@pytest.mark.slow
def test_psnr_agrees_with_torchmetrics(theirs) -> None:
    image, target = pair()
    expected = theirs.peak_signal_noise_ratio(as_batch(image), as_batch(target), data_range=1.0)
    assert psnr(image, target) == pytest.approx(expected.item(), rel=1e-6)


@pytest.mark.parametrize("channels", [1, 3])
def test_matched_psnr_is_that_of_the_least_squares_fit(channels: int) -> None:
    image, target = pair(channels)
    planes = []
    for channel in range(channels):
        inside, goal = (
            image[..., channel].double().flatten(),
            target[..., channel].double().flatten(),
        )
        design = torch.stack([inside, torch.ones_like(inside)], dim=1)
        planes.append(
            (design @ torch.linalg.lstsq(design, goal[:, None]).solution).reshape(image.shape[:2])
        )
    assert psnr_matched(image, target) == pytest.approx(
        psnr(torch.stack(planes, dim=2), target), rel=1e-9
    )
    assert psnr_matched(image, target) > psnr(image, target)


@given(gain=st.floats(0.5, 1.4), offset=st.floats(-0.1, 0.1))
def test_matched_psnr_does_not_see_how_a_photo_is_scaled(gain: float, offset: float) -> None:
    _, target = pair()
    assert psnr_matched((target - offset) / gain * 0.5 + 0.1, target) > 100


def test_matched_psnr_of_a_uniform_rendering_is_that_of_the_mean() -> None:
    _, target = pair(1)
    mean = torch.full_like(target, target.double().mean().item())
    assert psnr_matched(torch.full_like(target, 0.9), target) == pytest.approx(
        psnr(mean, target), rel=1e-6
    )


def test_no_camera_turns_a_photo_into_its_negative() -> None:
    _, target = pair(1)
    mean = torch.full_like(target, target.double().mean().item())
    assert psnr_matched(1 - target, target) == pytest.approx(psnr(mean, target), rel=1e-6)


def test_a_uniform_photo_matches_everything() -> None:
    image, _ = pair()
    figure = psnr_matched(image, torch.full_like(image, 0.3))
    assert isinstance(figure, Missing)
    assert "uniform" in figure.reason


def test_mean_absolute_error_after_offset_by_hand() -> None:
    target = torch.tensor([[10.0, 11.0, 12.0, 40.0]])
    image = target + 5 + torch.tensor([[0.0, 0.3, -0.3, 2.0]])
    valid = torch.tensor([[True, True, True, False]])
    assert mean_absolute_error_after_offset(image, target, valid) == pytest.approx(0.2, abs=1e-6)
    error = torch.tensor([2.0, 2.0, 2.0, 6.0])
    assert mean_absolute_error_after_offset(error, torch.zeros(4)) == pytest.approx(1.0)


def test_mean_absolute_error_by_hand() -> None:
    image, target = torch.tensor([[[1.0], [2.0]]]), torch.tensor([[[0.0], [5.0]]])
    assert mean_absolute_error(image, target) == 2.0
    assert mean_absolute_error(image, target, torch.tensor([[True, False]])) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("channels", [1, 3])
def test_ssim_pair_range_is_torchmetrics_default_away_from_the_border(
    channels: int, theirs
) -> None:
    image, target = pair(channels)
    _, similarity = theirs.structural_similarity_index_measure(
        as_batch(image), as_batch(target), return_full_image=True
    )
    expected = similarity[..., 5:-5, 5:-5].mean().item()
    assert ssim_pair_range(image, target) == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_ssim_is_torchmetrics_at_range_one_but_for_the_padding(theirs) -> None:
    _, target = pair()
    image, target = (
        torch.nn.functional.pad(x, (0, 0, 12, 12, 12, 12)) for x in (target * 0.8, target)
    )  # black frame
    _, similarity = theirs.structural_similarity_index_measure(
        as_batch(image), as_batch(target), data_range=1.0, return_full_image=True
    )
    assert ssim(image, target) == pytest.approx(similarity.mean().item(), rel=1e-9)


def test_pair_range_reads_lower_than_range_one() -> None:
    image, target = pair(1, 0.4, 0.5)
    assert ssim_pair_range(image, target) < ssim(image, target)


@pytest.mark.parametrize("metric", [ssim, ssim_pair_range])
def test_ssim_of_identical_images_is_one(metric: Metric) -> None:
    _, target = pair()
    assert metric(target, target) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("metric", [psnr, psnr_matched, ssim, ssim_pair_range, mean_absolute_error])
def test_nothing_outside_the_mask_counts(metric: Metric) -> None:
    image, target = pair()
    valid = torch.zeros(30, 40, dtype=torch.bool)
    valid[3:27, 5:35] = True
    spoiled = image.clone()
    spoiled[~valid] = torch.rand_like(spoiled[~valid])
    assert metric(spoiled, target, valid) == metric(image, target, valid)
    assert metric(spoiled, target) != metric(image, target)


def test_a_full_mask_is_no_mask() -> None:
    image, target = pair()
    valid = torch.ones(30, 40, dtype=torch.bool)
    for metric in (psnr, psnr_matched, ssim, ssim_pair_range, mean_absolute_error):
        assert metric(image, target, valid) == pytest.approx(metric(image, target), rel=1e-12)


def test_fill_invalid_takes_the_target() -> None:
    image, target = pair()
    valid = torch.zeros(30, 40, dtype=torch.bool)
    valid[0] = True
    filled = fill_invalid(image, target, valid)
    assert torch.equal(filled[0], image[0])
    assert torch.equal(filled[1:], target[1:])


def test_uniform_images_have_no_pair_range() -> None:
    flat = torch.full((20, 20, 1), 0.5)
    figure = ssim_pair_range(flat, flat)
    assert isinstance(figure, Missing)
    assert "uniform" in figure.reason


def test_an_image_without_a_whole_window_has_no_pair_range_ssim() -> None:
    figure = ssim_pair_range(torch.rand(10, 40, 1), torch.rand(10, 40, 1))
    assert isinstance(figure, Missing)
    assert "window" in figure.reason


def test_otsu_parts_two_modes() -> None:
    generator = np.random.default_rng(0)
    cold, warm = generator.normal(20, 1, 5000), generator.normal(40, 2, 1000)
    threshold = otsu_threshold(np.concatenate([cold, warm]))
    assert cold.max() - 0.5 < threshold < warm.min() + 0.5


def test_otsu_matches_an_exhaustive_search() -> None:
    values = np.random.default_rng(1).gamma(2.0, 1.0, 400)
    edges = np.histogram_bin_edges(values, 256)

    def within_class_variance(threshold: float) -> float:
        classes = values[values <= threshold], values[values > threshold]
        return sum(part.size * part.var() for part in classes)

    best = min(within_class_variance(edge) for edge in edges[1:-1])
    assert (
        within_class_variance(otsu_threshold(values)) <= best * 1.001
    )  # the histogram rounds values to bin centres


def test_a_uniform_image_has_no_threshold() -> None:
    assert otsu_threshold(np.full(9, 0.3)) is None


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.integers(0, 255), min_size=2, max_size=60), st.floats(0.1, 50), st.floats(-100, 100)
)
def test_otsu_foreground_does_not_depend_on_the_unit(
    levels: list[int], scale: float, shift: float
) -> None:
    values = np.array(levels, dtype=np.float64)
    threshold = otsu_threshold(values)
    if threshold is None:
        assert len(set(levels)) == 1
        return
    assert values.min() < threshold <= values.max()
    in_other_unit = otsu_threshold(values * scale + shift)
    assert in_other_unit == pytest.approx(
        threshold * scale + shift, abs=scale * (np.ptp(values) / 128 + 1e-6)
    )
