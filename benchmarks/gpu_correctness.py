"""Is it right on this device? Everything that has kernels there, beside the oracles in double
precision."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks import workload
from benchmarks.gpu_failure import failure
from benchmarks.gpu_plan import SCENE, Plan
from benchmarks.gpu_workload import RandomScene, photos_on, random_scene
from benchmarks.workload import training_state
from mrgs.data import load_scene
from mrgs.errors import KernelWarning
from mrgs.field import nearest_neighbours
from mrgs.method.config import make_config
from mrgs.method.losses.photometric import (
    LossConfig,
    masked_mean,
    photometric_loss,
)
from mrgs.method.losses.radiation import boltzmann_loss
from mrgs.method.losses.smoothness import smoothness_loss
from mrgs.method.losses.ssim import ssim_map, structural_similarity
from mrgs.method.losses.term import SceneScale
from mrgs.training.kernel_check import check_kernels
from mrgs.training.recorder import Recorder
from mrgs.training.state import initial_state
from mrgs.training.step import training_step
from mrgs.training.view_pass import PhotographedView

IMAGE_ERROR_MAX = 1e-4
"""Largest absolute error of a value in [0, 1], and of a depth relative to the largest depth."""

GRADIENT_ERROR_MAX = 1e-3
"""Largest relative L2 error of a gradient, and relative error of a loss."""

LAYERS = (("rgb", "thermal"), ("rgb",), ("thermal",))
DSSIM = 0.2
EXTENT = 5.0

Finding = dict[str, Any]
"""What was compared ("of"), the error and its limit; or why there is none ("skipped" or
"failed")."""

Comparison = Callable[[], Iterator[Finding]]


def findings(device: torch.device, plan: Plan) -> Iterator[Finding]:
    """One comparison after the other; one that fails says so and leaves the others alone."""
    for name, compare in comparisons(device, plan):
        yield from attempt(name, compare)


def attempt(name: str, compare: Comparison) -> Iterator[Finding]:
    """What is found; or, where the comparison fails, its name and why."""
    try:
        yield from compare()
    except Exception as error:
        yield {"of": name, **failure(error)}


def comparisons(device: torch.device, plan: Plan) -> Iterator[tuple[str, Comparison]]:
    """All of them by name."""
    for scene in scenes(plan):
        yield f"rasterizer: {scene}", partial(compare_rasterizer, scene, device)
    _, width, height = plan.largest_scene
    for masked in (False, True):
        for case in loss_cases(width, height, masked):
            yield case.title, partial(compare_loss, case, device)
    for count in plan.neighbours:
        yield f"neighbours among {count:,}", partial(compare_neighbours, device, count)
    for method in plan.methods:
        yield f"losses of three steps, {method}", partial(compare_step, device, method, plan)
        yield f"losses of replayed steps, {method}", partial(compare_replay, device, method, plan)
    # Last: a rejected kernel is not used by what follows in this process.
    for method in plan.methods:
        yield f"kernels of a training, {method}", partial(compare_kernels, device, method)


def ok(finding: Finding) -> bool:
    """Whether the error is within its limit, which NaN is not; a comparison that found no room is
    not wrong."""
    return "skipped" in finding or (
        "failed" not in finding and bool(finding["error"] <= finding["limit"])
    )


def scenes(plan: Plan) -> Iterator[RandomScene]:
    """From 0 Gaussians to the largest scene, with one layer and with both."""
    count, width, height = plan.largest_scene
    for seed, layers in zip(range(plan.scenes), itertools.cycle(LAYERS), strict=False):
        share = seed / max(1, plan.scenes - 1)
        scale = 0.2 + 0.8 * share
        sides = [max(1, round(scale * side)) for side in (width, height)]
        yield random_scene(seed, round(count * share**2), *sides, layers)


def compare_rasterizer(scene: RandomScene, device: torch.device) -> Iterator[Finding]:
    """Every image, and the gradient of a random linear loss by every input; and whether a second
    run gives the same."""
    truth_scene, scene = scene.to(device, torch.float64), scene.to(device, torch.float32)
    left_out = truth_scene.undecided()
    truth, raster = truth_scene.render(oracle=True), scene.render()
    for name, blend, true_blend in zip(scene.modalities, raster.blends, truth.blends, strict=True):
        for part, image, true_image in zip(blend._fields, blend, true_blend, strict=True):
            scale = max(1.0, true_image.max().item()) if part == "depth" else 1.0
            difference = (image.double() - true_image).detach()[~left_out].abs()
            error = difference.max().item() / scale if difference.numel() else 0.0
            yield {"of": f"rasterizer: {name} {part}", "error": error, "limit": IMAGE_ERROR_MAX}
    cotangents = _cotangents(truth.blends, left_out)
    true_grads = truth_scene.gradients(truth, cotangents)
    grads = scene.gradients(raster, cotangents)
    for name, grad in true_grads.items():
        yield {
            "of": f"rasterizer: gradient of {name}",
            "error": relative(grads[name], grad),
            "limit": GRADIENT_ERROR_MAX,
        }
    again = scene.gradients(scene.render(), cotangents)
    differing = sum(not torch.equal(grads[name], again[name]) for name in grads)
    yield {
        "of": "rasterizer: gradients that differ between two runs",
        "error": differing,
        "limit": 0,
    }


def _cotangents(blends: tuple[Any, ...], left_out: Tensor) -> list[Tensor]:
    """A random weight per value of every image, 1 on average, and 0 where rounding decides."""
    generator = torch.Generator().manual_seed(0)
    images = [image for blend in blends for image in blend]
    weights = [
        1 + torch.randn(image.shape, generator=generator, dtype=torch.float64).to(left_out.device)
        for image in images
    ]
    return [
        w.masked_fill(left_out.view(*left_out.shape, *[1] * (w.ndim - 2)), 0.0) for w in weights
    ]


def relative(value: Tensor, truth: Tensor) -> float:
    """‖value − truth‖ / ‖truth‖; the plain norm where the truth is 0."""
    norm = truth.norm().item()
    return (value.detach().to(truth) - truth).norm().item() / (norm if norm > 0 else 1.0)


Loss = Callable[..., Tensor]


class LossCase(NamedTuple):
    """A loss, its equation in plain torch, and what both are given."""

    title: str
    loss: Loss
    truth: Loss
    tensors: list[Tensor]
    valid: Tensor | None


def loss_cases(width: int, height: int, masked: bool) -> Iterator[LossCase]:
    """Photometric, smoothness and radiation loss of random images."""
    generator = torch.Generator().manual_seed(11)

    def noise(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    rgb, target, depth = noise(height, width, 3), noise(height, width, 3), 1 + noise(height, width)
    thermal, radiation, uncertainty = (noise(height, width) for _ in range(3))
    valid = noise(height, width) > 0.2 if masked else None
    config = LossConfig()
    cases: tuple[tuple[str, Loss, Loss, list[Tensor]], ...] = (
        (
            "L1 + D-SSIM",
            lambda x, y, v: photometric_loss(x, y, v, DSSIM),
            photometric_truth,
            [rgb, target],
        ),
        (
            "total variation",
            lambda x, d, v: smoothness_loss(x, d, v, EXTENT, 1.0, config),
            smoothness_truth,
            [rgb, depth],
        ),
        ("L_boltz", boltzmann_loss, boltzmann_truth, [thermal, radiation, uncertainty]),
    )
    for name, loss, truth, tensors in cases:
        yield LossCase(f"{name}, masked" if masked else name, loss, truth, tensors, valid)


def compare_loss(case: LossCase, device: torch.device) -> Iterator[Finding]:
    """The loss and its gradients beside those of its equation."""
    values = _value_and_gradients(case.loss, case.tensors, case.valid, device, torch.float32)
    true_values = _value_and_gradients(case.truth, case.tensors, case.valid, device, torch.float64)
    errors = [relative(value, true) for value, true in zip(values, true_values, strict=True)]
    yield {"of": f"{case.title}: value", "error": errors[0], "limit": GRADIENT_ERROR_MAX}
    yield {
        "of": f"{case.title}: gradients",
        "error": _largest(errors[1:]),
        "limit": GRADIENT_ERROR_MAX,
    }


def _largest(errors: list[float]) -> float:
    """The largest; NaN if one is."""
    return math.nan if any(math.isnan(error) for error in errors) else max(errors)


def _value_and_gradients(
    loss: Loss,
    tensors: list[Tensor],
    valid: Tensor | None,
    device: torch.device,
    dtype: torch.dtype,
) -> list[Tensor]:
    leaves = [tensor.to(device, dtype).requires_grad_() for tensor in tensors]
    value = loss(*leaves, None if valid is None else valid.to(device))
    return [value.detach(), *torch.autograd.grad(value, leaves)]


def photometric_truth(x: Tensor, y: Tensor, valid: Tensor | None) -> Tensor:
    """Eq. 17 from the map of SSIM."""
    x, y = (
        (t if valid is None else torch.where(valid[..., None], t, 0)).permute(2, 0, 1)
        for t in (x, y)
    )
    return masked_mean((1 - DSSIM) * (x - y).abs() + DSSIM * (1 - ssim_map(x, y)), valid)


def smoothness_truth(x: Tensor, depth: Tensor, valid: Tensor | None) -> Tensor:
    """Eq. 18 from the first differences."""
    total = torch.zeros((), dtype=x.dtype, device=x.device)
    for image, weight in ((x, 1.0), (depth[..., None], 1 / EXTENT)):
        for axis in (0, 1):
            differences = image.diff(dim=axis).abs().permute(2, 0, 1)
            steps = image.shape[axis] - 1
            both = (
                None
                if valid is None
                else valid.narrow(axis, 0, steps) & valid.narrow(axis, 1, steps)
            )
            total = total + weight * masked_mean(differences, both)
    return total


def boltzmann_truth(
    thermal: Tensor, radiation: Tensor, uncertainty: Tensor, valid: Tensor | None
) -> Tensor:
    """Eq. 16 from the map of S-SSIM."""
    if valid is not None:
        thermal, radiation = torch.where(valid, thermal, 0), torch.where(valid, radiation, 0)
    dissimilarity = 1 - structural_similarity(thermal[None], radiation[None])
    return masked_mean(dissimilarity / uncertainty.exp() + uncertainty, valid)


def compare_neighbours(
    device: torch.device,
    count: int,
    k: int = 8,
    search: Callable[[Tensor, int], Tensor] = nearest_neighbours,
) -> Iterator[Finding]:
    """The distances to the found neighbours beside those of all pairs; which of two equally far
    ones may differ."""
    means = torch.randn(count, 3, generator=torch.Generator().manual_seed(count)).to(device)
    found = search(means, k)
    exact = means.double()
    largest = 0.0
    for rows in torch.arange(count, device=device).split(max(1, 2**24 // count)):
        distances = (exact[rows, None] - exact[found[rows]]).norm(dim=2)
        all_distances = torch.cdist(exact[rows], exact, compute_mode="donot_use_mm_for_euclid_dist")
        nearest = all_distances.topk(min(k, count - 1) + 1, largest=False).values[:, 1:]
        missing = k - nearest.shape[1]  # where fewer others exist, the Gaussian itself
        nearest = torch.cat([nearest, nearest.new_zeros(len(rows), missing)], dim=1)
        largest = max(largest, (distances - nearest).abs().max().item())
    yield {"of": f"distances to {k} neighbours among {count:,}", "error": largest, "limit": 1e-6}


def compare_step(device: torch.device, method: str, plan: Plan) -> Iterator[Finding]:
    """The losses of three steps beside those on the CPU, whose kernels have their own tests."""
    losses = [_losses(place, method, plan, 3) for place in (device, torch.device("cpu"))]
    yield {
        "of": f"losses of three steps, {method}",
        "error": relative(*losses),
        "limit": GRADIENT_ERROR_MAX,
    }


def compare_replay(device: torch.device, method: str, plan: Plan) -> Iterator[Finding]:
    """The losses of steps that are replayed beside those of steps that are not."""
    recorders = [Recorder(device) if device.type == "cuda" else None, None]
    losses = [_losses(device, method, plan, 20, recorder) for recorder in recorders]
    yield {
        "of": f"losses of twenty steps, replayed, {method}",
        "error": relative(*losses),
        "limit": GRADIENT_ERROR_MAX,
    }


def compare_kernels(device: torch.device, method: str) -> Iterator[Finding]:
    """How many kernels a training of the bundled scene would not use, because they differ from
    their plain definitions."""
    config, scene = make_config(method, "paper"), load_scene(SCENE)
    state, scale = initial_state(scene, config, device), SceneScale.of(scene)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", KernelWarning)
        check_kernels(state, scene, config, scale)
    yield {
        "of": f"kernels that a training of {method} rejects",
        "error": sum(issubclass(each.category, KernelWarning) for each in caught),
        "limit": 0,
        "warnings": [str(each.message) for each in caught],
    }


def _losses(
    device: torch.device, method: str, plan: Plan, steps: int, recorder: Recorder | None = None
) -> Tensor:
    """Of some steps on a small room, by two cameras in turns."""
    count, width, height = (
        min(value, most) for value, most in zip(plan.step_sizes[0], (2_000, 96, 64), strict=True)
    )
    config = make_config(method, "paper")
    state = training_state(count, config, device)
    photos = photos_on(device, width, height)
    views = [PhotographedView(0, workload.view(width, height, x), photos) for x in (0.0, 0.3)]
    losses = []
    for step in range(steps):
        given = [views[step % 2]]
        result = training_step(state, given, config, workload.SCALE, recorder=recorder)
        losses.append(result.statistics.loss)
    return torch.tensor(losses, dtype=torch.float64)
