"""The stages of ``prepare``, in order. Each adds its result to the work, from the cache unless
something that it depends on has changed, and returns a summary."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from PIL import Image

from mrgs.check import fast_problems
from mrgs.data import load_scene
from mrgs.data.files import composed
from mrgs.data.kept import digest, stamps
from mrgs.data.transforms import TRANSFORMS
from mrgs.errors import RunError, SceneError
from mrgs.pictures.settings import settings_of, settings_text
from mrgs.prepare.contract import (
    CACHE_FOLDER,
    ConvertedPhotos,
    Georeference,
    Pairing,
    Reconstruction,
    StageReport,
    StageSummary,
    TooFewPosesError,
)
from mrgs.prepare.control import at_chequers, place_by_control, read_control
from mrgs.prepare.convert import convert_photos
from mrgs.prepare.existing import existing_poses
from mrgs.prepare.georeference import georeference
from mrgs.prepare.pairs.find import find_pairs
from mrgs.prepare.rig.contract import FEWEST_MATCHES, RigCalibration
from mrgs.prepare.sfm.job import MODEL_FOLDER, SFM_FOLDER
from mrgs.prepare.sfm.reconstruct import adjusted
from mrgs.prepare.thermal_camera import (
    Calibrate,
    calibrate_thermal_camera,
    in_metres_of_target,
    read_thermal_camera,
    stated_field_of_view,
)
from mrgs.prepare.work import Work
from mrgs.scene import THERMAL, Modality
from mrgs.scene.camera import field_of_view
from mrgs.system.wording import counted, number_text


def pairs(work: Work) -> StageSummary:
    """Which photos belong together; depends on the names and times of all files."""
    options, table = work.options, work.options.pair_table
    chosen = options.pairs, options.tolerance_s, options.camera
    table_content = None if table is None else (table.resolve(), digest(table))
    work.pairing = work.cache.get(
        "pairs",
        Pairing,
        (work.photos, stamps(work.photos), table_content, *chosen),
        lambda: find_pairs(work.photos, options, work.progress),
    )
    return summarise_pairs(work.pairing)


def images(work: Work) -> StageSummary:
    """The photos of all pairs as colours and temperatures; each pair is cached on its own."""
    work.images = convert_photos(
        work.pairing,
        work.scene,
        work.options.overrides,
        work.cache,
        work.progress,
        turn=work.options.poses is None,  # given poses are those of the images as stored
    )
    summary = summarise_photos(work.images)
    if (control := work.options.control) is not None:
        marked = read_control(control, _posed_photos(work))
        work.control, warnings = at_chequers(marked, partial(_grey, work))
        summary = replace(summary, warnings=summary.warnings + warnings)
    return summary


def _grey(work: Work, view: str) -> Float32[np.ndarray, "h w"]:
    """The image of a view that gets a pose, as brightness."""
    _, images = work.images.to_pose()
    with Image.open(work.scene / images[view].file) as image:
        return np.asarray(image.convert("F"))


def _posed_photos(work: Work) -> dict[str, tuple[str, tuple[int, int]]]:
    """View and size of the images that get poses, by path, name and stem of the photo and by the
    view's name, in lower case, as far as these are of one."""
    found: dict[str, set[tuple[str, tuple[int, int]]]] = {}
    photos = {pair.name: pair.photos for pair in work.pairing.pairs}
    modality, images = work.images.to_pose()
    for view, image in images.items():
        file = photos[view].get(modality, photos[view][THERMAL])  # RGB may be within the thermal
        path = file.relative_to(work.photos).as_posix()
        for name in (path, file.name, file.stem, view):
            found.setdefault(composed(name).lower(), set()).add((view, image.size))
    return {name: photo for name, (photo, *others) in found.items() if not others}


def poses(work: Work, reconstruct: Callable[..., Reconstruction]) -> StageSummary:
    """Camera poses, given or by ``reconstruct``; they depend on the posed images and their GPS
    positions alone, so that other temperatures do not matter."""
    modality, posed = work.images.to_pose()
    files = {name: work.scene / image.file for name, image in posed.items()}
    gps, view_deg, given = work.gps, None, None
    if modality == THERMAL:
        view_deg = work.options.thermal_fov_deg or stated_field_of_view(work.images.views)
    if work.options.poses is not None:
        two_cameras = modality != THERMAL and not work.options.one_camera
        folder, pairs = work.options.poses, work.pairing.pairs
        sizes = {name: image.size for name, image in posed.items()}
        given = existing_poses(folder, files, sizes, pairs=pairs, two_cameras=two_cameras)
        given = replace(given, images=modality)

    def find() -> Reconstruction:
        cache = work.scene / CACHE_FOLDER
        return given or reconstruct(
            files, cache, work.progress, modality=modality, gps=gps, field_of_view_deg=view_deg
        )

    work.poses = work.cache.get("poses", Reconstruction, (posed, given, gps, view_deg), find)
    return summarise_poses(work.poses)


