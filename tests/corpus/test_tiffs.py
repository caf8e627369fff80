from __future__ import annotations

import struct
import sys
import warnings

import numpy as np
import pytest
from PIL import Image

from mrgs.check.rules import fast_problems
from mrgs.data import load_scene
from mrgs.data.images import decode, probe, upright
from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.data.radiometric.exif import read_exif
from mrgs.errors import MrgsWarning, SceneError
from mrgs.prepare.convert import read_rgb
from mrgs.scene import THERMAL
from tests.corpus.tiffs import METADATA, scaled_by_gdal, write_by_gdal, write_tiff
from tests.helpers.layouts import HEIGHT, WIDTH, SceneWriter

SCENE_C = np.linspace(5, 30, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
COLOURS = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def stored(path):
    """The pixels in the file, whatever their kind, times the largest value of 8 or 16 bits."""
    return decode(path).values.numpy()


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_orientation_of_a_tiff_leaves_its_pixels_as_stored(tmp_path, orientation, dtype):
    pixels = (7 * SCENE_C).astype(dtype)
    path = write_tiff(tmp_path / "a.tif", pixels, t274=orientation)
    white = {np.uint8: 255, np.uint16: 65535, np.float32: 1}[dtype]
    np.testing.assert_allclose(stored(path)[..., 0] * white, pixels, rtol=1e-6)
    assert (probe(path).width, probe(path).height) == (WIDTH, HEIGHT)


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_turned_tiff_is_turned_once(tmp_path, orientation):
    path = write_tiff(tmp_path / "a.tif", COLOURS, t274=orientation)
    turned = read_rgb(path, orientation)
    (tmp_path / "turned.png").write_bytes(turned.content)
    truth = np.array(upright(Image.fromarray(COLOURS), orientation))
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "turned.png")), truth)
    thermal = read_thermal_photo(write_tiff(tmp_path / "t.tif", SCENE_C, t274=orientation))
    np.testing.assert_array_equal(thermal.temperature_c, SCENE_C)


def test_a_turned_thermal_image_of_a_scene_stays_on_its_photo(tmp_path):
    writer = SceneWriter(tmp_path / "scene")
    writer.transforms(writer.thermoscenes(thermal_mode="F"))
    name = "thermal/frame_train_00001.tiff"
    write_tiff(writer.root / name, SCENE_C, t274=3)
    scene = load_scene(writer.root)
    values = scene.train[1].images[THERMAL].load().values[..., 0]
    np.testing.assert_allclose(scene.temperature.to_celsius(values), SCENE_C, atol=1e-4)


class ThermalScene:
    """A scene whose thermal images are float TIFFs with these numbers."""

    def __init__(self, root, numbers, **tags):
        self.writer = SceneWriter(root / "scene")
        self.writer.transforms(self.writer.thermoscenes(thermal_mode="F"))
        for path in (self.writer.root / "thermal").iterdir():
            write_tiff(path, numbers, **tags)

    def loaded(self, *bounds):
        """The first thermal image in °C with its mask, and the warnings."""
        if bounds:
            self.writer.bounds(*bounds)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", MrgsWarning)
            scene = load_scene(self.writer.root)
        pixels = scene.train[0].images[THERMAL].load()
        celsius = scene.temperature.to_celsius(pixels.values[..., 0]).numpy()
        valid = np.ones(celsius.shape, bool) if pixels.valid is None else pixels.valid.numpy()
        return celsius, valid, [str(each.message) for each in said]


@pytest.mark.parametrize("bounds", [(), (0, 40)])
def test_kelvin_in_a_scene_are_kelvin_and_said(tmp_path, bounds):
    celsius, valid, said = ThermalScene(tmp_path, SCENE_C + np.float32(273.15)).loaded(*bounds)
    np.testing.assert_allclose(celsius, SCENE_C, atol=1e-4)
    assert valid.all()
    assert any("taken for K" in text for text in said)


def test_celsius_of_a_furnace_are_celsius_where_the_bounds_say_so(tmp_path):
    hot = SCENE_C + np.float32(400)
    celsius, _, said = ThermalScene(tmp_path, hot).loaded(400, 440)
    np.testing.assert_allclose(celsius, hot, atol=1e-3)
    assert said == []


