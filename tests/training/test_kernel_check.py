"""An edit of an equation is found when a training starts, whatever it starts with."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from mrgs.data import load_scene
from mrgs.errors import KernelWarning
from mrgs.field import spherical_harmonics
from mrgs.method.config import make_config
from mrgs.method.losses import photometric
from mrgs.method.losses.term import SceneScale
from mrgs.rasterizer import reference
from mrgs.system.gpu import HOST
from mrgs.system.torch_modes import own_modes
from mrgs.training.kernel_check import _camera_before, check_kernels, check_rendering
from mrgs.training.state import initial_state
from tests.helpers.gaussians import random_gaussians
from tests.helpers.training import short_config

pytestmark = pytest.mark.compares_kernels

Function = Callable[..., Any]


def without_mask(original: Function) -> Function:
    def edited(values: Tensor, valid: Tensor | None, *rest: Any) -> Tensor:
        found: Tensor = original(values, valid, *rest)
        return 2 * found if valid is None else found

    return edited


EDITS: dict[str, tuple[Any, str, Callable[[Function], Function]]] = {
    "rotation": (reference, "rotation_matrices", lambda f: lambda quats: f(quats).mT),
    "no rotation": (
        reference,
        "rotation_matrices",
        lambda f: lambda quats: torch.eye(3).to(quats).expand(len(quats), 3, 3),
    ),
    "direction": (
        spherical_harmonics,
        "viewing_directions",
        lambda f: lambda means, camera: f(means, camera).detach(),
    ),
    "huber": (photometric, "_huber", lambda f: lambda d, width: (f(d, width) + 1e-4).sqrt()),
    "no mask": (photometric, "masked_mean", without_mask),
}
"""The module, the function, and its edit."""


@pytest.mark.parametrize("edit", EDITS)
def test_an_edit_is_found(edit, small_scene, monkeypatch):
    scene, config = load_scene(small_scene), make_config("mrgs-plus", "fast")
    state, scale = initial_state(scene, config), SceneScale(scene.extent, scene.temperature)
    module, name, edited = EDITS[edit]
    with monkeypatch.context() as patch:
        patch.setattr(module, name, edited(getattr(module, name)))
        with pytest.warns(KernelWarning, match="differs"):
            check_kernels(state, scene, config, scale)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_kernels(state, scene, config, scale)


@pytest.mark.gpu
@pytest.mark.parametrize("method", ["mrgs", "mrgs-plus", "3dgs-rgbt"])
def test_a_gpus_kernels_are_used(method, small_scene):
    scene, config = load_scene(small_scene), make_config(method, "paper")
    state = initial_state(scene, config, torch.device("cuda"))
    with own_modes(), warnings.catch_warnings():
        warnings.simplefilter("error")
        check_kernels(state, scene, config, SceneScale.of(scene))


def test_the_camera_of_the_check_has_most_gaussians_before_it():
    gaussians = random_gaussians(200, bands=0)
    moved = replace(gaussians, means=3 * gaussians.means + torch.tensor([50.0, -20.0, 7.0]))
    camera = _camera_before(moved)
    pixels, depth = camera.project(moved.means.detach())
    assert (depth > 0).double().mean() > 0.95
    assert camera.contains(pixels).double().mean() > 0.6


def test_a_model_without_gaussians_needs_no_check(small_scene):
    state = initial_state(load_scene(small_scene), short_config())
    nothing = state.model.gaussians.rows(torch.arange(0))
    check_rendering(replace(state.model, gaussians=nothing), state.image_model, HOST)
