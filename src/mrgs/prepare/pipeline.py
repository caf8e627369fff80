"""The stages of ``prepare``: what each follows from, how it is made, and what it says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mrgs.data import load_scene
from mrgs.prepare.contract import (
    Development,
    Georeference,
    LeftOut,
    Pairing,
    Progress,
    Reconstruction,
    StageReport,
)
from mrgs.prepare.develop import develop
from mrgs.prepare.existing import existing_poses
from mrgs.prepare.georeference import georeference
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.page import write_page
from mrgs.prepare.pairs import find_pairs
from mrgs.prepare.rig import RigCalibration
from mrgs.prepare.scene_files import write_scene
from mrgs.prepare.sfm import reconstruct
from mrgs.prepare.stages import WORK, Stage, Told, digest, stamps
from mrgs.prepare.tell import tell_pairs, tell_photos, tell_place, tell_poses, tell_thermal_camera
from mrgs.prepare.thermal_camera import calibrate_thermal_camera
from mrgs.system.atomic import remove

Contents = Mapping[str, str]
"""Digests of images by their paths in the scene's folder."""


def pairs(folder: Path, options: PrepareOptions) -> Stage[Pairing]:
    """Which photos belong together; depends on the names and times of all files."""
    table = options.pair_table
    how = (
        options.pairs,
        None if table is None else (table.resolve(), digest(table)),
        options.tolerance_s,
    )
    return Stage(
        "pairs",
        Pairing,
        (folder, stamps(folder), how),
        lambda progress: find_pairs(
            folder, rule=options.pairs, table=table, tolerance_s=options.tolerance_s
        ),
        tell_pairs,
    )


def photos(
    folder: Path, pairing: Pairing, scene: Path, options: PrepareOptions
) -> Stage[Development]:
    """Colours and temperatures; depends on the photos that are in pairs."""
    used = {path for pair in pairing.pairs for path in (pair.rgb, pair.thermal)}
    turns = options.poses is None  # poses from elsewhere are those of the images as they are stored

    def make(progress: Progress) -> Development:
        remove(scene / "transforms.json")  # the images that it describes are about to change
        return develop(pairing, scene, options.overrides, progress, turns=turns)

    return Stage(
        "photos",
        Development,
        (
            pairing.pairs,
            [stamp for stamp in stamps(folder) if folder / stamp[0] in used],
            options.overrides,
            turns,
        ),
        make,
        tell_photos,
        lambda made: [
            scene / image
            for view in made.views
            for image in (view.rgb, view.thermal)
            if image is not None
        ],
    )


def contents(scene: Path, development: Development) -> Contents:
    """Digests of the scene's images, by their paths in its folder."""
    names = [
        name for view in development.views for name in (view.rgb, view.thermal) if name is not None
    ]
    return {name: digest(scene / name) for name in names}


def poses(
    pairing: Pairing,
    development: Development,
    digests: Contents,
    scene: Path,
    options: PrepareOptions,
) -> Stage[Reconstruction]:
    """Where the cameras were; depends on the content of the images, so that other temperatures
    leave it alone."""
    alone = all(view.rgb is None for view in development.views)
    images = {
        view.name: scene / image
        for view in development.views
        if (image := view.thermal if alone else view.rgb) is not None
    }
    cameras = dict.fromkeys(images, "one")  # sets of several cameras have been refused
    given = options.poses

    def make(progress: Progress) -> Reconstruction:
        if given is None:
            return reconstruct(images, cameras, scene / WORK, progress, stretch=alone)
        return replace(_given_poses(given, pairing, images), images="thermal" if alone else "rgb")

    posed = {name: digests[path.relative_to(scene).as_posix()] for name, path in images.items()}
    known = None
    if given is not None:
        known = (pairing.pairs, given.resolve(), stamps(given) if given.is_dir() else digest(given))
    return Stage("poses", Reconstruction, (posed, known), make, tell_poses)


