"""From a folder of photos to a scene, one stage after the other."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mrgs.data.files import scene_error
from mrgs.errors import RunError, SceneError
from mrgs.prepare import pipeline
from mrgs.prepare.contract import (
    Development,
    Georeference,
    Pairing,
    Preparation,
    Progress,
    Reconstruction,
    StageReport,
    TooFewPosesError,
)
from mrgs.prepare.georeference import apply
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.page import write_page
from mrgs.prepare.stages import WORK, Stages, only_one
from mrgs.prepare.thermal_camera import with_scale_of_target
from mrgs.system.atomic import replacing

MARK = "README.txt"
MARK_TEXT = """mrgs prepare keeps here what its stages have found: run the same command
again to resume. The images, transforms.json and prepare.html of the folder above are its
own too. To start over, delete that folder.
"""


def prepare(
    photos: str | Path,
    scene: str | Path,
    options: PrepareOptions | None = None,
    progress: Progress | None = None,
    report: Callable[[StageReport], None] | None = None,
) -> Preparation:
    """Make a scene that ``train`` takes from a folder of photos, and a page that shows what was
    understood.

    The photos are only read. What a stage finds is kept in ``SCENE/prepare``: the same call goes on
    where it was cut off, and does again only what follows from a photo or an option that has
    changed.

    Args:
        photos: the folder of the photos.
        scene: the folder to make, or one that an earlier call made.
        options: what is known of the photos.
        progress: called with "stage: step", and how many of the step's parts are done and there are
            (0 of 0 where that is not known).
        report: called with each stage's report when it is done.

    Raises:
        SceneError: the photos cannot be used: no pairs, fewer than three poses, no thermal camera.
        RunError: the scene's folder cannot be written, holds something else, or is in use.
        ConfigError: an option that does not fit the photos.
    """
    photos, scene, options = Path(photos).resolve(), Path(scene), options or PrepareOptions()
    _check_folders(photos, scene)
    with only_one(scene / WORK):
        _mark(scene / WORK)
        stages = Stages(scene / WORK, progress, report)
        pairing = stages.run(pipeline.pairs(photos, options))
        development = stages.run(pipeline.photos(photos, pairing, scene, options))
        return _with_poses(scene, pairing, development, stages, options)


def _with_poses(
    scene: Path, pairing: Pairing, development: Development, stages: Stages, options: PrepareOptions
) -> Preparation:
    """From images to a scene; where that cannot go on, to a page of what there is.

    Raises:
        SceneError: no poses, or no thermal camera.
    """
    digests = pipeline.contents(scene, development)
    found = place = None
    try:
        found = stages.run(pipeline.poses(pairing, development, digests, scene, options))
        place = stages.run(pipeline.scale_and_north(development, found, options))
        posed = apply(place, found)
        rig = stages.run(
            pipeline.thermal_camera(scene, development, digests, posed, place, options)
        )
    except SceneError as error:
        reached = found if found is None or place is None else apply(place, found)
        shown = _page_so_far(scene, pairing, development, stages, error, reached, place)
        raise (
            error
            if shown is None
            else SceneError(f"{error}; {shown} shows what was understood so far")
        ) from error
    place, rig = with_scale_of_target(place, rig)
    posed = apply(place, found)
    stages.run(pipeline.scene_files(scene, development, posed, rig, place, options))
    left_out = (*pairing.left_out, *development.left_out, *found.failed)
    page = stages.run(
        pipeline.page(scene, stages.reports, left_out, development, digests, posed, rig, place)
    )
    return Preparation(scene, scene / page, tuple(stages.reports), left_out)


def _page_so_far(
    scene: Path,
    pairing: Pairing,
    development: Development,
    stages: Stages,
    error: SceneError,
    reconstruction: Reconstruction | None,
    place: Georeference | None,
) -> Path | None:
    """The page of a preparation that cannot go on: most often the photos show why. None if it
    cannot be written."""
    stages.forget("page")
    reports = [*stages.reports, StageReport("stopped", (str(error),), (str(error),))]
    failed = error.failed if isinstance(error, TooFewPosesError) else ()
    left_out = (*pairing.left_out, *development.left_out, *failed)
    with suppress(OSError):  # of an earlier call, with other photos or options
        (scene / "transforms.json").unlink(missing_ok=True)
    try:
        return write_page(
            scene, reports, development, reconstruction, None, place, left_out=left_out
        )
    except RunError:  # the disk is full
        return None


def _mark(work: Path) -> None:
    """Say whose folder this is, to the user and to later calls."""
    mark = work / MARK
    if not mark.exists():
        with replacing(mark) as temporary:
            temporary.write_text(MARK_TEXT, encoding="utf-8")


def _check_folders(photos: Path, scene: Path) -> None:
    """Nothing of the user's may be taken for the program's own, or the other way round.

    Raises:
        SceneError: there are no photos.
        RunError: the scene's folder holds something else, or one of the folders lies in the other.
    """
    if not photos.is_dir():
        raise scene_error(photos, "is not a folder; give the folder that holds the photos")
    own = scene.resolve()
    if own.is_relative_to(photos) or photos.is_relative_to(own):
        raise RunError(
            f"{scene} and the photos lie in one another: choose a folder beside the photos"
        )
    try:
        foreign = own.is_dir() and not (own / WORK / MARK).is_file() and any(own.iterdir())
    except OSError as error:
        raise RunError(
            f"{scene} cannot be read ({error.strerror}): choose another folder"
        ) from None
    if foreign:
        raise RunError(
            f"{scene} holds something that `mrgs prepare` did not make: choose a new folder"
        )
