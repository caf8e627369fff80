"""The thermal camera of a set of photos: read from a file, or calibrated from the photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.data.cameras import lens_from_json, matrix_from_json, nearest_rotation
from mrgs.data.files import read_json_object
from mrgs.data.images import decode
from mrgs.data.sources import ImageSource, decode_rgb, posed_image
from mrgs.errors import ConfigError, scene_error
from mrgs.prepare.contract import ConvertedImage, ConvertedView, Georeference
from mrgs.prepare.georeference import ARBITRARY
from mrgs.prepare.rig.contract import RigCalibration, RigOptions, RigPair
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL, Pixels
from mrgs.scene.lens import Lens
from mrgs.scene.rotations import rigid_transform
from mrgs.system.wording import shown

EXTRINSICS = "thermal_from_rgb_m"
"""Key of the rigid motion [4, 4] from RGB camera to thermal camera axes, metres, in
``transforms.json`` and in the file of a thermal camera."""

SHAPE_TOLERANCE = 0.01
"""Aspect ratios of images of one camera may differ by this share: sizes are whole numbers."""


@dataclass(frozen=True, eq=False)
class ThermalCamera:
    """A thermal camera as a file describes it: intrinsics and radial distortion k1, k2 for its
    photos as they are, and the motion from RGB camera to thermal camera axes, OpenCV, metres; None
    for what is to be found."""

    lens: Lens | None
    extrinsics: Float64[Tensor, "4 4"] | None


def read_thermal_camera(path: Path) -> ThermalCamera:
    """Read ``thermal_camera``, ``thermal_from_rgb_m`` (4×4, OpenCV axes, metres), or both, from a
    JSON object, such as a prepared scene's ``transforms.json``. SceneError if the file cannot be
    read, has neither, or a camera that cannot be used."""
    content = read_json_object(path)
    own, motion = content.get("thermal_camera"), content.get(EXTRINSICS)
    if own is None and motion is None:
        raise scene_error(path, f"holds neither thermal_camera nor {EXTRINSICS}; add one of them")
    lens = matrix = None
    if own is not None:
        if not isinstance(own, dict):
            raise scene_error(path, f"thermal_camera is {shown(own)}, not an object; correct it")
        lens = lens_from_json(own, "thermal_camera", path)
        if lens.fisheye or any(lens.tangential) or any(lens.radial[2:]):
            raise scene_error(
                path,
                "thermal_camera is distorted by more than k1 and k2; calibrate it with these alone",
            )
    if motion is not None:
        given = matrix_from_json(motion, EXTRINSICS, path)
        rotation = nearest_rotation(given[:3, :3], EXTRINSICS, path)
        matrix = rigid_transform(rotation, given[:3, 3])
    return ThermalCamera(lens, matrix)


Calibrate = Callable[..., RigCalibration]
"""Such as ``mrgs.prepare.rig.calibrate.calibrate_rig``."""


def calibrate_thermal_camera(
    work: Work, calibrate: Calibrate, given: ThermalCamera | None = None
) -> RigCalibration | None:
    """Calibrate the thermal camera from the posed photos and the user's options, in the scene's
    world; None if one camera took both images of a pair, or if there are only thermal images.
    ``given`` is the content of ``options.thermal_camera``. SceneError if the photos do not
    determine the thermal camera, or the given one does not fit them; ConfigError for an option on
    it, for a set of thermal images only."""
    options, posed = work.options, work.posed
    if posed.images == THERMAL:
        names = ["thermal_camera", "target", "one_camera"]
        if options.poses is not None:  # else structure from motion takes it
            names.append("thermal_fov_deg")
        vain = tuple(name for name in names if getattr(options, name) not in (None, False))
        if vain:
            raise ConfigError(
                "there are only thermal images, so options for a second camera have no effect; "
                "remove them",
                options=vain,
            )
        return None
    views = [view for view in work.images.views if view.name in posed.viewmats]
    if options.one_camera:
        _check_same_shape(views[0])
        return None
    pairs = [
        RigPair(
            view.name,
            posed_image(
                ImageSource(
                    work.scene / view.images[RGB].file,
                    posed.lenses[view.name],
                    posed.viewmats[view.name],
                ),
                decode_rgb,
                None,
            ),
            partial(_first_channel, work.scene / view.images[THERMAL].file),
            None if posed.visible is None else posed.visible.get(view.name),
        )
        for view in views
    ]
    known = RigOptions(
        thermal_lens=None if given is None else given.lens,
        extrinsics=given.extrinsics if given and work.metric else None,
        field_of_view_deg=options.thermal_fov_deg,
        stated_field_of_view_deg=stated_field_of_view(views),
        target=options.target,
        metres_per_unit=1.0 if work.metric else None,
    )
    if options.thermal_camera is not None:
        _check_fits(known, views[0].images[THERMAL], options.thermal_camera)
    return calibrate(pairs, posed.points, known, work.progress)


def stated_field_of_view(views: Sequence[ConvertedView]) -> float | None:
    """The horizontal field of view of the thermal camera that the photos' files state, degrees; the
    median. None if none does."""
    stated_deg = [deg for view in views if (deg := view.facts.field_of_view_deg) is not None]
    return median(stated_deg) if stated_deg else None


def _check_same_shape(view: ConvertedView) -> None:
    """Refuse two images of one camera that differ in shape."""
    rgb, thermal = view.images[RGB].size, view.images[THERMAL].size
    upright, turned = rgb[0] / rgb[1], rgb[1] / rgb[0]
    ratio = thermal[1] / thermal[0]
    if abs(upright * ratio - 1) <= SHAPE_TOLERANCE:
        return
    sizes = (
        f"its RGB image has {rgb[0]}×{rgb[1]} px and its thermal image "
        f"{thermal[0]}×{thermal[1]}: they cannot show the same pixel for pixel, as from one "
        f"camera"
    )
    if abs(turned * ratio - 1) <= SHAPE_TOLERANCE:
        sizes += (
            ". They would after a quarter turn: only one of the two files says in its EXIF "
            "orientation how the camera was held. Give both the same orientation, or leave out "
            "that it is one camera"
        )
    raise scene_error(view.name, sizes, options=("one_camera",))


def _first_channel(path: Path) -> Pixels:
    decoded = decode(path)
    return Pixels(decoded.values[..., :1].contiguous(), decoded.valid)


def _check_fits(known: RigOptions, image: ConvertedImage, file: Path) -> None:
    """Refuse the file of a thermal camera that does not fit the thermal images, or has nothing but
    an offset, which cannot be used without metres."""
    lens, (width, height) = known.thermal_lens, image.size
    if lens is None and known.extrinsics is None:
        raise scene_error(
            file,
            "its offset is in metres, and these photos have no scale; give a known distance, "
            "or the camera's lens",
            options=("known_distance",),
        )
    if lens is not None and (lens.width, lens.height) != (width, height):
        raise scene_error(
            file,
            f"is for images of {lens.width}×{lens.height} px, but {Path(image.file).name} has "
            f"{width}×{height} px; give the camera that took these photos",
        )


def in_metres_of_target(
    georeference: Georeference, rig: RigCalibration | None
) -> tuple[Georeference, RigCalibration | None]:
    """Both rescaled to metres, if the target gives the scale and nothing else did."""
    metres = None if rig is None or rig.target is None else rig.target.metres_per_unit
    if rig is None or metres is None or georeference.metric:
        return georeference, rig
    georeference = replace(
        georeference,
        scale=metres * georeference.scale,
        translation=metres * georeference.translation,
        metric=True,
        text=f"The scale is that of the target's squares. "
        f"{georeference.text.removeprefix(f'{ARBITRARY} ')}",
    )
    in_metres = torch.ones(4, 4, dtype=torch.float64)
    in_metres[:3, 3] = metres
    views = tuple(replace(view, correction=in_metres * view.correction) for view in rig.views)
    return georeference, replace(rig, extrinsics=in_metres * rig.extrinsics, views=views)
