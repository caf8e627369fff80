"""``python -m tests.faults``: every attack in its long form, and a table at the end.

Needs Linux; attacks that mount a disk are left out without the right to do so. The attacks of the
``test_*.py`` files beside this one that need no process of their own run in pytest.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.faults import (
    blocks,
    fuzz,
    injections,
    interruptions,
    kills,
    memory,
    messages,
    places,
    soak,
    texts,
)
from tests.faults.program import SMALL, run, small_scene
from tests.faults.tally import Tally

ALL_SIGNALS = ("KILL", *interruptions.SIGNALS)
HERE = Path(__file__).parent
Attack = Callable[[Path], Tally]


def attacks(inputs: int, seed: int) -> Iterator[tuple[str, Attack]]:
    """Title and attack, in the order of the table; of texts so many inputs for each reader."""
    rng = random.Random(0)
    moments = [rng.uniform(0.1, 1) for _ in range(30)]
    yield "kill -9 of trainings", lambda at: kills.trainings(at, 50)
    yield "kill -9 of pipelines", lambda at: kills.pipelines(at, 7)
    yield "signals to blocks", lambda at: blocks.kills(at, 20)
    yield "kill -9 of writers", kills.writes
    yield "kill -9 of prepare", lambda at: interruptions.preparations(at, moments, signal.SIGKILL)
    yield "signals to trainings", lambda at: interruptions.trainings(at, 3 * interruptions.SIGNALS)
    yield "signals to compare", lambda at: interruptions.comparisons(at, ALL_SIGNALS)
    yield "signals to prepare", lambda at: interruptions.preparations(at, moments[:10])
    early = [place / 5 for place in range(1, 21)]
    yield "Ctrl-C while loading", lambda at: interruptions.imports(at, early)
    yield "outputs closed or full", interruptions.outputs
    yield "limited file sizes", lambda at: places.file_size(at, (2048, 8192, 65536))
    if os.geteuid() == 0:
        yield "full disks", _full_disks
        yield "the full disk of a block", blocks.full_disk
    yield "unusual names", lambda at: places.names(at, commands=("eval", "report", "export"))
    yield "fuzzed thermal photos", lambda at: fuzz.radiometric(at, 5000)
    yield "fuzzed poses", lambda at: fuzz.poses(at, 2000)
    yield "fuzzed texts", lambda at: texts.attacks(at, inputs, seed)
    yield "fuzzed messages to the viewer", lambda at: messages.messages(at, _trained(at), 5000)
    yield "values put into trainings", lambda at: injections.values(at, 100)
    yield "memory estimates", memory.estimates
    for path in sorted(HERE.glob("test_*.py")):
        if path.name != "test_short.py":
            yield path.stem.removeprefix("test_").replace("_", " "), lambda at, p=path: _pytest(p)


def main() -> int:
    """Run the attacks; returns the exit status, 1 if something did not hold."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--soak-hours", type=float, default=2.0, help="0 leaves the soak out")
    parser.add_argument(
        "--texts", type=int, default=1_000_000, help="inputs for each reader of text"
    )
    parser.add_argument("--seed", type=int, default=0, help="of these inputs")
    parser.add_argument("--only", default="", help="part of the titles of the attacks to run")
    options = parser.parse_args()
    hours = options.soak_hours
    soaking = (f"soak of {hours:g} h", lambda at: soak.training(at, hours * 3600))
    with ThreadPoolExecutor(1) as beside:  # the soak needs one core, and only time
        soaked = [beside.submit(_tried, *soaking)] if options.only in soaking[0] and hours else []
        chosen = attacks(options.texts, options.seed)
        rows = [_tried(*attack) for attack in chosen if options.only in attack[0]]
        rows += [each.result() for each in soaked]
    print("\n| attack | tried | held | failed | minutes | |\n|---|---:|---:|---:|---:|---|")
    for title, tally, seconds in rows:
        failed = len(tally.failures)
        counts = f"{tally.tried:,} | {tally.tried - failed:,} | {failed:,} | {seconds / 60:.1f}"
        print(f"| {title} | {counts} | {tally.figure} |")
    return int(any(tally.failures for _, tally, _ in rows))


def _tried(title: str, attack: Attack) -> tuple[str, Tally, float]:
    """Title, what an attack finds, and its seconds; one that fails itself must not end others."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mrgs-faults-") as folder:
        try:
            tally = attack(Path(folder))
        except Exception as error:
            traceback.print_exc()
            tally = Tally(1, [f"the attack itself: {error!r}"])
    print(f"{title}: {tally.tried} tried, {len(tally.failures)} failed", flush=True)
    for failure in tally.failures:
        print(f"  {failure}", flush=True)
    return title, tally, time.monotonic() - began


def _full_disks(folder: Path) -> Tally:
    return places.full_disks(folder, _trained(folder), (0, 20_000, 60_000, 200_000))


def _trained(folder: Path) -> Path:
    trained = folder / "trained"
    run("train", small_scene(folder / "scene"), "--output", trained, *SMALL, "--max-steps", 20)
    return trained


def _pytest(path: Path) -> Tally:
    """The tests of a file as cases."""
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "-n", "0", str(path)],
        cwd=HERE.parents[1], capture_output=True, text=True, check=False,
    )  # fmt: skip
    passed = re.search(r"(\d+) passed", found.stdout)
    failures = re.findall(r"^(?:FAILED|ERROR) (.*)$", found.stdout, re.MULTILINE)
    if (found.returncode != 0 or passed is None) and not failures:
        failures = [f"pytest ended with status {found.returncode}: {found.stdout[-200:]!r}"]
    return Tally((int(passed[1]) if passed else 0) + len(failures), failures)


if __name__ == "__main__":
    sys.exit(main())
