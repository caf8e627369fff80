from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from mrgs.scene import Camera
from tests.helpers.array_checks import unchecked

SIZES = st.integers(1, 5_000)
FOCALS = st.floats(0.2, 5.0)
PLACES = st.floats(0.0, 1.0)
SHARES = st.floats(-3.0, 3.0)
DEPTHS = st.floats(0.01, 1_000.0)


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
    assert original.resized(new_width, new_height) is resized


@given(st.lists(st.tuples(SHARES, SHARES, DEPTHS), min_size=1, max_size=4), FOCALS, FOCALS)
def test_unprojecting_and_projecting_undo_each_other(places, fx, fy):
    """Within the image and beside it, near and far; also in batches of more than one axis."""
    original = camera(40, 30, 40 * fx, 30 * fy)
    u, v, depth = torch.tensor(places, dtype=torch.float64).unbind(dim=1)
    pixels = torch.stack([40 * u, 30 * v], dim=1)
    points = original.unproject(pixels, depth)
    seen_at, seen_depth = original.project(points)
    torch.testing.assert_close(seen_at, pixels, rtol=1e-9, atol=1e-6)
    torch.testing.assert_close(seen_depth, depth, rtol=1e-9, atol=1e-9)
    again = original.unproject(seen_at[:, None], seen_depth[:, None])[:, 0]
    torch.testing.assert_close(again, points, rtol=1e-9, atol=1e-6)


def test_an_image_is_unprojected_at_the_centres_of_its_pixels():
    original = camera(40, 30, 36.0, 27.0)
    depth = 1 + torch.rand(30, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    pixels, seen_depth = original.project(original.unproject_image(depth))
    torch.testing.assert_close(seen_depth, depth)
    torch.testing.assert_close(pixels[12, 7], torch.tensor([7.5, 12.5], dtype=torch.float64))


@given(st.tuples(*[st.floats(-50, 50)] * 3))
def test_projecting_is_the_pinhole_equation(place):
    """K · (R X + t), divided by its third coordinate."""
    original, point = camera(), torch.tensor(place, dtype=torch.float64)
    homogeneous = original.K @ (original.viewmat[:3, :3] @ point + original.viewmat[:3, 3])
    pixel, depth = original.project(point)
    torch.testing.assert_close(depth, homogeneous[2])
    if depth > 1e-3:
        torch.testing.assert_close(pixel, homogeneous[:2] / homogeneous[2])
    else:
        assert depth > 0 or pixel.isnan().all()


def test_what_is_not_before_the_camera_appears_nowhere():
    original = camera()
    beside = original.position + original.viewmat[0, :3]
    pixels, depth = original.project(
        torch.stack([original.position - original.forward, beside, original.position])
    )
    assert pixels.isnan().all()
    torch.testing.assert_close(
        depth, torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64), rtol=0, atol=1e-12
    )
    assert not original.contains(pixels).any()


def test_an_image_contains_its_upper_and_left_border_but_not_the_others():
    inside = torch.tensor([[0.0, 0.0], [39.99, 29.99]])
    outside = torch.tensor(
        [[40.0, 5.0], [5.0, 30.0], [-0.01, 5.0], [5.0, -0.01], [float("nan"), 5.0]]
    )
    assert camera().contains(inside).all()
    assert not camera().contains(outside).any()


def test_the_precision_is_that_of_what_is_given():
    point = torch.tensor([0.5, 1.0, 5.0])
    pixel, depth = camera().project(point)
    assert {pixel.dtype, depth.dtype} == {torch.float32}
    torch.testing.assert_close(camera().unproject(pixel, depth), point)


@pytest.mark.parametrize("kind", [torch.tensor, np.array, list])
def test_points_and_pixels_are_integers_arrays_and_lists(kind):
    """Integers count as float64, so that no fraction of the camera is cut off."""
    original, point = camera(), [[1, 2, 9], [0, -3, 7]]
    expected = original.project(torch.tensor(point).double())
    pixel, depth = original.project(kind(point))
    assert torch.equal(pixel, expected[0])
    assert torch.equal(depth, expected[1])
    pixels, depths = [[3, 4], [50, 6]], [8, 9]
    found = original.unproject(kind(pixels), kind(depths))
    doubles = torch.tensor(pixels).double(), torch.tensor(depths).double()
    assert torch.equal(found, original.unproject(*doubles))
    assert original.contains(kind(pixels)).tolist() == [True, False]
    image = original.unproject_image(kind([[2, 3], [4, 5]]))
    assert torch.equal(image, original.unproject_image(torch.tensor([[2.0, 3], [4, 5]]).double()))


def test_gradients_flow_through_projections():
    point = torch.tensor([0.5, 1.0, 5.0], requires_grad=True)
    pixel, depth = camera().project(point)
    camera().unproject(pixel, depth).sum().backward()
    torch.testing.assert_close(point.grad, torch.ones(3))


