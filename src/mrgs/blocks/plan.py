"""Which parts of a scene photos show, according to a coarse model, and how it is cut into blocks:
written once, and read by all processes that train them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
import torch
from jaxtyping import Bool, Float32
from scipy.ndimage import distance_transform_edt, maximum_filter
from torch import Tensor

from mrgs.blocks.region import (
    Rectangle,
    Ring,
    ScenePlane,
    cells,
    parse_grid,
    plane_of,
    shape_for,
    without_empty,
)
from mrgs.errors import ConfigError, RunError
from mrgs.method.config import TrainConfig
from mrgs.render import Model, render
from mrgs.scene import Camera, Modality, Pixels, PosedImage, Scene, View
from mrgs.system.atomic import write_text
from mrgs.system.disk import read_text
from mrgs.system.strict_yaml import flat
from mrgs.system.typed_json import Count, NotNegative, from_json
from mrgs.system.wording import counted

ACROSS_PX = 96
"""Width of the images for which the place of each pixel in the scene is computed."""

COUNTED_PX = 32
"""Width of the images by which photos are chosen."""

LEAST_SHARE = 0.1
"""Least share of a photo's pixels that must show a part of the scene to train it."""

SHARE_OF_MOST = 0.5
"""The same relative to the best photo's share; the smaller bound counts."""

SKY_PX = 3
"""Width of the sky that counts around a part of a scene, for its outline."""


class Places(NamedTuple):
    """Places in the plane of a scene that the pixels of an image show: coordinates in the plane,
    [H, W, 2]; NaN where the background is seen."""

    known: Float32[np.ndarray, "h w 2"]

    def inside(self, region: Rectangle | Ring) -> Bool[np.ndarray, "h w"]:
        """Which pixels show a region."""
        found: Bool[np.ndarray, "h w"] = region.contains(torch.from_numpy(self.known)).numpy()
        return found

    def counted(self, region: Rectangle | Ring) -> Bool[np.ndarray, "h w"]:
        """Which pixels count for a region: those that show it, and the sky at its outline."""
        inside = self.inside(region)
        sky = np.isnan(self.known[..., 0])
        return inside | (sky & maximum_filter(inside, 2 * SKY_PX + 1))


class Surveyor:
    """Finds the places that cameras show."""

    def __init__(self, model: Model, scene: Scene, plane: ScenePlane) -> None:
        self._model, self._plane, self._reach = model, plane, scene.reach

    @torch.no_grad()
    def places(self, camera: Camera, modality: Modality) -> Places:
        """The places of a small image of a camera. Where the model shows no surface, it is taken to
        be where the nearest pixel shows one."""
        small = camera.at_most(ACROSS_PX)
        rendering = render(self._model, {modality: small}, with_median_depth=True)[0].cpu()
        depth = rendering.surface_depth(modality)
        if not depth.isfinite().any():
            return Places(np.full((*depth.shape, 2), np.nan, np.float32))
        nearest = distance_transform_edt(
            ~depth.isfinite().numpy(), return_distances=False, return_indices=True
        )
        points = small.unproject_image(depth[tuple(torch.from_numpy(nearest).long())].double())
        places = self._plane.coordinates(points)
        places[self._reach.is_background(points)] = torch.nan
        return Places(places.float().numpy())


def counted_places(surveyor: Surveyor, scene: Scene) -> list[Places]:
    """The places of the training views, in small images."""
    found = []
    for view in scene.train:
        modality = next(iter(view.images))
        known = surveyor.places(view.camera, modality).known
        step = max(1, known.shape[1] // COUNTED_PX)
        found.append(Places(known[::step, ::step].copy()))
    return found


def views_of(region: Rectangle | Ring, places: Sequence[Places]) -> tuple[int, ...]:
    """The views that show a region, by their places."""
    shares = np.array([each.inside(region).mean() for each in places])
    most = shares.max(initial=0.0)
    if most == 0:
        return ()
    return tuple(np.flatnonzero(shares >= min(LEAST_SHARE, SHARE_OF_MOST * most)).tolist())


def only(scene: Scene, region: Rectangle | Ring, views: Sequence[int], surveyor: Surveyor) -> Scene:
    """The same scene and files, but in the photos of these views only pixels that show the region
    count: a run on it is a run on the scene."""
    train = list(scene.train)
    for number in views:
        train[number] = _masked(train[number], region, surveyor)
    return replace(scene, train=tuple(train))


def _masked(view: View, region: Rectangle | Ring, surveyor: Surveyor) -> View:
    images: dict[Modality, PosedImage] = {}
    known: list[tuple[Camera, Bool[np.ndarray, "h w"]]] = []
    for modality, image in view.images.items():
        camera = image.camera
        shared = next((mask for other, mask in known if other.coincides_with(camera)), None)
        mask = surveyor.places(camera, modality).counted(region) if shared is None else shared
        known.append((camera, mask))
        images[modality] = replace(
            image,
            load=partial(_load, image.load, mask),
            load_at_least=partial(_load, image.look, mask),
        )
    return View(view.name, images)


def _load(load: Callable[..., Pixels], mask: Bool[np.ndarray, "h w"], *least_width: int) -> Pixels:
    """An image, or a look at it, of which only the pixels of a smaller mask count."""
    pixels = load(*least_width)
    height, width = pixels.values.shape[:2]
    row, column = (
        torch.arange(size) * small // size
        for size, small in zip((height, width), mask.shape, strict=True)
    )
    counts: Bool[Tensor, "h w"] = torch.from_numpy(mask)[row[:, None], column]
    return Pixels(pixels.values, counts if pixels.valid is None else counts & pixels.valid)


FORMAT = 1

VIEWS_PER_BLOCK = 150
"""Photos per block, if the number of blocks is automatic."""

OVERLAP = 0.15
"""Default width of the margins, as a share of the narrowest block."""


class BlockOptions(NamedTuple):
    """How a scene is to be cut: ``auto`` or ``ROWSxCOLUMNS``, and the width of the margin about
    each block that is trained with it, scene units; None for a share of the narrowest one."""

    blocks: str = "auto"
    overlap: float | None = None


class PlannedBlock(NamedTuple):
    """The region that a block contributes to the joined model, and the training views of the scene
    that show it or its margin."""

    region: Rectangle
    views: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]


