from __future__ import annotations

import errno
import os
import struct
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.data.radiometric import Overrides, ThermalPhoto, dji, read_thermal_photo
from mrgs.errors import RunError, SceneError, ToolError
from mrgs.prepare import PrepareOptions, convert, stages
from mrgs.prepare import contents as contents_module
from mrgs.prepare.cache import Cache
from mrgs.prepare.contract import ConvertedPhotos, Pairing, PhotoPair
from mrgs.prepare.convert import convert_photos
from mrgs.prepare.pairs.find import find_pairs
from mrgs.prepare.work import Work
from mrgs.scene import RGB, THERMAL
from tests.helpers.flir import FlirPhoto
from tests.helpers.photos import photo

NOON = datetime(2024, 5, 1, 12, 0, 0)


def quiet(step: str, done: int, total: int) -> None:
    """No progress is shown."""


def converted(
    pairing: Pairing, scene: Path, overrides: Overrides | None = None, progress=quiet, **options
) -> ConvertedPhotos:
    cache = Cache(scene / "prepare")
    return convert_photos(pairing, scene, overrides or Overrides(), cache, progress, **options)


@pytest.fixture
def scene(tmp_path) -> Path:
    return tmp_path / "scene"


@pytest.fixture
def made(photos, scene):
    """Writes photos, pairs and converts them."""

    def make(files: dict[str, object], overrides: Overrides | None = None) -> ConvertedPhotos:
        return converted(find_pairs(photos(files)), scene, overrides)

    return make


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_a_flir_photo_and_its_visible_photo(made, scene, photos):
    found = made({"FLIR1.jpg": ("flir with visible", {"taken": NOON, "model": "E60"})})
    (view,) = found.views
    assert (view.name, *view.files) == (
        "FLIR1",
        "images/FLIR1.jpg",
        "thermal/FLIR1.tiff",
    )
    truth = read_thermal_photo(photos({}) / "FLIR1.jpg")
    written = pixels(scene / view.images[THERMAL].file)
    assert written.dtype == np.float32
    np.testing.assert_array_equal(written, truth.temperature_c)
    assert (scene / view.images[RGB].file).read_bytes() == truth.facts.visible.data
    assert view.range_c == (float(written.min()), float(written.max()))
    assert (view.facts.camera, view.exif.model, view.exif.taken) == ("Test Camera", "E60", NOON)
    assert found.skipped == found.warnings == ()


def test_pixels_without_temperature_are_nan(made, scene):
    raw = FlirPhoto().raw
    raw[3, 4] = 0
    (view,) = made({"a.jpg": FlirPhoto(raw=raw).jpeg()}).views
    assert np.isnan(pixels(scene / view.images[THERMAL].file)).nonzero() == (
        np.array([3]),
        np.array([4]),
    )
    assert view.range_c is not None
    assert np.isfinite(view.range_c).all()
    assert "0.1 % of the pixels have no temperature; they are masked." in view.facts.warnings


def test_upright_photos_keep_their_bytes(made, scene, photos):
    files = {
        "rgb/a.JPG": ("jpg", {"taken": NOON, "model": "X100"}),
        "rgb/b.jpeg": "jpg",
        "thermal/a.tif": "celsius",
    }
    found = made({**files, "thermal/b.tif": "celsius"})
    root = photos({})
    assert [view.images[RGB].file for view in found.views] == ["images/a.jpg", "images/b.jpg"]
    assert (scene / "images/a.jpg").read_bytes() == (root / "rgb/a.JPG").read_bytes()
    assert (found.views[0].exif.model, found.views[0].exif.taken) == ("X100", NOON)
    assert (
        found.views[0].facts.record.taken == NOON
    )  # of the RGB photo, where the thermal says none
    assert found.views[0].facts.notes == ("The numbers are taken for celsius.",)


def test_a_tiff_photo_becomes_a_png(made, scene, photos):
    colours = np.arange(4 * 5 * 3, dtype=np.uint8).reshape(4, 5, 3)
    root = photos({})
    (root / "rgb").mkdir()
    Image.fromarray(colours).save(root / "rgb/a.tif")
    (view,) = made({"thermal/a.png": "png"}).views
    assert view.images[RGB].file == "images/a.png"
    np.testing.assert_array_equal(pixels(scene / "images/a.png"), colours)


