"""``cameras/``: the cameras with their images as a scene folder that nerfstudio, COLMAP and this
program can open.

The cameras are pinholes, and belong to the undistorted and perhaps reduced images that the model
was trained on; so those images are written beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from PIL import Image

from mrgs.data import transforms
from mrgs.data.ply import write_points
from mrgs.export.job import ExportJob
from mrgs.export.splats import to_bytes
from mrgs.pictures.files import to_array, write_float_tiff, write_png
from mrgs.scene import RGB, THERMAL, Camera, Modality, Scene, TemperatureRange, View
from mrgs.scene.preview import to_rgb8
from mrgs.scene.rotations import quaternion_from_matrix
from mrgs.system.atomic import write_text

COLMAP_FOLDER = "sparse/0"


def export(job: ExportJob) -> list[Path]:
    """Write the folder ``cameras`` into the job's folder; returns the paths."""
    return write_cameras(job.folder / "cameras", job.scene)


def write_cameras(folder: Path, scene: Scene) -> list[Path]:
    """Write ``transforms.json``, ``sparse/0/*.txt``, the images and the start points into a folder;
    returns the paths.

    RGB photos are ``images/NAME.png``, thermal photos with known °C ``thermal/NAME.tiff``
    (float32) with ``temperature_bounds.json``, all others ``MODALITY/NAME.png`` with 16 bits.
    Images with invalid pixels have masks. What a camera noted beside a photo (emissivity, reflected
    temperature, distance, humidity, serial number, time, calibration) is ``MODALITY_record`` of its
    frame in ``transforms.json``. There poses are camera to world with OpenGL axes, in
    ``images.txt`` world to camera with OpenCV axes. COLMAP's names are relative to ``images/``;
    where one view has several cameras, all are registered and the names are relative to the folder.
    RunError if a file cannot be written, SceneError if an image of the scene cannot be read.
    """
    paths = [
        path for view in scene.views for path in _write_images(folder, view, scene.temperature)
    ]
    if scene.temperature is not None and THERMAL in scene.modalities:
        bounds = scene.temperature.min_c, scene.temperature.max_c
        paths.append(transforms.write_bounds(folder / transforms.BOUNDS, *bounds))
    colors = to_bytes(scene.points.colors.numpy())
    paths.append(write_points(folder / transforms.POINTS, scene.points.positions.numpy(), colors))
    paths.append(_write_transforms(folder / transforms.TRANSFORMS, scene))
    return [*paths, *_write_colmap(folder / COLMAP_FOLDER, scene)]


def _write_transforms(path: Path, scene: Scene) -> Path:
    """Intrinsics in each frame, the split as lists of file names."""
    frames = [_frame(view, scene.temperature is not None) for view in scene.views]
    names = [frame["file_path"] for frame in frames]
    count = len(scene.train)
    facts = {"applied_transform": np.eye(4)[:3].tolist(), **transforms.world_json(scene.world)}
    return transforms.write_transforms(
        path,
        frames,
        points=transforms.POINTS,
        split=(names[:count], names[count:]),
        modalities=scene.modalities,
        facts=facts,
    )


def _frame(view: View, has_celsius: bool) -> dict[str, Any]:
    first, *others = view.images
    apart = [each for each in others if not view.shares_camera(first, each)]
    camera, cameras = view.camera, view.cameras
    frame = transforms.frame_json(
        camera.viewmat,
        _image_path(view, first, has_celsius),
        {each: _image_path(view, each, has_celsius) for each in others},
        lens=transforms.pinhole_lens(camera),
        viewmats={each: cameras[each].viewmat for each in apart},
        lenses={each: transforms.pinhole_lens(cameras[each]) for each in apart},
    )
    return frame | {
        f"{modality}_{transforms.RECORD}": image.record.to_json()
        for modality, image in view.images.items()
        if image.record is not None
    }


def _image_path(view: View, modality: Modality, has_celsius: bool) -> str:
    """Path of a view's photo, relative to the folder."""
    suffix = "tiff" if modality == THERMAL and has_celsius else "png"
    return f"{'images' if modality == RGB else modality}/{view.name}.{suffix}"


def _write_colmap(folder: Path, scene: Scene) -> list[Path]:
    """COLMAP's text model; points have no tracks, images no observations."""
    registered = _registered(scene)
    used = dict.fromkeys(transforms.pinhole_lens(camera) for _, camera in registered)
    lenses = {lens: number for number, lens in enumerate(used, start=1)}
    cameras = [f"{number} PINHOLE {_row(astuple(lens)[:6])}" for lens, number in lenses.items()]
    images = []
    for number, (name, camera) in enumerate(registered, start=1):
        quaternion = quaternion_from_matrix(camera.viewmat[:3, :3].numpy()).tolist()
        pose = _row([*quaternion, *camera.viewmat[:3, 3].tolist()])
        images.append(
            f"{number} {pose} {lenses[transforms.pinhole_lens(camera)]} {name}\n"
        )  # and an empty line: no observations
    positions = scene.points.positions.double().tolist()
    colors = to_bytes(scene.points.colors.numpy()).tolist()
    points = [
        f"{i} {_row(p)} {_row(c)} 0"
        for i, (p, c) in enumerate(zip(positions, colors, strict=True), start=1)
    ]
    tables = {
        "cameras.txt": ["# CAMERA_ID MODEL WIDTH HEIGHT fx fy cx cy", *cameras],
        "images.txt": ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", *images],
        "points3D.txt": ["# POINT3D_ID X Y Z R G B ERROR", *points],
    }
    return [write_text(folder / name, "\n".join(t) + "\n") for name, t in tables.items()]


def _registered(scene: Scene) -> list[tuple[str, Camera]]:
    """Names and cameras for COLMAP."""
    named = [
        [
            (_image_path(view, modality, scene.temperature is not None), camera)
            for modality, camera in view.cameras.items()
        ]
        for view in scene.views
    ]
    if all(
        view.shares_camera(next(iter(view.images)), e) for view in scene.views for e in view.images
    ):
        return [(Path(path).name, camera) for (path, camera), *_ in named]
    return [image for images in named for image in images]


def _write_images(folder: Path, view: View, temperature: TemperatureRange | None) -> list[Path]:
    paths = []
    for modality, image in view.images.items():
        pixels = image.load()
        path = folder / _image_path(view, modality, temperature is not None)
        if modality.channels == 3:
            paths.append(write_png(path, to_rgb8(pixels.values)))
        elif modality == THERMAL and temperature is not None:
            celsius = to_array(temperature.to_celsius(pixels.values[..., 0]))
            paths.append(write_float_tiff(path, celsius, "temperature, degrees Celsius"))
        else:
            grey = np.rint(to_array(pixels.values[..., 0]).clip(0, 1) * 65535).astype(np.uint16)
            paths.append(write_png(path, Image.fromarray(grey)))
        if pixels.valid is not None:
            masks = folder / ("masks" if modality == RGB else f"{modality}_masks")
            mask = Image.fromarray(pixels.valid.numpy().astype(np.uint8) * 255)
            paths.append(write_png(masks / f"{view.name}.png", mask))
    return paths


def _row(values: Sequence[float] | Float64[np.ndarray, " n"]) -> str:
    """Numbers as text that reads back to the same bits."""
    return " ".join(repr(value) for value in values)
