"""The commands and their options; the docstrings are what ``--help`` prints."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import tyro

from mrgs.export.formats import FORMATS
from mrgs.runs.registry import registered_methods

if TYPE_CHECKING:
    from mrgs.data.radiometric import Overrides
    from mrgs.prepare import PrepareOptions

# tyro keeps the line breaks in docstrings of fields; longer helps are given as arguments.
RESUME_HELP = (
    "Resume the run in --output; all options but --accept-changes, --device, "
    "--eval-steps, --plain, --tensorboard and --view come from the saved run."
)
SYNTH_SCENE_HELP = (
    "Scene: things on a table, a house in winter, a powered circuit board; or one of the kinds "
    "whose layout is drawn from the seed: room, house, circuit, roof, machine. random also draws "
    "the kind. solar-plant is the survey of a solar plant by a drone, without Mitsuba."
)
SynthScene = Literal[
    "tabletop", "facade", "electronics", "room", "house", "circuit", "roof", "machine", "random",
    "solar-plant",
]  # fmt: skip

METHOD_NAMES = [each.name for each in registered_methods()]
METHODS_HELP = "; ".join(f"{each.name}: {each.description}" for each in registered_methods())

FORMATS_HELP = "all, or one of: " + "; ".join(
    f"{each.name}: {each.files}" for each in FORMATS.values()
)

DeviceName = Literal["auto", "cpu", "cuda"]
"""The names in ``mrgs.system.gpu``, which loads torch."""

RenderDevice = Annotated[
    DeviceName, tyro.conf.arg(help="Device to render on; auto uses a usable GPU, else the CPU.")
]

QualityName = Literal["fast", "default", "best"]
"""The names in ``mrgs.pipeline.plan``, which loads torch."""

PaletteChoice = Literal["inferno", "iron", "grey", "black-hot", "rainbow", "arctic", "lava"]
"""The names in ``mrgs.pictures.page_data``, which loads torch; grey is white-hot."""

T = TypeVar("T")

Maybe = Annotated[T | None, tyro.conf.arg(help_behavior_hint="")]
"""An option that may be left out; the help does not list its default, None."""

Several = Annotated[tuple[T, ...], tyro.conf.arg(help_behavior_hint="")]
"""An option with any number of values, by default none."""

PresetName = Annotated[str, tyro.conf.arg(metavar="{fast,default,paper}")]
FormatName = Annotated[
    str, tyro.conf.arg(metavar="{" + ",".join(["all", *FORMATS]) + "}", help=FORMATS_HELP)
]
MethodName = Annotated[
    str, tyro.conf.arg(metavar="{" + ",".join(METHOD_NAMES) + "}", help=METHODS_HELP)
]
RunPath = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN", help="Run folder.")]
MovedScene = Annotated[
    Maybe[Path], tyro.conf.arg(help="Scene folder, if it has moved since training.")
]
CropBox = Annotated[
    Maybe[tuple[float, float, float, float, float, float]],
    tyro.conf.arg(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Crop to this box, not to the survey's."),
]
ScenePath = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]

_OF_PREPARE = ("pairs", "pair_table", "poses", "one_camera", "thermal_camera", "eval_every")
"""Options of the same name in ``PrepareOptions``."""


@dataclass(frozen=True)
class PhotoSettings:
    """What temperatures in thermal photos are computed with."""

    emissivity: Maybe[float] = None
    """Surface emissivity. This and the next six options override the values in the photos."""
    reflected: Maybe[float] = None
    """Reflected apparent temperature, °C."""
    distance: Maybe[float] = None
    """Distance from the camera to the object, m."""
    atmospheric: Maybe[float] = None
    """Air temperature, °C."""
    humidity: Maybe[float] = None
    """Relative humidity of the air, 0 to 1."""
    window: Maybe[float] = None
    """Temperature of an infrared window in front of the camera, °C."""
    window_transmission: Maybe[float] = None
    """Transmission of that window, 0 to 1."""
    unit: Maybe[str] = None
    """Unit of the values in TIFF, PNG and CSV files: celsius, kelvin*100, (celsius+100)*40 ..."""
    bounds: Maybe[tuple[float, float]] = None
    """Temperatures (°C) of black and white, for greyscale thermal photos with a fixed span."""

    def overrides(self) -> Overrides:
        """The settings for readers of photos. ConfigError for an invalid value."""
        from mrgs.data.radiometric import Overrides

        return Overrides(
            distance_m=self.distance,
            reflected_c=self.reflected,
            atmospheric_c=self.atmospheric,
            window_c=self.window,
            bounds_c=self.bounds,
            emissivity=self.emissivity,
            humidity=self.humidity,
            window_transmission=self.window_transmission,
            unit=self.unit,
        )


@dataclass(frozen=True)
class PhotoOptions(PhotoSettings):
    """Facts about the photos that their files do not hold."""

    pairs: Literal["auto", "names", "folders", "time", "thermal"] = "auto"
    """How photos are paired: by file names, two folders or time; thermal: thermal photos only."""
    pair_table: Maybe[Path] = None
    """CSV file with the columns rgb and thermal, if pairs cannot be inferred from file names."""
    tolerance: float = 2.0
    """Maximum time difference within a pair, in seconds."""
    camera: Maybe[str] = None
    """Thermal camera whose photos are used, if there are several: its model, such as M3T."""
    poses: Maybe[Path] = None
    """Folder with poses of these photos from COLMAP or nerfstudio; they are used as they are."""
    thermal_fov: Maybe[float] = None
    """Horizontal field of view of the thermal camera in degrees, from its data sheet."""
    thermal_camera: Maybe[Path] = None
    """JSON file with the thermal camera, or another scene's transforms.json (docs/prepare.md)."""
    one_camera: bool = False
    """The two images of a pair show the same scene, pixel for pixel."""
    target: Maybe[tuple[str, float]] = None
    """Chessboard that both cameras see: inner corners and square size in m, such as 7x6 0.05."""
    known_distance: Maybe[tuple[str, str, float]] = None
    """Two pixels of one view and the distance between their points: NAME:X,Y NAME:X,Y METRES."""
    control: Maybe[Path] = None
    """CSV file with control points, check points and scale bars in the photos (docs/prepare.md)."""
    eval_every: int = 8
    """Hold out every Nth view for evaluation; 0 holds out none."""

    def options(self) -> PrepareOptions:
        """The options of ``prepare``. ConfigError for an invalid value, or two options that exclude
        each other."""
        from mrgs.prepare import PrepareOptions, parse_known_distance, parse_target

        target, known = self.target, self.known_distance
        return PrepareOptions(
            overrides=self.overrides(),
            tolerance_s=self.tolerance,
            camera=self.camera,
            thermal_fov_deg=self.thermal_fov,
            control=self.control,
            target=None if target is None else parse_target(*target),
            known_distance=None if known is None else parse_known_distance(*known),
            **{name: getattr(self, name) for name in _OF_PREPARE},
        )


