"""Marks in trained models, against the exact truth of a generated scene."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from mrgs import Run, RunMarks, load_run, make_config, open_marks
from mrgs.data.images import read_float_tiff
from mrgs.errors import ConfigError, RunError
from mrgs.scene import THERMAL, View
from tests.helpers.runs import SMALL, trained_run

TABLETOP = Path(__file__).parents[2] / "examples" / "tabletop"
CONFIG = make_config("mrgs", "fast", max_steps=200, max_gaussians=3_000, resolution=96)
ON_THE_TABLE = [(30, 55), (60, 60)]
"""Pixels of the first held-out view, at 96 × 72."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    output = tmp_path_factory.mktemp("tabletop") / "run"
    return load_run(trained_run(tmp_path_factory, TABLETOP, CONFIG, output))


@pytest.fixture
def marks(run: Run) -> Iterator[RunMarks]:
    yield open_marks(run)
    for path in run.folder.path.glob("*marks*"):
        path.unlink()


@pytest.fixture
def view(run: Run) -> View:
    return run.load_scene().eval[0]


def exact_places(view: View, pixels: list[tuple[int, int]]) -> np.ndarray:
    """World coordinates of what the thermal camera sees at pixels, [N, 3]."""
    depth = read_float_tiff(TABLETOP / "truth" / "depth" / f"{view.name}.tiff")
    camera = view.images[THERMAL].camera.resized(*depth.shape[::-1])
    scale = depth.shape[1] / 96
    at = np.array(pixels) * scale
    depths = [float(depth[int(y), int(x)]) for x, y in at]
    return camera.unproject(torch.tensor(at), torch.tensor(depths).double()).numpy()


@pytest.mark.slow
def test_spots_have_the_temperature_of_the_surface(marks, view) -> None:
    exact = read_float_tiff(TABLETOP / "truth" / "temperature" / f"{view.name}.tiff")
    scale = exact.shape[1] / 96
    errors = []
    for pixel in ON_THE_TABLE:
        reading = marks.meter.read(marks.spot(view.images[THERMAL].camera, pixel))
        x, y = (int(each * scale) for each in pixel)
        errors.append(reading.mean - exact[y - 2 : y + 3, x - 2 : x + 3].mean())
        assert reading.photos >= 4
    assert np.abs(errors).max() < 1.0  # what test_temperature_at has for most of its surfaces


@pytest.mark.slow
def test_a_place_reads_the_same_as_a_mark_and_by_its_coordinates(marks, run) -> None:
    """Spots as small as a point; ``temperature_at`` knows nothing of where they were drawn from."""
    generator, away = np.random.default_rng(63), []
    for view in run.load_scene().eval:
        camera = view.images[THERMAL].camera
        for _ in range(4):
            pixel = generator.uniform(4, [camera.width - 4, camera.height - 4])
            try:
                mark = marks.spot(camera, pixel, radius=1e-3)
            except ConfigError:
                continue  # on nothing
            reading = marks.meter.read(mark)
            known = run.temperature_at(np.array(mark.points, np.float32))[0].item()
            if reading.uncertainty is not None and np.isfinite(known):
                away.append(abs(reading.mean - known) / reading.uncertainty.total)
    assert len(away) >= 15
    assert np.quantile(away, 0.9) < 1 / 3
    assert np.median(away) < 0.1  # 0.04 of 89 such spots


@pytest.mark.slow
def test_points_have_the_interval_that_holds_their_truth(marks, run, view) -> None:
    exact = read_float_tiff(TABLETOP / "truth" / "temperature" / f"{view.name}.tiff")
    camera, scale = view.images[THERMAL].camera, exact.shape[1] / 96
    depth = run.render(camera).surface_depth(THERMAL)
    rows, columns = (np.arange(6, side - 6, 3) for side in (camera.height, camera.width))
    x, y = (each.ravel() for each in np.meshgrid(columns, rows))
    pixels = torch.from_numpy(np.stack([x, y], axis=1) + 0.5)
    points = camera.unproject(pixels, depth[y, x].double())
    within = marks.uncertainty_at(points)
    error = marks.temperature_at(points) - torch.from_numpy(
        exact[((y + 0.5) * scale).astype(int), ((x + 0.5) * scale).astype(int)]
    )
    known = within.isfinite() & error.isfinite()
    assert known.sum() > 200
    assert (error.abs() < within)[known].float().mean() > 0.85
    assert within[known].quantile(0.2) < 0.6, "on even surfaces"
    assert marks.uncertainty_at([[0.0, 0.0, 50.0]]).isnan().all()


@pytest.mark.slow
def test_lengths_are_those_of_the_world(marks, view) -> None:
    ends = exact_places(view, ON_THE_TABLE[:2])
    mark = marks.line(view.images[THERMAL].camera, ON_THE_TABLE[:2])
    reading = marks.meter.read(mark)
    assert reading.length == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=0.04)
    assert marks.world.length_unit == "m"


@pytest.mark.slow
def test_marks_are_kept_with_the_run(marks, run, view) -> None:
    camera = view.images[THERMAL].camera
    marks.spot(camera, ON_THE_TABLE[1], note="near")
    marks.box(camera, (60, 52), (40, 44), emissivity=0.7)
    marks.polygon(camera, [(30, 50), (40, 50), (35, 58)], name="Table")
    marks.refer_to("S1")
    again = open_marks(run)
    assert again.marks == marks.marks
    assert [mark.name for mark in again.marks.marks] == ["S1", "B1", "Table"]
    spot, _, table = again.measure()
    assert table.difference == pytest.approx(table.mean - spot.mean)
    assert again.change("Table", name="Plate", note="warm").note == "warm"
    again.remove("B1")
    again.undo()
    assert [mark.name for mark in marks.marks.marks] == ["S1", "B1", "Plate"]


@pytest.mark.slow
def test_renderings_and_points_can_have_the_emissivity_of_areas(marks, run, view):
    camera = view.images[THERMAL].camera
    before = run.temperatures_c(run.render(camera))
    depth = run.render(camera).surface_depth(THERMAL)
    rows, columns = np.array([48, 8]), np.array([50, 8])
    pixels = torch.from_numpy(np.stack([columns, rows], axis=1) + 0.5)
    points = camera.unproject(pixels, depth[rows, columns].double())
    assert np.allclose(marks.temperature_at(points), run.temperature_at(points), equal_nan=True)
    marks.box(camera, (60, 52), (40, 44), emissivity=0.5, reflected_c=0.0)
    after = run.temperatures_c(marks.render(camera))
    changed = marks.temperature_at(points) - run.temperature_at(points)
    assert changed[0] == pytest.approx(float((after - before)[48, 50]), abs=0.5)
    assert changed[0] > 3
    assert not changed[1] > 0  # beside the area, or nothing known
    assert torch.equal(run.temperatures_c(run.render(camera)), before)


@pytest.mark.slow
def test_a_copy_of_another_runs_marks_is_refused(marks, view, small_scene, tmp_path_factory):
    marks.spot(view.images[THERMAL].camera, (48, 40))
    output = tmp_path_factory.mktemp("other") / "run"
    other = load_run(trained_run(tmp_path_factory, small_scene, SMALL, output))
    (other.folder.path / "marks.json").write_bytes(marks.store.file.read_bytes())
    with pytest.raises(RunError, match="another model"):
        open_marks(other).measure()
