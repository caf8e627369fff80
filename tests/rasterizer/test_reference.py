"""The oracle against closed forms, plain Python loops, its own symmetries and finite
differences."""

from __future__ import annotations

import math
from dataclasses import replace
from inspect import unwrap

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mrgs.rasterizer import reference
from mrgs.rasterizer.contract import Geometry, Layer, Projection
from mrgs.rasterizer.reference import rasterize
from tests.helpers.rasterizers import random_scene

WIDTH, HEIGHT = 21, 15
FX, FY, CX, CY = 20.0, 24.0, 10.5, 7.5  # the principal point is the centre of the pixel (10, 7)
CENTRE = (7, 10)
CAMERA = Projection(
    torch.eye(4).double(),
    torch.tensor([[FX, 0, CX], [0, FY, CY], [0, 0, 1]]).double(),
    WIDTH,
    HEIGHT,
)


def tensor(*values):
    return torch.tensor(values, dtype=torch.float64)


def isotropic(means, sigma):
    """Round Gaussians, whose quats are not normalised."""
    n = len(means)
    return Geometry(
        means,
        tensor(0.4, -1.0, 0.3, 2.0).expand(n, 4),
        torch.full((n, 3), sigma, dtype=torch.float64),
    )


def grey(opacities, features, background=0.0):
    return Layer(tensor(*opacities), tensor(*features)[:, None], tensor(background))


def on_axis(depths, layer, sigma=0.3):
    depths = tensor(*depths)
    means = torch.stack([torch.zeros_like(depths), torch.zeros_like(depths), depths], dim=1)
    return rasterize(isotropic(means, sigma), [layer], CAMERA)


def at_centre(raster):
    """image, depth and alpha of the only layer at the principal point."""
    return [image[CENTRE].item() for image in raster.blends[0]]


# --- closed forms


def test_one_gaussian_on_the_axis():
    sigma, z, opacity = 0.3, 2.0, 0.8
    raster = on_axis([z], grey([opacity], [0.6], background=0.1), sigma)
    dx, dy = np.meshgrid(np.arange(WIDTH) + 0.5 - CX, np.arange(HEIGHT) + 0.5 - CY)
    variance_x, variance_y = (FX * sigma / z) ** 2 + 0.3, (FY * sigma / z) ** 2 + 0.3
    alpha = opacity * np.exp(-(dx**2 / variance_x + dy**2 / variance_y) / 2)
    alpha[alpha < 1 / 255] = 0
    image, depth, accumulated = raster.blends[0]
    np.testing.assert_allclose(accumulated, alpha, atol=1e-14)
    np.testing.assert_allclose(image[..., 0], alpha * 0.6 + (1 - alpha) * 0.1, atol=1e-14)
    np.testing.assert_allclose(depth, alpha * z, atol=1e-14)
    assert accumulated.max() == accumulated[CENTRE] == pytest.approx(opacity)
    assert raster.radii.item() == pytest.approx(math.sqrt(2 * math.log(255 * opacity) * variance_y))


@pytest.mark.parametrize("depths", [(2.0, 3.0), (3.0, 2.0)])
def test_the_nearer_gaussian_is_blended_first(depths):
    image, depth, alpha = at_centre(on_axis(depths, grey([0.5, 0.8], [1.0, 0.25], background=0.4)))
    (z1, o1, f1), (z2, o2, f2) = sorted(zip(depths, (0.5, 0.8), (1.0, 0.25), strict=True))
    w1, w2, passed = o1, (1 - o1) * o2, (1 - o1) * (1 - o2)
    assert (image, depth, alpha) == pytest.approx(
        (w1 * f1 + w2 * f2 + passed * 0.4, w1 * z1 + w2 * z2, 1 - passed)
    )


def test_equal_distances_are_blended_in_the_order_of_their_index():
    n = 40  # an unstable sort may leave short lists alone
    opacities, features = np.linspace(0.05, 0.3, n), np.linspace(0, 1, n)
    image, _, _ = at_centre(on_axis([2.0] * n, grey(opacities, features)))
    transmittance = np.concatenate([[1], np.cumprod(1 - opacities)[:-1]])
    assert transmittance[-1] > 1e-4
    assert image == pytest.approx((opacities * transmittance * features).sum())


