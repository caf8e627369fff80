from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.errors import ConfigError
from mrgs.scene import Modality
from mrgs_synth import synthesize
from mrgs_synth.bands import BANDS, in_band, near_infrared
from mrgs_synth.colors import from_srgb, to_srgb
from mrgs_synth.stage import Material, Stage
from mrgs_synth.write import SceneFolder

NIR = BANDS["nir"]


def plain(color: tuple[int, int, int], **options) -> Material:
    return Material(np.full((2, 2, 3), color, dtype=np.uint8), **options)


def reflectance(material: Material) -> float:
    return float(near_infrared(material, from_srgb(material.texture)).mean())


def test_srgb_there_and_back() -> None:
    values = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(to_srgb(from_srgb(values)), values)


def test_what_is_dark_to_the_eye_may_be_bright_in_near_infrared() -> None:
    leaf = plain((40, 70, 30), infrared_lift=0.5)
    rubber, black_plastic = (
        plain((34, 34, 36), infrared_lift=0.0),
        plain((34, 34, 36), finish="glossy"),
    )
    assert 0.4 < reflectance(leaf) < 0.6  # as green leaves at 850 nm
    assert reflectance(rubber) < 0.03
    assert reflectance(black_plastic) > 0.3
    red_and_blue = [reflectance(plain(color)) for color in ((220, 20, 20), (20, 20, 220))]
    assert red_and_blue[0] == pytest.approx(red_and_blue[1])
    steel = plain((190, 190, 194), finish="metal")
    assert reflectance(steel) == pytest.approx(from_srgb(steel.texture).max())


def test_no_reflectance_exceeds_one() -> None:
    assert reflectance(plain((255, 255, 255), infrared_lift=1.0)) == 1.0


def test_a_stage_in_a_band_is_grey_and_otherwise_the_same(two_boxes: Stage) -> None:
    panorama = np.random.default_rng(0).uniform(0, 1, (4, 8, 3))
    for stage in (two_boxes, replace(two_boxes, sky=None), replace(two_boxes, sky=panorama)):
        grey = in_band(stage, NIR)
        for solid, original in zip(grey.solids, stage.solids, strict=True):
            assert np.ptp(solid.material.texture, axis=2).max() == 0
            assert solid.mesh is original.mesh
        assert np.ptp(grey.lamps[0].radiance) == 0
        assert np.mean(grey.lamps[0].radiance) == pytest.approx(np.mean(stage.lamps[0].radiance))
        if stage.sky is not None:
            np.testing.assert_allclose(
                np.mean(grey.sky, axis=-1), np.mean(stage.sky, axis=-1), rtol=1e-12
            )


def test_its_photos_are_listed(two_boxes: Stage, tmp_path: Path) -> None:
    camera = two_boxes.cameras.train(2, 32, 24, np.random.default_rng(0))[0]
    folder = SceneFolder.create(tmp_path)
    folder.band(NIR.modality, "frame_train_00001", np.full((24, 32), 77, dtype=np.uint8))
    folder.transforms({"frame_train_00001": camera}, [NIR.modality])
    written = json.loads((tmp_path / "transforms.json").read_text())
    assert [Modality.from_json(each) for each in written["modalities"]] == [NIR.modality]
    path = written["frames"][0]["nir_file_path"]
    with Image.open(tmp_path / path) as image:
        assert (image.mode, image.size, image.getpixel((3, 5))) == ("L", (32, 24), 77)


def test_an_unknown_band_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"uv: .*nir"):
        synthesize(tmp_path / "scene", bands=["uv"])


def test_the_other_images_stay_the_same(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="the extra synth is not installed")
    sizes = {"width": 32, "height": 24, "train_views": 2, "eval_views": 0, "samples": 2}
    synthesize(tmp_path / "with", bands=["nir"], **sizes)
    synthesize(tmp_path / "without", **sizes)
    written, expected = (
        {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file() and path.name != "transforms.json"
        }
        for folder in (tmp_path / "with", tmp_path / "without")
    )
    assert {name for name in written if name not in expected} == {
        "nir/frame_train_00001.png",
        "nir/frame_train_00002.png",
    }
    assert {name: written[name] for name in expected} == expected
