from __future__ import annotations

import pytest
import torch

from mrgs.scene import RGB, THERMAL, Gaussians
from mrgs.scene.level_of_detail import merged
from mrgs.scene.rotations import matrix_from_quaternion
from tests.helpers.gaussians import random_gaussians


def covariances(gaussians: Gaussians) -> torch.Tensor:
    rotations = torch.from_numpy(matrix_from_quaternion(gaussians.quats.numpy()))
    return (rotations * gaussians.scales.double()[:, None, :] ** 2) @ rotations.transpose(1, 2)


def test_as_many_as_there_are_leaves_them_alone():
    gaussians = random_gaussians(40)
    found = merged(gaussians, 40)
    assert torch.equal(found.of, torch.arange(40))
    assert found.gaussians is gaussians


def test_one_has_the_moments_of_all():
    gaussians = random_gaussians(30)
    found = merged(gaussians, 1)
    scales = gaussians.scales.double().sort(dim=1).values
    opacity = torch.stack([gaussians.opacity(RGB), gaussians.opacity(THERMAL)]).amax(dim=0)
    weights = opacity * scales[:, 1] * scales[:, 2]
    weights /= weights.sum()
    mean = (weights[:, None] * gaussians.means).sum(dim=0)
    away = gaussians.means - mean
    spread = covariances(gaussians) + away[:, :, None] * away[:, None, :]
    expected = (weights[:, None, None] * spread).sum(dim=0)
    torch.testing.assert_close(found.gaussians.means[0].double(), mean)
    torch.testing.assert_close(covariances(found.gaussians)[0], expected, rtol=1e-4, atol=1e-7)
    temperature = (weights[:, None] * gaussians.sh_dc[THERMAL][:, 0]).sum(dim=0)
    torch.testing.assert_close(found.gaussians.sh_dc[THERMAL][0, 0].double(), temperature)
    torch.testing.assert_close(found.averaged(gaussians.sh_dc[THERMAL])[0, 0].double(), temperature)


@pytest.mark.parametrize("most", [1, 37, 200, 999])
def test_there_are_at_most_as_many_as_asked_for_and_not_far_fewer(most):
    found = merged(random_gaussians(1000), most)
    assert most / 3 <= len(found.gaussians) <= most
    sums = torch.zeros(len(found.gaussians)).index_add_(0, found.of, found.weights)
    torch.testing.assert_close(sums, torch.ones_like(sums))
    assert all(tensor.isfinite().all() for tensor in found.gaussians.tensors().values())


def test_what_lies_apart_stays_apart():
    gaussians = random_gaussians(60)
    gaussians.means = 0.5 + 0.01 * gaussians.means
    gaussians.means[30:] += 5
    found = merged(gaussians, 8)
    assert not set(found.of[:30].tolist()) & set(found.of[30:].tolist())


def test_a_sheet_stays_thin_and_covers_as_much():
    side = torch.linspace(0, 1, 40)
    gaussians = random_gaussians(1600)
    x, y = (each.reshape(-1) for each in torch.meshgrid(side, side, indexing="ij"))
    gaussians.means = torch.stack([x, y, torch.zeros(1600)], dim=1)
    gaussians.quats = torch.tensor([1.0, 0, 0, 0]).repeat(1600, 1)
    gaussians.log_scales = torch.tensor([0.02, 0.02, 1e-4]).log().repeat(1600, 1)
    for modality in gaussians.opacity_logits:
        gaussians.opacity_logits[modality] = torch.full((1600, 1), -3.0)
    found = merged(gaussians, 100).gaussians
    scales = found.scales.sort(dim=1).values
    covered = found.opacity(RGB) * scales[:, 1] * scales[:, 2]
    before = 1600 * torch.tensor(-3.0).sigmoid().item() * 0.02**2
    assert covered.sum().item() == pytest.approx(before, rel=0.01)
    torch.testing.assert_close(scales[:, 0], torch.full((len(found),), 1e-4))
    torch.testing.assert_close(found.means[:, 2], torch.zeros(len(found)))
