"""The page's model in parts that are shown one after the other: first few splats that stand for
all, then the splats themselves, a region of the scene at a time."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Int64

from mrgs.export.page.packing import PackedModel, curve_rows, harmonics_limits, pack_in_order
from mrgs.field.spherical_harmonics import C0
from mrgs.rasterizer.contract import LEAST_DILATION_PX2
from mrgs.runs.baked import BakedModel
from mrgs.scene import THERMAL, Camera, Gaussians, Modality
from mrgs.scene.level_of_detail import merged

PART = 65_536
"""Splats of a part; a model of fewer is one part."""

COARSE = 1 / 50
"""Share of a part's splats that stand for it until it has come."""

ROW = 512
"""Splats in a row of the page's textures: each part begins a new one."""

FINITE_LOGITS = (1e-6, 1 - 1e-6)
"""Opacities are kept between these where their logits are taken."""


class PagePart(NamedTuple):
    """Some splats of a page's model: the place of the first among the page's splats, a multiple of
    ``ROW``, and the range of the coarse splats that they replace."""

    packed: PackedModel
    first: int
    replaces: tuple[int, int]

    def to_json(self) -> str:
        """For the page's script; holds no ``<``."""
        header = {**self.packed.header, "first": self.first, "replaces": self.replaces}
        data = base64.b64encode(self.packed.data).decode("ascii")
        return f'{{"header": {json.dumps(header)}, "data": "{data}"}}'


class PageModel:
    """A model, cut into parts of ``size`` splats for the page, without splats that no pixel can
    show; those that fill most of the first camera's image come first. ConfigError if no splat can
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
        sizes = [sum(map(len, self._coarse)), *map(len, self._parts)]
        return {
            "count": self.count,
            "parts": len(self._parts) + bool(self._coarse),
            "slots": sum(_whole_rows(size) for size in sizes),
            "dilation": asdict(self._baked.dilation) | {"least_px2": LEAST_DILATION_PX2},
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
