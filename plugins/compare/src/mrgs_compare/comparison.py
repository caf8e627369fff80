"""The paper's experiments over scenes and methods: train, score, tabulate, and draw photos beside
the renderings of every method, and depth with and without L_boltz."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mrgs.data import load_scene
from mrgs.data.images import read_float_tiff
from mrgs.errors import ConfigError, MrgsError, SceneError
from mrgs.evaluation.contact_sheet import (
    DEPTH_NOTE,
    NORMALISED_NOTE,
    ViewImages,
    colored,
    error_note,
    error_scale,
    pooled,
)
from mrgs.evaluation.lpips import Lpips
from mrgs.evaluation.metrics import to_json
from mrgs.evaluation.renders import evaluate_renders, find_renders
from mrgs.pictures.drawing import Scale
from mrgs.pictures.files import write_png
from mrgs.pictures.palette import display_range
from mrgs.pictures.sheet import Bar, Panel, PanelRow, draw_section, stack
from mrgs.pictures.values import unit_label
from mrgs.render import Rendering
from mrgs.run_files.folder import CHECKPOINTS_KEPT
from mrgs.runs.open import open_run
from mrgs.scene import BUILT_IN, THERMAL, Modality, Scene, View
from mrgs.system import gpu
from mrgs.system.atomic import remove, write_text
from mrgs.system.disk import warn_if_short
from mrgs.system.gpu import DeviceName
from mrgs.training import TrainConfig
from mrgs.training.memory import checkpoint_bytes
from mrgs_compare.paper_tables import NAMES, Outcomes, all_tables, scene_title
from mrgs_compare.plan import (
    Options,
    PlannedRun,
    is_scored,
    neighbour_methods,
    plan,
    read_metrics,
    run_scores,
)
from mrgs_compare.processes import Progress, run_jobs
from mrgs_compare.table import Outcome, Table, failed, outcome, to_csv, to_latex, to_markdown

Say = Callable[[str], None]

WIDE_PX, NARROW_PX = 300, 220
"""Width of a panel; narrow where there are more than five columns."""

LABEL_PX = 88

WITHOUT_BOLTZ, WITH_BOLTZ = "mrgs-fourier", "mrgs"


@dataclass(frozen=True, eq=False)
class Exhibit:
    """One view of one scene as every method shows it: ``folder`` is the scene's, for its exact
    depths, ``shown`` the images by method, with the depth from the thermal camera, on which L_boltz
    acts, and ``figures``, by method, this view's entry in ``metrics.json``."""

    scene: Scene
    folder: Path
    view: View
    shown: Mapping[str, ViewImages]
    figures: Mapping[str, Mapping[str, Any]]

    @property
    def title(self) -> str:
        """Names of the scene and the view."""
        return f"{scene_title(self.scene.name)} · {self.view.name}"


def qualitative_section(exhibit: Exhibit, methods: Sequence[str]) -> Image.Image:
    """Draw a row per modality, and one of errors for each with a unit; a column for the photo and
    one per method, of which at least one must have images."""
    shown = {method: exhibit.shown.get(method) for method in methods}
    photos = next(images.photos for images in shown.values() if images is not None)
    rows: list[PanelRow] = []
    bars: list[Bar] = []
    for modality, photo in photos.items():
        unit = unit_label(modality, exhibit.scene.temperature)
        scale = Scale("inferno", *display_range(photo), unit) if modality.is_metric else None
        panels = [Panel(colored(photo, scale))]
        for method, images in shown.items():
            rendering = None if images is None else images.renderings.get(modality)
            panels.append(Panel(colored(rendering, scale), _caption(exhibit, method, modality)))
        rows.append(PanelRow(modality.title, panels))
        if scale is None:
            continue
        bars.append(Bar(scale, modality.quantity if unit else NORMALISED_NOTE))
        errors = [None if each is None else each.errors.get(modality) for each in shown.values()]
        scale = error_scale(errors, unit)
        panels = [Panel(None, missing=""), *(Panel(colored(error, scale)) for error in errors)]
        rows.append(PanelRow("error", panels))
        bars.append(Bar(scale, error_note(modality)))
    return draw_section(
        ["ground truth", *methods],
        rows,
        bars,
        cell_px=WIDE_PX if len(methods) < 5 else NARROW_PX,
        label_px=LABEL_PX,
        title=exhibit.title,
    )


