"""The stages of a pipeline: what each does, what it depends on, its files, and which are done."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import cached_property, partial
from importlib.metadata import version
from itertools import count
from pathlib import Path

import msgspec

from mrgs.check import Severity
from mrgs.data.files import visible_files
from mrgs.data.kept import Digests, digest, fingerprint, stamp_of, stamps
from mrgs.errors import ConfigError, MrgsError, RunError, SceneError
from mrgs.evaluation import evaluate_run, render_run
from mrgs.export import FORMATS, export
from mrgs.marks.store import judged_content
from mrgs.method.config import DEFAULT_METHOD
from mrgs.pipeline.plan import QUALITIES, Intake, Monitor, Quality
from mrgs.prepare import Preparation, PrepareOptions, prepare
from mrgs.prepare.contract import CACHE_FOLDER, Progress
from mrgs.prepare.page.check import check_scene
from mrgs.report import report_run
from mrgs.run_files.folder import RunFolder
from mrgs.run_files.record import StepStatistics
from mrgs.runs.open import Run, load_run
from mrgs.runs.registry import find_method
from mrgs.scene import Scene
from mrgs.survey import SURVEY_FILE, read_survey, survey_of
from mrgs.system.atomic import write_text
from mrgs.system.disk import read_text
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import write_yaml
from mrgs.system.wording import counted
from mrgs.training.start import Hooks, TrainOptions

LEDGER = "pipeline.json"
CONTENTS = "contents.json"
"""File of the digests of the scene's files."""

PAGE_FORMAT, PREPARE = "page", "prepare"


@dataclass(frozen=True)
class Stage:
    """A stage of a pipeline: a digest of everything that its result depends on, asked for once the
    stages before it are done, and the work, which returns the files that it made."""

    name: str
    made_from: Callable[[], str]
    run: Callable[[Progress], Sequence[Path]]


