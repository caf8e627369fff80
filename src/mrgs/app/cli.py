"""The command line: argv, the terminal, exit codes. Everything else is a Python function
elsewhere."""

from __future__ import annotations

import math
import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mrgs.app.arguments import EXIT_USER_ERROR, parse
from mrgs.app.blocks import require_blocks, train_in_blocks
from mrgs.app.commands import (
    Check,
    CompareMethods,
    Demo,
    Eval,
    Export,
    Measure,
    Prepare,
    Render,
    Report,
    RunAll,
    Synth,
    Train,
    ViewRun,
    flag_of,
)
from mrgs.app.interrupts import BY_CTRL_C, Interrupted, interrupts
from mrgs.app.style import say_error
from mrgs.app.terminal import (
    PrepareProgress,
    TrainingProgress,
    counter,
    note_gpu,
    note_unfinished,
    plain_warnings,
    print_baking_loss,
    print_exported,
    print_figures,
    print_metrics,
    print_table,
    print_viewer_address,
    scene_if_there,
)
from mrgs.app.together import FollowingProgress, muted, processes_of, silenced
from mrgs.distributed.launch import Launch
from mrgs.errors import ConfigError, DeviceError, MrgsError, PeerError, TrainingError

if TYPE_CHECKING:
    from mrgs.distributed.processes import Processes
    from mrgs.runs.registry import Method
    from mrgs.scene import Scene
    from mrgs.training import StepStatistics, TrainConfig
    from mrgs.viewer import LiveView

EXIT_BAD_SCENE = 1

NO_MEMORY = ("can't allocate memory", "not enough memory")
"""What torch says, in a RuntimeError, when the system has no memory left."""

MAX_SYNTH_SEED = 1_000_000
"""Mitsuba takes 32 bits, and every view has a seed of its own."""


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code.

    0 is success, 1 a bad scene, 2 a user error, and 128 plus its number the signal that ended the
    command: 130 after Ctrl-C.
    """
    # Threads that spin while they wait cost more than they save on shared cores. Read once, when
    # torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    launch = Launch.from_environment()
    with interrupts, plain_warnings(), silenced(launch):
        try:
            status = _run(argv, launch)
            sys.stdout.flush()
            return status
        except PeerError:
            return EXIT_USER_ERROR
        except KeyboardInterrupt:
            with muted(launch):
                return _stopped()
        except Exception as error:
            if interrupts.received is not None:  # a library has turned it into an error of its own
                with muted(launch):
                    return _stopped()
            line = _line(error)
            if line is None:
                raise
            say_error(line)
            return EXIT_USER_ERROR


def _run(argv: list[str] | None, launch: Launch | None) -> int:
    """Run the command that the arguments name; returns the exit code."""
    with muted(launch):
        command = _parsed(sys.argv[1:] if argv is None else argv)
    if isinstance(command, (Train, CompareMethods)):
        with processes_of(launch) as processes:
            return _COOPERATIVE[type(command)](command, processes)
    if launch is not None and launch.world_size > 1:
        _refuse_processes(launch)
    handlers: dict[type, Callable[[Any], int | None]] = {
        RunAll: _run_all,
        Prepare: _prepare,
        Check: _check,
        Eval: _eval,
        Render: _render,
        ViewRun: _view,
        Measure: _measure,
        Export: _export,
        Report: _report,
        Demo: _demo,
        Synth: _synth,
    }
    return handlers[type(command)](command) or 0


def _refuse_processes(launch: Launch) -> None:
    """Say that a command works in one process.

    Raises:
        ConfigError: in the first process.
        PeerError: in the others.
    """
    if launch.is_first:
        raise ConfigError(
            "only mrgs train and mrgs compare run in several processes: leave torchrun out"
        )
    raise PeerError("the first process says why")


def _stopped() -> int:
    """Say that the command was interrupted; returns the exit code."""
    found = interrupts.received or BY_CTRL_C
    if found.message:
        print(found.message, file=sys.stderr)
    return found.status


def _line(error: Exception) -> str | None:
    """What the user can do about an error, on one line; None for an error in the program."""
    if isinstance(error, MrgsError):
        return f"{error}{_flags(error)}"
    if isinstance(error, OSError):  # what no part of the program expected of the system
        place = "" if error.filename is None else f"{error.filename}: "
        reason = error.strerror or error
        return f"{place}{reason}: check its permissions and the room on its disk"
    if isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and any(text in str(error) for text in NO_MEMORY)
    ):
        return (
            "the system has no memory left: close other programs, or use fewer Gaussians or a "
            "lower resolution (--max-gaussians, --resolution)"
        )
    return None


def _parsed(argv: Sequence[str]) -> Any:
    """The command, or a text that is printed to its end before the program exits."""
    try:
        return parse(argv)
    except SystemExit:
        sys.stdout.flush()
        raise


def _flags(error: MrgsError) -> str:
    """The command line's names of the parameters that an error is about."""
    flags = [flag_of(option) for option in error.options]
    return f" ({', '.join(flags)})" if flags else ""


