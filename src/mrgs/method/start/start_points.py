"""The points that training starts from: the scene's, distant ones, and what the photos show of
both. Only the scene's points and their colours are as in 3DGS: from one temperature for all, a
third of a short schedule goes into what every photo shows, and surfaces as warm as the background
never become opaque to the thermal blend."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from scipy.spatial import cKDTree
from torch import Tensor

from mrgs.field import RadianceField, nearest_neighbours
from mrgs.field.spherical_harmonics import C0, MAX_DEGREE
from mrgs.method.config import TrainConfig
from mrgs.method.start.distant_points import distant_points
from mrgs.scene import (
    RGB,
    THERMAL,
    Camera,
    Gaussians,
    Modality,
    PointCloud,
    PosedImage,
    Scene,
    evenly_spaced,
    in_order,
)
from mrgs.scene.capture import model_modalities
from mrgs.scene.point_cloud import coincident_points, spare_points

OPACITY = 0.1
"""3DGS's."""

THERMAL_OPACITY = 0.5
"""o_t of a point whose temperature the photos show. Started with 3DGS's, a surface that is as cold
everywhere as what is behind it would stay half transparent: nothing in a thermal photo asks it to
become opaque."""

DISTANT_OPACITY = 0.9
"""Nothing is behind a distant point; were it not opaque, nearer surfaces would fill the sky."""

NEARER_OPACITY = 0.5
"""Start opacity of the scene's own points if distant points are added. With 3DGS's they hide little
of what is opaque behind them, and surfaces stay full of holes (docs/decisions, 062)."""

DISTANT_SIZE = 2.0
"""Largest standard deviation of a distant point at the start, in spacings: one or two of them
behind a small hole have the scene's points as neighbours, and would start as a blob that reaches up
to the scene."""


class StartPoints(NamedTuple):
    """N points.

    Attributes:
        positions: in world coordinates, [N, 3].
        values: of each modality of C channels, in [0, 1], [N, C]: colours, normalised temperatures;
            NaN where they are not known.
        opacities: of each modality, [N].
        max_scales: no Gaussian starts larger than this, scene units, [N]; infinite where the
            spacing alone decides.
    """

    positions: Float[Tensor, "n 3"]
    values: dict[Modality, Float[Tensor, "n _"]]
    opacities: dict[Modality, Float[Tensor, " n"]]
    max_scales: Float[Tensor, " n"]

    def at_most(self, count: int, generator: torch.Generator) -> StartPoints:
        """These points, or a random subset of them if there are more than ``count``."""
        if len(self.positions) <= count:
            return self
        chosen = torch.randperm(len(self.positions), generator=generator)[:count].sort().values
        return StartPoints(
            self.positions[chosen],
            {modality: values[chosen] for modality, values in self.values.items()},
            {modality: opacities[chosen] for modality, opacities in self.opacities.items()},
            self.max_scales[chosen],
        )

    def followed_by(self, others: StartPoints) -> StartPoints:
        """These points and then others with the same modalities."""
        return StartPoints(
            torch.cat([self.positions, others.positions]),
            {each: torch.cat([v, others.values[each]]) for each, v in self.values.items()},
            {each: torch.cat([o, others.opacities[each]]) for each, o in self.opacities.items()},
            torch.cat([self.max_scales, others.max_scales]),
        )


def start_points(scene: Scene, config: TrainConfig) -> StartPoints:
    """The scene's points first, then those far away, as far as the configuration asks for them and
    for the values that the photos show."""
    modalities = model_modalities(scene.modalities)
    points = _as_published(scene.points, modalities)
    if config.distant_points:
        points = _with_distant(points, scene)
    if not config.photo_temperatures:
        return points
    for modality in modalities:
        if modality != RGB:
            points = _with_photo_values(points, scene, modality)
    return points


def blended_apart(captured: Iterable[Modality], shares_opacity: bool) -> tuple[Modality, ...]:
    """The modalities of a model that have an opacity of their own, by those of its scene: others
    share the first's, and all do where the method blends all with o_c. Opacities without photos
    would never move, and would keep every Gaussian from being pruned."""
    own = in_order(captured)
    return own if len(own) > 1 and not shares_opacity else model_modalities(own)[:1]