@dataclass(frozen=True)
class Read:
    """Read the temperatures of one thermal photo.

    Prints what the file says: kind, camera, settings, range, coldest and hottest pixel; writes the
    temperatures with --output.
    """

    photo: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTO")]
    """Thermal photo: radiometric JPEG, TIFF, PNG, FFF, or a table."""
    output: Maybe[Path] = None
    """File to write: .csv, a table of °C, or .tiff, float32."""
    settings: tyro.conf.OmitArgPrefixes[PhotoSettings] = field(default_factory=PhotoSettings)


@dataclass(frozen=True)
class RunAll:
    """From photos to results in one command.

    Prepares the scene, trains, scores and renders the model, and writes a report, a page and
    exports, all into one folder beside the photos. The photos are only read. PHOTOS may also be a
    scene in the layout of ThermoScenes, nerfstudio or COLMAP. Re-run the same command to resume:
    only stages whose photos or settings have changed are repeated.
    """

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """Folder of the photos, or of a scene."""
    quality: QualityName = "default"
    """fast for a first look, default, or best (docs/run.md)."""
    output: Maybe[Path] = None
    """Folder of all results; by default PHOTOS-mrgs, beside the photos."""
    yes: bool = False
    """Continue in spite of warnings about the photos, without asking."""
    device: DeviceName = "auto"
    """Device to train and render on; auto uses a usable GPU, else the CPU."""
    flat_field: Maybe[Path] = None
    """Folder of thermal photos of a uniform target, which show how the camera shades its photos."""
    photo: tyro.conf.OmitArgPrefixes[PhotoOptions] = field(default_factory=PhotoOptions)


