"""Control points, check points and scale bars: places that are marked in photos, and the scale and
axes that they give a reconstruction."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeAlias

import msgspec
import numpy as np
import torch
from jaxtyping import Float32, Float64

from mrgs.data.earth import enu, on_earth
from mrgs.data.files import composed, table_rows
from mrgs.data.radiometric import GpsPosition
from mrgs.errors import ConfigError, SceneError, scene_error
from mrgs.prepare.contract import ControlResidual, Georeference, Reconstruction, rms_m
from mrgs.prepare.georeference import KNOWN, centres, georeference, up_of_cameras
from mrgs.prepare.rig.chessboard import saddle_near
from mrgs.scene.similarity import Points, Similarity, fit_similarity
from mrgs.system.wording import counted, shown

Photos: TypeAlias = Mapping[str, tuple[str, tuple[int, int]]]
Place: TypeAlias = tuple[float, float, float]
Marks: TypeAlias = dict[str, tuple[float, float]]
Fixed: TypeAlias = Sequence[tuple[Place, Marks]]
Adjust: TypeAlias = Callable[[Similarity, Fixed], Reconstruction]
MIN_POINTS = 3
FLAT, CONTRADICTION = 0.03, 0.05
"""Points lie on a line if their spread across it is at most this share of that along it, and
contradict each other if their RMS residual is a larger share of their spread."""

DOUBTFUL = 2.5
"""A control point that is off by so many times the others' RMS is worth a warning."""

_REACH, _LEAST_REACH_PX = 0.002, 4.0
"""How far from a mark a chequer target is looked for: a share of the image's width, or so far."""

LARGEST_ERROR, LEAST_ANGLE_DEG = 0.01, 2.0
"""Marks of one place meet better, as a share of the image's width, and its rays differ by more."""

FARTHEST_GPS_M = 5000.0
OFFSET_FROM_M, OFFSET_STEP_M = 1000.0, 100.0
"""Local coordinates that are larger get an origin near the points, as float32 has seven digits."""

_EXAMPLE = "write name,east,north,height,view,x,y into the first line, and metres and pixels below"
_GCP_LIST = ("east", "north", "height", "x", "y", "view", "name")
_NARROWEST_M, _ITERATIONS = 0.02, 5
_Number: TypeAlias = Annotated[float, msgspec.Meta(ge=-1e8, le=1e8)] | None


class _Row(msgspec.Struct):
    name: str = ""
    east: _Number = None
    north: _Number = None
    height: _Number = None
    view: str = ""
    x: _Number = None
    y: _Number = None
    role: Literal["control", "check"] = "control"
    crs: str = ""
    to: str = ""
    target: Literal["chequer"] | None = None
    length: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None


@dataclass
class ControlPoint:
    """Pixels of a place by view, x and y from the image's upper left corner; its surveyed metres
    east, north and up, None for ends of scale bars; whether it is only compared; and whether it is
    where the quarters of a chequer target meet."""

    marks: Marks = field(default_factory=dict)
    place: Place | None = None
    check: bool = False
    chequer: bool = False


@dataclass
class ControlPoints:
    """Points by name; scale bars, two names and metres; and the CRS, empty for a local frame."""

    points: dict[str, ControlPoint] = field(default_factory=dict)
    bars: list[tuple[str, str, float]] = field(default_factory=list)
    crs: str = ""


