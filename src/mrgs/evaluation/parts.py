"""What each part of the paper contributes to a trained model: how large it is, and what the
held-out views lose without it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from mrgs.evaluation.evaluate import Truth
from mrgs.evaluation.metrics import Figure, Figures, Missing, mean_figures, psnr, to_json
from mrgs.method.parts import PartSpreads, knock_outs, part_spreads
from mrgs.render import Model, render
from mrgs.runs.open import Run
from mrgs.scene import BUILT_IN, THERMAL, Blend, Modality, Pixels, TemperatureRange, View

KNOCK_OUT_FIGURES = ("thermal_psnr", "rgb_psnr", "truth_mae_c")


@dataclass(frozen=True)
class Parts:
    """The parts of a run's model: how much they differ from Gaussian to Gaussian, and mean figures
    of the held-out views for each copy of ``knock_outs``, by the names in ``KNOCK_OUT_FIGURES``."""

    spreads: PartSpreads
    knock_out: Mapping[str, Mapping[str, Figure]]
    temperature: TemperatureRange | None

    def to_document(self) -> dict[str, Any]:
        """The object ``parts`` of ``metrics.json``; what cannot be had is null."""
        return {
            **self.spreads.to_json(self.temperature),
            "knock_out": {
                part: {name: to_json(figure)[0] for name, figure in figures.items()}
                for part, figures in self.knock_out.items()
            },
        }


def score_parts(run: Run, views: Sequence[View], truth: Truth | None = None) -> Parts | None:
    """Knock the parts out of a run's model, one at a time, and score what is left. None for a model
    without the paper's field (3DGS_RGB-T). SceneError if an image or a truth file cannot be
    read."""
    spreads = part_spreads(run.model, views[0].camera.position.float())
    if spreads is None:
        return None
    copies = knock_outs(run.model)
    scored: dict[str, list[Figures]] = {part: [] for part in copies}
    for view in views:
        photos = {modality: image.load() for modality, image in view.images.items()}
        for part, model in copies.items():
            scored[part].append(_score(model, view, photos, run, truth))
    means = {part: mean_figures(each, KNOCK_OUT_FIGURES) for part, each in scored.items()}
    return Parts(spreads, means, run.temperature)


def _score(
    model: Model, view: View, photos: Mapping[Modality, Pixels], run: Run, truth: Truth | None
) -> Figures:
    """One view's figures of a copy of the run's model, rendered on the CPU."""
    cameras = {each: view.cameras[each] for each in BUILT_IN if each in view.cameras}
    with torch.no_grad():
        rendering, _ = render(model, cameras)
    observed = run.camera_response(rendering, view.camera)
    figures: Figures = {
        f"{modality}_psnr": _psnr(photos.get(modality), observed.get(modality))
        for modality in BUILT_IN
    }
    thermal = rendering[THERMAL].image if THERMAL in rendering else None
    figures["truth_mae_c"] = (
        Missing("the scene has no exact truth")
        if truth is None
        else truth.score(view.name, thermal, None, None, run.temperature)["mae_c"]
    )
    return figures


def _psnr(photo: Pixels | None, blend: Blend | None) -> Figure:
    if photo is None or blend is None:
        return Missing("the view has no such image, or the model does not render it")
    return psnr(blend.image, photo.values, photo.valid)