@pytest.mark.parametrize("orientation", range(2, 9))
def test_a_rotated_photo_is_turned_in_its_pixels(made, scene, orientation):
    rgb = ("jpg", {"size": (32, 16), "orientation": orientation, "model": "X100", "focal_mm": 23.0})
    (view,) = made({"rgb/a.jpg": rgb, "thermal/a.tif": "celsius"}).views
    with Image.open(scene.parent / "card/rgb/a.jpg") as image:
        upright = np.asarray(image.transpose(turn_by_exif(orientation)), dtype=int)
    with Image.open(scene / view.images[RGB].file) as image:
        assert image.format == "JPEG"
        assert 0x0112 not in image.getexif()
        assert image.getexif()[0x0110] == "X100"
        assert image.getexif().get_ifd(0x8769)[0x920A] == 23.0
        written = np.asarray(image, dtype=int)
    assert written.shape == upright.shape
    assert np.abs(written - upright).mean() < 2


def turn_by_exif(orientation: int) -> Image.Transpose:
    """By what EXIF defines: where the first row and the first column of the pixels are shown."""
    return {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_270,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_90,
    }[orientation]


def with_exif(photo: bytes, tags: dict[int, tuple[int, int, bytes]]) -> bytes:
    """A JPEG with an EXIF of tags (type, count, value) as they are, and FocalLength 23 mm."""
    main = {**tags, 0x8769: (4, 1, struct.pack("<L", 8 + 2 + 12 * (len(tags) + 1) + 4))}
    rational = 8 + 2 + 12 * len(main) + 4 + 2 + 12 + 4
    tiff = b"II*\0" + struct.pack("<L", 8)
    for entries in (main, {0x920A: (5, 1, struct.pack("<L", rational))}):
        tiff += struct.pack("<H", len(entries))
        for tag, (kind, count, value) in sorted(entries.items()):
            tiff += struct.pack("<HHL", tag, kind, count) + value.ljust(4, b"\0")
        tiff += bytes(4)
    exif = b"Exif\0\0" + tiff + struct.pack("<LL", 23, 1)
    start = 2 + 2 + struct.unpack(">H", photo[4:6])[0]  # after JFIF's segment
    return photo[:start] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + photo[start:]


@pytest.mark.parametrize(
    "damaged",
    [
        {0x011A: (2, 3, b"72\0")},  # XResolution as text
        {0x0128: (2, 2, b"2\0")},  # ResolutionUnit as text
        {0x0128: (8, 1, struct.pack("<h", -1))},
        {0x010F: (3, 1, b"\1\0")},  # Make as a number
    ],
)
def test_damaged_exif_does_not_keep_a_photo_from_being_turned(made, scene, damaged):
    tags = {0x0110: (2, 4, b"X10\0"), 0x0112: (3, 1, b"\6\0")}
    jpeg = with_exif(photo("jpg", size=(32, 16)), tags | damaged)
    made({"rgb/a.jpg": jpeg, "thermal/a.tif": "celsius"})
    with Image.open(scene / "images/a.jpg") as image:
        assert image.size == (16, 32)
        assert dict(image.getexif()).keys() == {0x0110, 0x8769}
        assert image.getexif()[0x0110] == "X10"
        assert image.getexif().get_ifd(0x8769) == {0x920A: 23.0}


def test_exif_that_cannot_be_written_is_left_away(made, scene, monkeypatch):
    def refuse(exif: Image.Exif, offset: int = 8) -> bytes:
        raise struct.error

    rgb = photo("jpg", orientation=3, model="X100")  # written before it is refused
    with monkeypatch.context() as patch:
        patch.setattr(Image.Exif, "tobytes", refuse)
        made({"rgb/a.jpg": rgb, "thermal/a.tif": photo("celsius")})
    with Image.open(scene / "images/a.jpg") as image:
        assert not image.getexif()


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_images_with_given_poses_stay_as_they_are_stored(photos, scene, orientation):
    turn = {"size": (32, 16), "orientation": orientation}
    root = photos({"rgb/a.jpg": ("jpg", turn), "thermal/a.png": ("png", turn)})
    (view,) = converted(find_pairs(root), scene, turn=False).views
    stored = pixels(root / "rgb/a.jpg").astype(int)
    written = pixels(scene / view.images[RGB].file).astype(int)
    assert written.shape == stored.shape
    assert np.abs(written - stored).mean() < 2
    np.testing.assert_array_equal(
        pixels(scene / view.images[THERMAL].file), pixels(root / "thermal/a.png")
    )


