"""``mrgs run`` and ``mrgs demo`` at the terminal: the plan, progress, questions, results."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from mrgs.app.commands import Demo, RunAll
from mrgs.app.interrupts import Interrupted, interrupts
from mrgs.app.progress import PrepareProgress, TrainingProgress, duration, progress_bar
from mrgs.app.terminal import flags_of, print_note, styled
from mrgs.errors import MrgsError, printable
from mrgs.pipeline import Monitor, PipelinePlan, PipelineResults, PlannedStage, run_pipeline
from mrgs.pipeline.run import default_output
from mrgs.prepare import PrepareOptions, StageReport
from mrgs.prepare.contract import SeveralCamerasError
from mrgs.run_files.folder import RunConfig
from mrgs.run_files.record import StepStatistics
from mrgs.scene import Scene
from mrgs.system.disk import free_disk
from mrgs.system.threads import waiting_factor
from mrgs.system.wording import counted, quoted

GIGABYTE = 1e9
BUSY = 1.3
"""Slowdown by other programs above which the plan mentions it, a factor."""


def follow_pipeline(
    source: Path,
    command: RunAll | Demo,
    options: PrepareOptions,
    yes: bool,
    flat_field: Path | None = None,
) -> None:
    """Run a pipeline, show how far it is, and print what to open; of photos of several cameras one
    after another, whatever fails of one. Errors as for ``run_pipeline``."""
    terminal, started = PipelineTerminal(yes), time.perf_counter()
    try:
        results = run_pipeline(
            source,
            command.output,
            quality=command.quality,
            options=options,
            device=command.device,
            monitor=terminal,
            flat_field=flat_field,
        )
    except SeveralCamerasError as error:
        facts_of_one: list[object] = [flat_field, options.thermal_fov_deg, options.thermal_camera]
        facts_of_one += [options.poses, options.known_distance, options.control]
        if not isinstance(command, RunAll) or any(each is not None for each in facts_of_one):
            raise
        terminal.pause()
        print_note(f"photos of several cameras, each for a model: {', '.join(error.cameras)}")
        failed: list[MrgsError] = []
        choices = [replace(options, camera=camera) for camera in error.cameras]
        for chosen, output in zip(choices, _folders(source, command.output, choices), strict=True):
            own = replace(command, output=output)
            try:
                follow_pipeline(source, own, chosen, yes, flat_field)
            except MrgsError as stopped:
                print_note(f"{chosen.camera}: {stopped}{flags_of(stopped)}", "warning")
                failed.append(stopped)
        if failed:
            raise failed[0] from None
        return
    except KeyboardInterrupt:
        terminal.pause()
        print_note("results so far are kept; re-run the same command to resume")
        raise
    finally:
        terminal.pause()
    print(f"finished in {duration(time.perf_counter() - started)}\n")
    print(what_to_open(results))


def _folders(
    source: Path, output: Path | None, choices: Sequence[PrepareOptions]
) -> Iterator[Path | None]:
    """The folders of the results for each camera; None for the default. Names that differ only in
    punctuation or case would share one, so the second and later ones are numbered."""
    known: Counter[str] = Counter()
    for options in choices:
        name, default = options.name_of(source), default_output(source, options)
        known[name.casefold()] += 1
        number = known[name.casefold()]
        if output is not None:
            yield output / (f"{name}-{number}" if number > 1 else name)
        else:
            yield default.with_name(f"{name}-{number}-mrgs") if number > 1 else None


def what_to_open(results: PipelineResults) -> str:
    """The last lines: the files to open, and a command to continue with."""
    files = {
        results.report: "measurements, hottest and coldest places, limits",
        results.page: "the model in your browser: colour, temperature under the cursor",
        results.contact_sheet: "photos beside renderings of the same views",
        results.scene_page: "pairs, cameras and temperatures that were found",
        results.renders: "images, temperatures as float32 TIFF, depth",
        results.exports: "point cloud, mesh and splats for other programs",
    }
    there = [(printable(str(path)), text) for path, text in files.items() if path is not None]
    lines = [f"  {path}\n      {text}" for path, text in there]
    return "\n".join(["open:", *lines, f"explore: mrgs view {quoted(results.run)}"])


class PipelineTerminal(Monitor):
    """Shows a pipeline at the terminal, and asks the user unless ``yes`` accepts all warnings."""

    def __init__(self, yes: bool) -> None:
        self._yes = yes
        self._preparing = PrepareProgress()
        self._training = TrainingProgress()
        self._show: Callable[..., None] | None = None

    def pause(self) -> None:
        """Clear the bar of the photos' progress, if there is one."""
        self._preparing.pause()

    def planned(self, plan: PipelinePlan) -> None:  # noqa: D102
        self.pause()
        for name, text in _plan_lines(plan).items():
            print(f"{styled(f'{name}:', 'bold', sys.stdout)}{'':{9 - len(name)}}{printable(text)}")
        for note in plan.notes:
            print_note(note)
        sys.stdout.flush()

    def reused(self, stage: PlannedStage) -> None:  # noqa: D102
        print(f"{_heading(stage)} (done before)", flush=True)

    @contextmanager
    def running(self, stage: PlannedStage, rest_s: float) -> Iterator[None]:  # noqa: D102
        seconds = sum(stage.parts.values())
        rest = f", then {rough(rest_s)} for the rest" if rest_s >= 1 else ""
        print(f"{_heading(stage)} ({rough(seconds)}{rest})", flush=True)
        if stage.name == "train":
            self._training = TrainingProgress()
            with self._training:
                yield
            if interrupts.received is not None:  # in the training's last step
                raise Interrupted
        elif stage.name in ("prepare", "check"):
            self._preparing = PrepareProgress()
            with self._preparing:
                yield
        else:
            with progress_bar(stage.name) as self._show:
                yield

    def progress(  # noqa: D102
        self, part: str, done: int, total: int, left_s: float | None
    ) -> None:
        if self._show is None:
            self._preparing.step(part, done, total, left_s)
        else:
            self._show(done, total, "" if total else part, left_s=left_s)

    def prepared(self, report: StageReport) -> None:  # noqa: D102
        self._preparing.stage(report, warn=False)

    def training_started(self, scene: Scene, config: RunConfig) -> None:  # noqa: D102
        self._training.start(scene, config)

    def stepped(self, statistics: StepStatistics) -> bool | None:  # noqa: D102
        return self._training.step(statistics)

    def accepts(self, warnings: Sequence[str], page: Path) -> bool:  # noqa: D102
        self.pause()
        for text in warnings:
            print_note(text, "warning")
        if self._yes:
            return True
        return _agrees(f"{page} shows what was found. Continue? [y/N] ")

    def accepts_relative(self, reason: MrgsError) -> bool:  # noqa: D102
        self.pause()
        print_note(f"{reason}{flags_of(reason)}", "warning")
        return self._yes or _agrees("Continue with relative values? [y/N] ")

    def answer(  # noqa: D102
        self, error: MrgsError, options: PrepareOptions
    ) -> PrepareOptions | None:
        self.pause()
        if "unit" in error.options and options.overrides.unit is None:
            unit = _ask(f"{error}\nunit of the values (celsius, kelvin, kelvin*100 ...): ")
            overrides = replace(options.overrides, unit=unit or None)
            return replace(options, overrides=overrides) if unit else None
        if "thermal_fov_deg" in error.options and options.thermal_fov_deg is None:
            degrees = _ask(
                f"{error}\nhorizontal field of view of the thermal camera (data sheet), degrees: "
            )
            with suppress(ValueError):
                return replace(options, thermal_fov_deg=float(degrees))
        return None


