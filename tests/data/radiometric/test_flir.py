"""FLIR photos: what is written by hand comes back, and what is damaged is named."""

from __future__ import annotations

import io
import math
import struct
import sys
from datetime import datetime

import numpy as np
import pytest
from PIL import Image

from mrgs.data.radiometric import GpsPosition, Overrides, read_thermal_photo
from mrgs.errors import SceneError
from tests.helpers.flir import FlirPhoto


def expected_celsius(counts: np.ndarray, planck: dict, parameters: dict) -> np.ndarray:
    """The measurement formula, solved by bisection on the object's temperature: nothing is inverted
    by hand."""
    alpha1, alpha2, beta1, beta2, x = 0.006569, 0.01262, -0.002276, -0.00667, 1.9
    t = parameters["atmospheric_c"]
    water = parameters["humidity"] * np.exp(
        1.5587 + 6.939e-2 * t - 2.7816e-4 * t**2 + 6.8455e-7 * t**3
    )
    root = np.sqrt(parameters["distance_m"])
    tau = x * np.exp(-root * (alpha1 + beta1 * np.sqrt(water)))
    tau += (1 - x) * np.exp(-root * (alpha2 + beta2 * np.sqrt(water)))
    eps, window = parameters["emissivity"], parameters["window_transmission"]

    def signal(celsius):
        exponential = np.exp(planck["b"] / (celsius + 273.15))
        return planck["r1"] / (planck["r2"] * (exponential - planck["f"])) - planck["o"]

    def total(celsius):
        at_window = eps * tau * signal(celsius) + (1 - eps) * tau * signal(
            parameters["reflected_c"]
        )
        at_window += (1 - tau) * signal(parameters["atmospheric_c"])
        return window * at_window + (1 - window) * signal(parameters["window_c"])

    low, high = np.full(counts.shape, -100.0), np.full(counts.shape, 400.0)
    for _ in range(60):
        middle = (low + high) / 2
        above = total(middle) > counts
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return low


