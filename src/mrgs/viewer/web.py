"""The web server: one model, any number of browsers. Needs viser; ``server.py`` checks
that it is installed."""

from __future__ import annotations

import io
import threading
import warnings
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import viser
from filelock import FileLock, Timeout

from mrgs.errors import ConfigError, MrgsWarning, RunError
from mrgs.render import Model
from mrgs.runs.baked import bake
from mrgs.runs.open import Run
from mrgs.scene import Scene
from mrgs.viewer.address import require_free
from mrgs.viewer.browser import Browser
from mrgs.viewer.cameras import Pose, pose_around, pose_at
from mrgs.viewer.settings import Subject, shown_modalities
from mrgs.viewer.source import TrainedSource
from mrgs.viewer.splats import BrowserSplats


class Viewer:
    """A web server that shows one model to any number of browsers.

    Args:
        subject: the model.
        start: first viewpoint of each browser.
        host: the address to listen on; anything but this computer's own makes the model visible to
            the network.
        port: TCP port; 0 takes a free one.
        splats: the model as plain splats; None if browsers cannot draw it.

    Raises:
        ConfigError: viser is not installed, or the address or port cannot be used.
    """

    def __init__(
        self,
        subject: Subject,
        start: Pose,
        host: str,
        port: int,
        splats: BrowserSplats | None = None,
    ) -> None:
        self._subject = subject
        self._start = start
        self._splats = splats
        self._browsers: dict[int, Browser] = {}
        self._lock = threading.Lock()
        self.note = subject.note
        self._server = _serve(host, port, subject.name)
        self._server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="medium"
        )
        self._server.gui.main_panel.dock_right()
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._disconnected)
        self.url = f"http://{host}:{self._server.get_port()}"

    def refresh(self, note: str) -> None:
        """Redraw every idle browser, with a new note at the top of its panel."""
        self.note = note
        for browser in self.browsers:
            browser.set_note(note)
            browser.refresh()

    @property
    def browsers(self) -> list[Browser]:
        """The browsers that are connected now."""
        with self._lock:
            return list(self._browsers.values())

    def close(self) -> None:
        """Stop the server and disconnect all browsers."""
        for browser in self.browsers:
            browser.close()
        with redirect_stdout(io.StringIO()):  # its farewell
            self._server.stop()

    def _connected(self, client: viser.ClientHandle) -> None:
        browser = Browser(client, self._subject, self._start, self.note, self._splats)
        with self._lock:
            self._browsers[client.client_id] = browser

    def _disconnected(self, client: viser.ClientHandle) -> None:
        with self._lock:
            browser = self._browsers.pop(client.client_id, None)
        if browser is not None:
            browser.close()


def open_viewer(run: Run, scene: Scene | None, host: str, port: int) -> Viewer:
    """Start to serve a run, and return at once; arguments and errors as for ``view``."""
    _require_gaussians(run.model, run.folder.path)
    note = ""
    if is_training(run.folder.path):
        step = f"step {run.facts.step:,} of {run.config.max_steps:,}"
        note = (
            f"Still training: this is the checkpoint of {step}. Open the run again for a newer one."
        )
        warnings.warn(
            f"{run.folder.path} is still training: showing its checkpoint of {step}",
            MrgsWarning,
            stacklevel=2,
        )
    source = TrainedSource(run.model)
    subject = Subject(
        run.folder.path.resolve().name,
        source,
        shown_modalities(run.model, scene),
        run.temperature,
        scene,
        run.folder.path,
        note,
        run.camera_response,
    )
    splats = None
    if scene is not None:
        cameras = scene.train_cameras
        splats = BrowserSplats(
            lambda: source.run(lambda model: bake(model, cameras, run.temperature))
        )
    return Viewer(subject, start_pose(scene, run.model), host, port, splats)


def is_training(folder: Path) -> bool:
    """Whether a process holds the run's lock."""
    lock_file = folder / ".lock"
    if not lock_file.exists():
        return False
    lock = FileLock(lock_file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return True
    except OSError:  # a folder that cannot be written is not being trained in
        return False
    lock.release()
    return False


def _require_gaussians(model: Model, path: Path) -> None:
    if len(model.gaussians) == 0:
        raise RunError(
            f"{path}: the model has no Gaussians, so there is nothing to see; retrain it"
        )


def _serve(host: str, port: int, title: str) -> viser.ViserServer:
    require_free(host, port)
    with redirect_stdout(io.StringIO()):  # its banner
        server: Any = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    if port not in (0, server.get_port()):
        server.stop()
        raise ConfigError(
            f"cannot listen on {host}:{port}: choose another port, or end what uses it",
            options=("port",),
        )
    return server


def start_pose(scene: Scene | None, model: Model) -> Pose:
    """The first viewpoint: that of the first training view, or towards the model's middle without a
    scene."""
    if scene is not None:
        return pose_at(scene.train[0], scene.train)
    return pose_around(model.gaussians.means.detach().cpu().numpy())