def depth_section(exhibit: Exhibit) -> Image.Image:
    """Draw depth and thermal rendering without and with L_boltz, and the exact depth if there is
    one. The exhibit must show both ``WITHOUT_BOLTZ`` and ``WITH_BOLTZ``."""
    exact, path = None, exhibit.folder / "truth" / "depth" / f"{exhibit.view.name}.tiff"
    if path.is_file():
        with suppress(SceneError):  # a damaged file, which scoring reports
            found = read_float_tiff(path)
            exact = np.where(np.isfinite(found) & (found > 0), found, np.float32(np.nan))
    pair = {method: exhibit.shown[method] for method in (WITHOUT_BOLTZ, WITH_BOLTZ)}
    depths = pooled([images.depth for images in pair.values()])
    near, far = display_range(depths if exact is None else exact, tail=1.0)
    depth_scale = Scale("depth", far, near, "")
    heats = {method: images.renderings.get(THERMAL) for method, images in pair.items()}
    unit = unit_label(THERMAL, exhibit.scene.temperature)
    heat_scale = Scale("inferno", *display_range(pooled([*heats.values()])), unit)
    panels = []
    for method, images in pair.items():
        truth = exhibit.figures.get(method, {}).get("truth", {})
        error = truth.get("depth_median_relative_error")
        text = "" if error is None else f"median error {100 * error:.2f} %"
        panels.append(Panel(colored(images.depth, depth_scale), text))
        heat = colored(heats[method], heat_scale)
        panels.append(Panel(heat, _caption(exhibit, method, THERMAL)))
    columns = ["depth without L_boltz", "thermal without", "depth with L_boltz", "thermal with"]
    if exact is not None:
        columns.append("exact depth")
        panels.append(Panel(colored(exact, depth_scale)))
    bars = [Bar(depth_scale, DEPTH_NOTE), Bar(heat_scale, THERMAL.title)]
    return draw_section(
        columns, [PanelRow("", panels)], bars, cell_px=WIDE_PX, label_px=0, title=exhibit.title
    )


def _caption(exhibit: Exhibit, method: str, modality: Modality) -> str:
    """This view's PSNR, and its error in °C where there is one."""
    figures = exhibit.figures.get(method, {}).get(modality.name, {})
    parts = [
        f"{value:.2f} {unit}"
        for key, unit in (("psnr", "dB"), ("mae_c", "°C"))
        if (value := figures.get(key)) is not None
    ]
    return " · ".join(parts)


@dataclass(frozen=True)
class Comparison:
    """The results of a comparison: its tables without empty ones, why each run or set of renders
    without scores has none, and the folder of ``tables/``, ``figures/``, ``results.json`` and
    ``runs/``."""

    tables: tuple[Table, ...]
    failures: Mapping[str, str]
    folder: Path


