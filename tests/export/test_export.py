from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError, MrgsError, MrgsWarning, RunError, SceneError, WriteError
from mrgs.export import FORMATS, export
from mrgs.field.spherical_harmonics import C0
from mrgs.pictures.page_data import starting_limits
from mrgs.scene import RGB, THERMAL, Pixels, View, WorldFrame
from tests.helpers.changed_views import with_image
from tests.helpers.exports import make_baked, read_ply
from tests.helpers.gaussians import NEAR_INFRARED

EXPECTED = {
    "ply": {"rgb.ply", "thermal.ply", "rgb_thermal.ply"},
    "spz": {"rgb.spz", "thermal.spz"},
    "glb": {"rgb.glb", "thermal.glb"},
    "points": {"points.ply"},
    "las": {"points.las"},
    "mesh": {"mesh.ply"},
}


@pytest.fixture
def solid(baked):
    """The small model, opaque enough for points and a mesh."""
    return replace(
        baked,
        opacities={**baked.opacities, RGB: torch.full_like(baked.opacities[RGB], 0.95)},
        scales=baked.scales.clamp_min(0.1),
    )


@pytest.mark.parametrize("format", EXPECTED)
def test_each_format_writes_its_files_and_says_what_they_hold(tmp_path, solid, scene, format):
    paths = export(solid, scene, format, tmp_path / "out")
    assert {path.name for path in paths} == EXPECTED[format] | {
        f"{name}.json" for name in EXPECTED[format]
    }
    assert set((tmp_path / "out").iterdir()) == set(paths)
    for path in paths:
        if path.suffix == ".json":
            facts = json.loads(path.read_text(encoding="utf-8"))
            assert (facts["file"], facts["scene"]) == (path.stem, scene.name)
            assert facts["temperature"]["unit"] == "°C"
            of_surface = facts["temperature"]["of"].startswith("the surface")
            assert of_surface == (format in ("points", "las", "mesh"))
            assert ("colors" in facts) == path.name.startswith("thermal")


def test_cameras_come_with_their_images(tmp_path, baked, scene):
    paths = export(baked, scene, "cameras", tmp_path)
    assert tmp_path / "cameras" / "transforms.json" in paths
    assert tmp_path / "cameras" / "sparse" / "0" / "images.txt" in paths


def test_the_page_is_one_file(tmp_path, baked, scene):
    (path,) = export(baked, replace(scene, world=WorldFrame(metric=True)), "page", tmp_path)
    assert path == tmp_path / "page.html"
    assert '"length_unit": "m"' in path.read_text(encoding="utf-8")
    assert scene.name in path.read_text(encoding="utf-8")


def test_the_page_begins_with_the_colours_of_the_viewer(tmp_path, baked, scene):
    (path,) = export(baked, scene, "page", tmp_path)
    low, high = starting_limits((THERMAL,), scene, scene.temperature)[THERMAL]
    assert f'"range": [{low}, {high}]' in path.read_text(encoding="utf-8")


def test_a_damaged_photo_has_no_part_in_where_colours_begin(scene):
    def damaged() -> Pixels:
        raise SceneError("photo.png: cannot be read")

    first, *others = scene.train
    broken = with_image(first, THERMAL, lambda image: replace(image, load=damaged))
    seen = starting_limits((THERMAL,), replace(scene, train=(broken, *others)), scene.temperature)
    alone = starting_limits((THERMAL,), replace(scene, train=(broken,)), scene.temperature)
    assert alone == {THERMAL: (scene.temperature.min_c, scene.temperature.max_c)} != seen


def test_every_format_has_a_test_here():
    assert {*EXPECTED, "cameras", "page"} == {each.name for each in FORMATS.values() if each.in_all}
    assert {each.name for each in FORMATS.values() if not each.in_all} == {
        "marks",
        "ortho",
        "elevation",
    }


def test_all_writes_every_format(tmp_path, solid, scene):
    names = {path.name for path in export(solid, scene, "all", tmp_path)}
    assert set().union(*EXPECTED.values()) <= names
    assert {"transforms.json", "page.html"} <= names


