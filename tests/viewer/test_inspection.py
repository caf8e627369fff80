from __future__ import annotations

import json
import re
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
import torch
from PIL import Image

from mrgs.errors import ConfigError, RunError
from mrgs.rasterizer.contract import Dilation
from mrgs.runs.open import load_run
from mrgs.scene import RGB, THERMAL, Camera, Scene, SceneBounds
from mrgs.survey import SURVEY_FILE, Survey, write_survey
from mrgs.training import make_config, train
from mrgs.viewer.facts import header_text, hello_facts, point_text
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.painting import SCALE_FROM_PX, MarkLabel, seen_labels
from mrgs.viewer.saving import render_video, save_keyframes, save_screenshot
from mrgs.viewer.server import board_of
from mrgs.viewer.settings import Mode, Settings
from tests.helpers.scenes import write_scene
from tests.helpers.subjects import MODES, subject_of


@pytest.fixture
def inspection(subject):
    return Inspection(subject)


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_fills_the_picture(inspection, camera, mode):
    inspection.settings = Settings(MODES[mode])
    sharp = inspection.picture(camera).pixels
    coarse = inspection.picture(camera.resized(80, 60), moving=True).pixels
    assert (coarse.shape, sharp.shape) == ((60, 80, 3), (120, 160, 3))
    assert len(np.unique(sharp.reshape(-1, 3), axis=0)) > 30
    assert np.abs(coarse.astype(int) - sharp[::2, ::2]).mean() < 40


@dataclass(frozen=True, eq=False)
class SceneUpTo(Scene):
    """A scene that reaches up to a radius about the origin."""

    radius: float = 1.0

    @property
    def reach(self) -> SceneBounds:
        return SceneBounds(torch.zeros(3, dtype=torch.float64), self.radius)


def test_the_background_does_not_count_on_the_scale_of_the_depth(subject, camera):
    near_and_far = []
    for radius in (1e3, 1e-3):  # nothing is background, then everything is
        known = {each.name: getattr(subject.scene, each.name) for each in fields(subject.scene)}
        scene = SceneUpTo(**known, radius=radius)
        inspection = Inspection(replace(subject, scene=scene))
        inspection.settings = Settings(MODES["depth"])
        depth = inspection.picture(camera).scales["depth"]
        near_and_far.append((depth.high, depth.low))
    assert near_and_far[0][1] > 2
    assert near_and_far[1] == (0, 1)


def test_a_click_reads_what_is_drawn(subject, camera, small_run):
    """Without photos to look through; with them, what they see."""
    inspection = Inspection(replace(subject, board=None))
    inspection.picture(camera)
    shown = inspection.click(0.5, 0.5)
    expected = small_run.temperatures_c(small_run.render(camera))[60, 80].item()
    assert shown.value == pytest.approx(expected, abs=1e-3)
    assert shown.photo_value is None
    assert point_text(shown, inspection.subject)["value"] == f"{expected:.1f} °C"
    assert inspection.hover(0.5, 0.5) == f"{expected:.1f} °C"


def test_a_click_into_the_void_says_so(inspection, camera):
    assert inspection.click(0.5, 0.5) is None  # no picture yet
    assert inspection.hover(0.5, 0.5) == ""
    inspection.picture(camera)
    assert inspection.click(0.0, 0.0) is None
    assert inspection.hover(0.0, 0.0) == "no surface"


def test_beside_a_photo_both_values_are_read(inspection, balls, small_run):
    inspection.settings = Settings(MODES["difference"])
    captured = balls.train[2].cameras[THERMAL]
    inspection.picture(captured.resized(160, 120))
    assert inspection.view is balls.train[2]
    shown = inspection.click(20.5 / 40, 15.5 / 30)
    model = small_run.temperatures_c(small_run.render(captured))[15, 20].item()
    photo = small_run.temperature.to_celsius(
        balls.train[2].images[THERMAL].load().values[15, 20, 0].item()
    )
    assert (shown.value, shown.photo_value) == pytest.approx((model, photo), abs=1e-3)
    (line, *_) = point_text(shown, inspection.subject)["lines"]
    assert line.startswith(f"photo {photo:.1f} °C, model ")
    gap = f"{shown.value - photo:+.1f} K".replace("-", "−")
    assert inspection.hover(20.5 / 40, 15.5 / 30) == gap


