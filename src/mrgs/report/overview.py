"""Where the marks are: in photos, on a plan from above or from the front, on a temperature map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Float64
from PIL import Image, ImageDraw

from mrgs.errors import ConfigError, RunError
from mrgs.maps.crs import LOCAL, coordinate_system
from mrgs.maps.draw import (
    OrthographicMap,
    draw_length,
    draw_map,
    draw_north,
    frame_map,
    map_body,
    map_scale,
)
from mrgs.maps.facade import facade_grid
from mrgs.maps.options import MapOptions
from mrgs.maps.surfaces import grid_from_above, seen_surfaces
from mrgs.marks.mark import Mark
from mrgs.marks.regions import Regions
from mrgs.marks.tables import pixel_cm_text
from mrgs.pictures import drawing
from mrgs.pictures.drawing import LABEL_PX, RING_PX, Scale
from mrgs.pictures.files import to_array, to_picture
from mrgs.pictures.html import InlineImage, inline_image
from mrgs.pictures.palette import PaletteName, display_range
from mrgs.pictures.values import in_unit, unit_label
from mrgs.runs.baked import BakedModel, bake
from mrgs.runs.open import Run
from mrgs.scene import THERMAL, Camera, Rendering, Scene, TemperatureRange, View, in_order
from mrgs.scene.depth_map import PhotoSurvey, SurfaceRenderer
from mrgs.scene.preview import best_view


class Style(NamedTuple):
    """How temperatures are drawn: the palette, the limits of all pictures in the unit of their
    values, None for each its own, and the sign before decimals."""

    palette: PaletteName = "inferno"
    limits: tuple[float, float] | None = None
    decimal: str = "."

    def scale(self, limits: tuple[float, float], temperature: TemperatureRange | None) -> Scale:
        """The scale of a picture, whose own limits are given."""
        unit = unit_label(THERMAL, temperature)
        return Scale(self.palette, *(self.limits or limits), unit, self.decimal)


PLAIN = Style()

SMALL_PX = 420
MARK, WHITE, BLACK = (200, 70, 0), (255, 255, 255), (0, 0, 0)
STROKE_PX = 3


def draw_marks(
    image: Image.Image, marks: Mapping[str, Mark], places: Mapping[str, Float64[np.ndarray, "_ 2"]]
) -> None:
    """A ring about each spot, the outline of the others, then names; places are their corners."""
    for name, corners in places.items():
        path = [*map(tuple, corners)]
        if marks[name].kind == "spot":
            draw, (x, y) = ImageDraw.Draw(image), corners[0]
            for r, color, width in ((RING_PX + 1, BLACK, 5), (RING_PX, WHITE, 3)):
                draw.ellipse([x - r, y - r, x + r, y + r], outline=color, width=width)
        else:
            drawing.draw_outline(image, path, marks[name].is_area, STROKE_PX)
    drawing.draw_names(image, {name: corners.mean(axis=0) for name, corners in places.items()})


def draw_place(
    image: Image.Image, mark: Mark, corners: Float64[np.ndarray, "n 2"], radius: float
) -> None:
    """A dot for a spot, the outline of the other kinds, at pixels of a plan."""
    draw, path = ImageDraw.Draw(image), [*map(tuple, corners)]
    if mark.is_area:
        path.append(path[0])
    for color, wider in ((WHITE, 4), (MARK, 0)):
        if mark.kind != "spot":
            draw.line(path, fill=color, width=round(radius) + wider, joint="curve")
    x, y = np.mean(corners, axis=0)
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), MARK, WHITE, 2)


def small_picture(image: Image.Image) -> Image.Image:
    """A picture for beside others: at most ``SMALL_PX`` wide and high."""
    share = SMALL_PX / max(image.size)
    size = round(image.width * share), round(image.height * share)
    return image.resize(size, Image.Resampling.LANCZOS)


WIDTH_PX, HEIGHT_PX, MARGIN_PX = 1440, 840, 40
SMALL_RADIUS_PX = 22
MOST_POINTS = 20_000
TRIMMED_PERCENT = 4.0
"""Percentage of start points ignored on each side, so that outliers do not shrink the plan."""

FACES_ONE_SIDE = 0.7
"""Length of the mean of the cameras' level directions above which they look at one side."""