@pytest.mark.parametrize("is_known", [True, False])
def test_glb_files_hold_temperatures_and_say_whether_they_are_turned(
    tmp_path, baked, scene, is_known
):
    """Of one view it is not known which way is up."""
    made = scene if is_known else replace(scene, train=scene.train[:1])
    export(baked, made, "glb", tmp_path)
    for name in ("rgb", "thermal"):
        data = (tmp_path / f"{name}.glb").read_bytes()
        content = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
        attributes = content["meshes"][0]["primitives"][0]["attributes"]
        assert [each for each in attributes if each.startswith("_")] == ["_TEMPERATURE_C"]
        facts = json.loads((tmp_path / f"{name}.glb.json").read_text(encoding="utf-8"))
        assert ("rotation" in content["nodes"][0]) is is_known
        assert ("+y" in facts["frame"]) is is_known


def test_a_run_is_baked_and_its_loss_is_written_down(tmp_path, run, scene):
    export(run, scene, "ply", tmp_path)
    facts = json.loads((tmp_path / "rgb.ply.json").read_text())
    assert isinstance(facts["baking_loss_db"]["rgb"], float)


def test_palette_and_range_are_the_caller_s(tmp_path, baked, scene):
    export(baked, scene, "ply", tmp_path, "grey", (15.0, 25.0))
    colors = json.loads((tmp_path / "thermal.ply.json").read_text(encoding="utf-8"))["colors"]
    assert colors == {"palette": "grey", "first": 15.0, "last": 25.0, "unit": "°C"}
    comments = dict(line.split(": ", 1) for line in read_ply(tmp_path / "thermal.ply")[0])
    assert json.loads(comments["colors"]).items() >= {"palette": "grey", "first": 15.0}.items()


def test_a_modality_that_the_scene_has_not_is_left_out(tmp_path, baked, scene):
    views = (View(view.name, {THERMAL: view.images[THERMAL]}) for view in scene.train)
    alone = replace(scene, train=tuple(views))
    assert {path.name for path in export(baked, alone, "spz", tmp_path)} == {
        "thermal.spz",
        "thermal.spz.json",
    }


def photographed_in(modality, scene):
    """The scene with the photos of one modality only."""
    parts = {
        part: tuple(View(view.name, {modality: view.images[modality]}) for view in views)
        for part, views in (("train", scene.train), ("eval", scene.eval))
    }
    temperature = scene.temperature if modality == THERMAL else None
    return replace(scene, temperature=temperature, **parts)


def column_names(path):
    """The properties of a file, by its format."""
    if path.suffix == ".las":
        return set(laspy.read(path).point_format.dimension_names)
    if path.suffix == ".glb":
        text = path.read_bytes().partition(b"BIN\0")[0][20:-4]
        return set(json.loads(text)["meshes"][0]["primitives"][0]["attributes"])
    return set(read_ply(path)[1]["vertex"].dtype.names)


def test_without_thermal_photos_no_file_has_temperatures(tmp_path, solid, scene):
    solid = replace(solid, temperature=None)
    export(solid, photographed_in(RGB, scene), "all", tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"rgb.ply", "rgb.spz", "rgb.glb", "points.ply", "points.las", "mesh.ply"} <= names
    assert not {name for name in names if "thermal" in name}
    for name in ("rgb.ply", "rgb.glb", "points.ply", "points.las", "mesh.ply"):
        found = column_names(tmp_path / name)
        assert not {each for each in found if "temperature" in each.lower()}, name
        assert "temperature" not in json.loads((tmp_path / f"{name}.json").read_text()), name
    assert "red" in column_names(tmp_path / "mesh.ply")


