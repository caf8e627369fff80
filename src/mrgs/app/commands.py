"""The commands and their options; the docstrings are what ``--help`` prints."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from mrgs.runs.registry import registered_methods

if TYPE_CHECKING:
    from mrgs.prepare import PrepareOptions

METHODS_HELP = "; ".join(f"{each.name}: {each.description}" for each in registered_methods())

DeviceName = Literal["auto", "cpu", "cuda"]
"""As in ``mrgs.system.gpu``, which loads torch."""


@dataclass(frozen=True)
class Train:
    """Train a model of a scene.

    A scene is a folder in the layout of ThermoScenes, nerfstudio or COLMAP. The model, its log and
    its checkpoints are written to the run folder. Ctrl-C saves a checkpoint; --resume continues
    from it.
    """

    scene: tyro.conf.Positional[Path]
    """Scene folder."""
    output: Path | None = None
    """Run folder; by default runs/SCENE-METHOD."""
    method: Annotated[str, tyro.conf.arg(help=METHODS_HELP)] = "mrgs-plus"
    preset: str = "default"
    """fast (1,500 steps), default (4,000 steps), or paper (30,000 steps, as published)."""
    max_steps: int | None = None
    """Number of steps; the preset's schedule is rescaled to fit."""
    max_gaussians: int | None = None
    """Maximum number of Gaussians."""
    resolution: int | None = None
    """Downscale images wider than this many pixels."""
    seed: int = 0
    """Random seed."""
    config: Path | None = None
    """YAML file that overrides fields of a run's config.yaml, such as field: {neighbours_n: 5}."""
    resume: bool = False
    """Resume the run in --output; all options but --device, --plain and --view come from the saved
    run."""
    device: DeviceName = "auto"
    """auto uses a usable GPU, else the CPU. A run can be resumed on a different device."""
    plain: bool = False
    """Run the plain definition of every operation instead of its kernel, much slower; so does
    MRGS_PLAIN=1, for any command."""
    view: bool = False
    """Show the model in the browser while it trains. Needs mrgs[view]."""
    port: int = 8080
    """TCP port of --view; 0 picks a free port."""


@dataclass(frozen=True)
class Eval:
    """Score a run on its scene's evaluation views.

    Writes metrics.json, metrics.md and contact_sheet.png to RUN/eval. With --renders DIR, scores
    another program's images of a scene instead, and writes to DIR/eval.
    """

    run: tyro.conf.Positional[Path]
    """Run folder; with --renders, the scene folder."""
    renders: Path | None = None
    """Images to score: DIR/rgb/NAME.png, DIR/thermal/NAME.png or .tiff (docs/experiments.md)."""
    resolution: int | None = None
    """With --renders: downscale photos wider than this many pixels, as in training."""
    scene: Path | None = None
    """Scene folder, if it has moved since training."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights (safetensors); without them, LPIPS is skipped."""
    device: DeviceName = "auto"
    """Device to render on; auto uses a usable GPU, else the CPU."""


@dataclass(frozen=True)
class Render:
    """Render images into RUN/renders: RGB, temperature (°C as float32 TIFF, and colour-mapped),
    depth."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    scene: Path | None = None
    """Scene folder, if it has moved since training."""
    split: Literal["eval", "train", "path"] = "eval"
    """Evaluation views, training views, or a camera path (frames; a video with mrgs[video])."""
    palette: Literal["inferno", "iron", "grey", "rainbow"] = "inferno"
    """Palette of the thermal images."""
    frames: int = 120
    """Number of frames of the camera path."""
    device: DeviceName = "auto"
    """Device to render on; auto uses a usable GPU, else the CPU."""


@dataclass(frozen=True)
class View:
    """View a run in the browser: colour, temperature, depth, °C under the cursor. Needs
    mrgs[view]."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    scene: Path | None = None
    """Scene folder, if it has moved since training."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 exposes the viewer to the network."""
    port: int = 8080
    """TCP port; 0 picks a free port."""


