"""Preparation of a scene from a folder of photos, stage by stage."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from mrgs.data.transforms import TRANSFORMS
from mrgs.errors import RunError, scene_error
from mrgs.prepare import stages
from mrgs.prepare.contract import CACHE_FOLDER, Preparation, Progress, Reconstruction, StageReport
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.page.write import PAGE, write_page
from mrgs.prepare.rig.calibrate import calibrate_rig
from mrgs.prepare.scene_files import write_scene
from mrgs.prepare.sfm.reconstruct import reconstruct
from mrgs.prepare.thermal_camera import Calibrate
from mrgs.prepare.work import Work
from mrgs.system.atomic import LOCK, TEMPORARY, locked, remove_abandoned, write_text
from mrgs.system.disk import warn_if_short

GROWTH = 2
"""Size of the images and intermediate results over that of the photos, roughly."""

MARKER = "README.txt"
"""File in the cache by which the user and later calls know that the folder is the program's own."""

MARKER_TEXT = """mrgs prepare keeps the results of its stages here. Run the same command again to
resume. The images, transforms.json and prepare.html in the parent folder are generated too. To
start over, delete the parent folder.
"""


@dataclass(frozen=True)
class Steps:
    """The slow steps of ``prepare``; others may be given in their place."""

    reconstruct: Callable[..., Reconstruction] = reconstruct
    calibrate_rig: Calibrate = calibrate_rig
    write_scene: Callable[[Work], None] = write_scene
    write_page: Callable[..., Path] = write_page


_STEPS = Steps()


def prepare(
    photos: str | Path,
    scene: str | Path,
    options: PrepareOptions | None = None,
    progress: Progress | None = None,
    report: Callable[[StageReport], None] | None = None,
    *,
    trains: bool = False,
    steps: Steps = _STEPS,
) -> Preparation:
    """Make a scene for ``train`` from a folder of photos, and a page that shows the results.

    The photos are only read. Results are kept in ``SCENE/prepare``: the same call resumes after an
    interruption, and repeats only what depends on a changed photo or option.

    Args:
        scene: folder to make, or one that an earlier call made.
        progress: called with "stage: step", the number of the step's parts that are done, and of
            all (0 and 0 if not known).
        report: called with the report of each finished stage.
        trains: whether the caller goes on to train by itself, as ``run_pipeline`` does; the page
            then does not name the command that trains.
        steps: other functions for the slow steps.

    Raises:
        SceneError: the photos cannot be used: no pairs, fewer than three poses, or the thermal
            camera cannot be calibrated.
        RunError: the scene's folder cannot be written, holds something else, or is in use.
        ConfigError: an option that does not fit the photos.
    """
    work = Work(Path(photos).resolve(), Path(scene), options or PrepareOptions(), trains)
    work.on_progress = progress or work.on_progress
    work.on_report = report or work.on_report
    _check_folders(work.photos, work.scene)
    with preparing(work.cache.folder):
        remove_abandoned(work.scene)
        if not (work.cache.folder / MARKER).exists():
            write_text(work.cache.folder / MARKER, MARKER_TEXT)
        work.run("pairs", stages.pairs)
        if not (work.scene / TRANSFORMS).exists():
            files = [file for pair in work.pairing.pairs for file in pair.photos.values()]
            needed = GROWTH * sum(file.stat().st_size for file in files if file.is_file())
            warn_if_short(work.scene, needed, f"the images of {len(files)} photos")
        work.run("images", stages.images)
        with stages.page_on_error(work, steps.write_page):
            work.run("poses", stages.poses, steps.reconstruct)
            work.run("scale and north", stages.scale_and_north)
            work.run("thermal camera", stages.thermal_camera, steps.calibrate_rig)
        work.run("scene files", stages.scene_files, steps.write_scene)
        work.run("page", stages.page, steps.write_page)
    return Preparation(work.scene, work.scene / PAGE, tuple(work.reports), work.skipped)


def _check_folders(photos: Path, scene: Path) -> None:
    """The photos' folder must be there; the scene's folder must be new or made by ``prepare``, and
    neither inside the other."""
    if not photos.is_dir():
        raise scene_error(photos, "not a folder; give the photos' folder")
    own = scene.resolve()
    if own.is_relative_to(photos) or photos.is_relative_to(own):
        raise RunError(
            f"{scene} and the photos are inside one another: choose a separate scene folder"
        )
    try:
        is_own = (own / CACHE_FOLDER / MARKER).is_file() or _is_unclaimed(own)
    except OSError as error:
        raise RunError(
            f"{scene} cannot be read ({error.strerror}): choose another folder"
        ) from None
    if own.is_dir() and not is_own:
        raise RunError(
            f"{scene} holds something that `mrgs prepare` did not make: choose a new folder"
        )


def _is_unclaimed(folder: Path) -> bool:
    """Whether a folder is missing, or empty but for what is left by an earlier call that ended
    before it could mark the folder as its own."""
    cache = folder / CACHE_FOLDER
    if folder.is_dir() and any(path != cache for path in folder.iterdir()):
        return False
    own = (LOCK, TEMPORARY)
    return not cache.exists() or all(path.name.startswith(own) for path in cache.iterdir())


def preparing(folder: Path) -> AbstractContextManager[None]:
    """Around the work in a cache folder, which is made; RunError if another process works in it, or
    it cannot be made."""
    text = "is being prepared by another run: wait for it, or choose another folder"
    return locked(folder / LOCK, RunError(f"{folder.parent} {text}"))
