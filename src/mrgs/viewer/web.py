"""The web server: one page, one model, any number of browsers, and who may talk to it: whoever has
the token, from the server's own page, under a name of this computer."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import secrets
import socket
import threading
from collections.abc import Mapping, Sequence
from concurrent import futures
from contextlib import suppress
from http import HTTPStatus
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from mrgs.errors import ConfigError
from mrgs.pictures.html import Page, make_page
from mrgs.pictures.page_data import MARKS_STYLE, STAGE_SCRIPTS, STAGE_STYLE
from mrgs.scene import Camera
from mrgs.viewer.browser import LARGEST_MESSAGE, Browser
from mrgs.viewer.inspection import Inspection
from mrgs.viewer.panes import fitted_size
from mrgs.viewer.settings import Subject
from mrgs.viewer.source import Worker

SOCKET_PATH = "/socket"
SECONDS_TO_CLOSE = 2.0
WATCH_S = 1.0
"""Seconds between looks at files that others may change, while a browser is connected."""

GUESS_S, MOST_GUESSES = 0.5, 10
"""Seconds until a wrong token is answered, one at a time; and how many such requests may wait."""

MOST_WAITING = 64
"""Messages that a browser has not taken; one that lets more wait is cut off."""

LOCAL_NAME = "localhost"

POLICY = ["connect-src 'self'", "form-action 'self'"]
"""What the page may do beyond what a page from a file may."""

_log = logging.getLogger("mrgs.viewer.web")
_log.setLevel(logging.CRITICAL)  # a broken request is its sender's mistake


class Gate:
    """Checks the requests that reach a server; ``token`` is in the address to open.

    Another web page in the user's browser can send requests to any address, this computer's too:
    with its own origin or, where its name points at this address (DNS rebinding), that name as the
    host. Both are refused. Other users of the computer, and of the network, lack the token."""

    def __init__(self, host: str) -> None:
        self.token = secrets.token_urlsafe(24)
        self._host = host.lower()

    def is_own_host(self, hosts: Sequence[str]) -> bool:
        """Whether a request's ``Host`` headers, of which there must be one, name this computer: by
        an address, or by a name that nobody else can point here."""
        if len(hosts) != 1:
            return False
        name = _host_name(hosts[0])
        if name is None:
            return False
        if name in (self._host, LOCAL_NAME):
            return True
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return not _is_loopback(self._host) and name == socket.gethostname().lower()
        return address.is_loopback or not _is_loopback(self._host)

    def is_own_origin(self, origins: Sequence[str], hosts: Sequence[str]) -> bool:
        """Whether a request is of the server's own page, or of a program (without ``Origin``)."""
        if not origins:
            return True
        own = {f"{scheme}://{host}".lower() for scheme in ("http", "https") for host in hosts}
        return len(origins) == 1 and origins[0].lower() in own

    def knows(self, token: str | None) -> bool:
        """Whether a token is the server's."""
        guess = b"" if token is None else token.encode("utf-8", "replace")
        return secrets.compare_digest(guess, self.token.encode())

    def token_in(self, path: str) -> str | None:
        """The token in the query of a request's path; None without one."""
        return parse_qs(path.partition("?")[2]).get("token", [None])[0]

    def has_cookie(self, cookies: Sequence[str], port: int) -> bool:
        """Whether a request's ``Cookie`` headers have the token. Other servers of this computer may
        have set others, in whatever form."""
        pairs = [pair.partition("=") for each in cookies for pair in each.split(";")]
        return any(
            key.strip() == self._cookie_name(port) and self.knows(value.strip())
            for key, _, value in pairs
        )

    def has_cookie_name(self, cookies: Sequence[str], port: int) -> bool:
        """Whether a request's ``Cookie`` headers name the server's cookie, with whatever value."""
        return any(f"{self._cookie_name(port)}=" in each for each in cookies)

    def cookie(self, port: int) -> str:
        """The ``Set-Cookie`` header with which the page's browser keeps the token: scripts cannot
        read it, and requests from other pages do not carry it."""
        return f"{self._cookie_name(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _cookie_name(self, port: int) -> str:
        """Name of the cookie; each port has its own, since browsers share cookies between ports."""
        return f"mrgs-viewer-{port}"


