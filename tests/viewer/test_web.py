"""The viewer as other pages, other users and broken clients see it."""

from __future__ import annotations

import asyncio
import http.client
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import pytest
import websockets
from websockets.asyncio.client import ClientConnection, connect

from mrgs.errors import ConfigError, SceneError
from mrgs.marks import Mark
from mrgs.marks.store import MarkStore
from mrgs.survey import SURVEY_FILE, read_survey
from mrgs.viewer.board import MarkBoard
from mrgs.viewer.browser import MOST_CHANGES, Browser
from mrgs.viewer.server import open_viewer, start_at, title_of
from mrgs.viewer.web import MOST_GUESSES, Viewer
from tests.helpers.browsers import wait_until
from tests.viewer.test_messages import look

VISITS = 85
EVIL = "evil.example"


@pytest.fixture(scope="module")
def viewer(small_run, balls) -> Iterator[Viewer]:
    viewer = open_viewer(small_run, balls, "127.0.0.1", 0)
    yield viewer
    viewer.close()


@pytest.fixture
def own_viewer(small_run, balls) -> Iterator[Viewer]:
    """For tests after which a viewer may be busy with wrong tokens."""
    viewer = open_viewer(small_run, balls, "127.0.0.1", 0)
    yield viewer
    viewer.close()


def token(viewer: Viewer) -> str:
    return urlsplit(viewer.url).query


def ask(viewer: Viewer, path: str = "/", **headers: str) -> tuple[http.client.HTTPResponse, str]:
    """A request as a browser sends it; underscores in the headers' names stand for dashes."""
    connection = http.client.HTTPConnection("127.0.0.1", viewer.port, timeout=60)
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request("GET", path, headers=named)
    response = connection.getresponse()
    text = response.read().decode()
    connection.close()
    return response, text


def browse(
    viewer: Viewer, visit: Callable[[ClientConnection], Any], query: str | None = None, **options
) -> Any:
    """Run a visit over a socket of the viewer."""

    async def run() -> Any:
        address = f"ws://127.0.0.1:{viewer.port}/socket?{token(viewer) if query is None else query}"
        async with connect(address, max_size=None, **options) as connection:
            return await visit(connection)

    return asyncio.run(run())


async def picture(connection: ClientConnection, **changed: Any) -> dict[str, Any]:
    """Ask for a picture, and return its facts."""
    await connection.send(look(**changed))
    while isinstance(data := await asyncio.wait_for(connection.recv(), 60), str):
        pass
    assert data[4 + int.from_bytes(data[:4], "little") :].startswith(b"\xff\xd8"), "no JPEG"
    return json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")])


async def answer(connection: ClientConnection, *kinds: str) -> dict[str, Any]:
    """The next text of some kinds."""
    while True:
        data = await asyncio.wait_for(connection.recv(), 60)
        if isinstance(data, str) and (message := json.loads(data))["type"] in kinds:
            return message


def test_a_page_that_points_its_own_name_here_gets_nothing(viewer):
    """DNS rebinding: the request carries the other page's name, and knows the token."""
    host = f"{EVIL}:{viewer.port}"
    for path in (f"/?{token(viewer)}", "/"):
        response, text = ask(viewer, path, Host=host, Origin=f"http://{host}")
        assert (response.status, "token" in text) == (403, False)
    with pytest.raises(websockets.InvalidStatus) as refused:
        browse(viewer, picture, additional_headers={"Host": host}, origin=f"http://{host}")
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("origin", [f"http://{EVIL}", "null", "http://127.0.0.1:1", "https://x"])
def test_another_page_in_the_same_browser_gets_nothing(viewer, origin):
    """Its requests reach this address, with the browser's cookies, and with its own origin."""
    cookie = ask(viewer, f"/?{token(viewer)}")[0].headers["Set-Cookie"].split(";")[0]
    assert ask(viewer, "/", Cookie=cookie, Origin=origin)[0].status == 403
    with pytest.raises(websockets.InvalidStatus):
        browse(viewer, picture, "", origin=origin, additional_headers={"Cookie": cookie})
    own = f"http://127.0.0.1:{viewer.port}"
    cookies = {"Cookie": cookie}
    assert browse(viewer, picture, "", origin=own, additional_headers=cookies)["number"] == 1


