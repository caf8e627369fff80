"""MrGS: posed RGB and thermal photos in, one 3D Gaussian model out that renders novel views in
colour and in °C. The names below are imported on first use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mrgs.system.lazy import lazy_imports

if TYPE_CHECKING:
    from mrgs import data as data
    from mrgs import errors as errors
    from mrgs import export as export
    from mrgs import method as method
    from mrgs import pipeline as pipeline
    from mrgs import prepare as prepare
    from mrgs import runs as runs
    from mrgs import scene as scene
    from mrgs import viewer as viewer
    from mrgs.app.progress import progress_bar as progress_bar
    from mrgs.data import load_scene as load_scene
    from mrgs.errors import MrgsError as MrgsError
    from mrgs.errors import MrgsWarning as MrgsWarning
    from mrgs.evaluation import evaluate_run as evaluate_run
    from mrgs.evaluation import render_run as render_run
    from mrgs.export.write import export_run as export_run
    from mrgs.marks.run_marks import RunMarks as RunMarks
    from mrgs.marks.run_marks import open_marks as open_marks
    from mrgs.method.density import Strategy as Strategy
    from mrgs.method.losses.term import Term as Term
    from mrgs.report import report_run as report_run
    from mrgs.report.changes import diff_runs as diff_runs
    from mrgs.runs.open import Run as Run
    from mrgs.runs.open import load_run as load_run
    from mrgs.runs.open import open_run as open_run
    from mrgs.runs.registry import Method as Method
    from mrgs.runs.registry import register as register
    from mrgs.runs.train import LiveRun as LiveRun
    from mrgs.runs.train import train as train
    from mrgs.runs.train import train_steps as train_steps
    from mrgs.scene import RGB as RGB
    from mrgs.scene import THERMAL as THERMAL
    from mrgs.scene import Camera as Camera
    from mrgs.scene import Rendering as Rendering
    from mrgs.scene import Scene as Scene
    from mrgs.training import make_config as make_config

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_imports(__name__)
