"""Who may talk to the viewer (whoever has the token, from a page of the viewer's own, under a name
of its own), and the address that it listens on."""

from __future__ import annotations

import ipaddress
import secrets
import socket
from collections.abc import Sequence
from urllib.parse import parse_qs, urlsplit

from mrgs.errors import ConfigError


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


LOCAL_NAME = "localhost"


class Gate:
    """Checks the requests that reach a server.

    Another web page that is open in the user's browser can send requests to any address, also to
    this computer's own. Its requests carry its own origin; or, where it has pointed its own name at
    this address (DNS rebinding), that name as the host. Both are refused. Other users of the
    computer, and of the network, do not have the token.

    Attributes:
        token: what the address to open contains.
    """

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
        """Whether a request comes from the server's own page, or from a program, which sends no
        ``Origin``."""
        if not origins:
            return True
        own = {f"{scheme}://{host}".lower() for scheme in ("http", "https") for host in hosts}
        return len(origins) == 1 and origins[0].lower() in own

    def knows(self, token: str | None) -> bool:
        """Whether a token is the server's."""
        return token is not None and secrets.compare_digest(token.encode(), self.token.encode())

    def token_in(self, path: str) -> str | None:
        """The token in the query of a request's path; None without one."""
        return parse_qs(urlsplit(path).query).get("token", [None])[0]

    def has_cookie(self, cookies: Sequence[str], port: int) -> bool:
        """Whether a request's ``Cookie`` headers have the token. Other servers of this computer may
        have set others, in whatever form."""
        pairs = [pair.partition("=") for each in cookies for pair in each.split(";")]
        name = cookie_name(port)
        return any(key.strip() == name and self.knows(value.strip()) for key, _, value in pairs)

    def cookie(self, port: int) -> str:
        """The ``Set-Cookie`` header with which the page's browser keeps the token: scripts cannot
        read it, and requests from other pages do not carry it."""
        return f"{cookie_name(port)}={self.token}; Path=/; HttpOnly; SameSite=Strict"


def cookie_name(port: int) -> str:
    """Name of the cookie; of each port its own, since browsers share cookies between ports."""
    return f"mrgs-viewer-{port}"


def _host_name(header: str) -> str | None:
    """The name in a ``Host`` header, without port and brackets, lower case; None for nonsense."""
    try:
        parts = urlsplit(f"//{header}")
        parts.port  # noqa: B018 - raises for a port that is no number
    except ValueError:
        return None
    return parts.hostname if parts.netloc == header and "@" not in header else None


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == LOCAL_NAME
