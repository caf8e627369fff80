"""Do the kernels compute what their plain definitions say, and are these the package's own? Checked
when a training starts, and when a trained model is opened."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import replace
from types import FunctionType
from typing import Any

import torch
from jaxtyping import Int64
from torch import Tensor

from mrgs.errors import warn_user
from mrgs.method.adam import move
from mrgs.method.camera_model.image_model import ImageModel
from mrgs.method.config import TrainConfig
from mrgs.method.losses.term import SceneScale
from mrgs.method.losses.terms import term_values
from mrgs.render import Model, render, rows_in_view
from mrgs.scene import NOT_COARSER, Camera, Gaussians, Pixels, Scene
from mrgs.system.operation import Operation, checking
from mrgs.system.wording import listed
from mrgs.training.state import TrainingState
from mrgs.training.view_pass import ViewInputs, rendered

SAMPLED_GAUSSIANS = 300
WIDTH_PX = 48
INVALID = 0.05
"""Share of the pixels that the sample's masks leave out."""

NOISE = 0.05
"""Least noise of the sample's photos: some of the differences to them are then within it."""

CHANGED_BY = {
    "quats": 0.5, "log_scales": 0.3, "opacity_logit": 1.5, "sh_rest": 0.1, "embedding": 0.1
}  # fmt: skip
"""Standard deviations of what is added to the sample's parameters. A training starts with balls
that look the same from everywhere, so that much of the mathematics would not show in them."""


_DEFINED_IN = ("mrgs.field.", "mrgs.method.", "mrgs.rasterizer.", "mrgs.render.", "mrgs.training.")
_IMPORTED = {"mrgs", "torch", "numpy", "scipy", "jaxtyping", *sys.stdlib_module_names}
"""Packages whose functions these modules import."""


def custom_definitions() -> list[str]:
    """The functions of the model that someone has replaced from outside of the package, each as
    "equation: NAME: WHAT REPLACES IT", and as "kernel: NAME: ..." those whose kernels differ."""
    found: dict[str, str] = {}
    for name, value in _members():
        if isinstance(value, Operation) and value.rejected:
            found[f"kernel: {value.name}"] = "not used, it differs from the definition"
        plain = value.plain if isinstance(value, Operation) else value
        if isinstance(plain, FunctionType) and full_name(plain).partition(".")[0] not in _IMPORTED:
            found[f"equation: {name}"] = full_name(plain)
    return [f"{what}: {other}" for what, other in found.items()]


def _members() -> Iterator[tuple[str, Any]]:
    """What the modules of the model and their classes have, by full name."""
    for name, module in [*sys.modules.items()]:
        own = vars(module) if f"{name}.".startswith(_DEFINED_IN) else {}
        types = [value for value in own.values() if isinstance(value, type)]
        classes = {
            full_name(each): vars(each) for each in types if each.__module__.startswith("mrgs.")
        }
        for place, members in ({name: own} | classes).items():
            yield from ((f"{place}.{attribute}", value) for attribute, value in members.items())


def full_name(named: type | FunctionType) -> str:
    """The name of a class or function with its module."""
    return f"{named.__module__}.{named.__qualname__}"


def warn_of_missing(custom_parts: Iterable[str]) -> None:
    """MrgsWarning if a run was trained with replaced definitions that this process has not
    replaced; see ``RunFolder.custom_parts``."""
    trained = [part.split(": ")[1] for part in custom_parts if part.startswith("equation: ")]
    here = [part.split(": ")[1] for part in custom_definitions()] if trained else []
    if names := [name for name in trained if name not in here]:
        warn_user(
            f"the run was trained with other definitions of {listed(names)}: replace them in this "
            f"process, too, or what it computes by them is of another model"
        )


