from __future__ import annotations

import json
import logging
import socket
import threading
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from http.cookiejar import CookieJar
from urllib.parse import urlsplit

import pytest
import torch
from torch import Tensor

from mrgs.errors import ConfigError, MrgsWarning, RunError
from mrgs.render import render
from mrgs.runs.open import load_run
from mrgs.scene import THERMAL, Blend, Camera, Gaussians, Rendering
from mrgs.training import StepStatistics, make_config, train
from mrgs.training.start import Hooks
from mrgs.viewer import LiveView, view
from mrgs.viewer.browser import Browser
from mrgs.viewer.server import open_viewer
from mrgs.viewer.source import LiveSource
from mrgs.viewer.web import require_free


def test_a_run_is_served_until_it_is_stopped(small_run, balls, capsys):
    stop, seen = threading.Event(), []

    def ready(url):
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor(CookieJar()))
        seen.append((url, opener.open(url, timeout=60).status))
        stop.set()

    view(small_run, balls, port=0, on_ready=ready, stop=stop)
    ((url, status),) = seen
    assert url.startswith("http://127.0.0.1:")
    assert status == 200
    with pytest.raises(OSError, match=r"refused|reset"):
        socket.create_connection(("127.0.0.1", urlsplit(url).port), timeout=60)
    assert capsys.readouterr().out == ""


def test_ctrl_c_ends_the_serving(small_run):
    def ready(_):
        raise KeyboardInterrupt

    view(small_run, None, port=0, on_ready=ready)


def test_a_port_in_use_is_named(small_run):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=rf"127\.0\.0\.1:{port}"):
            view(small_run, None, port=port)
        with pytest.raises(ConfigError, match=f"{port}"):
            LiveView("nowhere", port=port)


def test_addresses_that_cannot_be_are_named(small_run):
    for port in (70000, -1):
        with pytest.raises(ConfigError, match=f"not {port}"):
            view(small_run, None, port=port)
    with pytest.raises(ConfigError, match="65535"):
        require_free("127.0.0.1", 70000)
    with pytest.raises(ConfigError, match=r"no\.such\.invalid:8080"):
        require_free("no.such.invalid", 8080)


def test_an_empty_model_is_named(small_run):
    tensors = small_run.model.gaussians.tensors()
    empty = Gaussians.from_tensors({name: tensor[:0] for name, tensor in tensors.items()})
    with pytest.raises(RunError, match="no Gaussians"):
        view(replace(small_run, model=replace(small_run.model, gaussians=empty)), None, port=0)


def test_a_run_still_training_is_shown_from_its_checkpoint(small_run):
    with small_run.folder.locked():
        with pytest.warns(MrgsWarning, match="60 of 60"):
            viewer = open_viewer(small_run, None, "127.0.0.1", 0)
        assert "Still training" in viewer.note
        viewer.close()


CAMERA = Camera(
    torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]).double(), torch.eye(4).double(), 40, 30
)


class FakeBrowser(Browser):
    """Stands for somebody who looks."""

    def __init__(self, raises: bool = False) -> None:  # nothing of the real one
        self.notes: list[str] = []
        self.raises = raises

    def send(self, kind: str, **facts: str) -> None:
        if self.raises:
            raise RuntimeError("the browser burst")
        self.notes.append(facts["text"])

    def close(self) -> None:
        pass


def test_a_training_can_be_watched(small_scene, tmp_path):
    urls, values = [], []
    browser = FakeBrowser()
    with LiveView(tmp_path / "run", port=0, on_ready=urls.append) as live:

        def on_model(model, response):
            live.on_model(model, response)
            live._viewer._browsers[0] = browser

        def look():
            values.append(live._source.run(lambda model: len(model.gaussians)))

        looker = threading.Thread(target=look, daemon=True)
        looker.start()
        train(
            small_scene,
            tmp_path / "run",
            make_config("mrgs", max_steps=6, max_gaussians=60),
            hooks=Hooks(on_start=live.on_start, on_model=on_model, on_step=live.on_step),
        )
        looker.join(60)
    assert urls[0].startswith("http://127.0.0.1:")
    assert "1 of 6" in browser.notes[0]
    assert values[0] > 0