def test_bounds_and_images_that_both_look_like_kelvin_are_doubted(tmp_path):
    kelvin = SCENE_C + np.float32(273.15)
    celsius, _, said = ThermalScene(tmp_path, kelvin).loaded(273, 310)
    np.testing.assert_allclose(celsius, kelvin, atol=1e-3)
    assert any("look like K" in text for text in said)


@pytest.mark.parametrize(
    ("mark", "tags"),
    [(-9999, {}), (-3.4e38, {}), (1e6, {}), (-40, {"t42113": "-40"}), (0, {"t42113": "0 "})],
)
def test_missing_pixels_are_masked_in_photos_and_in_scenes(tmp_path, mark, tags):
    numbers = SCENE_C.copy()
    numbers[2, 3:6] = mark
    celsius, valid, _ = ThermalScene(tmp_path, numbers, **tags).loaded(0, 40)
    photo = read_thermal_photo(write_tiff(tmp_path / "a.tif", numbers, **tags))
    for mask in (valid, photo.valid):
        np.testing.assert_array_equal(mask, numbers == SCENE_C)
    np.testing.assert_allclose(celsius[valid], SCENE_C[valid], atol=1e-4)


def test_missing_pixels_do_not_widen_the_range_of_a_scene(tmp_path):
    numbers = SCENE_C.copy()
    numbers[2, 3:7] = -9999
    scene = ThermalScene(tmp_path, numbers)
    assert load_scene(scene.writer.root).temperature.min_c == 5


def test_numbers_far_outside_of_the_bounds_are_said_before_training(tmp_path):
    scene = ThermalScene(tmp_path, SCENE_C + np.float32(70))
    scene.writer.bounds(0, 20)
    found = fast_problems(load_scene(scene.writer.root))
    assert any("outside of 0 to 20" in problem.text for problem in found)


@pytest.mark.parametrize("offset", [0.0, -273.15])
def test_the_scale_and_offset_of_gdal_count(tmp_path, offset):
    counts = np.rint((SCENE_C - offset) / 0.01).astype(np.uint16)
    tag = {"t42112": scaled_by_gdal(0.01, offset)}
    photo = read_thermal_photo(write_tiff(tmp_path / "a.tif", counts, **tag))
    celsius, _, _ = ThermalScene(tmp_path, counts, **tag).loaded(0, 40)
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=0.0051)
    np.testing.assert_allclose(celsius, SCENE_C, atol=0.0051)


@pytest.mark.parametrize("mode", ["1", "LA", "P", "RGB", "RGBA", "CMYK"])
def test_a_scale_says_nothing_of_colours(tmp_path, mode):
    """Nor does a tag that has no end."""
    plain, tagged = (tmp_path / name for name in ("plain.tif", "tagged.tif"))
    picture = Image.fromarray(COLOURS).convert(mode)
    picture.save(plain)
    for text in (scaled_by_gdal(0.5, 0), '<Item role="scale"' * 2_000):
        picture.save(tagged, tiffinfo={METADATA: text})
        np.testing.assert_array_equal(stored(tagged), stored(plain))
        found, expected = read_thermal_photo(tagged), read_thermal_photo(plain)
        np.testing.assert_array_equal(found.relative, expected.relative)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_are_shades_however_they_are_packed(tmp_path, dtype):
    pytest.importorskip("rasterio")
    shades = (7 * SCENE_C).astype(dtype)
    paths = [tmp_path / "plain.tif", tmp_path / "lerc.tif"]
    for path, options in zip(paths, ({}, {"compress": "lerc"}), strict=True):
        write_by_gdal(path, shades, nodata=shades[0, 0], **options)
    plain, lerc = map(decode, paths)
    assert plain.kind == lerc.kind == "grey"
    np.testing.assert_array_equal(plain.values, lerc.values)
    np.testing.assert_array_equal(plain.valid, lerc.valid)
    np.testing.assert_array_equal(plain.valid, shades != shades[0, 0])


def test_complex_numbers_are_no_temperatures(tmp_path):
    pytest.importorskip("rasterio")
    path = write_by_gdal(tmp_path / "a.tif", SCENE_C.astype(np.complex64))
    with pytest.raises(SceneError, match="complex64"):
        decode(path)