def _prepare(command: Prepare) -> None:
    _without_blas_threads()
    from mrgs.pipeline.expect import expect_prepare
    from mrgs.prepare import prepare

    options = command.photo.options()
    progress = PrepareProgress(expect_prepare(command.photos, options))
    try:
        with progress:
            made = prepare(
                command.photos,
                command.scene,
                options,
                progress.step,
                progress.stage,
            )
            progress.end(made)
    except KeyboardInterrupt:
        print("intermediate results are kept; re-run the same command to resume")
        raise
    print(
        f"scene: {made.scene}\nopen:  {made.page}\nnext:  mrgs train {shlex.quote(str(made.scene))}"
    )


def _without_blas_threads() -> None:
    """Keep BLAS single-threaded: for thousands of small matrices threads only wait for each other.

    Must run before NumPy and SciPy are loaded.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _check(command: Check) -> int:
    _without_blas_threads()
    from mrgs.check import check_scene

    with PrepareProgress() as progress:
        found = check_scene(command.scene, progress.step)
    for line in found.lines:
        print(line)
    for problem in found.problems:
        print(f"{problem.severity}: {problem.text} {problem.remedy}".rstrip())
    print(f"open: {found.page}")
    return 0 if found.usable else EXIT_BAD_SCENE


def _train(command: Train, processes: Processes | None) -> int:
    from mrgs.runs.open import method_of
    from mrgs.runs.registry import find_method
    from mrgs.system.gpu import HOST, choose_device
    from mrgs.training.run_folder import RunFolder

    if processes is not None:
        processes.connect()
    leads = processes is None or processes.is_first
    output = _output(command)
    goes_on = command.resume and leads and command.blocks is None
    name = method_of(RunFolder(output)).name if goes_on else command.method
    method = find_method(name if processes is None else processes.share_json(name))
    _require_possible(command, method, processes)
    require_blocks(command)
    together = 1 if processes is None or command.blocks is not None else processes.count
    batch = command.batch or together
    config = _configured(command, method, command.max_steps, batch)
    device = command.device if method.uses_gpu else "cpu"
    if command.minutes is not None:
        steps = _steps_in_time(command, method, config, device)
        config = _configured(command, method, steps, batch)
        if config.max_steps != steps:
            raise ConfigError(
                f"--minutes chooses the steps: leave max_steps out of {command.config}"
            )
    chosen = choose_device(device)
    if command.blocks is not None:
        train_in_blocks(command, output, config, device, processes)
        return 0
    progress: TrainingProgress | FollowingProgress = FollowingProgress()
    if leads:
        note_gpu(chosen)
        progress = TrainingProgress(compiles=chosen == HOST and not command.plain)
    shows = command.view and leads
    with progress, _live_view(output, command.port) if shows else nullcontext() as live:
        method.train(
            command.scene,
            output,
            config,
            resume=command.resume,
            accept_changes=command.accept_changes,
            device=device,
            plain=command.plain,
            tensorboard=command.tensorboard,
            **_hooks(progress, live),
            **({"processes": processes} if processes and method.has_gaussians else {}),
        )
    if isinstance(progress, TrainingProgress):
        _say_what_next(command, output, progress, processes)
    elif interrupts.received is not None:
        raise Interrupted
    return 0


def _configured(command: Train, method: Method, max_steps: int | None, batch: int) -> Any:
    return method.configure(
        command.preset,
        max_steps=max_steps,
        max_gaussians=command.max_gaussians,
        resolution=command.resolution,
        seed=command.seed,
        batch=batch,
        changes="" if command.config is None else _read_text(command.config),
        source=str(command.config),
    )


def _steps_in_time(command: Train, method: Method, config: Any, device: str) -> int:
    """Measure how fast the training is here, and say how many steps it gets."""
    from mrgs.pipeline.time_limit import measure_pace, steps_within

    assert command.minutes is not None
    print("measuring the pace of a few steps", flush=True)
    started = time.monotonic()
    pace = measure_pace(method, command.scene, config, device=device, plain=command.plain)
    left_s = command.minutes * 60 - (time.monotonic() - started)
    most = config.densification.max_gaussians if method.has_gaussians else None
    steps = steps_within(left_s, pace, most)
    print(f"{steps:,} steps fit into {command.minutes:g} minutes", flush=True)
    return steps


def _require_possible(command: Train, method: Method, processes: Processes | None) -> None:
    """Options that the method can follow.

    Raises:
        ConfigError: one needs Gaussians, and there are none.
        DeviceError: the method cannot use a GPU.
    """
    needs = {"--view": command.view, "--max-gaussians": command.max_gaussians}
    for option, value in {**needs, "--batch": command.batch}.items():
        if value and not method.has_gaussians:
            raise ConfigError(
                f"{option} needs a method with Gaussians, and {method.name} has none: leave it out"
            )
    if command.minutes is not None:
        if command.resume or command.max_steps is not None:
            raise ConfigError("--minutes chooses the steps: leave --resume and --max-steps out")
        if processes is not None and processes.count > 1:
            raise ConfigError("--minutes measures one process: under torchrun, use --max-steps")
        if not 0 < command.minutes < math.inf:
            raise ConfigError(f"--minutes must be above 0, not {command.minutes:g}")
    if not method.has_gaussians and processes is not None and processes.count > 1:
        raise ConfigError(f"{method.name} trains in one process: leave torchrun out")
    if command.accept_changes and not command.resume:
        raise ConfigError("--accept-changes needs --resume: a new run has nothing to compare with")
    if command.device == "cuda" and not method.uses_gpu:
        raise DeviceError(f"{method.name} works on the CPU alone: leave --device out")


def _output(command: Train) -> Path:
    """The run's folder."""
    folder = command.scene.parent if command.scene.is_file() else command.scene
    return command.output or Path("runs") / f"{folder.resolve().name}-{command.method}"


