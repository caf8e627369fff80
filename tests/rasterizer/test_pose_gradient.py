from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from mrgs.rasterizer import Geometry, Layer, Projection, Raster, rasterize, reference
from mrgs.rasterizer.pose_gradient import with_pose_gradient
from mrgs.scene import Camera
from mrgs.scene.rotations import cross_matrix
from tests.helpers.rasterizers import relative_l2

FAR = torch.tensor([300.0, -200.0, 50.0], dtype=torch.float64)
CAMERA = Camera.from_fov(32, 24, 60).look_at(FAR, FAR + torch.tensor([0.3, 4.0, 0.5]))


def scene() -> dict[str, Tensor]:
    """Gaussians before the camera, whose values are exact in both precisions."""
    generator = torch.Generator().manual_seed(0)

    def random(*size: int) -> Tensor:
        return torch.randn(*size, generator=generator).double()

    centre = (FAR + torch.tensor([0.3, 4.0, 0.5])).float().double()
    return {
        "means": (centre + 0.5 * random(30, 3)).float().double(),
        "quats": random(30, 4),
        "scales": 0.05 + 0.1 * random(30, 3).abs(),
        "opacities": torch.sigmoid(random(30)),
        "features": random(30, 3),
    }


ImageOf = Callable[[dict[str, Tensor], Layer, Tensor], Raster]


def loss(pose: Tensor, gaussians: dict[str, Tensor], image_of: ImageOf) -> Tensor:
    layer = Layer(
        gaussians["opacities"], gaussians["features"], torch.zeros_like(gaussians["features"][0])
    )
    raster = image_of(gaussians, layer, pose)
    image, depth, alpha = (each.double() for each in raster.blends[0])
    weights = torch.linspace(-1, 1, 32 * 24 * 3).view(24, 32, 3)
    return (image * weights).sum() + 0.1 * depth.sum() + (alpha * weights[..., 0]).sum()


def by_autograd(gaussians: dict[str, Tensor], layer: Layer, pose: Tensor) -> Raster:
    geometry = Geometry(gaussians["means"], gaussians["quats"], gaussians["scales"])
    return reference.rasterize(geometry, [layer], Projection(pose, CAMERA.K, 32, 24))


def by_rigid_motion(gaussians: dict[str, Tensor], layer: Layer, pose: Tensor) -> Raster:
    means, quats = with_pose_gradient(gaussians["means"], gaussians["quats"], pose)
    projection = Projection(pose.detach(), CAMERA.K, 32, 24)
    return rasterize(Geometry(means, quats, gaussians["scales"]), [layer], projection)


def moved(motion: Tensor) -> Tensor:
    """The camera's pose after a motion of the world about the camera, 6 numbers."""
    rotation = torch.linalg.matrix_exp(cross_matrix(motion[:3]))
    shift = FAR + motion[3:] - rotation @ FAR
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    return CAMERA.viewmat @ torch.cat([torch.cat([rotation, shift[:, None]], dim=1), last])


def gradient(image_of: ImageOf, dtype: torch.dtype) -> Tensor:
    gaussians = {name: tensor.to(dtype) for name, tensor in scene().items()}
    motion = torch.tensor([0.02, -0.01, 0.03, 0.05, 0.02, -0.04], dtype=torch.float64)
    motion.requires_grad_()
    (found,) = torch.autograd.grad(loss(moved(motion), gaussians, image_of), motion)
    return found


def test_it_is_the_gradient_of_the_oracle() -> None:
    expected = gradient(by_autograd, torch.float64)
    found = gradient(by_rigid_motion, torch.float64)
    assert relative_l2(found, expected) < 1e-10


def test_it_comes_from_the_kernels_too_and_far_from_the_origin() -> None:
    expected = gradient(by_autograd, torch.float64)
    found = gradient(by_rigid_motion, torch.float32)
    assert relative_l2(found, expected) < 1e-3


def test_gradients_of_the_gaussians_stay_what_they_are() -> None:
    tensors = {name: tensor.requires_grad_() for name, tensor in scene().items()}
    names = ("means", "quats")

    def gradients(pose: Tensor) -> tuple[Tensor, ...]:
        found = loss(pose, tensors, by_rigid_motion)
        return torch.autograd.grad(found, [tensors[name] for name in names])

    still = gradients(CAMERA.viewmat)
    learned = gradients(CAMERA.viewmat.clone().requires_grad_())
    for a, b in zip(still, learned, strict=True):
        assert torch.equal(a, b)


def test_without_a_gradient_nothing_is_done() -> None:
    means, quats = torch.zeros(2, 3), torch.ones(2, 4)
    found = with_pose_gradient(means, quats, CAMERA.viewmat)
    assert found[0] is means
    assert found[1] is quats
