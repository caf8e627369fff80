"""The command line: argv, the terminal, exit codes. Everything else is a Python function elsewhere."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mrgs.errors import ConfigError, MrgsError, TrainingError
from mrgs.terminal import (
    TrainingProgress,
    counter,
    note_unfinished,
    plain_warnings,
    print_baking_loss,
    print_figures,
    print_metrics,
    print_table,
    say_where_to_look,
    scene_if_there,
)

if TYPE_CHECKING:
    from mrgs.scene import Scene
    from mrgs.training import StepStatistics, TrainConfig
    from mrgs.viewer import LiveView

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

MAX_TRAIN_SEED = 2**32 - 1
MAX_SYNTH_SEED = 1_000_000
"""Mitsuba takes 32 bits, and every view has a seed of its own."""


@dataclass(frozen=True)
class Train:
    """Train a model of a scene.

    A scene is a folder in the layout of ThermoScenes, nerfstudio or COLMAP. The model, its log and its checkpoints go
    into the run folder. Ctrl-C leaves a checkpoint; --resume goes on exactly where it was.
    """

    scene: tyro.conf.Positional[Path]
    """The scene's folder."""
    output: Path | None = None
    """The run's folder; by default runs/SCENE-METHOD."""
    method: str = "mrgs"
    """mrgs, mrgs-plus, mrgs-base, mrgs-fourier, mrgs-boltz, or 3dgs-rgbt."""
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
    """YAML file with other values for any field of a run's config.yaml, for instance field: {neighbours_n: 5}."""
    resume: bool = False
    """Continue the run in the output folder; all other options are the run's own."""
    view: bool = False
    """Show the model in the browser while it trains. Needs mrgs[view]."""
    port: int = 8080
    """TCP port of --view; 0 takes a free one."""


@dataclass(frozen=True)
class Eval:
    """Score a run on its scene's eval views: RUN/eval/metrics.json, metrics.md and contact_sheet.png.

    With --renders, score another program's images of a scene instead: DIR/eval.
    """

    run: tyro.conf.Positional[Path]
    """The run's folder; with --renders, the scene's."""
    renders: Path | None = None
    """Folder of images named like the eval views: rgb/NAME.png and thermal/NAME.png or .tiff; docs/experiments.md."""
    resolution: int | None = None
    """With --renders: photos wider than this many pixels are reduced to it, as in training."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights (safetensors); without them LPIPS is left out."""


@dataclass(frozen=True)
class Render:
    """Write images into RUN/renders: RGB, temperature (float32 TIFF in °C, and colour-mapped), depth."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""
    split: Literal["eval", "train", "path"] = "eval"
    """The eval views, the training views, or a camera path around the scene (frames, and video where installed)."""
    palette: Literal["inferno", "iron", "grey", "rainbow"] = "inferno"
    """Colours of the thermal images."""
    frames: int = 120
    """Frames of the camera path."""


@dataclass(frozen=True)
class View:
    """Look at a run in the browser: colour, temperature, depth, °C under the cursor. Needs mrgs[view]."""

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
    """Write a run for other programs: splats, points, a mesh, cameras, one HTML page that needs nothing else."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    format: Literal["all", "ply", "spz", "glb", "splat", "points", "las", "mesh", "cameras", "page"] = "all"
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
    """Write one page for a thermographer: hottest and coldest spots, scores, capture, limits. Prints to PDF."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
    output: Path | None = None
    """The file; by default RUN/report.html."""
    scene: Path | None = None
    """The scene's folder, where it is no longer at the place it was trained from."""


@dataclass(frozen=True)
class Demo:
    """Train on the bundled scene, score, render, and say where to look. Takes a few minutes."""

    output: Path = Path("runs/demo")
    """The run's folder."""