def test_the_scale_is_locked_unless_it_follows(inspection, camera):
    def scale(at, **options):
        return inspection.picture(at, **options).scales[THERMAL]

    far = replace(camera, viewmat=camera.viewmat.clone())
    far.viewmat[2, 3] += 3
    assert scale(camera) == scale(far)
    inspection.settings = replace(inspection.settings, limits={})
    near = scale(camera)
    assert scale(far, moving=True) == near
    assert scale(far) != near


def test_it_begins_with_the_colours_that_the_survey_states(subject, camera):
    survey = subject.board._store.folder / SURVEY_FILE
    write_survey(survey, Survey(palette="iron", scale_low_c=11.0, scale_high_c=29.0))
    try:
        subject.board.refresh()
        inspection = Inspection(subject)
        facts = hello_facts(inspection, {})
    finally:
        survey.unlink()
    assert inspection.picture(camera).scales[THERMAL][:3] == ("iron", 11.0, 29.0)
    assert (facts["palette"], facts["modalities"][0]["range"]) == ("iron", [11.0, 29.0])


def test_the_scale_is_locked_at_what_the_photos_show(subject, camera):
    low, high = subject.limits[THERMAL]
    seen = [view.images[THERMAL].load().values for view in subject.scene.train]
    celsius = subject.temperature.to_celsius(torch.cat([values.flatten() for values in seen]))
    assert low <= torch.quantile(celsius, 0.005).item()
    assert high >= torch.quantile(celsius, 0.995).item()
    assert high - low < 1.2 * (celsius.max() - celsius.min()).item()
    assert (low, high) == pytest.approx((round(low, 1), round(high, 1)))


def test_the_scale_fits_the_view_when_asked(inspection, camera):
    inspection.fit()  # nothing to fit yet
    before = inspection.settings.limits[THERMAL]
    drawn = inspection.picture(camera.resized(40, 30))
    inspection.fit()
    low, high = inspection.settings.limits[THERMAL]
    solid = drawn.images[0].images[THERMAL][drawn.images[0].solid]
    assert low <= np.percentile(solid, 0.5)
    assert high >= np.percentile(solid, 99.5)
    assert (low, high) != before


def test_marks_are_drawn_measured_and_saved(inspection, camera, subject):
    inspection.picture(camera)
    inspection.add_mark("spot", [(0.5, 0.5)])
    inspection.add_mark("line", [(0.45, 0.5), (0.55, 0.5)])
    inspection.add_mark("box", [(0.55, 0.55), (0.45, 0.45)])
    inspection.add_mark("polygon", [(0.5, 0.45), (0.55, 0.55), (0.45, 0.55)])
    line, box, polygon, label = inspection.labels()
    assert re.fullmatch(r"S1  \d+\.\d ± \d+\.\d °C", label.label)
    assert [len(each.corners) for each in (line, box, polygon)] == [2, 4, 3]
    assert [each.closed for each in (line, box, polygon)] == [False, True, True]
    reading = subject.board.readings[2]
    rendering = inspection.drawn.images[0]
    inside = rendering.images[THERMAL][54:66, 72:88][rendering.solid[54:66, 72:88]]
    low, high = subject.limits[THERMAL]
    assert reading.mean == pytest.approx(inside.mean(), abs=0.1 * (high - low))
    again = Inspection(subject_of_same_folder(subject))
    again.subject.board.refresh()
    assert again.labels()[-1].label == label.label
    subject.board.undo()
    assert len(inspection.labels()) == 3


def subject_of_same_folder(subject):
    """Another viewer of the same run."""
    spread = subject.board._store._spread
    return replace(subject, board=board_of(subject, spread))


