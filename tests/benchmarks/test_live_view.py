from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import ThreadPoolExecutor

from benchmarks import live_view
from benchmarks.live_view import ALONE, PAUSES_S, Turn, looks, to_markdown, watch
from mrgs.runs.open import load_run
from mrgs.training import make_config, train
from mrgs.viewer.opening import open_viewer
from mrgs.viewer.source import TrainedSource


def test_the_onlooker_is_a_browser_to_the_viewer(small_scene, tmp_path, monkeypatch):
    """It is drawn for and receives pictures until the server goes; painting and serving are
    accounted for."""
    charged = set()
    monkeypatch.setattr(
        TrainedSource, "charge", lambda _: charged.add(threading.current_thread().name)
    )
    monkeypatch.setattr(live_view, "SCENE", small_scene)
    asked = looks()
    run = load_run(
        train(small_scene, tmp_path / "run", make_config(max_steps=3, max_gaussians=60)).path
    )
    viewer = open_viewer(run, run.load_scene(), "127.0.0.1", 0)
    with ThreadPoolExecutor(1) as pool:
        pictures = pool.submit(lambda: asyncio.run(watch(viewer.url, 0.1, asked)))
        try:
            _until(lambda: len(charged) == 2)
            time.sleep(0.3)  # the picture is on its way
        finally:
            viewer.close()
        assert pictures.result(20) >= 1
    assert "mrgs-viewer" in charged


def _until(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


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
    lines = to_markdown({ALONE: alone, **dict.fromkeys(PAUSES_S, watched)}).splitlines()
    assert lines[2] == "| alone | 10.0 s | 8.0 s | | | | |"
    assert lines[3].split(" | ")[1:] == [
        "3.0 % (2.0 to 4.0)", "5.0 % (2.5 to 10.0)", "3.0 % (2.0 to 4.0)", "1.0 % (1.0 to 2.0)",
        "5.0 % (3.0 to 5.0)",
        "8 |",
    ]  # fmt: skip
