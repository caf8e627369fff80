"""Write renderings as files for people (PNG) and for programs (float32 TIFF)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from torch import Tensor

from mrgs.pictures.drawing import Scale, blank, scale_bar
from mrgs.pictures.palette import PaletteName, display_range
from mrgs.pictures.values import folder_of_values, full_scale, in_unit
from mrgs.scene import Modality, PosedImage, Rendering, SceneBounds, TemperatureRange, View
from mrgs.scene.preview import to_rgb8
from mrgs.system.atomic import replacing

_IMAGE_DESCRIPTION_TAG = 270
_MARGIN_PX = 12


def write_rendering(
    folder: Path,
    view: View,
    rendering: Rendering,
    temperature: TemperatureRange | None,
    palette: PaletteName = "inferno",
    ball: SceneBounds | None = None,
) -> list[Path]:
    """Write all images of one view; returns the paths.

    Each modality is ``MODALITY/NAME.png``. One whose values have a unit is drawn through the
    palette with a scale bar over its whole range, and its values are a float32 TIFF:
    ``temperature_c/NAME.tiff`` in °C, or ``MODALITY_normalised/NAME.tiff`` where the scene has no
    °C. The depth of each modality is ``depth_MODALITY/NAME.tiff`` (z-depth, scene units) and
    ``NAME.png``. What the rendering lacks is left out. RunError if a file cannot be written.

    Args:
        folder: of the files; made if need be.
        view: that was rendered; names the files.
        palette: colours of values with a unit.
        ball: how far the scene reaches; the background beyond it does not count on the scale of the
            depth. None if there is none.
    """
    paths = []
    name = view.name
    for modality, blend in rendering.items():
        png = folder / modality.name / f"{name}.png"
        if not modality.is_metric:
            paths.append(write_png(png, to_rgb8(blend.image)))
            continue
        values = shown_values(modality, blend.image, temperature)
        kind, text = folder_of_values(modality, temperature)
        paths.append(write_float_tiff(folder / kind / f"{name}.tiff", values, text))
        scale = full_scale(modality, temperature, palette)
        paths.append(write_png(png, with_scale_bar(values, scale)))
    for modality in rendering:
        if rendering.has_depth(modality):
            surface = rendering.surface_depth(modality)
            place, image = folder / f"depth_{modality}", view.images.get(modality)
            tiff, values = place / f"{name}.tiff", to_array(surface)
            paths.append(write_float_tiff(tiff, values, "z-depth, scene units"))
            shown = shown_depth(surface, image, ball)
            paths.append(write_depth_png(place / f"{name}.png", shown))
    return paths


def shown_depth(
    depth: Float[Tensor, "h w"], image: PosedImage | None, ball: SceneBounds | None
) -> Float[np.ndarray, "h w"]:
    """The z-depth that an image's camera saw as pictures show it: infinite beyond the scene's
    ``ball``, since the background would take up the whole scale."""
    if image is not None and ball is not None:
        depth = ball.without_background(image.camera, depth.cpu())
    return to_array(depth)


def to_array(tensor: Float[Tensor, "..."]) -> Float32[np.ndarray, "..."]:
    """A tensor as a float32 array in main memory, detached."""
    return tensor.detach().float().cpu().numpy()


def to_picture(
    modality: Modality,
    image: Float[Tensor, "h w c"],
    temperature: TemperatureRange | None,
    palette: PaletteName,
) -> UInt8[np.ndarray, "h w 3"]:
    """An image as people look at it: values with a unit through the palette over their whole range,
    intensities as they are."""
    if modality.is_metric:
        values = shown_values(modality, image, temperature)
        return full_scale(modality, temperature, palette).colorize(values)
    return to_rgb8(image)


def shown_values(
    modality: Modality, image: Float[Tensor, "h w 1"], temperature: TemperatureRange | None
) -> Float[np.ndarray, "h w"]:
    """The values of a one-channel image [H, W, 1] in the modality's unit, [H, W]."""
    return to_array(in_unit(modality, image[..., 0], temperature))


def write_png(path: Path, image: Image.Image | UInt8[np.ndarray, "h w 3"]) -> Path:
    """Write an RGB PNG; returns the path. RunError if it cannot be written."""
    with replacing(path) as temporary:
        (image if isinstance(image, Image.Image) else Image.fromarray(image)).save(temporary)
    return path


def write_float_tiff(path: Path, values: Float[np.ndarray, "h w"], description: str) -> Path:
    """Write values [H, W], unchanged, into a one-channel float32 TIFF; returns the path. The
    description (ASCII) has their unit. RunError if the file cannot be written."""
    tags = ImageFileDirectory_v2()
    tags[_IMAGE_DESCRIPTION_TAG] = description
    with replacing(path) as temporary:
        Image.fromarray(np.ascontiguousarray(values, dtype=np.float32)).save(
            temporary, tiffinfo=tags
        )
    return path


def with_scale_bar(values: Float[np.ndarray, "h w"], scale: Scale) -> Image.Image:
    """A colour-mapped image with a scale bar at its right; the map's own pixels keep their size."""
    height, width = values.shape
    bar = scale_bar(scale, height, "vertical", size=max(10, min(18, height // 24)))
    image = blank((width + 2 * _MARGIN_PX + bar.width, height))
    image.paste(Image.fromarray(scale.colorize(values)), (0, 0))
    image.paste(bar, (width + _MARGIN_PX, 0))
    return image


def write_depth_png(path: Path, depth: Float[np.ndarray, "h w"]) -> Path:
    """Write a colour-mapped PNG of the depth, near is light, between its own percentiles."""
    low, high = display_range(depth)
    return write_png(path, Scale("depth", high, low, "").colorize(depth))