@pytest.mark.parametrize(
    ("dtype", "options"),
    [
        (np.float64, {}),
        (np.float32, {"compress": "lerc"}),
        (np.float32, {"compress": "deflate", "predictor": 3}),
        (np.float32, {"compress": "lzw", "ENDIANNESS": "BIG"}),
        (np.float32, {"ENDIANNESS": "BIG"}),
    ],
)
def test_floats_that_pillow_does_not_know(tmp_path, dtype, options):
    pytest.importorskip("rasterio")
    path = tmp_path / "a.tif"
    numbers = SCENE_C.astype(dtype)
    numbers[0, 0] = -1
    write_by_gdal(path, numbers, nodata=-1, **options)
    photo = read_thermal_photo(path)
    np.testing.assert_allclose(photo.temperature_c[photo.valid], SCENE_C.ravel()[1:], atol=1e-4)
    assert (photo.valid.sum(), decode(path).kind) == (SCENE_C.size - 1, "float")


@pytest.mark.parametrize("dtype", [np.int16, np.int32, np.uint16])
@pytest.mark.parametrize("compress", ["none", "lzw"])
def test_integers_in_either_order_of_bytes(tmp_path, dtype, compress):
    pytest.importorskip("rasterio")
    counts = np.rint(100 * (SCENE_C + 273.15)).astype(dtype)
    for order in ("BIG", "LITTLE"):
        path = write_by_gdal(tmp_path / f"{order}.tif", counts, compress=compress, ENDIANNESS=order)
        np.testing.assert_allclose(read_thermal_photo(path).temperature_c, SCENE_C, atol=0.006)


@pytest.mark.parametrize(("unit", "factor", "zero"), [("K", 1, 273.15), ("degF", 1.8, 32)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_unit_that_gdal_names(tmp_path, unit, factor, zero, dtype):
    pytest.importorskip("rasterio")
    path = write_by_gdal(tmp_path / "a.tif", (factor * SCENE_C + zero).astype(dtype), unit)
    np.testing.assert_allclose(read_thermal_photo(path).temperature_c, SCENE_C, atol=1e-4)
    np.testing.assert_allclose(stored(path)[..., 0], SCENE_C, atol=1e-4)
    given = {"K": "kelvin", "degF": "fahrenheit"}[unit]
    photo = read_thermal_photo(path, Overrides(unit=given))
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=1e-4)
    counts = np.rint(100 * (SCENE_C + 273.15)).astype(np.uint16)
    photo = read_thermal_photo(write_by_gdal(tmp_path / "b.tif", counts, "K"))
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=0.006)


def test_tags_of_a_tiff_that_pillow_does_not_know(tmp_path):
    data = write_tiff(tmp_path / "a.tif", SCENE_C, t274=6, t306="2024:05:01 12:00:07").read_bytes()
    unknown = data.replace(struct.pack("<HHII", 258, 3, 1, 32), struct.pack("<HHII", 258, 3, 1, 64))
    assert unknown != data
    assert read_exif(unknown) == read_exif(data)
    assert read_exif(data).orientation == 6


def test_shares_of_the_bounds_are_read_by_these(tmp_path):
    shares = (SCENE_C - 5) / np.float32(25)
    celsius, valid, said = ThermalScene(tmp_path, shares).loaded(5, 30)
    np.testing.assert_allclose(celsius, SCENE_C, atol=1e-4)
    assert valid.all()
    assert any("shares of the scale" in text for text in said)


def test_shares_without_bounds_are_relative(tmp_path):
    shares = (SCENE_C - 5) / np.float32(25)
    with pytest.warns(MrgsWarning, match="relative values without °C"):
        scene = load_scene(ThermalScene(tmp_path, shares).writer.root)
    assert scene.temperature is None
    values = scene.train[0].images[THERMAL].load().values[..., 0]
    np.testing.assert_array_equal(values, shares)


def test_a_range_of_a_degree_is_one_of_degrees(tmp_path):
    cold = (SCENE_C - 5) / np.float32(25)
    celsius, _, said = ThermalScene(tmp_path, cold).loaded(0, 1)
    np.testing.assert_allclose(celsius, cold, atol=1e-6)
    assert said == []