class Viewer:
    """A web server that shows one model to any number of browsers.

    It has three threads, however many browsers come: one for the network, one for the model, and
    one that watches the files of the run, which may be on a drive that does not answer. A ``host``
    other than this computer's own makes the model visible to the network, for whoever has the
    token; port 0 takes a free one. ``url`` is the address to open, with the token. ConfigError if
    address or port cannot be used."""

    def __init__(self, subject: Subject, start: Mapping[str, Any], host: str, port: int) -> None:
        require_port(port)
        self.note = subject.note
        self._subject = subject
        self._start = start
        self._gate = Gate(host)
        self._worker = Worker()
        self._browsers: dict[ServerConnection, Browser] = {}
        self._lock = threading.Lock()
        self._page = make_page(
            "viewer/page/page.html",
            title=subject.name,
            styles=[STAGE_STYLE, MARKS_STYLE, "viewer/page/page.css"],
            scripts=[*STAGE_SCRIPTS, "viewer/page/marks.js", "viewer/page/app.js"],
            sources=POLICY,
        )
        self._question = make_page(
            "viewer/page/token.html",
            title="Token",
            styles=[STAGE_STYLE, "viewer/page/page.css"],
            sources=POLICY,
        )
        ready: futures.Future[int] = futures.Future()
        self._thread = threading.Thread(
            target=lambda: asyncio.run(self._serve(host, port, ready)),
            name="mrgs-viewer-web",
            daemon=True,
        )
        self._thread.start()
        self._closed = threading.Event()
        try:
            self.port = ready.result()
        except OSError as error:
            self._worker.close()
            raise ConfigError(
                f"cannot listen on {host}:{port} ({error}): choose another port, or free this one",
                options=("port",),
            ) from error
        self._watching = threading.Thread(target=self._watch, name="mrgs-viewer-files", daemon=True)
        self._watching.start()
        self.url = f"http://{_in_url(host)}:{self.port}/?token={self._gate.token}"

    def warm_up(self, camera: Camera) -> None:
        """Draw a picture that nobody sees, so that the first browser need not wait for kernels."""
        longest = self._subject.source.most_pixels["moving"]
        small = camera.resized(*fitted_size(camera.width, camera.height, longest))
        self._worker.put("warm up", lambda: Inspection(self._subject).picture(small))

    def refresh(self, note: str) -> None:
        """Tell browsers that the model has changed, with a new note; visible pages ask for it."""
        self.note = note
        for browser in self.browsers:
            browser.send("note", text=note)

    @property
    def browsers(self) -> list[Browser]:
        """The browsers that are connected now."""
        with self._lock:
            return list(self._browsers.values())

    @property
    def busy(self) -> bool:
        """Whether something is being drawn, or about to be."""
        return self._worker.busy

    def close(self) -> None:
        """Stop the server, disconnect all browsers, and end the threads."""
        self._closed.set()
        self._worker.close()
        self._worker.join(SECONDS_TO_CLOSE)
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(2 * SECONDS_TO_CLOSE)
        self._watching.join(SECONDS_TO_CLOSE)

    async def _serve(self, host: str, port: int, ready: futures.Future[int]) -> None:
        """The network's thread: serve until the viewer is closed."""
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        self._guess, self._guessing = asyncio.Lock(), list[Request]()
        try:
            server = await serve(
                self._serve_browser,
                host,
                port,
                process_request=self._answer,
                compression=None,  # pictures are compressed already
                max_size=LARGEST_MESSAGE,
                close_timeout=SECONDS_TO_CLOSE,
                server_header=None,
                logger=_log,
            )
        except OSError as error:
            ready.set_exception(error)
            return
        async with server:
            ready.set_result(next(iter(server.sockets)).getsockname()[1])
            await self._stop.wait()

    def _watch(self) -> None:
        """Have what other programs write into the run's folder shown, while somebody looks."""
        board = self._subject.board
        while board is not None and not self._closed.wait(WATCH_S):
            if self.browsers and board.is_stale:
                self._worker.put("marks", board.refresh)

    async def _serve_browser(self, connection: ServerConnection) -> None:
        waiting = 0

        async def send(message: str | bytes) -> None:
            nonlocal waiting
            waiting += 1
            try:
                if waiting > MOST_WAITING:
                    connection.transport.abort()
                with suppress(ConnectionClosed):
                    await connection.send(message)
            finally:
                waiting -= 1

        def send_soon(message: str | bytes) -> futures.Future[None]:
            sending = send(message)
            try:
                return asyncio.run_coroutine_threadsafe(sending, self._loop)
            except RuntimeError:  # the server has been closed
                sending.close()
                return futures.Future()

        browser = Browser(self._subject, self._start, self.note, self._worker, send_soon)
        with self._lock:
            self._browsers[connection] = browser
        try:
            with suppress(ConnectionClosed):
                async for message in connection:
                    browser.receive(message)
        finally:
            with self._lock:
                del self._browsers[connection]
            browser.close()

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """What a request gets; None lets it become a browser's socket. Wrong tokens and cookies
        are answered one at a time."""
        headers, gate = request.headers, self._gate
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if not gate.is_own_host(hosts) or not gate.is_own_origin(origins, hosts):
            return _response(HTTPStatus.FORBIDDEN, "This address belongs to another page.")
        token = gate.token_in(request.path)
        allowed = gate.knows(token) or gate.has_cookie(headers.get_all("Cookie"), self.port)
        path = request.path.partition("?")[0]
        if path == "/favicon.ico":
            return _response(HTTPStatus.NO_CONTENT, "")
        if path not in ("/", SOCKET_PATH):
            return _response(HTTPStatus.NOT_FOUND, "There is nothing here.")
        if not allowed:
            if token is not None or gate.has_cookie_name(headers.get_all("Cookie"), self.port):
                if len(self._guessing) >= MOST_GUESSES:
                    return _response(HTTPStatus.TOO_MANY_REQUESTS, "Too many wrong tokens: wait.")
                self._guessing.append(request)
                try:
                    async with self._guess:
                        with suppress(TimeoutError, asyncio.TimeoutError):
                            await asyncio.wait_for(self._stop.wait(), GUESS_S)
                finally:  # also of a guess that is given up while it waits
                    self._guessing.remove(request)
            if path == SOCKET_PATH:
                return _response(HTTPStatus.FORBIDDEN, "The token is missing.")
            return _response(HTTPStatus.FORBIDDEN, self._question)
        if path == SOCKET_PATH:
            return None
        if token is None:
            return _response(HTTPStatus.OK, self._page)
        # The token leaves the address, so that it is not copied along with it.
        response = _response(HTTPStatus.SEE_OTHER, "")
        response.headers["Location"] = "/"
        response.headers["Set-Cookie"] = gate.cookie(self.port)
        return response