def test_the_order_does_not_depend_on_where_the_camera_points():
    aside, ahead = [1.0, 0.0, 2.0], [0.0, 0.0, 2.1]  # the nearer one in z is the farther one
    geometry = isotropic(tensor(aside, ahead), 0.1)
    for angle in (0.0, 0.3, -0.3):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("y", angle).as_matrix())
        splats = reference.project(geometry, CAMERA._replace(viewmat=viewmat))
        assert splats.indices.tolist() == [1, 0]


def test_the_gaussian_that_ends_the_pixel_counts_and_no_later_one_does():
    image, _, alpha = at_centre(
        on_axis([1, 2, 3, 4], grey([0.98, 0.98, 0.9, 0.9], [0, 0, 1, 1], background=0.5))
    )
    passed = 0.02 * 0.02 * 0.1  # 4e-4 before the third, 4e-5 after it
    assert alpha == pytest.approx(1 - passed, abs=1e-15)
    assert image == pytest.approx(0.02 * 0.02 * 0.9 + passed * 0.5)


def test_a_transmittance_at_the_threshold_is_not_yet_the_end():
    just_above, just_below = 1 - 1e-2 * (1 + 1e-9), 1 - 1e-2 * (1 - 1e-9)
    for opacity, blended in ((just_above, True), (just_below, False)):
        image, _, _ = at_centre(on_axis([1, 2, 3], grey([opacity, opacity, 0.5], [0, 0, 1])))
        assert image == pytest.approx(0.5e-4 if blended else 0.0, abs=1e-10)


def test_alpha_is_clamped_and_the_clamp_stops_the_gradient():
    opacities = tensor(0.9999, 0.5).requires_grad_()
    means = tensor([0.0, 0.0, 2.0], [0.0, 0.0, 3.0]).requires_grad_()
    layer = Layer(opacities, tensor([1.0], [0.5]), tensor(0.0))
    blend = rasterize(isotropic(means, 0.3), [layer], CAMERA).blends[0]
    assert blend.image[CENTRE].item() == pytest.approx(0.999 + 0.001 * 0.5 * 0.5)
    (blend.image[CENTRE] * 1e3).sum().backward()
    assert opacities.grad.tolist() == pytest.approx([0.0, 1e3 * 0.001 * 0.5])
    assert means.grad[0].tolist() == [0, 0, 0]


def test_alpha_under_one_255th_contributes_nothing_and_lets_all_light_through():
    image, depth, alpha = at_centre(on_axis([1, 2], grey([0.999 / 255, 1.001 / 255], [1.0, 0.5])))
    kept = 1.001 / 255
    assert (image, depth, alpha) == pytest.approx((kept * 0.5, kept * 2, kept), rel=1e-12)


def test_the_near_plane():
    raster = on_axis([0.00999, 0.01, -2.0], grey([0.5, 0.5, 0.5], [1, 1, 1]), sigma=1e-3)
    assert (raster.radii > 0).tolist() == [False, True, False]
    assert at_centre(raster)[2] == pytest.approx(0.5)


@pytest.mark.parametrize("quaternion", [(1.0, 0, 0, 0), (1.0, 1.0, 0, 0), (0.9, -0.2, 0.3, 0.1)])
def test_a_gaussian_that_reaches_the_plane_of_the_camera_is_left_out(quaternion):
    """One standard deviation along the view's axis, however wide it is across."""
    scales, quats = tensor([3.0, 0.9, 0.4]), tensor(quaternion)
    R = reference.rotation_matrices(quats)[0]
    reach = (R[2] * scales[0]).norm()
    for z, is_drawn in ((reach * (1 - 1e-6), False), (reach * (1 + 1e-6), True)):
        layer = grey([0.9], [1.0])
        geometry = Geometry(tensor([0.0, 0.0, z.item()]), quats, scales)
        raster = rasterize(geometry, [layer], CAMERA)
        assert (raster.radii > 0).tolist() == [is_drawn]


