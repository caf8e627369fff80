"""What the terminal says while nothing else can be seen."""

from __future__ import annotations

import builtins

import pytest
import torch

from mrgs.app import progress
from mrgs.app.progress import PrepareProgress
from mrgs.method.config import make_config
from mrgs.run_files.record import StepStatistics
from mrgs.scene import RGB, Camera, Pixels, PointCloud, PosedImage, Scene, View


def test_without_a_terminal_a_count_is_told_now_and_then_and_at_the_end(capsys):
    now = [0.0]
    with progress.progress_bar("rendering", clock=lambda: now[0]) as show:
        for done in range(1, 7):
            now[0] += 4
            show(done, 6)
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("rendering 3/6")
    assert "0:12 left" in first
    assert last == "rendering 6/6"


def test_a_bar_follows_any_function_of_the_package(capsys):
    now = [0.0]
    with progress.progress_bar("work", clock=lambda: now[0]) as show:
        for told in [(500, 900), (600, 900), ("reading", 0, 2), ("reading", 1, 2), (1, 2, "mesh")]:
            now[0] += 11
            show(*told)
    assert capsys.readouterr().out.splitlines() == [
        "work 500/900",
        "work 600/900 | 0:33 left",
        "work: reading 0/2",
        "work: reading 1/2 | 0:11 left",
        "work 1 of 2: mesh",
    ]


def test_in_a_notebook_the_bar_changes_in_place_without_widgets(capsys, monkeypatch):
    class ZMQInteractiveShell:
        """What Jupyter's kernel has by this name."""

    monkeypatch.setattr(builtins, "get_ipython", ZMQInteractiveShell, raising=False)
    now = [0.0]
    with progress.progress_bar("training", clock=lambda: now[0]) as show:
        for step in (1, 2, 3):
            now[0] += 0.25
            show(step, 3)
    assert capsys.readouterr().out.split("\r")[1:] == [
        "░" * 12 + " training",
        "████░░░░░░░░ training 1/3",
        "████████░░░░ training 2/3 | 0:00 left",
        "█" * 12 + " training 3/3".ljust(25),
        "█" * 12 + " training: 0:00\n",
    ]


def test_scoring_between_steps_leaves_the_speed_as_it_is(capsys):
    now = [0.0]
    shown = progress.TrainingProgress(clock=lambda: now[0])
    for step in range(1, 12):
        now[0] += 2
        shown.step(StepStatistics(step, 0.5, {}, None, 25, False))
        shown.paused()(now.__setitem__)(0, now[0] + 100)
    last = capsys.readouterr().out.splitlines()[-1]
    assert "0.5 steps/s" in last


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
