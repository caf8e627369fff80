from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import torch

from mrgs.errors import RunError
from mrgs.evaluation.evaluate import (
    NO_LPIPS,
    TRUTH_FIGURES,
    Metrics,
    Parts,
    Truth,
    evaluate,
)
from mrgs.evaluation.metrics import Missing, figure_names
from mrgs.evaluation.report import RunFacts, format_figure, to_document, to_markdown, write_report
from mrgs.method.parts import PartSpreads
from mrgs.pictures.files import write_float_tiff
from mrgs.scene import RGB, THERMAL, Rendering, View
from tests.helpers.gaussians import NEAR_INFRARED
from tests.helpers.views import CELSIUS, ramp_view, render_with_error, rendering_of

FACTS = RunFacts("mrgs", "a|b", 1200, 41_000, 63.5, None, "cpu")


@pytest.fixture
def metrics(tmp_path: Path) -> Metrics:
    """Three views: identical images (infinite PSNR), a rendering with NaN, and one without an RGB
    image."""
    views = [ramp_view("perfect"), ramp_view("broken"), ramp_view("no_rgb", rgb=False)]
    exact = CELSIUS.to_celsius(views[0].images[THERMAL].load().values[..., 0]).numpy()
    write_float_tiff(
        tmp_path / "truth" / "temperature" / "perfect.tiff", exact, "temperature, degrees Celsius"
    )

    def render(view: View) -> Rendering:
        images = {each: image.load().values.clone() for each, image in view.images.items()}
        if view.name == "broken":
            images[THERMAL][0, 0] = torch.nan
        return rendering_of(images)

    return evaluate(views, render, CELSIUS, truth=Truth(tmp_path / "truth"))


def strict(text: str) -> Any:
    def refuse(constant: str) -> None:
        raise AssertionError(f"not strict JSON: {constant}")

    return json.loads(text, parse_constant=refuse)


def nulls(node: Any, path: str = "") -> set[str]:
    if isinstance(node, dict):
        return {
            found
            for key, value in node.items()
            for found in nulls(value, f"{path}.{key}" if path else key)
        }
    return {path} if node is None else set()


def test_the_document_has_the_promised_fields(metrics: Metrics, tmp_path: Path) -> None:
    path, _ = write_report(tmp_path / "eval", FACTS, metrics)
    document = strict(path.read_text(encoding="utf-8"))
    assert list(document) == [
        *("method", "scene", "steps", "gaussians", "train_seconds", "peak_memory_bytes", "device"),
        *("custom_parts", "mean", "truth", "poses", "reasons", "views"),
    ]
    assert tuple(document["mean"]["thermal"]) == figure_names(THERMAL)
    assert tuple(document["mean"]["rgb"]) == figure_names(RGB)
    assert tuple(document["truth"]) == TRUTH_FIGURES
    assert document["train_seconds"] == 63.5
    assert [view["name"] for view in document["views"]] == ["perfect", "broken", "no_rgb"]


def test_every_null_has_its_reason_and_nothing_else_has(metrics: Metrics) -> None:
    document = to_document(FACTS, metrics)
    views = document.pop("views")
    for part in (document, *views):
        reasons = part.pop("reasons")
        assert set(reasons) == nulls(part)
        assert all(reasons.values())
    assert document["peak_memory_bytes"] is None


def test_nulls_of_the_parts_have_reasons_too(metrics: Metrics) -> None:
    figures = {"thermal_psnr": 30.0, "rgb_psnr": Missing("no photo"), "truth_mae_c": math.nan}
    parts = Parts(PartSpreads(0.1, 0.0, 0.2), {"heat_exchange": figures}, None)
    document = to_document(FACTS, metrics, parts)
    reasons, found = document.pop("reasons"), nulls(document["parts"], "parts")
    assert found == {name for name in reasons if name.startswith("parts.")}
    assert found == {
        "parts.temperature_residual_std_c",
        "parts.heat_exchange_std_c",
        "parts.knock_out.heat_exchange.rgb_psnr",
        "parts.knock_out.heat_exchange.truth_mae_c",
    }


def test_what_json_cannot_hold(metrics: Metrics) -> None:
    document = to_document(FACTS, metrics)
    perfect, broken, no_rgb = document["views"]
    assert perfect["thermal"]["psnr"] is None
    assert "identical" in perfect["reasons"]["thermal.psnr"]
    assert "NaN" in broken["reasons"]["thermal.mae_c"]
    assert "no RGB image" in no_rgb["reasons"]["rgb.ssim"]
    assert "NaN" in document["reasons"]["mean.thermal.mae_c"]
    assert document["truth"]["mae_c"] == 0.0
    assert document["mean"]["rgb"]["ssim"] == pytest.approx(1.0)


def test_truth_is_absent_where_the_scene_has_none() -> None:
    document = to_document(FACTS, evaluate([ramp_view()], render_with_error, None))
    assert "truth" not in document
    assert "truth" not in document["views"][0]


def test_markdown_tables_are_rectangular_and_explain_dashes(metrics: Metrics) -> None:
    text = to_markdown(FACTS, metrics)
    assert text.startswith("# mrgs on a\\|b\n")
    for fact in ("1,200 steps", "41,000 Gaussians", "64 s", "device cpu"):
        assert fact in text
    for block in text.split("\n\n"):
        if block.startswith("| |"):
            assert len({line.count("|") for line in block.splitlines()}) == 1
    assert re.search(r"^## .*exact truth$", text, re.MULTILINE)
    assert f"- LPIPS: {NO_LPIPS}" in text


def test_figures_for_people() -> None:
    assert format_figure("psnr", 32.618) == "32.62"
    assert format_figure("mae_c", 0.2386) == "0.239"
    assert format_figure("psnr", float("inf")) == "∞"
    assert format_figure("psnr", float("nan")) == "–"


def test_both_files_or_an_error_that_names_one(metrics: Metrics, tmp_path: Path) -> None:
    paths = write_report(tmp_path / "eval", FACTS, metrics)
    assert [path.name for path in paths] == ["metrics.json", "metrics.md"]
    (tmp_path / "taken").write_text("")
    with pytest.raises(RunError, match=r"metrics\.json"):
        write_report(tmp_path / "taken", FACTS, metrics)


def test_a_third_modality_has_its_own_key_and_table() -> None:
    metrics = evaluate([ramp_view("a", nir=True)], render_with_error, CELSIUS)
    document = to_document(FACTS, metrics)
    assert list(document["mean"]) == ["thermal", "rgb", "nir"]
    assert tuple(document["views"][0]["nir"]) == figure_names(NEAR_INFRARED)
    assert document["mean"]["nir"]["psnr"] == pytest.approx(40.0, abs=1e-3)
    assert "## Near infrared" in to_markdown(FACTS, metrics)