@pytest.mark.parametrize("direction", [(0.3, -0.2), (0.72, 0.1), (-0.1, -0.55), (3.0, -2.0)])
def test_projection_off_the_axis(direction):
    """Σ' of a round Gaussian is σ² J Jᵀ + 0.3 I, with u and v clamped 0.3 half fields of view
    outside the image."""
    sigma, z, cx, cy = 0.9, 3.0, 6.0, 9.0
    K = tensor([FX, 0, cx], [0, FY, cy], [0, 0, 1])
    x, y = direction
    u = min(max(x, -cx / FX - 0.3 * WIDTH / (2 * FX)), (WIDTH - cx) / FX + 0.3 * WIDTH / (2 * FX))
    v = min(
        max(y, -cy / FY - 0.3 * HEIGHT / (2 * FY)), (HEIGHT - cy) / FY + 0.3 * HEIGHT / (2 * FY)
    )
    J = np.array([[FX / z, 0, -FX * u / z], [0, FY / z, -FY * v / z]])
    splats = reference.project(isotropic(tensor([x * z, y * z, z]), sigma), CAMERA._replace(K=K))
    np.testing.assert_allclose(splats.means2d[0], [FX * x + cx, FY * y + cy], rtol=1e-14)
    np.testing.assert_allclose(splats.covs2d[0], sigma**2 * J @ J.T + 0.3 * np.eye(2), rtol=1e-13)


def test_the_clamp_of_the_jacobian_stops_the_gradient_to_the_direction():
    means = torch.tensor([[40.0, 0.0, 2.0]], dtype=torch.float64, requires_grad=True)
    jacobian = reference.jacobians(means, CAMERA.K, WIDTH, HEIGHT)
    (gradient,) = torch.autograd.grad(jacobian[0, 0, 2], means)
    assert gradient[0, 0] == 0
    assert gradient[0, 2] == pytest.approx(-jacobian[0, 0, 2].item() / 2)  # of 1/z alone


def test_radii_are_zero_for_what_no_pixel_can_see():
    z, sigma, opacity = 2.0, 0.01, 0.5  # so small that the 0.3 px² make up nearly all of Σ'
    reach_px = math.sqrt(2 * math.log(255 * opacity) * 0.3)
    beside = (WIDTH + reach_px - CX) / FX * z
    means = tensor([0.0, 0.0, -z], [beside * 1.05, 0.0, z], [beside * 0.95, 0.0, z], [0.0, 0.0, z])
    layers = [grey([0.1, opacity, opacity, 0.003], [0] * 4), grey([0.9, 0.1, 0.1, 0.0039], [0] * 4)]
    radii = rasterize(isotropic(means, sigma), layers, CAMERA).radii
    assert (radii > 0).tolist() == [False, False, True, False]
    assert not radii.requires_grad


def test_the_radius_is_where_alpha_reaches_the_threshold_in_the_more_opaque_layer():
    scene = random_scene(5)
    raster, t = scene.render(rasterize), scene.tensors
    splats = reference.project(scene.geometry, scene.projection, t["means2d_offset"])
    opacity = torch.maximum(t["rgb.opacities"], t["thermal.opacities"])
    seen = raster.radii[splats.indices] > 0
    assert seen.sum() > 20
    for i in torch.nonzero(seen).flatten():
        index = splats.indices[i]
        _, axes = np.linalg.eigh(splats.covs2d[i].numpy())
        tip = splats.means2d[i] + raster.radii[index] * torch.from_numpy(axes[:, -1])
        falloff = reference.falloffs(tip[None], splats.means2d[i : i + 1], splats.covs2d[i : i + 1])
        assert (opacity[index] * falloff).item() == pytest.approx(1 / 255)


# --- the contract walked pixel by pixel, in plain loops that share nothing with the oracle