@dataclass(frozen=True)
class Train:
    """Train a model of a scene.

    A scene is a folder in the layout of ThermoScenes, nerfstudio or COLMAP. The model, its log and
    its checkpoints are written to the run folder. Ctrl-C saves a checkpoint; --resume continues
    from it.
    """

    scene: ScenePath
    """Scene folder."""
    output: Maybe[Path] = None
    """Run folder; by default runs/SCENE-METHOD."""
    method: MethodName = "mrgs-plus"
    preset: PresetName = "default"
    """fast: 1,500 steps; default: 4,000; paper: 30,000, as published."""
    max_steps: Maybe[int] = None
    """Number of steps; the preset's schedule is rescaled to fit."""
    minutes: Maybe[float] = None
    """Choose the number of steps so that training takes about this long on this computer."""
    max_gaussians: Maybe[int] = None
    """Maximum number of Gaussians."""
    resolution: Maybe[int] = None
    """Downscale images wider than this many pixels."""
    seed: int = 0
    """Random seed."""
    batch: Maybe[int] = None
    """Views per step; 1 by default (docs/large-scenes.md)."""
    config: Maybe[Path] = None
    """YAML file that overrides fields of a run's config.yaml, such as field: {neighbours_n: 5}."""
    flat_field: Maybe[Path] = None
    """Folder of thermal photos of a uniform target, which show how the camera shades its photos."""
    flat_field_unit: Maybe[str] = None
    """Unit of the numbers in its files: celsius, kelvin*100, (celsius+100)*40 ..."""
    resume: Annotated[bool, tyro.conf.arg(help=RESUME_HELP)] = False
    accept_changes: bool = False
    """With --resume: continue although photos, poses or intrinsics have changed."""
    blocks: Maybe[str] = None
    """Train a large scene in blocks: auto, or ROWSxCOLUMNS such as 2x3 (docs/large-scenes.md)."""
    overlap: Maybe[float] = None
    """With --blocks: margin around each block, m or scene units; default: 15 % of the narrowest."""
    block: Maybe[int] = None
    """With --blocks: train only this block, from 1; for job arrays."""
    device: DeviceName = "auto"
    """auto uses a usable GPU, else the CPU. A run can be resumed on a different device."""
    plain: bool = False
    """Run plain definitions in place of kernels, much slower; MRGS_PLAIN=1 for other commands."""
    tensorboard: bool = False
    """Also write the log to RUN/tensorboard. Needs mrgs[tensorboard]."""
    eval_steps: Maybe[int] = None
    """Score the held-out views every N steps, into the log; pictures with --tensorboard."""
    view: bool = False
    """Show the model in the browser while it trains."""
    port: int = 8080
    """TCP port of --view; 0 picks a free port."""


@dataclass(frozen=True)
class Eval:
    """Score a run on the views that were held out from training.

    Writes metrics.json, metrics.md and contact_sheet.png to RUN/eval. With --renders DIR, scores
    another program's images of a scene instead, and writes to DIR/eval.
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Run folder; with --renders, the scene folder."""
    renders: Maybe[Path] = None
    """Images to score: DIR/rgb/NAME.png, DIR/thermal/NAME.png or .tiff (docs/compare.md)."""
    resolution: Maybe[int] = None
    """With --renders: downscale photos wider than this many pixels, as in training."""
    scene: MovedScene = None
    lpips_weights: Maybe[Path] = None
    """VGG-16 and LPIPS weights, if not those kept by torch's hub (docs/runs.md)."""
    device: RenderDevice = "auto"