@dataclass(frozen=True)
class Export:
    """Export a run for other programs: splats, points, a mesh, cameras, a self-contained HTML
    page."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    format: Literal[
        "all", "ply", "spz", "glb", "splat", "points", "las", "mesh", "cameras", "page"
    ] = "all"
    """What to write; see docs/export.md."""
    output: Path | None = None
    """Output folder; by default RUN/export."""
    scene: Path | None = None
    """Scene folder, if it has moved since training."""
    palette: Literal["inferno", "iron", "grey", "rainbow"] = "inferno"
    """Palette of the temperatures."""
    range_c: tuple[float, float] | None = None
    """°C of the palette's first and last colour; by default the scene's full range."""


@dataclass(frozen=True)
class Report:
    """Write a one-page report for a thermographer: hottest and coldest spots, scores, capture,
    limits."""

    run: tyro.conf.Positional[Path]
    """Run folder."""
    output: Path | None = None
    """Output file; by default RUN/report.html."""
    scene: Path | None = None
    """Scene folder, if it has moved since training."""
    device: DeviceName = "auto"
    """Device to render on; auto uses a usable GPU, else the CPU."""


@dataclass(frozen=True)
class Demo:
    """Train on the bundled scene, score it and render it. Takes a few minutes."""

    output: Path = Path("runs/demo")
    """Run folder."""
    device: DeviceName = "auto"
    """Device to train and render on; auto uses a usable GPU, else the CPU."""


@dataclass(frozen=True)
class Compare:
    """Train and score methods on scenes, and write the paper's tables and figures.

    Re-run the same command to resume. See docs/experiments.md for how to read the tables.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """Scene folders."""
    methods: tuple[str, ...] = (
        "3dgs-rgbt",
        "mrgs-base",
        "mrgs-fourier",
        "mrgs-boltz",
        "mrgs",
        "mrgs-plus",
    )
    """Methods, as for mrgs train --method."""
    variants: tuple[str, ...] = ()
    """Methods with other settings, NAME=FILE: as for mrgs train --config, plus method: METHOD."""
    neighbours: tuple[int, ...] = ()
    """Values of n for the table of neighbours; the paper has 1 3 5 7."""
    renders: tuple[str, ...] = ()
    """Other programs' images, NAME=DIR; those of each scene are in DIR/SCENE."""
    seeds: int = 1
    """Number of runs per method and scene."""
    preset: str = "default"
    """fast, default or paper, as in mrgs train."""
    max_steps: int | None = None
    """Number of steps; the preset's schedule is rescaled to fit."""
    max_gaussians: int | None = None
    """Maximum number of Gaussians."""
    resolution: int | None = None
    """Downscale images wider than this many pixels."""
    jobs: int = 1
    """Number of parallel runs; they share the cores."""
    device: DeviceName = "auto"
    """Device to train and render on; auto uses a usable GPU, else the CPU. Methods without GPU
    support use the CPU."""
    output: Path = Path("runs/compare")
    """Folder of the runs, tables and figures."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights (safetensors); without them, LPIPS is skipped."""


