"""What the terminal shows before and after the work: errors, notes, addresses, scores."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from mrgs.errors import ConfigError, MrgsError, MrgsWarning, SceneError, printable
from mrgs.system import disk

if TYPE_CHECKING:
    import torch

    from mrgs.evaluation import Metrics
    from mrgs.export import BakingLoss
    from mrgs.runs.open import Run, TrainedRun
    from mrgs.scene import Scene
    from mrgs.survey import Corners, Outlines


def styled(text: str, style: str, stream: TextIO) -> str:
    """The text with the codes of a style such as "bold red"; as it is where the stream is not a
    terminal with colours, or NO_COLOR is set."""
    if not stream.isatty():
        return text
    from rich.console import Console
    from rich.text import Text

    console = Console(file=stream, highlight=False, soft_wrap=True)
    if console.no_color:
        return text
    with console.capture() as capture:
        console.print(Text(text, style=style), end="")
    return capture.get()


def print_note(text: str, kind: str = "note", style: str = "yellow") -> None:
    """Print a note on one line."""
    print(f"{styled(f'mrgs: {kind}:', style, sys.stderr)} {printable(text)}", file=sys.stderr)


def say(*lines: str) -> None:
    """Print lines, names in them with escapes for what is not printable."""
    print("\n".join(map(printable, lines)), flush=True)


def print_error(text: str) -> None:
    """Print an error, on one line."""
    print_note(text, "error", "bold red")


def flag_of(parameter: str) -> str:
    """The flag of a parameter of the Python API, whose name may end with a unit:
    ``thermal_fov_deg`` is --thermal-fov."""
    return "--" + re.sub("_(c|k|m|s|deg)$", "", parameter).replace("_", "-")


def flags_of(error: MrgsError) -> str:
    """The flags of the parameters that an error is about, in brackets; empty if there are none."""
    flags = [flag_of(option) for option in error.options]
    return f" ({', '.join(flags)})" if flags else ""


def read_text(path: Path) -> str:
    """The text of a file that an option names. ConfigError if it cannot be read."""
    try:
        return disk.read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path}: cannot be read as text ({getattr(error, 'strerror', 'not UTF-8')})"
        ) from error


@contextmanager
def plain_warnings() -> Iterator[None]:
    """Print each distinct warning once, on one line."""
    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        if str(message) in shown:
            return
        shown.add(str(message))
        if issubclass(category, MrgsWarning):
            print_note(str(message))
        else:
            print(f"warning: {message}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.simplefilter("always", MrgsWarning)
        warnings.showwarning = show
        yield


def print_viewer_address(url: str) -> None:
    """Print how to open the viewer."""
    print(f"open {url} in a browser; press Ctrl-C here to stop", flush=True)


def note_gpu(device: torch.device) -> None:
    """Name the GPU if one is used."""
    from mrgs.system.gpu import device_title

    if device.type == "cuda":
        print(f"training on the {device_title(device)}")


def note_unfinished(run: Run) -> None:
    """Warn that the run is unfinished and its newest checkpoint is used."""
    if run.facts.step < run.config.max_steps:
        step, last = run.facts.step, run.config.max_steps
        print_note(f"the run is at step {step:,} of {last:,}; using its newest checkpoint")


def cropped(run: Run, crop: Corners | None = None, outlines: Outlines | None = None) -> Run:
    """The run without what is outside a box between two corners, and outlines, by default those in
    its survey; says how much that is. ConfigError as for ``Run.cropped``."""
    from mrgs.survey import Survey

    found = run.cropped(run.box_in(Survey(crop=crop, crop_outlines=outlines)))
    if found.crop is not None:
        print_note(f"{found.left_out:,} Gaussians are left out: not in the box {found.crop}")
    return found


def print_baking_loss(loss: BakingLoss) -> None:
    """PSNR on the held-out views that plain splats lose against the trained model."""
    known = {each.title: round(value, 2) + 0.0 for each, value in loss.items() if value is not None}
    lost = ", ".join(f"{title} {value:.2f} dB" for title, value in known.items())
    print(f"quality loss of the export: {lost or 'unknown, there are no held-out views'}")


def print_exported(folder: Path, paths: Sequence[Path]) -> None:
    """How much an export wrote, and which file to open first."""
    page = next((path for path in paths if path.suffix == ".html"), None)
    size = sum(path.stat().st_size for path in paths)
    say(
        f"files: {folder} ({len(paths):,} files, {size / 1e6:,.1f} MB)",
        f"open:  {page} (in a browser)" if page is not None else f"open:  {paths[0]}",
    )


def scene_if_there(run: Run) -> Scene | None:
    """The run's scene, or None with a note if it cannot be read."""
    try:
        return run.load_scene()
    except SceneError as error:
        print_note(f"photos and cameras are not available: {error}")
        return None


def print_metrics(run: TrainedRun, metrics: Metrics) -> None:
    """Print the mean scores, the number of Gaussians and the training time."""
    print_figures(metrics)
    gaussians = "" if run.gaussian_count is None else f"{run.gaussian_count:,} Gaussians, "
    print(f"{gaussians}{run.facts.train_seconds / 60:.1f} minutes of training")


def print_figures(metrics: Metrics) -> None:
    """Print the mean scores, one line per modality; the alternative conventions of PSNR and SSIM
    are in the report only."""
    from mrgs.evaluation.report import COLUMNS, format_figure

    groups = [(modality.title, figures) for modality, figures in metrics.mean.items()]
    for title, figures in (*groups, ("truth", metrics.truth or {})):
        shown = []
        for name, value in figures.items():
            if isinstance(value, float) and name not in ("psnr_matched", "ssim_pair_range"):
                heading, _, unit = COLUMNS[name][0].partition(", ")
                shown.append(f"{heading} {format_figure(name, value)} {unit}".rstrip())
        if shown:
            print(f"{title + ':':9}{'  '.join(shown)}")
    if metrics.aligned is not None:
        print("with each photo aligned with the model:")
        print_figures(metrics.aligned)
