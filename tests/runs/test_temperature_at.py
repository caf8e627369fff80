"""Temperatures at points of the world, against the exact truth of a generated scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs import Run, load_run, load_scene, make_config
from mrgs.data.images import read_float_tiff
from mrgs.scene import THERMAL
from tests.helpers.runs import SMALL, trained_run

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"
CONFIG = make_config("mrgs", "fast", max_steps=200, max_gaussians=3_000, resolution=96)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    output = tmp_path_factory.mktemp("tabletop") / "run"
    return load_run(trained_run(tmp_path_factory, TABLETOP, CONFIG, output))


def truth_of_held_out_views(nearness: float) -> tuple[np.ndarray, np.ndarray]:
    """World coordinates [N, 3] of the surfaces that held-out thermal cameras see, moved along their
    depth to this share of it, and exact °C [N]."""
    points, celsius = [], []
    for view in load_scene(TABLETOP).eval:
        exact, depth = (
            read_float_tiff(TABLETOP / "truth" / kind / f"{view.name}.tiff")
            for kind in ("temperature", "depth")
        )
        known = np.isfinite(depth) & (depth > 0) & np.isfinite(exact)
        camera = view.images[THERMAL].camera
        points.append(camera.unproject_image(torch.tensor(nearness * depth))[known].numpy())
        celsius.append(exact[known])
    return np.concatenate(points), np.concatenate(celsius)


@pytest.mark.slow
def test_surfaces_have_their_exact_temperatures(run: Run) -> None:
    points, exact = truth_of_held_out_views(1.0)
    found = run.temperature_at(points).numpy()
    known = ~np.isnan(found)
    assert found.shape == exact.shape
    assert known.mean() > 0.6
    errors = np.abs(found - exact)[known]
    assert np.median(errors) < 0.2, "of a range of 84 °C"
    assert np.quantile(errors, 0.8) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("nearness", "most"), [(0.75, 0.03), (1.25, 0.12)])
def test_nothing_is_known_before_and_behind_surfaces(run, nearness, most) -> None:
    points, _ = truth_of_held_out_views(nearness)
    assert (~run.temperature_at(points).isnan()).float().mean() < most


@pytest.mark.slow
def test_what_no_camera_can_see_is_nan(run: Run) -> None:
    reach = run.load_scene().reach
    offsets = np.array([[0, 0, 50 * reach.radius], [np.nan, 0, 0], [np.inf, 0, 0]])
    far = offsets + reach.centre.numpy()
    assert run.temperature_at(far).isnan().all()
    assert run.temperature_at(np.empty((0, 3))).shape == (0,)
    with pytest.raises(ValueError, match=r"points .* \[3\]"):
        run.temperature_at([0.0, 0.0, 0.0])


def test_without_celsius_there_is_no_temperature(small_scene, tmp_path, tmp_path_factory) -> None:
    run = load_run(trained_run(tmp_path_factory, small_scene, SMALL, tmp_path / "run"))
    without = replace(
        run,
        facts=run.facts._replace(temperature=None),
        scene=replace(run.load_scene(), temperature=None),
    )
    with pytest.raises(ValueError, match="no °C"):
        without.temperature_at([[0.0, 0.0, 0.0]])