@dataclass(frozen=True)
class Compare:
    """Train and score methods on scenes, and write the paper's tables and figures.

    The same command goes on where it was cut off. docs/experiments.md says how to read the tables.
    """

    scenes: tyro.conf.Positional[tuple[Path, ...]]
    """The scenes' folders."""
    methods: tuple[str, ...] = ("3dgs-rgbt", "mrgs-base", "mrgs-fourier", "mrgs-boltz", "mrgs", "mrgs-plus")
    """Any that mrgs train --method knows."""
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
    output: Path = Path("runs/compare")
    """The folder of the runs, tables and figures."""
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights (safetensors); without them LPIPS is left out."""


@dataclass(frozen=True)
class Synth:
    """Generate a scene with exact temperatures and depths: the bundled table-top, or another. Needs mrgs[synth]."""

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
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Synth, tyro.conf.subcommand("synth")]
)


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code: 0, 2 for what the user can mend, 130 after Ctrl-C."""
    # Threads that spin while they wait cost more than they save on shared cores. Read once, when torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    command: Any = tyro.cli(
        Command,
        prog="mrgs",
        description="RGB and thermal photos in, one 3D Gaussian model with colour and °C out.",
        args=argv,
    )
    handlers: dict[type, Callable[[Any], None]] = {
        Train: _train,
        Eval: _eval,
        Render: _render,
        View: _view,
        Export: _export,
        Report: _report,
        Demo: _demo,
        Compare: _compare,
        Synth: _synth,
    }
    with plain_warnings():
        try:
            handlers[type(command)](command)
        except MrgsError as error:
            print(f"mrgs: error: {error}", file=sys.stderr)
            return EXIT_USER_ERROR
        except BrokenPipeError:  # the reader of a pipe has gone; nothing more can be said
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except KeyboardInterrupt:
            print("mrgs: stopped", file=sys.stderr)
            return EXIT_INTERRUPTED
    return 0


def _train(command: Train) -> None:
    from mrgs.training import from_yaml, make_config, train

    config = make_config(
        command.method, command.preset, command.max_steps, command.max_gaussians, command.resolution, command.seed
    )
    if command.config is not None:
        config = from_yaml(_read_text(command.config), str(command.config), config)
    _check_seed(config.seed, MAX_TRAIN_SEED)
    folder = command.scene.parent if command.scene.is_file() else command.scene
    output = command.output or Path("runs") / f"{folder.resolve().name}-{command.method}"
    progress = TrainingProgress()
    with progress, _live_view(output, command.port) if command.view else nullcontext() as live:
        train(command.scene, output, config, resume=command.resume, **_hooks(progress, live))
    if progress.unfinished:
        go_on = shlex.join(["mrgs", "train", str(command.scene), "--output", str(output), "--resume"])
        print(f"a checkpoint is kept; go on with: {go_on}")
        raise KeyboardInterrupt
    quoted = shlex.quote(str(output))
    print(f"trained:   {output}\nscore it:  mrgs eval {quoted}\nrender it: mrgs render {quoted}")


def _live_view(output: Path, port: int) -> LiveView:
    from mrgs.viewer import LiveView

    return LiveView(output, port=port, on_ready=say_where_to_look)


def _hooks(progress: TrainingProgress, live: LiveView | None) -> dict[str, Any]:
    """What ``train`` calls: the terminal's line, and the view if there is one."""
    if live is None:
        return {"on_start": progress.start, "on_step": progress.step}

    def on_start(scene: Scene, config: TrainConfig) -> None:
        progress.start(scene, config)
        live.on_start(scene, config)

    def on_step(statistics: StepStatistics) -> bool:
        live.on_step(statistics)
        return progress.step(statistics)

    return {"on_start": on_start, "on_model": live.on_model, "on_step": on_step}


def _eval(command: Eval) -> None:
    if command.renders is not None:
        _eval_renders(command, command.renders)
        return
    from mrgs.evaluation import evaluate_run
    from mrgs.run import load_run

    run = load_run(command.run, command.scene)
    metrics = evaluate_run(run, command.lpips_weights, counter("scoring"))
    print_metrics(run, metrics)
    print(f"scores:   {command.run / 'eval' / 'metrics.md'}\npictures: {command.run / 'eval' / 'contact_sheet.png'}")


def _eval_renders(command: Eval, folder: Path) -> None:
    from mrgs.evaluation.renders import evaluate_renders

    metrics = evaluate_renders(
        command.run,
        folder,
        resolution=command.resolution,
        lpips_weights=command.lpips_weights,
        progress=counter("scoring"),
    )
    print_figures(metrics)
    print(f"scores:   {folder / 'eval' / 'metrics.md'}\npictures: {folder / 'eval' / 'contact_sheet.png'}")


