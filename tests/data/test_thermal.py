from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.images import probe
from mrgs.data.load import bounds_of_images, check_kinds, decode_thermal, read_bounds
from mrgs.data.sources import ReadingNotes
from mrgs.errors import MrgsWarning, SceneError
from mrgs.scene import THERMAL, TemperatureRange
from tests.helpers.layouts import HEIGHT, WIDTH


def celsius(path: Path, *values: float) -> Path:
    Image.fromarray(np.array([values], dtype=np.float32)).save(path)
    return path


def bounds(root: Path, **content) -> None:
    (root / "temperature_bounds.json").write_text(json.dumps(content))


def test_bounds_that_are_no_file_are_not_passed_over(tmp_path):
    (tmp_path / "temperature_bounds.json").mkdir()
    with pytest.raises(SceneError, match=r"bounds\.json: cannot be read"):
        read_bounds(tmp_path, ReadingNotes())


@pytest.mark.parametrize("folder", ["", "thermal"])
def test_bounds_in_the_scene_or_in_thermal(tmp_path, folder):
    (tmp_path / "thermal").mkdir()
    bounds(tmp_path / folder, absolute_min_temperature=-4.5, absolute_max_temperature=30)
    notes = ReadingNotes()
    assert read_bounds(tmp_path, notes) == TemperatureRange(-4.5, 30.0)
    assert notes.all == []


@pytest.mark.parametrize("unit", ["K", "kelvin", "degK", "°C", "℃", "Celsius", "F"])
def test_bounds_may_name_their_unit(tmp_path, unit):
    scale = {"k": (273.15, 1.0), "c": (0.0, 1.0), "f": (32.0, 1.8)}
    zero, degree = scale[unit.replace("℃", "C").removeprefix("deg").removeprefix("°")[0].lower()]
    low, high = (zero + degree * celsius for celsius in (-4.5, 30.0))
    bounds(tmp_path, unit=unit, absolute_min_temperature=low, absolute_max_temperature=high)
    found = read_bounds(tmp_path, ReadingNotes())
    assert (found.min_c, found.max_c) == pytest.approx((-4.5, 30.0))


def test_swapped_bounds(tmp_path):
    bounds(tmp_path, absolute_min_temperature=30, absolute_max_temperature=-4.5)
    notes = ReadingNotes()
    assert read_bounds(tmp_path, notes) == TemperatureRange(-4.5, 30.0)
    assert "swapped" in notes.repaired[0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "absolute_min_temperature is None"),
        (
            {"absolute_min_temperature": "cold", "absolute_max_temperature": 3},
            "is 'cold'",
        ),
        ({"absolute_min_temperature": 3, "absolute_max_temperature": 3}, "temperature range"),
        (
            {"absolute_min_temperature": -300, "absolute_max_temperature": 3},
            "temperature range",
        ),
        (
            {"absolute_min_temperature": 3, "absolute_max_temperature": float("nan")},
            "absolute_max_temperature is nan",
        ),
        (
            {"unit": "mK", "absolute_min_temperature": 3, "absolute_max_temperature": 5},
            "unit is 'mK'",
        ),
    ],
)
def test_bounds_that_cannot_be_used(tmp_path, content, message):
    bounds(tmp_path, **content)
    with pytest.raises(SceneError, match=f"temperature_bounds.json: .*{message}"):
        read_bounds(tmp_path, ReadingNotes())


def test_the_range_of_float_images_is_rounded_outwards(tmp_path):
    paths = [celsius(tmp_path / "a.tiff", -2.25, 7.0, np.nan), celsius(tmp_path / "b.tiff", 9.5)]
    assert bounds_of_images(paths) == TemperatureRange(-3, 10)
    assert bounds_of_images([celsius(tmp_path / "c.tiff", 20.0)]) == TemperatureRange(20, 21)


def test_float_images_without_a_temperature(tmp_path):
    for name, value in (("a", np.nan), ("b", -1000.0), ("c", 3e38)):
        with pytest.raises(SceneError, match=rf"{name}\.tiff: .*plausible"):
            bounds_of_images([celsius(tmp_path / f"{name}.tiff", value)])
    path = celsius(tmp_path / "d.tiff", 20.0, -1000.0, 3e38)
    assert bounds_of_images([path]) == TemperatureRange(20, 21)