def walk_pixel(scene, modality, column, row):
    """image, depth and alpha of one pixel: the contract read aloud."""
    t = {name: values.numpy() for name, values in scene.tensors.items()}
    viewmat, K = scene.viewmat.numpy(), scene.K.numpy()
    (fx, fy), (cx, cy), size = K.diagonal()[:2], K[:2, 2], np.array([scene.width, scene.height])
    cameras = t["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    lowest = -K[:2, 2] / (fx, fy) - 0.3 * size / (2 * fx, 2 * fy)
    highest = (size - K[:2, 2]) / (fx, fy) + 0.3 * size / (2 * fx, 2 * fy)
    image, depth, transmittance = np.zeros_like(t[f"{modality}.background"]), 0.0, 1.0
    distances = np.linalg.norm(cameras, axis=1)
    for _, i in sorted((distance, i) for i, distance in enumerate(distances)):
        z = cameras[i, 2]
        if z < 0.01 or transmittance < 1e-4:
            continue
        x, y = cameras[i, 0] / z, cameras[i, 1] / z
        u, v = np.clip((x, y), lowest, highest)
        axes = Rotation.from_quat(np.roll(t["quats"][i], -1)).as_matrix() @ np.diag(t["scales"][i])
        axes = viewmat[:3, :3] @ axes
        if np.linalg.norm(axes[2]) > z:
            continue
        N = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]]) @ axes
        d = (
            np.array([column + 0.5, row + 0.5])
            - (fx * x + cx, fy * y + cy)
            - t["means2d_offset"][i]
        )
        alpha = t[f"{modality}.opacities"][i] * np.exp(
            -0.5 * d @ np.linalg.inv(N @ N.T + scene.dilation_px2 * np.eye(2)) @ d
        )
        alpha = min(0.999, alpha)
        if alpha < 1 / 255:
            continue
        image = image + alpha * transmittance * t[f"{modality}.features"][i]
        depth += alpha * transmittance * z
        transmittance *= 1 - alpha
    return image + transmittance * t[f"{modality}.background"], depth, 1 - transmittance


@pytest.mark.parametrize("seed", range(4))
def test_random_scenes_against_plain_loops(seed):
    scene = random_scene(seed)
    raster = scene.render(rasterize)
    rng = np.random.default_rng(seed)
    for column, row in zip(
        rng.integers(0, scene.width, 12), rng.integers(0, scene.height, 12), strict=True
    ):
        for modality, blend in zip(("rgb", "thermal"), raster.blends, strict=True):
            image, depth, alpha = walk_pixel(scene, modality, column, row)
            np.testing.assert_allclose(blend.image[row, column], image, atol=1e-12)
            np.testing.assert_allclose(blend.depth[row, column], depth, atol=1e-12)
            np.testing.assert_allclose(blend.alpha[row, column], alpha, atol=1e-12)


# --- symmetries


def assert_same_images(raster, other, atol=1e-9):
    for blend, other_blend in zip(raster.blends, other.blends, strict=True):
        for image, other_image in zip(blend, other_blend, strict=True):
            torch.testing.assert_close(image, other_image, rtol=0, atol=atol)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**20), axis=st.integers(0, 2**20))
def test_moving_world_and_camera_together_changes_nothing(seed, axis):
    scene = random_scene(seed, n=20)
    rng = np.random.default_rng(axis)
    turn, shift = Rotation.random(random_state=rng), rng.uniform(-3, 3, 3)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), shift
    means = torch.from_numpy(turn.apply(scene.tensors["means"].numpy()) + shift)
    quats = (
        turn * Rotation.from_quat(np.roll(scene.tensors["quats"].numpy(), -1, axis=1))
    ).as_quat()
    moved = replace(
        scene,
        tensors=scene.tensors
        | {"means": means, "quats": torch.from_numpy(np.roll(quats, 1, axis=1))},
        viewmat=scene.viewmat @ torch.from_numpy(np.linalg.inv(motion)),
    )
    raster, moved_raster = scene.render(rasterize), moved.render(rasterize)
    assert_same_images(raster, moved_raster)
    torch.testing.assert_close(raster.radii, moved_raster.radii)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**20), order=st.permutations(range(20)))
def test_the_order_of_rows_does_not_matter_when_distances_differ(seed, order):
    scene = random_scene(seed, n=20)
    shuffled = {k: v if "background" in k else v[list(order)] for k, v in scene.tensors.items()}
    raster, shuffled_raster = (
        scene.render(rasterize),
        replace(scene, tensors=shuffled).render(rasterize),
    )
    assert_same_images(raster, shuffled_raster, atol=1e-12)
    torch.testing.assert_close(raster.radii[list(order)], shuffled_raster.radii)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**20), factor=st.floats(0.01, 100))
def test_only_the_direction_of_a_quaternion_matters(seed, factor):
    scene = random_scene(seed, n=20)
    for sign in (-1, 1):
        scaled = replace(
            scene, tensors=scene.tensors | {"quats": scene.tensors["quats"] * sign * factor}
        )
        assert_same_images(scene.render(rasterize), scaled.render(rasterize))