@pytest.mark.parametrize("count", [1, 3])
def test_a_box_has_two_corners(count, inspection, camera):
    inspection.picture(camera)
    with pytest.raises(ConfigError, match="corner"):
        inspection.add_mark("box", [(0.5, 0.5)] * count)


def test_a_mark_must_lie_within_one_picture(inspection, camera):
    with pytest.raises(ConfigError, match="one picture"):
        inspection.add_mark("spot", [(0.5, 0.5)])  # no picture yet
    inspection.settings = Settings(MODES["side_by_side"])
    inspection.picture(camera)
    with pytest.raises(ConfigError, match="one picture"):
        inspection.add_mark("line", [(0.25, 0.5), (0.75, 0.5)])
    with pytest.raises(ConfigError, match="no surface"):
        inspection.add_mark("spot", [(0.01, 0.01)])


def test_without_a_board_there_are_no_marks(subject, camera):
    inspection = Inspection(replace(subject, board=None))
    inspection.picture(camera)
    assert inspection.labels(with_proposals=True) == []
    with pytest.raises(ConfigError, match="scene"):
        inspection.add_mark("spot", [(0.5, 0.5)])


def test_a_surface_with_its_own_emissivity_is_shown_with_it(inspection, camera, subject):
    before = inspection.picture(camera).images[0].images[THERMAL][60, 80]
    inspection.add_mark("box", [(0.45, 0.45), (0.55, 0.55)])
    subject.board.edit(lambda marks: marks.changing("B1", emissivity=0.7, reflected_c=0.0))
    after = inspection.picture(camera)
    assert after.images[0].images[THERMAL][60, 80] > before + 1
    point = inspection.click(0.5, 0.5)
    place = point.value
    assert inspection.hover(0.5, 0.5) == f"{place:.1f} °C"
    inspection.add_mark("spot", [(0.5, 0.5)])
    # A mark is moved to where the photos agree on a depth, which differs in a model of few steps.
    assert place == pytest.approx(subject.board.readings[-1].mean, abs=0.5)
    subject.board.undo()
    subject.board.edit(lambda marks: marks.without("B1"))
    assert place > inspection.click(0.5, 0.5).value + 1
    subject.board.undo()
    assert any("apparent" in note for note in subject.board.notes)
    inspection.settings = Settings(MODES["photos"])
    photo, model = inspection.picture(camera).images[-2:]
    assert np.nanmax(model.images[THERMAL]) < np.nanmax(photo.images[THERMAL]) + 3
    titles = [pane.title for pane in inspection.drawn.panes]
    assert titles[-1] == "thermal, the model, emissivity of the photo"
    assert not any("emissivity" in title for title in titles[:-1])
    inspection.settings = Settings(MODES["difference"])
    assert inspection.picture(camera).panes[0].title.endswith(", emissivity of the photo")


def test_what_hides_a_mark_hides_it_in_the_photo_too(inspection, camera, balls):
    inspection.settings = Settings(MODES["photos"])
    drawn = inspection.picture(camera)
    view = inspection.view
    for pane, shown in zip(drawn.panes, drawn.images, strict=True):
        rows, columns = np.nonzero(np.isfinite(shown.depth))
        row, column = int(np.median(rows)), int(np.median(columns))
        height, width = shown.depth.shape
        own = pane.camera.resized(width, height)
        places = [
            own.unproject([column + 0.5, row + 0.5], share * float(shown.depth[row, column]))
            for share in (1.0, 1.5)
        ]
        labels = [MarkLabel(each.numpy()[None], f"S{i}") for i, each in enumerate(places)]
        assert [each.label for each in seen_labels(pane, shown, labels)] == ["S0"]
    assert len(drawn.panes) == 2 * len(view.images)


def test_screenshots_are_numbered(inspection, camera, subject):
    with pytest.raises(ConfigError, match="first picture"):
        save_screenshot(inspection)
    image = inspection.picture(camera).pixels
    paths = [save_screenshot(inspection), save_screenshot(inspection)]
    assert [path.relative_to(subject.folder).as_posix() for path in paths] == [
        "renders/screenshots/0001.png",
        "renders/screenshots/0002.png",
    ]
    with Image.open(paths[0]) as written:
        changed = (np.asarray(written) != image).any(axis=2)
    assert changed.any() == (image.shape[0] >= SCALE_FROM_PX)


