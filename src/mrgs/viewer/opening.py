"""A run as the viewer's subject, served."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from filelock import FileLock, Timeout

from mrgs.errors import RunError, warn_user
from mrgs.marks.emissivity import CaptureSettings
from mrgs.marks.measure import MarkMeter
from mrgs.marks.photo_readings import PhotoReadings
from mrgs.marks.run_marks import stereo_of, thermal_cameras
from mrgs.marks.store import CameraSpread, MarkStore
from mrgs.marks.surface import SurfaceRenderer, before_background
from mrgs.marks.uncertainty import Budget, UncertaintyMeter
from mrgs.pictures.stage import camera_facts, world_facts
from mrgs.render import Model
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Camera, Rendering, Scene
from mrgs.scene.preview import best_view
from mrgs.viewer.board import Appraiser, CachedMeter, MarkBoard
from mrgs.viewer.cameras import camera_around
from mrgs.viewer.panes import PaneImages, UncertaintyPictures
from mrgs.viewer.picking import render_surface
from mrgs.viewer.settings import Start, Subject, shown_modalities
from mrgs.viewer.source import TrainedSource
from mrgs.viewer.web import Viewer


def open_viewer(run: Run, scene: Scene | None, host: str, port: int) -> Viewer:
    """Start to serve a run, and return at once; arguments and errors as for ``view``."""
    _require_gaussians(run.model, run.folder.path)
    note = ""
    if is_training(run.folder.path):
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
    board = board_of(subject, CameraSpread.of_run(run))
    subject = replace(subject, board=board, uncertainty=uncertainty_of(subject, board))
    camera = start_camera(scene, run.model)
    viewer = Viewer(subject, start_at(camera, scene), host, port)
    viewer.warm_up(camera)
    return viewer


def title_of(folder: Path, scene: str) -> str:
    """Heading of a run's viewer: the scene's name, and that of the folder, which tells the runs of
    a scene apart; the folder's alone where it begins with the scene's, as by default.

    Args:
        folder: of the run.
        scene: name of the run's scene; empty if not known.
    """
    own = folder.resolve().name
    return own if own.startswith(scene) else f"{scene}, {own}"


def board_of(subject: Subject, spread: CameraSpread) -> MarkBoard:
    """The marks in a run's folder, measured in the model that is shown."""

    def draw(camera: Camera) -> Rendering:
        return subject.source.run(lambda model: render_surface(model, camera, subject))

    changes = not isinstance(subject.source, TrainedSource)  # what is found is of one step alone
    meter = (MarkMeter if changes else CachedMeter)(
        before_background(draw, subject.scene),
        subject.temperature,
        thermal_cameras(subject.scene),
        CaptureSettings.of(subject.scene),
    )
    stereo = None if changes else stereo_of(meter, subject.scene)
    appraise = None if changes else _appraiser(subject, draw)
    return MarkBoard(MarkStore(subject.folder, spread), meter, stereo, appraise)


def uncertainty_of(subject: Subject, board: MarkBoard) -> Callable[[Camera], PaneImages] | None:
    """Draws the uncertainty that the board's marks have; None without thermal photos."""
    if board.uncertainty is None or THERMAL not in subject.modalities:
        return None
    return UncertaintyPictures(board, subject.source, subject.temperature).images


def _appraiser(subject: Subject, draw: SurfaceRenderer) -> Appraiser | None:
    """None without photos."""
    scene, temperature = subject.scene, subject.temperature
    if scene is None:
        return None
    witnesses = PhotoReadings(draw, subject.camera_response, scene.train, temperature)
    return lambda survey: UncertaintyMeter(
        witnesses, None if temperature is None else Budget.of(scene, survey)
    )


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


def start_camera(scene: Scene | None, model: Model) -> Camera:
    """The training view that shows most of the scene; without a scene, one towards the model's
    middle."""
    if scene is None:
        return camera_around(model.gaussians.means.detach().cpu().numpy())
    points = scene.points.positions
    near = points[~scene.reach.is_background(points)]
    return scene.train_cameras[best_view(scene.train_cameras, near if len(near) else points)]


def start_at(camera: Camera, scene: Scene | None) -> Start:
    """Begin at a camera, and turn about what all cameras look at."""
    return Start(
        camera_facts(camera), world_facts([camera] if scene is None else scene.train_cameras)
    )


def _require_gaussians(model: Model, path: Path) -> None:
    if len(model.gaussians) == 0:
        raise RunError(
            f"{path}: the model has no Gaussians, so there is nothing to see; retrain it"
        )
