"""Splats in few bytes, part by part: what the page embeds and its script decodes.

The splats are ordered along a Morton curve and cut into chunks. Positions are 16-bit numbers
between the bounds of their chunk, scales 10-bit logarithms, rotations the three smaller components
of the quaternion in 10 bits each. Of each modality there is a plane of opacities, and one of
harmonics (degree 0 in 8 bits, higher ones in 7) or of values without view dependence (temperatures,
16 bits). Opacities have 8 bits, but 16 where values are read from the blend. All planes,
little-endian, one behind the other, are one gzip stream; the header names them in their order, with
the limits that the numbers stand for.

The bits are where they count: 8-bit scales would cost 0.3 °C at the edges of hot things, and 5-bit
harmonics 10 dB where the colours depend much on the view.

A large model comes in parts: first few splats that stand for all, then the splats themselves, a
region of the scene at a time.
"""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Float32, Int64, UInt8, UInt16, UInt32

from mrgs.errors import ConfigError
from mrgs.field.spherical_harmonics import C0
from mrgs.pictures.files import to_array
from mrgs.rasterizer.contract import ALPHA_MIN, LEAST_DILATION_PX2
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, Gaussians, Modality
from mrgs.scene.level_of_detail import merged

CHUNK = 256
"""Splats that share the bounds of their positions."""

MORTON_BITS = 21
"""Per axis: three axes fill a 64-bit number."""

GZIP_LEVEL = 6
SH_STEPS = (254, 126, 126, 126)
"""Per degree; even, so that zero is exact."""

CLIPPED_SHARE = 5e-4
"""Share of a band's coefficients that is clipped, for the precision of all others."""

SAMPLED = 2**18
"""Splats from which the limits of the harmonics are taken, at least; all if there are fewer."""


class PackedModel(NamedTuple):
    """A compressed model for the page: the planes, and a header of plain JSON: ``count``,
    ``chunk``, ``sh_steps``, ``planes`` (name, type and length in order), ``limits`` of scales
    (natural logarithms), and by the name of the modality of ``values`` (normalised) and of each
    degree of ``sh``."""

    header: dict[str, Any]
    data: bytes


HarmonicsLimits: TypeAlias = dict[Modality, list[list[float]]]
"""Lowest and highest coefficient of each degree, of each modality with harmonics."""


def pack_in_order(
    baked: BakedModel, modalities: Sequence[Modality], sh_limits: HarmonicsLimits
) -> PackedModel:
    """Quantise and compress all splats in their order, see ``curve_rows``."""
    low, high, positions = _chunked_positions(to_array(baked.means))
    scales, scale_limits = _quantise(np.log(to_array(baked.scales)), 1023)
    planes: dict[str, np.ndarray] = {
        "chunk_low": low,
        "chunk_high": high,
        "rotations": smallest_three(to_array(baked.quats)),
        "scales": _three_in_one(scales),
        "positions": positions.T,
    }
    limits: dict[str, Any] = {"scales": scale_limits, "values": {}, "sh": {}}
    for modality in modalities:
        kind = np.uint16 if modality.channels == 1 else np.uint8
        opacities = to_array(baked.opacities[modality]) * np.iinfo(kind).max
        planes[f"opacity_{modality}"] = np.rint(opacities).astype(kind)
        if modality in sh_limits:
            limits["sh"][modality.name] = bands = sh_limits[modality]
            sh = to_array(baked.sh(modality))
            codes = [_quantise_band(_band(sh, band), band, ends) for band, ends in enumerate(bands)]
            planes[f"sh_{modality}"] = np.concatenate(codes, axis=1).reshape(len(sh), -1).T
        else:
            values, ends = _quantise(to_array(baked.base_values(modality))[:, 0], 65535)
            limits["values"][modality.name] = ends
            planes[f"values_{modality}"] = values.astype(np.uint16)
    # Wide numbers first, so that each plane starts at a multiple of its width.
    planes = dict(sorted(planes.items(), key=lambda item: -item[1].itemsize))
    header = {
        "count": len(baked),
        "chunk": CHUNK,
        "sh_steps": list(SH_STEPS),
        "planes": [[name, plane.dtype.name, plane.size] for name, plane in planes.items()],
        "limits": limits,
    }
    stream = b"".join(
        np.ascontiguousarray(plane).astype(plane.dtype.newbyteorder("<")).tobytes()
        for plane in planes.values()
    )
    return PackedModel(header, gzip.compress(stream, GZIP_LEVEL, mtime=0))


def curve_rows(baked: BakedModel, modalities: Sequence[Modality]) -> Int64[np.ndarray, " k"]:
    """The splats that some pixel can show (an opacity is 1/255 or more), along the space-filling
    curve; ConfigError if there are none."""
    means = to_array(baked.means)
    opacity = np.max([to_array(baked.opacities[each]) for each in modalities], axis=0)
    rows = np.flatnonzero((opacity >= ALPHA_MIN) & np.isfinite(means).all(axis=1))
    if not rows.size:
        raise ConfigError(
            "the model has no splat that can be seen, so there is nothing to show; train it longer"
        )
    return rows[morton_order(means[rows])]