def check_kernels(
    state: TrainingState, scene: Scene, config: TrainConfig, scale: SceneScale
) -> None:
    """Take the forward pass of a training step on a sample of the model, and a step of Adam, and
    compare each kernel with its plain definition: values and gradients. A MrgsWarning if one
    differs, which is not used any more in this process (``operation.checking``). The state is left
    as it is. Photos of all modalities are random numbers, once with masks and once without."""
    scale = scale._replace(thermal_noise=max(scale.thermal_noise, NOISE))
    generator, device = torch.Generator().manual_seed(0), state.device
    missing = {modality for view in scene.train for modality in view.images}
    with checking(), torch.enable_grad():
        for number, view in sorted(enumerate(scene.train), key=lambda each: -len(each[1].images)):
            if not missing & set(view.images):
                continue
            missing -= set(view.images)
            cameras = {each: camera.with_width(WIDTH_PX) for each, camera in view.cameras.items()}
            seen = rows_in_view(state.model, next(iter(cameras.values())))
            model = _sampled(state.model, seen, config.sh_degree_at(config.max_steps))
            last = (config.max_steps - 1, config.max_steps)  # one of them goes without harmonics
            photos = {
                modality: random_photo(camera, modality.channels, generator, device)
                for modality, camera in cameras.items()
            }
            inputs = ViewInputs(
                number=torch.full((1,), number, device=device),
                cameras=cameras,
                photos=photos,
                pixel_sizes=NOT_COARSER,
                terms=state.terms,
                weights={},  # the values are compared one by one
                temperature_degree=max(map(config.temperature_sh_degree_at, last)),
            )
            context, _ = rendered(model, state.image_model, inputs, scale)
            whole = {modality: Pixels(photo.values) for modality, photo in photos.items()}
            for each in (context, replace(context, photos=whole)):
                term_values(state.terms, each)
        _check_optimizer(device, generator)


def _check_optimizer(device: torch.device, generator: torch.Generator) -> None:
    """Take a step of Adam: of one tensor that may be skipped, and of two that may not. Parameters
    start at 0, so that what is compared is how far they move."""
    for count, skip in ((1, torch.zeros((), device=device)), (2, None)):
        gradients, means, squares = (
            list(torch.rand(count, SAMPLED_GAUSSIANS, generator=generator).to(device))
            for _ in range(3)
        )
        steps = [torch.full((), 3.0, device=device) for _ in range(count)]
        parameters = list(map(torch.zeros_like, gradients))
        move(parameters, gradients, means, squares, steps, 1.0, 1e-8, skip)


def check_rendering(model: Model, image_model: ImageModel, *devices: torch.device) -> None:
    """Render a sample of a trained model by a new camera, on the devices where it will be rendered,
    and compare each kernel with its plain definition. A MrgsWarning if one differs, which is not
    used any more in this process (``operation.checking``). The image model is on the host."""
    if len(model.gaussians) == 0:
        return
    sample = _sampled(model, None, model.sh_degree)
    camera = _camera_before(sample.gaussians)
    cameras = dict.fromkeys(sample.gaussians.modalities, camera)
    with checking(gradients=False), torch.no_grad():
        for device in devices:
            rendering = render(sample.to(device), cameras, with_median_depth=True)[0].cpu()
            image_model.expected(rendering, camera)


def _camera_before(gaussians: Gaussians) -> Camera:
    """A camera that faces Gaussians along z, from a distance at which most are in view."""
    means = gaussians.means.detach().double().cpu()
    centre = means.median(dim=0).values
    radius = (means - centre).norm(dim=1).median().item()
    largest = gaussians.scales.detach().amax(dim=1).median().item()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -centre
    viewmat[2, 3] += 2 * radius + 3 * largest
    f, c = float(WIDTH_PX), WIDTH_PX / 2
    K = torch.tensor([[f, 0, c], [0, f, c], [0, 0, 1]], dtype=torch.float64)
    return Camera(K, viewmat, WIDTH_PX, WIDTH_PX)


def _sampled(model: Model, rows: Int64[Tensor, " v"] | None, sh_degree: int) -> Model:
    """Changed copies of some Gaussians under the model's own layers, of those in the rows if there
    are any, else of all; t̂ is not known beforehand."""
    if rows is None or len(rows) == 0:
        rows = torch.arange(len(model.gaussians), device=model.gaussians.means.device)
    count = min(SAMPLED_GAUSSIANS, len(rows))
    rows = rows[torch.arange(count, device=rows.device) * len(rows) // max(count, 1)]
    found, generator = model.gaussians.rows(rows), torch.Generator().manual_seed(0)
    changed = {}
    for name, tensor in found.tensors().items():
        noise = torch.randn(tensor.shape, generator=generator).to(tensor)
        scale = CHANGED_BY.get(name.partition(".")[0], 0.0)
        changed[name] = (tensor.detach() + scale * noise).requires_grad_()
    gaussians = found.with_tensors(changed)
    return replace(
        model,
        gaussians=gaussians,
        neighbours=model.field.neighbours_of(gaussians.means),
        sh_degree=sh_degree,
        temperature_residuals=None,
    )


def random_photo(
    camera: Camera, channels: int, generator: torch.Generator, device: torch.device
) -> Pixels:
    """Random values, of which a few do not count."""
    values = torch.rand(camera.height, camera.width, channels, generator=generator)
    valid = torch.rand(camera.height, camera.width, generator=generator) >= INVALID
    return Pixels(values.to(device), valid.to(device))
