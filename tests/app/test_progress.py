"""What the terminal says while nothing else can be seen."""

from __future__ import annotations

import pytest
import torch

from mrgs.app import progress
from mrgs.app.progress import PrepareProgress
from mrgs.method.config import make_config
from mrgs.scene import RGB, Camera, Pixels, PointCloud, PosedImage, Scene, View


def test_without_a_terminal_a_count_is_told_now_and_then_and_at_the_end(capsys):
    now = [0.0]
    with progress.counter("rendering", clock=lambda: now[0]) as show:
        for done in range(1, 7):
            now[0] += 4
            show(done, 6)
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("rendering 3/6")
    assert "0:12 left" in first
    assert last == "rendering 6/6"


def test_a_step_without_a_forecast_tells_the_time_left_by_its_own_pace(capsys):
    now = [0.0]
    shown = PrepareProgress(clock=lambda: now[0])
    for seconds, done in [(0.0, 0), (20.0, 10)]:
        now[0] = seconds
        shown.step("reading images", done, 40)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.split(" | ")[1:] == ["1:00 left", "0:20"]


@pytest.mark.parametrize(("width", "words"), [(640, None), (4000, "--resolution 1600")])
def test_large_photos_are_told_with_what_a_smaller_resolution_saves(width, words):
    scene = scene_of_views(width, 3 * width // 4)
    hint = progress._hint_at_resolution(scene, make_config("mrgs-plus", "default"))
    assert (hint is None) if words is None else (words in hint)


def scene_of_views(width: int, height: int) -> Scene:
    """A scene whose photos are never read."""
    K = torch.tensor([[500.0, 0, 0], [0, 500.0, 0], [0, 0, 1]], dtype=torch.float64)
    camera = Camera(K, torch.eye(4, dtype=torch.float64), width, height)

    def load() -> Pixels:
        raise AssertionError("no photo is needed")

    points = PointCloud(torch.zeros(1, 3), torch.zeros(1, 3))
    return Scene("large", (View("a", {RGB: PosedImage(camera, load)}),), (), points, None)