def _as_published(cloud: PointCloud, modalities: tuple[Modality, ...]) -> StartPoints:
    """The scene's points as 3DGS starts from them: only their colours are known."""
    like = cloud.positions[:, 0]
    return StartPoints(
        cloud.positions,
        _unknown(modalities, len(like)) | {RGB: cloud.colors},
        {modality: torch.full_like(like, OPACITY) for modality in modalities},
        torch.full_like(like, torch.inf),
    )


def _with_distant(points: StartPoints, scene: Scene) -> StartPoints:
    """Points far away behind the scene's, in the photos' colours; the scene's then hide them."""
    distant = distant_points(points.positions, scene.train_cameras, scene.world.north)
    count = len(distant.positions)
    if count == 0:
        return points
    positions = torch.cat([points.positions, distant.positions])
    colors = photo_values(positions, scene.train_photos(RGB), RGB.channels)[-count:]
    like = distant.positions[:, 0]
    added = StartPoints(
        distant.positions,
        _unknown(tuple(points.values), count) | {RGB: colors},
        {modality: torch.full_like(like, DISTANT_OPACITY) for modality in points.opacities},
        torch.full_like(like, DISTANT_SIZE * distant.spacing),
    )
    hiding = {each: o.clamp_min(NEARER_OPACITY) for each, o in points.opacities.items()}
    return points._replace(opacities=hiding).followed_by(added)


def _with_photo_values(points: StartPoints, scene: Scene, modality: Modality) -> StartPoints:
    """Points get a modality's value in the photos that show them, or that of the nearest points
    which these show, and are more opaque to it."""
    shown = photo_values(points.positions, scene.train_photos(modality), modality.channels)
    values = with_neighbours_values(points.positions, shown)
    unseen, opacities = values.isnan().any(dim=1), points.opacities[modality]
    opaque = opacities.clamp_min(THERMAL_OPACITY)
    return points._replace(
        values=points.values | {modality: values},
        opacities=points.opacities | {modality: torch.where(unseen, opacities, opaque)},
    )


def _unknown(modalities: tuple[Modality, ...], count: int) -> dict[Modality, Tensor]:
    return {each: torch.full((count, each.channels), torch.nan) for each in modalities}


READ_PHOTOS = 64
"""Largest number of photos that are read, evenly spread."""

SAMPLING_PX = 600
"""Least width at which a large photo is read for the values of points."""

CELLS_ACROSS = 48
"""Number of cells across a photo, which are about square. A point is hidden where
another in its cell, or in one of those around it, is much nearer."""

MUCH_NEARER = 1.5
"""Ratio of distances above which a farther point is hidden."""

VALUE_NEIGHBOURS = 8
"""Number of nearest points from which a point that no photo shows takes its values."""

SMALLEST_VALUE_DISTANCE = 1e-9
"""Smallest distance used as a divisor in inverse-distance weights, scene units."""


def photo_values(
    positions: Float[Tensor, "n 3"], photos: Sequence[PosedImage], channels: int
) -> Float[Tensor, "n {channels}"]:
    """The median over one modality's photos of the value of a point that they show, channel by
    channel; points hide each other. A point that is hidden in all of them takes the median over
    those that have it in frame; one in no photo's frame is NaN."""
    if not photos:
        return positions.new_full((len(positions), channels), torch.nan)
    chosen = [photos[index] for index in evenly_spaced(len(photos), READ_PHOTOS)]
    shown = [_shown(positions.double(), photo) for photo in chosen]
    in_frame, unhidden = (
        torch.stack(values).nanmedian(dim=0).values for values in zip(*shown, strict=True)
    )
    return torch.where(unhidden.isnan(), in_frame, unhidden).to(positions)


def with_neighbours_values(
    positions: Float[Tensor, "n 3"], values: Float[Tensor, "n c"]
) -> Float[Tensor, "n c"]:
    """Values in which a point without one, NaN, takes those of its nearest points that have one,
    weighted by the inverse square of their distance; where no point has any, all stay NaN."""
    unknown = values.isnan().any(dim=1)
    if unknown.all():
        return values
    known, places = values[~unknown].double().numpy(), positions[~unknown].double().numpy()
    spare = spare_points(coincident_points(places, VALUE_NEIGHBOURS), VALUE_NEIGHBOURS)
    known, places = np.delete(known, spare, axis=0), np.delete(places, spare, axis=0)
    tree = cKDTree(places)
    nearest = range(1, min(VALUE_NEIGHBOURS, len(known)) + 1)
    distance, index = tree.query(positions[unknown].double().numpy(), k=list(nearest), workers=-1)
    weight = 1 / np.square(distance.clip(SMALLEST_VALUE_DISTANCE))
    mean = (weight[:, :, None] * known[index]).sum(1) / weight.sum(1, keepdims=True)
    return values.masked_scatter(unknown[:, None], torch.from_numpy(mean).to(values))