def test_each_layer_is_blended_as_if_it_were_alone():
    scene = random_scene(3)
    both = scene.render(rasterize)
    for i, modality in enumerate(("rgb", "thermal")):
        (alone,) = scene.render(rasterize, (modality,)).blends
        for image, image_of_both in zip(alone, both.blends[i], strict=True):
            assert torch.equal(image, image_of_both)


def test_chunks_change_neither_images_nor_gradients():
    scene = random_scene(2, n=40)
    t = scene.tensors
    projected = reference.project(scene.geometry, scene.projection)
    kept = projected.indices
    given = [projected.means2d, projected.covs2d, projected.depths]
    given += [t["rgb.opacities"][kept], t["rgb.features"][kept], t["rgb.background"]]
    pixels = torch.rand(1_500_000 // len(kept), 2, dtype=torch.float64) * scene.width
    assert len(pixels) * len(kept) > reference.CHUNK_ELEMENTS
    results = []
    for function in (reference._blend_layers, reference._BlendInChunks.apply):
        leaves = [tensor.detach().requires_grad_() for tensor in given]
        images = function(pixels, *leaves)
        sum(image.square().sum() for image in images).backward()
        results.append(([*images], [leaf.grad for leaf in leaves]))
    torch.testing.assert_close(results[1], results[0])


@pytest.mark.parametrize("n", [0, 5])
def test_nothing_visible_shows_the_background(n):
    scene = random_scene(0, n=n).with_leaves()
    behind = scene.tensors["means"].detach() - 100 * scene.viewmat[2, :3]
    scene = replace(scene, tensors=scene.tensors | {"means": behind.requires_grad_()})
    raster = scene.render(rasterize)
    for modality, blend in zip(("rgb", "thermal"), raster.blends, strict=True):
        assert torch.equal(
            blend.image, scene.tensors[f"{modality}.background"].expand_as(blend.image)
        )
        assert not blend.depth.any()
        assert not blend.alpha.any()
    assert raster.radii.tolist() == [0.0] * n
    sum(image.sum() for blend in raster.blends for image in blend).backward()
    assert scene.tensors["rgb.background"].grad.tolist() == [scene.width * scene.height] * 3
    assert all(not t.grad.any() for name, t in scene.tensors.items() if "background" not in name)


# --- programmer errors

unchecked_rasterize = unwrap(
    rasterize
)  # a checker of the annotations, if the tests install one, would speak first


@pytest.mark.parametrize(
    ("name", "shape"),
    [("means", (20, 2)), ("quats", (20, 3)), ("scales", (19, 3)), ("means2d_offset", (20, 3))],
)
def test_wrong_shapes_are_named(name, shape):
    scene = random_scene(0, n=20)
    broken = replace(scene, tensors=scene.tensors | {name: torch.zeros(shape, dtype=torch.float64)})
    with pytest.raises(ValueError, match=rf"^{name} .*\[20, \d\].* \[{shape[0]}, {shape[1]}\]$"):
        broken.render(unchecked_rasterize)


def test_wrong_layers_cameras_and_sizes_are_named():
    scene = random_scene(0, n=20)
    with pytest.raises(ValueError, match=r"layer .*got 0"):
        scene.render(unchecked_rasterize, ())
    with pytest.raises(ValueError, match=r"layers\[0\]\.opacities .*\[20\].* \[3\]"):
        replace(scene, tensors=scene.tensors | {"rgb.opacities": tensor(0.1, 0.2, 0.3)}).render(
            unchecked_rasterize
        )
    with pytest.raises(ValueError, match=r"layers\[1\]\.background .*\[1\].* \[3\]"):
        replace(
            scene, tensors=scene.tensors | {"thermal.background": tensor(0.1, 0.2, 0.3)}
        ).render(unchecked_rasterize)
    with pytest.raises(ValueError, match=r"viewmat .*got \[3, 4\]"):
        replace(scene, viewmat=scene.viewmat[:3]).render(unchecked_rasterize)
    with pytest.raises(ValueError, match="0 x 29"):
        replace(scene, width=0).render(unchecked_rasterize)