@dataclass(frozen=True)
class Render:
    """Render images of a run: colour, temperature, depth.

    Writes RGB as PNG, temperature as float32 TIFF in °C and colour-mapped, and depth to
    RUN/renders. Temperatures have the emissivity of the photos, also in marked areas.
    """

    run: RunPath
    scene: MovedScene = None
    split: Literal["eval", "train", "path"] = "eval"
    """Evaluation views, training views, or a camera path (frames; a video with mrgs[video])."""
    palette: PaletteChoice = "inferno"
    """Palette of the thermal images."""
    frames: Maybe[int] = None
    """Number of frames of the camera path, by default 120."""
    width: Maybe[int] = None
    """Width of its frames in pixels, by default that of the photos."""
    fps: Maybe[int] = None
    """Frames per second of its videos, by default 24."""
    scale_bar: bool = False
    """Draw a scale bar beside the temperatures of its frames."""
    crop: CropBox = None
    device: RenderDevice = "auto"


@dataclass(frozen=True)
class ViewRun:
    """Explore a run in the browser and read °C under the cursor."""

    run: RunPath
    scene: MovedScene = None
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 exposes the viewer to the network, to whoever has its token."""
    port: int = 8080
    """TCP port; 0 picks a free port."""
    crop: CropBox = None


@dataclass(frozen=True)
class Export:
    """Export a run: splats, points, a mesh, cameras, a web page, maps in °C.

    The page is one HTML file with everything in it: colour, temperature, °C under the cursor.
    """

    run: RunPath
    format: FormatName = "all"
    output: Maybe[Path] = None
    """Output folder; by default RUN/export."""
    scene: MovedScene = None
    palette: Maybe[PaletteChoice] = None
    """Palette of the temperatures; by default the survey's, else inferno."""
    range_c: Maybe[tuple[float, float]] = None
    """°C of the palette's first and last colour; by default the scene's full range."""
    plane: Maybe[tuple[str, str, str]] = None
    """elevation: X,Y,Z of the façade's lower left, lower right and a point above (else found)."""
    pixel_size: Maybe[float] = None
    """Pixel size of the maps (ortho, elevation) in metres; by default that of the photos."""
    crs: Maybe[str] = None
    """ortho, las: projected coordinate system in metres, such as EPSG:25832; by default UTM."""
    crop: CropBox = None
    device: RenderDevice = "auto"


@dataclass(frozen=True)
class Report:
    """Write a report: marks with ±, hottest and coldest places, survey, limits.

    Object, client, weather, logo, palette and range come from RUN/survey.yaml, which mrgs run and
    the first report write for you to fill in.
    """

    run: RunPath
    output: Maybe[Path] = None
    """Output file; by default RUN/report.html."""
    survey: Maybe[Path] = None
    """YAML file with object, client, weather ...; kept as RUN/survey.yaml."""
    set: tuple[str, ...] = ()
    """NAME=VALUE of the survey, such as client="Town of X" inside_c=21; kept in RUN/survey.yaml."""
    language: Literal["en", "de", "fr"] = "en"
    """Language of the report."""
    pdf: bool = False
    """Also write a PDF beside it. Needs mrgs[report]."""
    docx: bool = False
    """Also write a Word document to be edited. Needs mrgs[report]."""
    appendix: bool = False
    """With scores, contact sheet, training, and drift and shading of the thermal camera."""
    scene: MovedScene = None
    device: RenderDevice = "auto"


