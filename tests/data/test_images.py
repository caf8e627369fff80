from __future__ import annotations

import struct
import warnings
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data.images import (
    ImageInfo,
    decode,
    decode_mask,
    has_eight_bit_levels,
    of_eight_bit_levels,
    probe,
)
from mrgs.errors import ConfigError, SceneError


def save(path, pixels, **options):
    Image.fromarray(pixels).save(path, **options)
    return path


def test_eight_bit_grey(tmp_path):
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4)
    values, valid, kind = decode(save(tmp_path / "a.png", pixels))
    np.testing.assert_array_equal(values[..., 0], pixels.astype(np.float32) / 255)
    assert (valid, kind) == (None, "grey")


def test_sixteen_bit_grey_keeps_every_level(tmp_path):
    pixels = (np.arange(12) * 5461).astype(np.uint16).reshape(3, 4)
    for name in ("a.png", "a.tif"):
        values, valid, kind = decode(save(tmp_path / name, pixels))
        np.testing.assert_array_equal(values[..., 0], pixels.astype(np.float32) / 65535)
        assert (valid, kind) == (None, "grey")


def test_floats_are_kept_and_what_is_not_finite_is_masked(tmp_path):
    pixels = np.array([[-12.25, 80.5], [np.nan, np.inf]], dtype=np.float32)
    values, valid, kind = decode(save(tmp_path / "a.tiff", pixels))
    assert values[..., 0].tolist() == [[-12.25, 80.5], [0, 0]]
    assert valid.tolist() == [[True, True], [False, False]]
    assert kind == "float"


@pytest.mark.parametrize(
    ("dtype", "shape", "kind", "white"),
    [
        ("u1", (9, 12), "grey", 255),
        ("<u2", (9, 12), "grey", 65535),
        (">u2", (9, 12), "grey", 65535),
        ("<f4", (9, 12, 1), "float", 1),
        (">f8", (9, 12), "float", 1),
    ],
)
@pytest.mark.parametrize("order", ["C", "F"])
def test_an_array_of_numpy_is_an_image(tmp_path, dtype, shape, kind, white, order):
    numbers = np.asarray(np.arange(9 * 12).reshape(shape), dtype, order)
    np.save(tmp_path / "a.npy", numbers)
    assert probe(tmp_path / "a.npy") == ImageInfo(12, 9, kind)
    values, valid, found = decode(tmp_path / "a.npy")
    np.testing.assert_array_equal(values, numbers.reshape(9, 12, 1).astype(np.float32) / white)
    assert (valid, found) == (None, kind)


def test_an_array_of_truth_values_is_a_mask(tmp_path):
    mask = np.eye(9, 12).astype(bool)
    np.save(tmp_path / "a.npy", mask)
    assert torch.equal(decode_mask(tmp_path / "a.npy"), torch.from_numpy(mask))


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((4, 9, 12)), r"an array \[4, 9, 12\] of float64"),
        (np.zeros((40, 7)), r"\[40, 7\]"),
        (np.zeros((9, 12), complex), "of complex"),
        (np.zeros((9, 12), np.int16), "pixels of type I"),
        (np.full((9, 12), None), "allow_pickle"),
    ],
)
def test_arrays_that_are_no_image(tmp_path, array, message):
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    with pytest.raises(SceneError, match=rf"a\.npy.*{message}"):
        decode(tmp_path / "a.npy")


def test_an_array_that_is_cut_off_or_claims_too_much(tmp_path, monkeypatch):
    np.save(tmp_path / "a.npy", np.zeros((90, 120)))
    whole = (tmp_path / "a.npy").read_bytes()
    for damaged in (whole[:-7], whole[:9], whole.replace(b"(90, 120)", b"(9000000000, 1200000)")):
        (tmp_path / "a.npy").write_bytes(damaged)
        with pytest.raises(SceneError, match=r"a\.npy: cannot be decoded"):
            decode(tmp_path / "a.npy")
    (tmp_path / "a.npy").write_bytes(whole)
    monkeypatch.setenv("MRGS_MAX_MEGAPIXELS", "0.01")
    with pytest.raises(SceneError, match=r"more than 0\.01 megapixels"):
        decode(tmp_path / "a.npy")


@pytest.mark.parametrize("mode", ["RGB", "P", "CMYK"])
def test_colour(tmp_path, mode):
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    Image.new("RGB", (4, 3), (255, 0, 0)).convert(mode).save(path)
    values, valid, kind = decode(path)
    np.testing.assert_allclose(values[1, 1], [1, 0, 0], atol=0.02)
    assert (valid, kind, values.shape) == (None, "colour", (3, 4, 3))


@pytest.mark.parametrize(("colour", "channels"), [((9, 8, 7), 3), ((9,), 1)])
def test_transparent_pixels_are_not_valid(tmp_path, colour, channels):
    pixels = np.full((2, 2, channels + 1), 255, dtype=np.uint8)
    pixels[0, 1] = (*colour, 0)
    values, valid, _ = decode(save(tmp_path / "a.png", pixels))
    assert values.shape == (2, 2, channels)
    assert valid.tolist() == [[True, False], [True, True]]


def test_black_is_masked(tmp_path):
    pixels = np.array([[0, 1], [255, 128]], dtype=np.uint8)
    assert decode_mask(save(tmp_path / "a.png", pixels)).tolist() == [[False, True], [True, True]]


