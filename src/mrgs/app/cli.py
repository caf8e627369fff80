"""The command line: argv, the terminal, exit codes. All else is elsewhere."""

from __future__ import annotations

import difflib
import inspect
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial, reduce
from importlib.metadata import version
from operator import or_
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from mrgs.app import commands
from mrgs.app.commands import COMMANDS
from mrgs.app.interrupts import BY_CTRL_C, interrupts
from mrgs.app.progress import PrepareProgress, progress_bar
from mrgs.app.terminal import (
    cropped,
    flags_of,
    note_unfinished,
    plain_warnings,
    print_baking_loss,
    print_error,
    print_exported,
    print_figures,
    print_metrics,
    print_viewer_address,
    read_text,
    say,
    scene_if_there,
    styled,
)
from mrgs.app.training import train
from mrgs.errors import ConfigError, MrgsError, TrainingError
from mrgs.runs.registry import imported
from mrgs.system.wording import quoted

if TYPE_CHECKING:
    from mrgs.runs.open import Run
    from mrgs.survey import Survey
    from mrgs_compare.table import Table

EXIT_BAD_SCENE = 1

MAX_SYNTH_SEED = 1_000_000
"""Mitsuba takes 32 bits, and every view has a seed of its own."""

NO_MEMORY = ("can't allocate memory", "not enough memory")
"""Texts of torch's RuntimeError when the system has no memory left."""

EXIT_USER_ERROR = 2

_CONFIG = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff)
_COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")


def parse(argv: Sequence[str]) -> Any:
    """The command, one of the types in ``COMMANDS``, with its options. SystemExit with 0 after a
    help text, a version or a completion script was printed, with 2 after an error."""
    first = argv[0] if argv else "--help"
    if first in COMMANDS:
        return tyro.cli(COMMANDS[first], prog=f"mrgs {first}", args=argv[1:], config=_CONFIG)
    if first.startswith(_COMPLETION):
        kinds = [
            Annotated[kind, tyro.conf.subcommand(name, description=_summary(kind))]
            for name, kind in COMMANDS.items()
        ]
        any_of_them: Any = reduce(or_, kinds)
        return tyro.cli(any_of_them, prog="mrgs", args=argv, config=_CONFIG)
    if first in ("-h", "--help", "help"):
        print(_overview())
        raise SystemExit(0)
    if first == "--version":
        print(f"mrgs {version('mrgs')}")
        raise SystemExit(0)
    near = difflib.get_close_matches(first, COMMANDS, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]}?" if near else "`mrgs` lists the commands"
    is_option = first.startswith("-")
    print_error(
        f"{first} must follow a command; `mrgs` lists them"
        if is_option
        else f"unknown command {first!r}; {hint}"
    )
    raise SystemExit(EXIT_USER_ERROR)


def _overview() -> str:
    """All commands, one line each."""
    names = "\n".join(
        f"  {styled(f'{name:9}', 'bold', sys.stdout)}{_summary(command)}"
        for name, command in COMMANDS.items()
    )
    return (
        f"One 3D model in colour and in °C from RGB and thermal photos.\n\n"
        f"usage: mrgs COMMAND [OPTIONS]\n\n{names}\n\n"
        f"mrgs COMMAND --help lists the options of a command, mrgs --version prints the version."
    )


def _summary(command: type) -> str:
    """The first paragraph of a command's help."""
    return (inspect.getdoc(command) or "").partition("\n\n")[0].replace("\n", " ")


def main(argv: list[str] | None = None) -> int:
    """Run a command; returns the exit code.

    0 is success, 1 a bad scene, 2 a user error, and 128 plus its number the signal that ended the
    command: 130 after Ctrl-C.
    """
    # Threads that spin while they wait cost more than they save on shared cores. Read once, when
    # torch is loaded.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with interrupts, plain_warnings():
        try:
            status = _run(argv)
            sys.stdout.flush()
            return status
        except KeyboardInterrupt:
            return _stopped()
        except Exception as error:
            if interrupts.received is not None:  # a library has turned it into an error of its own
                return _stopped()
            line = _line(error)
            if line is None:
                raise
            print_error(line)
            return EXIT_USER_ERROR