def scale_and_north(work: Work) -> StageSummary:
    """From the world of the poses to the scene's world: metres, and axes east, north, up."""
    found, gps, distance = work.posed, work.gps, work.options.known_distance
    as_given, control = work.options.poses is not None, work.control
    sfm = work.scene / CACHE_FOLDER / SFM_FOLDER

    def place() -> tuple[Reconstruction | None, Georeference]:
        if control is None:
            return None, georeference(found, gps, distance, as_given=as_given)
        adjust = None
        if not as_given and (sfm / MODEL_FOLDER).is_dir():
            adjust = partial(adjusted, sfm, found.images, work.progress)
        moved, placed = place_by_control(found, control, gps, adjust, as_given=as_given)
        if distance is None:
            return moved, placed
        unused = "The known distance is not used beside control points and scale bars."
        return moved, replace(placed, warnings=(*placed.warnings, unused))

    moved, work.georeference = work.cache.get(
        "scale and north",
        tuple[Reconstruction | None, Georeference],
        (found, gps, distance, as_given, control),
        place,
    )
    work.poses = moved or work.poses
    return StageSummary((work.georeference.text,), work.georeference.warnings)


def thermal_camera(work: Work, calibrate: Calibrate) -> StageSummary:
    """Intrinsics and extrinsics of the thermal camera; a target may also rescale the world."""
    options, posed, metric = work.options, work.posed, work.metric
    file = options.thermal_camera
    given = None if file is None else read_thermal_camera(file)
    known = (options.one_camera, options.thermal_fov_deg, options.target, given)
    images = [(view.name, view.images) for view in work.images.views]
    found = work.cache.get(
        "thermal camera",
        RigCalibration | None,
        (posed, metric, images, known),
        lambda: calibrate_thermal_camera(work, calibrate, given),
    )
    if work.georeference is not None:
        work.georeference, work.rig = in_metres_of_target(work.georeference, found)
    return summarise_thermal_camera(found, posed.images, metric)


def scene_files(work: Work, write_scene: Callable[[Work], None]) -> StageSummary:
    """``transforms.json``, points and bounds; ``load_scene`` reads them once as a check, with the
    problems that training would find."""

    def write() -> StageSummary:
        write_scene(work)
        read = load_scene(work.scene)
        bounds = "no °C"
        if read.temperature is not None:
            limits = f"{read.temperature.min_c:g} °C to {read.temperature.max_c:g} °C"
            bounds = limits.replace("-", "−")
        line = f"{len(read.train)} training views, {len(read.eval)} held out, {bounds}."
        problems = (f"{each.text} {each.remedy}".rstrip() for each in fast_problems(read))
        return StageSummary((line,), tuple(problems))

    split, bounds_c = work.options.eval_every, work.options.overrides.bounds_c
    return work.cache.get(
        "scene files",
        StageSummary,
        (work.images, work.posed, work.rig, work.georeference, split, bounds_c),
        write,
        lambda _: [work.scene / TRANSFORMS],
    )


def page(work: Work, write_page: Callable[..., Path]) -> StageSummary:
    """The HTML page that shows the results, and what only the page could see."""
    reported = [(report.title, report.lines, report.warnings) for report in work.reports]
    written = work.cache.get(
        "page",
        StageSummary,
        (reported, work.skipped, work.images, work.posed, work.rig, work.georeference, work.trains),
        lambda: StageSummary((write_page(work).name,), work.found_by_page),
        lambda written: [work.scene / written.lines[0]],
    )
    return replace(written, lines=(f"{work.scene / written.lines[0]}",))


@contextmanager
def page_on_error(work: Work, write_page: Callable[..., Path]) -> Iterator[None]:
    """On an error of the photos, write a page of the results so far: it often shows the cause. The
    SceneError is that of the block; it names the page if there is one."""
    try:
        yield
    except SceneError as error:
        work.cache.forget("page")
        work.reports.append(StageReport("stopped", (str(error),), (str(error),)))
        with suppress(OSError):  # of an earlier call, with other photos or options
            (work.scene / TRANSFORMS).unlink(missing_ok=True)
        try:
            shown = write_page(work, error.failed if isinstance(error, TooFewPosesError) else ())
        except (RunError, SceneError):  # the disk is full, or a photo cannot be shown
            raise error from None
        message = f"{error}; {shown} shows what was found so far"
        raise SceneError(message, options=error.options) from error


SCALE_TOLERANCE = 0.03
"""Two sources of the scene's scale may differ by this share."""