@pytest.mark.parametrize("storage", ["bare", "png", "swapped png", "jpeg-ls"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_every_storage_gives_the_same_temperatures(save, storage, order):
    written = FlirPhoto(storage=storage, order=order)
    photo = read_thermal_photo(save("a.jpg", written.jpeg()))
    expected = expected_celsius(written.raw.astype(float), written.planck, written.parameters)
    assert photo.temperature_c.dtype == np.float32
    np.testing.assert_allclose(photo.temperature_c, expected, atol=1e-3)
    assert photo.valid.all()
    assert photo.relative is None


@pytest.mark.parametrize(
    "changed",
    [
        {"emissivity": 0.6},
        {"distance_m": 150.0},
        {"reflected_c": -40.0},
        {"atmospheric_c": 35.0, "distance_m": 80.0},
        {"humidity": 0.9, "distance_m": 80.0},
        {"window_c": 60.0, "window_transmission": 0.7},
    ],
)
def test_parameters_from_the_file_and_given_by_hand_are_equal(save, changed):
    plain, stored = FlirPhoto(), FlirPhoto()
    stored.parameters.update(changed)
    expected = expected_celsius(plain.raw.astype(float), plain.planck, stored.parameters)
    from_file = read_thermal_photo(save("a.jpg", stored.jpeg()))
    by_hand = read_thermal_photo(save("b.jpg", plain.jpeg()), Overrides(**changed))
    np.testing.assert_allclose(from_file.temperature_c, expected, atol=2e-3)
    np.testing.assert_allclose(by_hand.temperature_c, expected, atol=2e-3)
    before = read_thermal_photo(save("b.jpg", plain.jpeg())).temperature_c
    assert np.abs(by_hand.temperature_c - before).max() > 0.05
    assert by_hand.facts.parameters == from_file.facts.parameters


def test_humidity_in_per_cent(save):
    written = FlirPhoto()
    written.parameters["humidity"] = 40.0
    assert read_thermal_photo(save("a.jpg", written.jpeg())).facts.parameters.humidity == 0.4


def test_facts(save):
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "FLIR Systems AB", "Ex"
    exif.get_ifd(0x8769)[0x9003] = "2024:02:03 04:05:06"
    exif.get_ifd(0x8769)[0x9291] = "50"
    exif.get_ifd(0x8825).update(
        {1: "S", 2: (33.0, 30.0, 36.0), 3: "E", 4: (151.0, 0.0, 0.0), 5: b"\1", 6: 12.5}
    )
    facts = read_thermal_photo(save("a.jpg", FlirPhoto(exif=exif).jpeg())).facts
    assert (facts.camera, facts.serial) == ("Test Camera", "4711")
    assert facts.taken == datetime(2024, 2, 3, 4, 5, 6, 500_000)
    assert facts.gps == GpsPosition(-33.51, 151.0, -12.5)
    assert facts.calibrated_c == (-20.0, 120.0)
    assert facts.parameters.emissivity == 0.95
    assert facts.visible is None


def test_the_scale_of_the_picture_follows_the_formula(save):
    written = FlirPhoto()
    low, high = read_thermal_photo(save("a.jpg", written.jpeg())).facts.scale_c
    ends = expected_celsius(np.array([15000.0, 17000.0]), written.planck, written.parameters)
    np.testing.assert_allclose([low, high], ends, atol=0.01)


def test_a_bare_record_and_its_time(save):
    photo = read_thermal_photo(save("a.fff", FlirPhoto().record()))
    assert photo.facts.taken == datetime(2013, 3, 12, 16, 31, 23, 250_000)
    assert photo.facts.source == "FLIR thermal record"
    assert photo.valid.all()


def test_the_time_of_a_record_is_that_of_the_camera_s_zone(save):
    stamp = struct.pack("<IIh", 1_363_105_883, 0x50000 | 250, -60)  # an hour before UTC
    record = FlirPhoto(info_fields={0x384: stamp}).record()
    taken = read_thermal_photo(save("a.fff", record)).facts.taken
    assert taken == datetime(2013, 3, 12, 17, 31, 23, 250_000)


def test_many_parts(save):
    written = FlirPhoto(part_bytes=9)  # more parts than one byte counts
    photo = read_thermal_photo(save("a.jpg", written.jpeg()))
    reference = read_thermal_photo(save("b.jpg", FlirPhoto().jpeg()))
    np.testing.assert_array_equal(photo.temperature_c, reference.temperature_c)


def colours() -> np.ndarray:
    pixels = np.zeros((16, 24, 3), dtype=np.uint8)
    pixels[:, :12] = (200, 40, 30)
    pixels[:, 12:] = (20, 60, 190)
    return pixels


def test_visible_photo_as_jpeg(save):
    file = io.BytesIO()
    Image.fromarray(colours()).save(file, "JPEG", quality=95)
    visible = read_thermal_photo(
        save("a.jpg", FlirPhoto(visible=file.getvalue()).jpeg())
    ).facts.visible
    assert visible.data == file.getvalue()
    assert np.abs(visible.pixels().astype(int) - colours())[:, [2, 20]].max() < 12


def test_visible_photo_as_png_holds_luma_and_chroma(save):
    file = io.BytesIO()
    luma_chroma = np.array(Image.fromarray(colours()).convert("YCbCr"))
    Image.fromarray(luma_chroma).save(file, "PNG")
    visible = read_thermal_photo(
        save("a.jpg", FlirPhoto(visible=file.getvalue()).jpeg())
    ).facts.visible
    assert np.abs(visible.pixels().astype(int) - colours()).max() <= 4


def test_a_visible_photo_of_another_kind_is_left_out_and_said(save):
    facts = read_thermal_photo(save("a.jpg", FlirPhoto(visible=b"GIF89a").jpeg())).facts
    assert facts.visible is None
    assert any("unknown kind" in warning for warning in facts.warnings)


def test_a_damaged_visible_photo_leaves_the_temperatures(save):
    photo = read_thermal_photo(save("a.jpg", FlirPhoto(visible=b"\xff\xd8\xff nothing").jpeg()))
    assert photo.valid.all()
    with pytest.raises(SceneError, match="decoded"):
        photo.facts.visible.pixels()


def test_pixels_without_a_temperature_are_masked(save):
    written = FlirPhoto()
    written.raw[0, :3] = (0, 65535, 1)  # no data, saturated, colder than its surroundings allow
    photo = read_thermal_photo(save("a.jpg", written.jpeg()))
    assert not photo.valid[0, :3].any()
    assert photo.valid.sum() == photo.valid.size - 3
    np.testing.assert_array_equal(np.isfinite(photo.temperature_c), photo.valid)
    assert any("are masked" in warning for warning in photo.facts.warnings)


def test_temperatures_outside_of_the_calibration_are_said(save):
    written = FlirPhoto(info_fields={0x90: struct.pack("<2f", 250 + 273.15, 100 + 273.15)})
    warnings = read_thermal_photo(save("a.jpg", written.jpeg())).facts.warnings
    assert any("100 to 250 °C" in warning and "calibrated" in warning for warning in warnings)


def test_overrides_without_effect_are_said(save):
    photo = read_thermal_photo(save("a.jpg", FlirPhoto().jpeg()), Overrides(unit="kelvin"))
    assert any(each.startswith("unit had no effect") for each in photo.facts.warnings)


@pytest.mark.parametrize(("record", "what"), [(0x01, "no raw image"), (0x20, "no camera info")])
def test_a_missing_record(save, record, what):
    with pytest.raises(SceneError, match=what):
        read_thermal_photo(save("a.jpg", FlirPhoto(without=(record,)).jpeg()))


@pytest.mark.parametrize("kept", [30, 100, 500, 1400, 2000])
def test_a_record_that_is_cut_off(save, kept):
    with pytest.raises(SceneError, match=r"cut off|not start"):
        read_thermal_photo(save("a.jpg", FlirPhoto().jpeg(FlirPhoto().record()[:kept])))


def test_a_file_that_is_cut_off(save):
    whole = FlirPhoto(part_bytes=1000).jpeg()
    for kept in (500, 1500, len(whole) - 900):
        with pytest.raises(SceneError, match=r"\d whole parts of 3"):
            read_thermal_photo(save("a.jpg", whole[:kept]))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({0x58: bytes(12), 0x308: bytes(8)}, "constants are missing"),
        (
            {0x58: struct.pack("<f", float("nan"))},
            r"\(not a number\)",
        ),
        ({0x58: struct.pack("<f", -3.0)}, r"implausible \(R1 = -3"),
        ({0x5C: struct.pack("<f", 3.0)}, r"implausible \(B = 3\)"),
        ({0x60: struct.pack("<f", 99.0)}, r"implausible \(F = 99\)"),
        (
            {0x308: struct.pack("<i", -(10**9))},
            "Planck .* plausible",
        ),
        (
            {0x20: struct.pack("<f", 0.0)},
            r"emissivity of 0 .*0\.01",
        ),
        (
            {0x24: struct.pack("<f", float("inf"))},
            "distance_m of inf",
        ),
        (
            {0x2C: struct.pack("<f", 0.0)},
            r"atmospheric_c of -273\.15",
        ),
        (
            {0x70: struct.pack("<5f", 9, 9, 9, 9, 9)},
            "distance of 0 m",
        ),
        ({0x00: b"\7\7"}, "info is damaged"),
    ],
)
def test_camera_info_that_cannot_be(save, fields, message):
    with pytest.raises(SceneError, match=message):
        read_thermal_photo(save("a.jpg", FlirPhoto(info_fields=fields).jpeg()))