def test_prepare_turns_images_only_where_it_finds_the_poses(photos, scene):
    root = photos(
        {"rgb/a.jpg": ("jpg", {"size": (32, 16), "orientation": 6}), "thermal/a.tif": "celsius"}
    )
    for poses, shape in ((None, (32, 16, 3)), (scene, (16, 32, 3))):
        work = Work(root, scene, PrepareOptions(poses=poses), pairing=find_pairs(root))
        work.run("images", stages.images)
        assert not work.reports[0].reused
        (view,) = work.images.views
        assert pixels(scene / view.images[RGB].file).shape == shape


def test_all_photos_are_turned_as_most_of_them(made, scene):
    """Photos of one camera keep one lens, whichever way it was held."""
    rgb = {
        f"rgb/{i}.jpg": ("jpg", {"size": (32, 16), "orientation": (1, 6, 6)[i]}) for i in range(3)
    }
    found = made(rgb | {f"thermal/{i}.tif": "celsius" for i in range(3)})
    assert {pixels(scene / view.images[RGB].file).shape for view in found.views} == {(32, 16, 3)}


def test_thermal_photos_are_turned_too(made, scene):
    (view,) = made(
        {"a_t.png": ("png", {"size": (32, 16), "orientation": 6}), "a_rgb.jpg": "jpg"}
    ).views
    np.testing.assert_array_equal(
        pixels(scene / view.images[THERMAL].file),
        np.rot90(pixels(scene.parent / "card/a_t.png"), -1),
    )


def test_photos_without_temperatures_still_train(made, scene):
    found = made({"rgb/a.jpg": "jpg", "thermal/a.png": "png"})
    (view,) = found.views
    assert (view.images[THERMAL].file, view.range_c) == ("thermal/a.png", None)
    np.testing.assert_array_equal(
        pixels(scene / view.images[THERMAL].file), pixels(scene.parent / "card/thermal/a.png")
    )
    assert found.warnings == ()
    (warning,) = view.facts.warnings
    assert "relative values from 0 to 1 are used; absolute temperatures need bounds" in warning


def test_bounds_make_temperatures_of_grey(made, scene):
    files = {"rgb/a.jpg": "jpg", "thermal/a.png": "png"}
    made(files)
    (view,) = made(files, Overrides(bounds_c=(-10.0, 40.0))).views
    assert view.range_c == (-10.0, 40.0)
    assert sorted(contents(scene / "thermal")) == ["a.tiff"]  # the grey image of before is gone


def counts(value: float) -> np.ndarray:
    return np.linspace(value, value + 300, 16 * 12).reshape(12, 16).astype(np.uint16)


def test_one_set_has_one_unit(made, photos, scene):
    """The second photo alone could be °C × 100 or K × 10."""
    root = photos({})
    for name, values in (("a", counts(1500)), ("b", counts(2900))):
        Image.fromarray(values).save(root / f"{name}_t.png")
    found = made({"a_rgb.jpg": "jpg", "b_rgb.jpg": "jpg"})
    assert [view.range_c for view in found.views] == [(15.0, 18.0), (29.0, 32.0)]
    assert [view.facts.notes for view in found.views] == [
        ("The numbers are taken for celsius*100.",)
    ] * 2