def read_control(file: Path, photos: Photos) -> ControlPoints:
    """The points in a table, a line an observation (name, east, north, height, view, x, y; perhaps
    role, crs and target) or a scale bar (name, to, length); or in OpenDroneMap's ``gcp_list.txt``.
    ``photos`` are view, width and height by a photo's names in lower case. SceneError, with the
    line, if one cannot be read or contradicts another, or names no photo or a pixel outside of it;
    if coordinates are degrees, or a point lacks what it needs."""
    control, columns = ControlPoints(), tuple[str, ...]()
    for number, cells in table_rows(file, _EXAMPLE):
        if not columns and re.match(r"EPSG:|\+proj|WGS", cells[0], re.IGNORECASE):
            utm = r"(?i)^WGS ?84 UTM (\d+)([NS])$"
            control.crs = re.sub(utm, r"WGS 84 / UTM zone \1\2", " ".join(cells))
            columns = _GCP_LIST
        elif cells[0].startswith("#"):
            continue
        elif not columns:
            columns = tuple(cell.lower() for cell in cells)
            if "name" not in columns:
                raise scene_error(file, f"the first line names no columns; {_EXAMPLE}")
        else:
            try:
                _add(dict(zip(columns, cells, strict=False)), control, photos)
            except ValueError as problem:
                raise scene_error(file, f"line {number}: {problem}") from None
    if not control.points:
        raise scene_error(file, f"it has no points; {_EXAMPLE}")
    ends = {name for *both, _ in control.bars for name in both}
    for name in sorted(ends | control.points.keys()):
        if name not in control.points:
            raise scene_error(file, f"{name} needs a line with pixels; add it")
        if control.points[name].place is None and name not in ends:
            raise scene_error(file, f"{name} needs coordinates or a scale bar; add them")
    plan = np.array([point.place[:2] for point in control.points.values() if point.place])
    narrow = len(plan) > 1 and np.ptp(plan, axis=0).max() < _NARROWEST_M
    if narrow and (abs(plan) <= (180, 90)).all():
        raise scene_error(file, "the coordinates look like degrees; give metres, such as UTM")
    return control


def _add(cells: dict[str, str], control: ControlPoints, photos: Photos) -> None:
    """Add a line. ValueError if it is neither an observation nor a scale bar."""
    texts = {key: re.sub(r"^(-?\d+),(\d+)$", r"\1.\2", cell) for key, cell in cells.items() if cell}
    try:
        row = msgspec.convert(texts, _Row, strict=False)
    except msgspec.ValidationError as error:
        column = str(error).rpartition("$.")[2].strip("`")
        known = "write chequer, or nothing" if column == "target" else _EXAMPLE
        raise ValueError(f"{column} is {shown(texts[column])}; {known}") from None
    if control.crs not in ("", row.crs or control.crs):
        raise ValueError(f"the CRS is {row.crs}, and {control.crs} above; give all points in one")
    control.crs = row.crs or control.crs
    if row.to or row.length is not None:
        if row.name in ("", row.to) or not row.to or row.length is None:
            raise ValueError("a scale bar needs name, to and length: two points and metres")
        control.bars.append((row.name, row.to, row.length))
        return
    place = [each for each in (row.east, row.north, row.height) if each is not None]
    point = control.points.setdefault(name := row.name or f"{place}", ControlPoint())
    point.check |= row.role == "check"
    point.chequer |= row.target == "chequer"
    if place:
        if len(place) < 3 or point.place not in (None, (*place,)):
            raise ValueError(f"{name} lacks a coordinate, or has others above; correct one of them")
        point.place = (place[0], place[1], place[2])
    if not row.view:
        return
    if (photo := photos.get(composed(row.view.replace("\\", "/")).lower())) is None:
        problem = f"none of the photos in use, or more than one, has the name {shown(row.view)}"
        raise ValueError(f"{problem}; correct it, give its path, or delete the line")
    view, (width, height) = photo
    if row.x is None or row.y is None or not (0 <= row.x <= width and 0 <= row.y <= height):
        raise ValueError(f"the mark is not in {row.view}, {width}×{height} px; correct x and y")
    if view in point.marks:
        raise ValueError(f"{name} is marked in {row.view} twice; delete one of the lines")
    point.marks[view] = row.x, row.y


def at_chequers(
    control: ControlPoints, grey: Callable[[str], Float32[np.ndarray, "h w"]]
) -> tuple[ControlPoints, tuple[str, ...]]:
    """The points with the marks of chequer targets moved to where their quarters meet, in a view's
    image ``grey``, and a warning for each target that is not found in all of its photos."""
    points = {name: replace(each, marks={**each.marks}) for name, each in control.points.items()}
    targets = {name: point for name, point in points.items() if point.chequer}
    lost = dict[str, list[str]]()
    for view in dict.fromkeys(view for point in targets.values() for view in point.marks):
        image = grey(view)
        reach_px = max(_REACH * image.shape[1], _LEAST_REACH_PX)
        for name, point in targets.items():
            if view not in point.marks:
                continue
            if (found := saddle_near(image, np.array(point.marks[view]), reach_px)) is None:
                lost.setdefault(name, []).append(view)
            else:
                point.marks[view] = float(found[0]), float(found[1])
    text = "{} is not a chequer target in {}: its mark there counts as it is."
    warnings = (text.format(name, ", ".join(views)) for name, views in lost.items())
    return replace(control, points=points), tuple(warnings)


