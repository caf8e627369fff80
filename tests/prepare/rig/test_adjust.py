from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.prepare.rig import adjust as adjust_module
from mrgs.prepare.rig.adjust import (
    MOTION,
    Observations,
    Prior,
    ThermalCameras,
    adjust,
    aimed,
    lens_parameters,
    pixel_sigma,
    project,
)
from mrgs.scene.lens import Lens

LENS = Lens(640, 480, 640.0, 641.0, 312.0, 250.0, (-0.2, 0.1, 0.0, 0.0))
VIEWS, PER_VIEW, NOISE_PX = 8, 60, 0.3
MOTION_SIGMA = torch.tensor([0.005] * 3 + [0.05] * 3, dtype=torch.float64)


def observed(outliers: float, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, Observations]:
    """The true rig and motions, and patches with noise, a share of them wild."""
    rng = torch.Generator().manual_seed(seed)
    rig = torch.cat(
        [lens_parameters(LENS), torch.tensor([0.01, 0.03, -0.01, 0.2, 0.05, -0.05]).double()]
    )
    motions = torch.randn(VIEWS, MOTION, generator=rng, dtype=torch.float64) * MOTION_SIGMA
    views = torch.arange(VIEWS).repeat_interleave(PER_VIEW)
    count = len(views)
    depth = 4 + 8 * torch.rand(count, generator=rng, dtype=torch.float64)
    slopes = (torch.rand(count, 2, generator=rng, dtype=torch.float64) - 0.5) * torch.tensor(
        [0.9, 0.7]
    )
    points = torch.cat([slopes * depth[:, None], depth[:, None]], dim=1)
    pixels = project(rig, motions[views], points)
    pixels = pixels + NOISE_PX * torch.randn(count, 2, generator=rng, dtype=torch.float64)
    wild = torch.rand(count, generator=rng) < outliers
    pixels[wild] += 15 * torch.randn(int(wild.sum()), 2, generator=rng, dtype=torch.float64)
    information = torch.eye(2, dtype=torch.float64).expand(count, 2, 2).clone()
    return (
        rig,
        motions,
        Observations(views, points, pixels, information, torch.ones(count).double(), views * 0),
    )


def start_and_prior() -> tuple[ThermalCameras, Prior]:
    rig = torch.zeros(12, dtype=torch.float64)
    rig[:4] = torch.tensor([np.log(620.0), 0.0, 320.0, 240.0])
    sigma = torch.tensor(
        [0.1, 0.005, 20, 20, 0.3, 0.3, 0.3, 0.3, 0.3, 0.4, 0.4, 0.4], dtype=torch.float64
    )
    return ThermalCameras(rig, torch.zeros(VIEWS, MOTION, dtype=torch.float64)), Prior(
        rig, sigma, MOTION_SIGMA
    )


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_the_truth_is_found_within_the_stated_uncertainty(outliers):
    rig, motions, observations = observed(outliers)
    start, prior = start_and_prior()
    found = adjust(observations, prior, start)
    ratios = []
    for view in range(VIEWS):
        points = observations.points[observations.views == view]
        own, true = (m[view].repeat(len(points), 1) for m in (found.cameras.motions, motions))
        error = (project(found.cameras.rig, own, points) - project(rig, true, points)).norm(dim=1)
        assert error.median() < 0.5
        ratios.append(error.square().mean() / pixel_sigma(found, view, points).square().mean())
    assert 0.2 < float(torch.stack(ratios).mean()) < 3.0
    assert 0.8 * (1 - outliers) < float(found.inlier.double().mean()) < 1.05 * (1 - outliers)


def test_what_is_given_stays():
    _, _, observations = observed(0.0)
    start, prior = start_and_prior()
    known = torch.cat([lens_parameters(LENS), start.rig[6:]])
    sigma = prior.rig_sigma.clone()
    sigma[:6] = 0.0
    found = adjust(
        observations, Prior(known, sigma, MOTION_SIGMA), ThermalCameras(known, start.motions)
    )
    assert torch.allclose(found.cameras.rig[:6], known[:6], atol=1e-6)
    assert found.residual_px.median() < 2 * NOISE_PX


def test_fewer_independent_patches_are_less_certain():
    _, _, observations = observed(0.0)
    start, prior = start_and_prior()
    few = replace(observations, independent=0.1 * observations.independent)
    points = observations.points[:PER_VIEW]
    all_sigma, few_sigma = (
        pixel_sigma(adjust(o, prior, start), 0, points).median() for o in (observations, few)
    )
    assert few_sigma > 1.5 * all_sigma


def test_each_kind_is_trusted_as_far_as_its_own_residuals_go():
    rig, motions, precise = observed(0.0)
    start, prior = start_and_prior()
    noise = 3 * torch.randn(
        precise.pixels.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    wild = replace(precise, pixels=precise.pixels + noise, kinds=torch.ones_like(precise.kinds))
    found = adjust(Observations.joined([precise, wild]), prior, start)
    assert found.residual_px[: len(precise.views)].median() < 1.5 * NOISE_PX
    own = precise.views == 0
    points = precise.points[own]
    shown, true = (
        project(r, m[0].repeat(len(points), 1), points)
        for r, m in ((found.cameras.rig, found.cameras.motions), (rig, motions))
    )
    assert (shown - true).norm(dim=1).median() < 0.5


def test_cameras_are_aimed_at_what_they_observe():
    rig, motions, observations = observed(0.0)
    far = motions.clone()
    far[2, :2] += 0.2
    found = aimed(ThermalCameras(rig, far), observations)
    own = observations.views == 2
    before, after = (
        (project(rig, m[observations.views], observations.points) - observations.pixels)[own]
        .mean(dim=0)
        .norm()
        for m in (far, found.motions)
    )
    assert after < 0.2 * before


def normal_equations() -> adjust_module._NormalEquations:
    _, _, observations = observed(0.3)
    start, prior = start_and_prior()
    residual, weight = adjust_module._weights(observations, start.rig, start.motions)
    return adjust_module._normal_equations(
        observations, residual, weight, start.rig, start.motions, prior
    )


def test_eliminating_the_motions_gives_what_the_whole_system_gives():
    equations = normal_equations()
    whole = torch.block_diag(equations.rig, *equations.motions)
    whole[:12, 12:] = equations.coupling.movedim(0, 1).flatten(1)
    whole[12:, :12] = whole[:12, 12:].T
    right = torch.cat([equations.rig_gradient, equations.motion_gradients.flatten()])
    expected, covariance = torch.linalg.solve(whole, right), torch.linalg.inv(whole)
    rig, motions = equations.solution()
    torch.testing.assert_close(torch.cat([rig, motions.flatten()]), expected)
    for view, found in enumerate(equations.covariances()):
        own = [*range(12), *range(12 + MOTION * view, 12 + MOTION * (view + 1))]
        torch.testing.assert_close(found, covariance[own][:, own])


def test_many_pairs_are_solved_one_by_one():
    """The whole system of so many unknowns would take a hundred gigabytes, and days."""
    equations = normal_equations()
    times = 20_000 // VIEWS
    repeated = adjust_module._NormalEquations(
        times * equations.rig,
        equations.coupling.repeat(times, 1, 1),
        equations.motions.repeat(times, 1, 1),
        times * equations.rig_gradient,
        equations.motion_gradients.repeat(times, 1),
    )
    rig, motions = equations.solution()
    many_rig, many_motions = repeated.solution()
    torch.testing.assert_close(many_rig, rig)
    torch.testing.assert_close(many_motions, motions.repeat(times, 1))
