"""Serve a run to browsers: after training, or while it trains."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from mrgs.errors import RunError, warn_user
from mrgs.marks.measure import MarkMeter
from mrgs.marks.photo_readings import PhotoReadings
from mrgs.marks.run_marks import MarkPicker
from mrgs.marks.store import CameraSpread, MarkStore
from mrgs.marks.uncertainty import UncertaintyMeter
from mrgs.pictures.page_data import camera_facts, world_facts
from mrgs.render import Model
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Camera, CameraResponse, Rendering, Scene
from mrgs.scene.preview import best_view
from mrgs.training import StepStatistics, TrainConfig
from mrgs.viewer.board import Appraiser, MarkBoard
from mrgs.viewer.panes import PaneImages, UncertaintyPictures, render_surface
from mrgs.viewer.settings import Subject, shown_modalities
from mrgs.viewer.source import LiveSource, TrainedSource
from mrgs.viewer.web import Viewer, require_free

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080

LIVE_REFRESH_S = 3.0
"""Interval at which browsers at rest are notified that the model has changed."""

_log = logging.getLogger(__name__)


def view(
    run: Run,
    scene: Scene | None,
    host: str = DEFAULT_HOST,
    port: int = DEFAULT_PORT,
    on_ready: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Serve a run to browsers until Ctrl-C.

    Args:
        scene: what ``run.load_scene`` returns; without it there are no photos and no captured
            cameras.
        port: TCP port; 0 takes a free one.
        on_ready: called with the address to open.
        stop: ends the serving when it is set.

    Raises:
        RunError: the model is empty.
        ConfigError: the address or port cannot be used.
    """
    viewer = open_viewer(run, scene, host, port)
    try:
        if on_ready is not None:
            on_ready(viewer.url)
        stop = stop or threading.Event()
        while not stop.wait(3600):
            pass
    except KeyboardInterrupt:
        pass
    finally:
        viewer.close()


class LiveView:
    """Shows a model while it trains; pass its methods to ``mrgs.training.train``.

    It takes at most 5 % of the training's time, and none while nobody looks. Whatever fails
    in it is logged, and the training continues.

    Args:
        port: TCP port; 0 takes a free one.
        on_ready: called with the address to open.
    """

    def __init__(
        self,
        output: str | Path,
        port: int = DEFAULT_PORT,
        on_ready: Callable[[str], None] | None = None,
    ) -> None:
        require_free(DEFAULT_HOST, port)
        self._output, self._port, self._on_ready = Path(output), port, on_ready
        self._source = LiveSource()
        self._model: Model | None = None
        self._viewer: Viewer | None = None
        self._served: Viewer | None = None
        self._scene: Scene | None = None
        self._max_steps = 0
        self._last_refresh = -math.inf

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def on_start(self, scene: Scene, config: TrainConfig) -> None:
        """Store the scene and the number of steps; for ``train(on_start=...)``."""
        self._scene, self._max_steps = scene, config.max_steps

    def on_model(self, model: Model, response: CameraResponse) -> None:
        """Start serving the model; ``response`` is for comparisons with photos; see ``train``."""
        self._model = model
        try:
            scene = self._scene
            temperature = None if scene is None else scene.temperature
            subject = Subject(
                title_of(self._output, "" if scene is None else scene.name),
                self._source,
                shown_modalities(model, scene),
                temperature,
                scene,
                self._output,
                "Training begins.",
                response,
            )
            if scene is not None:
                spread = CameraSpread.of_scene(scene)
                subject = replace(subject, board=board_of(subject, spread))
            self._viewer = self._served = Viewer(
                subject, start_at(start_camera(scene, model), scene), DEFAULT_HOST, self._port
            )
            if self._on_ready is not None:
                self._on_ready(self._viewer.url)
        except Exception as error:
            _log.warning("training continues without its viewer: %s", error)

    def on_step(self, statistics: StepStatistics) -> None:
        """Draw if a browser is connected and the time budget allows; for ``train(on_step=...)``."""
        viewer = self._viewer
        if viewer is None or self._model is None:
            return
        try:
            if not viewer.browsers:
                return
            self._source.serve(self._model)
            if time.perf_counter() - self._last_refresh >= LIVE_REFRESH_S:
                self._last_refresh = time.perf_counter()
                viewer.refresh(f"Training: step {statistics.step:,} of {self._max_steps:,}.")
        except Exception as error:
            _log.warning("training continues without its viewer: %s", error)
            self._viewer = None

    def close(self) -> None:
        """Stop the server and cancel what it waits for. Raises nothing."""
        self._source.close()
        viewer = self._served
        # A closed view keeps nothing in memory.
        self._viewer = self._served = self._model = self._scene = None
        try:
            if viewer is not None:
                viewer.close()
        except Exception as error:
            _log.warning("the view could not be closed: %s", error)


