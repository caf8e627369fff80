"""The sections of the report, each as HTML; all text that comes from files is escaped."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from PIL import Image

from mrgs.errors import RunError
from mrgs.evaluation.report import COLUMNS
from mrgs.pictures.drawing import Scale, scale_bar
from mrgs.pictures.palette import PaletteName
from mrgs.report.pictures import Span, crops, overview, photo_value
from mrgs.report.spots import Spot, find_spots
from mrgs.runs.open import Run
from mrgs.scene import Camera, Scene, TemperatureRange, View

PALETTE: PaletteName = "inferno"
JPEG_QUALITY = 88
SHEET_WIDTH_PX = 1600
SCALE_BAR_PX = 420

HOW_SPOTS_ARE_FOUND = (
    "A spot is 3×3 pixels of the thermal rendering, as on a camera's spot meter, on a surface "
    "that at least three "
    "views see. Its value is the median over these views; the range is what four fifths of them "
    "say. Places that few "
    "views see, edges, and single points that float in space do not count. Two spots of one list "
    "keep their distance."
)


def spots(run: Run, scene: Scene) -> str:
    """The hottest and the coldest spots: an overview, a table, and a crop of each."""
    views = [*scene.train, *scene.eval]
    title = _heading("Hottest and coldest spots")
    if not scene.has_thermal:
        return title + "<p>The capture has no thermal photos, so there are no temperatures.</p>"

    def render(camera: Camera) -> Any:
        return run.render(None, camera)

    hottest, coldest = find_spots(views, render, ball=scene.reach)
    if not hottest:
        return (
            title
            + "<p>No surface is seen by enough views. More steps, or more photos, may help.</p>"
        )
    named = {f"H{i}": spot for i, spot in enumerate(hottest, 1)} | {
        f"C{i}": spot for i, spot in enumerate(coldest, 1)
    }
    span = (
        Span(0.0, 1.0)
        if scene.temperature is None
        else Span(scene.temperature.min_c, scene.temperature.max_c)
    )
    scale = Scale(PALETTE, *span, "°C" if scene.temperature else "")
    marked = overview(views, named, render, scale, span)
    pictures = [
        _image(picture, "the spots marked") for picture in (marked.photo, marked.thermal) if picture
    ]
    caption = (
        f"View {escape(views[marked.view].name)}: photo and thermal rendering, with the "
        f"spots that it sees."
    )
    pictures.append(
        _image(scale_bar(scale, SCALE_BAR_PX, "horizontal"), "temperature scale", "PNG")
    )
    figures = [
        _spot_figure(name, spot, views[spot.view], run, scale, span) for name, spot in named.items()
    ]
    return (
        title
        + f'<figure><div class="pair">{"".join(pictures)}</div>'
        + f"<figcaption>{caption}</figcaption></figure>"
        + _spot_table(named, views, scene.temperature)
        + f'<p class="note">{escape(HOW_SPOTS_ARE_FOUND)} Positions are x, y, z in the scene\'s '
        f"own units and axes; "
        f"they are metres only if the capture was scaled to metres.</p><div "
        f'class="spots">{"".join(figures)}</div>'
    )


def limits(temperature: TemperatureRange | None, scaled_anew: bool, depends_on_view: bool) -> str:
    """What the numbers do not say.

    Args:
        temperature: the scale of the thermal values; None without known °C.
        scaled_anew: whether each thermal photo has a learned scale of its own.
        depends_on_view: whether the model's temperatures change with the viewpoint.
    """
    lines = [
        "Emissivity: the temperatures are apparent, as the thermal camera computed them with the "
        "emissivity that was "
        "set in it. The scene's files do not say which; look it up in the camera or its original "
        "photos. A surface "
        "whose emissivity differs from it is warmer or colder than shown.",
        "Reflections: bare metal, glass, water, glazed tiles and polished stone mirror what they "
        "face, also the sky "
        "and the person with the camera. A spot whose range over the views is wide may be a "
        "reflection.",
        "Air: humidity, distance and wind are not corrected beyond what the camera did.",
        "Where no photo looked, the model guesses. Walk around such places in the viewer before "
        "you judge them.",
        "Places at the cold end of the range may be missing from the model, because they are as "
        "cold as its empty "
        "background: the true coldest spot can lie there.",
        "Edges and parts finer than a thermal pixel blend with what is beside them: their true "
        "extremes are stronger.",
        "Moment: the photos are treated as if taken at one instant. What warmed or cooled between "
        "them is averaged.",
    ]
    if temperature is None:
        lines.insert(
            0, "There are no °C: the photos hold relative values, from 0 (coldest) to 1 (warmest)."
        )
        if scaled_anew:
            lines.insert(
                1,
                "Each thermal photo was scaled by itself. The values here are on the photos' mean "
                "scale.",
            )
    else:
        lines.insert(
            2,
            f"Range: the photos record {_celsius(temperature.min_c)} to "
            f"{_celsius(temperature.max_c)}. What was colder "
            "or warmer shows the end of this range.",
        )
    if depends_on_view:
        lines.append(
            "Viewpoint: the model's values change a little with the side that a place is seen from."
        )
    return _heading("Limits of the measurement") + _list(lines)


def capture(scene: Scene) -> str:
    """Views, image sizes, temperature range, and what the reader of the files decided."""
    views = [*scene.train, *scene.eval]
    rows = [
        ("Views", f"{len(scene.train)} to learn from, {len(scene.eval)} held out to check"),
        ("Colour photos", _sizes([view.rgb.camera for view in views if view.rgb])),
        ("Thermal photos", _sizes([view.thermal.camera for view in views if view.thermal])),
        (
            "Cameras",
            "one for both images"
            if all(view.shares_camera for view in views)
            else "each image has its own",
        ),
        ("Temperature range", _range(scene.temperature)),
        ("Emissivity, reflected temperature, humidity, distance", "not in the scene's files"),
    ]
    notes = _list(scene.notes) if scene.notes else ""
    return _heading("Capture") + _pairs(rows) + notes


def metrics(run: Run) -> str:
    """The scores of ``eval/metrics.json``, or how to get them."""
    title = _heading("How well the model agrees with photos it never saw")
    document = _read_metrics(run)
    command = f"<code>mrgs eval {escape(str(run.folder.path))}</code>"
    if document is None:
        return title + f"<p>Not scored yet: {command} does it.</p>"
    rows = [
        (f"{label} {COLUMNS[name][0]}", f"{value:.{COLUMNS[name][1]}f}")
        for group, label in (("thermal", "Thermal"), ("rgb", "Colour"))
        for name, value in document["mean"][group].items()
        if value is not None
    ]
    stale = (
        f"<p>Scored at step {document['steps']:,}, but the model is now at step "
        f"{run.facts.step:,}: {command} scores "
        "it anew.</p>"
        if document["steps"] != run.facts.step
        else ""
    )
    note = (
        "Means over the held-out views. MAE is the mean difference from the thermal photo; "
        "foreground is what is "
        "warmer than its surroundings. A higher PSNR (dB) and an SSIM closer to 1 are better. "
        "They compare with the "
        "photos, and so say nothing of errors that the camera made itself."
    )
    return title + stale + _pairs(rows) + f'<p class="note">{note}</p>'


def contact_sheet(run: Run) -> str:
    """The contact sheet of ``eval/``, or how to get it."""
    path = run.folder.path / "eval" / "contact_sheet.png"
    title = _heading("Held-out views")
    if not path.is_file():
        return (
            title
            + f"<p>No contact sheet yet: <code>mrgs eval {escape(str(run.folder.path))}</code> "
            f"makes it.</p>"
        )
    try:
        with Image.open(path) as sheet:
            image = sheet.convert("RGB")
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise RunError(f"{path} cannot be read ({error}); make it anew with `mrgs eval`") from error
    image.thumbnail((SHEET_WIDTH_PX, SHEET_WIDTH_PX * 4))
    caption = (
        "Photo, rendering, thermal photo, thermal rendering, difference and depth of "
        "held-out views."
    )
    return (
        title
        + f'<figure class="wide">{_image(image, "contact sheet")}'
        + f"<figcaption>{caption}</figcaption></figure>"
    )


def training(run: Run) -> str:
    """What was trained, and what it cost."""
    facts = run.facts
    rows = [
        ("Method", run.config.method),
        ("Preset", run.config.preset),
        ("Steps", f"{facts.step:,} of {run.config.max_steps:,}"),
        ("Gaussians", f"{len(run.model.gaussians):,}"),
        ("Time", f"{facts.train_seconds / 60:.1f} minutes"),
        (
            "Memory",
            f"{facts.peak_memory_bytes / 2**20:,.0f} MiB"
            if facts.peak_memory_bytes
            else "not measured",
        ),
    ]
    return _heading("Training") + _pairs(rows)


def _spot_table(
    named: dict[str, Spot], views: Sequence[View], temperature: TemperatureRange | None
) -> str:
    unit = "°C" if temperature is not None else "relative"
    headings = ["Spot", unit, "range over views", "views", "position x, y, z", "best seen in"]
    lines = ["<tr>" + "".join(f"<th>{escape(heading)}</th>" for heading in headings) + "</tr>"]
    for name, spot in named.items():
        x, y, z = spot.position
        low, high = (_number(value, temperature) for value in (spot.low, spot.high))
        cells = [
            f'<td class="strong">{name}</td><td '
            f'class="strong">{_number(spot.value, temperature)}</td>',
            f"<td>{low} to {high}</td><td>{spot.views}</td><td>{x:.3f}, {y:.3f}, {z:.3f}</td>",
            f"<td>{escape(views[spot.view].name)}</td>",
        ]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    return f'<div class="wide"><table>{"".join(lines)}</table></div>'


def _spot_figure(name: str, spot: Spot, view: View, run: Run, scale: Scale, span: Span) -> str:
    assert view.thermal is not None
    rendering = run.render(None, view.thermal.camera)
    pictures = crops(view, spot, rendering, scale, span)
    images = "".join(
        _image(picture, f"spot {name}") for picture in (pictures.photo, pictures.thermal) if picture
    )
    measured = photo_value(view, spot)
    unit = " °C" if run.temperature is not None else ""
    reads = (
        ""
        if measured is None
        else f" The thermal photo reads {_number(measured, run.temperature)}{unit} there."
    )
    at_end = not 0 < spot.value < 1 and run.image_model.thermal_gain is None
    end = " At the end of the recorded range: the true value may lie beyond." if at_end else ""
    caption = (
        f"<strong>{name}: {_number(spot.value, run.temperature)}{unit}</strong><br>"
        f"{escape(view.name)}.{escape(reads)}{escape(end)}"
    )
    return f'<figure><div class="pair">{images}</div><figcaption>{caption}</figcaption></figure>'


def _read_metrics(run: Run) -> dict[str, Any] | None:
    path = run.folder.path / "eval" / "metrics.json"
    if not path.is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        groups = [document["mean"][group] for group in ("thermal", "rgb")]
        values = [
            value
            for group in groups
            for name, value in group.items()
            if value is not None and COLUMNS[name]
        ]
        if not all(isinstance(value, int | float) for value in [*values, document["steps"]]):
            raise ValueError("a figure is not a number")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise RunError(
            f"{path} is not what `mrgs eval` writes ({error}); run `mrgs eval` again"
        ) from error
    return document


def _sizes(cameras: Sequence[Camera]) -> str:
    if not cameras:
        return "none"
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    return f"{len(cameras)}, " + ", ".join(f"{width} × {height} pixels" for width, height in sizes)


def _range(temperature: TemperatureRange | None) -> str:
    if temperature is None:
        return "no °C known: relative values"
    return f"{_celsius(temperature.min_c)} to {_celsius(temperature.max_c)}"


def _celsius(value: float) -> str:
    return f"{value:.4g} °C"


def _number(value: float, temperature: TemperatureRange | None) -> str:
    """A normalised temperature in °C with one decimal, or as it is with three."""
    if temperature is None:
        return f"{value:.3f}"
    return f"{round(temperature.to_celsius(value), 1) + 0.0:.1f}"  # adding 0 turns -0.0 into 0.0


def _heading(text: str) -> str:
    return f"<h2>{escape(text)}</h2>"


def _pairs(rows: Iterable[tuple[str, str]]) -> str:
    cells = [
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(value)}</td></tr>'
        for name, value in rows
    ]
    return f"<table>{''.join(cells)}</table>"


def _list(lines: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _image(image: Image.Image, text: str, kind: str = "JPEG") -> str:
    """The picture inside the page."""
    buffer = io.BytesIO()
    image.save(buffer, kind, **({"quality": JPEG_QUALITY} if kind == "JPEG" else {}))
    content = base64.b64encode(buffer.getvalue()).decode("ascii")
    size = f'width="{image.width}" height="{image.height}"'
    return f'<img {size} alt="{escape(text)}" src="data:image/{kind.lower()};base64,{content}">'