def test_without_rgb_photos_no_file_has_colours_of_its_own(tmp_path, solid, scene):
    opaque = {each: torch.full_like(alpha, 0.95) for each, alpha in solid.opacities.items()}
    solid = replace(solid, opacities=opaque)
    export(solid, photographed_in(THERMAL, scene), "all", tmp_path)
    for name in ("points.ply", "points.las", "mesh.ply"):
        found = column_names(tmp_path / name)
        assert "temperature_c" in found
        assert "red" not in found
    both, heat = (read_ply(tmp_path / f"{each}.ply")[1] for each in ("rgb_thermal", "thermal"))
    assert "temperature_c" in both["vertex"].dtype.names
    np.testing.assert_array_equal(both["vertex"]["f_dc_0"], heat["vertex"]["f_dc_0"])


def test_splats_that_only_the_other_modality_shows_are_no_points(tmp_path, solid, scene):
    faint = torch.full_like(solid.opacities[RGB], 0.01)
    solid = replace(solid, opacities={RGB: faint, THERMAL: solid.opacities[RGB]})
    with pytest.raises(RunError, match=r"0\.3 or more"):
        export(solid, photographed_in(RGB, scene), "points", tmp_path)


def test_a_run_s_loss_is_of_the_modalities_that_have_photos(tmp_path, run, scene):
    half = replace(photographed_in(RGB, scene), eval=scene.eval)
    export(run, half, "ply", tmp_path)
    facts = json.loads((tmp_path / "rgb.ply.json").read_text(encoding="utf-8"))
    assert list(facts["baking_loss_db"]) == ["rgb"]


def test_a_scene_of_other_modalities_alone_is_refused(tmp_path, baked, scene):
    _, more = with_infrared(baked, scene)
    views = tuple(View(v.name, {NEAR_INFRARED: v.images[NEAR_INFRARED]}) for v in more.train)
    with pytest.raises(RunError, match="balls has photos"):
        export(baked, replace(more, train=views), "ply", tmp_path)


def with_infrared(baked, scene):
    """The model and the scene with a third modality that looks as warm as the thermal one."""
    temperatures = baked.temperatures.clamp_min(0)
    sh = ((temperatures - 0.5) / C0)[:, None, None]
    model = replace(
        baked,
        temperatures=temperatures,
        opacities={**baked.opacities, NEAR_INFRARED: baked.opacities[THERMAL]},
        sh_dc={**baked.sh_dc, NEAR_INFRARED: sh},
        sh_rest={**baked.sh_rest, NEAR_INFRARED: sh[:, :0]},
    )
    views = (
        View(view.name, {**view.images, NEAR_INFRARED: view.images[THERMAL]})
        for view in scene.train
    )
    return model, replace(scene, train=tuple(views))


