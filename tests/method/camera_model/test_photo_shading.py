from __future__ import annotations

import pytest
import torch

from mrgs.method.camera_model.image_model import ImageModel, ImageModelConfig
from mrgs.method.camera_model.photo_drift import PARTS
from mrgs.method.camera_model.photo_shading import (
    TERMS,
    PhotoShading,
    image_places,
    shading_terms,
)
from mrgs.scene import THERMAL, Blend, Pixels, Rendering
from mrgs.scene.capture import Capture, Viewpoint

YES = torch.tensor(True)
TRUE = torch.tensor([-0.03, 0.004, 0.01, 0.006, 0.02, -0.01])
POINTS = tuple(Viewpoint((float(x), 0.0, 0.0), (0.0, 0.0, 1.0)) for x in range(6))


def test_the_terms_are_of_mean_zero_and_independent():
    terms = shading_terms(*image_places(300, 400, TRUE)).view(-1, TERMS)
    assert terms.mean(dim=0).abs().max().item() < 1e-4
    assert torch.linalg.matrix_rank(terms).item() == TERMS


def test_the_gradient_is_that_of_the_definition():
    shading = PhotoShading(6).double()

    def applied(image, coefficients):
        shading.coefficients = coefficients
        return image + shading(6, 8)

    image = torch.rand(6, 8, 1, dtype=torch.float64, requires_grad=True)
    coefficients = TRUE.double().requires_grad_()
    assert torch.autograd.gradcheck(applied, (image, coefficients))


def taught(shading: PhotoShading, times: int = 20) -> PhotoShading:
    generator = torch.Generator().manual_seed(1)
    for _ in range(6 * times):
        left = shading.part_terms @ (TRUE - shading.coefficients)
        shading.learn(left + 0.002 * torch.randn(PARTS**2, generator=generator), YES)
    return shading


def test_what_all_photos_have_in_common_is_learned():
    found = taught(PhotoShading(6))(30, 40)
    true = PhotoShading(6)
    true.begin(TRUE, torch.eye(TERMS))
    assert (found - true(30, 40)).abs().max().item() < 2e-3


def test_a_prior_counts_by_its_precision():
    certain = PhotoShading(6)
    certain.begin(2 * TRUE, 1e12 * torch.eye(TERMS))
    assert taught(certain).coefficients == pytest.approx((2 * TRUE).numpy(), rel=1e-2)
    vague = PhotoShading(6)
    vague.begin(2 * TRUE, torch.eye(TERMS))
    assert taught(vague).coefficients == pytest.approx(TRUE.numpy(), abs=4e-3)
    fixed = PhotoShading(6, fixed=True)
    fixed.begin(2 * TRUE, torch.zeros(TERMS, TERMS))
    assert torch.equal(taught(fixed).coefficients, 2 * TRUE)


def test_failed_steps_and_masked_parts_teach_nothing():
    shading = PhotoShading(6)
    shading.learn(torch.ones(PARTS**2), torch.tensor(False))
    shading.learn(torch.full((PARTS**2,), torch.nan), YES)
    assert not shading.coefficients.any()


def test_the_image_model_shades_every_photo_alike_and_learns_it():
    config = ImageModelConfig(thermal_drift=True, thermal_shading=True)
    model = ImageModel(config, Capture(POINTS, 1.0, has_celsius=True))
    generator = torch.Generator().manual_seed(3)
    image, ones = torch.rand(30, 40, 1, generator=generator), torch.ones(30, 40)
    rendering = Rendering({THERMAL: Blend(image, ones, ones)})
    true = PhotoShading(6)
    true.begin(TRUE, torch.eye(TERMS))
    offsets = torch.tensor([0.05, -0.02, 0.03, -0.02, 0.0, -0.04])
    for _ in range(30):
        for view, offset in enumerate(offsets):
            photo = Pixels(image + offset + true(30, 40))
            recorded = model(rendering, torch.tensor([view]))
            model.learn(view, model.thermal_residual(recorded, photo), YES)
    assert model.thermal_drift.offsets() == pytest.approx(offsets.numpy(), abs=1e-3)
    written = model(rendering, torch.tensor([2]))[THERMAL].image
    assert (written - image - 0.03 - true(30, 40)).abs().max().item() < 2e-3
