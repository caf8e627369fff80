"""The stages of a pipeline: what each does, what it depends on, and the files that it makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from mrgs.check import Severity
from mrgs.data.kept import digest, fingerprint, stamps
from mrgs.errors import ConfigError, MrgsError, RunError, SceneError
from mrgs.evaluation import evaluate_run, render_run
from mrgs.export import FORMATS, export
from mrgs.marks.store import judged_content
from mrgs.method.config import DEFAULT_METHOD
from mrgs.pipeline.intake import Intake
from mrgs.pipeline.ledger import Ledger, file_stamp
from mrgs.pipeline.plan import QUALITIES, Monitor, Quality
from mrgs.prepare import Preparation, PrepareOptions, prepare
from mrgs.prepare.contract import CACHE_FOLDER
from mrgs.prepare.page.check import check_scene
from mrgs.report import write_report
from mrgs.run_files.folder import RunFolder
from mrgs.run_files.record import Statistics
from mrgs.runs.open import Run, load_run
from mrgs.runs.registry import find_method
from mrgs.scene import Scene
from mrgs.survey import SURVEY_FILE
from mrgs.system.gpu import DeviceName
from mrgs.system.strict_yaml import write_yaml
from mrgs.system.wording import counted
from mrgs.training.start import Hooks, TrainOptions

PAGE_FORMAT, PREPARE = "page", "prepare"

Report = Callable[[str, int, int], None]
"""Called with a part's name, how much of it is done, and of how much (0 if not known)."""


@dataclass(frozen=True)
class Stage:
    """A stage of a pipeline.

    Attributes:
        name: unique.
        made_from: a digest of everything that its result depends on; called once the stages before
            it are done.
        run: does the work; returns the files that it made.
    """

    name: str
    made_from: Callable[[], str]
    run: Callable[[Report], Sequence[Path]]