def _say_what_next(
    command: Train, output: Path, progress: TrainingProgress, processes: Processes | None
) -> None:
    """How to go on with an unfinished run, or what to do with a finished one."""
    if progress.unfinished or (processes is not None and processes.stopped):
        go_on = shlex.join(
            ["mrgs", "train", str(command.scene), "--output", str(output), "--resume"]
        )
        print(f"checkpoint saved; resume with: {go_on}", file=progress.sink)
        if progress.unfinished:
            raise Interrupted
        return  # another process was asked to stop
    quoted = shlex.quote(str(output))
    print(f"run:  {output}\nnext: mrgs eval {quoted}\n      mrgs render {quoted}")


def _live_view(output: Path, port: int) -> LiveView:
    from mrgs.viewer import LiveView

    return LiveView(output, port=port, on_ready=print_viewer_address)


def _hooks(progress: TrainingProgress | FollowingProgress, live: LiveView | None) -> dict[str, Any]:
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
        if command.scene is not None:
            raise ConfigError("with --renders, give the scene instead of the run and omit --scene")
        _eval_renders(command, command.renders)
        return
    if command.resolution is not None:
        raise ConfigError(
            "--resolution needs --renders: a run is scored at its training resolution"
        )
    from mrgs.evaluation import evaluate_run
    from mrgs.runs.open import open_run

    run = open_run(command.run, command.scene, command.device)
    with counter("scoring") as progress:
        metrics = evaluate_run(run, command.lpips_weights, progress)
    print_metrics(run, metrics)
    print(
        f"scores:   {command.run / 'eval' / 'metrics.md'}\npictures: "
        f"{command.run / 'eval' / 'contact_sheet.png'}"
    )


