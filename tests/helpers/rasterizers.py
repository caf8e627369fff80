"""Random scenes, and the comparison of a kernel with the oracle that every kernel's tests share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from mrgs.rasterizer import reference
from mrgs.rasterizer.contract import (
    ALPHA_MAX,
    ALPHA_MIN,
    DILATION_PX2,
    LEAST_DILATION_PX2,
    TRANSMITTANCE_MIN,
    Geometry,
    Layer,
    Projection,
    Raster,
)

Rasterizer = Callable[..., Raster]

MODALITIES = ("rgb", "thermal")
LAYER_TENSORS = Layer._fields

IMAGE_ERROR_MAX = 1e-5
"""Largest absolute error of a value in [0, 1], and of a depth relative to the largest depth."""
GRADIENT_ERROR_MAX = 1e-4
"""Largest relative L2 error of a gradient."""
RADIUS_ERROR_MAX = 1e-5

ANY_CHANNELS = ((5,), (3, 2), (2,), (4,), (7, 3), (1, 1))
"""Channels of layers that one pass of the kernels cannot take."""


@dataclass(frozen=True)
class RasterizerScene:
    """A rasterizer's arguments; ``tensors`` holds the differentiable ones by name, a layer's as
    "rgb.features"."""

    tensors: dict[str, Tensor]
    viewmat: Tensor
    K: Tensor
    width: int
    height: int
    dilation_px2: float = DILATION_PX2

    def to(self, dtype: torch.dtype) -> RasterizerScene:
        tensors = {name: tensor.to(dtype) for name, tensor in self.tensors.items()}
        return replace(self, tensors=tensors, viewmat=self.viewmat.to(dtype), K=self.K.to(dtype))

    def with_leaves(self) -> RasterizerScene:
        """A copy whose tensors are leaves that require a gradient."""
        return replace(
            self,
            tensors={name: t.detach().clone().requires_grad_() for name, t in self.tensors.items()},
        )

    def render(self, rasterize: Rasterizer, modalities: tuple[str, ...] = MODALITIES) -> Raster:
        t = self.tensors
        layers = [
            Layer(*(t[f"{modality}.{name}"] for name in LAYER_TENSORS)) for modality in modalities
        ]
        return rasterize(self.geometry, layers, self.projection, t["means2d_offset"])

    @property
    def geometry(self) -> Geometry:
        return Geometry(*(self.tensors[name] for name in Geometry._fields))

    @property
    def projection(self) -> Projection:
        return Projection(self.viewmat, self.K, self.width, self.height, self.dilation_px2)

    @torch.no_grad()
    def pixels_near_a_threshold(
        self, alpha_margin: float = 1e-4, transmittance_margin: float = 1e-2
    ) -> Bool[Tensor, "h w"]:
        """Pixels where rounding may decide whether a Gaussian counts: α near 1/255 or 0.999, or T
        near 1e-4.

        There a correct float32 kernel may differ from the oracle by a whole contribution (1/255 of
        the image, and any amount in the gradient), so comparisons leave these few pixels out. The
        margins are relative; the one for T is wide because 1 − α loses up to three digits.
        """
        t = self.tensors
        splats = reference.project(self.geometry, self.projection, t["means2d_offset"])
        falloff = reference.falloffs(
            reference.pixel_centres(self.width, self.height, t["means"]),
            splats.means2d,
            splats.covs2d,
        )
        near = torch.zeros(self.height * self.width, dtype=torch.bool)
        for name in (name for name in t if name.endswith(".opacities")):
            opacities = t[name][splats.indices]
            alpha = opacities * falloff
            transmittance = reference.transmittances(reference.alphas(opacities, falloff))[:, 1:]
            for values, threshold, margin in (
                (alpha, ALPHA_MIN, alpha_margin),
                (alpha, ALPHA_MAX, alpha_margin),
                (transmittance, TRANSMITTANCE_MIN, transmittance_margin),
            ):
                near |= ((values / threshold - 1).abs() < margin).any(dim=1)
        return near.unflatten(0, (self.height, self.width))

    def gradients(self, raster: Raster, cotangents: list[Tensor]) -> dict[str, Tensor]:
        """The gradient of Σ cotangent · image for every tensor that the raster depends on."""
        images = [image for blend in raster.blends for image in blend]
        cotangents = [cotangent.to(images[0]) for cotangent in cotangents]
        grads = torch.autograd.grad(
            images, list(self.tensors.values()), cotangents, allow_unused=True
        )
        return {
            name: grad for name, grad in zip(self.tensors, grads, strict=True) if grad is not None
        }


def random_scene(
    seed: int, n: int = 60, width: int = 37, height: int = 29, dtype: torch.dtype = torch.float64
) -> RasterizerScene:
    """A rotated camera with fx ≠ fy and an off-centre principal point, before n Gaussians of all
    kinds.

    One in ten lies behind the camera or before the near plane, about a third of the rest outside
    the image. Most project to a few pixels, some to less than one, one in fifteen to more than the
    image; these lie so far off that the clamp in the Jacobian acts on some. Opacities reach below
    1/255 and above 0.999. Distances differ, so that no rounding can swap two Gaussians. The
    dilation is that of 3DGS or smaller, by the seed.
    """
    rng = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=rng, dtype=torch.float64)

    fx, fy = uniform(0.7, 1.5, 2) * width
    cx, cy = uniform(0.35, 0.65, 2) * torch.tensor([width, height])
    K = torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = reference.rotation_matrices(uniform(-1, 1, 1, 4))[0]
    viewmat[:3, 3] = uniform(-2, 2, 3)

    distances = 1 + 5 * (torch.randperm(n, generator=rng) + uniform(0, 0.5, n)) / max(n, 1)
    means2d = uniform(-0.1, 1.1, n, 2)
    means2d[3::15] = uniform(-0.7, 1.7, len(means2d[3::15]), 2)
    means2d *= torch.tensor([width, height])
    rays = torch.cat([(means2d - K[:2, 2]) / K.diagonal()[:2], torch.ones(n, 1)], dim=1)
    depths = distances / rays.norm(dim=1)
    means_camera = rays * depths[:, None]
    means_camera[::20] *= -1
    means_camera[10::20] *= 0.005 / depths[10::20, None]
    extent_px = torch.exp(uniform(-1, 2, n))
    extent_px[3::15] = uniform(0.5, 1.5, len(extent_px[3::15])) * width
    scales = torch.exp(uniform(-0.8, 0.8, n, 3)) * (extent_px * depths / fx)[:, None]
    tensors = {
        "means": (means_camera - viewmat[:3, 3]) @ viewmat[:3, :3],
        "quats": torch.randn(n, 4, generator=rng, dtype=torch.float64) * uniform(0.3, 3, n, 1),
        "scales": scales,
        "means2d_offset": uniform(-0.5, 0.5, n, 2),
    }
    for modality, channels in (("rgb", 3), ("thermal", 1)):
        opacities = uniform(0.01, 0.99, n)
        opacities[1::9] = uniform(0.001, 0.01, len(opacities[1::9]))
        opacities[5::9] = uniform(0.99, 0.99999, len(opacities[5::9]))
        tensors[f"{modality}.opacities"] = opacities
        tensors[f"{modality}.features"] = uniform(0, 1, n, channels)
        tensors[f"{modality}.background"] = uniform(0, 1, channels)
    # Through float32, so that a float32 kernel and the float64 oracle are given the same numbers.
    dilation_px2 = (DILATION_PX2, 0.1, LEAST_DILATION_PX2)[seed % 3]
    scene = RasterizerScene(tensors, viewmat, K, width, height, dilation_px2)
    return scene.to(torch.float32).to(dtype)


def wide_and_flat(scene: RasterizerScene) -> RasterizerScene:
    """The scene with its Gaussians 15 times as wide and parallel to the image, so that none reaches
    the plane of the camera."""
    means = scene.tensors["means"]
    facing = {
        "means": reference.to_camera(means, scene.viewmat.to(means)),
        "quats": means.new_tensor([1.0, 0, 0, 0]).expand(len(means), 4).clone(),
        "scales": scene.tensors["scales"] * means.new_tensor([15.0, 15.0, 0.1]),
    }
    return replace(scene, viewmat=torch.eye(4).to(scene.viewmat), tensors=scene.tensors | facing)


def needle_scene(dilation_px2: float, width: int, height: int) -> RasterizerScene:
    """Slanting Gaussians that are as thin as the dilation lets them be, with standard deviations
    from a third of the image's width to eight times as much: written as quadratic forms of dx and
    dy, they and the moments of their gradients would cancel in float32."""
    n = 12
    scene = random_scene(0, n, width, height)
    along = torch.logspace(-0.5, 1.2, n, dtype=torch.float64)
    half_angle = torch.linspace(0.1, 1.4, n, dtype=torch.float64)
    zero, one = torch.zeros(n, dtype=torch.float64), torch.ones(n, dtype=torch.float64)
    across = torch.linspace(-0.5, 0.5, n, dtype=torch.float64)
    tensors = {
        "means": torch.stack([across, across.roll(5), 1 + 0.1 * torch.arange(n) * one], dim=1),
        "quats": torch.stack([half_angle.cos(), zero, zero, half_angle.sin()], dim=1),
        "scales": torch.stack([along, 1e-3 * one, 1e-3 * one], dim=1),
    }
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]).double()
    scene = replace(
        scene,
        viewmat=torch.eye(4).double(),
        K=K,
        tensors=scene.tensors | tensors,
        dilation_px2=dilation_px2,
    )
    return scene.to(torch.float32).to(torch.float64)


def random_cotangents(raster: Raster, left_out: Bool[Tensor, "h w"], seed: int) -> list[Tensor]:
    """One random float64 weight per value of every image, blend by blend; 0 at the pixels to be
    left out.

    Their mean is 1: around 0, the one number of a background's gradient could cancel down to its
    rounding.
    """
    rng = torch.Generator().manual_seed(seed)
    images = [image for blend in raster.blends for image in blend]
    weights = [1 + torch.randn(image.shape, generator=rng, dtype=torch.float64) for image in images]
    return [
        weight.masked_fill(left_out.view(*left_out.shape, *[1] * (weight.ndim - 2)), 0.0)
        for weight in weights
    ]


def relative_l2(value: Tensor, truth: Tensor) -> float:
    """‖value − truth‖ / ‖truth‖; the plain difference where the truth is 0."""
    norm = truth.norm().item()
    return (value.to(truth) - truth).norm().item() / (norm if norm > 0 else 1.0)


def compare_with_oracle(
    rasterize: Rasterizer,
    scene: RasterizerScene,
    modalities: tuple[str, ...] = MODALITIES,
    seed: int = 0,
) -> dict[str, float]:
    """How far a float32 rasterizer is from the float64 oracle on the same (float32) numbers.

    Returns:
        "rgb.image", "rgb.alpha", ...: largest absolute difference; "rgb.depth", ...: the same over
        the largest depth; "radii": largest difference relative to the radius (plus one pixel);
        "grad means", "grad rgb.features", ...: relative L2 error of the gradient of a random linear
        loss.
    """
    left_out = scene.to(torch.float64).pixels_near_a_threshold()
    truth_scene, scene = (
        scene.to(torch.float64).with_leaves(),
        scene.to(torch.float32).with_leaves(),
    )
    truth, raster = (
        truth_scene.render(reference.rasterize, modalities),
        scene.render(rasterize, modalities),
    )
    errors = {"radii": ((raster.radii - truth.radii).abs() / (truth.radii + 1)).amax().item()}
    for modality, blend, true_blend in zip(modalities, raster.blends, truth.blends, strict=True):
        for name, image, true_image in zip(blend._fields, blend, true_blend, strict=True):
            scale = max(1.0, true_image.max().item()) if name == "depth" else 1.0
            errors[f"{modality}.{name}"] = (image - true_image)[
                ~left_out
            ].abs().max().item() / scale
    cotangents = random_cotangents(truth, left_out, seed)
    truth_grads = truth_scene.gradients(truth, cotangents)
    grads = scene.gradients(raster, cotangents)
    errors |= {f"grad {name}": relative_l2(grads[name], grad) for name, grad in truth_grads.items()}
    return errors


def assert_small(errors: dict[str, float], gradient_error_max: float = GRADIENT_ERROR_MAX) -> None:
    for name, error in errors.items():
        limit = gradient_error_max if name.startswith("grad ") else IMAGE_ERROR_MAX
        limit = RADIUS_ERROR_MAX if name == "radii" else limit
        assert error < limit, (name, errors)


def assert_gradients_of_needles(rasterize: Rasterizer, dilation_px2: float) -> None:
    errors = compare_with_oracle(rasterize, needle_scene(dilation_px2, 50, 40))
    gradients = {name: error for name, error in errors.items() if name.startswith("grad ")}
    assert max(gradients.values()) < GRADIENT_ERROR_MAX, gradients
    assert gradients["grad scales"] < 1e-5, gradients


def images_of(raster: Raster) -> list[Tensor]:
    return [image for blend in raster.blends for image in blend]


def sum_of_squares(images: list[Tensor]) -> Tensor:
    return torch.stack([image.square().sum() for image in images]).sum()


def render_and_differentiate(
    rasterize: Rasterizer,
    scene: RasterizerScene,
    loss: Callable[[list[Tensor]], Tensor] = sum_of_squares,
) -> tuple[list[Tensor], dict[str, Tensor | None]]:
    """All outputs, and the gradient of a loss for every tensor of the scene."""
    scene = scene.with_leaves()
    raster = scene.render(rasterize)
    loss(images_of(raster)).backward()
    grads = {name: tensor.grad for name, tensor in scene.tensors.items()}
    return [*(image.detach() for image in images_of(raster)), raster.radii], grads


def assert_same_bits(result: tuple[list, dict], other: tuple[list, dict]) -> None:
    for values, other_values in zip(result[0], other[0], strict=True):
        assert torch.equal(values, other_values)
    for name, gradient in result[1].items():
        assert torch.equal(gradient, other[1][name]), name


def assert_any_channels(rasterize: Rasterizer, channels: tuple[int, ...]) -> None:
    """Images and gradients of layers that no pass takes as they are."""
    scene, seed = random_scene(2, 12, 20, 12), torch.Generator().manual_seed(1)
    tensors = {name: t for name, t in scene.tensors.items() if "." not in name}
    for place, count in enumerate(channels):
        tensors[f"{place}.opacities"] = scene.tensors[f"{MODALITIES[place]}.opacities"]
        tensors[f"{place}.features"] = torch.rand(12, count, generator=seed).double()
        tensors[f"{place}.background"] = torch.rand(count, generator=seed).double()
    scene = replace(scene, tensors=tensors)
    assert_small(compare_with_oracle(rasterize, scene, tuple(map(str, range(len(channels))))))


def assert_shows_the_background(rasterize: Rasterizer, scene: RasterizerScene) -> None:
    """What is seen, and what has a gradient, where all of a scene's Gaussians lie behind the
    camera."""
    behind = scene.tensors["means"] - 100 * scene.viewmat[2, :3]
    scene = replace(scene, tensors=scene.tensors | {"means": behind})
    outputs, grads = render_and_differentiate(
        rasterize, scene, lambda images: sum(i.sum() for i in images)
    )
    *images, radii = outputs
    for modality, blend in (("rgb", images[:3]), ("thermal", images[3:])):
        assert torch.equal(blend[0], scene.tensors[f"{modality}.background"].expand_as(blend[0]))
        assert not blend[1].any()
        assert not blend[2].any()
        assert (
            grads[f"{modality}.background"].tolist()
            == [scene.width * scene.height] * blend[0].shape[-1]
        )
    assert radii.shape == scene.tensors["means"].shape[:1]
    assert not radii.any()
    assert not radii.requires_grad
    assert not any(gradient.any() for name, gradient in grads.items() if "background" not in name)
