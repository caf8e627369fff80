"""Overlays, drawings, charts and sizes."""

from __future__ import annotations

import base64
import math
import tracemalloc

import numpy as np
import pytest
import torch

from mrgs.check.problem import views_text
from mrgs.prepare.page.temperatures import histogram, spread_chart, temperatures
from mrgs.prepare.page.views import (
    EDGE_COLOR,
    MOST_SHOWN,
    Preview,
    PreviewImage,
    edge_layer,
    pairs,
    thermal_overlay,
    thumbnail_width,
)
from mrgs.prepare.page.write import World, frustum_size, lens_text, orbit_facts
from mrgs.scene import RGB, THERMAL, Camera, PointCloud
from mrgs.scene.lens import Lens


def camera(x: float = 0.0, width: int = 64, height: int = 48) -> Camera:
    """Looks along z from (x, 0, 0)."""
    K = torch.tensor([[60.0, 0, width / 2], [0, 60, height / 2], [0, 0, 1]], dtype=torch.float64)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3] = -x
    return Camera(K, viewmat, width, height)


def wall(depth: float) -> PointCloud:
    """Points of a plane across the axis."""
    x, y = torch.meshgrid(torch.linspace(-3, 3, 25), torch.linspace(-3, 3, 25), indexing="ij")
    positions = torch.stack([x, y, torch.full_like(x, depth)], dim=-1).reshape(-1, 3)
    return PointCloud(
        positions, torch.rand(positions.shape, generator=torch.Generator().manual_seed(0))
    )


def preview_of(
    thermal: np.ndarray, rgb_camera: Camera | None, thermal_camera: Camera | None
) -> Preview:
    images = {
        RGB: PreviewImage(np.full((48, 64, 3), 90, dtype=np.uint8), rgb_camera),
        THERMAL: PreviewImage(thermal.astype(np.float32), thermal_camera),
    }
    return Preview("view", "training", True, images)


def test_the_thermal_image_lands_where_the_photo_shows_the_same_thing():
    """Thermal camera 0.5 to the right, wall at 5: what the photo has at column c, it has at c -
    6."""
    columns = np.tile(np.arange(64.0), (48, 1))
    overlay = thermal_overlay(preview_of(columns, camera(), camera(0.5)), wall(5.0))
    np.testing.assert_allclose(overlay[:, 7:], columns[:, 7:] - 6, atol=0.02)
    assert np.isnan(overlay[:, :6]).all()


def test_an_overlay_needs_both_poses():
    thermal = np.zeros((48, 64))
    assert thermal_overlay(preview_of(thermal, camera(), None), wall(5.0)) is None
    assert thermal_overlay(preview_of(thermal, None, camera()), wall(5.0)) is None


def test_few_points_give_their_median_depth():
    columns = np.tile(np.arange(64.0), (48, 1))
    few = PointCloud(wall(5.0).positions[300:303], wall(5.0).colors[300:303])
    overlay = thermal_overlay(preview_of(columns, camera(), camera(0.5)), few)
    np.testing.assert_allclose(overlay[:, 7:], columns[:, 7:] - 6, atol=0.02)


def test_edges_are_drawn_where_the_temperature_jumps_and_not_where_the_image_ends():
    values = np.full((40, 60), 20.0, dtype=np.float32)
    values[:, 30:] = 40.0
    values[:, :10] = np.nan
    layer = edge_layer(values)
    opacity = np.asarray(layer.convert("RGBA"))
    assert (opacity[:, 28:32, 3] > 200).any(axis=1).all()
    assert opacity[:, 40:, 3].max() == opacity[:, :25, 3].max() == 0
    assert tuple(opacity[20, 20, :3]) == EDGE_COLOR


def test_a_flat_image_has_no_edges():
    assert (
        np.asarray(edge_layer(np.full((20, 30), 7.0, dtype=np.float32)).convert("RGBA"))[
            ..., 3
        ].max()
        == 0
    )