def _given_poses(given: Path, pairing: Pairing, images: Mapping[str, Path]) -> Reconstruction:
    """The poses of the photos: the user's files know them by the names that they had."""
    photos = {
        pair.name: (pair.rgb or pair.thermal).stem for pair in pairing.pairs if pair.name in images
    }
    if len(set(photos.values())) < len(photos):  # of several folders
        photos = {name: name for name in photos}
    found = existing_poses(given, {photo: images[name] for name, photo in photos.items()})
    names = {photo: name for name, photo in photos.items()}
    return replace(
        found,
        viewmats={names[photo]: viewmat for photo, viewmat in found.viewmats.items()},
        lenses={names[photo]: lens for photo, lens in found.lenses.items()},
        failed=tuple(LeftOut(names[item.name], item.reason) for item in found.failed),
    )


def scale_and_north(
    development: Development, found: Reconstruction, options: PrepareOptions
) -> Stage[Georeference]:
    """The metre and the axes of the scene."""
    gps = {view.name: view.exif.gps for view in development.views if view.exif.gps is not None}
    return Stage(
        "scale and north",
        Georeference,
        (found, gps, options.known_distance, options.poses is not None),
        lambda progress: georeference(
            found, gps, options.known_distance, as_given=options.poses is not None
        ),
        tell_place,
    )


def thermal_camera(
    scene: Path,
    development: Development,
    digests: Contents,
    reconstruction: Reconstruction,
    place: Georeference,
    options: PrepareOptions,
) -> Stage[RigCalibration | None]:
    """The thermal camera; None where one camera serves both images."""
    file = options.thermal_camera
    known = (
        options.one_camera,
        options.thermal_fov_deg,
        options.target,
        None if file is None else digest(file),
    )
    return Stage(
        "thermal camera",
        RigCalibration | None,
        (reconstruction, place.metric, digests, known),
        lambda progress: calibrate_thermal_camera(
            scene, development, reconstruction, place.metric, options, progress
        ),
        lambda rig: tell_thermal_camera(rig, reconstruction.images == "thermal", place.metric),
    )


@dataclass(frozen=True)
class WrittenScene:
    """What a training will find: numbers of views, and the coldest and the hottest temperature in
    °C."""

    train: int
    eval: int
    range_c: tuple[float, float] | None


def scene_files(
    scene: Path,
    development: Development,
    reconstruction: Reconstruction,
    rig: RigCalibration | None,
    place: Georeference,
    options: PrepareOptions,
) -> Stage[WrittenScene]:
    """The scene as it is read by all other commands; it is read once here, so that it surely can
    be."""
    bounds = options.overrides.bounds_c

    def make(progress: Progress) -> WrittenScene:
        write_scene(
            scene,
            development,
            reconstruction,
            rig,
            place,
            eval_every=options.eval_every,
            bounds=bounds,
        )
        read = load_scene(scene)
        span = read.temperature
        return WrittenScene(
            len(read.train), len(read.eval), None if span is None else (span.min_c, span.max_c)
        )

    return Stage(
        "scene",
        WrittenScene,
        (development, reconstruction, rig, place, options.eval_every, bounds),
        make,
        _tell_scene,
        lambda written: [scene / "transforms.json"],
    )


def page(
    scene: Path,
    reports: Sequence[StageReport],
    left_out: Sequence[LeftOut],
    development: Development,
    digests: Contents,
    reconstruction: Reconstruction,
    rig: RigCalibration | None,
    place: Georeference,
) -> Stage[str]:
    """The page of what was understood; its file's name."""
    said = [(report.title, report.lines, report.warnings) for report in reports]
    return Stage(
        "page",
        str,
        (said, left_out, development, digests, reconstruction, rig, place),
        lambda progress: (
            write_page(
                scene, reports, development, reconstruction, rig, place, left_out=left_out
            ).name
        ),
        lambda name: Told((f"{scene / name}",)),
        lambda name: [scene / name],
    )


def _tell_scene(written: WrittenScene) -> Told:
    bounds = (
        "no °C"
        if written.range_c is None
        else f"{written.range_c[0]:g} °C to {written.range_c[1]:g} °C"
    )
    return Told((f"{written.train} training views, {written.eval} held out, {bounds}.",))
