"""What a folder contains, from the headers of its files (photos or a scene, their number and size,
with °C or without), and what a pipeline is going to do: its quality, its stages, and the monitor
that follows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Literal

from mrgs.data import load_scene
from mrgs.data.colmap import find_model
from mrgs.data.images import probe
from mrgs.data.nerfstudio import find_transforms
from mrgs.data.radiometric import Overrides, ThermalPhoto, read_thermal_photo
from mrgs.errors import ConfigError, MrgsError, scene_error
from mrgs.method.config import DEFAULT_METHOD, TrainConfig, with_flat_field
from mrgs.prepare.contract import MIN_VIEWS, PhotoPair, Progress, StageReport
from mrgs.prepare.options import PrepareOptions
from mrgs.prepare.pairs.find import find_pairs
from mrgs.run_files.folder import RunConfig
from mrgs.run_files.record import StepStatistics
from mrgs.runs.registry import find_method
from mrgs.scene import RGB, THERMAL, Modality, Scene
from mrgs.system.wording import counted

Size = tuple[int, int]


@dataclass(frozen=True)
class Intake:
    """The contents of a folder.

    Attributes:
        kind: photos, or a scene with poses.
        views: number of pairs, or of a scene's views.
        held_out: views for scoring.
        sizes: width and height of the images by modality, px.
        camera: model of the thermal camera; empty if not known.
        has_celsius: whether the thermal photos have temperatures; None without thermal photos.
        points: start points of a scene; None for photos.
        bytes: size of the files that are used.
        facts: further sentences for the user.
        poses_given: whether the poses of photos need not be found.
        without_celsius: why the first thermal photo has no temperatures; empty if it has, and for a
            scene.
        takes_bounds: whether the °C of black and white would turn them into temperatures.
    """

    source: Path
    kind: Literal["photos", "scene"]
    views: int
    held_out: int
    sizes: Mapping[Modality, Size]
    camera: str
    has_celsius: bool | None
    points: int | None
    bytes: int
    facts: tuple[str, ...] = ()
    poses_given: bool = False
    without_celsius: str = ""
    takes_bounds: bool = False

    @property
    def summary(self) -> str:
        """One line."""
        noun = "views" if self.kind == "scene" else "pairs" if RGB in self.sizes else "photos"
        parts = [f"{self.views} {noun}"]
        parts += [
            f"{modality.title} {width}×{height} px"
            for modality, (width, height) in self.sizes.items()
        ]
        if self.camera:
            parts.append(self.camera)
        if self.has_celsius is not None:
            parts.append("temperatures in °C" if self.has_celsius else "no °C (relative values)")
        return ", ".join(parts)


def is_scene(folder: Path) -> bool:
    """Whether a folder has poses in a layout that ``load_scene`` reads."""
    if folder.is_file():
        return folder.suffix == ".json"
    if not folder.is_dir():
        return False
    root = folder.resolve()
    return find_transforms(root) is not None or find_model(root) is not None


def take_in(source: Path, options: PrepareOptions, progress: Progress | None = None) -> Intake:
    """Look at a folder of photos, or at a scene or its transforms file; nothing is written. The
    progress is called with a step's name, the number of files that are done, and of all. SceneError
    if the folder cannot be used: not there, no photos, too few pairs, or a thermal photo that
    cannot be read. ConfigError for an option that does not fit the photos or the scene."""
    if not is_scene(source):
        if not source.is_dir():
            raise scene_error(source, "not a folder; give the folder of the photos, or a scene")
        return _photos(source, options, progress)
    given = [*_changed(options.overrides, Overrides()), *_changed(options, PrepareOptions())]
    if names := tuple(name for name in given if name != "overrides"):
        raise ConfigError(
            f"{source} is a scene, in which options for photos change nothing: give the folder of "
            f"the photos, or leave them out",
            options=names,
        )
    return _scene(source)


def _changed(chosen: Overrides | PrepareOptions, default: Overrides | PrepareOptions) -> list[str]:
    """Names of the fields that differ from their defaults."""
    names = [field.name for field in fields(default)]
    return [name for name in names if getattr(chosen, name) != getattr(default, name)]


def _scene(source: Path) -> Intake:
    scene = load_scene(source)
    cameras = scene.train[0].cameras
    folder = source if source.is_dir() else source.parent
    has_thermal = THERMAL in scene.modalities
    return Intake(
        source,
        "scene",
        len(scene.train) + len(scene.eval),
        len(scene.eval),
        {modality: (camera.width, camera.height) for modality, camera in cameras.items()},
        "",
        (scene.temperature is not None) if has_thermal else None,
        len(scene.points.positions),
        sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
    )


def _photos(source: Path, options: PrepareOptions, progress: Progress | None) -> Intake:
    pairing = find_pairs(source, options, progress)
    count = len(pairing.pairs)
    if count < MIN_VIEWS:
        raise scene_error(
            source,
            f"holds {counted(count, 'pair')} of photos, and a model needs at least "
            f"{MIN_VIEWS}, better 20 or more; add photos of the same object from other places",
        )
    found = [_read(pair, options) for pair in pairing.pairs[:MIN_VIEWS]]
    readable = [each for each in found if isinstance(each, ThermalPhoto)]
    if not readable and isinstance(found[0], MrgsError):
        raise found[0]
    thermal = readable[0]
    relative, skipped = thermal.temperature_c is None, len(pairing.skipped)
    are = "is" if skipped == 1 else "are"
    unused = [f"{counted(skipped, 'other file')} {are} not used."] if skipped else []
    return Intake(
        source,
        "photos",
        count,
        0 if options.eval_every == 0 else (count + options.eval_every - 1) // options.eval_every,
        _sizes(pairing.pairs[0], thermal),
        thermal.facts.camera or "",
        not relative,
        None,
        sum(path.stat().st_size for pair in pairing.pairs for path in pair.photos.values()),
        (pairing.rule, *unused),
        options.poses is not None,
        " ".join(thermal.facts.warnings) if relative else "",
        relative and _takes_bounds(pairing.pairs, options),
    )


def _takes_bounds(pairs: tuple[PhotoPair, ...], options: PrepareOptions) -> bool:
    """Whether a thermal photo has temperatures once bounds are given; not if it shows a palette."""
    if options.overrides.unit is not None:
        return False
    bounded = replace(options, overrides=replace(options.overrides, bounds_c=(0.0, 1.0)))
    found = [_read(pair, bounded) for pair in pairs[:MIN_VIEWS]]
    return any(isinstance(each, ThermalPhoto) for each in found)


def _read(pair: PhotoPair, options: PrepareOptions) -> ThermalPhoto | MrgsError:
    """A pair's thermal photo, or why it cannot be read."""
    try:
        return read_thermal_photo(pair.photos[THERMAL], options.overrides)
    except MrgsError as error:
        return error