class _Seen(NamedTuple):
    """A point, where the rays of its marks meet, and their distance from there, px (RMS)."""

    point: ControlPoint
    place: Float64[np.ndarray, "3"]
    error_px: float


def place_by_control(
    found: Reconstruction,
    control: ControlPoints,
    gps: Mapping[str, GpsPosition],
    adjust: Adjust | None = None,
    as_given: bool = False,
) -> tuple[Reconstruction, Georeference]:
    """The reconstruction, which ``adjust`` gives in the frame of the control points and adjusted to
    them, and the similarity to that frame. Two points, and scale bars without points, give the
    scale; GPS or the cameras then give the axes. SceneError if there are fewer, they lie on a line
    or contradict each other, their marks do not meet, or the scene would be upside down."""
    local, offset, origin = _in_metres(control)
    seen, warnings = _seen(local, found)
    bars = [bar for bar in control.bars if {*bar[:2]} <= seen.keys()]
    points = {name: each.point for name, each in seen.items()}
    fitted = {n: (p.place, p.marks) for n, p in points.items() if p.place and not p.check}
    target = np.array([place for place, _ in fitted.values()])
    if len(fitted) < MIN_POINTS:
        if len(fitted) == 2 and not bars:
            first, second = fitted
            bars = [(first, second, float(np.linalg.norm(target[1] - target[0])))]
            warnings += ("2 control points give no axes: mark a third, beside their line.",)
        if not bars:
            usable = f"{counted(len(fitted), 'control point')} can be used; mark {MIN_POINTS}"
            raise _error(" ".join((f"{usable}, each in two photos.", *warnings)))
        scale, off, text = _scale_of(bars, seen)
        placed = georeference(found, gps, scale, as_given=as_given)
        text, warnings = placed.text.replace(KNOWN, text) + _rms(off), warnings + placed.warnings
        return found, replace(placed, text=text, warnings=warnings, control=off)
    similarity = _fit([*fitted], np.array([seen[name].place for name in fitted]), target, found)
    if adjust is not None:
        found = adjust(similarity, [*fitted.values()])
        seen, similarity = _seen(local, found)[0], Similarity(1.0, np.eye(3), np.zeros(3))
    off = _residuals(bars, seen, similarity)
    *rest, worst = sorted(off, key=lambda each: (each.role == "control", each.off_m))
    others_m = rms_m(rest, "control") or 0.0
    if len(fitted) > MIN_POINTS + 1 and worst.off_m > DOUBTFUL * others_m:
        far = f"{100 * worst.off_m:.2g} cm off, the other control points {100 * others_m:.2g} cm"
        warnings += (f"{worst.name} is {far}: check its coordinates and marks.",)
    if origin is not None and gps:
        apart_m = np.median(np.linalg.norm(enu([*gps.values()], origin), axis=1))
        if apart_m > FARTHEST_GPS_M:
            warnings += (f"GPS puts the photos {apart_m / 1000:.0f} km away: check the CRS.",)
    sigma_m = (rms_m(off, "control") or 0.0) / math.sqrt(3 - 7 / len(fitted))
    return found, Georeference(
        similarity.scale,
        torch.from_numpy(similarity.rotation),
        torch.from_numpy(similarity.translation),
        metric=True,
        north=True,
        origin=origin,
        residual_m=None,
        text=f"{len(fitted)} control points give metres and the axes east, north, up"
        f"{'; GPS is not used' if gps else ''}.{_rms(off)}",
        warnings=warnings,
        scale_error=sigma_m / float(np.linalg.norm(target - target.mean(axis=0))),
        offset=offset,
        control=off,
    )


