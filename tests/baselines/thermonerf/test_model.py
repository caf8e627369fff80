from __future__ import annotations

import torch

from mrgs.baselines.thermonerf import model as model_module
from mrgs.baselines.thermonerf.frame import frame_of
from mrgs.baselines.thermonerf.step import new_model
from mrgs.data import load_scene
from tests.helpers.thermonerf import small_config


def test_a_view_is_rendered_from_each_of_its_cameras(small_scene):
    scene = load_scene(small_scene)
    model = new_model(small_config(), frame_of(scene))
    camera = scene.eval[0].rgb.camera
    both = model.render(camera, camera)
    assert (both.rgb.shape, both.thermal.shape) == ((30, 40, 3), (30, 40, 1))
    assert both.depth_rgb.shape == both.alpha_thermal.shape == (30, 40)
    assert not any(image.requires_grad for image in both)
    apart = model.render(camera, camera.resized(20, 15))
    torch.testing.assert_close(apart.rgb, both.rgb)
    assert apart.thermal.shape == (15, 20, 1)
    alone = model.render(None, camera)
    assert (alone.rgb, alone.depth_rgb) == (None, None)
    torch.testing.assert_close(alone.thermal, both.thermal)


def test_the_size_of_the_chunks_does_not_show(small_scene, monkeypatch):
    scene = load_scene(small_scene)
    model = new_model(small_config(), frame_of(scene))
    camera = scene.eval[0].rgb.camera
    whole = model.render(camera, camera)
    monkeypatch.setattr(model_module, "CHUNK_RAYS", 17)
    for image, again in zip(whole, model.render(camera, camera), strict=True):
        torch.testing.assert_close(image, again)


def test_depth_is_that_of_the_surface(small_scene):
    """An opaque ball about the scene's centre, as large as the frame's radius."""
    scene = load_scene(small_scene)
    frame = frame_of(scene)
    model = new_model(small_config(), frame)

    def density(positions):
        return torch.where(positions.norm(dim=1) < 1, 1e4, 0.0)

    model.proposal.density = density
    model.field.density = lambda positions: (density(positions), torch.zeros(len(positions), 15))
    camera = scene.eval[0].rgb.camera
    rendering = model.render(camera, None)
    middle = rendering.depth_rgb[15, 20].item()
    expected = (camera.position - frame.centre).norm().item() - frame.radius
    assert abs(middle - expected) < 0.1 * expected
    assert rendering.alpha_rgb[15, 20] > 0.99
    assert rendering.alpha_rgb[0, 0] < 0.01
