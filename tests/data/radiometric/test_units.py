"""Units of stored temperatures: by the maker's tags, by the user's word, or by a guess that is
told."""

from __future__ import annotations

import struct
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from PIL import Image, TiffImagePlugin
from PIL.TiffImagePlugin import IFDRational

from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.data.radiometric.units import INTEGER_UNITS, Unit
from mrgs.errors import ConfigError, SceneError
from tests.helpers.flir import FlirPhoto

WALL_C = np.linspace(12, 18, 20 * 30, dtype=np.float64).reshape(20, 30)
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF
 xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"
 xmlns:Camera="http://pix4d.com/camera/1.0/"><rdf:Description>{}</rdf:Description></rdf:RDF>
</x:xmpmeta>"""
LWIR = "<Camera:BandName><rdf:Seq><rdf:li>LWIR</rdf:li></rdf:Seq></Camera:BandName>"


def counts(unit: str, celsius: np.ndarray = WALL_C) -> np.ndarray:
    """What a camera stores for temperatures in a unit."""
    zero, one = Unit.parse(unit).celsius(np.array([0.0, 1.0]))
    return np.rint((celsius - zero) / (one - zero)).astype(np.uint16)


@pytest.fixture
def tiff(tmp_path):
    """Writes a 16-bit TIFF with tags and XMP, and gives its path."""

    def write(values: np.ndarray, tags: dict[int, object] | None = None, xmp: str = ""):
        directory = TiffImagePlugin.ImageFileDirectory_v2()
        for tag, value in (tags or {}).items():
            directory[tag] = value
        if xmp:
            directory[700] = XMP.format(xmp).encode()
            directory.tagtype[700] = 1
        path = tmp_path / "a.tif"
        Image.fromarray(values).save(path, tiffinfo=directory)
        return path

    return write


@pytest.mark.parametrize(
    ("unit", "tags", "xmp"),
    [
        ("(celsius+100)*40", {271: "Workswell", 272: "WIRIS Pro"}, ""),
        ("kelvin*25", {271: "FLIR", 272: "Vue Pro R"}, "<Camera:TlinearGain>0.04"),
        ("kelvin*2.5", {271: "FLIR"}, "<Camera:TlinearGain>0.40</Camera:TlinearGain>"),
        ("kelvin*100", {271: "MicaSense", 272: "Altum"}, LWIR),
    ],
)
def test_tags_that_state_the_unit(tiff, unit, tags, xmp):
    photo = read_thermal_photo(tiff(counts(unit), tags, xmp))
    np.testing.assert_allclose(photo.temperature_c, WALL_C, atol=0.21)
    assert photo.facts.warnings == ()
    assert photo.facts.unit is None


def test_a_known_camera_of_an_unusual_scene(tiff):
    """A furnace is no everyday scene, and the camera is known all the same."""
    hot = WALL_C + 400
    tags = {271: "Workswell", 272: "WIRIS Pro"}
    photo = read_thermal_photo(tiff(counts("(celsius+100)*40", hot), tags))
    np.testing.assert_allclose(photo.temperature_c, hot, atol=0.02)


def test_another_unit_of_the_same_maker_is_a_doubt(tiff):
    tags = {271: "Workswell", 272: "WIRIS Pro"}
    cold = WALL_C - 30
    photo = read_thermal_photo(tiff(counts("kelvin*25", cold), tags))
    (warning,) = photo.facts.warnings
    assert "kelvin*25 (−17.9 to −12.1 °C)" in warning


@pytest.mark.parametrize(
    ("xmp", "why"),
    [
        ("<Camera:TlinearGain>0.00</Camera:TlinearGain>", "counts"),
        ("<Camera:TlinearGain>-0.04</Camera:TlinearGain>", "counts"),
        ("<Camera:TlinearGain>0.0000000001</Camera:TlinearGain>", "counts"),
        (LWIR.replace("LWIR", "Rededge"), "REDEDGE"),
    ],
)
def test_tags_of_numbers_that_are_no_temperatures(tiff, xmp, why):
    with pytest.raises(SceneError, match=why):
        read_thermal_photo(tiff(counts("kelvin*25"), {271: "FLIR"}, xmp))


@pytest.mark.parametrize("gain", ["e", "", "nan", "K"])
def test_a_damaged_tag_states_nothing(tiff, gain):
    photo = read_thermal_photo(
        tiff(counts("kelvin*25"), {271: "FLIR"}, f"<Camera:TlinearGain>{gain}</Camera:TlinearGain>")
    )
    np.testing.assert_allclose(photo.temperature_c, WALL_C, atol=0.03)
    assert len(photo.facts.warnings) == 1


def test_numbers_without_tags_that_two_units_fit_are_asked_for(tiff):
    with pytest.raises(SceneError, match=r"celsius\*100.*\(celsius\+100\)\*40") as caught:
        read_thermal_photo(tiff(counts("(celsius+100)*40")))
    assert caught.value.options == ("unit",)


def test_a_guess_is_a_warning_with_two_alternatives(tiff):
    photo = read_thermal_photo(tiff(counts("kelvin*100")))
    np.testing.assert_allclose(photo.temperature_c, WALL_C, atol=0.006)
    (warning,) = photo.facts.warnings
    assert "kelvin*100 (12.1 to 17.9 °C)" in warning
    assert warning.count(" °C)") == 3


@pytest.mark.parametrize("highest", [1, 2])
def test_numbers_from_0_to_1_may_be_no_temperatures(tiff, highest):
    values = np.linspace(0, highest, 600, dtype=np.float32).reshape(20, 30)
    doubts = read_thermal_photo(tiff(values)).facts.warnings
    assert ["from 0 to 1" in doubt for doubt in doubts] == ([True] if highest == 1 else [])
    assert read_thermal_photo(tiff(values), Overrides(unit="celsius")).facts.warnings == ()


@pytest.mark.parametrize("unit", INTEGER_UNITS)
def test_no_unit_is_taken_for_another_in_silence(tiff, unit):
    """Numbers without tags are asked for, or right; each guess is told."""
    photo, asked = None, ()
    try:
        photo = read_thermal_photo(tiff(counts(unit)))
    except SceneError as error:
        asked = error.options
    assert asked == ("unit",) if photo is None else photo.facts.warnings


@pytest.mark.parametrize(
    "unit",
    ["celsius*40+4000", "(celsius+100)*40", "( Celsius + 100 ) * 40", "celsius*40+100"],
)
def test_a_unit_with_an_addend(tiff, unit):
    photo = read_thermal_photo(tiff(counts("(celsius+100)*40")), Overrides(unit=unit))
    np.testing.assert_allclose(photo.temperature_c, WALL_C, atol=0.02)


def test_a_unit_with_a_negative_addend(tiff):
    values = np.rint(10 * WALL_C - 50).astype(np.uint16)
    photo = read_thermal_photo(tiff(values), Overrides(unit="celsius*10-50"))
    np.testing.assert_allclose(photo.temperature_c, WALL_C, atol=0.06)
    assert photo.facts.warnings == ()


@pytest.mark.parametrize("unit", ["celsius*0", "celsius+", "(celsius+1)", "rankine", "40*celsius"])
def test_units_that_cannot_be(unit):
    with pytest.raises(ConfigError, match="unit") as caught:
        Overrides(unit=unit)
    assert caught.value.options == ("unit",)


def test_tags_in_the_main_directory(tiff):
    """Workswell writes time, focal length and the pixels' size on the sensor; a fraction of a
    second is a ratio."""
    tags = {
        271: "Workswell",
        272: "WIRIS Pro",
        36867: "2024:10:30 10:59:13",
        34665: {
            37521: "73/1000",
            37386: IFDRational(13),
            41486: IFDRational(640000, 1088),
            41488: 3,
        },
    }
    wide = np.repeat(np.repeat(counts("(celsius+100)*40"), 32, axis=0), 64, axis=1)[:512, :640]
    facts = read_thermal_photo(tiff(wide, tags)).facts
    assert facts.taken == datetime(2024, 10, 30, 10, 59, 13, 73_000)
    assert facts.field_of_view_deg == pytest.approx(45.4, abs=0.1)


def workswell_jpeg(values: np.ndarray) -> bytes:
    """A record in FLIR's format without constants, in parts that are all numbered 0 of 0."""
    no_planck = dict.fromkeys(("r1", "r2", "b", "f"), 0.0) | {"o": 0}
    photo = FlirPhoto(raw=values, planck=no_planck)
    record = bytearray(photo.record())
    record[4:20] = b"WWP".ljust(16, b"\0")
    struct.pack_into(">I", record, 20, 211)
    parts = [record[:1000], record[1000:]]
    segments = b"".join(
        b"\xff\xe1" + struct.pack(">H", len(part) + 10) + b"WORK\0\1\0\0" + part for part in parts
    )
    picture = replace(photo).jpeg(b"")
    return picture[:2] + segments + picture[2:]


def test_workswell_jpeg(tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(workswell_jpeg(counts("(celsius+100)*40")))
    photo = read_thermal_photo(path)
    np.testing.assert_allclose(photo.temperature_c, WALL_C, atol=0.02)
    assert photo.facts.parameters is None
    assert photo.facts.serial == "4711"