def test_nobody_gets_in_without_the_token(viewer):
    response, text = ask(viewer)
    assert response.status == 403
    assert 'name="token"' in text
    assert viewer._gate.token not in text
    assert ask(viewer, "/?token=wrong")[0].status == 403
    for query in ("", "token=wrong"):
        with pytest.raises(websockets.InvalidStatus):
            browse(viewer, picture, query)


@pytest.mark.parametrize(
    ("path", "status"),
    [("/?token=é", 403), ("/?token=%FF", 403), ("//[x", 404), ("/?token=a&[", 403)],
)
def test_odd_addresses_are_answered(viewer, path, status):
    with socket.create_connection(("127.0.0.1", viewer.port), timeout=60) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        assert connection.recv(12) == f"HTTP/1.1 {status}".encode()


def test_wrong_tokens_wait_for_each_other_and_right_ones_do_not(own_viewer, monkeypatch):
    viewer = own_viewer
    monkeypatch.setattr("mrgs.viewer.web.GUESS_S", 3600.0)
    guesses = [socket.create_connection(("127.0.0.1", viewer.port)) for _ in range(MOST_GUESSES)]
    for number, guess in enumerate(guesses):
        wrong = b"/?token=guess" if number % 2 else b"/"
        cookie = b"Cookie: mrgs-viewer-%d=guess\r\n" % viewer.port
        guess.sendall(b"GET " + wrong + b" HTTP/1.1\r\nHost: localhost\r\n" + cookie + b"\r\n")
    wait_until(lambda: len(viewer._guessing) == MOST_GUESSES, "all wait")
    assert ask(viewer, "/?token=guess")[0].status == 429
    assert ask(viewer, f"/?{token(viewer)}")[0].status == 303
    for guess in guesses:
        guess.setblocking(False)
        with pytest.raises(BlockingIOError):
            guess.recv(1)
        guess.close()


def test_the_token_leaves_the_address_for_a_cookie(viewer):
    response, _ = ask(viewer, f"/?{token(viewer)}")
    assert (response.status, response.headers["Location"]) == (303, "/")
    cookie = response.headers["Set-Cookie"]
    assert {"HttpOnly", "SameSite=Strict"} <= set(cookie.split("; "))
    response, text = ask(viewer, "/", Cookie=cookie.split(";")[0])
    assert response.status == 200
    assert viewer._gate.token not in text


def test_the_policy_lets_nothing_else_in(viewer):
    cookie = f"mrgs-viewer-{viewer.port}={viewer._gate.token}"
    for headers in ({"Cookie": cookie}, {}, {"Host": EVIL}):
        response, _ = ask(viewer, **headers)
        policy = response.headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'none'")
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert response.headers["X-Content-Type-Options"] == "nosniff"
        assert response.headers["Cache-Control"] == "no-store"
        assert "Access-Control-Allow-Origin" not in response.headers


def test_on_the_network_the_token_is_asked_for_as_well(small_run):
    viewer = open_viewer(small_run, None, "0.0.0.0", 0)
    try:
        assert ask(viewer, Host=f"192.0.2.7:{viewer.port}")[0].status == 403
        response, _ = ask(viewer, f"/?{token(viewer)}", Host=f"192.0.2.7:{viewer.port}")
        assert response.status == 303
        assert ask(viewer, f"/?{token(viewer)}", Host=EVIL)[0].status == 403
        assert viewer.url.startswith("http://127.0.0.1:")
    finally:
        viewer.close()


def test_only_this_computer_is_served_unless_the_user_says_otherwise(viewer):
    # Who listens on all addresses answers at this one as well, on whatever network.
    with pytest.raises(OSError, match=r"refused|timed out|assign|unreachable"):
        socket.create_connection(("127.0.0.2", viewer.port), 5)


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/etc/passwd",
        "/socket/..", "/page/app.js", "/" + "a" * 7000,
    ],
)  # fmt: skip
def test_no_file_is_served(viewer, path):
    response, text = ask(viewer, path, Cookie=f"mrgs-viewer-{viewer.port}={viewer._gate.token}")
    assert response.status in (400, 404)
    assert "root:" not in text


