"""The whole way from photos to a scene; only what takes long, or needs sharper images, is
replaced."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from filelock import FileLock
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.kept import stamps
from mrgs.data.ply import write_points
from mrgs.data.radiometric import Overrides
from mrgs.errors import RunError, SceneError
from mrgs.prepare import Preparation, PrepareOptions, prepare, stages
from mrgs.prepare.contract import Reconstruction, Skipped, TooFewPosesError
from mrgs.prepare.existing import existing_poses
from mrgs.prepare.georeference import KnownDistance
from mrgs.prepare.rig.contract import ChessboardTarget, RigCalibration, RigView, TargetFit
from mrgs.prepare.run import Steps, preparing
from mrgs.prepare.thermal_camera import read_thermal_camera
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL
from mrgs.scene.lens import Lens
from tests.helpers.converted import sizes_of

STAGES = ["pairs", "images", "poses", "scale and north", "thermal camera", "scene files", "page"]
BOUNDS = Overrides(bounds_c=(10.0, 30.0))


@pytest.fixture
def photos(small_scene: Path, tmp_path: Path) -> Path:
    """Eight pairs in folders of their own, under other names, and a file that is not a photo."""
    folder = tmp_path / "photos"
    for own, name in (("images", "rgb"), ("thermal", "thermal")):
        (folder / name).mkdir(parents=True)
        for index, image in enumerate(sorted((small_scene / own).iterdir())):
            shutil.copy2(image, folder / name / f"shot_{index:02d}.png")
    (folder / "notes.txt").write_text("windy")
    return folder


@dataclass
class Fakes:
    """Stand-ins for structure from motion and the calibration, and how often they were called."""

    poses: Path
    calls: list[str] = field(default_factory=list)
    failed: tuple[Skipped, ...] = ()
    fails: str = ""

    def prepare(self, *arguments, steps: Steps | None = None, **options) -> Preparation:
        """``prepare`` with these steps, or else with the stand-ins."""
        return prepare(*arguments, steps=steps or self.steps, **options)

    @property
    def steps(self) -> Steps:
        return Steps(self.reconstruct, self.calibrate, write_page=short_page)

    def reconstruct(
        self, images, work, progress, *, modality, gps, field_of_view_deg
    ) -> Reconstruction:
        self.calls.append("thermal poses" if modality == THERMAL else "poses")
        progress("matching", 1, 2)
        return replace(existing_poses(self.poses, images, sizes_of(images)), images=modality)

    def calibrate(self, pairs, points, options, progress) -> RigCalibration:
        self.calls.append("thermal camera")
        if self.fails == "thermal camera":
            raise KeyboardInterrupt
        pose = torch.eye(4, dtype=torch.float64)
        views = tuple(RigView(pair.name, pose, 5, 0.1, 0.2) for pair in pairs)
        pose = pose.clone()
        pose[0, 3] = -0.03
        return RigCalibration(
            Lens(40, 30, 41.0, 41.0, 20.0, 15.0), pose, views, (0.1, 0.2), 0.3, 0.1, ()
        )


def short_page(work: Work, without_pose: Sequence[Skipped] = ()) -> Path:
    """A page that holds what the stages said."""
    text = "\n".join(line for stage in work.reports for line in stage.lines)
    page = work.scene / "prepare.html"
    page.write_text(text, encoding="utf-8")
    return page


@pytest.fixture
def posed(photos: Path, small_scene: Path, tmp_path: Path) -> Path:
    """The scene that the photos were copied from, with their names."""
    renamed = tmp_path / "posed"
    text = (small_scene / "transforms.json").read_text()
    for own in ("images", "thermal"):
        (renamed / own).mkdir(parents=True)
        for index, image in enumerate(sorted((small_scene / own).iterdir())):
            shutil.copy2(image, renamed / own / f"shot_{index:02d}.png")
            text = text.replace(image.name, f"shot_{index:02d}.png")
    (renamed / "transforms.json").write_text(text)
    shutil.copy2(small_scene / "sparse_pc.ply", renamed)
    return renamed


@pytest.fixture
def fakes(posed: Path) -> Fakes:
    """The known poses, a thermal camera that is not searched for, and a short page."""
    return Fakes(posed)


def test_photos_become_the_scene_that_they_show(photos, posed, tmp_path):
    before, reports = stamps(photos), []
    options = PrepareOptions(overrides=BOUNDS, poses=posed, one_camera=True, eval_every=4)
    made = prepare(photos, tmp_path / "scene", options, report=reports.append)
    assert [report.title for report in reports] == STAGES
    assert made.stages == tuple(reports)
    assert made.page == tmp_path / "scene" / "prepare.html"
    assert "shot_03" in made.page.read_text(encoding="utf-8")
    assert [item.name for item in made.skipped] == ["notes.txt"]
    assert stamps(photos) == before
    scene, truth = load_scene(tmp_path / "scene"), load_scene(posed)
    assert ([view.name for view in scene.eval], len(scene.train)) == (["shot_00", "shot_04"], 6)
    assert (scene.temperature.min_c, scene.temperature.max_c) == (10.0, 30.0)
    true = {view.name: view for view in truth.views}
    for view in scene.views:
        assert view.shares_camera(RGB, THERMAL)
        assert torch.equal(
            view.images[RGB].load().values, true[view.name].images[RGB].load().values
        )
        # The same pictures through the same lenses; the world may have been turned upright.
        assert torch.allclose(view.images[RGB].camera.K, true[view.name].images[RGB].camera.K)
        assert torch.allclose(
            view.images[THERMAL].load().values,
            true[view.name].images[THERMAL].load().values,
            atol=1e-6,
        )


def test_control_points_place_the_scene(photos, posed, tmp_path):
    """Places of the scene, twice as large and moved, are its control points; one is a check."""
    truth = load_scene(posed)
    positions = truth.points.positions.double()
    rows = ["name,east,north,height,view,x,y,role"]
    for index, place in enumerate(positions[:: len(positions) // 6][:6]):
        east, north, height = (2 * place + torch.tensor([5000.0, 20.0, 7.0])).tolist()
        role = "check" if index == 5 else "control"
        for view in truth.views:
            pixel, depth = view.camera.project(place[None])
            if depth[0] > 0 and view.camera.contains(pixel)[0]:
                x, y = pixel[0].tolist()
                name = f"rgb/{view.name}.png" if index % 2 else view.name.upper()
                rows.append(f"P{index},{east},{north},{height},{name},{x},{y},{role}")
    table = tmp_path / "points.csv"
    table.write_text("\n".join(rows))
    options = PrepareOptions(overrides=BOUNDS, poses=posed, one_camera=True, control=table)
    made = prepare(photos, tmp_path / "scene", options)
    scene = load_scene(made.scene)
    assert scene.world.offset == (5000.0, 0.0, 0.0)
    assert scene.world.control_m < 1e-3
    places = {view.name: view.camera.position for view in truth.views}
    for view in scene.views:
        moved = 2 * places[view.name] + torch.tensor([0.0, 20.0, 7.0])
        assert torch.allclose(view.camera.position, moved, atol=1e-3)
    page = made.page.read_text(encoding="utf-8")
    assert "<h2>Control points</h2>" in page
    assert "<td>P5</td><td>check</td>" in page
    again = prepare(photos, tmp_path / "scene", options)
    assert all(stage.reused for stage in again.stages)
    known = KnownDistance(truth.views[0].name, (1.0, 1.0), (2.0, 2.0), 3.0)
    made = prepare(photos, tmp_path / "scene", replace(options, known_distance=known))
    assert "The known distance is not used" in made.page.read_text(encoding="utf-8")
    table.write_text(f"{rows[0]}\nP,1,2,3,shot_99.png,1,1,\n")
    with pytest.raises(SceneError, match=r"line 2: none of the photos.*'shot_99.png'"):
        prepare(photos, tmp_path / "scene", options)


def test_given_poses_without_points_do_for_thermal_photos_alone(photos, posed, tmp_path):
    (posed / "sparse_pc.ply").unlink()
    options = PrepareOptions(overrides=BOUNDS, poses=posed, pairs="thermal")
    made = prepare(photos / "thermal", tmp_path / "alone", options)
    assert next(s for s in made.stages if s.title == "poses").warnings == ()
    options = PrepareOptions(overrides=BOUNDS, poses=posed, one_camera=True)
    made = prepare(photos, tmp_path / "both", options)
    assert next(s for s in made.stages if s.title == "poses").warnings == ()


def test_what_only_the_page_sees_is_a_warning_too(photos, posed, tmp_path):
    odd = photos / "thermal" / "shot_03.png"
    with Image.open(odd) as image:
        image.point(lambda value: value // 3).save(odd)
    few = load_scene(posed).points.positions.numpy()
    points = np.repeat(few, 16, axis=0)  # enough of them to compare the images
    points = points + np.random.default_rng(0).normal(0, 0.05, points.shape)
    write_points(posed / "sparse_pc.ply", points, np.zeros(points.shape, np.uint8))
    options = PrepareOptions(overrides=BOUNDS, poses=posed, one_camera=True)
    for _ in range(2):  # the second time from the cache
        made = prepare(photos, tmp_path / "scene", options)
        (warning,) = made.stages[-1].warnings
        assert "(shot_03) the same places" in warning
    assert made.page.read_text(encoding="utf-8").count("the same places") == 1


def test_photos_that_are_odd_are_named(photos, posed, tmp_path):
    for photo in (photos / "rgb").iterdir():
        with Image.open(photo) as image:
            Image.new(image.mode, image.size).save(photo)
    options = PrepareOptions(overrides=BOUNDS, poses=posed, one_camera=True)
    for _ in range(2):  # the second call takes its results from the first
        made = prepare(photos, tmp_path / "scene", options)
        (warning,) = next(s for s in made.stages if s.title == "scene files").warnings
        assert "black" in warning
        assert "RGB image of 7 views" in warning


def test_the_thermal_camera_comes_into_the_scene(photos, fakes, tmp_path):
    fakes.prepare(photos, tmp_path / "scene", PrepareOptions(overrides=BOUNDS))
    assert fakes.calls == ["poses", "thermal camera"]
    view = load_scene(tmp_path / "scene").train[0]
    between = view.images[THERMAL].camera.viewmat @ torch.linalg.inv(
        view.images[RGB].camera.viewmat
    )
    assert torch.allclose(
        between[:3, 3], torch.tensor([-0.03, 0.0, 0.0], dtype=torch.float64), atol=1e-9
    )
    assert view.images[THERMAL].camera.K[0, 0] == 41.0


def touch(path: Path) -> None:
    os.utime(path, ns=(1, 2))


def repaint(path: Path) -> None:
    with Image.open(path) as image:
        image.transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(path)


CHANGES: dict[str, tuple[Callable[[Path, Path], object], PrepareOptions, list[str]]] = {
    "nothing": (lambda photos, scene: None, PrepareOptions(), []),
    "other file": (lambda photos, scene: touch(photos / "notes.txt"), PrepareOptions(), ["pairs"]),
    "same photo, copied again": (
        lambda photos, scene: touch(photos / "rgb" / "shot_02.png"),
        PrepareOptions(),
        ["pairs"],
    ),
    "other photo": (
        lambda photos, scene: repaint(photos / "rgb" / "shot_02.png"),
        PrepareOptions(),
        ["pairs", "images", "poses", "thermal camera", "scene files", "page"],
    ),
    "other temperatures": (
        lambda photos, scene: None,
        PrepareOptions(overrides=BOUNDS),
        ["images", "thermal camera", "scene files", "page"],
    ),
    "split": (lambda photos, scene: None, PrepareOptions(eval_every=3), ["scene files", "page"]),
    "field of view": (
        lambda photos, scene: None,
        PrepareOptions(thermal_fov_deg=50),
        ["thermal camera"],
    ),
    "one camera": (
        lambda photos, scene: None,
        PrepareOptions(one_camera=True),
        ["thermal camera", "scene files", "page"],
    ),
    "image removed": (
        lambda photos, scene: (scene / "thermal" / "shot_01.png").unlink(),
        PrepareOptions(),
        ["images", "scene files"],
    ),
    "scene removed": (
        lambda photos, scene: (scene / "transforms.json").unlink(),
        PrepareOptions(),
        ["scene files"],
    ),
    "page removed": (
        lambda photos, scene: (scene / "prepare.html").unlink(),
        PrepareOptions(),
        ["page"],
    ),
}


@pytest.mark.parametrize(("change", "options", "expected"), CHANGES.values(), ids=CHANGES)
def test_only_what_follows_from_a_change_is_done_again(
    change, options, expected, photos, fakes, tmp_path
):
    scene = tmp_path / "scene"
    fakes.prepare(photos, scene)
    change(photos, scene)
    made = fakes.prepare(photos, scene, options)
    assert [report.title for report in made.stages] == STAGES
    assert [report.title for report in made.stages if not report.reused] == expected
    assert load_scene(scene).train


def test_after_ctrl_c_the_same_call_goes_on(photos, fakes, tmp_path):
    fakes.fails = "thermal camera"
    with pytest.raises(KeyboardInterrupt):
        fakes.prepare(photos, tmp_path / "scene")
    assert not (tmp_path / "scene" / "transforms.json").exists()
    fakes.fails = ""
    made = fakes.prepare(photos, tmp_path / "scene")
    assert [report.title for report in made.stages if report.reused] == STAGES[:4]
    assert fakes.calls == ["poses", "thermal camera", "thermal camera"]


def test_a_scene_whose_images_have_changed_is_no_scene_until_it_is_whole(photos, fakes, tmp_path):
    fakes.prepare(photos, tmp_path / "scene")
    fakes.fails = "thermal camera"
    with pytest.raises(KeyboardInterrupt):
        fakes.prepare(photos, tmp_path / "scene", PrepareOptions(overrides=BOUNDS))
    with pytest.raises(SceneError, match="no scene found"):
        load_scene(tmp_path / "scene")


def test_thermal_photos_alone_are_posed_by_themselves(photos, fakes, tmp_path):
    shutil.rmtree(photos / "rgb")
    made = fakes.prepare(photos, tmp_path / "scene", PrepareOptions(overrides=BOUNDS))
    assert fakes.calls == ["thermal poses"]
    scene = load_scene(tmp_path / "scene")
    assert scene.modalities == (THERMAL,)
    assert "only thermal" in made.stages[4].lines[0]


def test_progress_names_the_stage_and_the_step(photos, fakes, tmp_path):
    steps = []
    fakes.prepare(photos, tmp_path / "scene", progress=lambda *step: steps.append(step))
    assert ("poses: matching", 1, 2) in steps
    assert {step.partition(":")[0] for step, _, _ in steps} == set(STAGES)


def test_what_was_left_out_is_told(photos, fakes, tmp_path):
    (photos / "rgb" / "shot_03.png").write_bytes(b"torn")
    made = fakes.prepare(photos, tmp_path / "scene")
    assert {item.name for item in made.skipped} >= {"notes.txt", "rgb/shot_03.png"}
    assert not any("shot_03" in path.name for path in (tmp_path / "scene" / "images").iterdir())


BAD_FOLDERS: dict[str, tuple[Callable[[Path], tuple[Path, Path]], type[Exception], str]] = {
    "no photos": (lambda root: (root / "nowhere", root / "scene"), SceneError,
                  "nowhere: not a folder; give the photos' folder"),
    "scene in photos": (lambda root: (root / "photos", root / "photos" / "scene"), RunError,
                        "scene and the photos are inside one another: choose a separate "
                        "scene folder"),
    "photos in scene": (lambda root: (root / "photos", root), RunError, "are inside one another"),
    "something else": (lambda root: (root / "photos", root / "posed"), RunError,
                       "posed holds something that `mrgs prepare` did not make: choose a new "
                       "folder"),
    "a file": (lambda root: (root / "photos", root / "photos.txt"), RunError,
    r"photos\.txt.* cannot be written"),
}  # fmt: skip


@pytest.mark.parametrize(("folders", "kind", "message"), BAD_FOLDERS.values(), ids=BAD_FOLDERS)
def test_a_folder_that_cannot_be_used_is_named_and_left_alone(
    folders, kind, message, photos, fakes, tmp_path
):
    (tmp_path / "photos.txt").write_text("mine")
    before = stamps(tmp_path)
    with pytest.raises(kind, match=message):
        fakes.prepare(*folders(tmp_path))
    assert stamps(tmp_path) == before


def test_the_page_shows_how_far_it_came(photos, fakes, tmp_path):
    def fails(*arguments):
        raise SceneError("the thermal camera cannot be placed: noise")

    fakes.prepare(photos, tmp_path / "scene")
    steps = replace(fakes.steps, calibrate_rig=fails)
    with pytest.raises(SceneError, match=r"noise; .*prepare\.html"):
        fakes.prepare(photos, tmp_path / "scene", PrepareOptions(thermal_fov_deg=50), steps=steps)
    shown = (tmp_path / "scene" / "prepare.html").read_text(encoding="utf-8")
    assert "8 of 8 photos" in shown
    assert shown.endswith("the thermal camera cannot be placed: noise")
    assert not (tmp_path / "scene" / "transforms.json").exists()  # of other options
    made = fakes.prepare(photos, tmp_path / "scene")
    assert [report.title for report in made.stages if not report.reused] == ["scene files", "page"]
    assert "cannot be placed" not in made.page.read_text(encoding="utf-8")


def test_a_target_gives_metres(photos, fakes, tmp_path):
    def calibrate(*arguments) -> RigCalibration:
        return replace(fakes.calibrate(*arguments), target=TargetFit(5, (0.1, 0.2), 2.0))

    before = load_scene(fakes.prepare(photos, tmp_path / "scene").scene)
    options = PrepareOptions(target=ChessboardTarget((7, 6), 0.05))
    steps = replace(fakes.steps, calibrate_rig=calibrate)
    made = fakes.prepare(photos, tmp_path / "scene", options, steps=steps)
    assert "in metres" in made.stages[4].lines[-1]
    after = load_scene(made.scene)
    for old, new in zip(before.train, after.train, strict=True):
        assert torch.allclose(
            2 * old.images[RGB].camera.position, new.images[RGB].camera.position, atol=1e-9
        )
        assert torch.allclose(
            2 * old.images[THERMAL].camera.position, new.images[THERMAL].camera.position, atol=1e-9
        )
        assert torch.allclose(
            old.images[RGB].camera.viewmat[:3, :3], new.images[RGB].camera.viewmat[:3, :3]
        )
    assert torch.allclose(2 * before.points.positions, after.points.positions, atol=1e-5)
    camera = read_thermal_camera(made.scene / "transforms.json")  # for other scenes of this camera
    assert camera.lens.fx == 41.0
    assert camera.extrinsics[0, 3] == pytest.approx(-0.06)


def test_given_poses_know_the_photos_by_the_names_that_they_had(photos, posed, tmp_path):
    names = {path.stem: f"DJI_{path.stem[-2:]}" for path in sorted((photos / "rgb").iterdir())}
    for name, new in names.items():
        (photos / "rgb" / f"{name}.png").rename(photos / "rgb" / f"{new}_W.png")
        (photos / "thermal" / f"{name}.png").rename(photos / "thermal" / f"{new}_T.png")
        (posed / "images" / f"{name}.png").rename(posed / "images" / f"{new}_W.png")
        (posed / "thermal" / f"{name}.png").rename(posed / "thermal" / f"{new}_T.png")
    text = (posed / "transforms.json").read_text()
    for name, new in names.items():
        text = text.replace(f"images/{name}.png", f"images/{new}_W.png").replace(
            f"thermal/{name}.png", f"thermal/{new}_T.png"
        )
    (posed / "transforms.json").write_text(text)
    work = Work(photos, tmp_path / "scene", PrepareOptions(overrides=BOUNDS, poses=posed))
    stages.pairs(work)
    assert [pair.name for pair in work.pairing.pairs] == list(names.values())
    stages.images(work)
    stages.poses(work, pytest.fail)
    assert list(work.poses.viewmats) == list(work.poses.lenses) == list(names.values())
    assert work.poses.failed == ()


@pytest.mark.parametrize("points", ["sparse_pc.ply", "cloud.ply"])
def test_given_poses_are_read_again_when_their_points_change(photos, posed, tmp_path, points):
    transforms = posed / "transforms.json"
    content = json.loads(transforms.read_text())
    content.pop("ply_file_path", None)
    named = {} if points == "sparse_pc.ply" else {"ply_file_path": points}  # else it is found
    transforms.write_text(json.dumps(content | named))
    work = Work(photos, tmp_path / "scene", PrepareOptions(overrides=BOUNDS, poses=transforms))
    stages.pairs(work)
    stages.images(work)
    for count in (5, 6):
        colors = np.zeros((count, 3), np.uint8)
        write_points(posed / points, np.zeros((count, 3)) + np.arange(3), colors)
        stages.poses(work, pytest.fail)
        assert len(work.poses.points.positions) == count


def test_a_folder_of_the_user_s_that_is_called_prepare_is_left_alone(photos, fakes, tmp_path):
    own = tmp_path / "scene" / "prepare" / "notes.txt"
    own.parent.mkdir(parents=True)
    own.write_text("mine")
    with pytest.raises(RunError, match=r"scene .*new folder"):
        fakes.prepare(photos, tmp_path / "scene")
    assert [path.name for path in (tmp_path / "scene").rglob("*")] == ["prepare", "notes.txt"]


def test_images_without_a_pose_are_told_on_the_page(photos, fakes, tmp_path):
    told = []

    def fails(*arguments, **options):
        raise TooFewPosesError(
            "only 2 of 8 photos could be placed", (Skipped("view_3", "too little texture"),)
        )

    def page(work, without_pose):
        told.extend((*work.skipped, *without_pose))
        return work.scene / "prepare.html"

    steps = Steps(reconstruct=fails, write_page=page)
    with pytest.raises(SceneError, match=r"2 of 8 .*prepare\.html"):
        fakes.prepare(photos, tmp_path / "scene", steps=steps)
    assert told == [Skipped("notes.txt", told[0].reason), Skipped("view_3", "too little texture")]


def test_a_page_that_cannot_be_written_hides_no_error(photos, fakes, tmp_path):
    def fails(*arguments, **options):
        raise SceneError("noise")

    def full(*arguments, **options):
        raise RunError("the disk is full")

    steps = Steps(reconstruct=fails, write_page=full)
    with pytest.raises(SceneError, match=r"^noise$"):
        fakes.prepare(photos, tmp_path / "scene", steps=steps)


def test_two_at_once_are_refused(photos, fakes, tmp_path):
    fakes.prepare(photos, tmp_path / "scene")
    with (
        FileLock(tmp_path / "scene" / "prepare" / ".lock"),
        pytest.raises(RunError, match="another run"),
    ):
        fakes.prepare(photos, tmp_path / "scene")


def test_a_full_disk_is_told_and_the_rest_is_kept(photos, fakes, tmp_path):
    def full(*arguments, **options):
        raise RunError(
            "transforms.json cannot be written (No space left on device): free the place or "
            "choose another"
        )

    with pytest.raises(RunError, match="No space left"):
        fakes.prepare(photos, tmp_path / "scene", steps=replace(fakes.steps, write_scene=full))
    made = fakes.prepare(photos, tmp_path / "scene")
    assert [report.title for report in made.stages if not report.reused] == ["scene files", "page"]


def test_a_folder_in_use_is_left_alone(tmp_path):
    folder = tmp_path / "scene" / "prepare"
    folder.mkdir(parents=True)
    message = "scene is being prepared by another run: wait for it, or choose another folder"
    with FileLock(folder / ".lock"), pytest.raises(RunError, match=message), preparing(folder):
        pass
    with preparing(folder):
        assert folder.is_dir()


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "scene").write_text("mine")
    with (
        pytest.raises(RunError, match="scene/prepare cannot be"),
        preparing(tmp_path / "scene" / "prepare"),
    ):
        pass