def _scale_of(
    bars: Sequence[tuple[str, str, float]], seen: Mapping[str, _Seen]
) -> tuple[float, tuple[ControlResidual, ...], str]:
    """The scale that fits stated lengths best, by how much they are off, and a sentence. SceneError
    if the ends of one are in one place."""
    lengths = [float(np.linalg.norm(seen[a].place - seen[b].place)) for a, b, _ in bars]
    for (a, b, metres), length in zip(bars, lengths, strict=True):
        if not metres * length > 0:
            raise _error(f"{a} and {b} are in one place; correct their coordinates or marks")
    scale = float(np.dot([bar[2] for bar in bars], lengths) / np.dot(lengths, lengths))
    if len(bars) == 1:  # one length fits itself
        return scale, (), "The scale is that of the stated length."
    off = _residuals(bars, seen, Similarity(scale, np.eye(3), np.zeros(3)))[-len(bars) :]
    return scale, off, f"The scale is that of {len(bars)} stated lengths."


def _error(text: str) -> SceneError:
    return SceneError(text, options=("control",))


def _in_metres(
    control: ControlPoints,
) -> tuple[dict[str, ControlPoint], Place | None, GpsPosition | None]:
    """The points in metres east, north and up of the scene's origin; its coordinates in a local
    frame, None for 0, 0, 0; and on Earth, if the CRS is known."""
    names = [name for name, point in control.points.items() if point.place]
    places = np.array([control.points[name].place for name in names]).reshape(-1, 3)
    offset, origin = np.zeros(3), None
    if control.crs and names:
        try:
            positions = on_earth(places, control.crs)
        except ConfigError as error:
            raise _error(f"control points: {error.message}") from None
        origin = GpsPosition(*np.mean([astuple(each) for each in positions], axis=0).tolist())
        places = enu(positions, origin)
    elif np.abs(places).max(initial=0) > OFFSET_FROM_M:
        offset = np.floor(places.mean(axis=0) / OFFSET_STEP_M) * OFFSET_STEP_M
    moved = dict(zip(names, map(tuple, (places - offset).tolist()), strict=True))
    points = {name: replace(each, place=moved.get(name)) for name, each in control.points.items()}
    return points, tuple(offset.tolist()) if offset.any() else None, origin


def _seen(
    points: Mapping[str, ControlPoint], found: Reconstruction
) -> tuple[dict[str, _Seen], tuple[str, ...]]:
    """The points that photos with a pose show from two places, with these marks alone, and a
    warning for each other one. SceneError if marks do not meet."""
    seen: dict[str, _Seen] = {}
    warnings: list[str] = []
    for name, point in points.items():
        marks = {view: mark for view, mark in point.marks.items() if view in found.viewmats}
        if lost := sorted(point.marks.keys() - marks.keys()):
            warnings.append(f"{name} is marked in {', '.join(lost)}, without a pose.")
        place, errors_px, angle_deg = _meeting(marks, found) if marks else (None, None, 0.0)
        if place is None or errors_px is None or angle_deg < LEAST_ANGLE_DEG:
            warnings.append(f"{name} is not used: mark it in two photos, from different places.")
        elif errors_px.max() > LARGEST_ERROR * found.lenses[next(iter(marks))].width:
            off = f"{errors_px.max():.0f} px off" if np.isfinite(errors_px).all() else "behind it"
            worst = f"that in {[*marks][int(errors_px.argmax())]} is {off}"
            raise _error(f"the marks of {name} do not meet: {worst}; correct it")
        else:
            rms_px = float(np.sqrt(np.mean(errors_px**2)))
            seen[name] = _Seen(replace(point, marks=marks), place, rms_px)
    return seen, tuple(warnings)