def test_what_cannot_be_written_is_named(subject, camera):
    inspection = Inspection(subject)
    (subject.folder / "renders").write_text("in the way")
    inspection.picture(camera)
    with pytest.raises(RunError, match=r"0001\.png"):
        save_screenshot(inspection)


def test_nothing_is_written_beside_a_run_that_is_gone(subject, camera):
    gone = subject.folder / "stick" / "run"
    inspection = Inspection(replace(subject, folder=gone))
    inspection.picture(camera)
    with pytest.raises(RunError, match="run is gone"):
        save_screenshot(inspection)
    assert not gone.parent.exists()


@pytest.mark.parametrize("with_mp4", [True, False])
def test_a_path_becomes_a_video(inspection, balls, with_mp4):
    for view in balls.train[:2]:
        inspection.picture(view.camera.resized(80, 60))
        inspection.add_keyframe()
    *progress, (_, _, path) = render_video(inspection, 0.25, mp4=with_mp4)
    folder = path.with_suffix("")
    assert (path.name, path.is_file()) == (("0001.mp4", True) if with_mp4 else ("0001", False))
    assert [path.name for path in sorted(folder.iterdir())] == [
        f"{index:05d}.png" for index in range(6)
    ]
    with Image.open(folder / "00000.png") as first:
        assert first.size == (80, 60)
    assert [each.done for each in progress] == [1, 2, 3, 4, 5, 6]
    document = json.loads(save_keyframes(inspection, 0.25).read_text())
    assert len(document["camera_path"]) == 2


def test_a_video_needs_a_free_camera_and_two_keyframes(inspection, camera):
    with pytest.raises(ConfigError, match="first picture"):
        inspection.add_keyframe()
    with pytest.raises(ConfigError, match="two keyframes"):
        next(render_video(inspection, 1.0))
    inspection.settings = Settings(MODES["photos"])
    with pytest.raises(ConfigError, match="free camera"):
        next(render_video(inspection, 1.0))


def test_without_celsius_values_are_called_normalised(small_run, balls, camera, tmp_path):
    unknown = replace(small_run, facts=small_run.facts._replace(temperature=None))
    inspection = Inspection(subject_of(unknown, balls, tmp_path))
    inspection.picture(camera)
    shown = point_text(inspection.click(0.5, 0.5), inspection.subject)
    assert re.fullmatch(r"\d\.\d{3}", shown["value"])
    assert "no known °C" in header_text(inspection.subject)
    assert inspection.drawn.scales[THERMAL].unit == "normalised"


@pytest.mark.filterwarnings("ignore:scene. No view has any")
@pytest.mark.parametrize(
    ("options", "modes"),
    [
        ({"thermal": False}, [Mode("image", (RGB,)), Mode("depth"), Mode("photos", (RGB,))]),
        (
            {"rgb": False},
            [
                MODES["temperature"],
                Mode("depth"),
                MODES["uncertainty"],
                Mode("photos", (THERMAL,)),
                MODES["difference"],
            ],
        ),
        ({"two_cameras": True}, list(MODES.values())),
    ],
)
def test_other_captures(tmp_path, camera, options, modes):
    folder = train(
        write_scene(tmp_path / "scene", **options),
        tmp_path / "run",
        make_config("mrgs", max_steps=3, max_gaussians=100),
    )
    run = load_run(folder.path)
    subject = subject_of(run, run.load_scene(), tmp_path)
    assert list(subject.modes) == modes
    inspection = Inspection(subject)
    for mode in modes:
        inspection.settings = Settings(mode)
        assert inspection.picture(camera).pixels.shape == (120, 160, 3)
        reading = inspection.click(0.5, 0.5)
        assert reading is None or point_text(reading, subject)["lines"]


