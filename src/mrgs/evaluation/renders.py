"""Score any program's renderings of a scene's held-out views: image files named like the views.

``FOLDER/MODALITY/NAME.png`` (or .jpg), such as ``FOLDER/rgb``. A modality with a unit may be
``FOLDER/MODALITY_normalised/NAME.tiff`` instead: float32, 0 and 1 at the ends of its range.
Temperatures are in one of

- ``FOLDER/temperature_c/NAME.tiff``: float32, °C;
- ``FOLDER/thermal_normalised/NAME.tiff``: float32, 0 and 1 at the ends of the scene's range;
- ``FOLDER/thermal/NAME.png``: 8-bit or 16-bit grey over the scene's range; or ``NAME.tiff``,
  float32, °C.

The first of these folders that exists is read, so that the output of ``mrgs render`` can be scored:
its ``thermal/`` has coloured pictures beside the values. ``depth_thermal/NAME.tiff`` (z-depth,
scene units) is optional.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float32
from torch import Tensor

from mrgs.data import load_scene
from mrgs.data.files import IMAGE_SUFFIXES, without_image_suffix
from mrgs.data.images import Decoded, decode, with_channels
from mrgs.errors import RunError, SceneError, warn_user
from mrgs.evaluation.evaluate import Metrics, Truth
from mrgs.evaluation.report import RunFacts
from mrgs.evaluation.score_run import Counted, Progress, score_views
from mrgs.scene import (
    THERMAL,
    Blend,
    Camera,
    Modality,
    Rendering,
    Scene,
    TemperatureRange,
    View,
    in_order,
)
from mrgs.system.wording import listed

GREY_TOLERANCE = 2.5 / 255
"""Largest difference between the channels of a grey image that was saved in colour."""

FLOAT_SUFFIXES = frozenset({".tif", ".tiff"})

CELSIUS_FOLDER = "temperature_c"


@dataclass(frozen=True)
class Renders:
    """The image files of one folder: of each modality that it has, by view name, where the name of
    a file's folder determines how it is read; and thermal depths, if any, by view name."""

    images: Mapping[Modality, Mapping[str, Path]]
    depths: Mapping[str, Path]

    def rendering(self, view: View, temperature: TemperatureRange | None) -> Rendering:
        """The images of a view, as if a model had rendered them. RunError if a file cannot be used;
        the message names it and the remedy."""
        blends = {}
        for modality, posed in view.images.items():
            if modality in self.images:
                path = self.images[modality][view.name]
                image = _read(path, posed.camera, modality, temperature)
                blends[modality] = Blend.of_image(image)
        depths = {}
        if THERMAL in blends and view.name in self.depths:
            path = self.depths[view.name]
            decoded = _decoded(path, view.images[THERMAL].camera)
            depth, hit = _floats(path, decoded)[..., 0], decoded.valid
            # Infinite where the program found no surface.
            depths[THERMAL] = depth if hit is None else torch.where(hit, depth, torch.inf)
        return Rendering(blends, depths)


def evaluate_renders(
    scene: str | Path,
    folder: str | Path,
    *,
    name: str | None = None,
    output: Path | None = None,
    resolution: int | None = None,
    lpips_weights: Path | None = None,
    progress: Progress | None = None,
) -> Metrics:
    """Score a folder of renderings with the metrics of ``evaluate_run``.

    Writes ``metrics.json``, ``metrics.md`` and ``contact_sheet.png``. The images are compared with
    the undistorted photos, at the size at which ``load_scene`` gives them. MrgsWarning if the
    folder has images of no eval view.

    Args:
        folder: of the images, see the module.
        name: of the program, in the report; by default the folder's name.
        output: folder to write to; by default ``folder/eval``.
        resolution: photos wider than this many pixels are downscaled to it, as in training.
        lpips_weights: weights for LPIPS, as for ``evaluate_run``.

    Raises:
        SceneError: the scene cannot be read, or has no eval views.
        RunError: an image is missing, cannot be read, or has another size than its view.
    """
    folder = Path(folder)
    loaded = load_scene(scene, resolution=resolution)
    renders = find_renders(folder, loaded)
    facts = RunFacts(name or folder.resolve().name, loaded.name)
    return score_views(
        loaded,
        Truth.of(loaded),
        lambda view: renders.rendering(view, loaded.temperature),
        facts,
        output or folder / "eval",
        lpips_weights,
        Counted(progress, len(loaded.eval)).one_more,
    )


