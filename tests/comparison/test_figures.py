from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs.data import load_scene
from mrgs.evaluation.contact_sheet import ViewImages
from mrgs.pictures.files import write_float_tiff
from mrgs.pictures.sheet import GAP_PX
from mrgs.scene import THERMAL, Blend, Modality, PosedImage, Rendering, Scene, View
from mrgs_compare.comparison import (
    NARROW_PX,
    WIDE_PX,
    Exhibit,
    depth_section,
    qualitative_section,
)
from tests.helpers.gaussians import NEAR_INFRARED


def render_off_by(error: float, depth: float = 2.0) -> Callable[[View], Rendering]:
    def render(view: View) -> Rendering:
        def blend(modality: Modality, posed: PosedImage) -> Blend:
            image = posed.load().values + error
            away = torch.full(image.shape[:2], depth if modality == THERMAL else 9.0)
            return Blend(image, away, torch.ones_like(away))

        return Rendering({each: blend(each, posed) for each, posed in view.images.items()})

    return render


def shown_by(scene: Scene, view: View, render: Callable[[View], Rendering]) -> ViewImages:
    return ViewImages.of(view, render(view), scene.temperature, scene.reach, THERMAL)


@pytest.fixture
def make_exhibit(small_scene: Path) -> Callable[..., Exhibit]:
    def make(
        methods: dict[str, Callable[[View], Rendering]], folder: Path = small_scene
    ) -> Exhibit:
        scene = load_scene(small_scene)
        view = scene.eval[1]
        figures = {
            name: {"thermal": {"psnr": 31.234, "mae_c": 0.456}, "rgb": {"psnr": None}}
            for name in methods
        }
        shown = {name: shown_by(scene, view, render) for name, render in methods.items()}
        return Exhibit(scene, folder, view, shown, figures)

    return make


def test_a_column_for_the_truth_and_for_every_method(make_exhibit):
    one = qualitative_section(make_exhibit({"a": render_off_by(0.1)}), ["a"])
    two = qualitative_section(
        make_exhibit({"a": render_off_by(0.1), "b": render_off_by(0.2)}), ["a", "b"]
    )
    assert WIDE_PX <= two.width - one.width <= WIDE_PX + 10
    assert two.height == one.height > 3 * WIDE_PX * 3 // 4


def test_a_third_modality_has_a_row(small_scene):
    scene = load_scene(small_scene)
    view = scene.eval[1]
    grey = view.images[THERMAL]
    more = View(view.name, {**view.images, NEAR_INFRARED: grey})
    two, three = (
        qualitative_section(
            Exhibit(scene, small_scene, each, {"a": shown_by(scene, each, render_off_by(0.1))}, {}),
            ["a"],
        )
        for each in (view, more)
    )
    assert two.width == three.width
    assert three.height - two.height > WIDE_PX // 2


def test_many_methods_make_narrow_columns(make_exhibit):
    names = [f"m{index}" for index in range(6)]
    figure = qualitative_section(make_exhibit(dict.fromkeys(names, render_off_by(0.1))), names)
    assert 7 * NARROW_PX < figure.width < 8 * NARROW_PX


def test_a_method_without_images_leaves_its_column_empty(make_exhibit):
    exhibit = make_exhibit({"a": render_off_by(0.1)})
    figure = np.asarray(qualitative_section(exhibit, ["a", "gone"]))
    last = figure[70:-70, -WIDE_PX:]
    assert (last == 255).all(axis=2).mean() > 0.95


def test_the_error_is_that_of_the_rendering(make_exhibit):
    warm = np.asarray(qualitative_section(make_exhibit({"a": render_off_by(0.2)}), ["a"])).astype(
        int
    )
    cold = np.asarray(qualitative_section(make_exhibit({"a": render_off_by(-0.2)}), ["a"])).astype(
        int
    )
    below = warm.shape[0] * 3 // 4
    error = [
        picture[below - 40 : below, -WIDE_PX // 2 - 20 : -WIDE_PX // 2].mean(axis=(0, 1))
        for picture in (warm, cold)
    ]
    assert error[0][0] > error[0][2]  # red: too warm
    assert error[1][0] < error[1][2]  # blue: too cold


def test_depth_with_and_without(make_exhibit, tmp_path):
    methods = {"mrgs-fourier": render_off_by(0.0, depth=2.0), "mrgs": render_off_by(0.0, depth=4.0)}
    plain = depth_section(make_exhibit(methods))
    exhibit = make_exhibit(methods, tmp_path)
    write_float_tiff(
        tmp_path / "truth" / "depth" / f"{exhibit.view.name}.tiff",
        np.linspace(1, 5, 1200, dtype=np.float32).reshape(30, 40), "depth",
    )  # fmt: skip
    exact = depth_section(exhibit)
    assert WIDE_PX <= exact.width - plain.width <= WIDE_PX + 10
    row = np.asarray(exact).astype(int)[150]
    near, far = (row[(WIDE_PX + GAP_PX) * index + WIDE_PX // 2] for index in (0, 2))
    assert near.sum() > far.sum()  # near is light; the depth is the thermal camera's


def test_a_damaged_exact_depth_is_left_out(make_exhibit, tmp_path):
    methods = {"mrgs-fourier": render_off_by(0.0), "mrgs": render_off_by(0.0)}
    plain = depth_section(make_exhibit(methods))
    exhibit = make_exhibit(methods, tmp_path)
    damaged = tmp_path / "truth" / "depth" / f"{exhibit.view.name}.tiff"
    damaged.parent.mkdir(parents=True)
    damaged.write_bytes(b"II*")
    assert depth_section(exhibit).tobytes() == plain.tobytes()