def compare(
    scenes: Sequence[Path],
    output: Path,
    options: Options,
    *,
    renders: Mapping[str, Path] | None = None,
    jobs: int = 1,
    device: DeviceName = "auto",
    lpips_weights: Path | None = None,
    say: Say = lambda line: None,
) -> Comparison:
    """Train and score every method on every scene, then write tables and figures.

    Scored runs are kept, and scored again if held-out images have changed; runs with a checkpoint
    are continued; a run that fails is reported at the end. Tables and figures of an earlier call
    that this one does not write are removed.

    Args:
        output: folder to write to, or to continue in.
        options: the methods, and what all runs share.
        renders: other programs' renderings by their name in tables: folders with one folder per
            scene, see ``mrgs.evaluation.renders``.
        jobs: number of parallel runs, which share the cores.
        device: where they train and render, if their method can use a GPU.
        lpips_weights: weights for LPIPS; None leaves it out.

    Raises:
        MrgsError: a scene, an option or the output folder cannot be used.
        KeyboardInterrupt: Ctrl-C; the runs have written checkpoints, and the same call resumes
            them.
    """
    if jobs < 1:
        raise ConfigError(f"the number of jobs must be at least 1, not {jobs}", options=("jobs",))
    gpu.choose_device(device)  # better now than in every run
    renders = dict(renders or {})
    _check_names(options, renders)
    if lpips_weights is not None:
        Lpips.from_file(lpips_weights)  # better now than after the first training
    planned = plan(scenes, output, options)
    with_lpips = lpips_weights is not None
    due = [job for job in planned if not is_scored(job.scores, job.folder, job.config, with_lpips)]
    say(f"{len(planned)} runs, {len(planned) - len(due)} of them scored already")
    failures: Mapping[PlannedRun, str] = {}
    if due:
        _warn_if_disk_is_short(due)
        progress = Progress(due, jobs, say)
        failures = run_jobs(due, jobs, lpips_weights, progress.on_message, progress.on_tick, device)
    found = []
    for job in planned:
        scores = run_scores(job.folder) if job in due else job.scores
        if job in failures or scores is None:
            unreadable = f"{job.folder / 'eval' / 'metrics.json'} cannot be read"
            reason = f"the run failed: {failures.get(job, unreadable)}"
            found.append(failed(job.scene_name, job.method, job.seed, reason))
        else:
            found.append(outcome(job.scene_name, job.method, job.seed, scores))
    paths = {job.scene_name: job.scene for job in planned}
    for name, folder in renders.items():
        for scene, path in paths.items():
            found.append(
                _renders_outcome(name, folder / scene, scene, path, output, options, lpips_weights)
            )
    rows = (
        *dict.fromkeys(options.methods),
        *(variant.name for variant in options.variants),
        *renders,
    )
    outcomes = Outcomes(tuple(found), tuple(paths), rows, neighbour_methods(options))
    held_out = {each.scene: len(each.document.get("views", [])) for each in found if each.document}
    tables = tuple(all_tables(outcomes, options.setup(sum(held_out.values()))))
    _write_tables(output / "tables", tables)
    _write_results(output / "results.json", outcomes, options, paths)
    _write_figures(output / "figures", outcomes, planned, renders, options)
    reasons = {}
    for each in found:
        if each.failure is not None:
            seed = "" if each.seed is None else f", seed {each.seed}"
            reasons[f"{each.scene}, {each.method}{seed}"] = each.failure
    return Comparison(tables, reasons, output)


def _check_names(options: Options, renders: Mapping[str, Path]) -> None:
    """Names of variants and renders become folders and rows."""
    taken = {*options.methods, *neighbour_methods(options).values()}
    given = [("variants", variant.name) for variant in options.variants] + [
        ("renders", name) for name in renders
    ]
    for option, name in given:
        if name in taken:
            raise ConfigError(
                f"{name}: a method has this name already; choose another", options=(option,)
            )
        if not name or name in (".", "..") or set(name) & set("/\\:"):
            raise ConfigError(
                f"{name}: the name must be usable as a folder's name; choose another",
                options=(option,),
            )
        taken.add(name)


def _warn_if_disk_is_short(due: Sequence[PlannedRun]) -> None:
    """Warn if the disk has too little room for the checkpoints that the runs will keep."""
    configs = [job.config for job in due if isinstance(job.config, TrainConfig)]
    sizes = [
        checkpoint_bytes(config, BUILT_IN, config.densification.max_gaussians) for config in configs
    ]
    needed = CHECKPOINTS_KEPT * sum(sizes) + max(sizes, default=0)
    warn_if_short(due[0].folder, needed, f"these {len(due)} runs")


def _renders_outcome(
    name: str,
    folder: Path,
    scene: str,
    path: Path,
    output: Path,
    options: Options,
    lpips_weights: Path | None,
) -> Outcome:
    """Score another program's renderings, which is cheap."""
    scores = output / "renders" / name / scene
    try:
        evaluate_renders(
            path,
            folder,
            name=name,
            output=scores,
            resolution=options.resolution,
            lpips_weights=lpips_weights,
        )
    except MrgsError as error:
        return failed(scene, name, None, str(error))
    document = read_metrics(scores)
    assert document is not None
    return outcome(scene, name, None, document)