@dataclass(frozen=True)
class Prepare:
    """Make a scene from a folder of photos: pairs, temperatures, poses, the thermal camera, scale.
    Needs mrgs[sfm].

    The photos are only read. SCENE/prepare.html shows what was understood: look at it before
    training. The same command goes on where it was cut off. With --check, look at a scene that was
    made elsewhere, and say what is wrong with it.
    """

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """The folder of the photos; with --check, the scene's."""
    scene: Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[SCENE]")] = None
    """The folder to make."""
    check: bool = False
    """Check a scene instead of making one."""
    pairs: Literal["auto", "names", "folders", "time", "thermal"] = "auto"
    """How the two photos of a moment are told: by names, two folders, time; or the thermal photos
    alone."""
    pair_table: Path | None = None
    """A CSV with two columns, the RGB and the thermal photo, where the names do not tell."""
    tolerance: float = 2.0
    """Photos farther apart in time are no pair, s."""
    poses: Path | None = None
    """A folder with COLMAP's or nerfstudio's poses of these photos, to be taken as they are."""
    emissivity: float | None = None
    """Of the surfaces; this and the next six replace what radiometric photos say.
    docs/radiometric.md"""
    reflected: float | None = None
    """Reflected apparent temperature, °C."""
    distance: float | None = None
    """From the camera to the object, m."""
    atmospheric: float | None = None
    """Temperature of the air, °C."""
    humidity: float | None = None
    """Relative humidity of the air, 0 to 1."""
    window: float | None = None
    """Temperature of an infrared window before the camera, °C."""
    window_transmission: float | None = None
    """Transmission of that window, 0 to 1."""
    unit: str | None = None
    """What the numbers in TIFF, PNG and CSV files are, for instance celsius, kelvin*100."""
    bounds: tuple[float, float] | None = None
    """°C of black and white, where the thermal photos are grey pictures of one fixed span."""
    thermal_fov: float | None = None
    """Horizontal field of view of the thermal camera from its data sheet, degrees; helps to find
    it."""
    thermal_camera: Path | None = None
    """JSON with the thermal camera, such as the transforms.json of another scene of the same
    camera. docs/prepare.md"""
    one_camera: bool = False
    """The two images of a pair show the same, pixel for pixel."""
    target: tuple[str, float] | None = None
    """A chessboard that both cameras see: its inner corners and the side of a square in m, for
    instance 7x6 0.05."""
    known_distance: tuple[str, str, float] | None = None
    """Two pixels of a view and the distance between what they show in m: NAME:X,Y NAME:X,Y
    METRES."""
    eval_every: int = 8
    """Every so-many-th view is held out for scoring; 0 holds none out."""

    def options(self) -> PrepareOptions:
        """What ``prepare`` takes.

        Raises:
            ConfigError: a value that cannot be, or two options that exclude each other.
        """
        from mrgs.data.radiometric import Overrides
        from mrgs.prepare import PrepareOptions, parse_known_distance, parse_target

        return PrepareOptions(
            overrides=Overrides(
                emissivity=self.emissivity,
                distance_m=self.distance,
                reflected_c=self.reflected,
                atmospheric_c=self.atmospheric,
                humidity=self.humidity,
                window_c=self.window,
                window_transmission=self.window_transmission,
                unit=self.unit,
                bounds_c=self.bounds,
            ),
            pairs=self.pairs,
            pair_table=self.pair_table,
            tolerance_s=self.tolerance,
            poses=self.poses,
            one_camera=self.one_camera,
            thermal_fov_deg=self.thermal_fov,
            thermal_camera=self.thermal_camera,
            target=None if self.target is None else parse_target(*self.target),
            known_distance=None
            if self.known_distance is None
            else parse_known_distance(*self.known_distance),
            eval_every=self.eval_every,
        )


@dataclass(frozen=True)
class Synth:
    """Generate a scene with exact temperatures and depths. Needs mrgs[synth]."""

    output: tyro.conf.Positional[Path]
    """Folder of the new scene."""
    scene: Literal["tabletop", "facade", "electronics"] = "tabletop"
    """Scene: things on a table, a house in winter, or a powered circuit board."""
    train_views: int = 40
    """Number of training views."""
    eval_views: int = 8
    """Number of evaluation views."""
    width: int = 320
    """Image width in pixels."""
    height: int = 240
    """Image height in pixels."""
    samples: int = 64
    """Paths per pixel; more take longer and reduce noise."""
    seed: int = 0
    """Seed of the scene's random details and of the sensor's noise."""


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Prepare, tyro.conf.subcommand("prepare")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Synth, tyro.conf.subcommand("synth")]
)