def _eval_renders(command: Eval, folder: Path) -> None:
    from mrgs.evaluation.renders import evaluate_renders

    with counter("scoring") as progress:
        metrics = evaluate_renders(
            command.run,
            folder,
            resolution=command.resolution,
            lpips_weights=command.lpips_weights,
            progress=progress,
        )
    print_figures(metrics)
    print(
        f"scores:   {folder / 'eval' / 'metrics.md'}\npictures: "
        f"{folder / 'eval' / 'contact_sheet.png'}"
    )


def _compare(command: CompareMethods, processes: Processes | None) -> int:
    from mrgs.comparison import Options, Variant, compare

    if processes is not None and not processes.is_first:
        from mrgs.comparison.shared import follow_jobs

        follow_jobs(processes, command.lpips_weights, command.device)
        return 0
    variants = _named_paths("--variants", command.variants, "wide=wide.yaml")
    options = Options(
        command.methods,
        tuple(
            Variant.from_text(name, _read_text(file), str(file)) for name, file in variants.items()
        ),
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
            renders=_named_paths("--renders", command.renders, "ThermoNeRF=renders/thermonerf"),
            jobs=command.jobs,
            device=command.device,
            lpips_weights=command.lpips_weights,
            say=lambda line: print(line, flush=True),
            processes=processes,
        )
    except KeyboardInterrupt:
        print("interrupted runs keep their checkpoints; re-run the same command to resume")
        raise
    for table in comparison.tables:
        print_table(table)
    print(f"tables: {command.output / 'tables'}\nfigures: {command.output / 'figures'}")
    if comparison.failures:
        name, reason = next(iter(comparison.failures.items()))
        raise TrainingError(
            f"{len(comparison.failures)} rows of the tables have no scores, first {name} "
            f"({reason}); fix the cause and re-run the same command"
        )
    return 0


def _named_paths(option: str, pairs: tuple[str, ...], example: str) -> dict[str, Path]:
    """Paths by name, from NAME=PATH."""
    named = {}
    for pair in pairs:
        name, separator, path = pair.partition("=")
        if not separator or not name or not path:
            raise ConfigError(f"{option} {pair}: use NAME=PATH, for example {example}")
        if name in named:
            raise ConfigError(f"{option} {pair}: {name} is used twice; choose another name")
        named[name] = Path(path)
    return named


def _render(command: Render) -> None:
    from mrgs.evaluation import render_run
    from mrgs.runs.open import open_run

    run = open_run(command.run, command.scene, command.device)
    with counter("rendering") as progress:
        folder = render_run(run, command.split, command.palette, command.frames, progress)
    print(f"images: {folder}")


def _view(command: ViewRun) -> None:
    from mrgs.runs.open import load_run
    from mrgs.viewer import view

    run = load_run(command.run, command.scene, "cpu")
    note_unfinished(run)
    view(run, scene_if_there(run), command.host, command.port, on_ready=print_viewer_address)


def _measure(command: Measure) -> None:
    from mrgs.app.measuring import measure

    measure(command)


def _export(command: Export) -> None:
    from mrgs.export import export
    from mrgs.pipeline.expect import expect_export
    from mrgs.runs.open import load_run
    from mrgs.system.memory import release_when_freed

    release_when_freed()
    run = load_run(command.run, command.scene, "cpu")
    note_unfinished(run)
    folder = command.output or command.run / "export"
    maps = command.maps()
    scene = run.load_scene()
    with counter("export", expect_export(run, scene, command.format)) as progress:
        paths = export(
            run,
            scene,
            command.format,
            folder,
            command.palette,
            command.range_c,
            maps,
            on_baked=print_baking_loss,
            progress=progress,
        )
    print_exported(folder, paths)