@dataclass(frozen=True)
class Measure:
    """Measure marks on a run's surfaces: spots, lines, boxes, polygons.

    Without further options, lists the marks in RUN/marks.json with their temperatures, differences
    and sizes, and the places that mrgs report proposes. Places are pixels of a view's thermal
    image: VIEW:X,Y, then X,Y of the same view.
    """

    run: RunPath
    spot: Annotated[Several[str], tyro.conf.arg(metavar="VIEW:X,Y")] = ()
    """Add a spot."""
    line: Annotated[Several[str], tyro.conf.arg(metavar="VIEW:X,Y X,Y [X,Y ...]")] = ()
    """Add a line with its profile."""
    box: Annotated[Several[str], tyro.conf.arg(metavar="VIEW:X,Y X,Y")] = ()
    """Add a box between two corners."""
    polygon: Annotated[Several[str], tyro.conf.arg(metavar="VIEW:X,Y X,Y X,Y [X,Y ...]")] = ()
    """Add a polygon."""
    mark: Maybe[str] = None
    """Mark that the next six options change; by default the ones that are added or accepted."""
    name: Maybe[str] = None
    """Name of the mark."""
    note: Maybe[str] = None
    """Note of the mark."""
    severity: Maybe[str] = None
    """Severity: class 1-3 of IEC TS 62446-3, or free text."""
    against: Maybe[str] = None
    """Mark that is subtracted in its temperature difference; '' for the reference."""
    emissivity: Maybe[float] = None
    """Emissivity of the surface in a box or polygon, above 0 and at most 1."""
    reflected: Maybe[float] = None
    """Reflected apparent temperature there, °C."""
    reference: Maybe[str] = None
    """Mark that all differences refer to, '' for none; S1=12.4 shifts the run to its true °C."""
    accept: Annotated[Several[str], tyro.conf.arg(metavar="NAME [NAME ...]")] = ()
    """Places proposed by mrgs report that become marks, such as H1 C2."""
    drop: Annotated[Several[str], tyro.conf.arg(metavar="NAME [NAME ...]")] = ()
    """Reject proposed places; they will not be proposed again."""
    delete: Maybe[str] = None
    """Mark to delete."""
    undo: bool = False
    """Undo the last change."""
    csv: Maybe[Path] = None
    """Write the table to this file, and the profiles of lines beside it."""
    geojson: Maybe[Path] = None
    """Write the marks and their values to this file, for maps."""
    scene: MovedScene = None
    device: RenderDevice = "auto"


@dataclass(frozen=True)
class Diff:
    """Compare two runs of one object, such as before and after a repair.

    Aligns the second run with the first and lists what has become warmer or colder, with its ΔT, ±
    and area, and the marks of the first run on both dates: diff.html, CSV, GeoJSON and a map.
    Needs mrgs[sfm].
    """

    first: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_A")]
    """Run of the earlier date."""
    second: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN_B")]
    """Run of the later date."""
    output: Maybe[Path] = None
    """Output folder; by default RUN_B/diff."""
    relative: bool = False
    """Subtract the change that most of the surface has in common, such as the weather's."""
    least: float = 1.0
    """Smallest change beside the common one that is listed, K."""
    language: Literal["en", "de", "fr"] = "en"
    """Language of the page."""
    pdf: bool = False
    """Also write a PDF beside it. Needs mrgs[report]."""
    device: RenderDevice = "auto"


@dataclass(frozen=True)
class ListModules:
    """List the modules of a solar plant: place, ΔT, class, lost power and energy.

    Finds the modules in the map from above by their grid, numbers them by row and place, compares
    each with its neighbours and classifies it by IEC TS 62446-3: modules.html, CSV, GeoJSON and a
    map. ΔT at 1,000 W/m² and lost power need irradiance_w_m2 in RUN/survey.yaml.
    """

    run: RunPath
    module: Annotated[str, tyro.conf.arg(metavar="METRESxMETRES")]
    """Sides of a module, such as 1.05x1.75."""
    power: Maybe[float] = None
    """Power of a module at 1,000 W/m², W."""
    yield_kwh: Maybe[float] = None
    """Energy that a kW of sound modules gives in a year, kWh."""
    output: Maybe[Path] = None
    """Output folder; by default RUN/modules."""
    language: Literal["en", "de", "fr"] = "en"
    """Language of the page."""
    pdf: bool = False
    """Also write a PDF beside it. Needs mrgs[report]."""
    scene: MovedScene = None
    device: RenderDevice = "auto"


@dataclass(frozen=True)
class Demo:
    """Run the bundled scene: mrgs run on an example, in a few minutes."""

    output: Path = Path("runs/demo")
    """Folder of all results."""
    quality: QualityName = "fast"
    """fast, default or best, as in mrgs run."""
    device: DeviceName = "auto"
    """Device to train and render on; auto uses a usable GPU, else the CPU."""