def _plan_lines(plan: PipelinePlan) -> dict[str, str]:
    """What was found and what will be done, by title."""
    quality, intake = plan.quality, plan.intake
    facts = [counted(plan.cores, "core")]
    for what, free, needed in (
        ("memory", plan.free_memory, plan.memory),
        ("disk", free_disk(plan.output), plan.disk),
    ):
        if free is not None:
            amounts = f"{free / GIGABYTE:.1f} GB {what} free (about {needed / GIGABYTE:.1f} needed)"
            facts.append(amounts)
    facts += [plan.device] if plan.device != "cpu" else []
    factor = waiting_factor()
    slower = f", {rough(factor * plan.seconds)} if other programs go on" if factor > BUSY else ""
    stages = ", ".join(
        f"{stage.name} {'done' if stage.is_done else duration(stage.seconds)}"
        for stage in plan.stages
    )
    return {
        "photos" if intake.kind == "photos" else "scene": f"{intake.source}: {intake.summary}",
        **({"pairs": " ".join(intake.facts)} if intake.facts else {}),
        "computer": ", ".join(facts),
        "quality": f"{quality.name}: {quality.max_steps:,} steps, at most "
        f"{quality.max_gaussians:,} Gaussians, photos at most {quality.resolution:,} px wide",
        "results": str(plan.output),
        "time": f"{rough(plan.seconds)}{slower} ({stages})",
    }


def _heading(stage: PlannedStage) -> str:
    text = f"stage {stage.number} of {stage.total}: {stage.name}"
    return styled(text, "bold", sys.stdout)


def rough(seconds: float) -> str:
    """An estimated duration."""
    if seconds < 90:
        return f"about {max(5 * round(seconds / 5), 5)} seconds"
    if seconds < 90 * 60:
        return f"about {round(seconds / 60)} minutes"
    return f"about {seconds / 3600:.1f} hours"


def _agrees(question: str) -> bool:
    return _ask(question).lower() in ("y", "yes")


def _ask(question: str) -> str:
    """The user's answer; empty without a terminal."""
    if not sys.stdin.isatty():
        return ""
    try:
        return input(question).strip()
    except EOFError:
        return ""
