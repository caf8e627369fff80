"""The command line: argv, the terminal, exit codes. Everything else is a Python function elsewhere."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mrgs.errors import ConfigError, MrgsError, MrgsWarning

if TYPE_CHECKING:
    from mrgs.evaluation import Metrics
    from mrgs.run import Run
    from mrgs.scene import Scene
    from mrgs.training import StepStatistics, TrainConfig

EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130

PLAIN_LINE_EVERY_S = 10.0
"""Between progress lines where the output is not a terminal."""

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
    """fast (1,200 steps), default (4,000 steps), or paper (30,000 steps, as published)."""
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
    lpips_weights: Path | None = None
    """VGG-16 and LPIPS weights (safetensors); without them LPIPS is left out."""


@dataclass(frozen=True)
class Render:
    """Write images into RUN/renders: RGB, temperature (float32 TIFF in °C, and colour-mapped), depth."""

    run: tyro.conf.Positional[Path]
    """The run's folder."""
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
    with _plain_warnings():
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
    progress = _TrainingProgress()
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

    run = load_run(command.run)
    metrics = evaluate_run(run, command.lpips_weights, _counter("scoring"))
    _print_metrics(run, metrics)
    print(f"scores:   {command.run / 'eval' / 'metrics.md'}\npictures: {command.run / 'eval' / 'contact_sheet.png'}")


def _render(command: Render) -> None:
    from mrgs.evaluation import render_run
    from mrgs.run import load_run

    folder = render_run(load_run(command.run), command.split, command.palette, command.frames, _counter("rendering"))
    print(f"images: {folder}")


def _demo(command: Demo) -> None:
    started = (command.output / "config.yaml").exists()
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
        progress=_counter("photographing"),
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


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Show what was mended or left out as one line each, and each once."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        if str(message) in shown:
            return
        shown.add(str(message))
        print(f"mrgs: note: {message}" if issubclass(category, MrgsWarning) else f"warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", MrgsWarning)
        warnings.showwarning = show
        yield


def _counter(verb: str) -> Callable[[int, int], None]:
    """A progress callback: one line that counts up on a terminal, a line at the end elsewhere."""

    def show(done: int, total: int) -> None:
        if sys.stdout.isatty():
            print(f"\r{verb} {done}/{total}", end="\n" if done == total else "", flush=True)
        elif done == total:
            print(f"{verb} {done}/{total}")

    return show


class _TrainingProgress:
    """The line that follows a training: step, time left, loss, °C, Gaussians, speed.

    The first Ctrl-C ends the training after the step, the second at once.
    """

    def __init__(self) -> None:
        self.unfinished = False
        self._interrupted = False
        self._span_c: float | None = None
        self._max_steps = 0
        self._first_step: int | None = None
        self._started = self._last_line = time.perf_counter()
        self._smoothed: dict[str, float] = {}
        self._terminal = sys.stdout.isatty()
        self._previous_handler: Any = None

    def __enter__(self) -> None:
        def stop(*_: Any) -> None:
            if self._interrupted:
                raise KeyboardInterrupt
            self._interrupted = True
            print("\nmrgs: stopping after this step; Ctrl-C again stops at once, without a checkpoint", file=sys.stderr)

        self._previous_handler = signal.signal(signal.SIGINT, stop)

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous_handler)
        if self._terminal and self._first_step is not None:
            print()

    def start(self, scene: Scene, config: TrainConfig) -> None:
        """Say what will be trained, and the memory that it will need."""
        from mrgs.training import estimate_bytes

        self._max_steps = config.max_steps
        self._span_c = None if scene.temperature is None else scene.temperature.span_c
        print(
            f"{scene.name}: {len(scene.train)} training views, {len(scene.eval)} held out, "
            f"{len(scene.points.positions):,} start points"
        )
        for note in scene.notes:  # what was mended has been shown already, in the same words
            warnings.warn(f"{scene.name}: {note}", MrgsWarning, stacklevel=2)
        print(
            f"{config.method}, {config.max_steps:,} steps, at most {config.densification.max_gaussians:,} Gaussians, "
            f"about {estimate_bytes(scene, config) / 2**30:.1f} GiB of memory"
        )
        print("The first run on a machine compiles the kernels, which takes up to a minute.", flush=True)

    def step(self, statistics: StepStatistics) -> bool:
        """Show a step; True asks the training to stop."""
        now = time.perf_counter()
        if self._first_step is None:
            # The first step compiles and reads; it would spoil the speed.
            self._first_step, self._started = statistics.step, now
        self._smooth("loss", statistics.loss)
        if statistics.thermal_error is not None:
            self._smooth("thermal", statistics.thermal_error)
        interval = 0.2 if self._terminal else PLAIN_LINE_EVERY_S
        self.unfinished = self._interrupted and statistics.step < self._max_steps
        if now - self._last_line >= interval or statistics.step == self._max_steps or self.unfinished:
            self._last_line = now
            line = self._line(statistics, now)
            if self._terminal:  # a line that wraps would stay
                line = f"\r{line[: shutil.get_terminal_size().columns - 1]}\033[K"
            print(line, end="" if self._terminal else "\n", flush=True)
        return self.unfinished

    def _line(self, statistics: StepStatistics, now: float) -> str:
        thermal = self._smoothed.get("thermal")
        parts = [f"step {statistics.step:,}/{self._max_steps:,}"]
        steps = statistics.step - (self._first_step or 0)
        speed = steps / (now - self._started) if steps > 0 and now > self._started else None
        if speed is not None:
            parts.append(f"{_duration((self._max_steps - statistics.step) / speed)} left")
        if "loss" in self._smoothed:
            parts.append(f"loss {self._smoothed['loss']:.4f}")
        if thermal is not None:
            parts.append(
                f"thermal {thermal:.4f} (no °C)" if self._span_c is None else f"thermal {thermal * self._span_c:.2f} °C"
            )
        parts.append(f"{statistics.gaussians:,} Gaussians")
        if speed is not None:
            parts.append(f"{speed:.1f} steps/s")
        return " | ".join(parts)

    def _smooth(self, name: str, value: float) -> None:
        """Mean over about the last fifty steps; values that are not finite are left out."""
        if value - value == 0:
            old = self._smoothed.get(name, value)
            self._smoothed[name] = old + 0.02 * (value - old)


def _duration(seconds: float) -> str:
    """Minutes and seconds, with hours in front where there are any."""
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}" if minutes >= 60 else f"{minutes}:{rest:02d}"


def _print_metrics(run: Run, metrics: Metrics) -> None:
    """The means, a line for each modality; SSIM's second convention is in the report only."""
    from mrgs.evaluation.report import COLUMNS, format_figure

    for title, figures in (("thermal", metrics.thermal), ("RGB", metrics.rgb), ("truth", metrics.truth or {})):
        shown = []
        for name, value in figures.items():
            if isinstance(value, float) and name != "ssim_pair_range":
                heading, _, unit = COLUMNS[name][0].partition(", ")
                shown.append(f"{heading} {format_figure(name, value)} {unit}".rstrip())
        if shown:
            print(f"{title + ':':9}{'  '.join(shown)}")
    print(f"{len(run.model.gaussians):,} Gaussians, {run.facts.train_seconds / 60:.1f} minutes of training")


if __name__ == "__main__":
    sys.exit(main())
