from __future__ import annotations

import asyncio
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from benchmarks.live_view import ALONE, PAUSES_S, Turn, looks, to_markdown, watch
from mrgs.render import Model
from mrgs.runs.open import load_run
from mrgs.training import make_config, train
from mrgs.viewer.server import start_at, start_camera
from mrgs.viewer.source import TrainedSource
from mrgs.viewer.web import Viewer
from tests.benchmarks.tables import rows
from tests.helpers.subjects import subject_of


class Watched(list):
    """Looks that tell when a picture of the first has come."""

    def __init__(self, looks: list) -> None:
        super().__init__(looks)
        self.drawn = threading.Event()

    def __getitem__(self, number):
        if number > 0:
            self.drawn.set()
        return super().__getitem__(number)


class Charged(TrainedSource):
    """Tells which threads account for the time that they use."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.threads: set[str] = set()

    def charge(self) -> None:
        self.threads.add(threading.current_thread().name)


def test_the_onlooker_is_a_browser_to_the_viewer(small_scene, tmp_path):
    """It is drawn for and receives pictures until the server goes; painting and serving are
    accounted for."""
    asked = Watched(looks(small_scene))
    run = load_run(
        train(small_scene, tmp_path / "run", make_config(max_steps=3, max_gaussians=60)).path
    )
    scene, source = run.load_scene(), Charged(run.model)
    subject = replace(subject_of(run, scene, tmp_path), source=source)
    start = start_at(start_camera(scene, run.model), scene)
    viewer = Viewer(subject, start, "127.0.0.1", 0)
    with ThreadPoolExecutor(1) as pool:
        pictures = pool.submit(lambda: asyncio.run(watch(viewer.url, 0.1, asked)))
        try:
            assert asked.drawn.wait(60)
        finally:
            viewer.close()
        assert pictures.result(20) >= 1
    assert len(source.threads) == 2


def test_the_table_compares_each_watched_training_with_the_one_alone_of_its_round():
    alone = [
        Turn(10.0, 8.0, 0.0, 0.0, 0),
        Turn(20.0, 8.0, 0.0, 0.0, 0),
        Turn(10.0, 8.0, 0.0, 0.0, 0),
    ]
    watched = [
        Turn(10.4, 8.8, 0.4, 0.1, 7),
        Turn(20.4, 8.2, 0.4, 0.2, 9),
        Turn(10.3, 8.4, 0.3, 0.2, 8),
    ]
    found = rows(to_markdown({ALONE: alone, **dict.fromkeys(PAUSES_S, watched)}))
    assert found[2][:3] == ["alone", "10.0 s", "8.0 s"]
    assert [re.findall(r"[\d.]+", cell) for cell in found[3][1:]] == [
        ["3.0", "2.0", "4.0"],  # wall: the median, the least, the most
        ["5.0", "2.5", "10.0"],
        ["3.0", "2.0", "4.0"],
        ["1.0", "1.0", "2.0"],
        ["5.0", "3.0", "5.0"],
        ["8"],
    ]