def _run(argv: list[str] | None) -> int:
    """Run the command that the arguments name; returns the exit code."""
    try:
        command = parse(sys.argv[1:] if argv is None else argv)
    finally:
        sys.stdout.flush()
    if isinstance(command, (commands.RunAll, commands.Demo, commands.Prepare, commands.Check)):
        # For thousands of small matrices BLAS threads only wait for each other. Read once, when
        # NumPy is loaded.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    follow_pipeline = imported("mrgs.app.pipeline", "follow_pipeline")
    handlers: dict[type, Callable[[Any], int | None]] = {
        commands.RunAll: lambda given: follow_pipeline(
            given.photos, given, given.photo.options(), given.yes, given.flat_field
        ),
        commands.Read: imported("mrgs.app.reading", "read"),
        commands.Prepare: _prepare,
        commands.Check: _check,
        commands.Train: train,
        commands.CompareMethods: compare,
        commands.Eval: _eval,
        commands.Render: _render,
        commands.ViewRun: _view,
        commands.Measure: imported("mrgs.app.measuring", "measure"),
        commands.Export: _export,
        commands.Report: _report,
        commands.Diff: _diff,
        commands.ListModules: _modules,
        commands.Demo: lambda given: follow_pipeline(
            _bundled_scene(), given, commands.PhotoOptions().options(), True
        ),
        commands.Synth: _synth,
    }
    return handlers[type(command)](command) or 0


def _stopped() -> int:
    """Print that the command was interrupted; returns the exit code."""
    found = interrupts.received or BY_CTRL_C
    if found.message:
        print(found.message, file=sys.stderr)
    return found.status


def _line(error: Exception) -> str | None:
    """What the user can do about an error, on one line; None for an error in the program."""
    if isinstance(error, MrgsError):
        return f"{error}{flags_of(error)}"
    if isinstance(error, OSError):  # not expected by any part of the program
        place = "" if error.filename is None else f"{error.filename}: "
        reason = error.strerror or error
        return f"{place}{reason}: check its permissions and the room on its disk"
    fewer = "fewer Gaussians or a lower resolution (--max-gaussians, --resolution)"
    lacks_any = isinstance(error, MemoryError)
    if isinstance(error, RuntimeError):
        from mrgs.system.gpu import lacks_memory

        if lacks_memory(error):
            return f"the GPU's memory does not suffice: use the CPU (--device cpu), {fewer}"
        lacks_any = any(text in str(error) for text in NO_MEMORY)
    if lacks_any:
        return f"the system has no memory left: close other programs, or use {fewer}"
    return None


def _prepare(command: commands.Prepare) -> None:
    from mrgs.pipeline.forecast import expect_prepare
    from mrgs.prepare import prepare

    options = command.photo.options()
    progress = PrepareProgress()
    try:
        with progress:
            progress.forecast = expect_prepare(command.photos, options, progress.step)
            made = prepare(command.photos, command.scene, options, progress.step, progress.stage)
            progress.end(made)
    except KeyboardInterrupt:
        print("intermediate results are kept; re-run the same command to resume")
        raise
    say(f"scene: {made.scene}", f"open:  {made.page}", f"next:  mrgs train {quoted(made.scene)}")


def _check(command: commands.Check) -> int:
    from mrgs.prepare.page.check import check_scene

    with PrepareProgress() as progress:
        found = check_scene(command.scene, progress.step)
    problems = (f"{each.severity}: {each.text} {each.remedy}" for each in found.problems)
    say(*found.lines, *map(str.rstrip, problems), f"open: {found.page}")
    return 0 if found.usable else EXIT_BAD_SCENE


