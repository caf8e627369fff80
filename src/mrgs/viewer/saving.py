"""Files that a viewer session writes into its run's folder: screenshots, camera paths, videos."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from mrgs.errors import ConfigError
from mrgs.pictures.files import write_png
from mrgs.pictures.video import VIDEO_FPS, can_write_mp4, frame_writer
from mrgs.scene import Camera
from mrgs.scene.camera import field_of_view
from mrgs.scene.rotations import opengl_camera_to_world, rigid_transform
from mrgs.system.atomic import require_folder, write_text
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.painting import annotate
from mrgs.viewer.panes import fitted_size

VIDEO_SIDE_PX = 960


class VideoProgress(NamedTuple):
    """Progress of a video; at the end ``path`` is the mp4, or the folder of the frames."""

    done: int
    total: int
    path: Path | None = None


def save_screenshot(inspection: Inspection) -> Path:
    """Write the current view, sharp and with its marks, into ``renders/screenshots``; returns the
    file. ConfigError if no picture has been drawn yet, RunError if the file cannot be written."""
    if inspection.drawn is None:
        raise ConfigError("wait for the first picture, then take a screenshot")
    folder = _folder(inspection, "screenshots")
    drawn = inspection.picture(inspection.drawn.camera)
    image = annotate(drawn, inspection.labels())
    return write_png(_next_free(folder, ".png"), image)


def save_keyframes(inspection: Inspection, seconds: float) -> Path:
    """Write the keyframes into ``renders/paths``, in nerfstudio's format; returns the file.
    ConfigError if there are none, RunError if the file cannot be written."""
    folder = _folder(inspection, "paths")
    return save_path(_next_free(folder, ".json"), inspection.keyframes, seconds, VIDEO_FPS)


def render_video(
    inspection: Inspection, seconds: float, mp4: bool | None = None
) -> Iterator[VideoProgress]:
    """Render the path with the current settings, colour scale and marks into ``renders/videos``,
    and an mp4 too, if possible (``mp4`` as for ``frame_writer``); yields the progress after each
    frame, and at the end. ConfigError for fewer than two keyframes, or a mode that is bound to
    photos; RunError if a file cannot be written."""
    if inspection.settings.mode.shows_photos:
        raise ConfigError(
            "a video needs a free camera: choose another picture than those with photos"
        )
    path = smooth_path(inspection.keyframes, round(seconds * VIDEO_FPS))
    size = fitted_size(path[0].width, path[0].height, VIDEO_SIDE_PX)
    folder = _folder(inspection, "videos")
    target = _next_free(folder, "")
    mp4 = can_write_mp4() if mp4 is None else mp4
    with frame_writer(folder, target.name, size, mp4=mp4) as add:
        frames = inspection.annotated_pictures([camera.resized(*size) for camera in path])
        for number, frame in enumerate(frames, start=1):
            add(frame)
            yield VideoProgress(number, len(path))
    written = target.with_suffix(".mp4") if mp4 else target
    yield VideoProgress(len(path), len(path), written)


def _folder(inspection: Inspection, name: str) -> Path:
    """The folder for files of a kind; WriteError if the run's folder is gone."""
    run = inspection.subject.folder
    require_folder(run)
    return run / "renders" / name


def _next_free(folder: Path, suffix: str) -> Path:
    """``FOLDER/0001`` with the first number that no file or folder has."""
    number = 1
    while any(folder.glob(f"{number:04d}*")):
        number += 1
    return folder / f"{number:04d}{suffix}"


def vertical_fov(camera: Camera) -> float:
    """Vertical field of view of a camera, radians."""
    return field_of_view(camera.height, camera.K[1, 1].item())


def smooth_path(keyframes: Sequence[Camera], frames: int) -> list[Camera]:
    """Pinhole cameras with square pixels along a smooth curve through the keyframes, evenly in
    time; the size is that of the first. ConfigError for fewer than two keyframes."""
    if len(keyframes) < 2:
        raise ConfigError("a camera path needs at least two keyframes: add them from two places")
    times = np.arange(len(keyframes), dtype=np.float64)
    wanted = np.linspace(0, times[-1], max(frames, 2))
    positions = CubicSpline(
        times, np.stack([camera.position.numpy() for camera in keyframes]), bc_type="natural"
    )
    turns = Rotation.from_matrix([camera.viewmat[:3, :3].numpy().T for camera in keyframes])
    axes = RotationSpline(times, turns)(wanted).as_matrix()
    fovs = np.interp(wanted, times, [vertical_fov(camera) for camera in keyframes])
    width, height = keyframes[0].width, keyframes[0].height
    path = []
    for rotation, position, fov in zip(axes, positions(wanted), fovs.tolist(), strict=True):
        focal = 0.5 * height / math.tan(0.5 * fov)
        K = [[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]]
        viewmat = rigid_transform(rotation.T, -rotation.T @ position)
        path.append(Camera(K, viewmat, width, height))
    return path


def save_path(path: Path, keyframes: Sequence[Camera], seconds: float, fps: int) -> Path:
    """Write the keyframes as nerfstudio's camera-path JSON (camera to world, OpenGL axes); returns
    the path. Errors as for ``save_keyframes``."""
    if not keyframes:
        raise ConfigError("there are no keyframes to save: add some first")
    entries = [
        {
            "camera_to_world": opengl_camera_to_world(camera.viewmat).flatten().tolist(),
            "fov": math.degrees(vertical_fov(camera)),
            "aspect": camera.width / camera.height,
        }
        for camera in keyframes
    ]
    document = {
        "camera_type": "perspective",
        "render_width": keyframes[0].width,
        "render_height": keyframes[0].height,
        "seconds": seconds,
        "fps": fps,
        "camera_path": entries,
    }
    return write_text(path, json.dumps(document, indent=1))