def test_celsius_are_mapped_and_not_clamped(tmp_path):
    values, valid = decode_thermal(
        celsius(tmp_path / "a.tiff", 10.0, 15.0, 35.0), None, TemperatureRange(10.0, 30.0)
    )
    assert values[..., 0].tolist() == [[0.0, 0.25, 1.25]]
    assert valid is None
    with pytest.raises(SceneError, match="not known"):
        decode_thermal(tmp_path / "a.tiff", None, None)


def test_integers_are_spread_over_the_range_already(tmp_path):
    Image.fromarray(np.array([[0, 13107, 65535]], dtype=np.uint16)).save(tmp_path / "a.png")
    values, _ = decode_thermal(tmp_path / "a.png", None, TemperatureRange(10.0, 30.0))
    np.testing.assert_allclose(values[..., 0], [[0.0, 0.2, 1.0]], atol=1e-7)


def test_the_luminance_of_a_grey_image_in_colour_is_its_grey(tmp_path):
    Image.fromarray(np.full((2, 2, 3), 77, dtype=np.uint8)).save(tmp_path / "a.png")
    values, _ = decode_thermal(tmp_path / "a.png", None, None)
    np.testing.assert_allclose(values, 77 / 255, atol=1e-7)
    assert values.shape == (2, 2, 1)


def test_kinds_that_do_not_fit_together(tmp_path):
    Image.new("L", (1, 1)).save(tmp_path / "a.png")
    Image.new("RGB", (1, 1)).save(tmp_path / "c.png")
    paths = [tmp_path / "a.png", celsius(tmp_path / "b.tiff", 10.0), tmp_path / "c.png"]
    kinds = [(path, probe(path).kind) for path in paths]
    with pytest.raises(SceneError, match=r"b\.tiff: holds °C"):
        check_kinds(kinds, False, ReadingNotes())
    notes = ReadingNotes()
    assert check_kinds(kinds, True, notes) == "float"
    assert "luminance" in notes.all[0]
    assert check_kinds(kinds[:1], True, ReadingNotes()) == "grey"


def centikelvin(writer, low_c: float = 21.8, high_c: float = 47.2) -> None:
    """A scene whose thermal images are 16-bit K × 100."""
    for index, name in enumerate(["a", "b", "c"]):
        writer.image(f"images/{name}.png", seed=index)
        celsius = np.linspace(low_c, high_c, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH)
        values = np.round(100 * (celsius + 273.15)).astype(np.uint16)
        Image.fromarray(values).save(writer.image(f"thermal/{name}.png", "I;16"))
    writer.colmap(["a.png", "b.png", "c.png"], binary=True)


def test_centikelvin_are_read_as_such(writer):
    centikelvin(writer)
    with pytest.warns(MrgsWarning, match=r"taken for K × 100 \(22\.\d to 46\.9 °C\)"):
        scene = load_scene(writer.root)
    assert (scene.temperature.min_c, scene.temperature.max_c) == (21.0, 48.0)
    values = scene.train[0].images[THERMAL].load().values
    celsius = scene.temperature.to_celsius(values)
    assert (celsius.min().item(), celsius.max().item()) == pytest.approx((21.8, 47.2), abs=0.3)


def test_bounds_beside_what_looks_like_centikelvin_are_doubted(writer):
    centikelvin(writer)
    writer.bounds(20.0, 50.0)
    with pytest.warns(MrgsWarning, match="If they are K × 100 .*, remove temperature_bounds"):
        scene = load_scene(writer.root)
    assert scene.temperature.max_c == 50.0


def test_shades_of_16_bits_are_no_centikelvin(writer):
    centikelvin(writer, -200.0, 300.0)
    assert load_scene(writer.root).temperature is None


def test_a_colour_palette_has_no_celsius_whatever_the_bounds_say(writer):
    for name in ("images/a.png", "thermal/a.png"):
        writer.image(name)
    writer.bounds(20.0, 50.0)
    writer.colmap(["a.png"], binary=True)
    with pytest.warns(MrgsWarning, match="colour palette"):
        assert load_scene(writer.root).temperature is None