def test_rubbish_ends_itself_alone(viewer, caplog):
    for number in range(20):
        with socket.create_connection(("127.0.0.1", viewer.port), 10) as raw:
            raw.sendall(os.urandom(500) if number % 2 else b"GET / HTTP/1.1\r\nX: " + b"a" * 20_000)
    silent = [socket.create_connection(("127.0.0.1", viewer.port), 10) for _ in range(20)]
    assert browse(viewer, picture)["number"] == 1
    for each in silent:
        each.close()
    assert caplog.text == ""


def test_messages_that_mean_nothing_are_answered_and_have_no_effect(viewer):
    async def visit(connection: ClientConnection) -> None:
        nonsense = ["", "{", "[]", '{"type": "no"}', b"\x00\xff", look(position=[1e300, 0, 0])]
        nonsense += [look(rotation=[1.0] * 9), '{"type": "choose", "mode": 999}']
        nonsense += ['{"type": "photo", "index": 99999}', '{"type": "judge", "mark": 5}']
        for data in nonsense:
            await connection.send(data)
            assert (await answer(connection, "status"))["failed"]
        await connection.send('{"type": "delete_mark", "mark": 999}')
        refused = await answer(connection, "refused")
        assert refused["mark"] == 999
        assert "deleted" in refused["text"]
        assert (await picture(connection))["number"] == 1

    browse(viewer, visit)


def test_a_message_that_is_too_large_ends_its_connection(viewer):
    async def visit(connection: ClientConnection) -> None:
        with suppress(websockets.ConnectionClosed):
            await connection.send("x" * 2_000_000)
        await connection.wait_closed()

    browse(viewer, visit)
    assert browse(viewer, picture)["number"] == 1


def test_many_visits_leave_nothing_behind(viewer):
    """Some leave while they are being set up, some in the middle of a picture, some without a
    word."""
    browse(viewer, picture)
    before = threading.active_count()

    async def visit(number: int) -> None:
        address = f"ws://127.0.0.1:{viewer.port}/socket?{token(viewer)}"
        connection = await connect(address, max_size=None)
        await connection.send(look(position=[3, 0.01 * number, 0]))
        await asyncio.sleep(0.01 * (number % 3))
        if number % 2:
            await connection.close()
        else:
            connection.transport.abort()

    async def visits() -> None:
        for number in range(VISITS):
            await visit(number)

    asyncio.run(visits())
    wait_until(lambda: not viewer.browsers, "all have been forgotten")
    wait_until(lambda: not viewer.busy, "nothing is drawn for them")
    wait_until(lambda: threading.active_count() <= before, "no thread is left")
    assert browse(viewer, picture)["number"] == 1


def test_a_browser_that_takes_nothing_is_cut_off(viewer):
    """It asks and asks, and never reads."""

    async def visit(connection: ClientConnection) -> None:
        with suppress(websockets.ConnectionClosed):
            while True:
                await connection.send(json.dumps({"type": "unheard" * 5000}))

    with socket.socket() as narrow:
        narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        narrow.connect(("127.0.0.1", viewer.port))
        browse(viewer, visit, sock=narrow)
    wait_until(lambda: not viewer.browsers, "it is cut off")


def test_nothing_is_drawn_unless_somebody_asks(viewer):
    async def visit(connection: ClientConnection) -> None:
        await answer(connection, "hello")
        viewer.refresh("Step 2.")
        assert (await answer(connection, "note"))["text"] == "Step 2."
        (browser,) = viewer.browsers
        while viewer.busy:
            await asyncio.sleep(0.01)
        assert browser.inspection.drawn is None

    wait_until(lambda: not viewer.busy, "it has warmed up")
    browse(viewer, visit)


def test_of_many_places_on_the_way_the_newest_is_drawn(viewer):
    async def visit(connection: ClientConnection) -> int:
        for number in range(1, 41):
            await connection.send(look(number=number, position=[3, 0.01 * number, 0]))
        received = 0
        while True:
            data = await asyncio.wait_for(connection.recv(), 60)
            if isinstance(data, bytes):
                received += 1
                facts = json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")])
                if facts["number"] == 40:
                    return received

    assert browse(viewer, visit) < 20