def _eval(command: commands.Eval) -> None:
    if command.renders is not None:
        if command.scene is not None:
            raise ConfigError("with --renders, give the scene instead of the run and omit --scene")
        from mrgs.evaluation.renders import evaluate_renders

        folder = command.renders
        with progress_bar("scoring") as progress:
            metrics = evaluate_renders(
                command.run,
                folder,
                resolution=command.resolution,
                lpips_weights=command.lpips_weights,
                progress=progress,
            )
        print_figures(metrics)
    elif command.resolution is not None:
        raise ConfigError(
            "--resolution needs --renders: a run is scored at its training resolution"
        )
    else:
        from mrgs.evaluation import evaluate_run
        from mrgs.runs.open import open_run

        folder, run = command.run, open_run(command.run, command.scene, command.device)
        with progress_bar("scoring") as progress:
            metrics = evaluate_run(run, command.lpips_weights, progress)
        print_metrics(run, metrics)
    say(f"scores:   {folder / 'eval/metrics.md'}", f"pictures: {folder / 'eval/contact_sheet.png'}")


def _render(command: commands.Render) -> None:
    from mrgs.evaluation import render_run
    from mrgs.evaluation.score_run import PathOptions
    from mrgs.runs.open import Run, open_run

    options = {name: getattr(command, name) for name in ("frames", "width", "fps")}
    given = {name: value for name, value in options.items() if value is not None}
    given |= {"scale_bar": True} if command.scale_bar else {}
    path = PathOptions(**given) if given else None
    run = open_run(command.run, command.scene, command.device)
    if isinstance(run, Run):
        run = cropped(run, command.crop)
    elif command.crop is not None:
        raise ConfigError(f"--crop: a run of {run.config.method} has no Gaussians")
    with progress_bar("rendering") as progress:
        folder = render_run(run, command.split, command.palette, path, progress)
    say(f"images: {folder}", *(f"video:  {film}" for film in sorted(folder.glob("*.mp4"))))


def _view(command: commands.ViewRun) -> None:
    from mrgs.runs.open import load_run
    from mrgs.viewer import view

    run = cropped(load_run(command.run, command.scene, "cpu"), command.crop)
    note_unfinished(run)
    view(run, scene_if_there(run), command.host, command.port, on_ready=print_viewer_address)


def _export(command: commands.Export) -> None:
    from mrgs.export import export
    from mrgs.maps.options import MapOptions, parse_plane
    from mrgs.pipeline.forecast import expect_export
    from mrgs.runs.open import load_run
    from mrgs.system.memory import release_when_freed

    release_when_freed()
    run = cropped(load_run(command.run, command.scene, command.device), command.crop)
    note_unfinished(run)
    folder = command.output or command.run / "export"
    plane = None if command.plane is None else parse_plane(*command.plane)
    maps = MapOptions(plane, command.pixel_size, command.crs)
    scene = run.load_scene()
    with progress_bar("export", expect_export(run, scene, command.format)) as progress:
        write = partial(export, run, scene, command.format, folder, command.palette)
        paths = write(command.range_c, maps, on_baked=print_baking_loss, progress=progress)
    print_exported(folder, paths)


def _report(command: commands.Report) -> None:
    from mrgs.pipeline.forecast import expect_report
    from mrgs.report import report_run
    from mrgs.report.copies import require_packages
    from mrgs.runs.open import load_run

    require_packages(command.pdf, command.docx)
    run = load_run(command.run, command.scene, command.device)
    note_unfinished(run)
    stated = _stated_survey(command)
    run, scene = _cropped_as_stated(run, command, stated), run.load_scene()
    _keep_survey(command.run, stated)
    with progress_bar("report", expect_report(run, scene)) as progress:
        write = partial(report_run, run, command.output, command.language, command.pdf)
        page = write(docx=command.docx, appendix=command.appendix, scene=scene, progress=progress)
    others = [name for name in ("pdf", "docx") if getattr(command, name)]
    say(f"report: {page}", *(f"{name}: {page.with_suffix(f'.{name}')}" for name in others))