class Job:
    """The stages for one folder of photos, or one scene, at one quality. ``accepted`` is a warning
    that was accepted before the first stage; empty if there was none."""

    def __init__(
        self,
        intake: Intake,
        quality: Quality,
        options: PrepareOptions,
        output: Path,
        device: DeviceName,
        monitor: Monitor,
    ) -> None:
        self.intake, self.quality, self.options = intake, quality, options
        self.output, self.device, self.monitor = output, device, monitor
        self.ledger, self.config, self.accepted = Ledger(output), quality.config(), ""

    @property
    def scene(self) -> Path:
        """The scene's folder; that of photos has their name, which is the model's title."""
        if self.intake.kind == "scene":
            return self.intake.source
        name = self.options.name_of(self.intake.source)
        return self.output / (f"{name}-scene" if name in QUALITIES else name)

    @property
    def model(self) -> Path:
        """The run's folder."""
        return self.output / self.quality.name

    @property
    def stages(self) -> tuple[Stage, ...]:
        """All stages, in order."""
        own = self.quality.name
        first = self._prepare if self.intake.kind == "photos" else self._check
        return (
            Stage(PREPARE, self._made_from_source, first),
            Stage(f"{own}/train", self._made_from_scene, self._train),
            Stage(f"{own}/score", self._made_from_model, self._score),
            Stage(f"{own}/render", self._made_from_cropped, self._render),
            Stage(f"{own}/report", self._made_from_measured, self._report),
            Stage(f"{own}/page", self._made_from_measured, partial(self._exported, [PAGE_FORMAT])),
            Stage(f"{own}/exports", self._made_from_measured, self._exports),
        )

    def _made_from_source(self) -> str:
        options = self.options
        if self.intake.kind == "scene":
            return fingerprint(self._scene_contents(), options)
        # Only ``prepare`` reads the photos: where nothing has changed it takes no time.
        given = [options.pair_table, options.thermal_camera, options.poses, options.control]
        files = [digest(path) for path in given if path is not None and path.is_file()]
        folder = options.poses
        poses = stamps(folder) if folder is not None and folder.is_dir() else ()
        return fingerprint(stamps(self.intake.source), options, files, poses)

    def _made_from_scene(self) -> str:
        flat_field = self.config.image_model.flat_field
        frames = [] if flat_field is None else self.ledger.contents_of(Path(flat_field))
        return fingerprint(self._scene_contents() + frames, write_yaml(self.config))

    def _made_from_model(self) -> str:
        newest = RunFolder(self.model).newest_checkpoint()
        size, mtime, _ = stamp_of(newest)  # a copy that keeps its mtime is the same file
        stamp = newest.relative_to(self.model).as_posix(), size, mtime
        return fingerprint(version("mrgs"), stamp, self._scene_contents())

    def _made_from_cropped(self) -> str:
        return fingerprint(self._made_from_model(), read_survey(self.model / SURVEY_FILE).kept)

    def _made_from_measured(self) -> str:
        """The model, and what the user has stated and marked in its folder."""
        survey = self.model / SURVEY_FILE
        stated = survey.read_bytes().hex() if survey.is_file() else ""
        return fingerprint(self._made_from_model(), stated, judged_content(self.model))

    def _scene_contents(self) -> list[tuple[str, str]]:
        """The contents of the scene's files, without pages and without the cache of prepare."""
        folder = self.scene.parent if self.scene.is_file() else self.scene
        return self.ledger.contents_of(folder, without=(CACHE_FOLDER, "*.html"))

    def _prepare(self, report: Progress) -> list[Path]:
        made_from = self._made_from_source()
        made = self._prepared(report)
        self.ledger.begin(PREPARE, made_from)  # until it is accepted, all of it is in the cache
        titles: dict[str, str] = {}
        for stage in made.stages:
            for text in stage.warnings:
                titles.setdefault(text, stage.title)
        self._require_accepted([f"{title}: {text}" for text, title in titles.items()], made.page)
        return [self.scene / "transforms.json", made.page]

    def _prepared(self, report: Progress) -> Preparation:
        """The scene, after the monitor was asked for what the photos lack."""
        source, prepared = self.intake.source, self.monitor.prepared
        try:
            return prepare(source, self.scene, self.options, report, prepared, trains=True)
        except MrgsError as error:
            if (completed := self.monitor.answer(error, self.options)) is None:
                raise
        self.options = completed
        return self._prepared(report)

    def _check(self, report: Progress) -> list[Path]:
        found = check_scene(self.scene, report, self.output)
        texts: dict[Severity, list[str]] = {"error": [], "warning": [], "note": []}
        for problem in found.problems:
            texts[problem.severity].append(f"{problem.text} {problem.remedy}".rstrip())
        if errors := texts["error"]:
            raise SceneError(
                f"{self.scene} cannot be trained on: {' '.join(errors)} {found.page} shows it"
            )
        self._require_accepted(texts["warning"], found.page)
        return [found.page]

    def _require_accepted(self, warnings: Sequence[str], page: Path) -> None:
        """Stop at warnings about the scene; SceneError unless they are accepted."""
        known = self.accepted
        is_new = any(not known or known not in text for text in warnings)
        if is_new and not self.monitor.accepts(warnings, page):
            found = counted(len(warnings), "warning")
            raise SceneError(
                f"stopped at {found} about the scene: check {page}; then run again and accept them",
                options=("yes",),
            )

    def _train(self, report: Progress) -> list[Path]:
        folder, own = RunFolder(self.model), self.stages[1]
        resume = bool(folder.checkpoints())
        if resume and not self.ledger.is_begun(own.name, own.made_from):
            self._set_aside()
            resume = False
        self.ledger.begin(own.name, own.made_from())
        last = self.config.max_steps

        def stepped(statistics: StepStatistics) -> bool | None:
            nonlocal last
            last = statistics.step
            return self.monitor.stepped(statistics)

        options = TrainOptions(resume, device=self.device)
        hooks = Hooks(stepped, self.monitor.training_started)
        find_method(DEFAULT_METHOD).train(self.scene, self.model, self.config, options, hooks)
        if last < self.config.max_steps:
            raise KeyboardInterrupt
        survey_of(self.model)  # to be filled in
        return [folder.config_file, folder.newest_checkpoint()]

    def _set_aside(self) -> None:
        """Rename the results of other photos or settings; RunError if that is not possible."""
        names = (self.output / f"{self.quality.name}-{number}" for number in count(1))
        try:
            self.model.rename(next(name for name in names if not name.exists()))
        except OSError as error:
            raise RunError(
                f"{self.model} cannot be renamed ({error.strerror}): choose another folder",
                options=("output",),
            ) from None

    @cached_property
    def _run(self) -> Run:
        return load_run(self.model, self.scene, self.device)

    @cached_property
    def _cropped(self) -> Run:
        """The run without what the survey crops; the scores are of the whole."""
        return self._run.cropped()

    @cached_property
    def _loaded(self) -> Scene:
        return self._run.load_scene()

    def _score(self, report: Progress) -> list[Path]:
        if not self._loaded.eval:
            return []
        report("scoring", 0, len(self._loaded.eval))
        evaluate_run(self._run, progress=lambda done, total: report("scoring", done, total))
        return [self.model / "eval" / name for name in ("metrics.json", "contact_sheet.png")]

    def _render(self, report: Progress) -> list[Path]:
        folder = render_run(
            self._cropped,
            "eval" if self._loaded.eval else "train",
            progress=lambda done, total: report("rendering", done, total),
        )
        return [path for path in folder.rglob("*") if path.is_file()]

    def _report(self, report: Progress) -> list[Path]:
        return [report_run(self._cropped, scene=self._loaded, progress=_named_parts(report))]

    def _exports(self, report: Progress) -> list[Path]:
        formats = []
        for name, format in FORMATS.items():
            with suppress(ConfigError):  # the plan has a note about it
                format.require(self._loaded)
                formats.append(name)
        return self._exported([name for name in formats if name != PAGE_FORMAT], report)

    def _exported(self, formats: list[str], report: Progress) -> list[Path]:
        folder, progress = self.model / "export", _named_parts(report)
        return export(self._cropped, self._loaded, formats, folder, progress=progress)