def test_r_jpegs_have_no_unit_to_guess(made, monkeypatch):
    celsius = np.full((512, 640), 20, "<f4").tobytes()
    monkeypatch.setattr(dji.shutil, "which", lambda program: program)
    monkeypatch.setattr(dji, "_run_tool", lambda _, __, output, ___: output.write_bytes(celsius))
    found = made(
        {f"DJI_{i}_T.JPG": ("dji", {"model": "DJI M3T"}) for i in (1, 2)}
        | {f"DJI_{i}_W.JPG": ("jpg", {"model": "DJI M3T"}) for i in (1, 2)}
    )
    assert [view.facts.notes for view in found.views] == [(), ()]


def test_photos_with_and_without_temperatures_are_not_mixed(made, scene):
    found = made({"a_t.tif": "celsius", "a_rgb.jpg": "jpg", "b_t.png": "png", "b_rgb.jpg": "jpg"})
    assert [view.name for view in found.views] == ["a"]
    assert [(item.name, item.reason) for item in found.skipped] == [
        ("b", "its thermal photo holds no temperatures, while those of others do")
    ]
    assert sorted(contents(scene / "images")) == ["a.jpg"]


def test_parameters_that_differ_are_told(made):
    parameters = FlirPhoto().parameters
    content = {
        f"{i}.jpg": FlirPhoto(
            parameters={**parameters, "emissivity": value, "window_c": 20.0 + i}
        ).jpeg()
        for i, value in enumerate((0.9, 0.95))
    }
    assert made(content).warnings == (
        "Emissivity differs between the photos (0.9 to 0.95): one surface then has several "
        "temperatures. "
        "Give one value for all.",
    )
    assert made(content, Overrides(emissivity=0.9)).warnings == ()


def test_a_bad_photo_is_left_out(made, scene):
    files = {
        f"{i}_{mark}": kind
        for i in range(4)
        for mark, kind in (("t.tif", "celsius"), ("rgb.jpg", "jpg"))
    }
    files["1_rgb.jpg"] = photo("jpg", size=(16, 12))[:-30]
    files["2_t.tif"] = photo("celsius")[:300]
    found = made(files)
    assert [view.name for view in found.views] == ["0", "3"]
    assert [item.name for item in found.skipped] == ["1", "2"]
    assert "1_rgb.jpg: cannot be decoded as an image (" in found.skipped[0].reason
    assert "2_t.tif: it cannot be decoded as an image (" in found.skipped[1].reason
    assert sorted(contents(scene / "images")) == ["0.jpg", "3.jpg"]


def test_no_photo_that_can_be_used(made):
    with pytest.raises(
        SceneError,
        match=r"none of the 2 pairs can be used; the first: .*1_T\.JPG: is a DJI R-JPEG, who",
    ):
        made(
            {
                f"DJI_{i}_{m}.JPG": ("dji" if m == "T" else "jpg", {"model": "DJI M3T"})
                for i in (1, 2)
                for m in "TW"
            }
        )


def test_no_pairs(scene):
    with pytest.raises(SceneError, match="none of the 0 pairs can be used; find pairs first"):
        converted(Pairing((), (), ""), scene)