def _shown(
    positions: Float64[Tensor, "n 3"], photo: PosedImage
) -> tuple[Float[Tensor, "n c"], Float[Tensor, "n c"]]:
    """What a photo has where the points in its frame are, and where the unhidden ones of them are;
    NaN for the others."""
    pixels, in_frame, hidden = framed_points(photo.camera, positions)
    image = photo.look(SAMPLING_PX)
    height, width, _ = image.values.shape
    per_pixel = pixels.new_tensor([width / photo.camera.width, height / photo.camera.height])
    column, row = (pixels * per_pixel).long().T
    if image.valid is not None:
        in_frame = in_frame & image.valid[row, column]
    values = torch.where(in_frame[:, None], image.values[row, column], torch.nan)
    return values, torch.where(hidden[:, None], torch.nan, values)


def framed_points(
    camera: Camera, positions: Float64[Tensor, "n 3"]
) -> tuple[Float64[Tensor, "n 2"], Bool[Tensor, " n"], Bool[Tensor, " n"]]:
    """The points' pixels, 0 for those out of the frame; which are in the frame; and which are
    behind others in their cells."""
    pixels, depth = camera.project(positions)
    in_frame = camera.contains(pixels)
    pixels = torch.where(in_frame[:, None], pixels, 0)
    depth = torch.where(in_frame, depth, torch.inf)  # hides none
    rows = max(1, round(CELLS_ACROSS * camera.height / camera.width))
    cells_per_px = pixels.new_tensor([CELLS_ACROSS / camera.width, rows / camera.height])
    column, row = (pixels * cells_per_px).long().T
    cell = row * CELLS_ACROSS + column
    nearest = depth.new_full((rows * CELLS_ACROSS,), torch.inf).scatter_reduce(
        0, cell, depth, "amin"
    )
    around = -torch.nn.functional.max_pool2d(
        -nearest.view(1, rows, CELLS_ACROSS), 3, stride=1, padding=1
    )
    return pixels, in_frame, depth > MUCH_NEARER * around.flatten()[cell]


INITIAL_SCALE_NEIGHBOURS = 3
UNSEEN = 0.5
"""Colour and temperature of a point that no photo shows."""

SMALLEST_DISTANCE = 1e-7
"""Coincident points still become Gaussians of some size (scene units)."""


def initial_gaussians(
    points: StartPoints, field: RadianceField, apart: Sequence[Modality], temperature_sh_degree: int
) -> Gaussians:
    """One isotropic Gaussian per start point, as large as the RMS distance to its three nearest
    points (3DGS), but no larger than ``max_scales``: a distant point may have the scene's own
    points as neighbours.

    Args:
        field: gives e_m its start; its frame must be set.
        apart: modalities with an opacity of their own; see ``blended_apart``.
        temperature_sh_degree: degree of the temperature's spherical harmonics, 0 to 3.
    """
    count = len(points.positions)
    values = {each: known.nan_to_num(nan=UNSEEN) for each, known in points.values.items()}
    means = points.positions.clone()
    neighbours = nearest_neighbours(means, INITIAL_SCALE_NEIGHBOURS)
    squared = (means[neighbours] - means[:, None]).square().sum(dim=2).mean(dim=1)
    spacing = squared.sqrt().clamp_min(SMALLEST_DISTANCE)
    degrees = dict.fromkeys(points.values, MAX_DEGREE) | {THERMAL: temperature_sh_degree}
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        log_scales=torch.minimum(spacing, points.max_scales).log()[:, None].repeat(1, 3),
        opacity_logits={each: points.opacities[each].logit()[:, None] for each in apart},
        sh_dc={each: ((value - 0.5) / C0)[:, None] for each, value in values.items()},
        sh_rest={
            each: torch.zeros(count, (degrees[each] + 1) ** 2 - 1, each.channels)
            for each in points.values
        },
        embedding=field.initial_embedding(means),
    )