def test_an_empty_list_holds_no_points():
    pixels, depth = camera().project([])
    assert (pixels.shape, depth.shape) == ((0, 2), (0,))
    assert camera().unproject([], []).shape == (0, 3)
    assert camera().contains([]).shape == (0,)


def test_points_and_pixels_of_another_shape():
    for message, call in {
        r"points must have shape \[..., 3\], not \[2\]": lambda: camera().project([1, 2]),
        r"pixels must have shape \[..., 2\], not \[3\]": lambda: camera().unproject([1, 2, 3], 1),
        r"depth must have shape \[2\], not \[3\]": lambda: camera().unproject(
            [[1, 2], [3, 4]], [1, 2, 3]
        ),
        r"pixels must have shape \[..., 2\], not \[\]": lambda: camera().contains(torch.ones(())),
        r"depth must have shape \[H, W\], not \[2\]": lambda: camera().unproject_image([1, 2]),
    }.items():
        with pytest.raises(ValueError, match=message):
            call()


def test_position_and_forward_are_the_axes_of_the_camera():
    original = camera()
    at_centre = original.viewmat[:3, :3] @ original.position + original.viewmat[:3, 3]
    torch.testing.assert_close(at_centre, torch.zeros(3, dtype=torch.float64))
    ahead = (
        original.viewmat[:3, :3] @ (original.position + 2 * original.forward)
        + original.viewmat[:3, 3]
    )
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


@given(st.integers(1, 2_000), st.integers(1, 2_000), st.floats(1.0, 170.0))
def test_the_field_of_view_spans_the_width(width, height, fov_deg):
    made = Camera.from_fov(width, height, fov_deg)
    left, right = (ray(made, u, 0.5) for u in (0.0, 1.0))
    angle = torch.rad2deg(torch.arccos(torch.nn.functional.cosine_similarity(left, right, dim=0)))
    assert angle.item() == pytest.approx(fov_deg, abs=1e-5)
    assert made.K[0, 0] == made.K[1, 1]


@pytest.mark.parametrize("fov_deg", [0.0, 180.0, float("nan")])
def test_a_field_of_view_is_an_angle_of_a_pinhole(fov_deg):
    with pytest.raises(ValueError, match="180°, not"):
        Camera.from_fov(4, 3, fov_deg)


@pytest.mark.parametrize(
    ("size", "side"),
    [(("64", 48), "width"), ((64, "48"), "height"), ((64, 48.0), "height"), ((None, 48), "width")],
)
def test_the_size_for_a_field_of_view_must_be_whole_numbers(size, side):
    with pytest.raises(ValueError, match=f"^{side} .*whole"):
        Camera.from_fov(*size, 60)


@given(st.tuples(*[st.floats(-5, 5)] * 3), st.tuples(*[st.floats(-5, 5)] * 3))
def test_looking_at_a_target(position, target):
    forward = np.subtract(target, position)
    assume(np.linalg.norm(np.cross(forward, [0, 0, 1])) > 1e-3)
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    placed = camera().look_at(position, np.array(target))
    pixel, depth = placed.project(torch.tensor([target], dtype=torch.float64))
    torch.testing.assert_close(pixel[0], placed.K[:2, 2], rtol=0, atol=1e-6)
    assert depth.item() == pytest.approx(np.linalg.norm(forward))
    np.testing.assert_allclose(placed.position, position, atol=1e-9)
    assert torch.linalg.det(placed.viewmat[:3, :3]).item() == pytest.approx(1)
    above, _ = placed.project(torch.tensor([target], dtype=torch.float64) + up / 1_000)
    assert above[0, 1] < pixel[0, 1], "up is up in the image"


def test_up_must_not_be_the_viewing_direction():
    for position, target in (([0, 0, 5.0], [0, 0, 0.0]), ([1.0, 2, 3], [1.0, 2, 3])):
        with pytest.raises(ValueError, match=r"^up .*along"):
            camera().look_at(position, target)
    camera().look_at([0, 0, 5.0], [0, 0, 0.0], up=[0.0, 1, 0])


def test_arrays_and_lists_become_float64_tensors():
    K = np.array([[50, 0, 32], [0, 50, 24], [0, 0, 1]], dtype=np.float32)
    made = Camera(K, np.eye(4).tolist(), 64, 48)
    assert made.K.dtype == made.viewmat.dtype == torch.float64
    np.testing.assert_array_equal(made.K, K)


def changed(matrix: np.ndarray, place: tuple[int, ...], value: float | np.ndarray) -> np.ndarray:
    copy = np.array(matrix)
    copy[place] = value
    return copy


