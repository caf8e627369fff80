"""What each part of the paper contributes to a trained model: how much it says, and what the
held-out views lose without it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from mrgs.errors import SceneError
from mrgs.evaluation.figures import Figure, Missing, mean_figures, to_json
from mrgs.evaluation.metrics import psnr
from mrgs.evaluation.truth import Truth
from mrgs.method.parts import PartSpreads, knock_outs, part_spreads
from mrgs.render import Model, render
from mrgs.runs.open import Run
from mrgs.scene import BUILT_IN, RGB, THERMAL, Blend, CameraResponse, Pixels, TemperatureRange, View

KNOCK_OUT_FIGURES = ("thermal_psnr", "rgb_psnr", "truth_mae_c")


@dataclass(frozen=True)
class Parts:
    """The parts of a run's model.

    Attributes:
        spreads: how much they differ from Gaussian to Gaussian.
        knock_out: mean figures of the held-out views for each copy of ``knock_outs``, by the names
            in ``KNOCK_OUT_FIGURES``.
        temperature: the scene's scale; None without °C.
    """

    spreads: PartSpreads
    knock_out: Mapping[str, Mapping[str, Figure]]
    temperature: TemperatureRange | None

    def to_document(self) -> dict[str, Any]:
        """The object ``parts`` of ``metrics.json``; what cannot be had is null."""
        span = None if self.temperature is None else self.temperature.span_c

        def celsius(spread: float) -> float | None:
            return None if span is None else spread * span

        return {
            "temperature_residual_std_c": celsius(self.spreads.temperature_residual),
            "heat_exchange_std_c": celsius(self.spreads.heat_exchange),
            "color_residual_std": self.spreads.color_residual,
            "knock_out": {
                part: {name: to_json(figure)[0] for name, figure in figures.items()}
                for part, figures in self.knock_out.items()
            },
        }


def score_parts(run: Run, views: Sequence[View], truth: Truth | None = None) -> Parts | None:
    """Knock the parts out of a run's model, one at a time, and score what is left.

    Args:
        run: a trained run.
        views: the held-out views.
        truth: exact temperatures, see ``Truth.find``.

    Returns:
        None for a model without the paper's field (3DGS_RGB-T).

    Raises:
        SceneError: there are no views, or an image or a truth file cannot be read.
    """
    if not views:
        raise SceneError("there are no views to score the parts of the model on")
    spreads = part_spreads(run.model, views[0].camera.position.float())
    if spreads is None:
        return None
    scored = {
        part: _score(model, views, run.camera_response, run.temperature, truth)
        for part, model in knock_outs(run.model).items()
    }
    return Parts(spreads, scored, run.temperature)


def _score(
    model: Model,
    views: Sequence[View],
    response: CameraResponse,
    temperature: TemperatureRange | None,
    truth: Truth | None,
) -> Mapping[str, Figure]:
    """Mean figures of the views, rendered on the CPU."""
    scored = []
    for view in views:
        cameras = {each: view.cameras[each] for each in BUILT_IN if each in view.cameras}
        with torch.no_grad():
            rendering, _ = render(model, cameras)
        observed = response(rendering, view.camera)
        photos = {modality: image.load() for modality, image in view.images.items()}
        figures: dict[str, Figure] = {
            f"{modality}_psnr": _psnr(photos.get(modality), observed.get(modality))
            for modality in (THERMAL, RGB)
        }
        thermal = rendering[THERMAL].image if THERMAL in rendering else None
        figures["truth_mae_c"] = (
            Missing("the scene has no exact truth")
            if truth is None
            else truth.score(view.name, thermal, None, None, temperature)["mae_c"]
        )
        scored.append(figures)
    return mean_figures(scored, KNOCK_OUT_FIGURES)


def _psnr(photo: Pixels | None, blend: Blend | None) -> Figure:
    if photo is None or blend is None:
        return Missing("the view has no such image, or the model does not render it")
    return psnr(blend.image, photo.values, photo.valid)
