"""The state that the stages of ``prepare`` share."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mrgs.data.kept import Cache
from mrgs.data.radiometric import GpsPosition
from mrgs.prepare.contract import (
    CACHE_FOLDER,
    ConvertedPhotos,
    Georeference,
    Pairing,
    Progress,
    Reconstruction,
    Skipped,
    StageReport,
    StageSummary,
)
from mrgs.prepare.control import ControlPoints
from mrgs.prepare.georeference import apply
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.rig.contract import RigCalibration


@dataclass(eq=False)
class Work:
    """A scene in preparation: the user's input, and the results of the stages so far.

    Attributes:
        trains: whether the caller goes on to train by itself, so that the page names no command.
        on_progress: called with "stage: step", and how many of the step's parts are done and there
            are (0 of 0 if not known).
        control: points that are marked in the photos; None without.
        poses: of the images, in the world of the reconstruction; None until found.
        georeference: from that world to the scene's; None until found.
        rig: the thermal camera, calibrated in the scene's world; None until found, and where one
            camera took both images.
        found_by_page: warnings that only the page could find.
    """

    photos: Path
    scene: Path
    options: PrepareOptions = field(default_factory=PrepareOptions)
    trains: bool = False
    on_progress: Progress = lambda step, done, total: None
    on_report: Callable[[StageReport], None] = lambda report: None
    reports: list[StageReport] = field(default_factory=list)
    pairing: Pairing = field(default_factory=lambda: Pairing((), (), ""))
    images: ConvertedPhotos = field(default_factory=lambda: ConvertedPhotos((), ()))
    control: ControlPoints | None = None
    poses: Reconstruction | None = None
    georeference: Georeference | None = None
    rig: RigCalibration | None = None
    found_by_page: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.cache = Cache(self.scene / CACHE_FOLDER)
        self._title = ""

    @property
    def posed(self) -> Reconstruction:
        """Poses and points in the scene's world."""
        if self.poses is None:
            raise ValueError("the poses are not found yet")
        return self.poses if self.georeference is None else apply(self.georeference, self.poses)

    @property
    def metric(self) -> bool:
        """Whether the unit of the scene's world is the metre."""
        return self.georeference is not None and self.georeference.metric

    @property
    def gps(self) -> dict[str, GpsPosition]:
        """Positions in the photos' files, by view."""
        views = self.images.views
        return {view.name: view.exif.gps for view in views if view.exif.gps is not None}

    @property
    def skipped(self) -> tuple[Skipped, ...]:
        """Files and views that are not in the scene."""
        failed = () if self.poses is None else self.poses.failed
        return (*self.pairing.skipped, *self.images.skipped, *failed)

    def progress(self, step: str, done: int, total: int) -> None:
        """Report progress within the current stage; a :data:`Progress`."""
        self.on_progress(f"{self._title}: {step}", done, total)

    def run(self, title: str, stage: Callable[..., StageSummary], *arguments: Any) -> None:
        """Run a stage with the work and ``arguments``, and report its summary."""
        self._title, made, started = title, self.cache.made, time.perf_counter()
        self.on_progress(title, 0, 0)
        summary = stage(self, *arguments)
        reused = self.cache.made == made
        seconds = 0.0 if reused else time.perf_counter() - started
        report = StageReport(title, summary.lines, summary.warnings, seconds, reused)
        self.reports.append(report)
        self.on_report(report)
