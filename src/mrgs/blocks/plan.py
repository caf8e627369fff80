"""How a scene is cut into blocks; written once, and read by all processes that train them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec

from mrgs.blocks.coverage import Surveyor, counted_places, views_of
from mrgs.blocks.region import (
    Region,
    ScenePlane,
    cells,
    parse_grid,
    plane_of,
    shape_for,
    without_empty,
)
from mrgs.errors import ConfigError, RunError
from mrgs.method.config import TrainConfig
from mrgs.render import Model
from mrgs.scene import Scene
from mrgs.system.atomic import write_text
from mrgs.system.disk import read_text
from mrgs.system.strict_yaml import flat
from mrgs.system.typed_json import Count, NotNegative, from_json
from mrgs.system.wording import counted

FORMAT = 1

VIEWS_PER_BLOCK = 150
"""Photos per block, if the number of blocks is automatic."""

OVERLAP = 0.15
"""Default width of the margins, as a share of the narrowest block."""


class BlockOptions(NamedTuple):
    """How a scene is to be cut: ``auto`` or ``ROWSxCOLUMNS``, and the width of the margin about
    each block that is trained with it, scene units; None for a share of the smallest block."""

    blocks: str = "auto"
    overlap: float | None = None


class PlannedBlock(NamedTuple):
    """The region that a block contributes to the joined model, and the training views of the scene
    that show it or its margin."""

    region: Region
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
    """The plan in a file; None if there is none. RunError if it is no plan of this version."""
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
        "cells": [(Region.from_json(each["region"]), each["views"]) for each in cells],
    }
    return from_json(BlockPlan, found)