@pytest.mark.parametrize("mode", ["L", "RGB"])
def test_the_compression_of_a_mask_does_not_show(tmp_path, mode):
    pixels = np.zeros((40, 40), dtype=np.uint8)
    pixels[11:29, 13:30] = 255
    path = tmp_path / "a.jpg"
    Image.fromarray(pixels).convert(mode).save(path, quality=60)
    assert (decode(path).values > 0).sum() > (pixels > 0).sum() * decode(path).values.shape[2]
    np.testing.assert_array_equal(decode_mask(path).numpy(), pixels > 0)


def test_the_exif_orientation_is_ignored(tmp_path):
    image = Image.new("RGB", (6, 4))
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(tmp_path / "a.jpg", exif=exif)
    assert (probe(tmp_path / "a.jpg").width, probe(tmp_path / "a.jpg").height) == (6, 4)
    assert decode(tmp_path / "a.jpg").values.shape == (4, 6, 3)


def png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b""))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("side", [5_001, 10_000, 60_000])
def test_decompression_bombs_are_refused_from_the_header(tmp_path, side):
    (tmp_path / "bomb.png").write_bytes(png_header(side, side))
    limit = Image.MAX_IMAGE_PIXELS
    with pytest.raises(SceneError, match=r"bomb\.png: .* 25 megapixels"):
        probe(tmp_path / "bomb.png")
    assert limit == Image.MAX_IMAGE_PIXELS


@pytest.fixture
def pillow_limit():
    """Pillow's limit, restored at the end."""
    limit = Image.MAX_IMAGE_PIXELS
    yield
    Image.MAX_IMAGE_PIXELS = limit


@pytest.mark.usefixtures("pillow_limit")
def test_a_large_file_may_have_many_pixels(tmp_path, monkeypatch):
    """40 for each byte, and 80 million at most, unless the user says how many."""
    photo = tmp_path / "photo.png"
    for side, filler, limit in ((8_000, 1_600_000, 80), (9_000, 3_000_000, 80), (8_000, 1e6, 40)):
        photo.write_bytes(png_header(side, side) + bytes(int(filler)))
        if (side, filler) == (8_000, 1_600_000):
            assert probe(photo).width == side
            continue
        with pytest.raises(SceneError, match=f"{limit} megapixels"):
            probe(photo)
    monkeypatch.setenv("MRGS_MAX_MEGAPIXELS", "400")
    photo.write_bytes(png_header(19_000, 20_000))
    assert probe(photo).width == 19_000
    for wrong in ("many", "-5", "0"):
        monkeypatch.setenv("MRGS_MAX_MEGAPIXELS", wrong)
        with pytest.raises(ConfigError, match="MRGS_MAX_MEGAPIXELS"):
            probe(photo)


def test_truncated_and_foreign_files(tmp_path):
    rng = np.random.default_rng(0)
    whole = save(
        tmp_path / "whole.png", rng.integers(0, 255, (40, 40), dtype=np.uint8)
    ).read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "text.png").write_text("not an image")
    (tmp_path / "empty.jpg").write_bytes(b"")
    Image.new("RGB", (4, 4)).save(tmp_path / "a.gif")
    for name in ("cut.png", "text.png", "empty.jpg", "a.gif", "missing.png"):
        with pytest.raises(SceneError, match=f"{name}: .*decoded") as caught:
            decode(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_thirty_two_bit_integers_are_refused(tmp_path):
    path = save(tmp_path / "a.tif", np.zeros((2, 2), dtype=np.int32))
    with pytest.raises(SceneError, match="type I;"):
        probe(path)


def test_mutated_images_give_pixels_or_a_scene_error(tmp_path):
    rng = np.random.default_rng(1)
    for name in ("a.png", "a.jpg", "a.tiff"):
        whole = bytearray(
            save(tmp_path / name, rng.integers(0, 255, (16, 16), dtype=np.uint8)).read_bytes()
        )
        for _ in range(60):
            mutated = whole.copy()
            for position in rng.integers(0, len(whole), 4):
                mutated[position] = rng.integers(0, 256)
            (tmp_path / f"mutated-{name}").write_bytes(mutated)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    values = decode(tmp_path / f"mutated-{name}").values
                except SceneError:
                    continue
            assert torch.isfinite(values).all()


@pytest.mark.parametrize(
    ("size", "least", "expected"),
    [
        ((64, 48), 8, (8, 6)),
        ((64, 48), 9, (16, 12)),
        ((64, 48), 33, (64, 48)),
        ((62, 48), 8, (31, 24)),  # an eighth of 62 is no whole number
        ((63, 48), 8, (63, 48)),
    ],
)
def test_a_jpeg_is_decoded_at_a_fraction_that_divides_its_size(tmp_path, size, least, expected):
    path = save(tmp_path / "a.jpg", np.full((size[1], size[0], 3), 51, dtype=np.uint8))
    values = decode(path, least).values
    assert (values.shape[1], values.shape[0]) == expected
    torch.testing.assert_close(values, torch.full_like(values, 0.2))


def test_other_files_are_decoded_whole(tmp_path):
    path = save(tmp_path / "a.png", np.full((48, 64), 51, dtype=np.uint8))
    assert decode(path, 8).values.shape == (48, 64, 1)


def test_levels_are_looked_for_in_every_row():
    values = of_eight_bit_levels(torch.randint(0, 256, (300, 500, 3), dtype=torch.uint8))
    assert has_eight_bit_levels(values)
    values[-1, -1, -1] = 0.3
    assert not has_eight_bit_levels(values)
