from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.data.sources import ImageSource, check_files, decode_rgb, posed_image
from mrgs.errors import SceneError
from mrgs.scene.lens import Lens

LENS = Lens(40, 31, 30.0, 31.0, 20.0, 15.0)
EYE = torch.eye(4, dtype=torch.float64)


def source(path, lens=LENS, mask=None) -> ImageSource:
    return ImageSource(path, lens, EYE, mask)


def test_the_camera_follows_the_resolution(tmp_path):
    image = posed_image(source(tmp_path / "a.png"), decode_rgb, 20)
    assert (image.camera.width, image.camera.height) == (20, 16)  # 15.5 rounded
    assert image.camera.K[0, 0] == 15.0
    assert image.camera.K[1, 1] == pytest.approx(31.0 * 16 / 31)


def test_grey_becomes_three_channels(tmp_path):
    Image.fromarray(np.full((31, 40), 51, dtype=np.uint8)).save(tmp_path / "a.png")
    pixels = posed_image(source(tmp_path / "a.png"), decode_rgb, None).load()
    assert pixels.values.shape == (31, 40, 3)
    assert pixels.values.is_contiguous()
    torch.testing.assert_close(pixels.values, torch.full((31, 40, 3), 0.2))


def test_floats_are_no_colours(tmp_path):
    Image.fromarray(np.zeros((31, 40), dtype=np.float32)).save(tmp_path / "a.tiff")
    with pytest.raises(SceneError, match="holds floats"):
        decode_rgb(tmp_path / "a.tiff")


def test_the_mask_and_the_alpha_channel_both_count(tmp_path):
    pixels = np.full((31, 40, 4), 255, dtype=np.uint8)
    pixels[0, 0, 3] = 0
    mask = np.full((31, 40), 255, dtype=np.uint8)
    mask[0, 1] = 0
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(mask).save(tmp_path / "mask.png")
    checked = source(tmp_path / "a.png", mask=tmp_path / "mask.png")
    assert check_files(checked).kind == "colour"
    valid = posed_image(checked, decode_rgb, None).load().valid
    assert valid[0, :3].tolist() == [False, False, True]
    assert (~valid).sum() == 2


def test_a_file_that_changed_its_size_after_opening(tmp_path):
    Image.new("RGB", (40, 31)).save(tmp_path / "a.png")
    image = posed_image(source(tmp_path / "a.png"), decode_rgb, None)
    Image.new("RGB", (41, 31)).save(tmp_path / "a.png")
    with pytest.raises(SceneError, match=r"41×31 .*40×31"):
        image.load()


def test_a_distortion_that_folds_the_image_names_the_file(tmp_path):
    lens = Lens(40, 31, 30.0, 31.0, 20.0, 15.0, (-100.0, 0.0, 0.0, 0.0))
    with pytest.raises(SceneError, match=r"a\.png: .*distortion .*fold"):
        posed_image(source(tmp_path / "a.png", lens), decode_rgb, None)


@pytest.mark.parametrize("lens", [LENS, Lens(40, 31, 30.0, 31.0, 20.0, 15.0, (-0.1, 0, 0, 0))])
@pytest.mark.parametrize("width", [None, 20])
def test_an_image_of_8_bits_can_keep_its_levels(lens, width, tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (31, 40, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "a.png")
    exact, kept = (
        posed_image(source(tmp_path / "a.png", lens), decode_rgb, width, keeps).load().values
        for keeps in (False, True)
    )
    assert (exact - kept).abs().max() < 0.5001 / 255
    torch.testing.assert_close(kept * 255, (kept * 255).round(), atol=1e-4, rtol=0)
    assert torch.equal(exact, kept) == (width is None and lens.is_pinhole)


def test_an_image_of_more_bits_keeps_its_values(tmp_path):
    noise = np.random.default_rng(0).integers(0, 2**16, (31, 40), dtype=np.uint16)
    Image.fromarray(noise).save(tmp_path / "a.png")
    exact, kept = (
        posed_image(source(tmp_path / "a.png"), decode_rgb, 20, keeps).load().values
        for keeps in (False, True)
    )
    assert torch.equal(exact, kept)


def test_a_large_photo_is_read_at_a_fraction_of_its_size_where_that_is_enough(tmp_path):
    lens = Lens(160, 96, 120.0, 120.0, 80.0, 48.0, radial=(-0.1, 0.0, 0.0, 0.0))
    x, y = np.meshgrid(np.arange(160), np.arange(96))
    pixels = np.stack([x, 2 * y, 128 + 0 * x], axis=-1).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    sizes = []

    def decoder(path, least_width):
        values, valid = decode_rgb(path, least_width)
        sizes.append(values.shape[:2])
        return values, valid

    small = posed_image(source(tmp_path / "a.jpg", lens), decoder, 20)
    whole = posed_image(
        source(tmp_path / "a.jpg", lens), lambda path, least_width: decode_rgb(path), 20
    )
    assert small.camera.coincides_with(whole.camera)
    torch.testing.assert_close(small.load().values, whole.load().values, atol=0.02, rtol=0)
    assert posed_image(source(tmp_path / "a.jpg", lens), decoder, 21).load().values.shape[1] == 21
    assert (
        posed_image(source(tmp_path / "a.jpg", lens), decoder, None).load().values.shape[1] == 160
    )
    assert sizes == [(24, 40), (48, 80), (96, 160)]


def test_a_look_at_a_large_photo_shows_the_same_in_fewer_pixels(tmp_path):
    lens = Lens(160, 96, 120.0, 120.0, 80.0, 48.0, radial=(-0.1, 0.0, 0.0, 0.0))
    x, y = np.meshgrid(np.arange(160), np.arange(96))
    pixels = np.stack([x, 2 * y, 128 + 0 * x], axis=-1).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.jpg", quality=95)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    image = posed_image(source(tmp_path / "a.jpg", lens), decode_rgb, None)
    look, whole = image.look(30).values, image.load().values
    assert look.shape == (24, 40, 3)
    averaged = whole.reshape(24, 4, 40, 4, 3).mean(dim=(1, 3))
    torch.testing.assert_close(look, averaged, atol=0.02, rtol=0)
    assert torch.equal(image.look(81).values, whole)
    narrow = posed_image(source(tmp_path / "a.jpg", lens), decode_rgb, 20)
    assert narrow.look(30).values.shape == (12, 20, 3)  # no more pixels than its camera has
    png = posed_image(source(tmp_path / "a.png", lens), decode_rgb, None)
    assert torch.equal(png.look(30).values, png.load().values)


def test_a_photo_that_became_as_small_as_it_may_be_decoded_is_still_refused(tmp_path):
    lens = Lens(160, 96, 120.0, 120.0, 80.0, 48.0)
    Image.new("RGB", (40, 24)).save(tmp_path / "a.jpg")
    image = posed_image(source(tmp_path / "a.jpg", lens), decode_rgb, None)
    with pytest.raises(SceneError, match=r"40×24 .*160×96"):
        image.load()


def test_a_mask_of_a_photo_that_is_read_small_keeps_out_all_that_it_touches(tmp_path):
    lens = Lens(160, 96, 120.0, 120.0, 80.0, 48.0)
    Image.fromarray(np.full((96, 160, 3), 90, np.uint8)).save(tmp_path / "a.jpg")
    mask = np.full((96, 160), 255, np.uint8)
    mask[5, 9] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    image = posed_image(source(tmp_path / "a.jpg", lens, tmp_path / "mask.png"), decode_rgb, None)
    valid = image.look(40).valid
    assert valid.shape == (24, 40)
    assert (~valid).nonzero().tolist() == [[1, 2]]