def find_renders(folder: Path, scene: Scene) -> Renders:
    """The files for a scene's eval views; nothing is decoded yet. RunError if the folder has no
    images, or not all that it must have. MrgsWarning for images of no eval view."""
    modalities = in_order(modality for view in scene.eval for modality in view.images)
    if not folder.is_dir():
        folders = " and ".join(f"{modality}/" for modality in modalities)
        raise RunError(f"{folder} is not a folder: give the folder that holds {folders}")
    images, wanted = {}, []
    for modality in modalities:
        names = [view.name for view in scene.eval if modality in view.images]
        possible = [CELSIUS_FOLDER] if modality == THERMAL else []
        possible += [f"{modality}_normalised"] if modality.is_metric else []
        found = [name for name in possible if (folder / name).is_dir()]
        place = folder / next(iter(found), modality.name)
        suffixes = IMAGE_SUFFIXES - {".npy"} if place.name == modality.name else FLOAT_SUFFIXES
        files = _files(place, names, suffixes)
        if files is not None:
            images[modality] = files
        wanted.append(f"{modality.title} images into {folder / modality.name}")
    if wanted and not images:
        names = [view.name for view in scene.eval]
        raise RunError(
            f"{folder} holds no renderings: put {' and '.join(wanted)}, named like the eval views "
            f"({listed(names)})"
        )
    depths = None
    if THERMAL in images:
        depths = _files(folder / "depth_thermal", list(images[THERMAL]), FLOAT_SUFFIXES)
    return Renders(images, depths or {})


def _files(folder: Path, names: list[str], suffixes: frozenset[str]) -> dict[str, Path] | None:
    """The image of each view; None where the folder is not there or no view needs it."""
    if not names or not folder.is_dir():
        return None
    found: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() in suffixes and path.is_file():
            found.setdefault(without_image_suffix(path.name), []).append(path)
    missing = [name for name in names if name not in found]
    if missing:
        raise RunError(
            f"{folder} has no image of {len(missing)} of {len(names)} eval views "
            f"({listed(missing)}): add them, named like the views"
        )
    for name in names:
        if len(found[name]) > 1:
            raise RunError(
                f"{folder} has several images of the view {name}: keep one of "
                f"{listed([path.name for path in found[name]])}"
            )
    extra = sorted(found.keys() - set(names))
    if extra:
        warn_user(
            f"{folder} holds {len(extra)} images that belong to no eval view ({listed(extra)}); "
            f"they are left out"
        )
    return {name: found[name][0] for name in names}


def _read(
    path: Path, camera: Camera, modality: Modality, temperature: TemperatureRange | None
) -> Float32[Tensor, "h w c"]:
    """The values that a model would render, of every pixel; the name of the file's folder
    determines how it is read."""
    image = _decoded(path, camera)
    if image.valid is not None:
        what = "not finite" if image.kind == "float" else "transparent"
        raise RunError(
            f"{path} has pixels that are {what}: every pixel is scored, so render all of them"
        )
    if path.parent.name == CELSIUS_FOLDER:
        return _celsius(path, image, temperature)
    if path.parent.name != modality.name:
        return _floats(path, image)
    if modality == THERMAL:
        return _temperatures(path, image, temperature)
    if image.kind == "float":
        raise RunError(f"{path} is a float image: save {modality.title} with 8 bits per channel")
    try:
        return with_channels(image.values, modality.channels)
    except ValueError as error:
        raise RunError(f"{path} {error}") from error


def _decoded(path: Path, camera: Camera) -> Decoded:
    """An image of the camera's size."""
    try:
        image = decode(path)
    except SceneError as error:
        raise RunError(str(error)) from error
    height, width = image.values.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise RunError(
            f"{path} is {width}×{height} px, but its view is {camera.width}×{camera.height} px: "
            "render at the view's size, or choose the resolution that was rendered at",
            options=("resolution",),
        )
    return image


def _floats(path: Path, image: Decoded) -> Float32[Tensor, "h w 1"]:
    if image.kind != "float":
        raise RunError(f"{path} holds no floats: save it as a one-channel float32 TIFF")
    return image.values


def _celsius(
    path: Path, image: Decoded, temperature: TemperatureRange | None
) -> Float32[Tensor, "h w 1"]:
    if temperature is None:
        raise RunError(
            f"{path} holds °C, but the scene has no temperature range: put normalised floats into "
            f"thermal_normalised/"
        )
    return temperature.from_celsius(_floats(path, image))


def _temperatures(
    path: Path, image: Decoded, temperature: TemperatureRange | None
) -> Float32[Tensor, "h w 1"]:
    """Normalised temperatures from ``thermal/``: floats are °C, integers span the range already."""
    if image.kind == "float":
        return _celsius(path, image, temperature)
    values = image.values
    if (values.amax(dim=2) - values.amin(dim=2)).max() > GREY_TOLERANCE:
        raise RunError(
            f"{path} is pseudo-coloured, and temperatures cannot be read from colours: save 8-bit "
            f"or 16-bit grey over the scene's temperature range, or a float32 TIFF in °C"
        )
    return values[..., :1]
