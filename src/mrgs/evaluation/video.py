"""Write the frames of a camera path as PNG files and, where the extra ``video`` is installed, as an mp4."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from mrgs.atomic import replacing
from mrgs.evaluation.pictures import write_png


def can_write_mp4() -> bool:
    """Whether imageio and imageio-ffmpeg are installed (``pip install "mrgs[video]"``)."""
    return all(importlib.util.find_spec(name) is not None for name in ("imageio", "imageio_ffmpeg"))


def write_frames(folder: Path, name: str, frames: Iterable[UInt8[np.ndarray, "h w 3"]], fps: int = 24) -> list[Path]:
    """Write ``NAME/00000.png`` and so on and, if possible, ``NAME.mp4``; returns the paths.

    The frames are taken one at a time, so a generator needs the memory of one. H.264 wants even sides: an odd image
    loses its last column or row in the mp4.

    Raises:
        RunError: a file cannot be written.
    """
    paths: list[Path] = []
    with ExitStack() as stack:
        writer = None
        if can_write_mp4():
            temporary = stack.enter_context(replacing(folder / f"{name}.mp4"))
            writer = stack.enter_context(_mp4_writer(temporary, fps))
        for index, frame in enumerate(frames):
            paths.append(write_png(folder / name / f"{index:05d}.png", frame))
            if writer is not None:
                height, width = frame.shape[0] // 2 * 2, frame.shape[1] // 2 * 2
                writer.append_data(np.ascontiguousarray(frame[:height, :width]))
    return [*paths, folder / f"{name}.mp4"] if writer is not None else paths


def _mp4_writer(path: Path, fps: int) -> Any:  # imageio has no types
    import imageio.v2 as imageio  # an extra: only where it is installed

    return imageio.get_writer(path, format="FFMPEG", fps=fps, codec="libx264", quality=8, macro_block_size=2)