def test_a_rest_sharpens_up_to_the_screens_resolution(viewer):
    async def visit(connection: ClientConnection) -> list[bool]:
        size = {"width": 1600, "height": 1200, "focal": [1000, 1000], "centre": [800, 600]}
        efforts = ("moving", "resting", "still")
        return [(await picture(connection, effort=each, **size))["full"] for each in efforts]

    assert browse(viewer, visit) == [False, False, True]


def test_what_a_browser_does_is_answered(viewer, balls):
    """Hover, click, spot, box, palette, photo and screenshot, as the page asks for them."""

    async def visit(connection: ClientConnection) -> None:
        hello = await answer(connection, "hello")
        assert hello["views"][0]["name"] == balls.train[0].name
        assert hello["modes"][0]["label"] == "Temperature"
        assert (hello["longest_side_px"], hello["video_seconds"]) == (4096, [0.5, 600])
        await picture(connection)
        await connection.send('{"type": "hover", "x": 0.5, "y": 0.5}')
        assert (await answer(connection, "hover"))["text"].endswith(" °C")
        await connection.send('{"type": "read", "x": 0.5, "y": 0.5}')
        assert (await answer(connection, "point"))["of"]["value"].endswith(" °C")
        await connection.send('{"type": "add_mark", "kind": "spot", "points": [[0.5, 0.5]]}')
        while not (marks := (await answer(connection, "marks"))["of"]):
            pass  # those that the file held
        assert (marks[0]["name"], marks[0]["kind"]) == ("S1", "spot")
        corners = [[0.45, 0.45], [0.55, 0.55]]
        await connection.send(json.dumps({"type": "add_mark", "kind": "box", "points": corners}))
        numbers = [mark["id"] for mark in (await answer(connection, "marks"))["of"]]
        assert len(numbers) == 2
        (pane,) = (await picture(connection, number=2))["panes"]
        ((x, y, label, short),) = pane["marks"]
        assert (x, y) == pytest.approx((0.5, 0.5), abs=0.02)
        assert label.startswith("S1  ")
        assert short == "S1"
        (outline,) = pane["outlines"]
        assert len(outline["corners"]) == 4
        spot, box = numbers
        change = {"type": "change_mark", "mark": box, "name": "Ball", "note": "warm"}
        await connection.send(json.dumps({**change, "emissivity": 0.9, "reflected_c": 15}))
        changed = (await answer(connection, "marks"))["of"][1]
        assert (changed["name"], changed["note"], changed["emissivity"]) == ("Ball", "warm", 0.9)
        await connection.send(json.dumps({"type": "change_mark", "mark": box, "severity": "2"}))
        changed = (await answer(connection, "marks"))["of"][1]
        assert (changed["name"], changed["severity"], changed["emissivity"]) == ("Ball", "2", 0.9)
        await connection.send(json.dumps({"type": "refer_to", "mark": spot}))
        assert (await answer(connection, "marks"))["of"][1]["difference"].startswith("ΔT ")
        await connection.send(json.dumps({"type": "delete_mark", "mark": box}))
        assert len((await answer(connection, "marks"))["of"]) == 1
        await connection.send('{"type": "undo"}')
        assert len((await answer(connection, "marks"))["of"]) == 2
        assert pane["scale"]["palette"] == "inferno"
        choice = {
            "type": "choose", "mode": 0, "palette": "iron", "scaled": "thermal",
            "limits": [10, 20], "isotherm": None, "share": 0.5, "marks": True,
        }  # fmt: skip
        await connection.send(json.dumps(choice))
        (pane,) = (await picture(connection, number=3))["panes"]
        assert pane["scale"] == {"palette": "iron", "low": 10, "high": 20, "unit": "°C"}
        await connection.send('{"type": "screenshot"}')
        saved = (await answer(connection, "status"))["text"]
        assert saved.startswith("Saved in the run's folder: renders/screenshots/")

    browse(viewer, visit)