def open_viewer(run: Run, scene: Scene | None, host: str, port: int) -> Viewer:
    """Start to serve a run, and return at once; arguments and errors as for ``view``."""
    if len(run.model.gaussians) == 0:
        raise RunError(
            f"{run.folder.path}: the model has no Gaussians, so there is nothing to see; retrain it"
        )
    note = ""
    if run.folder.is_locked:
        step = f"step {run.facts.step:,} of {run.config.max_steps:,}"
        note = (
            f"Still training: this is the checkpoint of {step}. Open the run again for a newer one."
        )
        warn_user(f"{run.folder.path} is still training: showing its checkpoint of {step}")
    subject = Subject(
        title_of(run.folder.path, Path(run.facts.scene).name if scene is None else scene.name),
        TrainedSource(run.model),
        shown_modalities(run.model, scene),
        run.temperature,
        scene,
        run.folder.path,
        note,
        run.camera_response,
    )
    board = board_of(subject, CameraSpread.of_run(run), run)
    subject = replace(subject, board=board, uncertainty=uncertainty_of(subject, board))
    camera = start_camera(scene, run.model)
    viewer = Viewer(subject, start_at(camera, scene), host, port)
    viewer.warm_up(camera)
    return viewer


def title_of(folder: Path, scene: str) -> str:
    """Heading of a run's viewer: the names of the scene (empty if not known) and of the folder, by
    which runs of one scene differ; the folder's alone where it begins with the scene's."""
    own = folder.resolve().name
    return own if own.startswith(scene) else f"{scene}, {own}"


def board_of(subject: Subject, spread: CameraSpread, run: Run | None = None) -> MarkBoard:
    """The marks in a run's folder, measured in what is shown; the ``run`` if parts can be kept."""
    store, instruments = MarkStore(subject.folder, spread), partial(instruments_of, subject)
    if run is None or not isinstance(subject.source, TrainedSource):
        return MarkBoard(store, instruments)
    return MarkBoard(store, instruments, run, subject.source.show)


def instruments_of(subject: Subject) -> tuple[MarkPicker, Appraiser | None]:
    """See ``Instruments``."""

    def draw(camera: Camera) -> Rendering:
        return subject.source.run(lambda model: render_surface(model, camera, subject))

    scene, temperature = subject.scene, subject.temperature
    changes = not isinstance(subject.source, TrainedSource)  # what is found is of one step alone
    meter = MarkMeter.of(draw, temperature, scene, changes=changes)
    appraise: Appraiser | None = None
    if scene is not None and not changes:
        views = scene.survey_views(THERMAL)
        readings = PhotoReadings(draw, subject.camera_response, views, temperature)
        appraise = partial(UncertaintyMeter.of, readings, scene, temperature)
    return MarkPicker(meter, scene, by_photos=not changes), appraise


def uncertainty_of(subject: Subject, board: MarkBoard) -> Callable[[Camera], PaneImages] | None:
    """Draws the uncertainty that the board's marks have; None without thermal photos."""
    if board.uncertainty is None or THERMAL not in subject.modalities:
        return None
    return UncertaintyPictures(board, subject.source, subject.temperature).images


def start_camera(scene: Scene | None, model: Model) -> Camera:
    """The training view that shows most of the scene, or one towards the model's middle."""
    if scene is None:
        return camera_around(model.gaussians.means.detach().cpu().numpy())
    points = scene.points.positions
    near = points[~scene.reach.is_background(points)]
    return scene.train_cameras[best_view(scene.train_cameras, near if len(near) else points)]


def start_at(camera: Camera, scene: Scene | None) -> dict[str, Any]:
    """Where a page begins: at a camera, which turns about what all cameras look at."""
    cameras = [camera] if scene is None else scene.train_cameras
    return {"camera": camera_facts(camera), "world": world_facts(cameras)}


def camera_around(means: Float[np.ndarray, "n 3"]) -> Camera:
    """The first viewpoint for a model without known cameras: towards its middle; z is up."""
    centre = np.median(means, axis=0).astype(np.float64)
    radius = float(np.median(np.linalg.norm(means - centre, axis=1))) or 1.0
    position = centre + 2.5 * radius * np.array([1.0, -1.0, 0.6])
    return Camera.from_fov(800, 600, 63.7).look_at(position, centre)