def test_without_the_scene_there_are_no_photos(small_run, camera, tmp_path):
    inspection = Inspection(subject_of(small_run, None, tmp_path))
    assert not any(mode.shows_photos for mode in inspection.subject.modes)
    assert inspection.picture(camera).pixels.shape == (120, 160, 3)
    assert inspection.view is None
    low, high = inspection.settings.limits[THERMAL]
    assert (low, high) == (small_run.temperature.min_c, small_run.temperature.max_c)


def test_uncertainty_is_that_of_the_marks_and_has_no_value_where_no_photo_looked(subject, camera):
    inspection = Inspection(subject)
    inspection.settings = Settings(MODES["uncertainty"])
    drawn = inspection.picture(camera)
    (shown,) = drawn.images
    values = shown.images[THERMAL]
    assert shown.solid.mean() > 0.05
    assert (values[shown.solid] > 0).all()
    assert np.isnan(values[~shown.solid]).all()
    assert drawn.scales["uncertainty"].low == 0
    row, column = np.argwhere(shown.solid)[0]
    height, width = values.shape
    text = inspection.hover((column + 0.5) / width, (row + 0.5) / height)
    assert re.fullmatch(r"± \d+\.\d K", text)


def test_uncertainty_is_drawn_with_the_dilation_of_the_model(small_run, balls, camera, tmp_path):
    wide = replace(small_run.model, dilation=Dilation(40.0))  # far from any other
    run = replace(small_run, model=wide)
    inspection = Inspection(subject_of(run, balls, tmp_path))
    inspection.settings = Settings(MODES["uncertainty"])
    (shown,) = inspection.picture(camera).images
    depth = run.render(camera).visible_depth().numpy()
    assert shown.depth[shown.solid] == pytest.approx(depth[shown.solid], rel=1e-5)


def test_a_box_is_around_the_surface_that_is_seen_in_it(inspection, camera, balls):
    inspection.picture(camera)
    box = inspection.box_of("box", [(0.7, 0.35), (0.3, 0.65)])
    depth = inspection.drawn.images[0].depth
    points = camera.unproject_image(balls.reach.without_background(camera, torch.from_numpy(depth)))
    seen = points[42:79, 48:113].reshape(-1, 3)
    seen = seen[seen.isfinite().all(dim=1)]
    assert box.contains(seen).float().mean() > 0.9
    assert (np.subtract(box.high, box.low) < 1.3 * np.ptp(seen.numpy(), axis=0).max()).all()


def test_an_outline_is_above_and_below_the_surface_at_its_corners(subject, inspection):
    above = Camera.from_fov(160, 120, 60).look_at((0.0, 0.1, 4.0), (0.0, 0.0, 0.0))
    inspection.picture(above)
    corners = [(0.4, 0.4), (0.6, 0.4), (0.6, 0.6), (0.4, 0.6), (0.01, 0.01)]
    box = inspection.box_of("polygon", corners)
    means = subject.board.shown.model.gaussians.means
    assert (box.low[2], box.high[2]) == (means[:, 2].min().item(), means[:, 2].max().item())
    depth = inspection.drawn.images[0].depth
    z = [depth[int(120 * y), int(160 * x)] for x, y in corners]
    z = np.where(np.isfinite(z), z, np.median(depth[np.isfinite(depth)]))
    pixels = [(int(160 * x) + 0.5, int(120 * y) + 0.5) for x, y in corners]
    expected = above.unproject(pixels, z).numpy()[:, :2]
    np.testing.assert_allclose(box.outlines[0], expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["box", "polygon"])
def test_what_is_drawn_beside_the_model_keeps_nothing(inspection, camera, kind):
    away = camera.look_at((3.0, 0.0, 0.0), (6.0, 0.0, 0.0))
    inspection.picture(away)
    points = [(0.3, 0.3), (0.7, 0.7)] if kind == "box" else [(0.3, 0.3), (0.7, 0.3), (0.5, 0.6)]
    with pytest.raises(ConfigError, match="no surface is seen there"):
        inspection.box_of(kind, points)