def _write_tables(folder: Path, tables: Sequence[Table]) -> None:
    """Write the tables in all formats; remove those of an earlier call that are empty now."""
    writers = {".md": to_markdown, ".tex": to_latex, ".csv": to_csv}
    for table in tables:
        for suffix, write in writers.items():
            write_text(folder / f"{table.name}{suffix}", write(table))
    for name in set(NAMES) - {table.name for table in tables}:
        for suffix in writers:
            remove(folder / f"{name}{suffix}")


def _write_results(
    path: Path, outcomes: Outcomes, options: Options, scenes: Mapping[str, Path]
) -> None:
    """Every figure of every run, with the reason of each that is null."""
    runs = []
    for each in outcomes.all:
        pairs = {name: to_json(figure) for name, figure in each.figures.items()}
        runs.append(
            {
                "scene": each.scene,
                "method": each.method,
                "seed": each.seed,
                "failure": each.failure,
                "figures": {name: number for name, (number, _) in pairs.items()},
                "reasons": {name: why for name, (_, why) in pairs.items() if why is not None},
                "metrics": each.document,
            }
        )
    content = {
        "mrgs": version("mrgs"),
        "options": asdict(options),
        "scenes": {name: str(folder) for name, folder in scenes.items()},
        "runs": runs,
    }
    write_text(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")


def _write_figures(
    folder: Path,
    outcomes: Outcomes,
    planned: Sequence[PlannedRun],
    renders: Mapping[str, Path],
    options: Options,
) -> None:
    """Write ``qualitative.png``, and ``depth.png`` where both of its methods are there, of the
    first seed; remove files of an earlier call that have no contents now."""
    figures: dict[str, list[Image.Image]] = {"qualitative.png": [], "depth.png": []}
    for scene in outcomes.scenes:
        exhibit = _exhibit(scene, outcomes, planned, renders, options)
        if not exhibit.shown.keys().isdisjoint(outcomes.methods):
            figures["qualitative.png"].append(qualitative_section(exhibit, outcomes.methods))
        if {WITH_BOLTZ, WITHOUT_BOLTZ} <= exhibit.shown.keys():
            figures["depth.png"].append(depth_section(exhibit))
    for name, sections in figures.items():
        if sections:
            write_png(folder / name, stack(sections))
        else:
            remove(folder / name)


def _exhibit(
    scene: str,
    outcomes: Outcomes,
    planned: Sequence[PlannedRun],
    renders: Mapping[str, Path],
    options: Options,
) -> Exhibit:
    """The middle held-out view of a scene as the methods show it; one model in memory at a time."""
    path = next(job.scene for job in planned if job.scene_name == scene)
    loaded = load_scene(path, resolution=options.resolution)
    view = loaded.eval[len(loaded.eval) // 2]
    wanted, pair = set(outcomes.methods), {WITH_BOLTZ, WITHOUT_BOLTZ}
    if pair <= {each.method for each in outcomes.all}:  # one may be a run of neighbours alone
        wanted |= pair
    shown: dict[str, ViewImages] = {}
    figures: dict[str, Any] = {}
    for each in outcomes.all:
        is_scored_here = each.scene == scene and each.document is not None
        if not is_scored_here or each.method not in wanted or each.method in shown:
            continue
        try:
            # A rendering keeps its run in memory: it must not outlive the call.
            shown[each.method] = ViewImages.of(
                view,
                _render(each, loaded, view, planned, renders),
                loaded.temperature,
                loaded.reach,
                THERMAL,
            )
        except MrgsError:  # scored, but its checkpoints or images were removed since
            continue
        views = (each.document or {}).get("views", [])
        own = (entry for entry in views if entry["name"] == view.name)
        figures[each.method] = next(own, {})
    return Exhibit(loaded, path.parent if path.is_file() else path, view, shown, figures)


def _render(
    each: Outcome,
    scene: Scene,
    view: View,
    planned: Sequence[PlannedRun],
    renders: Mapping[str, Path],
) -> Rendering:
    """A view as the cameras would have recorded it."""
    if each.seed is None:
        return find_renders(renders[each.method] / each.scene, scene).rendering(
            view, scene.temperature
        )
    key = each.scene, each.method, each.seed
    job = next(job for job in planned if (job.scene_name, job.method, job.seed) == key)
    run = open_run(job.folder, job.scene, "cpu")
    return run.camera_response(run.render_view(view), view.camera)
