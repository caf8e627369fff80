"""What a folder holds, said before anything is done with it."""

from __future__ import annotations

from pathlib import Path

import pytest

from mrgs.data.radiometric import Overrides
from mrgs.errors import ConfigError, SceneError
from mrgs.pipeline.plan import is_scene, take_in
from mrgs.prepare import PrepareOptions
from mrgs.scene import RGB, THERMAL
from tests.helpers.photos import photo


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder


def pairs(count: int, thermal: bytes) -> dict[str, bytes]:
    """Photos as a DJI camera names them."""
    name = "DJI_202405141030{:02d}_{:04d}_{}.{}"
    suffix = "JPG" if thermal.startswith(b"\xff\xd8") else "tiff"
    found = {}
    for number in range(1, count + 1):
        found[name.format(number, number, "V", "JPG")] = photo("jpg", (32, 24))
        found[name.format(number, number, "T", suffix)] = thermal
    return found


def grey_pairs(count: int) -> dict[str, bytes]:
    """Photos beside grey pictures without a scale."""
    colours = {f"rgb/{number}.jpg": photo("jpg", (32, 24)) for number in range(count)}
    return colours | {f"thermal/{number}.png": photo("png") for number in range(count)}


def test_pairs_with_temperatures(tmp_path):
    folder = write(tmp_path, {**pairs(9, photo("celsius")), "notes.txt": b"mine"})
    found = take_in(folder, PrepareOptions())
    assert (found.kind, found.views, found.held_out, found.has_celsius) == ("photos", 9, 2, True)
    assert found.sizes == {RGB: (32, 24), THERMAL: (16, 12)}
    parts = found.summary.split(", ")
    assert parts[:3] == ["9 pairs", "RGB 32×24 px", "thermal 16×12 px"]
    assert "°C" in parts[3]
    assert found.facts[-1].startswith("1 other file")
    assert take_in(folder, PrepareOptions(eval_every=0)).held_out == 0


def test_pairs_without_temperatures(tmp_path):
    found = take_in(write(tmp_path, pairs(3, photo("jpg"))), PrepareOptions())
    assert found.summary.endswith("no °C (relative values)")
    assert "colours" in found.without_celsius
    assert not found.takes_bounds, "a palette has no black and white"


def test_shades_of_grey_become_temperatures_by_bounds(tmp_path):
    folder = write(tmp_path, grey_pairs(3))
    found = take_in(folder, PrepareOptions())
    assert "grey" in found.without_celsius
    assert found.takes_bounds
    bounded = take_in(folder, PrepareOptions(overrides=Overrides(bounds_c=(0.0, 50.0))))
    assert (bounded.has_celsius, bounded.without_celsius, bounded.takes_bounds) == (True, "", False)


def test_photos_with_an_embedded_photo(tmp_path):
    files = {f"FLIR{number:04d}.jpg": photo("flir with visible") for number in range(1, 5)}
    found = take_in(write(tmp_path, files), PrepareOptions())
    assert found.views == 4
    assert found.sizes[RGB] == (24, 20)
    assert found.camera
    assert found.camera in found.summary


def test_thermal_photos_alone(tmp_path):
    files = {f"thermal/{number}.tiff": photo("celsius") for number in range(4)}
    found = take_in(write(tmp_path, files), PrepareOptions())
    assert [*found.sizes] == [THERMAL]
    assert found.summary.startswith("4 photos, thermal 16×12 px")


def test_a_scene(small_scene):
    assert is_scene(small_scene)
    found = take_in(small_scene, PrepareOptions())
    assert (found.kind, found.views, found.held_out, found.points) == ("scene", 8, 2, 25)
    parts = found.summary.split(", ")
    assert parts[:3] == ["8 views", "RGB 40×30 px", "thermal 40×30 px"]
    assert "°C" in parts[3]
    assert take_in(small_scene / "transforms.json", PrepareOptions()).views == 8


def test_options_for_photos_are_not_ignored_in_a_scene(small_scene):
    """Nobody should read temperatures that they believe to be corrected for an emissivity."""
    options = PrepareOptions(overrides=Overrides(emissivity=0.9), eval_every=0)
    with pytest.raises(ConfigError, match="is a scene") as caught:
        take_in(small_scene, options)
    assert caught.value.options == ("emissivity", "eval_every")


def test_one_photo_that_cannot_be_read_is_passed_over(tmp_path):
    folder = write(tmp_path, pairs(4, photo("flir")))
    first = min(folder.glob("*_T.JPG"))
    first.write_bytes(first.read_bytes()[:-3000] + bytes(100))
    assert take_in(folder, PrepareOptions()).has_celsius


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "holds no photos"),
        ({"a.txt": b"text", "b.pdf": b"%PDF-1.4"}, "none of its 2 files"),
        (pairs(1, photo("celsius")), "1 pair .*at least 3"),
        (pairs(2, photo("celsius")), "2 pairs"),
        ({f"{number}.jpg": photo("jpg") for number in range(5)}, "known to be thermal"),
        (pairs(3, photo("dji", model="DJI M3T")), "dji_irp"),
    ],
    ids=["empty", "other files", "one", "two", "no thermal", "R-JPEG"],
)
def test_what_cannot_be_used_is_said_in_one_line(files, message, tmp_path):
    with pytest.raises(SceneError, match=message) as error:
        take_in(write(tmp_path, files), PrepareOptions())
    assert "\n" not in str(error.value)


def test_a_wrong_path_is_named(tmp_path):
    with pytest.raises(SceneError, match="nowhere: not"):
        take_in(tmp_path / "nowhere", PrepareOptions())


def test_a_unit_that_is_not_known_is_the_option_of_the_error(tmp_path):
    import io

    import numpy as np
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(np.full((12, 16), 200.0, np.float32)).save(file, "TIFF")
    folder = write(tmp_path, pairs(3, file.getvalue()))
    with pytest.raises(SceneError) as error:
        take_in(folder, PrepareOptions())
    assert "unit" in error.value.options
    given = PrepareOptions(overrides=Overrides(unit="celsius"))
    assert take_in(folder, given).has_celsius