def _compare(command: Compare) -> None:
    from mrgs.comparison import Options, compare

    options = Options(
        command.methods,
        command.neighbours,
        command.seeds,
        command.preset,
        command.max_steps,
        command.max_gaussians,
        command.resolution,
    )
    try:
        comparison = compare(
            command.scenes,
            command.output,
            options,
            renders=_named_folders(command.renders),
            jobs=command.jobs,
            lpips_weights=command.lpips_weights,
            say=lambda line: print(line, flush=True),
        )
    except KeyboardInterrupt:
        print("the runs that were under way have left checkpoints; the same command goes on")
        raise
    for table in comparison.tables:
        print_table(table)
    print(f"tables: {command.output / 'tables'}\nfigures: {command.output / 'figures'}")
    if comparison.failures:
        name, reason = next(iter(comparison.failures.items()))
        raise TrainingError(
            f"{len(comparison.failures)} of the tables' rows lack scores, the first is {name} ({reason}); "
            "mend the cause and run the same command again"
        )


def _named_folders(pairs: tuple[str, ...]) -> dict[str, Path]:
    """Folders by name, from NAME=DIR."""
    named = {}
    for pair in pairs:
        name, separator, folder = pair.partition("=")
        if not separator or not name or not folder:
            raise ConfigError(f"--renders {pair}: write NAME=DIR, for instance ThermoNeRF=renders/thermonerf")
        named[name] = Path(folder)
    return named


def _render(command: Render) -> None:
    from mrgs.evaluation import render_run
    from mrgs.run import load_run

    run = load_run(command.run, command.scene)
    folder = render_run(run, command.split, command.palette, command.frames, counter("rendering"))
    print(f"images: {folder}")


def _view(command: View) -> None:
    from mrgs.run import load_run
    from mrgs.viewer import view

    run = load_run(command.run, command.scene)
    note_unfinished(run)
    view(run, scene_if_there(run), command.host, command.port, on_ready=say_where_to_look)


def _export(command: Export) -> None:
    from mrgs.export import export
    from mrgs.run import load_run

    run = load_run(command.run, command.scene)
    note_unfinished(run)
    folder = command.output or command.run / "export"
    paths = export(
        run, run.load_scene(), command.format, folder, command.palette, command.range_c, on_baked=print_baking_loss
    )
    print(*paths, sep="\n")


def _report(command: Report) -> None:
    from mrgs.report import write_report
    from mrgs.run import load_run

    run = load_run(command.run, command.scene)
    note_unfinished(run)
    print(f"report: {write_report(run, run.load_scene(), command.output or command.run / 'report.html')}")


def _demo(command: Demo) -> None:
    started = any((command.output / "checkpoints").glob("*.safetensors"))
    _train(Train(scene=_bundled_scene(), output=command.output, preset="fast", resume=started))
    _eval(Eval(run=command.output))
    _render(Render(run=command.output))
    print(f"\nLook at {command.output / 'eval' / 'contact_sheet.png'} first.")


def _synth(command: Synth) -> None:
    from mrgs.synth import synthesize

    _check_seed(command.seed, MAX_SYNTH_SEED)
    synthesize(
        command.output,
        scene=command.scene,
        width=command.width,
        height=command.height,
        train_views=command.train_views,
        eval_views=command.eval_views,
        samples=command.samples,
        seed=command.seed,
        progress=counter("photographing"),
    )
    print(f"scene: {command.output}")


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path} cannot be read ({getattr(error, 'strerror', 'not UTF-8')}): name a text file"
        ) from error


def _check_seed(seed: int, largest: int) -> None:
    if not 0 <= seed <= largest:
        raise ConfigError(f"the seed must be from 0 to {largest:,}, not {seed}")


def _bundled_scene() -> Path:
    """The example scene: beside the installed package, or in the checkout."""
    package = Path(__file__).resolve().parent
    for folder in (package / "examples", package.parents[1] / "examples"):
        if (folder / "tabletop" / "transforms.json").is_file():
            return folder / "tabletop"
    raise ConfigError("the bundled scene is not installed: run `mrgs demo` from a checkout, or reinstall mrgs")


if __name__ == "__main__":
    sys.exit(main())