def test_what_is_drawn_is_kept_and_what_cannot_be_is_refused(viewer, small_run):
    async def visit(connection: ClientConnection) -> None:
        async def keep(expected: str = "kept", **message: Any) -> dict[str, Any]:
            await connection.send(json.dumps({"type": "keep", **message}))
            while (told := await answer(connection, expected, "refused")).get("box", 0) == known[
                -1
            ]:
                pass  # what is kept is told again after it was measured in
            assert told["type"] == expected, told["text"]
            known.append(told.get("box", known[-1]))
            return told

        assert (await answer(connection, "hello"))["keeps"]
        first = await answer(connection, "kept")
        known = [first["box"]]
        assert (first["box"], first["left_out"]) == (None, 0)
        await picture(connection)
        box = await keep(kind="box", points=[[0.4, 0.4], [0.6, 0.6]])
        assert box["left_out"] + box["shown"] == small_run.gaussian_count
        assert box["left_out"] > 0
        low, high, outlines = box["box"]
        assert outlines == []
        wider = [low[0] - 9, *low[1:], *high]
        moved = await keep(kind="sides", sides=wider)
        assert moved["box"][0] == wider[:3]
        down = {"rotation": [1, 0, 0, 0, -1, 0, 0, 0, -1], "position": [0, 0, 4]}
        await picture(connection, **down)
        corners = [[0.1, 0.1], [0.9, 0.1], [0.5, 0.9]]
        drawn = await keep(kind="polygon", points=corners)
        assert len(drawn["box"][2][0]) == 3
        refused = await keep("refused", kind="sides", sides=[50, 50, 50, 51, 51, 51])
        assert (refused["mark"], "no Gaussian" in refused["text"]) == ("keep", True)
        refused = await keep("refused", kind="sides")
        assert "no inside" in refused["text"]
        refused = await keep("refused", kind="box", points=corners)
        assert "opposite" in refused["text"]
        refused = await keep("refused", kind="polygon", points=corners[:2])
        assert "no inside" in refused["text"]
        assert read_survey(small_run.folder.path / SURVEY_FILE).crop_outlines is not None
        for expected in (moved, box, first):
            assert (await keep(kind="undo"))["box"] == expected["box"]
        assert "nothing to undo" in (await keep("refused", kind="undo"))["text"]
        assert (await keep(kind="box", points=[[0.4, 0.4], [0.6, 0.6]]))["box"]
        assert (await keep(kind="all"))["box"] is None

    browse(viewer, visit)


@pytest.fixture
def held(viewer) -> Iterator[threading.Event]:
    """The model's thread is in the middle of a job until the event is set."""
    begun, go = threading.Event(), threading.Event()

    def wait() -> None:
        begun.set()
        assert go.wait(60)

    viewer._worker.put("held", wait)
    assert begun.wait(60)
    yield go
    go.set()


def test_a_closed_browser_leaves_its_changes_and_nothing_else(viewer, balls, request):
    board = viewer._subject.board
    place = tuple(balls.points.positions[0].tolist())
    spot = Mark("S1", "spot", (place,), (3.0, 0.0, 0.0), 0.1)
    board.edit(lambda marks: marks.adding(**vars(spot)))
    wait_until(lambda: not viewer.busy, "it has warmed up")

    async def visit(connection: ClientConnection) -> None:
        await answer(connection, "marks")
        while viewer.busy:
            await asyncio.sleep(0.01)
        request.getfixturevalue("held")
        change = {"type": "change_mark", "mark": board.numbers[-1]}
        await connection.send(json.dumps({**change, "note": "kept"}))
        await connection.send(json.dumps({**change, "severity": "2"}))
        await connection.send(look())
        await connection.send('{"type": "hover", "x": 0.5, "y": 0.5}')
        await answer(connection, "hover")

    browse(viewer, visit)
    wait_until(lambda: not viewer.browsers, "it has gone")
    assert sum(map(len, viewer._worker._jobs.values())) == 2
    request.getfixturevalue("held").set()
    wait_until(lambda: not viewer.busy, "the changes are made")
    assert (board.marks.marks[-1].note, board.marks.marks[-1].severity) == ("kept", "2")


def test_a_drive_that_does_not_answer_stops_no_browser(subject, camera):
    away, begun, go = threading.Event(), threading.Event(), threading.Event()

    class StoreOnDrive(MarkStore):
        @property
        def stamp(self) -> tuple[int, ...] | None:
            if away.is_set():
                begun.set()
                assert go.wait(60)
            return super().stamp

    async def visit(connection: ClientConnection) -> None:
        await picture(connection)
        while viewer.busy:
            await asyncio.sleep(0.01)
        away.set()
        while not begun.is_set():
            await asyncio.sleep(0.01)
        await connection.send('{"type": "hover", "x": 0.5, "y": 0.5}')
        assert (await answer(connection, "hover"))["text"].endswith(" °C")

    board = subject.board
    store = StoreOnDrive(board._store.folder, board._store._spread)
    subject = replace(subject, board=MarkBoard(store, board._instruments))
    viewer = Viewer(subject, start_at(camera, subject.scene), "127.0.0.1", 0)
    try:
        browse(viewer, visit)
    finally:
        go.set()
        viewer.close()