@pytest.mark.parametrize(
    ("K", "viewmat", "size", "message"),
    [
        (np.eye(4), np.eye(4), (4, 3), r"^K .*\[3, 3\], not \[4, 4\]"),
        (np.eye(3), np.eye(4)[:3], (4, 3), r"^viewmat .*\[4, 4\], not \[3, 4\]"),
        (np.eye(3), [["a"] * 4] * 4, (4, 3), "^viewmat .*of numbers"),
        (np.eye(3), np.eye(4), (0, 3), "not 0×3"),
        (np.eye(3), np.eye(4), (4.0, 3), r"^width .*4\.0"),
        (np.eye(3), np.eye(4), (4, "3"), "^height .*'3'"),
        (np.zeros((3, 3)), np.eye(4), (4, 3), "K is 0 0 0,"),
        (2 * np.eye(3), np.eye(4), (4, 3), "K is 0 0 2,"),
        (np.diag([5.0, -5, 1]), np.eye(4), (4, 3), "K .*5 -5"),
        (changed(np.eye(3), (0, 1), 0.2), np.eye(4), (4, 3), r"skew \(K\[0, 1\] = 0\.2"),
        (changed(np.eye(3), (0, 0), np.inf), np.eye(4), (4, 3), "K holds NaN"),
        (np.eye(3), changed(np.eye(4), (0, 3), np.nan), (4, 3), "viewmat holds NaN"),
        (np.eye(3), np.diag([2.0, 2, 2, 1]), (4, 3), "not a rotation"),
        (np.eye(3), np.diag([1.0, 1, -1, 1]), (4, 3), "not a rotation"),
        (np.eye(3), changed(np.eye(4), (0, 1), 0.01), (4, 3), "not a rotation"),
        (np.eye(3), changed(np.eye(4), (3,), 5.0), (4, 3), "viewmat is 5 5 5 5,"),
    ],
)
def test_what_is_no_camera(K, viewmat, size, message):
    with unchecked(), pytest.raises(ValueError, match=message):
        Camera(K, viewmat, *size)


def test_a_rotation_of_few_digits_is_replaced_by_the_nearest_and_others_keep_every_bit():
    original = camera()
    rounded = Camera(original.K, original.viewmat.numpy().round(4), 40, 30)
    rotation = rounded.viewmat[:3, :3]
    torch.testing.assert_close(rotation.T @ rotation, torch.eye(3).double(), rtol=0, atol=1e-14)
    torch.testing.assert_close(rounded.viewmat, original.viewmat, rtol=0, atol=1e-4)
    for exact in (original.viewmat, original.viewmat.float()):
        assert torch.equal(Camera(original.K, exact, 40, 30).viewmat, exact.double())


def test_a_camera_keeps_its_matrices_when_the_callers_change():
    K, viewmat = camera().K, camera().viewmat.numpy()
    made = Camera(K, viewmat, 40, 30)
    K[0, 0], viewmat[0, 3] = 1, 9
    assert torch.equal(made.K, camera().K)
    assert torch.equal(made.viewmat, camera().viewmat)


def test_sizes_of_numpy_become_ints():
    with unchecked():
        made = Camera(np.eye(3), np.eye(4), np.int64(64), np.uint8(48))
    assert (type(made.width), type(made.height)) == (int, int)


def test_places_are_finite():
    with pytest.raises(ValueError, match="position holds NaN"):
        camera().look_at([np.nan, 1, 1], [0, 0, 0])
    with pytest.raises(ValueError, match="target holds NaN"):
        camera().look_at([1, 1, 1], [0, 0, np.inf])


def test_tensors_in_lists_may_require_gradients():
    three = torch.tensor(3.0, requires_grad=True)
    placed = camera().look_at([three, 0, 1], [0, 0, 0])
    assert placed.position.tolist() == pytest.approx([3, 0, 1])


def test_a_camera_is_one_short_line():
    made = Camera.from_fov(640, 480, 60).look_at([1.0, -2, 0.5], [0.0, 0, 0])
    assert repr(made) == "Camera(640×480, 60° wide, at 1, -2, 0.5)"


@pytest.mark.parametrize("axes", ["opencv", "opengl"])
def test_a_camera_from_its_pose_is_the_one_of_its_view(axes):
    expected = Camera.from_fov(64, 48, 60.0).look_at([1.0, -2.0, 3.0], [0.5, 0.0, 1.0])
    pose = torch.linalg.inv(expected.viewmat)
    if axes == "opengl":
        pose = pose @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    made = Camera.from_pose(expected.K, pose.tolist(), 64, 48, axes)
    torch.testing.assert_close(made.viewmat, expected.viewmat)
    torch.testing.assert_close(made.position, torch.tensor([1.0, -2.0, 3.0]).double())
    assert (made.width, made.height) == (64, 48)


def test_a_pose_that_is_none_is_refused():
    K = Camera.from_fov(64, 48, 60.0).K
    with pytest.raises(ValueError, match="'blender'"):
        Camera.from_pose(K, torch.eye(4), 64, 48, "blender")
    with pytest.raises(ValueError, match="mirrored"):
        Camera.from_pose(K, torch.diag(torch.tensor([1.0, 1.0, -1.0, 1.0])), 64, 48)
