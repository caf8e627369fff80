from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.data import load_scene
from mrgs.errors import SceneError
from mrgs.prepare.contract import PhotoPair, Reconstruction
from mrgs.prepare.existing import existing_poses
from mrgs.scene import RGB, THERMAL, EarthPosition, Modality, WorldFrame
from tests.helpers.converted import sizes_of


def photos(folder: Path, names: list[str], size: tuple[int, int] = (40, 30)) -> dict[str, Path]:
    folder.mkdir(exist_ok=True)
    images = {}
    for name in names:
        images[name] = folder / f"{name}.png"
        Image.fromarray(np.zeros((size[1], size[0], 3), dtype=np.uint8)).save(images[name])
    return images


def found_for(folder: Path, images: dict[str, Path], **options: object) -> Reconstruction:
    """The poses in a folder for image files, whose sizes are those of the files."""
    return existing_poses(folder, images, sizes_of(images), **options)


def write_colmap(folder: Path, names: list[str], points: bool = True) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 SIMPLE_RADIAL 40 30 35 20 15 0.01\n")
    lines = [
        f"{index + 1} 1 0 0 0 {0.1 * index} 0 3 1 {name}\n\n" for index, name in enumerate(names)
    ]
    (folder / "images.txt").write_text("".join(lines))
    if points:
        (folder / "points3D.txt").write_text("1 0.5 -0.25 0.125 255 0 51 0.5 1 0 2 3\n")


def test_transforms(small_scene, tmp_path):
    scene = load_scene(small_scene)
    truth = {view.name: view.camera.viewmat for view in scene.train}
    found = found_for(small_scene, photos(tmp_path / "photos", [*truth, "another"]))
    assert found.viewmats.keys() == truth.keys()
    for name, viewmat in found.viewmats.items():
        assert viewmat.numpy() == pytest.approx(truth[name].numpy())
    assert len(found.points.positions) == 25
    assert found.visible is None
    assert f"{len(truth)} of {len(truth) + 1} photos" in found.source
    assert "transforms.json" in found.source
    (left,) = found.failed
    assert left.name == "another"
    assert "no pose" in left.reason
    by_file = found_for(small_scene / "transforms.json", photos(tmp_path / "photos", list(truth)))
    assert by_file.viewmats.keys() == truth.keys()


def test_transforms_of_a_georeferenced_scene(small_scene, tmp_path):
    scene = shutil.copytree(small_scene, tmp_path / "scene")
    content = json.loads((scene / "transforms.json").read_text())
    content["georeference"] = {
        "units": "metres",
        "axes": "east north up",
        "origin": {"latitude_deg": 48.0, "longitude_deg": 11.0, "altitude_m": 500.0},
    }
    (scene / "transforms.json").write_text(json.dumps(content))
    names = [view.name for view in load_scene(scene).train]
    found = found_for(scene, photos(tmp_path / "photos", names))
    assert found.world == WorldFrame(True, True, EarthPosition(48.0, 11.0, 500.0))


@pytest.mark.parametrize("folder", ["sparse/0", "."])
def test_colmap(tmp_path, folder):
    write_colmap(tmp_path / "model" / folder, ["rgb/a.jpg", "rgb/b.jpg", "rgb/c.JPG", "rgb/d.jpg"])
    found = found_for(tmp_path / "model", photos(tmp_path / "photos", ["a", "b", "c"]))
    assert list(found.viewmats) == ["a", "b", "c"]
    assert found.viewmats["c"][0, 3] == pytest.approx(0.2)
    assert found.lenses["a"].fx == 35
    assert found.points.colors.tolist() == [pytest.approx([1, 0, 0.2])]
    assert found.warnings == ()


def test_a_view_is_not_given_the_pose_of_another_photo_that_its_file_is_named_after(tmp_path):
    write_colmap(tmp_path / "model", ["a.jpg", "b.jpg", "c.jpg", "d.jpg"])
    files = photos(tmp_path / "photos", ["a", "b", "c", "d"])
    found = found_for(
        tmp_path / "model", {**{name: files[name] for name in "abc"}, "other": files["d"]}
    )
    assert list(found.viewmats) == ["a", "b", "c"]
    assert [left.name for left in found.failed] == ["other"]


def test_larger_photos_scale_the_lens(tmp_path):
    write_colmap(tmp_path / "model", ["a.jpg", "b.jpg", "c.jpg"])
    lens = found_for(
        tmp_path / "model", photos(tmp_path / "photos", ["a", "b", "c"], (80, 60))
    ).lenses["a"]
    assert (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy) == (80, 60, 70, 70, 40, 30)
    assert lens.radial[0] == 0.01


def test_without_points(tmp_path):
    write_colmap(tmp_path / "model", ["a.jpg", "b.jpg", "c.jpg"], points=False)
    found = found_for(tmp_path / "model", photos(tmp_path / "photos", ["a", "b", "c"]))
    assert found.points.positions.shape == (0, 3)
    (warning,) = found.warnings
    assert "images.txt has no points" in warning
    files = photos(tmp_path / "again", ["a", "b", "c"])
    alone = found_for(tmp_path / "model", files, two_cameras=False)
    assert alone.warnings == (), "there is no thermal camera to be found"


