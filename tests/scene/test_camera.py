from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.scene import Camera

SIZES = st.integers(1, 5_000)
FOCALS = st.floats(0.2, 5.0)
PLACES = st.floats(0.0, 1.0)


def camera(width: int = 40, height: int = 30, fx: float = 35.0, fy: float = 50.0) -> Camera:
    """Rotated about the vertical, off the origin, with an off-centre principal point."""
    K = torch.tensor([[fx, 0, 0.4 * width], [0, fy, 0.6 * height], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    angle = torch.tensor(0.3, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = angle.cos()
    viewmat[0, 2], viewmat[2, 0] = angle.sin(), -angle.sin()
    viewmat[:3, 3] = torch.tensor([0.5, -1.0, 2.0])
    return Camera(K, viewmat, width, height)


def ray(camera: Camera, u: float, v: float) -> torch.Tensor:
    """Direction through the image at these shares of its width and height."""
    pixel = torch.tensor([u * camera.width, v * camera.height, 1.0], dtype=torch.float64)
    return torch.linalg.solve(camera.K, pixel)


@given(SIZES, SIZES, SIZES, SIZES, FOCALS, FOCALS, PLACES, PLACES)
def test_resizing_keeps_every_ray(width, height, new_width, new_height, fx, fy, u, v):
    original = camera(width, height, fx * width, fy * height)
    resized = original.resized(new_width, new_height)
    assert (resized.width, resized.height) == (new_width, new_height)
    torch.testing.assert_close(ray(resized, u, v), ray(original, u, v), rtol=1e-9, atol=1e-9)
    assert torch.equal(resized.viewmat, original.viewmat)


def test_position_and_forward_are_the_axes_of_the_camera():
    original = camera()
    at_centre = original.viewmat[:3, :3] @ original.position + original.viewmat[:3, 3]
    torch.testing.assert_close(at_centre, torch.zeros(3, dtype=torch.float64))
    ahead = original.viewmat[:3, :3] @ (original.position + 2 * original.forward) + original.viewmat[:3, 3]
    torch.testing.assert_close(ahead, torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64))


def test_equal_cameras_coincide():
    assert camera().coincides_with(camera())
    assert camera().resized(80, 60).resized(40, 30).coincides_with(camera())


def test_cameras_that_differ_in_anything_do_not_coincide():
    original = camera()
    moved = original.viewmat.clone()
    moved[0, 3] += 1e-9
    sharper = original.K.clone()
    sharper[0, 0] *= 1.001
    for other in (
        Camera(original.K, moved, 40, 30),
        Camera(sharper, original.viewmat, 40, 30),
        Camera(original.K, original.viewmat, 41, 30),
        original.resized(80, 60),
    ):
        assert not original.coincides_with(other)
        assert not other.coincides_with(original)