@pytest.mark.parametrize("format", ["ply", "spz", "glb"])
def test_a_third_modality_has_grey_splats_of_its_own(tmp_path, baked, scene, format):
    model, scene = with_infrared(baked, scene)
    export(model, scene, format, tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    assert names - EXPECTED[format] - {f"{name}.json" for name in EXPECTED[format]} == {
        f"nir.{format}",
        f"nir.{format}.json",
    }
    facts = json.loads((tmp_path / f"nir.{format}.json").read_text(encoding="utf-8"))
    assert facts["colors"]["palette"] == "grey"
    assert facts["nir"]["property"] == "nir"
    both = json.loads((tmp_path / f"rgb.{format}.json").read_text(encoding="utf-8"))
    assert both["nir"] == facts["nir"]


def test_a_third_modality_is_a_column_beside_the_temperatures(tmp_path, solid, scene):
    model, scene = with_infrared(solid, scene)
    for format, name in (("ply", "rgb_thermal"), ("points", "points"), ("mesh", "mesh")):
        export(model, scene, format, tmp_path)
        rows = read_ply(tmp_path / f"{name}.ply")[1]["vertex"]
        celsius = 10 + 20 * rows["nir"]
        np.testing.assert_allclose(rows["temperature_c"], celsius, atol=1e-3, err_msg=name)
    splats = read_ply(tmp_path / "nir.ply")[1]["vertex"]
    np.testing.assert_array_equal(splats["f_dc_0"], splats["f_dc_2"])
    export(model, scene, "las", tmp_path)
    assert "nir" in laspy.read(tmp_path / "points.las").point_format.dimension_names


def test_a_scene_of_another_modality_alone_has_every_format(tmp_path, solid, scene):
    model, scene = with_infrared(solid, scene)
    views = (View(view.name, {NEAR_INFRARED: view.images[NEAR_INFRARED]}) for view in scene.train)
    alone = replace(scene, train=tuple(views), eval=())
    names = {path.name for path in export(model, alone, "all", tmp_path)}
    assert {"nir.spz", "mesh.ply", "transforms.json", "page.html"} <= names
    assert "rgb.spz" not in names


def test_a_modality_that_the_model_has_not_is_left_out(tmp_path, solid, scene):
    """Its photos were added to the scene after the training."""
    _, more = with_infrared(solid, scene)
    assert {path.name for path in export(solid, more, "spz", tmp_path)} == EXPECTED["spz"] | {
        f"{name}.json" for name in EXPECTED["spz"]
    }
    (page,) = export(solid, more, "page", tmp_path)
    assert "Near infrared" not in page.read_text(encoding="utf-8")


def test_each_format_is_announced_before_it_is_written(tmp_path, solid, scene):
    announced = []

    def progress(*part: object) -> None:
        announced.append((*part, (tmp_path / "points.ply").exists()))

    export(solid, scene, "all", tmp_path, progress=progress)
    formats = [each.name for each in FORMATS.values() if each.in_all]
    assert [part[:3] for part in announced] == [
        (number, len(formats) + 1, name)
        for number, name in enumerate(["baking", *formats], start=1)
    ]
    assert not next(part for part in announced if part[2] == "points")[3]


def test_the_manual_lists_every_format():
    manual = (Path(__file__).parents[2] / "docs" / "export.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(\w+)` \|", manual, re.MULTILINE) == list(FORMATS)


def test_an_unknown_format_is_named(tmp_path, baked, scene):
    with pytest.raises(ConfigError, match="'obj'") as caught:
        export(baked, scene, "obj", tmp_path)
    assert all(name in str(caught.value) for name in FORMATS)


def test_a_missing_package_is_named_before_anything_is_done(tmp_path, baked, scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ConfigError, match="laspy"):
        export(baked, scene, "las", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_all_goes_on_without_the_package(tmp_path, solid, scene, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.warns(MrgsWarning, match="^las .*laspy"):
        names = {path.name for path in export(solid, scene, "all", tmp_path)}
    assert "points.las" not in names
    assert "points.ply" in names


def failing_mesh(monkeypatch: pytest.MonkeyPatch, error: MrgsError) -> None:
    def fail(job: object) -> list[Path]:
        raise error

    monkeypatch.setitem(FORMATS, "mesh", replace(FORMATS["mesh"], export=fail))


def test_all_writes_what_can_be_written_and_says_what_cannot(tmp_path, solid, scene, monkeypatch):
    failing_mesh(monkeypatch, RunError("there are no surfaces: train it longer"))
    with pytest.warns(MrgsWarning, match="^mesh .*no surfaces"):
        names = {path.name for path in export(solid, scene, "all", tmp_path)}
    assert {"points.ply", "transforms.json", "page.html"} <= names
    with pytest.raises(RunError, match="no surfaces"):
        export(solid, scene, "mesh", tmp_path)


def test_all_stops_where_nothing_more_can_be_written(tmp_path, solid, scene, monkeypatch):
    failing_mesh(monkeypatch, WriteError("the disk is full"))
    with pytest.raises(WriteError):
        export(solid, scene, "all", tmp_path)


def test_an_empty_model_and_a_file_in_the_folder_s_place_are_refused(tmp_path, scene):
    with pytest.raises(RunError, match="no splats"):
        export(make_baked(0), scene, "ply", tmp_path)
    (tmp_path / "out").write_text("")
    with pytest.raises(RunError, match="cannot be written"):
        export(make_baked(), scene, "ply", tmp_path / "out")