def thermal_rendering(image: Tensor) -> Rendering:
    """A rendering of temperatures alone, opaque."""
    depth = torch.ones(image.shape[:2])
    return Rendering({THERMAL: Blend(image, depth, depth)})


def test_a_training_is_compared_with_photos_as_its_cameras_write_them(small_scene, tmp_path):
    """The blur of ``mrgs-plus`` as it is learned by then; an image without detail stays as it
    is."""
    sharp = torch.zeros(CAMERA.height, CAMERA.width, 1)
    sharp[CAMERA.height // 2] = 1
    found = []
    with LiveView(tmp_path / "run", port=0) as live:

        def look(_):
            subject = live._viewer._subject
            written = [
                subject.camera_response(thermal_rendering(image), CAMERA)[THERMAL].image
                for image in (sharp, sharp * 0 + 0.5)
            ]
            found.append(written)

        config = make_config("mrgs-plus", max_steps=2, max_gaussians=60)
        no_shading = replace(config.image_model, thermal_drift=False, thermal_shading=False)
        config = replace(config, image_model=no_shading)
        train(
            small_scene, tmp_path / "run", config, hooks=Hooks(on_model=live.on_model, on_step=look)
        )
    run = load_run(tmp_path / "run")
    blurred, even = found[-1]
    expected = run.camera_response(thermal_rendering(sharp), CAMERA)
    torch.testing.assert_close(blurred, expected[THERMAL].image)
    assert not torch.equal(blurred, found[0][0])
    assert blurred.max() < 0.9
    torch.testing.assert_close(even, torch.full_like(even, 0.5))


def test_watching_changes_nothing(small_scene, tmp_path):
    """The same seed gives the same model, watched or not."""
    config = make_config("mrgs", max_steps=6, max_gaussians=60)
    alone = train(small_scene, tmp_path / "alone", config)
    seen: list[Tensor] = []

    def look(model):
        with torch.no_grad():
            seen.append(render(model, {THERMAL: CAMERA})[0][THERMAL].image)

    with ThreadPoolExecutor(1) as pool, LiveView(tmp_path / "watched", port=0) as live:
        live._source = LiveSource(share=1.0)

        def on_step(statistics):
            live._viewer._browsers.setdefault(0, FakeBrowser())
            pool.submit(live._source.run, look)
            time.sleep(0.05)  # the credit that the picture needs
            return live.on_step(statistics)

        watched = train(
            small_scene,
            tmp_path / "watched",
            config,
            hooks=Hooks(on_model=live.on_model, on_step=on_step),
        )
    assert seen
    first, second = load_run(alone.path).model.gaussians, load_run(watched.path).model.gaussians
    for name, tensor in first.tensors().items():
        assert torch.equal(tensor, second.tensors()[name]), name


def test_a_burst_viewer_does_not_stop_the_training(small_scene, tmp_path, caplog):
    with LiveView(tmp_path / "run", port=0) as live, caplog.at_level(logging.WARNING):

        def on_step(statistics):
            if live._viewer is not None:
                live._viewer._browsers.setdefault(0, FakeBrowser(raises=True))
            return live.on_step(statistics)

        folder = train(
            small_scene,
            tmp_path / "run",
            make_config("mrgs", max_steps=4, max_gaussians=60),
            hooks=Hooks(on_model=live.on_model, on_step=on_step),
        )
    assert "the browser burst" in caplog.text
    steps = [json.loads(line)["step"] for line in folder.log_file.read_text().splitlines()]
    assert steps[-1] == 4


def test_a_port_that_is_taken_meanwhile_does_not_stop_the_training(
    small_scene, tmp_path, caplog, small_run
):
    live = LiveView(tmp_path / "run", port=0)
    with socket.socket() as taken, caplog.at_level(logging.WARNING):
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        live._port = port = taken.getsockname()[1]
        live.on_model(small_run.model, small_run.camera_response)
        live.on_step(StepStatistics(1, 0.0, {}, None, 10, False))
    assert f":{port}" in caplog.text
    live.close()