def test_cropped_photos(tmp_path):
    write_colmap(tmp_path / "model", ["a.jpg", "b.jpg", "c.jpg"])
    images = photos(tmp_path / "photos", ["a", "b", "c"], (40, 20))
    with pytest.raises(SceneError) as error:
        found_for(tmp_path / "model", images)
    for told in (str(images["a"]), "40×20", "40×30", "cropped"):
        assert told in str(error.value)


def test_other_names(tmp_path):
    write_colmap(tmp_path / "model", ["a.jpg", "b.jpg", "c.jpg", "d.jpg"])
    with pytest.raises(SceneError) as error:
        found_for(tmp_path / "model", photos(tmp_path / "photos", ["a", "x", "y"]))
    for told in (str(tmp_path / "model"), "1 of 3 photos", "a.jpg, b.jpg, c.jpg"):
        assert told in str(error.value)


def test_names_that_stand_for_two_images(tmp_path):
    write_colmap(tmp_path / "model", ["one/a.jpg", "two/a.jpg", "c.jpg", "d.jpg"])
    with pytest.raises(SceneError, match="named a;"):
        found_for(tmp_path / "model", photos(tmp_path / "photos", ["a", "c", "d"]))


def pairs_of(folder: Path, files: dict[str, str], modality: Modality = RGB) -> list[PhotoPair]:
    """Pairs by the views' names, of photos of these paths."""
    return [PhotoPair(name, {modality: folder / path}) for name, path in files.items()]


def test_one_model_of_both_cameras(tmp_path):
    names = [f"{folder}/{number}.png" for folder in ("rgb", "thermal") for number in range(4)]
    write_colmap(tmp_path / "model", [name for name in names if name != "rgb/3.png"])
    images = photos(tmp_path / "images", list("0123"))
    for modality, folder, first_x in ((RGB, "rgb", 0.0), (THERMAL, "thermal", 0.3)):
        files = {name: f"{folder}/{name}.jpg" for name in images}
        pairs = pairs_of(tmp_path / "photos", files, modality)
        found = found_for(tmp_path / "model", images, pairs=pairs)
        got = {name: float(viewmat[0, 3]) for name, viewmat in found.viewmats.items()}
        count = 3 + (modality == THERMAL)  # no RGB photo has the pose of a thermal one
        assert got == pytest.approx({str(at): first_x + 0.1 * at for at in range(count)})
    elsewhere = pairs_of(tmp_path / "photos", {name: f"visible/{name}.jpg" for name in images})
    with pytest.raises(SceneError, match=r"poses named 0, 1, 2; name them .* folders"):
        found_for(tmp_path / "model", images, pairs=elsewhere)


def test_photos_of_two_cards_with_equal_names(tmp_path):
    files = {
        f"{card}_DJI_{number}_W": f"{card}/DJI_{number}_W.JPG"
        for card in ("100MEDIA", "101MEDIA")
        for number in range(3)
    }
    write_colmap(tmp_path / "model", [f"flight/{path}" for path in files.values()])
    write_colmap(tmp_path / "earlier", [f"images/{name}.jpg" for name in files])
    images = photos(tmp_path / "images", list(files))
    pairs = pairs_of(tmp_path / "photos", files)
    for model in ("model", "earlier"):
        found = found_for(tmp_path / model, images, pairs=pairs)
        got = {name: float(viewmat[0, 3]) for name, viewmat in found.viewmats.items()}
        assert got == pytest.approx({name: 0.1 * at for at, name in enumerate(files)})
    write_colmap(tmp_path / "bare", ["DJI_0_W.JPG", "DJI_1_W.JPG", "DJI_2_W.JPG"])
    with pytest.raises(SceneError, match="0 of 6 photos have a pose"):
        found_for(tmp_path / "bare", images, pairs=pairs)


def test_a_pose_of_the_other_card_is_not_that_of_a_photo_alone(tmp_path):
    """Photo 3 of the first card has none: photo 3 of the second card does not stand in."""
    poses = [f"{card}/{number}.JPG" for card in "ab" for number in range(3)]
    write_colmap(tmp_path / "model", [*poses, "b/3.JPG"])
    files = {f"a_{number}": f"a/{number}.JPG" for number in range(4)}
    images = photos(tmp_path / "images", list(files))
    found = found_for(tmp_path / "model", images, pairs=pairs_of(tmp_path / "photos", files))
    assert [left.name for left in found.failed] == ["a_3"]


def test_a_folder_without_poses(tmp_path):
    with pytest.raises(SceneError, match=r"no poses; .*transforms\.json, sparse/0/cameras\.bin"):
        found_for(tmp_path, {})
    with pytest.raises(SceneError, match=r"missing: .*folder"):
        found_for(tmp_path / "missing", {})


def test_a_damaged_file_is_named(small_scene, tmp_path):
    shutil.copytree(small_scene, tmp_path / "scene")
    content = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    content["frames"][3]["transform_matrix"][0][0] = None
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match="transform_matrix of frame 3"):
        found_for(tmp_path / "scene", {})