def _sizes(pair: PhotoPair, thermal: ThermalPhoto) -> dict[Modality, Size]:
    height, width = thermal.valid.shape
    sizes: dict[Modality, Size] = {}
    if RGB in pair.photos:
        info = probe(pair.photos[RGB])
        sizes[RGB] = (info.width, info.height)
    elif pair.embedded and thermal.facts.visible is not None:
        sizes[RGB] = thermal.facts.visible.pixels().shape[1::-1]
    return {**sizes, THERMAL: (width, height)}


@dataclass(frozen=True)
class Quality:
    """How much work a pipeline puts into a model: the options of ``mrgs train``."""

    name: str
    preset: str
    max_steps: int
    max_gaussians: int
    resolution: int
    flat_field: Path | None = None
    flat_field_unit: str | None = None

    def config(self) -> TrainConfig:
        """The configuration of the training. ConfigError if the flat field is not a folder."""
        config: TrainConfig = find_method(DEFAULT_METHOD).configure(
            self.preset,
            max_steps=self.max_steps,
            max_gaussians=self.max_gaussians,
            resolution=self.resolution,
        )
        if self.flat_field is None:
            return config
        return with_flat_field(config, self.flat_field, self.flat_field_unit)


QUALITIES: dict[str, Quality] = {
    each.name: each
    for each in (
        Quality("fast", "fast", 1_500, 20_000, 640),
        Quality("default", "default", 4_000, 50_000, 1_024),
        Quality("best", "default", 8_000, 100_000, 1_600),
    )
}


@dataclass(frozen=True)
class PlannedStage:
    """A stage of a pipeline, with its number from 1, of ``total``, the seconds that its parts are
    expected to take, by name, and whether an earlier call has finished it, with the same inputs."""

    name: str
    number: int
    total: int
    parts: Mapping[str, float]
    is_done: bool

    @property
    def seconds(self) -> float:
        """Expected duration; 0 if it is done."""
        return 0.0 if self.is_done else sum(self.parts.values())


@dataclass(frozen=True)
class PipelinePlan:
    """What a pipeline is going to do.

    Attributes:
        free_memory: bytes; None if not known.
        device: what trains and renders, such as "cpu" or a GPU's name.
        memory: bytes that are needed at most, roughly.
        disk: bytes that the results need, roughly.
        notes: sentences for the user.
    """

    intake: Intake
    quality: Quality
    cores: int
    free_memory: int | None
    device: str
    output: Path
    stages: tuple[PlannedStage, ...]
    memory: int
    disk: int
    notes: tuple[str, ...] = ()

    @property
    def seconds(self) -> float:
        """Expected duration of all stages."""
        return sum(stage.seconds for stage in self.stages)


class Monitor:
    """Follows a pipeline. This one shows nothing and accepts nothing; override its methods."""

    def planned(self, plan: PipelinePlan) -> None:
        """Called once, before the first stage."""

    def reused(self, stage: PlannedStage) -> None:
        """Called instead of ``running`` for a stage that an earlier call has finished."""

    def running(self, stage: PlannedStage, rest_s: float) -> AbstractContextManager[None]:
        """A context in which a stage runs."""
        return nullcontext()

    def progress(self, part: str, done: int, total: int, left_s: float | None) -> None:
        """Called while the photos are inspected, and while a stage runs: the finished items of a
        part, all of its items, 0 if not known, and the stage's seconds left, None if not known."""

    def prepared(self, report: StageReport) -> None:
        """Called with the result of each part of the first stage."""

    def training_started(self, scene: Scene, config: RunConfig) -> None:
        """Called before the first training step."""

    def stepped(self, statistics: StepStatistics) -> bool | None:
        """Called after each training step; returning True stops the pipeline with a checkpoint."""
        return None

    def accepts(self, warnings: Sequence[str], page: Path) -> bool:
        """Whether to continue in spite of warnings about the scene, which ``page`` shows."""
        return False

    def accepts_relative(self, reason: MrgsError) -> bool:
        """Whether to continue with thermal photos without temperatures; called before anything is
        computed, with the reason and the remedy, whose ``options`` names what would help."""
        return False

    def answer(self, error: MrgsError, options: PrepareOptions) -> PrepareOptions | None:
        """The options with the information that ``error.options`` names; None to give up."""
        return None
