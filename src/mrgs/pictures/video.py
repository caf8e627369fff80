"""Write a camera path's frames as PNG files and, with the extra ``video``, as an mp4."""

from __future__ import annotations

import importlib.util
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import UInt8

from mrgs.errors import RunError
from mrgs.pictures.files import write_png
from mrgs.system.atomic import replacing

VIDEO_FPS = 24

CRF = 10
"""libx264's constant rate factor, 0 (lossless) to 51: hardly a difference can be seen."""

AddFrame: TypeAlias = Callable[[UInt8[np.ndarray, "h w 3"]], None]


def can_write_mp4() -> bool:
    """Whether imageio-ffmpeg is installed (``pip install "mrgs[video]"``)."""
    return importlib.util.find_spec("imageio_ffmpeg") is not None


@contextmanager
def frame_writer(
    folder: Path, name: str, size: tuple[int, int], mp4: bool | None = None, fps: int = VIDEO_FPS
) -> Iterator[AddFrame]:
    """Give a function that writes frames into ``NAME/00000.png`` and so on and, if asked for or by
    default if imageio-ffmpeg is installed, into ``NAME.mp4``.

    Frames and mp4 of an earlier video of this name are removed. The mp4 is complete when the
    context ends. H.264 needs even sides: an odd image loses its last column or row in the mp4.
    RunError if a file cannot be written, or an old one cannot be removed."""
    _remove_video(folder, name)
    with ExitStack() as stack:
        add_to_mp4 = None
        if can_write_mp4() if mp4 is None else mp4:
            temporary = stack.enter_context(replacing(folder / f"{name}.mp4"))
            add_to_mp4 = stack.enter_context(_mp4_encoder(temporary, size, fps))
        count = 0

        def add(frame: UInt8[np.ndarray, "h w 3"]) -> None:
            nonlocal count
            write_png(folder / name / f"{count:05d}.png", frame)
            if add_to_mp4 is not None:
                add_to_mp4(frame)
            count += 1

        yield add


def _remove_video(folder: Path, name: str) -> None:
    """Remove an earlier video, whose frames would mix with the new ones."""
    frames = (folder / name).glob("[0-9][0-9][0-9][0-9][0-9].png")
    try:
        for path in [*frames, folder / f"{name}.mp4"]:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise RunError(
            f"{error.filename} of an earlier video cannot be removed ({error.strerror}): remove it"
        ) from error


@contextmanager
def _mp4_encoder(path: Path, size: tuple[int, int], fps: int) -> Iterator[AddFrame]:
    """Feed frames to ffmpeg; an OSError with the last line that it printed if it fails."""
    import imageio_ffmpeg  # an extra: only where it is installed

    raw = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {fps} -i -".split()
    even = ["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2:0:0"]
    # H.264 in the pixel format that every player knows.
    target = ["-c:v", "libx264", "-crf", str(CRF), "-pix_fmt", "yuv420p", str(path)]
    process = subprocess.Popen(
        [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *raw, *even, *target],
        stdin=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )

    def add(frame: UInt8[np.ndarray, "h w 3"]) -> None:
        assert process.stdin is not None
        process.stdin.write(frame.tobytes())

    try:
        yield add
    except BrokenPipeError:
        pass  # it has ended, and says why
    except BaseException:
        process.kill()
        process.communicate()
        raise
    _, printed = process.communicate()
    if process.returncode != 0:
        raise OSError(
            printed.decode(errors="replace").strip().rpartition("\n")[2]
            or f"ffmpeg: {process.returncode}"
        )