def test_nobody_changes_marks_faster_than_hands_can(viewer):
    sent = []

    def send(data) -> Future[None]:
        sent.append(json.loads(data))
        return Future()

    browser = Browser(viewer._subject, viewer._start, "", viewer._worker, send)
    for _ in range(MOST_CHANGES + 50):
        browser.receive('{"type": "change_mark", "mark": 7, "note": "x"}')
    hasty = [each for each in sent if "too many" in each.get("text", "")]
    assert [(each["type"], each["mark"]) for each in hasty] == 50 * [("refused", 7)]
    browser.close()


@pytest.mark.parametrize("effort", ["moving", "resting"])
def test_a_picture_that_cannot_be_drawn_is_not_waited_for(viewer, effort):
    sent = []

    def send(data) -> Future[None]:
        sent.append(json.loads(data))
        return Future()

    def fail(*_, **__) -> None:
        raise SceneError("photo.png: cannot be read")

    browser = Browser(viewer._subject, viewer._start, "", viewer._worker, send)
    browser.inspection = SimpleNamespace(picture=fail)
    browser.receive(look(number=4, effort=effort))
    wait_until(lambda: any(each["type"] == "status" for each in sent), "the error is told")
    assert [each["number"] for each in sent if each["type"] == "undrawn"] == [4]
    browser.close()


def test_a_port_that_is_taken_is_named(small_run):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        threads = threading.active_count()
        with pytest.raises(ConfigError, match=rf"127\.0\.0\.1:{port}"):
            open_viewer(small_run, None, "127.0.0.1", port)
        wait_until(lambda: threading.active_count() <= threads, "no thread is left")


def test_a_closed_viewer_leaves_no_thread(small_run, balls):
    before = threading.active_count()
    viewer = open_viewer(small_run, balls, "127.0.0.1", 0)
    browse(viewer, picture)
    viewer.close()
    wait_until(lambda: threading.active_count() <= before, "no thread is left")


@pytest.mark.slow
def test_view_beside_train(small_scene: Path, tmp_path: Path):
    """A run that trains in one process is shown by another, and both end well."""
    run = tmp_path / "run"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(["src", *filter(None, sys.path)])}
    command = [sys.executable, "-m", "mrgs"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": environment}
    training = subprocess.Popen(
        [*command, "train", small_scene, "--output", run, "--preset", "fast",
         "--max-steps", "200000", "--max-gaussians", "60"], **pipes,
    )  # fmt: skip
    viewing = None
    try:
        wait_until(lambda: any(run.glob("checkpoints/*")), "there is a checkpoint")
        viewing = subprocess.Popen([*command, "view", run, "--port", "0"], **pipes)
        assert viewing.stdout is not None
        url = urlsplit(viewing.stdout.readline().split()[1])

        async def visit() -> str:
            address = f"ws://{url.netloc}/socket?{url.query}"
            async with connect(address, max_size=None) as connection:
                note = (await answer(connection, "hello"))["note"]
                await picture(connection)
                return note

        assert "Still training" in asyncio.run(visit())
        assert training.poll() is None
        viewing.send_signal(2)
        assert viewing.wait(120) == 0
    finally:
        for process in filter(None, (viewing, training)):
            process.send_signal(2)
            process.communicate(timeout=120)


@pytest.mark.parametrize(
    ("folder", "scene", "title"),
    [
        ("farmhouse-mrgs/fast", "farmhouse", "farmhouse, fast"),
        ("runs/farmhouse-mrgs-plus", "farmhouse", "farmhouse-mrgs-plus"),
        ("runs/mine", "", "mine"),
    ],
)
def test_the_title_is_the_scenes_and_tells_its_runs_apart(folder, scene, title):
    assert title_of(Path(folder), scene) == title