def harmonics_limits(
    baked: BakedModel, rows: Int64[np.ndarray, " k"], modalities: Sequence[Modality]
) -> HarmonicsLimits:
    """The limits of each degree's coefficients, within which all but a few of some splats are."""
    some = torch.from_numpy(rows[:: -(-len(rows) // SAMPLED)])
    limits = {}
    for modality in modalities:
        if modality in baked.sh_dc:
            sh = to_array(
                torch.cat([baked.sh_dc[modality][some], baked.sh_rest[modality][some]], dim=1)
            )
            bands = range(math.isqrt(sh.shape[1]))
            limits[modality] = [_band_limits(_band(sh, band), band) for band in bands]
    return limits


def _band(sh: Float32[np.ndarray, "n _ c"], band: int) -> Float32[np.ndarray, "n b c"]:
    """The coefficients of one degree."""
    return sh[:, band**2 : (band + 1) ** 2]


def morton_order(means: Float32[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """The rows along a space-filling curve, so that neighbours in the file are neighbours in space;
    by the ranks on each axis, which a few splats far away do not change."""
    ranks = np.argsort(np.argsort(means, axis=0, kind="stable"), axis=0).astype(np.uint64)
    ranks >>= np.uint64(max(0, len(means).bit_length() - MORTON_BITS))
    code = np.zeros(len(means), dtype=np.uint64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= (ranks[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def smallest_three(quats: Float32[np.ndarray, "n 4"]) -> UInt32[np.ndarray, " n"]:
    """Unit quaternions wxyz in 32 bits: the index of the largest component on top, then the others,
    10 bits each."""
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.stack([np.delete(np.arange(4), index) for index in range(4)])[largest]
    small = np.take_along_axis(quats * sign, others, axis=1)
    codes = np.rint((small * math.sqrt(0.5) + 0.5) * 1023).clip(0, 1023)
    return largest.astype(np.uint32) << 30 | _three_in_one(codes)


def _chunked_positions(
    means: Float32[np.ndarray, "n 3"],
) -> tuple[Float32[np.ndarray, "c 3"], Float32[np.ndarray, "c 3"], UInt16[np.ndarray, "n 3"]]:
    """The bounds of each chunk, and the positions between them."""
    starts = np.arange(0, len(means), CHUNK)
    low, high = np.minimum.reduceat(means, starts), np.maximum.reduceat(means, starts)
    chunks = np.arange(len(means)) // CHUNK
    span = np.maximum(high - low, np.finfo(np.float32).tiny)
    return low, high, np.rint((means - low[chunks]) / span[chunks] * 65535).astype(np.uint16)


def _three_in_one(codes: Float[np.ndarray, "n 3"]) -> UInt32[np.ndarray, " n"]:
    """Three 10-bit numbers in one, the first on top."""
    first, second, third = codes.astype(np.uint32).T
    return first << 20 | second << 10 | third


def _quantise(
    values: Float32[np.ndarray, "..."], steps: int
) -> tuple[Float32[np.ndarray, "..."], list[float]]:
    """The values as whole numbers from 0 to ``steps`` between their limits."""
    low, high = float(values.min()), float(values.max())
    return np.rint((values - low) / max(high - low, 1e-12) * steps), [low, high]


def _band_limits(sh: Float32[np.ndarray, "n b c"], band: int) -> list[float]:
    """Limits that all but a few coefficients of one degree keep."""
    if band == 0:
        ends = np.quantile(sh, [CLIPPED_SHARE / 2, 1 - CLIPPED_SHARE / 2])
        return [float(limit) for limit in ends]
    high = float(np.quantile(np.abs(sh), 1 - CLIPPED_SHARE))
    return [-high, high]


def _quantise_band(
    sh: Float32[np.ndarray, "n b c"], band: int, limits: Sequence[float]
) -> UInt8[np.ndarray, "n b c"]:
    """The coefficients of one degree between their limits."""
    low, high = limits
    codes = np.rint((sh - low) / max(high - low, 1e-12) * SH_STEPS[band])
    return codes.clip(0, SH_STEPS[band]).astype(np.uint8)


PART = 65_536
"""Splats of a part; a model of fewer is one part."""

COARSE = 1 / 50
"""Share of a part's splats that stand for it until it has come."""

ROW = 512
"""Splats in a row of the page's textures: each part begins a new one."""

LAW = ("b", "low_k", "span_k", "gain", "offset", "least", "coldest_k")
"""What ``radiance.js`` reads of the ``BandRadiance``."""

FINITE_LOGITS = (1e-6, 1 - 1e-6)
"""Opacities are kept between these where their logits are taken."""


class PagePart(NamedTuple):
    """Some splats of a page's model: the place of the first among the page's splats, a multiple of
    ``ROW``, and the range of the coarse splats that they replace."""

    packed: PackedModel
    first: int
    replaces: tuple[int, int]

    def to_json(self) -> str:
        """JSON for the page's script; contains no ``<``."""
        header = {**self.packed.header, "first": self.first, "replaces": self.replaces}
        data = base64.b64encode(self.packed.data).decode("ascii")
        return f'{{"header": {json.dumps(header)}, "data": "{data}"}}'


class PageModel:
    """A model, cut into parts of ``size`` splats for the page, without splats that no pixel can
    show; parts that fill most of the first camera's image come first. ConfigError if no splat can
    be seen."""

    def __init__(
        self, baked: BakedModel, modalities: Sequence[Modality], camera: Camera, size: int = PART
    ) -> None:
        self._baked, self._modalities = baked, modalities
        rows = curve_rows(baked, modalities)
        self.count = len(rows)
        self._limits = harmonics_limits(baked, rows, modalities)
        parts = np.split(rows, range(size, len(rows), size))
        order = np.argsort([-_share(baked, part, camera) for part in parts], kind="stable")
        self._parts = [parts[index] for index in order]
        self._coarse = [] if len(parts) == 1 else [self._merged(part) for part in self._parts]

    @property
    def facts(self) -> dict[str, Any]:
        """What the page's script must know before the first part comes."""
        law, sizes = self._baked.radiance, [sum(map(len, self._coarse)), *map(len, self._parts)]
        return {
            "count": self.count,
            "parts": len(self._parts) + bool(self._coarse),
            "slots": sum(_whole_rows(size) for size in sizes),
            "dilation": asdict(self._baked.dilation) | {"least_px2": LEAST_DILATION_PX2},
            "radiance": law and {name: getattr(law, name) for name in LAW},
        }

    def parts(self) -> Iterator[PagePart]:
        """The parts in the order of the file; each is packed when it is asked for."""
        ends = np.cumsum([0, *map(len, self._coarse)]).tolist()
        if self._coarse:
            tensors = zip(*(each.tensors().values() for each in self._coarse), strict=True)
            joined = iter([torch.cat(each) for each in tensors])
            coarse = self._coarse[0].map_tensors(lambda tensor: next(joined))
            yield PagePart(self._pack(coarse), 0, (0, 0))
        first = _whole_rows(ends[-1])
        for number, rows in enumerate(self._parts):
            replaces = (ends[number], ends[number + 1]) if self._coarse else (0, 0)
            part = self._baked.subset(torch.from_numpy(rows))
            yield PagePart(self._pack(part), first, replaces)
            first += _whole_rows(len(rows))

    def _pack(self, baked: BakedModel) -> PackedModel:
        return pack_in_order(baked, self._modalities, self._limits)

    def _merged(self, rows: Int64[np.ndarray, " k"]) -> BakedModel:
        """The few splats that stand for a part."""
        part = self._baked.subset(torch.from_numpy(rows))
        few = merged(_as_gaussians(part), round(COARSE * len(rows)) + 1).gaussians
        return replace(
            part,
            means=few.means,
            quats=few.quats,
            scales=few.scales,
            opacities={modality: few.opacity(modality) for modality in part.opacities},
            sh_dc={modality: few.sh_dc[modality] for modality in part.sh_dc},
            sh_rest={modality: few.sh_rest[modality] for modality in part.sh_rest},
            temperatures=0.5 + C0 * few.sh_dc[THERMAL][:, 0, 0],
        )


def _whole_rows(count: int) -> int:
    return -(-count // ROW) * ROW


def _share(baked: BakedModel, rows: Int64[np.ndarray, " k"], camera: Camera) -> float:
    """How much of a camera's image some splats would cover if none hid another, in a unit that is
    the same for all."""
    part = torch.from_numpy(rows)
    pixels, depth = camera.project(baked.means[part])
    opacity = torch.stack([each[part] for each in baked.opacities.values()]).amax(dim=0)
    covers = opacity * (baked.scales[part].amax(dim=1) / depth).square()
    return float(covers[camera.contains(pixels)].sum())


def _as_gaussians(baked: BakedModel) -> Gaussians:
    """The parameters of splats."""
    thermal = ((baked.temperatures - 0.5) / C0)[:, None, None]
    opacities = {each: opacity.clamp(*FINITE_LOGITS) for each, opacity in baked.opacities.items()}
    return Gaussians(
        means=baked.means,
        quats=baked.quats,
        log_scales=baked.scales.log(),
        opacity_logits={each: opacity.logit()[:, None] for each, opacity in opacities.items()},
        sh_dc={**baked.sh_dc, THERMAL: thermal},
        sh_rest={**baked.sh_rest, THERMAL: thermal[:, :0]},
        embedding=baked.means.new_zeros(len(baked), 0),
    )