def _diff(command: commands.Diff) -> None:
    from mrgs.report.changes import HEADINGS, diff_runs
    from mrgs.report.copies import require_packages
    from mrgs.runs.open import load_run
    from mrgs.system.wording import aligned, counted, number_text

    require_packages(command.pdf)
    first, second = (
        cropped(load_run(path, None, command.device)) for path in (command.first, command.second)
    )
    for run in (first, second):
        note_unfinished(run)
    found = diff_runs(first, second, relative=command.relative, least_k=command.least)
    changes, marks = found.rows()
    for rows in filter(None, (changes, marks)):
        print("\n".join(aligned([[*HEADINGS, ""], *rows], {0, 1, len(HEADINGS)})))
    common = number_text(found.common, 2, sign=True)
    said = "subtracted from" if found.relative else "part of (without it: --relative)"
    say(f"{counted(len(changes), 'change')}; common change {common} K, {said} all ΔT")
    folder = command.output or command.second / "diff"
    print_exported(folder, found.write(folder, command.language, command.pdf))


def _modules(command: commands.ListModules) -> None:
    from mrgs.report.copies import require_packages
    from mrgs.report.modules import module_table
    from mrgs.runs.open import load_run
    from mrgs.system.wording import counted

    require_packages(command.pdf)
    try:
        width, height = (float(side) for side in command.module.split("x"))
    except ValueError:
        raise ConfigError(f"--module {command.module}: write it as 1.05x1.75, in metres") from None
    run = cropped(load_run(command.run, command.scene, command.device))
    note_unfinished(run)
    table = module_table(run, (width, height), command.power, command.yield_kwh)
    say(f"{counted(len(table.rows), 'module')}, {len(table.findings)} with findings")
    folder = command.output or command.run / "modules"
    print_exported(folder, table.write(folder, command.language, command.pdf))


def _stated_survey(command: commands.Report) -> Survey | None:
    """The survey of the run's folder with what the options state; None if they state nothing."""
    from mrgs.report.sections import read_logo
    from mrgs.survey import SURVEY_FILE, read_survey

    if command.survey is None and not command.set:
        return None
    if command.survey is not None and not command.survey.is_file():
        raise ConfigError(f"--survey {command.survey}: there is no such file")
    stated = read_survey(command.survey or command.run / SURVEY_FILE)
    if command.survey is not None and stated.logo is not None:
        stated = replace(stated, logo=str(command.survey.absolute().parent / stated.logo))
    stated = stated.stating(command.set, "--set")
    if stated.logo and any(each.startswith("logo=") for each in command.set):
        stated = replace(stated, logo=str(Path(stated.logo).absolute()))
    read_logo(stated, command.run)
    return stated


def _cropped_as_stated(run: Run, command: commands.Report, stated: Survey | None) -> Run:
    """The run in the box that the options state, or else in that of the survey in its folder."""
    sets_box = command.survey is not None or any(each.startswith("crop") for each in command.set)
    if stated is None or not sets_box:
        return cropped(run)
    return cropped(run, *stated.kept) if any(stated.kept) else run


def _keep_survey(folder: Path, stated: Survey | None) -> None:
    """Write the stated survey to the run's folder, or an empty one to fill in."""
    from mrgs.survey import SURVEY_FILE, survey_of, write_survey

    own = folder / SURVEY_FILE
    if stated is not None:
        write_survey(own, stated)
    elif not own.exists():
        survey_of(folder)
        print(f"survey: fill in {own}, and write the report again")


