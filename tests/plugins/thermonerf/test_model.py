from __future__ import annotations

import pytest
import torch

from mrgs.data import load_scene
from mrgs.scene import RGB, THERMAL
from mrgs_thermonerf.model import ALL_ROWS, CHUNK_RAYS
from mrgs_thermonerf.rays import CameraRays, frame_of
from mrgs_thermonerf.run import new_model


def test_a_view_is_rendered_from_each_of_its_cameras(small_scene):
    scene = load_scene(small_scene)
    model = new_model(0, frame_of(scene))
    camera = scene.eval[0].images[RGB].camera
    both = model.render({RGB: camera, THERMAL: camera})
    assert (both[RGB].image.shape, both[THERMAL].image.shape) == ((30, 40, 3), (30, 40, 1))
    assert both[RGB].depth.shape == both[THERMAL].alpha.shape == (30, 40)
    assert not any(image.requires_grad for blend in both.values() for image in blend)
    apart = model.render({RGB: camera, THERMAL: camera.resized(20, 15)})
    torch.testing.assert_close(apart[RGB].image, both[RGB].image)
    assert apart[THERMAL].image.shape == (15, 20, 1)
    alone = model.render({THERMAL: camera})
    assert set(alone) == {THERMAL}
    torch.testing.assert_close(alone[THERMAL].image, both[THERMAL].image)


@pytest.mark.slow
def test_the_size_of_the_chunks_does_not_show(small_scene):
    scene = load_scene(small_scene)
    model = new_model(0, frame_of(scene))
    camera = scene.eval[0].images[RGB].camera.resized(120, 90)
    rays = CameraRays([camera], model.frame)
    assert len(rays) > CHUNK_RAYS
    rendering = model.render({RGB: camera, THERMAL: camera})
    with torch.no_grad():
        whole = model.trace(
            rays.through(torch.arange(len(rays))), dict.fromkeys((RGB, THERMAL), ALL_ROWS)
        )
    for modality in (RGB, THERMAL):
        image = rendering[modality].image.flatten(0, 1)
        torch.testing.assert_close(image, whole.values[modality].reshape(image.shape))


def test_depth_is_that_of_the_surface(small_scene):
    """An opaque ball about the scene's centre, as large as the frame's radius."""
    scene = load_scene(small_scene)
    frame = frame_of(scene)
    model = new_model(0, frame)

    def density(positions):
        return torch.where(positions.norm(dim=1) < 1, 1e4, 0.0)

    model.proposal.density = density
    model.field.density = lambda positions: (density(positions), torch.zeros(len(positions), 15))
    camera = scene.eval[0].images[RGB].camera
    rendering = model.render({RGB: camera})
    middle = rendering[RGB].depth[15, 20].item()
    expected = (camera.position - frame.centre).norm().item() - frame.radius
    assert abs(middle - expected) < 0.1 * expected
    assert rendering[RGB].alpha[15, 20] > 0.99
    assert rendering[RGB].alpha[0, 0] < 0.01
