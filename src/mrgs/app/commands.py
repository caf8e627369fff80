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
    its checkpoints go into the run folder. Ctrl-C leaves a checkpoint; --resume goes on exactly
    where it was.
    """

    scene: tyro.conf.Positional[Path]
    """The scene's folder."""
    output: Path | None = None
    """The run's folder; by default runs/SCENE-METHOD."""
    method: Annotated[str, tyro.conf.arg(help=METHODS_HELP)] = "mrgs-plus"
    preset: str = "default"
    """fast (1,500 steps), default (4,000 steps), or paper (30,000 steps, as published)."""
    max_steps: int | None = None
    """Steps; the preset's whole schedule is stretched or shrunk to them."""
    max_gaussians: int | None = None
    """Cap on the number of Gaussians."""
    resolution: int | None = None
    """Images wider than this many pixels are reduced to it."""
    seed: int = 0
    """Seed of every random choice."""
    config: Path | None = None
    """YAML file with other values for any field of a run's config.yaml, for instance field:
    {neighbours_n: 5}."""
    resume: bool = False
    """Continue the run in the output folder; all options but --device, --plain and --view are
    the run's own."""
    device: DeviceName = "auto"
    """auto takes the GPU where one can be used, else the CPU. A run may go on on another."""
    plain: bool = False
    """Run the plain definition of every operation instead of its kernel, much slower; so does
    MRGS_PLAIN=1, for any command."""
    view: bool = False
    """Show the model in the browser while it trains. Needs mrgs[view]."""
    port: int = 8080
    """TCP port of --view; 0 takes a free one."""


@dataclass(frozen=True)
class Eval:
    """Score a run on its scene's eval views: RUN/eval/metrics.json, metrics.md and
    contact_sheet.png.

    With --renders, score another program's images of a scene instead: DIR/eval.
    """

    run: tyro.conf.Positional[Path]
    """The run's folder; with --renders, the scene's."""
    renders: Path | None = None
    """Folder of images named like the eval views: rgb/NAME.png and thermal/NAME.png or .tiff;
    docs/experiments.md."""
    resolution: int | None = None
    """With --renders: photos wider than this many pixels are reduced to it, as in training."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights (safetensors); without them LPIPS is left out."""
    device: DeviceName = "auto"
    """Where to render; auto takes the GPU where one can be used."""


@dataclass(frozen=True)
class Render:
    """Write images into RUN/renders: RGB, temperature (float32 TIFF in °C, and colour-mapped),
    depth."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""
    split: Literal["eval", "train", "path"] = "eval"
    """The eval views, the training views, or a camera path around the scene (frames, and video
    where installed)."""
    palette: Literal["inferno", "iron", "grey", "rainbow"] = "inferno"
    """Colours of the thermal images."""
    frames: int = 120
    """Frames of the camera path."""
    device: DeviceName = "auto"
    """Where to render; auto takes the GPU where one can be used."""


@dataclass(frozen=True)
class View:
    """Look at a run in the browser: colour, temperature, depth, °C under the cursor. Needs
    mrgs[view]."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines look too."""
    port: int = 8080
    """TCP port; 0 takes a free one."""


@dataclass(frozen=True)
class Export:
    """Write a run for other programs: splats, points, a mesh, cameras, one HTML page that needs
    nothing else."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    format: Literal[
        "all", "ply", "spz", "glb", "splat", "points", "las", "mesh", "cameras", "page"
    ] = "all"
    """What to write; docs/export.md says what is in each."""
    output: Path | None = None
    """The folder to write into; by default RUN/export."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""
    palette: Literal["inferno", "iron", "grey", "rainbow"] = "inferno"
    """Colours of the temperatures."""
    range_c: tuple[float, float] | None = None
    """°C of the palette's first and last colour; by default the scene's whole range."""


@dataclass(frozen=True)
class Report:
    """Write one page for a thermographer: hottest and coldest spots, scores, capture, limits.
    Prints to PDF."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    output: Path | None = None
    """The file; by default RUN/report.html."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""
    device: DeviceName = "auto"
    """Where to render; auto takes the GPU where one can be used."""


@dataclass(frozen=True)
class Demo:
    """Train on the bundled scene, score, render, and say where to look. Takes a few minutes."""

    output: Path = Path("runs/demo")
    """The run's folder."""
    device: DeviceName = "auto"
    """Where to train and render; auto takes the GPU where one can be used."""


@dataclass(frozen=True)
class Compare:
    """Train and score methods on scenes, and write the paper's tables and figures.

    The same command goes on where it was cut off. docs/experiments.md says how to read the tables.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """The scenes' folders."""
    methods: tuple[str, ...] = (
        "3dgs-rgbt",
        "mrgs-base",
        "mrgs-fourier",
        "mrgs-boltz",
        "mrgs",
        "mrgs-plus",
    )
    """Any that mrgs train --method knows."""
    variants: tuple[str, ...] = ()
    """Also methods with changed values, NAME=FILE: as for mrgs train --config, with a line such as
    method: mrgs."""
    neighbours: tuple[int, ...] = ()
    """Also the table of neighbours: mrgs with each n; the paper has 1 3 5 7."""
    renders: tuple[str, ...] = ()
    """Other programs' images, NAME=DIR, with those of each scene in DIR/SCENE."""
    seeds: int = 1
    """Runs of each method on each scene."""
    preset: str = "default"
    """fast, default or paper, as in mrgs train."""
    max_steps: int | None = None
    """Steps; the preset's whole schedule is stretched or shrunk to them."""
    max_gaussians: int | None = None
    """Cap on the number of Gaussians."""
    resolution: int | None = None
    """Images wider than this many pixels are reduced to it."""
    jobs: int = 1
    """Runs at a time; the cores are divided among them."""
    device: DeviceName = "auto"
    """Where to train and render; auto takes the GPU where one can be used. Methods
    that have no kernels for it take the CPU."""
    output: Path = Path("runs/compare")
    """The folder of the runs, tables and figures."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights (safetensors); without them LPIPS is left out."""


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
    """Generate a scene with exact temperatures and depths: the bundled table-top, or another. Needs
    mrgs[synth]."""

    output: tyro.conf.Positional[Path]
    """The new scene's folder."""
    scene: Literal["tabletop", "facade", "electronics"] = "tabletop"
    """What to generate: things on a table, a house in winter, or a powered circuit board."""
    train_views: int = 40
    """Training views."""
    eval_views: int = 8
    """Held-out views."""
    width: int = 320
    """Image width in pixels."""
    height: int = 240
    """Image height in pixels."""
    samples: int = 64
    """Paths per pixel: more take longer and are less noisy."""
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