@dataclass(frozen=True)
class CompareMethods:
    """Compare methods on scenes: the paper's tables and figures.

    Trains and scores every method on every scene. Re-run the same command to resume. See
    docs/compare.md for how to read the tables.
    """

    scenes: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SCENE [SCENE ...]", help_behavior_hint=""),
    ]
    """Scene folders."""
    methods: Annotated[
        tuple[str, ...],
        tyro.conf.arg(
            metavar="METHOD [METHOD ...]", help=f"Methods: any of {', '.join(METHOD_NAMES)}."
        ),
    ] = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")
    variants: Several[str] = ()
    """Methods with other settings, NAME=FILE: as for mrgs train --config, plus method: METHOD."""
    neighbours: Several[int] = ()
    """Values of n for the table of neighbours; the paper has 1 3 5 7."""
    renders: Several[str] = ()
    """Other programs' images, NAME=DIR; those of each scene are in DIR/SCENE."""
    seeds: int = 1
    """Number of runs per method and scene."""
    preset: PresetName = "default"
    """fast, default or paper, as in mrgs train."""
    max_steps: Maybe[int] = None
    """Number of steps; the preset's schedule is rescaled to fit."""
    max_gaussians: Maybe[int] = None
    """Maximum number of Gaussians."""
    resolution: Maybe[int] = None
    """Downscale images wider than this many pixels."""
    jobs: int = 1
    """Number of parallel runs; they share the cores."""
    device: DeviceName = "auto"
    """auto uses a usable GPU, else the CPU. Methods without GPU support use the CPU."""
    output: Path = Path("runs/compare")
    """Folder of the runs, tables and figures."""
    lpips_weights: Maybe[Path] = None
    """VGG-16 and LPIPS weights, if not those kept by torch's hub (docs/runs.md)."""


@dataclass(frozen=True)
class Prepare:
    """Make a scene from a folder of photos.

    Pairs the photos, reads the temperatures, estimates the camera poses and the scale, and
    calibrates the thermal camera. The photos are only read. Check SCENE/prepare.html before
    training: it shows what was found. Re-run the same command to resume. Needs mrgs[sfm].
    """

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """Folder of the photos."""
    scene: ScenePath
    """Folder to make."""
    photo: tyro.conf.OmitArgPrefixes[PhotoOptions] = field(default_factory=PhotoOptions)


@dataclass(frozen=True)
class Check:
    """Check a scene that was made elsewhere.

    Lists problems of images, cameras, points and temperatures, the worst first, and draws the scene
    on SCENE/check.html; changes nothing else. The exit code is 1 if the scene should not be trained
    as it is.
    """

    scene: ScenePath
    """Folder of the scene, in the layout of ThermoScenes, nerfstudio or COLMAP."""


@dataclass(frozen=True)
class Synth:
    """Generate a scene with exact temperatures and depths.

    Needs a checkout of the repository, with pip install -e ".[synth]".
    """

    output: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    """Folder of the new scene."""
    scene: Annotated[SynthScene, tyro.conf.arg(help=SYNTH_SCENE_HELP)] = "tabletop"
    train_views: Maybe[int] = None
    """Number of training views, by default 40; for solar-plant it follows from --overlap."""
    eval_views: int = 8
    """Number of evaluation views."""
    width: int = 320
    """Image width in pixels."""
    height: int = 240
    """Image height in pixels."""
    samples: int = 64
    """Paths per pixel; more take longer and reduce noise. 8 suffice for the drawn kinds."""
    seed: int = 0
    """Seed of the scene, or of its random details, and of the sensor's noise."""
    nir: bool = False
    """Also take near-infrared photos, a third modality."""
    camera: Literal["gaussian", "phone", "phone-edges", "handheld", "wiris-like"] = "gaussian"
    """Thermal camera; all but gaussian drift, shade and blur as real ones. Not for solar-plant."""
    rows: int = 4
    """solar-plant: rows of modules, 6 m apart."""
    modules: int = 20
    """solar-plant: modules along a row, 1.05 m wide."""
    overlap: float = 0.75
    """solar-plant: overlap of photos and of flight lines, as a share of a photo."""
    gps_noise: float = 0.5
    """solar-plant: standard deviation of the GPS positions in the photos' EXIF, m."""


COMMANDS: dict[str, type] = {
    "run": RunAll,
    "demo": Demo,
    "read": Read,
    "prepare": Prepare,
    "check": Check,
    "train": Train,
    "eval": Eval,
    "render": Render,
    "view": ViewRun,
    "measure": Measure,
    "diff": Diff,
    "modules": ListModules,
    "export": Export,
    "report": Report,
    "compare": CompareMethods,
    "synth": Synth,
}
"""All commands by name, in the order in which they are listed."""
