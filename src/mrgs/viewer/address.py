"""The address to listen on, checked before anything is opened."""

from __future__ import annotations

import socket

from mrgs.errors import ConfigError


def require_port(port: int) -> None:
    """Check that there is such a port.

    Raises:
        ConfigError: there is none.
    """
    if not 0 <= port <= 65535:
        raise ConfigError(
            f"the port must be from 1 to 65535, or 0 for any that is free, not {port}",
            options=("port",),
        )


def require_free(host: str, port: int) -> None:
    """Check that the port can be used, before a training begins that is to be watched there.

    Raises:
        ConfigError: it cannot.
    """
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