FADED = 0.45
"""Share of white in the colours of the surfaces, so that the marks stand out."""

CAMERA = (31, 95, 168)


class Plan:
    """The start points of a scene in their colours, on which marks are drawn: from the front, along
    the cameras' mean level direction, if they face one side; else from above."""

    def __init__(self, scene: Scene, marks: Sequence[Mark]) -> None:
        self.from_the_front = faces_one_side(scene)
        self._metric, self._north = scene.world.metric, scene.world.north
        self._axes = _axes(_level_direction(scene) if self.from_the_front else None)
        points, colors = scene.points.positions.double().numpy(), scene.points.colors.numpy()
        step = max(1, len(points) // MOST_POINTS)
        flat = points[::step] @ self._axes.T
        cameras = np.stack([camera.position.numpy() for camera in scene.train_cameras])
        self._cameras = np.empty((0, 2)) if self.from_the_front else (cameras @ self._axes.T)[:, :2]
        low, high = np.percentile(flat[:, :2], [TRIMMED_PERCENT, 100 - TRIMMED_PERCENT], axis=0)
        reached = [self._flat(mark) for mark in marks]
        reached += [self._cameras] if len(self._cameras) else []
        self._low = np.min([low, *(each.min(axis=0) for each in reached)], axis=0)
        self._high = np.max([high, *(each.max(axis=0) for each in reached)], axis=0)
        size = np.array([WIDTH_PX, HEIGHT_PX]) - 2 * MARGIN_PX
        self._scale = float((size / np.maximum(self._high - self._low, 1e-9)).min())
        self._ground = self._draw_ground(flat, colors[::step])

    def whole(self, marks: Mapping[str, Mark], decimal: str = PLAIN.decimal) -> Image.Image:
        """The plan with all marks under their names."""
        image = self._ground.copy()
        for mark in marks.values():
            draw_place(image, mark, self._pixels(self._flat(mark)), LABEL_PX / 4)
        middles = {name: self._pixels(self._flat(m)).mean(axis=0) for name, m in marks.items()}
        drawing.draw_names(image, middles)
        self._draw_scale(image, decimal)
        return image

    def small(self, mark: Mark) -> Image.Image:
        """The plan with one mark, for beside its pictures."""
        image = self._ground.copy()
        draw_place(image, mark, self._pixels(self._flat(mark)), SMALL_RADIUS_PX)
        return small_picture(image)

    def _draw_ground(
        self, flat: Float64[np.ndarray, "n 3"], colors: Float32[np.ndarray, "n 3"]
    ) -> Image.Image:
        """The surfaces, the farthest first, and the cameras."""
        image = Image.new("RGB", (WIDTH_PX, self._height), drawing.PAPER)
        draw = ImageDraw.Draw(image)
        inside = ((flat[:, :2] >= self._low) & (flat[:, :2] <= self._high)).all(axis=1)
        order = np.flatnonzero(inside)[np.argsort(flat[inside, 2])]
        shades = (255 * (FADED + (1 - FADED) * colors[order])).astype(int)
        for (x, y), shade in zip(self._pixels(flat[order, :2]), shades.tolist(), strict=True):
            draw.rectangle((x - 2, y - 2, x + 2, y + 2), fill=tuple(shade))
        for x, y in self._pixels(self._cameras):
            draw.polygon([(x, y - 10), (x + 9, y + 6), (x - 9, y + 6)], fill=CAMERA, outline=WHITE)
        return image

    def _draw_scale(self, image: Image.Image, decimal: str) -> None:
        """A bar of a round length, and an arrow to the north, where the scene has them."""
        if self._metric:
            bottom = image.height - MARGIN_PX
            draw_length(image, (MARGIN_PX, bottom), WIDTH_PX, 1 / self._scale, decimal)
        if self._north and not self.from_the_front:
            draw_north(image, (WIDTH_PX - MARGIN_PX, MARGIN_PX + 10), 0.0)

    @property
    def _height(self) -> int:
        return round((self._high - self._low)[1] * self._scale) + 2 * MARGIN_PX

    def _flat(self, mark: Mark) -> Float64[np.ndarray, "n 2"]:
        return (np.array(mark.points) @ self._axes.T)[:, :2]

    def _pixels(self, flat: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n 2"]:
        """Pixels of places in the plan's plane."""
        middle = flat - (self._low + self._high) / 2
        return np.array([WIDTH_PX, self._height]) / 2 + self._scale * middle * (1, -1)


def faces_one_side(scene: Scene) -> bool:
    """Whether the cameras of a scene look at one side of it, as at a façade."""
    return bool(np.linalg.norm(_level_direction(scene)) > FACES_ONE_SIDE)


def _level_direction(scene: Scene) -> Float64[np.ndarray, "3"]:
    """The mean of the cameras' directions, without its vertical part."""
    forward = np.stack([camera.forward.numpy() for camera in scene.train_cameras])
    level: Float64[np.ndarray, "3"] = forward.mean(axis=0) * (1, 1, 0)
    return level


def _axes(level: Float64[np.ndarray, "3"] | None) -> Float64[np.ndarray, "3 3"]:
    """Rows: to the right, up, and towards the onlooker, who looks level, or down if None."""
    if level is None:
        return np.eye(3)
    towards, up = -level / np.linalg.norm(level), np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(up, towards), up, towards])


