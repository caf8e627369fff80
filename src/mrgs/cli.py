"""The command line: argv, the terminal, exit codes. Everything else is a Python function elsewhere."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from mrgs.errors import ConfigError, MrgsError
from mrgs.terminal import TrainingProgress, counter, plain_warnings, print_metrics

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
    """mrgs, mrgs-base, mrgs-fourier, mrgs-boltz, or 3dgs-rgbt."""
    preset: str = "default"
    """fast (1,100 steps), default (4,000 steps), or paper (30,000 steps, as published)."""
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


@dataclass(frozen=True)
class Eval:
    """Score a run on its scene's eval views: RUN/eval/metrics.json, metrics.md and contact_sheet.png."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
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
class Demo:
    """Train on the bundled scene, score, render, and say where to look. Takes a few minutes."""

    output: Path = Path("runs/demo")
    """The run's folder."""


@dataclass(frozen=True)
class Synth:
    """Generate the bundled scene anew, or a variant of it, with exact temperatures and depths. Needs mrgs[synth]."""

    output: tyro.conf.Positional[Path]
    """The new scene's folder."""
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
        Demo: _demo,
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
    with progress:
        train(
            command.scene,
            output,
            config,
            resume=command.resume,
            on_start=progress.start,
            on_step=progress.step,
        )
    if progress.unfinished:
        go_on = shlex.join(["mrgs", "train", str(command.scene), "--output", str(output), "--resume"])
        print(f"a checkpoint is kept; go on with: {go_on}")
        raise KeyboardInterrupt
    quoted = shlex.quote(str(output))
    print(f"trained:   {output}\nscore it:  mrgs eval {quoted}\nrender it: mrgs render {quoted}")


def _eval(command: Eval) -> None:
    from mrgs.evaluation import evaluate_run
    from mrgs.run import load_run

    run = load_run(command.run, command.scene)
    metrics = evaluate_run(run, command.lpips_weights, counter("scoring"))
    print_metrics(run, metrics)
    print(f"scores:   {command.run / 'eval' / 'metrics.md'}\npictures: {command.run / 'eval' / 'contact_sheet.png'}")


def _render(command: Render) -> None:
    from mrgs.evaluation import render_run
    from mrgs.run import load_run

    run = load_run(command.run, command.scene)
    folder = render_run(run, command.split, command.palette, command.frames, counter("rendering"))
    print(f"images: {folder}")


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
