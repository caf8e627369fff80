"""SPZ files, version 3: gzipped, 20 bytes per splat and one per higher colour coefficient, about a
tenth of a PLY.

The layout follows the format's description by Niantic (github.com/nianticlabs/spz). Version 3 is
the newest that is plain gzip. The format's axes are x right, y up, z backward where those of a
splat PLY are x right, y down, z forward, and readers turn one into the other; so the world is
turned by 180° about x here, and comes back as it was.
"""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8, UInt32

from mrgs.errors import RunError
from mrgs.export.job import ExportJob, described
from mrgs.export.ply import log_of
from mrgs.export.splats import SplatArrays, to_bytes
from mrgs.system.atomic import replacing
from mrgs.system.memory import row_chunks

MAGIC = 0x5053474E
VERSION = 3
NO_FLAGS = 0
"""SPZ's flags: without 'antialiased', viewers do not compensate opacities for their dilation."""

MAX_FRACTIONAL_BITS = 20
POSITION_LIMIT = 2**23
"""Positions are 24-bit fixed-point numbers with as many fractional bits as the farthest splat
leaves, at most 20."""

COLOR_SCALE = 0.15
"""Coefficients of degree 0 in ±1/0.3 are spread over the 256 values of a byte."""

COMPRESSION = 6

_TURN = np.array([1, -1, -1], dtype=np.float32)
_TURN_QUAT = np.array([1, 1, -1, -1], dtype=np.float32)
_TURN_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float32)
"""What 180° about x does to a position, a quaternion wxyz, and the coefficients of degrees 1 to 3
(y and z odd: −)."""


def export(job: ExportJob) -> list[Path]:
    """Write a file for each modality, with its sidecar."""
    paths = []
    for modality, splats, facts in job.splats():
        facts["frame"] += ", turned by 180° about x, as SPZ's axes demand and its readers undo"
        paths += described(write_spz(job.folder / f"{modality}.spz", splats), facts)
    return paths


def write_spz(path: Path, splats: SplatArrays) -> Path:
    """Write an SPZ file; returns the path. RunError if a splat is too far out for the format, or
    the file cannot be written."""
    farthest = float(np.abs(splats.means).max())
    bits = min(
        MAX_FRACTIONAL_BITS, math.floor(math.log2((POSITION_LIMIT - 1) / max(farthest, 1e-3)))
    )
    if bits < 0:
        raise RunError(
            f"{path}: a splat lies {farthest:g} units out, farther than SPZ stores: export a PLY"
        )
    header = struct.pack(
        "<IIIBBBB", MAGIC, VERSION, len(splats), splats.sh_degree, bits, NO_FLAGS, 0
    )
    turn_sh = _TURN_SH[: splats.sh.shape[1] - 1, None]
    parts: list[Callable[[slice], np.ndarray]] = [
        lambda rows: _fixed_point(splats.means[rows] * _TURN, bits),
        lambda rows: to_bytes(splats.opacities[rows]),
        lambda rows: _byte(splats.sh[rows, 0] * (COLOR_SCALE * 255) + 127.5),
        lambda rows: _byte((log_of(splats.scales[rows]) + 10) * 16),
        lambda rows: _smallest_three(splats.quats[rows] * _TURN_QUAT),
        lambda rows: _byte(splats.sh[rows, 1:] * turn_sh * 128 + 128),
    ]
    # Without a time or a name in its header the same model gives the same bytes.
    with (
        replacing(path) as temporary,
        open(temporary, "wb") as raw,
        gzip.GzipFile("", "wb", compresslevel=COMPRESSION, fileobj=raw, mtime=0) as file,
    ):
        file.write(header)
        for part in parts:
            for rows in row_chunks(len(splats)):
                file.write(np.ascontiguousarray(part(rows)).data)
    return path


def _fixed_point(means: Float32[np.ndarray, "n 3"], bits: int) -> UInt8[np.ndarray, "n 3 3"]:
    """Positions as 24-bit little-endian integers of 2^−bits scene units."""
    fixed: Int32[np.ndarray, "n 3"] = np.rint(means.astype(np.float64) * 2**bits).astype("<i4")
    return fixed.view(np.uint8).reshape(len(means), 3, 4)[..., :3]


def _smallest_three(quats: Float32[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Unit quaternions as 32 bits: the index of the largest component in xyzw, then the others as
    sign and 9 bits.

    The largest component is made positive, so that it follows from the others.
    """
    xyzw = np.roll(quats, -1, axis=1)
    largest = np.abs(xyzw).argmax(axis=1)
    sign = np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    others = np.argsort(np.arange(4)[None] == largest[:, None], axis=1, kind="stable")[:, :3]
    values = np.take_along_axis(xyzw * sign, others, axis=1)
    magnitudes = np.rint(np.abs(values) * (511 * math.sqrt(2))).clip(0, 511).astype(np.uint32)
    words = magnitudes | ((values < 0).astype(np.uint32) << 9)
    packed = largest.astype(np.uint32) << 30 | words[:, 0] << 20 | words[:, 1] << 10 | words[:, 2]
    return packed.astype("<u4")


def _byte(values: Float32[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.rint(values).clip(0, 255).astype(np.uint8)