def compare(command: commands.CompareMethods) -> None:
    """Train and score methods side by side."""
    with _from_checkout(
        "mrgs_compare",
        "mrgs compare is a package of its own: run `pip install ./plugins/compare` in a checkout",
    ):
        from mrgs_compare import Options, Variant
        from mrgs_compare import compare as compare_methods
        from mrgs_compare.table import to_plain

    variants = _named_paths("--variants", command.variants, "wide=wide.yaml")
    given = (Variant.from_text(name, read_text(file), str(file)) for name, file in variants.items())
    options = Options(
        command.methods,
        tuple(given),
        command.neighbours,
        command.seeds,
        command.preset,
        command.max_steps,
        command.max_gaussians,
        command.resolution,
    )
    try:
        comparison = compare_methods(
            command.scenes,
            command.output,
            options,
            renders=_named_paths("--renders", command.renders, "ThermoNeRF=renders/thermonerf"),
            jobs=command.jobs,
            device=command.device,
            lpips_weights=command.lpips_weights,
            say=say,
        )
    except KeyboardInterrupt:
        print("interrupted runs keep their checkpoints; re-run the same command to resume")
        raise
    for table in comparison.tables:
        print("\n" + to_plain(table), end="")
    for line in how_to_read(comparison.tables, command.seeds):
        print(line)
    say(f"tables: {command.output / 'tables'}", f"figures: {command.output / 'figures'}")
    if comparison.failures:
        name, reason = next(iter(comparison.failures.items()))
        raise TrainingError(
            f"{len(comparison.failures)} rows of the tables have no scores, first {name} "
            f"({reason}); fix the cause and re-run the same command"
        )


def how_to_read(tables: Sequence[Table], seeds: int) -> list[str]:
    """What the signs of printed tables mean, and whether differences may be by chance."""
    from mrgs_compare.table import marks

    lines = []
    if any(any(row) for table in tables for row in marks(table)):
        lines.append("*: the best, +: the second best of what was measured here")
    if tables and seeds == 1:
        lines.append("one seed: small differences may be by chance; --seeds 3 shows the spread")
    return lines


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


@contextmanager
def _from_checkout(package: str, remedy: str) -> Iterator[None]:
    """For imports from a package that comes with a source checkout only; ConfigError without it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name != package:
            raise
        raise ConfigError(remedy) from None


def _bundled_scene() -> Path:
    """Folder of the bundled scene, in the installed package or the checkout."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "examples", package.parents[1] / "examples"):
        if (folder / "tabletop" / "transforms.json").is_file():
            return folder / "tabletop"
    raise ConfigError(
        "the bundled scene is not installed; run `mrgs demo` from a checkout, or reinstall mrgs"
    )


def _synth(command: commands.Synth) -> None:
    with _from_checkout(
        "mrgs_synth",
        "the scene generator needs a source checkout: run `pip install -e '.[synth]'` there",
    ):
        from mrgs_synth import synthesize
        from mrgs_synth.solar_plant import PlantOptions, synthesize_plant

    if not 0 <= command.seed <= MAX_SYNTH_SEED:
        raise ConfigError(f"the seed must be from 0 to {MAX_SYNTH_SEED:,}, not {command.seed}")
    chosen = command.nir or command.camera != "gaussian" or command.train_views is not None
    if command.scene == "solar-plant" and chosen:
        raise ConfigError(
            "solar-plant has no near-infrared photos, a camera of its own, and as many training "
            "views as its overlap asks for: leave out --nir, --camera and --train-views"
        )
    with progress_bar("rendering") as progress:
        if command.scene == "solar-plant":
            options = PlantOptions(
                command.rows, command.modules, command.overlap, command.gps_noise,
                command.eval_views, command.width, command.height, command.seed,
            )  # fmt: skip
            views = synthesize_plant(command.output, options, progress)
        else:
            views = 40 if command.train_views is None else command.train_views
            synthesize(
                command.output, scene=command.scene, width=command.width, height=command.height,
                train_views=views, eval_views=command.eval_views, samples=command.samples,
                seed=command.seed, bands=["nir"] if command.nir else [], camera=command.camera,
                progress=progress,
            )  # fmt: skip
    print(f"scene: {command.output} ({views} training views)")


if __name__ == "__main__":
    sys.exit(main())