def test_thermal_photos_of_two_sizes(made):
    content = {
        f"{i}.jpg": FlirPhoto(raw=FlirPhoto().raw[: 24 - i // 2, :]).jpeg() for i in range(3)
    }
    with pytest.raises(
        SceneError,
        match=r"2\.jpg: its thermal image has 32 x 23 pixels, while 2 such as 0\.jpg have 32 x",
    ):
        made(content)


def test_visible_photos_of_two_sizes(made):
    content = {
        f"{i}.jpg": FlirPhoto(visible=photo("jpg", size=(16, 12 + i))).jpeg() for i in range(2)
    }
    with pytest.raises(
        SceneError,
        match=r"1\.jpg: its RGB image has 16 x 13 pixels, while 1 such as 0\.jpg have 16 x 12",
    ):
        made(content)


def test_photos_in_the_scene_s_own_folders(photos, tmp_path):
    root = photos({"images/a.jpg": "jpg", "thermal/a.tif": "celsius"})
    before = contents(root)
    with pytest.raises(
        SceneError,
        match=r"a\.jpg: lies where the images of .* are written; choose another folder for",
    ):
        converted(find_pairs(root), root)
    assert contents(root) == before


@pytest.fixture
def digested(monkeypatch) -> list[str]:
    """Names of the files whose content is read to tell whether it has changed."""
    names = []
    original = contents_module.digest
    monkeypatch.setattr(
        contents_module, "digest", lambda path: names.append(path.name) or original(path)
    )
    return names


SET = {
    f"{i}_{mark}": kind
    for i in range(3)
    for mark, kind in (("t.tif", "celsius"), ("rgb.jpg", "jpg"))
}


def test_nothing_is_done_twice(made, monkeypatch, photos):
    first = made(SET)
    read = []
    original = convert.read_rgb
    monkeypatch.setattr(
        convert, "read_rgb", lambda path, turn: read.append(path.name) or original(path, turn)
    )
    assert made({}) == first
    assert read == []
    os.utime(photos({"1_rgb.jpg": photo("jpg", taken=NOON)}) / "1_rgb.jpg", ns=(1, 1))
    assert made({}).views[1].exif.taken == NOON
    assert read == ["1_rgb.jpg"]
    made({}, Overrides(unit="fahrenheit"))
    assert read == ["1_rgb.jpg", "0_rgb.jpg", "1_rgb.jpg", "2_rgb.jpg"]


def test_a_photo_exported_again_with_its_old_size_and_time_is_read_again(made, photos, scene):
    made(SET)
    file = photos({}) / "1_t.tif"
    before, status = pixels(scene / "thermal/1.tiff"), file.stat()
    Image.fromarray(pixels(file) + np.float32(5)).save(file)
    assert file.stat().st_size == status.st_size
    os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert made({}).views[1].range_c == (15.0, 35.0)
    np.testing.assert_array_equal(pixels(scene / "thermal/1.tiff"), before + np.float32(5))


def test_a_call_that_was_cut_short_remembers_what_others_read(made, photos, scene, digested):
    made(SET)
    digested.clear()
    pairing, cache = find_pairs(photos({})), Cache(scene / "prepare")

    def stop(step: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    (photos({}) / "0_t.tif").touch()
    with pytest.raises(KeyboardInterrupt):
        convert_photos(pairing, scene, Overrides(), cache, stop)
    convert_photos(pairing, scene, Overrides(), cache, quiet)
    assert digested == ["0_t.tif"]


def test_photos_are_read_again_only_where_their_files_changed(made, photos, scene, digested):
    """A photo that was touched is compared by its content, and not converted again."""
    made(SET)
    digested.clear()
    cache = Cache(scene / "prepare")
    (photos({}) / "2_t.tif").touch()
    convert_photos(find_pairs(photos({})), scene, Overrides(), cache, quiet)
    assert (cache.made, digested) == (0, ["2_t.tif"])


def test_a_refused_photo_is_not_read_again(made, scene, photos):
    """Its refusal is kept like an image, until the photo or an override changes."""
    cut = photo("celsius")[:200]
    first = made({**SET, "1_t.tif": cut})
    assert [item.name for item in first.skipped] == ["1"]
    assert "1_t.tif: " in first.skipped[0].reason
    results = contents(scene / "prepare")
    assert made({}) == first
    assert contents(scene / "prepare") == results
    cache = Cache(scene / "prepare")
    convert_photos(find_pairs(photos({})), scene, Overrides(), cache, quiet)
    assert cache.made == 0
    convert_photos(find_pairs(photos({})), scene, Overrides(unit="fahrenheit"), cache, quiet)
    assert cache.made == 3
    assert [view.name for view in made({"1_t.tif": "celsius"}).views] == ["0", "1", "2"]


def test_a_photo_without_permission_is_read_again(photos, scene):
    """Permissions change neither size nor time: such a refusal is not kept."""
    root = photos(SET)
    pairing = find_pairs(root)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("builtins.open", denied(root / "1_rgb.jpg", open))
        found = converted(pairing, scene)
    assert "1_rgb.jpg: cannot be" in found.skipped[0].reason
    assert converted(pairing, scene).skipped == ()


def test_a_photo_that_another_program_could_not_read_is_tried_again(photos, scene, monkeypatch):
    root = photos({**SET, "3_t.tif": "celsius", "3_rgb.jpg": "jpg"})
    pairing = find_pairs(root)
    original = convert.read_thermal_photo

    def lacks_tool(path: Path, overrides: Overrides) -> ThermalPhoto:
        if path.name == "3_t.tif":
            raise ToolError(f"{path}: install the SDK")
        return original(path, overrides)

    with monkeypatch.context() as patch:
        patch.setattr(convert, "read_thermal_photo", lacks_tool)
        assert [item.name for item in converted(pairing, scene).skipped] == ["3"]
    assert converted(pairing, scene).skipped == ()


def denied(secret: Path, original):
    """A function that reads files, for a user who may not read one of them."""

    def read(path, *arguments, **options):
        if str(path) == str(secret):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return original(path, *arguments, **options)

    return read


def test_an_image_that_was_removed_is_made_again(made, scene):
    first = made(SET)
    (scene / "images/1.jpg").unlink()
    assert made({}) == first
    assert (scene / "images/1.jpg").is_file()


def test_views_that_are_no_more_are_removed(made, scene, photos):
    made(SET)
    (scene / "images/mine.jpg").write_bytes(b"the user's")
    (photos({}) / "1_t.tif").unlink()
    made({})
    assert sorted(contents(scene / "images")) == ["0.jpg", "2.jpg", "mine.jpg"]
    assert sorted(contents(scene / "thermal")) == ["0.tiff", "2.tiff"]


def test_the_photos_are_only_read(made, photos):
    root = photos(SET)
    before = contents(root)
    made({})
    assert contents(root) == before


def test_a_photo_that_changes_while_it_is_read(made, monkeypatch, scene):
    original = convert.read_rgb

    def changing(path: Path, turn: int):
        found = original(path, turn)
        if path.name == "1_rgb.jpg":
            path.write_bytes(path.read_bytes() + b" more")
        return found

    monkeypatch.setattr(convert, "read_rgb", changing)
    found = made(SET)
    assert [view.name for view in found.views] == ["0", "2"]
    assert found.skipped[0].reason.endswith(
        "1_t.tif: this photo or its RGB photo changed while it was read; wait until it is copied"
    )
    assert sorted(contents(scene / "images")) == ["0.jpg", "2.jpg"]


def test_a_photo_that_vanishes(photos, scene):
    root = photos(SET)
    pairing = find_pairs(root)
    (root / "1_rgb.jpg").unlink()
    found = converted(pairing, scene)
    assert found.skipped[0].reason.endswith(
        "1_rgb.jpg: cannot be read (No such file or directory); it was there before, put it back"
    )


def test_a_full_disk(made, monkeypatch, scene):
    """What was written stays whole, and the next call goes on with it."""
    write = Path.write_bytes
    written = []

    def full(path: Path, content: bytes) -> int:
        if len(written) == 1 and path.suffix == ".jpg":
            write(path, content[:10])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if scene in path.parents and path.suffix == ".jpg":
            written.append(path)
        return write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(
            RunError,
            match=r"1\.jpg cannot be written \(No space left on device\): make room, or",
        ):
            made(SET)
    assert sorted(contents(scene / "images")) == ["0.jpg"]
    stamp = (scene / "images/0.jpg").stat().st_mtime_ns
    assert len(made({}).views) == 3
    assert (scene / "images/0.jpg").stat().st_mtime_ns == stamp


def test_a_folder_that_cannot_be_made(photos, tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(RunError, match=r"a\.jpg cannot be written"):
        converted(find_pairs(photos({"a_t.tif": "celsius", "a_rgb.jpg": "jpg"})), tmp_path / "file")


def test_a_photo_that_says_it_holds_another(photos, scene):
    root = photos({"a.jpg": "flir"})
    with pytest.raises(
        SceneError,
        match=r"a\.jpg: holds no visible photo, while others do; leave it out, or add its RGB",
    ):
        converted(Pairing((PhotoPair("a", {THERMAL: root / "a.jpg"}, True),), (), ""), scene)


def test_progress_is_told(photos, scene):
    told = []
    converted(find_pairs(photos(SET)), scene, progress=lambda *step: told.append(step))
    assert told == [("reading and writing", done, 3) for done in range(4)]