@dataclass(frozen=True)
class BlockPlan:
    """The blocks of a scene.

    Attributes:
        scene: absolute path of its folder.
        config: of the whole, as in ``config.yaml``.
        plane: in which it was cut.
        overlap: width of the margins, scene units.
    """

    scene: str
    config: Mapping[str, Any]
    options: BlockOptions
    plane: ScenePlane
    overlap: NotNegative
    cells: Annotated[tuple[PlannedBlock, ...], msgspec.Meta(min_length=1)]

    def write(self, path: Path) -> None:
        """Write the plan. WriteError if the file cannot be written."""
        content = {
            "format": FORMAT,
            **vars(self),
            "options": self.options._asdict(),
            "plane": self.plane._asdict(),
            "cells": [
                {"region": each.region.to_json(), "views": each.views} for each in self.cells
            ],
        }
        write_text(path, json.dumps(content, allow_nan=False) + "\n")

    def require_same(
        self, path: Path, scene: Scene, config: TrainConfig, options: BlockOptions
    ) -> None:
        """Check that the plan is the one that would be made now. RunError if it is of another
        scene, configuration or number of blocks."""
        now = {"scene": scene.path, **options._asdict(), **flat(config_values(config))}
        found = {"scene": self.scene, **self.options._asdict(), **flat(self.config)}
        last = max((view for each in self.cells for view in each.views), default=-1)
        if last >= len(scene.train):
            now["views"], found["views"] = len(scene.train), last + 1
        for name, value in now.items():
            if found.get(name) != value:
                raise RunError(
                    f"{path.parent} holds blocks made with other options "
                    f"({name.replace('_', ' ')} {found.get(name)}, not {value}): use the same "
                    f"options again, or choose another folder",
                    options=("output",),
                )


def make_plan(
    coarse: Model,
    scene: Scene,
    config: Mapping[str, Any],
    options: BlockOptions,
    say: Callable[[str], None],
) -> BlockPlan:
    """Cut a scene into blocks. ConfigError if the scene cannot be cut like this."""
    plane = plane_of(scene)
    rows, columns = parse_grid(options.blocks) or shape_for(
        math.ceil(len(scene.train) / VIEWS_PER_BLOCK), plane.sides
    )
    places = counted_places(Surveyor(coarse, scene, plane), scene)
    points = plane.coordinates(scene.points.positions.double())
    wanted = rows * columns
    regions = without_empty(
        cells(points, rows, columns), lambda region: not views_of(region, places)
    )
    if not any(views_of(region, places) for region in regions):
        raise ConfigError(
            f"the photos of {scene.name} show no surface of the coarse model: train it for longer, "
            f"or check the poses"
        )
    if len(regions) < wanted:
        say(
            f"{wanted - len(regions)} of {wanted} blocks have no photo and are merged with their "
            f"neighbours"
        )
    narrowest = min(min(plane.clipped(region)) for region in regions)
    overlap = OVERLAP * narrowest if options.overlap is None else options.overlap
    unit = scene.world.length_unit
    if not 0 <= overlap <= narrowest:
        raise ConfigError(
            f"an overlap of {overlap:g} {unit} does not fit blocks that are {narrowest:.3g} {unit} "
            f"wide: choose a smaller one, or fewer blocks",
            options=("overlap", "blocks"),
        )
    found = tuple(PlannedBlock(each, views_of(each.grown(overlap), places)) for each in regions)
    photos = sorted(len(cell.views) for cell in found)
    if len(found) == 1:
        say(f"1 block of {counted(photos[0], 'photo')}")
    else:
        say(
            f"{len(found)} blocks of {photos[0]} to {photos[-1]} photos, at least {narrowest:.3g} "
            f"{unit} wide, with a margin of {overlap:.3g} {unit}"
        )
    return BlockPlan(scene.path, config, options, plane, overlap, found)


def read_plan(path: Path) -> BlockPlan | None:
    """The plan in a file; None if there is none. RunError if it is not a plan of this version."""
    if not path.exists():
        return None
    try:
        content = json.loads(read_text(path))
        if content["format"] != FORMAT:
            raise RunError(
                f"{path} was written by another version of the program: choose another folder",
                options=("output",),
            )
        return _from_json(content)
    except (KeyError, TypeError, ValueError, OverflowError, OSError, RecursionError) as error:
        raise RunError(
            f"{path} is not a plan of blocks: restore it, or choose another folder",
            options=("output",),
        ) from error


def config_values(config: TrainConfig) -> Mapping[str, Any]:
    """A configuration as JSON gives it back."""
    values: Mapping[str, Any] = json.loads(json.dumps(asdict(config)))
    return values


def _from_json(content: Any) -> BlockPlan:
    plane, cells = content["plane"], content["cells"]
    found = {
        **content,
        "options": BlockOptions(**content["options"]),
        "plane": [plane[name] for name in ScenePlane._fields],
        "cells": [(Rectangle.from_json(each["region"]), each["views"]) for each in cells],
    }
    return from_json(BlockPlan, found)