MOST_PX = 1200
"""Longer side of the map."""

SMALL_DRAWN_PX, SMALL_RADIUS = 1200, 0.02
WHITE_SHARE = 0.3
"""Share of white mixed into the small map, to make the mark visible."""

LOOKS_DOWN = 0.7
"""Mean share of the cameras' directions that points down, of a scene seen from above."""


@dataclass(frozen=True, eq=False)
class TemperatureMap:
    """A map for a report: of a façade if it is ``from_the_front``, else of the scene from above; in
    the scene's units if it is not ``metric``."""

    drawn: OrthographicMap
    from_the_front: bool
    north: bool
    metric: bool = True
    unit: str = "°C"

    def shows(self, mark: Mark) -> bool:
        """Whether all of a mark is on the map."""
        return self.drawn.grid.shows(np.array(mark.points))

    def picture(self, marks: Mapping[str, Mark], style: Style = PLAIN) -> Image.Image:
        """The temperatures with legend and scale bar, and the marks on it under their names."""
        scale = map_scale(self.drawn, style.palette, style.limits)
        scale = scale._replace(decimal=style.decimal, unit=self.unit)
        body, metres_per_px = map_body(self.drawn, scale)
        grid, zoom = self.drawn.grid, self.drawn.grid.pixel_m / metres_per_px
        shown = {
            name: zoom * grid.pixels_of(np.array(each.points))
            for name, each in marks.items()
            if self.shows(each)
        }
        draw_marks(body, marks, shown)
        metres = metres_per_px if self.metric else None
        return frame_map(body, metres, scale, 0.0 if self.north else None)

    def small(self, mark: Mark) -> Image.Image:
        """The place of a mark on the map, in the colours of the photos, where there are any."""
        colors = self.drawn.bands[1:4].transpose(1, 2, 0)
        if np.isnan(colors).all():
            image, metres_per_px = map_body(self.drawn, map_scale(self.drawn, "grey"))
        else:
            pale = np.nan_to_num(WHITE_SHARE * 255 + (1 - WHITE_SHARE) * colors, nan=255)
            zoom = SMALL_DRAWN_PX / max(colors.shape[:2])
            size = round(zoom * colors.shape[1]), round(zoom * colors.shape[0])
            image = Image.fromarray(pale.astype(np.uint8)).resize(size, Image.Resampling.BICUBIC)
            metres_per_px = self.drawn.grid.pixel_m / zoom
        grid = self.drawn.grid
        corners = grid.pixels_of(np.array(mark.points)) * (grid.pixel_m / metres_per_px)
        draw_place(image, mark, corners, SMALL_RADIUS * max(image.size))
        return small_picture(image)


