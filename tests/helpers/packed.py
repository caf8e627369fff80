"""A model packed for a page, and a decoder that follows the description of ``packing.py``."""

from __future__ import annotations

import gzip
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from mrgs.export.page.packing import PackedModel, curve_rows, harmonics_limits, pack_in_order
from mrgs.runs.baked import BakedModel
from mrgs.scene import Modality


def pack(baked: BakedModel, modalities: Sequence[Modality] | None = None) -> PackedModel:
    modalities = baked.modalities if modalities is None else modalities
    rows = curve_rows(baked, modalities)
    limits = harmonics_limits(baked, rows, modalities)
    return pack_in_order(baked.subset(torch.from_numpy(rows)), modalities, limits)


def unpack(packed: PackedModel) -> dict[str, np.ndarray]:
    header, stream = packed.header, gzip.decompress(packed.data)
    planes, at = {}, 0
    for name, kind, length in header["planes"]:
        planes[name] = np.frombuffer(stream, np.dtype(kind).newbyteorder("<"), length, at)
        at += planes[name].nbytes
    assert at == len(stream)
    count, limits = header["count"], header["limits"]

    def between(codes: np.ndarray, low: float, high: float, steps: int) -> np.ndarray:
        return low + (high - low) * codes.astype(np.float64) / steps

    chunks = np.arange(count) // header["chunk"]
    low, high = (planes[name].reshape(-1, 3)[chunks] for name in ("chunk_low", "chunk_high"))

    def harmonics(name: str) -> np.ndarray:
        ends = limits["sh"][name]
        codes = planes[f"sh_{name}"].reshape(len(ends) ** 2, -1, count)
        bands = [
            between(codes[d**2 : (d + 1) ** 2], *ends[d], header["sh_steps"][d])
            for d in range(len(ends))
        ]
        return np.concatenate(bands).transpose(2, 0, 1)

    opacities = {
        f"opacity.{name.removeprefix('opacity_')}": plane / np.iinfo(plane.dtype).max
        for name, plane in planes.items()
        if name.startswith("opacity_")
    }
    return {
        "means": low + (high - low) * planes["positions"].reshape(3, count).T / 65535,
        "scales": np.exp(between(ten_bits(planes["scales"]), *limits["scales"], 1023)),
        "quats": quaternions(planes["rotations"]),
        **opacities,
        "temperatures": between(planes["values_thermal"], *limits["values"]["thermal"], 65535),
        **{f"sh_dc.{name}": harmonics(name)[:, :1] for name in limits["sh"]},
        **{f"sh_rest.{name}": harmonics(name)[:, 1:] for name in limits["sh"]},
    }


def ten_bits(codes: np.ndarray) -> np.ndarray:
    return np.stack([codes >> shift & 1023 for shift in (20, 10, 0)], axis=1)


def quaternions(codes: np.ndarray) -> np.ndarray:
    small = (ten_bits(codes) / 1023 * 2 - 1) * math.sqrt(0.5)
    largest = np.sqrt(np.maximum(0, 1 - (small**2).sum(axis=1)))
    return np.stack(
        [np.insert(s, code >> 30, big) for s, code, big in zip(small, codes, largest, strict=True)]
    )


def as_model(content: dict[str, np.ndarray], like: BakedModel) -> BakedModel:
    tensors = {name: torch.tensor(array, dtype=torch.float32) for name, array in content.items()}
    rest = {modality: tensors.pop(f"sh_rest.{modality}") for modality in like.sh_rest}
    return replace(
        like,
        opacities={each: tensors.pop(f"opacity.{each}") for each in like.modalities},
        sh_dc={modality: tensors.pop(f"sh_dc.{modality}") for modality in like.sh_dc},
        sh_rest={
            modality: torch.nn.functional.pad(each, (0, 0, 0, 15 - each.shape[1]))
            for modality, each in rest.items()
        },
        **tensors,
    )
