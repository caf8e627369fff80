"""Files that a viewer session writes into its run's folder: screenshots, camera paths, videos."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from mrgs.errors import ConfigError
from mrgs.pictures.files import write_png
from mrgs.pictures.video import VIDEO_FPS, can_write_mp4, frame_writer
from mrgs.system.atomic import require_folder
from mrgs.viewer.annotation import annotate
from mrgs.viewer.cameras import fitted_size, save_path, smooth_path
from mrgs.viewer.inspection import Inspection

VIDEO_SIDE_PX = 960


class VideoProgress(NamedTuple):
    """How far a video is.

    Attributes:
        done: frames that are written.
        total: frames of the video.
        path: the finished mp4, or the folder of the frames; None before the end.
    """

    done: int
    total: int
    path: Path | None = None


def save_screenshot(inspection: Inspection) -> Path:
    """Write the current view, sharp and with its marks, into ``renders/screenshots``; returns the
    file.

    Raises:
        ConfigError: no picture has been drawn yet.
        RunError: the file cannot be written.
    """
    if inspection.drawn is None:
        raise ConfigError("wait for the first picture, then take a screenshot")
    folder = _folder(inspection, "screenshots")
    drawn = inspection.picture(inspection.drawn.camera)
    image = annotate(
        drawn.pixels,
        drawn.panes,
        drawn.images,
        drawn.scales,
        inspection.marks(),
        inspection.outlines(),
    )
    return write_png(_next_free(folder, ".png"), image)


def save_keyframes(inspection: Inspection, seconds: float) -> Path:
    """Write the keyframes into ``renders/paths``, in nerfstudio's format; returns the file.

    Raises:
        ConfigError: there are no keyframes.
        RunError: the file cannot be written.
    """
    folder = _folder(inspection, "paths")
    return save_path(_next_free(folder, ".json"), inspection.keyframes, seconds, VIDEO_FPS)


def render_video(
    inspection: Inspection, seconds: float, mp4: bool | None = None
) -> Iterator[VideoProgress]:
    """Render the path with the current settings into ``renders/videos``, frame by frame; as an mp4
    too, if one can be written.

    The colour scale is the current one throughout, and so are the marks.

    Args:
        inspection: whose keyframes are gone through.
        seconds: length of the video.
        mp4: as for ``frame_writer``.

    Yields:
        After each frame how far it is; the last time, with the mp4 or the frames' folder.

    Raises:
        ConfigError: fewer than two keyframes, or a mode that is bound to photos.
        RunError: a file cannot be written.
    """
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
    """Where files of a kind are written.

    Raises:
        WriteError: the run's folder is gone.
    """
    run = inspection.subject.folder
    require_folder(run)
    return run / "renders" / name


def _next_free(folder: Path, suffix: str) -> Path:
    """``FOLDER/0001`` with the first number that no file or folder has."""
    number = 1
    while any(folder.glob(f"{number:04d}*")):
        number += 1
    return folder / f"{number:04d}{suffix}"
