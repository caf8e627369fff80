"""What watching costs a training: ``python -m benchmarks.live_view``.

The bundled scene is trained again and again, in turns: alone; watched by somebody who moves the
camera now and then; and by somebody who never stops dragging it. The onlooker is a process of its
own that asks for pictures as the page does, but throws every picture away: a browser's
drawing is the browser's cost, and may happen elsewhere.

The trainings of a round are compared by the clock and by the processor time of the process (a
picture is drawn with all cores, most of a step is not: so it takes a larger share of the processor
time than of the time). What else runs on the machine blurs both. So the viewer's cost is also taken
directly, within the watched training: how long it stood still for the viewer, and the processor
time of the viewer's own threads (web server, painting), for which no core may be free.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import websockets

from mrgs import load_scene, make_config, train
from mrgs.pictures.page_data import camera_facts
from mrgs.scene.camera import orbit
from mrgs.training import StepStatistics
from mrgs.viewer import LiveView

SCENE = Path(__file__).parents[1] / "examples" / "tabletop"
WINDOW_PX = (1280, 800)
PATH_CAMERAS = 240

ALONE = "alone"
PAUSES_S = {"a camera every 3 s": 3.0, "dragged without end, 30 cameras per second": 1 / 30}
"""Time between two cameras of each kind of onlooker."""


@dataclass(frozen=True)
class Turn:
    """One training from the end of its first step to that of its last.

    Attributes:
        wall_s: how long it took.
        process_s: processor time of the process, which has the viewer too.
        halted_s: how long it stood still for the viewer.
        beside_s: processor time of all other Python threads.
        pictures: how many the onlooker received.
    """

    wall_s: float
    process_s: float
    halted_s: float
    beside_s: float
    pictures: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.live_view", description="What watching a training costs."
    )
    parser.add_argument("--rounds", type=int, default=4, help="trainings of each kind")
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args(arguments)
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    onlooker = multiprocessing.get_context("spawn").Process(
        target=look_on, args=(theirs,), daemon=True
    )
    onlooker.start()
    kinds = [ALONE, *PAUSES_S]
    for kind in kinds:  # loads the compiled kernels
        train_once(kind, 40, ours)
    turns: dict[str, list[Turn]] = {kind: [] for kind in kinds}
    for number in range(options.rounds):
        for kind in kinds:
            turns[kind].append(train_once(kind, options.steps, ours))
            print(
                f"{number + 1}/{options.rounds} {kind}: {turns[kind][-1]}",
                file=sys.stderr,
                flush=True,
            )
    ours.send(None)
    onlooker.join()
    print(to_markdown(turns))
    return 0


def train_once(kind: str, steps: int, onlooker: Connection) -> Turn:
    """Train the bundled scene from its start, watched or not."""
    starts_s: list[float] = []
    halts_s: list[float] = []
    process_s: list[float] = []
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        run = Path(folder) / "run"
        live = None
        if kind != ALONE:
            live = stack.enter_context(
                LiveView(run, port=0, on_ready=lambda url: onlooker.send((url, PAUSES_S[kind])))
            )

        def on_step(statistics: StepStatistics) -> None:
            starts_s.append(time.perf_counter())
            process_s.append(time.process_time())
            if live is not None:
                live.on_step(statistics)
            halts_s.append(time.perf_counter() - starts_s[-1])

        hooks = {} if live is None else {"on_start": live.on_start, "on_model": live.on_model}
        train(SCENE, run, make_config("mrgs", "fast", max_steps=steps), on_step=on_step, **hooks)
        beside_s = _processor_time_of_other_threads()
    pictures = 0 if live is None else onlooker.recv()
    return Turn(
        starts_s[-1] - starts_s[0],
        process_s[-1] - process_s[0],
        sum(halts_s[:-1]),
        beside_s,
        pictures,
    )


def _processor_time_of_other_threads() -> float:
    """Of Python's threads alone: those of the kernels are none."""
    others = [
        thread.ident for thread in threading.enumerate() if thread is not threading.current_thread()
    ]
    return sum(
        time.clock_gettime(time.pthread_getcpuclockid(ident))
        for ident in others
        if ident is not None
    )


def to_markdown(turns: dict[str, list[Turn]]) -> str:
    """Medians over the rounds with their ranges, in percent; the first two beside the unwatched
    training of a round."""
    header = ("", "wall", "processor time", "stood still", "other threads", "both", "pictures")
    lines = [f"| {' | '.join(header)} |", "|" + "---|" * len(header)]
    alone = turns[ALONE]
    wall_s, process_s = (
        statistics.median(getattr(t, name) for t in alone) for name in ("wall_s", "process_s")
    )
    lines.append(f"| {ALONE} | {wall_s:.1f} s | {process_s:.1f} s | | | | |")
    for kind in PAUSES_S:
        rows = [_percentages(own, other) for own, other in zip(turns[kind], alone, strict=True)]
        cells = [
            f"{statistics.median(column):.1f} % ({min(column):.1f} to {max(column):.1f})"
            for column in zip(*rows, strict=True)
        ]
        pictures = statistics.median(turn.pictures for turn in turns[kind])
        lines.append(f"| {kind} | {' | '.join(cells)} | {pictures:g} |")
    return "\n".join(lines)


def _percentages(watched: Turn, alone: Turn) -> tuple[float, ...]:
    """How much longer, and how much more processor time, than alone; then what adds to the
    training's own time."""
    own_s = watched.wall_s - watched.halted_s
    return (
        100 * (watched.wall_s / alone.wall_s - 1),
        100 * (watched.process_s / alone.process_s - 1),
        100 * watched.halted_s / own_s,
        100 * watched.beside_s / own_s,
        100 * (watched.halted_s + watched.beside_s) / own_s,
    )


def look_on(orders: Connection) -> None:
    """The onlooker's process: watch each address that is sent, and send back how many pictures
    came."""
    cameras = looks()
    while (order := orders.recv()) is not None:
        orders.send(asyncio.run(watch(*order, cameras)))


def looks(scene: Path = SCENE) -> list[dict[str, Any]]:
    """Cameras around a scene, as the page asks for pictures from them."""
    width, height = WINDOW_PX
    facts = [
        camera_facts(camera.resized(width, height))
        for camera in orbit(load_scene(scene).train_cameras, PATH_CAMERAS)
    ]
    return [
        {
            "type": "look",
            "rotation": each["rotation"],
            "position": each["position"],
            "focal": [each["fx"], each["fy"]],
            "centre": [each["cx"], each["cy"]],
            "width": width,
            "height": height,
        }
        for each in facts
    ]


async def watch(url: str, pause_s: float, looks: Sequence[dict[str, Any]]) -> int:
    """Be a browser until the server goes; returns the number of pictures that it sent.

    As the page does, it asks for the next picture when it has the last, and for a sharp one where
    the camera rests.
    """
    pictures = 0
    parts = urlsplit(url)
    address = f"ws://{parts.netloc}/socket?{parts.query}"
    with suppress(websockets.ConnectionClosed):
        async with websockets.connect(address, compression=None, max_size=None) as socket:
            while True:
                efforts = ["moving"] if pause_s < 1 else ["moving", "resting"]
                for effort in efforts:
                    look = looks[pictures % len(looks)]
                    await socket.send(json.dumps({**look, "number": pictures, "effort": effort}))
                    while isinstance(await socket.recv(), str):
                        pass
                    pictures += 1
                await asyncio.sleep(pause_s)
    return pictures


if __name__ == "__main__":
    sys.exit(main())