def test_points_of_the_orbit_view_come_back_from_their_integers():
    world = World({"a": camera(), "b": camera(1.0)}, {"b"}, wall(5.0), True, False)
    facts = orbit_facts(world)
    quantised = np.frombuffer(base64.b64decode(facts["points"]), dtype="<u2").reshape(-1, 3)
    np.testing.assert_allclose(
        quantised * facts["step"] + facts["low"], world.points.positions, atol=facts["step"]
    )
    assert [(item["name"], item["heldOut"]) for item in facts["cameras"]] == [
        ("a", False),
        ("b", True),
    ]
    np.testing.assert_allclose(facts["world"]["up"], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(facts["cameras"][1]["position"], [1, 0, 0], atol=1e-6)


def test_a_drawing_from_above_has_north_up():
    facts = orbit_facts(World({"a": camera(), "b": camera(1.0)}, set(), wall(5.0), True, True))
    above = np.reshape(facts["views"]["above"]["rotation"], (3, 3))
    np.testing.assert_allclose(above, [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-9)


def test_a_drawing_from_the_side_looks_where_the_cameras_look():
    facts = orbit_facts(World({"a": camera(), "b": camera(1.0)}, set(), wall(5.0), True, False))
    side = np.reshape(facts["views"]["side"]["rotation"], (3, 3))
    np.testing.assert_allclose(side, np.eye(3), atol=1e-9)


def test_a_camera_alone_can_be_drawn():
    empty = PointCloud(torch.zeros(0, 3), torch.zeros(0, 3))
    facts = orbit_facts(World({"a": camera()}, set(), empty, False, False))
    numbers = [number for view in facts["views"].values() for number in view["position"]]
    assert all(math.isfinite(number) for number in numbers)


def test_spreads_are_those_of_the_valid_pixels():
    values = np.array([[np.nan, 10.0], [20.0, 30.0]])
    found = temperatures([preview_of(values, None, None)], "°C", [], {}, 1)
    assert "view: 10.0 to 30.0 °C" in found["spreads"]
    nothing = preview_of(np.full((2, 2), np.nan), None, None)
    assert temperatures([nothing], "°C", [], {}, 1) is None


def test_charts_have_axes_with_units_and_escaped_names():
    spreads = dict.fromkeys(("<x>", "b"), np.array([15.0, 16, 26, 40, 41]))
    chart = spread_chart(spreads, 10.0, 50.0, "°C")
    assert "50 °C" in chart
    assert "&lt;x&gt;: 15.0 to 41.0 °C" in chart
    assert "<x>" not in chart
    bars = histogram(np.array([0.0, 3.0, 6.0]), 10.0, 40.0, "°C")
    assert bars.count("<rect") == 2
    assert "40 °C" in bars


def test_a_lens_is_told_with_its_field_of_view():
    parts = lens_text(Lens(320, 240, 160.0, 120.0, 160.0, 120.0)).split(", ", 3)
    assert parts[:2] == ["320 × 240 px", "90.0° × 90.0°"]
    assert "160.0 × 120.0 px" in parts[2]
    assert "160.0, 120.0 px, no distortion" in parts[3]
    assert lens_text(Lens(4, 4, 2.0, 2.0, 2.0, 2.0, (-0.1, 0, 0, 0), (0, 0.02))).endswith(
        "distortion k1 -0.1, p2 0.02"
    )
    assert lens_text(Lens(4, 4, 2.0, 2.0, 2.0, 2.0, fisheye=True)).endswith("fisheye distortion")


def test_many_names_are_counted():
    assert views_text(["a"]) == "1 view (a)"
    assert views_text(list("abcdefg")) == "7 views (a, b, c, d, e and 2 more)"


def test_a_hundred_pairs_stay_under_six_megabytes():
    """Coarse noise under fine noise: more detail than photos have at this size."""
    rng = np.random.default_rng(0)
    width = thumbnail_width(100)
    previews, overlays = [], {}
    for index in range(10):
        coarse = np.kron(rng.uniform(30, 220, (18, 24, 3)), np.ones((10, 10, 1)))
        rgb = np.clip(coarse + rng.normal(0, 12, coarse.shape), 0, 255).astype(np.uint8)
        thermal = np.kron(rng.uniform(10, 40, (9, 12)), np.ones((20, 20))) + rng.normal(
            0, 0.1, (180, 240)
        )
        images = {
            RGB: PreviewImage(rgb, None),
            THERMAL: PreviewImage(thermal.astype(np.float32), None),
        }
        previews.append(Preview(f"v{index}", "training", True, images))
        overlays[f"v{index}"] = thermal.astype(np.float32)
    assert rgb.shape[1] == width
    cards = pairs(previews, overlays, "°C", 10)["cards"]
    pictures = [
        image
        for card in cards
        for image in (*card["images"].values(), card["warped"], card["edges"])
    ]
    assert len(pictures) == 4 * len(cards)
    assert 10 * sum(len(picture.source) for picture in pictures) < 6e6
    assert MOST_SHOWN <= 120


def test_cameras_are_drawn_by_the_distance_to_the_nearest_other():
    """With as many cameras as a plant has, a table of all distances would take gigabytes."""
    rng = np.random.default_rng(0)
    positions = rng.uniform(0, 10, (40, 3))
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    nearest = np.median(distances.min(axis=1))
    size = nearest / 0.05
    assert frustum_size(positions, size) == pytest.approx(0.8 * nearest)
    assert frustum_size(positions[:1], size) == pytest.approx(0.06 * size)
    assert frustum_size(np.zeros((5, 3)), size) == pytest.approx(0.02 * size)
    tracemalloc.start()
    frustum_size(rng.uniform(0, 10, (3000, 3)), size)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2_000_000
