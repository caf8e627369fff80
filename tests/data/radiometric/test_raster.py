"""Images without a thermal record."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.errors import ConfigError, SceneError

SCENE_C = np.linspace(5, 30, 20 * 30, dtype=np.float32).reshape(20, 30)


@pytest.mark.parametrize("name", ["a.tif", "a.png"])
@pytest.mark.parametrize(
    ("unit", "counts"),
    [("celsius*100", 100 * SCENE_C), ("kelvin*100", 100 * (SCENE_C + 273.15))],
)
def test_sixteen_bits_whose_unit_is_plain(save, name, unit, counts):
    photo = read_thermal_photo(save(name, np.rint(counts).astype(np.uint16)))
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=0.0051)
    assert [f" {unit}." in note for note in photo.facts.notes] == [True]


@pytest.mark.parametrize(
    ("unit", "numbers"),
    [
        ("celsius", SCENE_C),
        ("kelvin", SCENE_C.astype(np.float64) + 273.15),
        ("celsius*100", np.rint(100 * SCENE_C).astype(np.int16)),
        ("kelvin*100", np.rint(100 * (SCENE_C + 273.15)).astype(np.uint16)),
    ],
)
def test_arrays_of_numpy(tmp_path, unit, numbers):
    np.save(tmp_path / "a.npy", numbers)
    photo = read_thermal_photo(tmp_path / "a.npy")
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=0.0051)
    said = [*photo.facts.notes, *photo.facts.warnings]
    assert any(
        unit.partition("*")[0].replace("kelvin", "K").replace("celsius", "°C") in text
        or unit in text
        for text in said
    )


@pytest.mark.parametrize(
    ("unit", "counts"),
    [
        ("kelvin*10", 10 * (SCENE_C + 273.15)),
        ("kelvin*25", 25 * (SCENE_C + 273.15)),
        ("celsius", SCENE_C),
        ("fahrenheit*100", 100 * (SCENE_C * 1.8 + 32)),
    ],
)
def test_a_given_unit(save, unit, counts):
    photo = read_thermal_photo(
        save("a.png", np.rint(counts).astype(np.uint16)), Overrides(unit=unit)
    )
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=0.51)
    assert photo.facts.notes == ()


def test_numbers_are_radiometric_and_shades_of_grey_are_not(save):
    numbers = read_thermal_photo(save("a.tif", SCENE_C))
    grey = save("a.png", np.rint(8 * SCENE_C).astype(np.uint8))
    shades = read_thermal_photo(grey, Overrides(bounds_c=(0.0, 30.0)))
    assert numbers.facts.record.is_radiometric
    assert not shades.facts.record.is_radiometric


def test_signed_sixteen_bits(save):
    photo = read_thermal_photo(save("a.tif", np.rint(100 * (SCENE_C - 20)).astype(np.int16)))
    np.testing.assert_allclose(photo.temperature_c, SCENE_C - 20, atol=0.0051)


def test_two_units_that_both_fit_are_not_guessed(save):
    path = save("a.png", np.rint(10 * (SCENE_C + 285)).astype(np.uint16))
    with pytest.raises(
        SceneError,
        match=r"\(290\d(\.\d+)? to 31\d\d(\.\d+)?\) .*celsius\*100 .* or kelvin\*10",
    ):
        read_thermal_photo(path)


def test_no_unit_that_fits(save):
    with pytest.raises(SceneError, match=r"no usual unit"):
        read_thermal_photo(save("a.png", np.full((4, 5), 60000, dtype=np.uint16)))


def test_a_unit_that_cannot_be(save):
    with pytest.raises(SceneError, match="temperature in celsius"):
        read_thermal_photo(
            save("a.png", np.full((4, 5), 60000, dtype=np.uint16)), Overrides(unit="celsius")
        )


def test_nothing_but_zeros(save):
    with pytest.raises(SceneError, match="but 0"):
        read_thermal_photo(save("a.png", np.zeros((4, 5), dtype=np.uint16)))


@pytest.mark.parametrize(("unit", "offset"), [("celsius", 0), ("kelvin", 273.15)])
def test_float_tiff(save, unit, offset):
    values = SCENE_C + np.float32(offset)
    values[0, :3] = (np.nan, np.inf, -9999)
    photo = read_thermal_photo(save("a.tiff", values))
    assert not photo.valid[0, :3].any()
    assert photo.valid.sum() == photo.valid.size - 3
    np.testing.assert_array_equal(np.isfinite(photo.temperature_c), photo.valid)
    np.testing.assert_allclose(photo.temperature_c[photo.valid], SCENE_C[photo.valid], atol=1e-4)
    assert [f" {unit}." in note for note in photo.facts.notes] == [True]


def test_numbers_that_may_be_hot_celsius_are_doubted(save):
    values = SCENE_C + np.float32(273.15)
    photo = read_thermal_photo(save("a.tiff", values))
    (warning,) = photo.facts.warnings
    assert "for kelvin" in warning
    assert "give the unit" in warning
    for unit, shift in (("celsius", 273.15), ("kelvin", 0)):
        given = read_thermal_photo(save("a.tiff", values), Overrides(unit=unit))
        np.testing.assert_allclose(given.temperature_c, SCENE_C + shift, atol=1e-3)
        assert given.facts.warnings == ()


@pytest.mark.parametrize(
    ("dtype", "marks"), [(np.uint16, [65535]), (np.int16, [-9999, -32768]), (np.int32, [65535])]
)
@pytest.mark.parametrize("unit", [None, "celsius*100", "kelvin*100"])
def test_integers_that_mark_a_pixel_without_value_are_no_temperatures(save, dtype, marks, unit):
    kelvin = unit != "celsius*100"
    scaled = 100 * (np.full((10, 12), 30.0) + (273.15 if kelvin else 0))
    values = scaled.astype(dtype)
    values[0, : len(marks)] = marks
    photo = read_thermal_photo(save("a.tiff", values), Overrides(unit=unit))
    assert not photo.valid[0, : len(marks)].any()
    assert photo.valid.sum() == photo.valid.size - len(marks)
    np.testing.assert_allclose(photo.temperature_c[photo.valid], 30.0, atol=0.02)


def test_signalling_nan_is_masked(save):
    values = SCENE_C.copy()
    values.view(np.uint32)[0, 0] = 0x7F800001
    photo = read_thermal_photo(save("a.tiff", values))
    assert photo.valid.sum() == photo.valid.size - 1


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_grey_with_bounds(save, dtype, white):
    pixels = np.array([[0, white], [white // 5, white // 3]], dtype=dtype)
    photo = read_thermal_photo(save("a.png", pixels), Overrides(bounds_c=(-10, 40)))
    np.testing.assert_allclose(photo.temperature_c, [[-10, 40], [0, 20 / 3]], atol=1e-3)
    assert photo.facts.warnings == ()


def with_alpha() -> Image.Image:
    return Image.fromarray(np.array([[0, 255], [51, 85]], dtype=np.uint8)).convert("LA")


def numbered() -> Image.Image:
    image = Image.new("P", (2, 2))
    image.putpalette([shade for grey in (85, 51, 255, 0) for shade in (grey, grey, grey)])
    image.putdata([3, 2, 1, 0])
    return image


@pytest.mark.parametrize("image", [with_alpha(), numbered()], ids=["with alpha", "numbered"])
def test_grey_is_that_which_one_sees_however_it_is_stored(tmp_path, image):
    image.save(tmp_path / "a.png")
    photo = read_thermal_photo(tmp_path / "a.png", Overrides(bounds_c=(-10, 40)))
    np.testing.assert_allclose(photo.temperature_c, [[-10, 40], [0, 20 / 3]], atol=1e-3)


def test_grey_without_bounds_is_relative(save):
    photo = read_thermal_photo(save("a.png", np.array([[0, 51], [102, 255]], dtype=np.uint8)))
    np.testing.assert_allclose(photo.relative, [[0, 0.2], [0.4, 1]], atol=1e-6)
    assert photo.temperature_c is None
    assert "need bounds" in photo.facts.warnings[0]


def grey_in_colour() -> np.ndarray:
    return np.repeat(np.rint(SCENE_C * 8)[..., None], 3, axis=2).astype(np.uint8)


def test_grey_saved_as_a_jpeg_in_colour(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(grey_in_colour()).save(path, quality=95)
    photo = read_thermal_photo(path, Overrides(bounds_c=(0, 255 / 8)))
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=0.6)


def test_a_colour_palette_has_no_temperatures_but_is_used(save):
    pixels = np.zeros((4, 6, 3), dtype=np.uint8)
    pixels[:, :3], pixels[:, 3:] = (40, 0, 120), (255, 220, 60)
    path = save("a.png", pixels)
    photo = read_thermal_photo(path, Overrides(emissivity=0.9))
    assert photo.temperature_c is None
    assert photo.valid.all()
    assert 0 < photo.relative[0, 0] < photo.relative[0, 5] < 1
    assert "shows colours" in photo.facts.warnings[0]
    assert photo.facts.warnings[1].startswith("emissivity had no effect")
    with pytest.raises(SceneError, match="palette"):
        read_thermal_photo(path, Overrides(bounds_c=(0, 1)))


def test_grey_with_a_unit(save):
    with pytest.raises(SceneError, match="shades of grey") as caught:
        read_thermal_photo(save("a.png", np.eye(3, dtype=np.uint8)), Overrides(unit="kelvin"))
    assert caught.value.options == ("bounds_c",)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "a.tif: is empty"),
        (b"hello", "a.tif: is not an"),
        (b"\x89PNG\r\n\x1a\n", "a.tif: .*decoded"),
        (b"\xff\xd8\xff\xe0", "a.tif: .*decoded"),
    ],
)
def test_no_image(save, content, message):
    with pytest.raises(SceneError, match=message):
        read_thermal_photo(save("a.tif", content))


def test_an_image_that_is_cut_off(save):
    file = io.BytesIO()
    Image.fromarray(np.rint(100 * SCENE_C).astype(np.uint16)).save(file, "PNG")
    with pytest.raises(SceneError, match="decoded"):
        read_thermal_photo(save("a.png", file.getvalue()[:200]))


def test_an_image_that_is_too_large(save):
    path = save("a.png", np.zeros((5001, 5000), dtype=np.uint8))
    with pytest.raises(SceneError, match="25 megapixels"):
        read_thermal_photo(path)


def test_a_missing_file(tmp_path):
    with pytest.raises(SceneError, match="cannot be read"):
        read_thermal_photo(tmp_path / "none.jpg")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"emissivity": 0.0}, r"emissivity = 0 .*0\.01"),
        ({"humidity": 50.0}, r"humidity = 50 .*0\.5"),
        ({"distance_m": float("nan")}, "distance_m = nan"),
        ({"unit": "rankine"}, "'rankine'"),
        ({"unit": "kelvin*0"}, r"'kelvin\*0' .* factor"),
        ({"bounds_c": (30.0, 10.0)}, "30 to 10"),
        ({"bounds_c": (1.0, 2.0), "unit": "kelvin"}, "unit and bounds"),
    ],
)
def test_overrides_that_cannot_be(given, message):
    with pytest.raises(ConfigError, match=message):
        Overrides(**given)


def test_bounds_without_effect_are_said(save):
    photo = read_thermal_photo(save("a.tiff", SCENE_C), Overrides(bounds_c=(0, 50)))
    (warning,) = photo.facts.warnings
    assert warning.startswith("bounds_c had no effect")


def test_bounds_for_other_integers(save):
    with pytest.raises(SceneError, match="16-bit shades"):
        read_thermal_photo(
            save("a.tif", np.full((3, 4), -5, dtype=np.int16)), Overrides(bounds_c=(0, 50))
        )


def float_page(at: float = 0.0) -> Image.Image:
    return Image.fromarray(SCENE_C + np.float32(at))


def test_a_recording_is_refused(tmp_path):
    path = tmp_path / "a.tif"
    float_page().save(path, save_all=True, append_images=[float_page(1), float_page(2)])
    with pytest.raises(SceneError, match="recording of 3 frames; export the frames"):
        read_thermal_photo(path)


@pytest.mark.parametrize(
    "other",
    [
        Image.new("RGB", (30, 20)),
        Image.new("L", (30, 20)),
        Image.new("1", (30, 20)),
        float_page().resize((15, 10)),
        None,
    ],
    ids=["preview", "grey preview", "mask", "smaller copy", "damaged page"],
)
def test_pages_beside_the_photo(tmp_path, other):
    path = tmp_path / "a.tif"
    float_page().save(path, save_all=True, append_images=[other or float_page(1)])
    if other is None:
        path.write_bytes(path.read_bytes()[: -SCENE_C.nbytes - 100])
    photo = read_thermal_photo(path)
    np.testing.assert_allclose(photo.temperature_c, SCENE_C, atol=1e-4)
    assert photo.facts.warnings == ()