def test_zeros_around_a_warped_image_are_missing(tmp_path):
    warped = SCENE_C + np.float32(10)
    warped[:, :3] = 0
    celsius, valid, said = ThermalScene(tmp_path, warped).loaded()
    assert not valid[:, :3].any()
    assert valid[:, 3:].all()
    np.testing.assert_allclose(celsius[valid], warped[valid], atol=1e-4)
    assert any("exactly 0" in text for text in said)


def test_zeros_around_a_warped_photo_are_missing(tmp_path):
    warped = SCENE_C + np.float32(10)
    warped[:3] = 0
    photo = read_thermal_photo(write_tiff(tmp_path / "a.tif", warped))
    assert not photo.valid[:3].any()
    assert photo.valid[3:].all()
    assert any("exactly 0" in note for note in photo.facts.warnings)


@pytest.mark.parametrize("bounds", [(), (0, 40)])
def test_a_cold_place_is_no_missing_one(tmp_path, bounds):
    """Its edge has all temperatures between; and bounds from 0 °C on may mean 0 °C."""
    celsius = SCENE_C + np.float32(10)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    away = np.hypot(rows - HEIGHT / 2, columns - WIDTH / 2).astype(np.float32)
    celsius *= np.clip((away - 2) / (4 if not bounds else 0.01), 0, 1)
    assert (celsius == 0).any()
    found, valid, _ = ThermalScene(tmp_path, celsius).loaded(*bounds)
    assert valid.all()
    np.testing.assert_allclose(found, celsius, atol=1e-4)


def test_shades_as_floats_are_doubted(tmp_path):
    _, _, said = ThermalScene(tmp_path, 8 * SCENE_C).loaded()
    assert any("(42 to 238) are taken for °C" in text for text in said)


def test_pixels_that_are_no_numbers_are_no_zeros(tmp_path):
    framed = SCENE_C + np.float32(10)
    framed[:, :3] = np.nan
    _, valid, said = ThermalScene(tmp_path, framed).loaded()
    assert not valid[:, :3].any()
    assert said == []


def test_zeros_near_other_temperatures_are_temperatures(tmp_path):
    near = SCENE_C - np.float32(5)
    assert (near == 0).any()
    _, valid, said = ThermalScene(tmp_path, near).loaded()
    assert valid.all()
    assert said == []


def test_kelvin_among_celsius_are_said(tmp_path):
    scene = ThermalScene(tmp_path, SCENE_C)
    write_tiff(min((scene.writer.root / "thermal").iterdir()), SCENE_C + np.float32(273.15))
    assert any("some like K" in text for text in scene.loaded()[2])


def test_minus_999_is_a_missing_pixel(tmp_path):
    numbers = SCENE_C.copy()
    numbers[2, 3:6] = -999
    photo = read_thermal_photo(write_tiff(tmp_path / "a.tif", numbers))
    np.testing.assert_array_equal(photo.valid, numbers == SCENE_C)


def test_several_bands_are_refused_by_their_number(tmp_path):
    pytest.importorskip("rasterio")
    path = write_by_gdal(tmp_path / "a.tif", np.stack([SCENE_C] * 5))
    with pytest.raises(SceneError, match=r"a\.tif: has 5 bands"):
        read_thermal_photo(path)


def test_counts_in_a_scene_are_not_taken_for_shades_in_silence(tmp_path):
    writer = SceneWriter(tmp_path / "scene")
    writer.transforms(writer.thermoscenes(thermal_mode="I;16"))
    writer.bounds(0, 40)
    scene = load_scene(writer.root)
    assert not any("counts" in problem.text for problem in fast_problems(scene))
    for index, path in enumerate(sorted((writer.root / "thermal").iterdir())):
        counts = np.rint(100 * (SCENE_C + index / 10 + 273.15)).astype(np.uint16)
        Image.fromarray(counts).save(path)
    with pytest.warns(MrgsWarning, match="If they are K × 100"):
        found = fast_problems(load_scene(writer.root))
    assert any("counts" in problem.text for problem in found)


def test_a_tiff_that_only_rasterio_reads_says_so_where_it_is_missing(tmp_path, monkeypatch):
    pytest.importorskip("rasterio")
    path = write_by_gdal(tmp_path / "a.tif", SCENE_C.astype(np.float64))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(SceneError, match=r"a\.tif: .*mrgs\[export\]"):
        probe(path)
