"""Marks on a wall whose temperatures and lengths are known exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from mrgs.errors import ConfigError
from mrgs.field import FieldConfig, RadianceField
from mrgs.marks import Mark, Marks
from mrgs.marks.measure import NO_PHOTO, NO_PLANE, NO_SURFACE, NO_THERMAL, MarkMeter
from mrgs.marks.run_marks import MarkPicker
from mrgs.marks.surface import (
    has_flat_outline,
    outline_area,
    see,
    steady_depth,
)
from mrgs.rasterizer.contract import Dilation
from mrgs.render import Model, render
from mrgs.scene import RGB, THERMAL, Blend, Camera, Rendering, Scene
from mrgs.scene.depth_map import before_background
from tests.helpers.gaussians import random_gaussians
from tests.helpers.walls import RANGE, camera_before_wall, render_wall

EYE = (1.0, -5.0, 0.5)
SPOT = Mark("S1", "spot", ((0.5, 0.0, 0.25),), EYE, radius=0.05)
LINE = Mark("L1", "line", ((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0)), EYE)
SQUARE = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 1.0), (0.0, 0.0, 1.0))
BOX = Mark("B1", "box", SQUARE, EYE)


@pytest.fixture
def meter() -> MarkMeter:
    return MarkMeter(render_wall, RANGE)


def test_a_spot_is_the_mean_of_its_disc(meter):
    reading = meter.read(SPOT)
    assert reading.mean == pytest.approx(21.25, abs=0.005)
    assert reading.low == pytest.approx(21.25 - 0.05 * 5**0.5, abs=0.02)
    assert reading.high == pytest.approx(21.25 + 0.05 * 5**0.5, abs=0.02)
    assert np.isnan(reading.length)
    assert np.isnan(reading.area)
    assert reading.problem == ""


def test_a_spot_reads_what_a_photo_from_its_eye_shows():
    gaussians = random_gaussians(60, seed=5)
    gaussians.means = 0.6 * gaussians.means
    gaussians.log_scales = 0.3 * gaussians.log_scales - 1.2
    gaussians.opacity_logits = {each: torch.full((60, 1), 4.0) for each in (RGB, THERMAL)}
    model = Model(
        gaussians,
        RadianceField(FieldConfig(residuals=False)),
        None,
        sh_degree=0,
        dilation=Dilation(),
    )
    camera = Camera.from_fov(161, 121, 50.0).look_at(EYE, [0.0, 0.0, 0.0])

    def render_surface(camera):
        with torch.no_grad():
            return render(model, {THERMAL: camera}, with_median_depth=True)[0]

    seen = render_surface(camera)
    middle = seen[THERMAL].image[59:62, 79:82, 0].double().mean()
    depth = seen.surface_depth(THERMAL)[60, 80].double()
    place = camera.unproject(torch.tensor([80.5, 60.5]).double(), depth)
    radius = 1.5 * float(depth / camera.K[0, 0])
    mark = Mark("S1", "spot", (tuple(place.tolist()),), EYE, radius=radius)
    reading = MarkMeter(render_surface, RANGE).read(mark)
    assert reading.mean == pytest.approx(RANGE.to_celsius(middle).item(), abs=0.3)


def test_a_spot_reads_what_the_photos_see_wherever_it_was_drawn_from():
    """The image of a model depends on where its camera points."""

    def render_turned(camera: Camera) -> Rendering:
        turned = 1 - float(camera.forward[1])
        rendering = render_wall(camera)
        return rendering.with_images({THERMAL: rendering[THERMAL].image + turned})

    cameras = [facing_the_wall(camera_before_wall(x)) for x in (-1.0, 0.0, 1.0)]
    aside = replace(SPOT, points=((1.5, 0.0, 0.5),), eye=(-1.5, -3.0, 0.5))
    reading = MarkMeter(render_turned, RANGE, cameras).read(aside)
    assert reading.mean == pytest.approx(23.5, abs=0.05)
    unknown = MarkMeter(render_turned, RANGE).read(aside)
    assert unknown.mean > 30
    changing = MarkMeter(render_turned, RANGE, cameras, changes=True).read(aside)
    assert changing.mean == unknown.mean


def facing_the_wall(camera: Camera) -> Camera:
    """The same camera, looking straight at the wall."""
    x, y, z = camera.position.tolist()
    return camera.look_at((x, y, z), (x, 0.0, z))


def test_a_line_has_a_profile_along_its_pieces(meter):
    reading = meter.read(LINE)
    assert reading.length == pytest.approx(3.0, abs=1e-9)
    profile = reading.profile
    assert profile.distances[[0, -1]] == pytest.approx((0.0, 3.0))
    along = np.minimum(profile.distances, 2.0) - 1
    exact = 20 + 2 * along + np.maximum(profile.distances - 2, 0.0)
    assert np.abs(profile.values - exact).max() < 0.05
    assert reading.mean == pytest.approx(exact.mean(), abs=0.02)


def test_an_area_has_extremes_and_a_size(meter):
    reading = meter.read(BOX)
    assert reading.area == pytest.approx(1.0, rel=1e-9)
    assert (reading.mean, reading.low, reading.high) == pytest.approx((21.5, 20.0, 23.0), abs=0.03)
    assert reading.low_at == pytest.approx((0.0, 0.0, 0.0), abs=0.02)
    assert reading.high_at == pytest.approx((1.0, 0.0, 1.0), abs=0.02)
    assert reading.spread == pytest.approx((4 / 12 + 1 / 12) ** 0.5, rel=0.02)
    assert reading.covered == 1.0


def test_the_area_of_an_outline_that_is_not_convex():
    corner = [(0.0, 0, 0), (2.0, 0, 0), (2.0, 0, 1), (1.0, 0, 1), (1.0, 0, 2), (0.0, 0, 2)]
    assert outline_area(corner) == pytest.approx(3.0)


def moved_to(depth: float, corner: int, square: tuple = SQUARE) -> Mark:
    """The box with one corner on another surface, which its eye sees at the same pixel."""
    places = list(square)
    away = np.array(places[corner]) - EYE
    places[corner] = tuple((EYE + depth * away).tolist())
    return replace(BOX, points=tuple(places))


def test_corners_on_different_surfaces_have_no_area(meter):
    for corner in range(4):
        for depth in (0.5, 0.8, 1.5):
            assert not has_flat_outline(moved_to(depth, corner)), (corner, depth)
    for corner, depth in ((0, 0.5), (2, 1.5)):
        reading = meter.read(moved_to(depth, corner))
        assert reading.remarks == (NO_PLANE,)
        assert np.isnan(reading.area)
        assert np.isfinite(reading.mean), "what is seen there is still measured"
    depths = (1.68, 1.88, 0.93, 1.82)  # as picked over the edge of a table
    pixels = ((-0.2, -0.2), (0.2, -0.2), (0.2, 0.2), (-0.2, 0.2))
    points = tuple((x * z, z, y * z) for (x, y), z in zip(pixels, depths, strict=True))
    assert not has_flat_outline(Mark("B1", "box", points, (0.0, 0.0, 0.0)))


def test_a_slope_noise_and_a_gentle_bend_keep_their_area(meter):
    assert np.isfinite(meter.read(BOX).area)
    assert meter.read(BOX).remarks == ()
    steep = tuple((x, 20.0 * x, z) for x, _, z in SQUARE)
    assert has_flat_outline(replace(BOX, points=steep)), "depths that differ, in one plane"
    small = tuple((0.05 * x, y, 0.05 * z) for x, y, z in SQUARE)
    for depth in (0.98, 1.02):
        assert has_flat_outline(moved_to(depth, 2)), "as the depths of a model differ"
        assert has_flat_outline(moved_to(depth, 2, small)), "also of a small box"
    pipe = [(np.sin(angle), -np.cos(angle)) for angle in (-0.8, 0.8)]
    corners = [(x, y, z) for (x, y), z in zip([*pipe, *pipe[::-1]], (0, 0, 1, 1), strict=True)]
    assert has_flat_outline(replace(BOX, points=tuple(corners))), "along a pipe"


def test_differences_are_to_the_reference_or_to_a_mark_of_their_own(meter):
    marks = Marks((SPOT, replace(BOX, against="L1"), LINE), reference="S1")
    spot, box, line = meter.measure(marks)
    assert np.isnan(spot.difference)
    assert box.difference == pytest.approx(box.mean - line.mean)
    assert line.difference == pytest.approx(line.mean - spot.mean)


def test_what_lies_beyond_the_surface_is_left_out(meter):
    half = tuple((x + 2.5, y, z) for x, y, z in SQUARE)
    reading = meter.read(replace(BOX, points=half))
    assert reading.covered == pytest.approx(0.53, abs=0.01)  # of its picture; half of it is nearer
    assert reading.high == pytest.approx(27.0, abs=0.05)
    gone = meter.read(replace(SPOT, points=((3.5, 0.0, 0.0),)))
    assert gone.problem == NO_SURFACE
    assert np.isnan(gone.mean)


def test_a_spot_that_the_model_no_longer_holds_is_empty(meter):
    before_the_wall = replace(SPOT, points=((0.5, -1.0, 0.25),))
    assert meter.read(before_the_wall).problem == NO_SURFACE


def test_photos_are_counted_and_where_none_looks_there_is_no_temperature():
    cameras = [camera_before_wall(x) for x in (-1.0, 0.0, 1.0)]
    away = camera_before_wall().look_at([0.0, -5.0, 0.0], [0.0, -10.0, 0.0])
    assert MarkMeter(render_wall, RANGE, [*cameras, away]).read(BOX).photos == 3
    reading = MarkMeter(render_wall, RANGE, [away]).read(BOX)
    assert reading.photos == 0
    assert reading.problem == NO_PHOTO
    assert np.isnan(reading.mean)
    assert reading.area == pytest.approx(1.0)


def wall_before_sky(camera: Camera) -> Rendering:
    """The wall, and −30 °C a hundred metres behind its ends."""
    blend = render_wall(camera)[THERMAL]
    wall = blend.alpha > 0
    cold = RANGE.from_celsius(torch.tensor(-30.0)).to(blend.image)
    return Rendering(
        {
            THERMAL: Blend(
                torch.where(wall[..., None], blend.image, cold),
                torch.where(wall, blend.depth, 100.0),
                torch.ones_like(blend.alpha),
            )
        }
    )


def test_the_sky_is_refused():
    camera = camera_before_wall()
    corners = [[x, 0.0, z] for x in (-3.0, 3.0) for z in (-2.0, 2.0)]
    celsius = [np.zeros((120, 160), np.float32)]
    scene = Scene.from_arrays([camera], celsius=celsius, points=np.array(corners))
    aside = camera.look_at([0, -5, 0], [4.0, 0, 0])
    assert MarkPicker(MarkMeter(wall_before_sky, RANGE), None).pick("spot", aside, [(150.0, 60.0)])
    meter = MarkMeter(before_background(wall_before_sky, scene.reach), RANGE)
    with pytest.raises(ConfigError, match=r"surface .* 150, 60"):
        MarkPicker(meter, None).pick("spot", aside, [(150.0, 60.0)])
    sky = replace(BOX, points=tuple((x + 120, 100.0, z) for x, _, z in SQUARE))
    assert meter.read(sky).problem == NO_SURFACE
    over_the_end = replace(BOX, points=tuple((x + 2.5, y, z) for x, y, z in SQUARE))
    assert meter.read(over_the_end).low == pytest.approx(25.0, abs=0.05)


def test_without_thermal_images_there_are_lengths_alone():
    def colours(camera):
        blend = render_wall(camera)[THERMAL]
        return Rendering({RGB: blend._replace(image=blend.image.expand(-1, -1, 3))})

    line, box = MarkMeter(colours, None).measure(Marks((LINE, BOX)))
    assert (line.length, box.area) == pytest.approx((3.0, 1.0))
    assert {line.problem, box.problem} == {NO_THERMAL}


def test_a_mark_about_its_own_eye_is_refused(meter):
    wide = replace(BOX, eye=(0.5, -0.05, 0.5))
    assert "too wide" in meter.read(wide).problem


def test_places_are_picked_on_the_surface(meter):
    camera, picker = camera_before_wall(), MarkPicker(meter, None)
    (place,) = picker.pick("spot", camera, [(100.0, 40.0)])["points"]
    assert place[1] == pytest.approx(0.0, abs=1e-6)
    pixel, _ = camera.project(torch.tensor(place).double())
    assert pixel.tolist() == pytest.approx([100.0, 40.0], abs=1e-6)
    with pytest.raises(ConfigError, match=r"200, 40 .* 160 × 120"):
        picker.pick("spot", camera, [(200.0, 40.0)])
    aside = camera.look_at([0, -5, 0], [4.0, 0, 0])
    with pytest.raises(ConfigError, match=r"surface .* 150, 60"):
        picker.pick("spot", aside, [(150.0, 60.0)])


def test_a_picked_depth_is_steadier_than_a_pixel():
    """A model's depth is that of single splats: steps, and things that stick out."""
    rng = np.random.default_rng(0)

    def rough(camera):
        blend = render_wall(camera)[THERMAL]
        steps = torch.from_numpy(rng.choice([0.99, 1.0, 1.01, 1.02], blend.depth.shape))
        return Rendering({THERMAL: Blend(blend.image, blend.depth * steps, blend.alpha)})

    camera = camera_before_wall(2.0)
    exact = see(render_wall, camera).depth
    surface = see(rough, camera)
    errors = [
        steady_depth(surface, x + 0.5, y + 0.5) / exact[y, x] - 1
        for x in range(40, 120, 20)
        for y in range(30, 100, 20)
    ]
    assert np.abs(np.array(errors) - 0.005).max() < 0.006
