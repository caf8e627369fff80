"""One view of a training step: rendered, compared with its photos, differentiated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from mrgs.data.undistort import resize
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.losses.photometric import total_loss
from mrgs.method.losses.term import LossContext, SceneScale, Term
from mrgs.method.losses.terms import term_values
from mrgs.render import Model, ScreenPoints, render, renderer
from mrgs.scene import THERMAL, Camera, Modality, Pixels, Rendering, View
from mrgs.training.state import TrainingState

SMALLEST_PX = 160
"""No side of an image is made shorter than this: smaller images lose more than they save."""


class PhotographedView(NamedTuple):
    """A training view, by its place among them, with its photos."""

    number: int
    view: View
    photos: Mapping[Modality, Pixels]


class ViewInputs(NamedTuple):
    """What the pass of a view reads besides the model.

    Attributes:
        number: the view's place among the training views, on the device.
        pixel_sizes: of the photos, in pixels of the scene's.
        terms: of the loss, those that are due.
        weights: λ of each of these terms, by name.
        temperature_degree: highest degree of the temperature's harmonics that counts; 0 where it
            has none.
    """

    number: Int64[Tensor, "1"]
    cameras: Mapping[Modality, Camera]
    photos: Mapping[Modality, Pixels]
    pixel_sizes: Mapping[Modality, float]
    terms: Sequence[Term]
    weights: Mapping[str, float | Float[Tensor, ""]]
    temperature_degree: int


class ViewMeasures(NamedTuple):
    """What the pass of a view has measured, without gradients.

    Attributes:
        loss: L_total.
        terms: of the loss, unweighted, by name.
        thermal_error: mean absolute error of the normalised temperature; NaN if no pixel is valid,
            None without a thermal photo.
        residual: of the parts of the thermal photo, where drift or shading is modelled.
        passes: the projected centres, with the gradients of their places.
    """

    loss: Float[Tensor, ""]
    terms: Mapping[str, Float[Tensor, ""]]
    thermal_error: Float[Tensor, ""] | None
    residual: Float[Tensor, " n"] | None
    passes: Sequence[ScreenPoints]


def view_inputs(state: TrainingState, each: PhotographedView, config: TrainConfig) -> ViewInputs:
    """What the pass of a view reads at the step of the state."""
    cameras, photos = coarser(each.view.cameras, each.photos, config.pixel_size_at(state.step))
    terms = [term for term in state.terms if term.is_due(state.step)]
    return ViewInputs(
        torch.full((1,), each.number, device=state.device),
        cameras,
        photos,
        pixel_sizes(each.view.cameras, cameras),
        terms,
        {term.name: term.weight(state.step) for term in terms},
        temperature_degree(state, config),
    )


def temperature_degree(state: TrainingState, config: TrainConfig) -> int:
    """Highest degree of the temperature's harmonics that counts at this step; 0 without any."""
    depends = state.model.gaussians.depends_on_view(THERMAL)
    return config.temperature_sh_degree_at(state.step) if depends else 0


def forward_backward(state: TrainingState, inputs: ViewInputs, scale: SceneScale) -> ViewMeasures:
    """Render a view, compare it with its photos, and add its gradients to the parameters'."""
    context, passes = rendered(state.model, state.image_model, inputs, scale)
    values = term_values(inputs.terms, context)
    loss = total_loss(values, inputs.weights)
    loss.backward()
    terms = {name: value.detach() for name, value in values.items()}
    thermal_error = residual = None
    if THERMAL in inputs.photos:
        photo = inputs.photos[THERMAL]
        thermal_error = _thermal_error(context.observed, photo)
        residual = state.image_model.thermal_residual(context.observed, photo)
    return ViewMeasures(loss.detach(), terms, thermal_error, residual, passes)


def rendered(
    model: Model, image_model: ImageModel, inputs: ViewInputs, scale: SceneScale
) -> tuple[LossContext, Sequence[ScreenPoints]]:
    """Render a view as its cameras would have recorded it: what the terms of the loss may look at,
    and the projected centres."""
    degrees = {THERMAL: inputs.temperature_degree}
    cameras = image_model.refined(inputs.cameras, inputs.number)
    rendering, passes = render(model, cameras, degrees)
    context = LossContext(
        rendering=rendering,
        observed=image_model(rendering, inputs.number, inputs.pixel_sizes),
        photos=inputs.photos,
        cameras=cameras,
        gaussians=model.gaussians,
        dilation=model.dilation,
        scale=scale,
        render=renderer(model, degrees),
    )
    return context, passes


def _thermal_error(rendering: Rendering, photo: Pixels) -> Float[Tensor, ""]:
    """Mean absolute error of the normalised temperature over valid pixels; NaN without any."""
    error = (rendering[THERMAL].image.detach() - photo.values).abs()
    if photo.valid is None:
        return error.mean()
    return torch.where(photo.valid[:, :, None], error, 0).sum() / photo.valid.sum()


def coarser(
    cameras: Mapping[Modality, Camera], photos: Mapping[Modality, Pixels], pixel_size: int
) -> tuple[Mapping[Modality, Camera], Mapping[Modality, Pixels]]:
    """A view's cameras and photos with larger pixels: their side, a power of two, in pixels of the
    photos; smaller where an image would be too small. What a coarse pixel averages is as for
    ``--resolution``; it counts where all of that does."""
    if pixel_size == 1:
        return cameras, photos
    resized = {}
    for modality, camera in cameras.items():
        size = coarse_size(camera.width, camera.height, pixel_size)
        is_same = size == (camera.width, camera.height)
        resized[modality] = camera if is_same else camera.resized(*size)
    return resized, {
        modality: _resized(pixels, resized[modality]) for modality, pixels in photos.items()
    }


def pixel_sizes(
    cameras: Mapping[Modality, Camera], coarse: Mapping[Modality, Camera]
) -> dict[Modality, float]:
    """Side of a pixel of the coarser cameras, in pixels of the cameras, by modality."""
    return {modality: camera.width / coarse[modality].width for modality, camera in cameras.items()}


def coarse_size(width: int, height: int, pixel_size: int) -> tuple[int, int]:
    """Width and height with pixels of this size, smaller where the image would be too small."""
    while pixel_size > 1 and min(width, height) < SMALLEST_PX * pixel_size:
        pixel_size //= 2
    return width // pixel_size, height // pixel_size


def _resized(pixels: Pixels, camera: Camera) -> Pixels:
    """The pixels on the grid of a camera."""
    return Pixels(*resize(pixels.values, pixels.valid, camera.width, camera.height))