class Job:
    """The stages for one folder of photos, or one scene, at one quality.

    Attributes:
        intake: what the folder holds.
        quality: of the model.
        options: facts about the photos.
        output: folder of all results.
        device: where it is trained and rendered.
        monitor: hears of the progress, and is asked.
        ledger: the stages that are done.
        accepted: a warning that was accepted before the first stage; empty if there was none.
    """

    def __init__(
        self,
        intake: Intake,
        quality: Quality,
        options: PrepareOptions,
        output: Path,
        device: DeviceName,
        monitor: Monitor,
    ) -> None:
        self.intake = intake
        self.quality = quality
        self.options = options
        self.output = output
        self.device = device
        self.monitor = monitor
        self.ledger = Ledger(output)
        self.config = quality.config()
        self.accepted = ""

    @property
    def scene(self) -> Path:
        """The scene's folder; that of photos has their name, which is the model's title."""
        if self.intake.kind == "scene":
            return self.intake.source
        name = self.intake.source.resolve().name
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
            Stage(f"{own}/render", self._made_from_model, self._render),
            Stage(f"{own}/report", self._made_from_scores, self._report),
            Stage(f"{own}/page", self._made_from_measured, self._page),
            Stage(f"{own}/exports", self._made_from_measured, self._exports),
        )

    def _made_from_source(self) -> str:
        options = self.options
        if self.intake.kind == "scene":
            return fingerprint(self._held_by_scene(), options)
        # Only ``prepare`` asks what the photos hold: where nothing has changed it takes no time.
        files = [
            digest(path)
            for path in (options.pair_table, options.thermal_camera, options.poses)
            if path is not None and path.is_file()
        ]
        given = options.poses
        poses = stamps(given) if given is not None and given.is_dir() else ()
        return fingerprint(stamps(self.intake.source), options, files, poses)

    def _made_from_scene(self) -> str:
        return fingerprint(self._held_by_scene(), write_yaml(self.config))

    def _made_from_model(self) -> str:
        newest = RunFolder(self.model).newest_checkpoint()
        stamp = file_stamp(newest, self.model)
        return fingerprint(version("mrgs"), stamp, self._held_by_scene())

    def _made_from_scores(self) -> str:
        scores = self.model / "eval" / "metrics.json"
        stamps = [file_stamp(scores, self.model)] if scores.is_file() else []
        return fingerprint(self._made_from_measured(), stamps)

    def _made_from_measured(self) -> str:
        """The model, and what the user has stated and marked in its folder."""
        survey = self.model / SURVEY_FILE
        stated = survey.read_bytes().hex() if survey.is_file() else ""
        return fingerprint(self._made_from_model(), stated, judged_content(self.model))

    def _held_by_scene(self) -> list[tuple[str, str]]:
        """What the scene's files hold, without pages and without the cache of prepare."""
        folder = self.scene.parent if self.scene.is_file() else self.scene
        return self.ledger.contents_of(folder, without=(CACHE_FOLDER, "*.html"))

    def _prepare(self, report: Report) -> list[Path]:
        made_from = self._made_from_source()
        made = self._prepared(report)
        self.ledger.begin(PREPARE, made_from)  # until it is accepted, all of it is in the cache
        titles: dict[str, str] = {}
        for stage in made.stages:
            for text in stage.warnings:
                titles.setdefault(text, stage.title)
        self._require_accepted([f"{title}: {text}" for text, title in titles.items()], made.page)
        return [self.scene / "transforms.json", made.page]

    def _prepared(self, report: Report) -> Preparation:
        """The scene, after the monitor was asked for what the photos do not say."""
        try:
            return prepare(
                self.intake.source,
                self.scene,
                self.options,
                report,
                self.monitor.prepared,
                trains=True,
            )
        except MrgsError as error:
            if (completed := self.monitor.answer(error, self.options)) is None:
                raise
        self.options = completed
        return self._prepared(report)

    def _check(self, report: Report) -> list[Path]:
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
        """Stop at warnings about the scene, unless they are accepted.

        Raises:
            SceneError: they are not.
        """
        known = self.accepted
        is_new = any(not known or known not in text for text in warnings)
        if is_new and not self.monitor.accepts(warnings, page):
            count = counted(len(warnings), "warning")
            raise SceneError(
                f"stopped at {count} about the scene: check {page}; then run again and accept them",
                options=("yes",),
            )

    def _train(self, report: Report) -> list[Path]:
        folder, method, made_from = (
            RunFolder(self.model),
            find_method(DEFAULT_METHOD),
            self._made_from_scene(),
        )
        resume = bool(folder.checkpoints())
        if resume and not self.ledger.is_begun(self.stages[1].name, made_from):
            self._set_aside()
            resume = False
        self.ledger.begin(self.stages[1].name, made_from)
        last = self.config.max_steps

        def stepped(statistics: Statistics) -> bool | None:
            nonlocal last
            last = statistics.step
            return self.monitor.stepped(statistics)

        method.train(
            self.scene,
            self.model,
            self.config,
            TrainOptions(resume, device=self.device),
            Hooks(stepped, self.monitor.training_started),
        )
        if last < self.config.max_steps:
            raise KeyboardInterrupt
        return [folder.config_file, folder.newest_checkpoint()]

    def _set_aside(self) -> None:
        """Keep the results of other photos or settings under another name.

        Raises:
            RunError: the folder cannot be renamed.
        """
        number = 1
        while (old := self.output / f"{self.quality.name}-{number}").exists():
            number += 1
        try:
            self.model.rename(old)
        except OSError as error:
            raise RunError(
                f"{self.model} cannot be renamed ({error.strerror}): choose another folder",
                options=("output",),
            ) from None

    @cached_property
    def _run(self) -> Run:
        return load_run(self.model, self.scene, self.device)

    @cached_property
    def _loaded(self) -> Scene:
        return self._run.load_scene()

    def _score(self, report: Report) -> list[Path]:
        if not self._loaded.eval:
            return []
        report("scoring", 0, len(self._loaded.eval))
        evaluate_run(self._run, progress=lambda done, total: report("scoring", done, total))
        return [self.model / "eval" / name for name in ("metrics.json", "contact_sheet.png")]

    def _render(self, report: Report) -> list[Path]:
        folder = render_run(
            self._run,
            "eval" if self._loaded.eval else "train",
            progress=lambda done, total: report("rendering", done, total),
        )
        return [path for path in folder.rglob("*") if path.is_file()]

    def _report(self, report: Report) -> list[Path]:
        return [
            write_report(self._run, self._loaded, self.model / "report.html", _named_parts(report))
        ]

    def _page(self, report: Report) -> list[Path]:
        return export(
            self._run,
            self._loaded,
            PAGE_FORMAT,
            self.model / "export",
            progress=_named_parts(report),
        )

    def _exports(self, report: Report) -> list[Path]:
        formats = [name for name in FORMATS if name != PAGE_FORMAT and self._is_writable(name)]
        return export(
            self._run, self._loaded, formats, self.model / "export", progress=_named_parts(report)
        )

    def _is_writable(self, name: str) -> bool:
        try:
            FORMATS[name].require(self._loaded)
        except ConfigError:  # the plan has said so
            return False
        return True


def _named_parts(report: Report) -> Callable[[int, int, str], None]:
    """For work that reports its parts as they begin, by number and name."""
    return lambda number, total, name: report(name, 0, 0)
