"""Measure and write the report: ``python -m benchmarks.quality SCENE... --commits now 0981875``."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.__main__ import machine
from benchmarks.quality import child
from benchmarks.quality.commits import ROOT, sources
from benchmarks.quality.plan import (
    WORKING_TREE,
    Curve,
    Job,
    Point,
    curve_from_json,
    curve_to_json,
    jobs_of,
    variants_of,
)
from benchmarks.quality.report import TITLES, draw, to_markdown

GENERATED_SEEDS = (100, 101, 102)
"""Of the scenes that are made where none is given; no setting was chosen on them."""

WARM_UP_STEPS = 3


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, score and report; what the output folder already holds is kept."""
    options = _parse(arguments)
    options.output.mkdir(parents=True, exist_ok=True)
    changes = {"": ""} | {path.stem: path.read_text(encoding="utf-8") for path in options.changes}
    names = [*changes] if options.unchanged or not options.changes else [*changes][1:]
    variants = variants_of(options.methods, options.presets, options.commits, names)
    scenes = [str(scene) for scene in options.scenes] or _generated()
    jobs = jobs_of(variants, scenes, options.seeds)
    curves = _measure(jobs, changes, options)
    text = to_markdown(curves, dict(options.target), _heading(options, scenes))
    (options.output / "quality.md").write_text(text, encoding="utf-8")
    draw(curves, options.output / "quality.png")
    print(text)
    return 0


def _measure(
    jobs: Sequence[Job], changes: Mapping[str, str], options: argparse.Namespace
) -> list[Curve]:
    """The curves of all jobs, in their order; those that the store lacks are trained."""
    store = options.output / "quality.json"
    curves = _read(store)
    done = {curve.job for curve in curves}
    missing = [job for job in jobs if job not in done]
    with sources(job.variant.commit for job in missing) as folders, TemporaryDirectory() as scratch:
        for commit, job in {job.variant.commit: job for job in missing}.items():
            print(f"compiling {commit}", flush=True)
            _train(job, folders, scratch, changes, options, max_steps=WARM_UP_STEPS)
        for number, job in enumerate(missing, start=1):
            name = f"{job.variant.name}, {Path(job.scene).name}, seed {job.seed}"
            print(f"{number}/{len(missing)} {name}", flush=True)
            curves.append(Curve(job, _train(job, folders, scratch, changes, options)))
            _write_json(store, curves, options)
    by_job = {curve.job: curve for curve in curves}
    return [by_job[job] for job in jobs]


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality",
        description="Processor seconds and minutes until a training reaches a quality. The first "
        "method, preset, commit and change are what the others are compared with.",
    )
    parser.add_argument(
        "scenes", nargs="*", type=Path, help="scene folders; by default three are generated"
    )
    parser.add_argument("--methods", nargs="+", default=["mrgs-plus"])
    parser.add_argument("--presets", nargs="+", default=["fast"])
    parser.add_argument(
        "--commits", nargs="+", default=[WORKING_TREE], help=f"{WORKING_TREE}: the working tree"
    )
    parser.add_argument(
        "--changes",
        nargs="+",
        type=Path,
        default=[],
        metavar="YAML",
        help="files with changed values of the configuration, a variant each",
    )
    parser.add_argument(
        "--unchanged", action="store_true", help="with --changes: also the preset as it is, first"
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--points", type=int, default=10, help="models that are scored on the way")
    parser.add_argument("--max-steps", type=int)
    parser.add_argument("--max-gaussians", type=int)
    parser.add_argument("--resolution", type=int)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument(
        "--target",
        nargs="+",
        type=_target,
        default=[],
        metavar="SCORE=VALUE",
        help=f"{', '.join(TITLES)}; by default what the first variant ends with",
    )
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "results" / "quality")
    return parser.parse_args(arguments)


def _target(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in TITLES:
        raise argparse.ArgumentTypeError(f"{name!r} is none of {', '.join(TITLES)}")
    return name, float(value)


def _generated() -> list[str]:
    """Random scenes that no setting was chosen on, kept in ``build``."""
    from mrgs_synth import synthesize  # type: ignore[import-untyped]

    scenes = []
    for seed in GENERATED_SEEDS:
        folder = ROOT / "build" / "scenes" / f"random-{seed}"
        if not (folder / "transforms.json").exists():
            print(f"generating {folder}", flush=True)
            synthesize(folder, scene="random", seed=seed, width=160, height=120, samples=16)
        scenes.append(os.path.relpath(folder))
    return scenes


def _train(
    job: Job,
    folders: Mapping[str, Path],
    scratch: str,
    changes: Mapping[str, str],
    options: argparse.Namespace,
    max_steps: int | None = None,
) -> list[Point]:
    """One training in a process of its own, with the code of its commit."""
    with TemporaryDirectory(dir=scratch) as folder:
        request = {
            "scene": str(Path(job.scene).resolve()),
            "folder": folder,
            "method": job.variant.method,
            "preset": job.variant.preset,
            "change": changes[job.variant.change],
            "seed": job.seed,
            "points": options.points if max_steps is None else 1,
            "max_steps": max_steps or options.max_steps,
            "max_gaussians": options.max_gaussians,
            "resolution": options.resolution,
        }
        threads = str(options.threads)
        environment = os.environ | {
            "PYTHONPATH": str(folders[job.variant.commit]),
            "OMP_NUM_THREADS": threads,
            "NUMBA_NUM_THREADS": threads,
            "OMP_WAIT_POLICY": "PASSIVE",
        }
        result = subprocess.run(
            [sys.executable, "-W", "ignore", child.__file__, json.dumps(request)],
            env=environment,
            cwd=folder,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        )
    lines = [json.loads(line) for line in result.stdout.splitlines() if line.startswith("{")]
    return [Point(**line) for line in lines]


def _read(store: Path) -> list[Curve]:
    if not store.exists():
        return []
    entries = json.loads(store.read_text(encoding="utf-8"))["curves"]
    return [curve_from_json(entry) for entry in entries]


def _write_json(store: Path, curves: Sequence[Curve], options: argparse.Namespace) -> None:
    content: dict[str, Any] = {
        "machine": machine(options.threads),
        "curves": [curve_to_json(curve) for curve in curves],
    }
    store.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _heading(options: argparse.Namespace, scenes: Sequence[str]) -> list[str]:
    facts = machine(options.threads)
    return [
        f"{facts['processor']}, {facts['threads']} threads; {len(scenes)} scenes "
        f"({', '.join(Path(scene).name for scene in scenes)}), {options.seeds} seeds each."
    ]


if __name__ == "__main__":
    sys.exit(main())