def _response(status: HTTPStatus, content: str | Page) -> Response:
    """A page, or a plain text, as the server sends it."""
    kind, text, policy = "text/plain", content, "default-src 'none'"
    if isinstance(content, Page):
        kind, text, policy = "text/html", content.html, content.policy
    body = str(text).encode("utf-8", "replace")
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(body)),
            "Content-Security-Policy": f"{policy}; frame-ancestors 'none'",
            "Cache-Control": "no-store",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Connection": "close",
        }
    )
    return Response(status.value, status.phrase, headers, body)


def _in_url(host: str) -> str:
    """The host as an address names it; of all addresses, this computer's own."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host
    if address.is_unspecified:
        return "127.0.0.1" if address.version == 4 else "[::1]"
    return f"[{host}]" if address.version == 6 else host


def _host_name(header: str) -> str | None:
    """The name in a ``Host`` header, without port and brackets, lower case; None for nonsense."""
    try:
        parts = urlsplit(f"//{header}")
        parts.port  # noqa: B018 - raises for a port that is not a number
    except ValueError:
        return None
    return parts.hostname if parts.netloc == header and "@" not in header else None


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == LOCAL_NAME


def require_port(port: int) -> None:
    """Check that a port number is possible; ConfigError if not."""
    if not 0 <= port <= 65535:
        raise ConfigError(
            f"the port must be from 1 to 65535, or 0 for any that is free, not {port}",
            options=("port",),
        )


def require_free(host: str, port: int) -> None:
    """Check that the port can be used, before a training begins that is to be watched there.
    ConfigError if it cannot."""
    require_port(port)
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise ConfigError(
            f"cannot listen on {host}:{port} ({error.strerror or error}): choose another port, "
            f"or end what uses it",
            options=("port",),
        ) from error