def summarise_pairs(pairing: Pairing) -> StageSummary:
    """Number of pairs, or of photos without partners, and the rule that found them."""
    has_pairs = any(pair.embedded or len(pair.photos) > 1 for pair in pairing.pairs)
    noun = "pair" if has_pairs or not pairing.pairs else "photo"
    lines = [f"{counted(len(pairing.pairs), noun)}. {pairing.rule}"]
    if pairing.skipped:
        lines.append(f"{counted(len(pairing.skipped), 'file')} skipped.")
    return StageSummary(tuple(lines), pairing.warnings)


def summarise_photos(photos: ConvertedPhotos) -> StageSummary:
    """Cameras and temperatures of the photos; each warning once, with the number of its photos."""
    views = photos.views
    ranges = [view.range_c for view in views if view.range_c is not None]
    cameras = sorted({view.facts.camera for view in views if view.facts.camera is not None})
    facts = [counted(len(views), "view"), *cameras[:3]]
    if ranges:
        low, high = min(low for low, _ in ranges), max(high for _, high in ranges)
        facts.append(f"{number_text(low, 1)} °C to {number_text(high, 1)} °C")
    if len(ranges) < len(views):
        facts.append(
            "no temperatures" if not ranges else f"{len(views) - len(ranges)} without temperatures"
        )
    lines = [", ".join(facts) + "."]
    if ranges:
        known = settings_text(settings_of([view.facts.record for view in views]), "given by you")
        lines.append(
            f"Temperatures computed with {known}."
            if known
            else "The photos' files do not say with which emissivity, reflected temperature and "
            "distance the temperatures were computed."
        )
    if photos.skipped:
        lines.append(f"{counted(len(photos.skipped), 'pair')} skipped.")
    by_text: dict[str, list[str]] = {}
    for view in views:
        for text in view.facts.warnings:
            by_text.setdefault(text, []).append(view.name)
    repeated = (
        f"{names[0] if len(names) == 1 else counted(len(names), 'photo')}: {text}"
        for text, names in by_text.items()
    )
    return StageSummary(tuple(lines), (*photos.warnings, *repeated))


def summarise_poses(reconstruction: Reconstruction) -> StageSummary:
    """Source of the poses and their reprojection error."""
    lines = [reconstruction.source]
    if reconstruction.reprojection_px is not None:
        lines[0] += f" Reprojection error {reconstruction.reprojection_px:.2f} px."
    if reconstruction.failed:
        lines.append(f"{counted(len(reconstruction.failed), 'image')} without a pose.")
    return StageSummary(tuple(lines), reconstruction.warnings)


def summarise_thermal_camera(
    rig: RigCalibration | None, posed: Modality, metric: bool
) -> StageSummary:
    """Field of view, offset and residuals of the thermal camera; ``rig`` is None without a second
    camera, ``metric`` whether the scene's unit is the metre."""
    if rig is None:
        alone = posed == THERMAL
        return StageSummary(
            ("There are only thermal images." if alone else "One camera took both images.",)
        )
    by_target = None if rig.target is None else rig.target.metres_per_unit
    width_deg = math.degrees(field_of_view(rig.lens.width, rig.lens.fx))
    offset = float(rig.extrinsics[:3, 3].norm())
    metres = 1.0 if metric else by_target
    length = f"{offset:.3g} scene units" if metres is None else f"{100 * offset * metres:.1f} cm"
    lines = [
        f"{width_deg:.1f}° wide, {length} from the RGB camera; residual "
        f"{rig.residual_px[0]:.2f} px, uncertainty ±{rig.uncertainty_px:.2f} px."
    ]
    turn_rad = math.atan2(rig.extrinsics[1, 0].item(), rig.extrinsics[0, 0].item())
    if quarters := abs(round(2 * turn_rad / math.pi)):
        lines.append(
            f"The thermal images are turned by about {90 * quarters}° relative to the RGB images; "
            f"the offset includes this turn."
        )
    if rig.target is not None:
        pairs, residual_px = counted(rig.target.pairs, "pair"), rig.target.residual_px[0]
        lines.append(f"The target is in {pairs}; residual {residual_px:.2f} px.")
    few = (view for view in rig.views if view.matches < FEWEST_MATCHES)
    plain = [view.name for view in few if math.isfinite(view.uncertainty_px)]
    if plain:
        lines.append(
            f"{counted(len(plain), 'thermal image')} ({', '.join(plain)}) with hardly an edge of "
            f"their photos placed by the rig alone: look at them on the page."
        )
    warnings = rig.warnings
    if by_target and not metric:
        lines.append("The target gives the scale: the scene is in metres.")
    elif by_target and abs(by_target - 1) > SCALE_TOLERANCE:
        warnings += (
            f"The target's squares make the scene {by_target:.2f} times as large as GPS, control "
            f"points or the known distance: check the side of a square, and these.",
        )
    return StageSummary(tuple(lines), warnings)
