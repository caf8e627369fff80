"""Serve a run to browsers: after training, or while it trains."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from mrgs.render import Model
from mrgs.runs.open import Run
from mrgs.scene import CameraResponse, Scene
from mrgs.training import StepStatistics, TrainConfig
from mrgs.viewer.gate import require_free
from mrgs.viewer.settings import Subject, shown_modalities
from mrgs.viewer.source import LiveSource

if TYPE_CHECKING:
    from mrgs.viewer.web import Viewer

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080

LIVE_REFRESH_S = 3.0
"""Time after which a browser at rest is told that the model has changed."""

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
        run: what ``load_run`` returns.
        scene: what ``run.load_scene`` returns; without it there are no photos and no captured
            cameras.
        host: the address to listen on.
        port: TCP port; 0 takes a free one.
        on_ready: called with the address to open.
        stop: ends the serving when it is set.

    Raises:
        RunError: the model is empty.
        ConfigError: the address or port cannot be used.
    """
    from mrgs.viewer.opening import open_viewer

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
        output: the run's folder.
        host: the address to listen on.
        port: TCP port; 0 takes a free one.
        on_ready: called with the address to open.
    """

    def __init__(
        self,
        output: str | Path,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        on_ready: Callable[[str], None] | None = None,
    ) -> None:
        require_free(host, port)
        self._output, self._host, self._port, self._on_ready = Path(output), host, port, on_ready
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
        """Start serving the model, which is compared with photos through ``response``; for
        ``train(on_model=...)``."""
        self._model = model
        try:
            from mrgs.marks.store import CameraSpread
            from mrgs.viewer.opening import board_of, start_at, start_camera, title_of
            from mrgs.viewer.web import Viewer

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
                subject, start_at(start_camera(scene, model), scene), self._host, self._port
            )
            if self._on_ready is not None:
                self._on_ready(self._viewer.url)
        except Exception as error:
            _log.warning("training continues without its viewer: %s", error)

    def on_step(self, statistics: StepStatistics) -> None:
        """Draw if a browser is connected and the time budget allows; for ``train(on_step=...)``.
        Raises nothing."""
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
        self._viewer = self._served = self._model = self._scene = (
            None  # a closed view keeps nothing in memory
        )
        try:
            if viewer is not None:
                viewer.close()
        except Exception as error:
            _log.warning("the view could not be closed: %s", error)