def _meeting(
    marks: Marks, found: Reconstruction
) -> tuple[Float64[np.ndarray, "3"], Float64[np.ndarray, " n"], float]:
    """The place nearest to the marks' rays, by least squares in pixels; its distance from each, px,
    infinite behind the camera; and the largest angle between two rays, degrees."""
    lenses = [found.lenses[view] for view in marks]
    pixels = zip(lenses, np.array([*marks.values()])[..., None], strict=True)
    rays = np.array([(*np.ravel(lens.rays(*pixel)), 1.0) for lens, pixel in pixels])
    turns = np.stack([found.viewmats[view].numpy()[:3, :3] for view in marks])
    rays = np.einsum("nij,ni->nj", turns, rays / np.linalg.norm(rays, axis=1, keepdims=True))
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    eyes, weights = centres(found, marks), np.ones(len(rays))
    for _ in range(_ITERATIONS):
        right = np.einsum("n,nij,nj->i", weights, across, eyes)
        place = np.linalg.lstsq(np.einsum("n,nij->ij", weights, across), right, rcond=None)[0]
        distances = np.maximum(np.linalg.norm(place - eyes, axis=1), 1e-9)
        weights = (np.array([lens.fx for lens in lenses]) / distances) ** 2
    ahead = np.einsum("ni,ni->n", rays, place - eyes)
    off = np.linalg.norm(place - eyes - ahead[:, None] * rays, axis=1)
    errors_px = np.where(ahead > 0, np.sqrt(weights) * off, np.inf)
    return place, errors_px, math.degrees(math.acos(np.clip((rays @ rays.T).min(), -1, 1)))


def _fit(names: Sequence[str], source: Points, target: Points, found: Reconstruction) -> Similarity:
    """The similarity of the points. SceneError if they do not determine it, or contradict each
    other or how the cameras were held."""

    def rms(chosen: Sequence[int], target: Points = target) -> float:
        fit = fit_similarity(source[chosen], target[chosen])
        return math.sqrt(((fit(source[chosen]) - target[chosen]) ** 2).sum() / len(chosen))

    spread = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    if spread[1] <= FLAT * spread[0]:
        raise _error("the control points lie on a line, about which the scene could turn; add one")
    every = range(len(names))
    if rms(every) > CONTRADICTION * np.linalg.norm(spread) / math.sqrt(len(names)):
        rests = [[other for other in every if other != one] for one in every]
        one = int(np.argmin([rms(rest) for rest in rests]))
        off = fit_similarity(source[rests[one]], target[rests[one]])(source) - target
        worst = f"{names[one]} is {np.linalg.norm(off[one]):.2g} m off the others"
        if len(names) == MIN_POINTS:
            worst = f"{', '.join(names)} fit to {rms(every):.2g} m"
        swapped = rms(every, target[:, [1, 0, 2]]) < rms(every) / 3
        remedy = "swap east and north" if swapped else "correct its coordinates or marks"
        raise _error(f"the control points contradict each other: {worst}; {remedy}")
    similarity = fit_similarity(source, target)
    if similarity.rotation[2] @ up_of_cameras(found) < 0:
        swap = "swap east and north, or count heights upwards"
        raise _error(f"the control points turn the scene upside down; {swap}")
    return similarity


def _residuals(
    bars: Sequence[tuple[str, str, float]], seen: Mapping[str, _Seen], similarity: Similarity
) -> tuple[ControlResidual, ...]:
    """Found minus stated: of control points, of check points, then of lengths."""
    found = []
    for name, (point, place, error_px) in seen.items():
        if point.place:
            shift = similarity(place[None])[0] - point.place
            role, off_m = "check" if point.check else "control", float(np.linalg.norm(shift))
            known = error_px, len(point.marks), tuple(shift.tolist())
            found.append(ControlResidual(name, role, off_m, *known))
    found.sort(key=lambda each: each.role == "check")
    for a, b, metres in bars:
        ends = seen[a], seen[b]
        off_m = similarity.scale * float(np.linalg.norm(ends[1].place - ends[0].place)) - metres
        error_px, photos = max(each[2] for each in ends), min(len(each[0].marks) for each in ends)
        found.append(ControlResidual(f"{a} – {b}", "length", off_m, error_px, photos))
    return tuple(found)


def _rms(residuals: Sequence[ControlResidual]) -> str:
    nouns = {"control": "control points", "check": "check points", "length": "stated lengths"}
    off = {noun: rms_m(residuals, role) for role, noun in nouns.items()}
    return "".join(f" RMS of {noun}: {100 * m:.2g} cm." for noun, m in off.items() if m is not None)