def _named_parts(report: Progress) -> Callable[[int, int, str], None]:
    """A callback for work that reports its parts as they begin, by number and name."""
    return lambda number, total, name: report(name, 0, 0)


class _Entry(msgspec.Struct, omit_defaults=True):
    """A stage that was begun, and the sizes of its files if it was finished."""

    made_from: str
    files: dict[str, int | None] | None = None


class Ledger:
    """The finished stages, in a JSON file; an unreadable entry counts as not done."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._file = folder, folder / LEDGER
        self._digests = Digests(folder / CONTENTS)
        self._stages: dict[str, _Entry] = {}
        with suppress(OSError, msgspec.MsgspecError, RecursionError):
            self._stages = msgspec.json.decode(read_text(self._file), type=dict[str, _Entry])

    def open(self) -> None:
        """Make the file, which marks a pipeline's folder, if need be. RunError if that fails."""
        if not self._file.is_file():
            self._write()

    def is_done(self, stage: str, made_from: Callable[[], str]) -> bool:
        """Whether a stage was finished with these inputs, and its files are as it left them."""
        if not self.is_begun(stage, made_from) or (files := self._stages[stage].files) is None:
            return False
        return all(_size(self._folder / name) == size for name, size in files.items())

    def is_begun(self, stage: str, made_from: Callable[[], str]) -> bool:
        """Whether a stage was begun, or finished, with the inputs as they are now, of which
        ``made_from`` gives the digest; they are read only if it was ever begun."""
        return stage in self._stages and self._stages[stage].made_from == made_from()

    def begin(self, stage: str, made_from: str) -> None:
        """Note that a stage begins; RunError if the file cannot be written."""
        self._stages[stage] = _Entry(made_from)
        self._write()

    def finish(self, stage: str, made_from: str, files: Sequence[Path]) -> None:
        """Note that a stage is finished, and the files that it made; errors as for ``begin``."""
        sizes = {path.relative_to(self._folder).as_posix(): _size(path) for path in files}
        self._stages[stage] = _Entry(made_from, sizes)
        self._write()

    def contents_of(self, folder: Path, without: Sequence[str] = ()) -> list[tuple[str, str]]:
        """Names and SHA-256 of all visible files below a folder, sorted. Only those that changed
        since the last call, also of another process, are read. Files and folders whose names match
        a pattern of ``without`` do not count. RunError if the digests cannot be written."""
        found = []
        try:
            for path in sorted(filter(Path.is_file, visible_files(folder))):
                own = path.relative_to(folder)
                if not any(fnmatchcase(part, each) for each in without for part in own.parts):
                    found.append((own.as_posix(), self._digests.of(path)))
        except BaseException:  # Ctrl-C: the next call reads the others only
            with suppress(RunError):
                self._digests.save()
            raise
        self._digests.save(forget_others=True)
        return found

    def _write(self) -> None:
        content = msgspec.json.format(msgspec.json.encode(self._stages), indent=1)
        write_text(self._file, content.decode())


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size
    except (OSError, ValueError):
        return None