@pytest.mark.parametrize(
    ("offset", "value", "option"),
    [(0x20, 0.0, "emissivity"), (0x24, math.inf, "distance_m"), (0x2C, 0.0, "atmospheric_c")],
)
def test_an_absurd_parameter_names_the_option_that_replaces_it(save, offset, value, option):
    photo = FlirPhoto(info_fields={offset: struct.pack("<f", value)})
    with pytest.raises(SceneError) as error:
        read_thermal_photo(save("a.jpg", photo.jpeg()))
    assert error.value.options == (option,)


def test_an_absurd_parameter_is_replaced_by_hand(save):
    path = save("a.jpg", FlirPhoto(info_fields={0x20: struct.pack("<f", 0.0)}).jpeg())
    assert read_thermal_photo(path, Overrides(emissivity=0.9)).valid.all()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (struct.pack("<3H26x", 2, 0, 9), "header of its raw image"),
        (struct.pack("<3H26x", 2, 60000, 60000), "cut off"),
        (struct.pack("<3H26x", 0, 8, 8), "header .* damaged"),
        (
            struct.pack("<3H26x", 2, 8, 8) + bytes(100),
            "100 of 128 bytes",
        ),
        (
            struct.pack("<3H26x", 2, 8, 8) + b"\xff\xd8\xff\xf7",
            "0 x 0 pixels of 0 × 0 bits, where 8 x 8 of 16 bits are announced",
        ),
        (
            struct.pack("<3H26x", 2, 8, 8)
            + b"\xff\xd8\xff\xf7"
            + struct.pack(">HBHHB", 11, 16, 8, 8, 1),
            "cannot be decoded",
        ),
        (struct.pack("<3H26x", 2, 8, 8) + b"\x89PNG\r\n\x1a\n", "cannot be decoded"),
    ],
)
def test_raw_images_that_cannot_be(save, content, message):
    with pytest.raises(SceneError, match=message):
        read_thermal_photo(save("a.jpg", FlirPhoto(raw_content=content).jpeg()))


def test_jpeg_ls_without_its_decoder_names_it(save, monkeypatch):
    monkeypatch.setitem(sys.modules, "jpeg_ls", None)
    with pytest.raises(SceneError, match="needs `pip install pyjpegls`"):
        read_thermal_photo(save("a.jpg", FlirPhoto(storage="jpeg-ls").jpeg()))


def test_a_raw_png_of_another_size(save):
    written = FlirPhoto(storage="png").raw_data()
    content = struct.pack("<3H26x", 2, 8, 8) + written[32:]
    with pytest.raises(SceneError, match=r"32 x 24 "):
        read_thermal_photo(save("a.jpg", FlirPhoto(raw_content=content).jpeg()))


def test_a_directory_without_end(save):
    record = bytearray(FlirPhoto().record())
    record[0x1C:0x20] = b"\x7f\xff\xff\xff"
    with pytest.raises(SceneError, match="2147483647 parts"):
        read_thermal_photo(save("a.jpg", FlirPhoto().jpeg(bytes(record))))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("between", [b"", bytes(100)])
def test_a_recording_is_refused(save, order, between):
    record = FlirPhoto(order=order).record() + between
    with pytest.raises(SceneError, match="recording of 4 frames; export the frames"):
        read_thermal_photo(save("a.seq", 4 * record))
    assert read_thermal_photo(save("a.seq", record)).temperature_c is not None


def test_a_mark_within_a_photo_is_no_second_frame(save):
    raw = FlirPhoto().raw.copy()
    raw.view(np.uint8)[3, 4:8] = list(b"FFF\0")
    assert read_thermal_photo(save("a.fff", FlirPhoto(raw=raw).record())).valid.any()