def _report(command: Report) -> None:
    from mrgs.pipeline.expect import expect_report
    from mrgs.report import write_report
    from mrgs.report.pdf import require_weasyprint, write_pdf
    from mrgs.runs.open import load_run

    if command.pdf:
        require_weasyprint()
    run = load_run(command.run, command.scene, command.device)
    note_unfinished(run)
    _state_survey(command)
    target = command.output or command.run / "report.html"
    scene = run.load_scene()
    with counter("report", expect_report(run, scene)) as progress:
        path = write_report(run, scene, target, progress, command.language)
    print(f"report: {path}")
    if command.pdf:
        print(f"pdf: {write_pdf(path, path.with_suffix('.pdf'))}")


def _state_survey(command: Report) -> None:
    """Keep what the options state in the run's folder; a survey to fill in where there is none."""
    from mrgs.survey import SURVEY_FILE, read_survey, write_survey

    own = command.run / SURVEY_FILE
    if command.survey is not None and not command.survey.is_file():
        raise ConfigError(f"--survey {command.survey}: there is no such file")
    if command.survey is None and not command.set and own.exists():
        return
    survey = read_survey(command.survey or own).stating(command.set, "--set")
    write_survey(own, survey)
    if not survey:
        print(f"survey: fill in {own}, and write the report again")


def _run_all(command: RunAll) -> None:
    _without_blas_threads()
    from mrgs.app.pipeline import run_everything

    run_everything(command)


def _demo(command: Demo) -> None:
    _without_blas_threads()
    from mrgs.app.pipeline import run_demo

    run_demo(command, _bundled_scene())


def _synth(command: Synth) -> None:
    try:
        from mrgs_synth import synthesize
    except ModuleNotFoundError as error:
        if error.name != "mrgs_synth":
            raise
        raise ConfigError(
            "the scene generator comes with a source checkout only: run `pip install -e "
            "'.[synth]'` there"
        ) from None

    if not 0 <= command.seed <= MAX_SYNTH_SEED:
        raise ConfigError(f"the seed must be from 0 to {MAX_SYNTH_SEED:,}, not {command.seed}")
    if command.scene == "solar-plant":
        _synth_plant(command)
        return
    with counter("rendering") as progress:
        synthesize(
            command.output,
            scene=command.scene,
            width=command.width,
            height=command.height,
            train_views=40 if command.train_views is None else command.train_views,
            eval_views=command.eval_views,
            samples=command.samples,
            seed=command.seed,
            bands=["nir"] if command.nir else [],
            progress=progress,
        )
    print(f"scene: {command.output}")


def _synth_plant(command: Synth) -> None:
    from mrgs_synth.solar_plant import PlantOptions, synthesize_plant

    if command.nir or command.train_views is not None:
        raise ConfigError(
            "solar-plant has no near-infrared photos, and as many training views as its overlap "
            "asks for: leave out --nir and --train-views"
        )
    options = PlantOptions(
        command.rows, command.modules, command.overlap, command.gps_noise,
        command.eval_views, command.width, command.height, command.seed,
    )  # fmt: skip
    with counter("rendering") as progress:
        views = synthesize_plant(command.output, options, progress)
    print(f"scene: {command.output} ({views} training views)")


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path}: cannot be read as text ({getattr(error, 'strerror', 'not UTF-8')})"
        ) from error


def _bundled_scene() -> Path:
    """Folder of the bundled scene, in the installed package or the checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "examples", package.parents[1] / "examples"):
        if (folder / "tabletop" / "transforms.json").is_file():
            return folder / "tabletop"
    raise ConfigError(
        "the bundled scene is not installed; run `mrgs demo` from a checkout, or reinstall mrgs"
    )


_COOPERATIVE: dict[type, Callable[[Any, Processes | None], int]] = {
    Train: _train,
    CompareMethods: _compare,
}
"""Commands that several processes can share."""


if __name__ == "__main__":
    sys.exit(main())