def has_map(scene: Scene) -> bool:
    """Whether a scene is a façade or seen from above: a map shows its surfaces as its photos do."""
    down = [-camera.forward[2].item() for camera in scene.train_cameras]
    return faces_one_side(scene) or sum(down) / len(down) > LOOKS_DOWN


def temperature_map(run: Run, scene: Scene, regions: Regions) -> TemperatureMap | None:
    """The map of a scene that has °C and metres, and is a façade or seen from above; None for all
    others. SceneError if a photo cannot be read."""
    if scene.temperature is None or not scene.world.metric or not has_map(scene):
        return None
    baked = bake(run.model, scene.train_cameras, run.temperature, run.device)
    try:
        return draw_temperature_map(baked, scene, regions)
    except (ConfigError, RunError):
        return None


def draw_temperature_map(
    baked: BakedModel, scene: Scene, regions: Regions | None = None
) -> TemperatureMap:
    """The map of a façade, or of a scene from above. ConfigError if the vertical is not known or
    pyproj not installed, RunError if there is no façade, SceneError if a photo cannot be read."""

    def corrected(
        points: Float32[np.ndarray, "n 3"], celsius: Float32[np.ndarray, " n"]
    ) -> tuple[Float32[np.ndarray, " n"], Float32[np.ndarray, " n"]]:
        found = celsius if regions is None else regions.corrected_at(points, celsius)
        return found, np.full_like(celsius, np.nan)

    maps = seen_surfaces(baked, scene)
    options, metric = MapOptions(), scene.world.metric
    if faces_one_side(scene):
        grid, coverage, north = facade_grid(scene, maps, options, MOST_PX), None, False
    else:
        system = coordinate_system(scene) if metric else LOCAL
        grid, coverage = grid_from_above(scene, maps, system, options, MOST_PX)
        north = system.north
    drawn = draw_map(baked, scene, maps, grid, corrected, coverage)
    return TemperatureMap(drawn, coverage is None, north, metric)


OVERVIEW_PX = 900
MOST_OVERVIEWS = 3
SCALE_GAP_PX = 10
TAIL_PERCENT = 0.2
"""Percentage of the surfaces' temperatures cut off at each end of a picture's colour scale."""


class Overview(NamedTuple):
    """A view with the names of the marks that it sees, the photo of every modality but thermal, RGB
    first, and the thermal rendering above its scale."""

    view: str
    seen: list[str]
    pictures: list[Image.Image]


def overviews(
    scene: Scene,
    marks: Mapping[str, Mark],
    survey: PhotoSurvey,
    render: SurfaceRenderer,
    style: Style = PLAIN,
) -> list[Overview]:
    """The views that together see most marks by their middles, the one that sees most first; at
    most ``MOST_OVERVIEWS``, by the survey of the scene's ``survey_views``. Without marks,
    the view that shows most of the scene. SceneError if a photo cannot be read."""
    thermal = scene.survey_views(THERMAL)
    if not marks and thermal and len(scene.points.positions):
        view = thermal[best_view(scene.survey_cameras(THERMAL), scene.points.positions)]
        return [overview(view, {}, scene, render, style)]
    names = np.array([*marks])
    middles = np.array([np.mean(mark.points, axis=0) for mark in marks.values()], np.float32)
    seen = {n: names[item.shown(middles).rows].tolist() for n, item in survey.near(middles)}
    left, chosen = set(marks), []
    for _ in range(MOST_OVERVIEWS):
        best = max(seen, key=lambda n: len(left & set(seen[n])), default=None)
        if best is None or not left & set(seen[best]):
            break
        shown = {name: marks[name] for name in seen[best] if name in left}
        view = thermal[best]
        chosen.append(overview(view, shown, scene, render, style))
        left -= set(shown)
    return chosen


def overview(
    view: View, marks: Mapping[str, Mark], scene: Scene, render: SurfaceRenderer, style: Style
) -> Overview:
    """Photos and thermal rendering of a view with marks. SceneError if a photo cannot be read."""
    pictures = []
    for modality in sorted(in_order(view.images), key=lambda each: each == THERMAL):
        camera = view.images[modality].camera
        if modality == THERMAL:
            picture, scale = _thermal(render(camera), camera, scene, style)
        else:
            pixels = to_picture(modality, view.images[modality].load().values, None, "inferno")
            picture = Image.fromarray(pixels)
        size = OVERVIEW_PX, max(1, round(picture.height * OVERVIEW_PX / picture.width))
        picture = picture.resize(size, Image.Resampling.LANCZOS)
        zoom, shown = picture.width / camera.width, {}
        for name, mark in marks.items():
            corners = zoom * camera.project(torch.tensor(mark.points).double())[0].numpy()
            if np.isfinite(corners).all():  # not behind the camera
                shown[name] = corners
        draw_marks(picture, marks, shown)
        if modality == THERMAL:
            picture = drawing.above_scale(picture, scale, LABEL_PX, SCALE_GAP_PX)
        pictures.append(picture)
    return Overview(view.name, list(marks), pictures)


def _thermal(
    rendering: Rendering, camera: Camera, scene: Scene, style: Style
) -> tuple[Image.Image, Scale]:
    """The thermal image and its scale, which its surfaces use up; the sky may be beyond it."""
    values = in_unit(THERMAL, to_array(rendering[THERMAL].image[..., 0]), scene.temperature)
    surface = scene.reach.without_background(camera, rendering.surface_depth(THERMAL))
    limits = display_range(values[np.isfinite(to_array(surface))], TAIL_PERCENT)
    scale = style.scale(limits, scene.temperature)
    return Image.fromarray(scale.colorize(values)), scale


@dataclass(frozen=True, eq=False)
class PlacePictures:
    """Where marks are, for the template: views with their pictures; the plan, None without marks,
    or where the map shows them all; the map, None where the scene has none, its width and height in
    m, and its pixel in cm."""

    from_the_front: bool
    overviews: Sequence[Mapping[str, Any]]
    plan: InlineImage | None
    map: InlineImage | None
    map_size: Sequence[str]
    _drawn: TemperatureMap | None
    _plan: Plan | None

    def small(self, mark: Mark) -> Image.Image:
        """The place of one mark on the map, or on the plan, for beside its pictures."""
        if self._drawn is not None and self._drawn.shows(mark):
            return self._drawn.small(mark)
        assert self._plan is not None
        return self._plan.small(mark)


def draw_places(
    run: Run,
    scene: Scene,
    marks: Mapping[str, Mark],
    survey: PhotoSurvey,
    regions: Regions,
    style: Style,
) -> PlacePictures:
    """Draw marks into photos and renderings, on the plan and on the map; ``survey`` is that of the
    scene's thermal training photos. SceneError if a photo cannot be read."""
    drawn = temperature_map(run, scene, regions)
    views = overviews(scene, marks, survey, regions.render, style)
    plan = Plan(scene, list(marks.values())) if marks else None
    size, image, whole = [], None, None
    if drawn is not None:
        grid = drawn.drawn.grid
        size = [f"{pixels * grid.pixel_m:.1f}" for pixels in (grid.width, grid.height)]
        size.append(pixel_cm_text(grid.pixel_m))
        image = inline_image(drawn.picture(marks, style), "map", quality=90)
    if plan is not None and not (drawn is not None and all(map(drawn.shows, marks.values()))):
        whole = inline_image(plan.whole(marks, style.decimal), "plan", png=True)
    shown = []
    for each in views:
        text = ", ".join(each.seen) or each.view
        pictures = [inline_image(picture, text, quality=88) for picture in each.pictures]
        shown.append({"view": each.view, "pictures": pictures})
    return PlacePictures(faces_one_side(scene), shown, whole, image, size, drawn, plan)
