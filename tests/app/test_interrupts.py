"""What ends a command early, and streams that never raise."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from mrgs.app.interrupts import Interrupted, Interrupts, guard_streams


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    """The handlers are as before afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")
def test_closed_streams_are_the_null_device():
    code = (
        "import gc, sys; from mrgs.app.interrupts import guard_streams; guard_streams(print); "
        "gc.collect(); print(sys.stdout.isatty(), sys.stderr.isatty(), sys.stdin.read()); "
        "print(1, file=sys.stderr, flush=True)"
    )
    for closed in (">&-", "2>&-", "<&- >&- 2>&-"):
        shell = f'exec "$@" {closed}'
        found = subprocess.run(["sh", "-c", shell, "sh", sys.executable, "-c", code], check=False)
        assert found.returncode == 0


def test_a_request_ends_a_command_and_handlers_are_back_afterwards():
    before = signal.getsignal(signal.SIGTERM)
    interrupts = Interrupts()
    with pytest.raises(Interrupted), interrupts:
        signal.raise_signal(signal.SIGTERM)
    assert interrupts.received is not None
    assert interrupts.received.status == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before


class Console(io.RawIOBase):
    """A raw stream that is no file, as a console is on Windows."""

    def __init__(self, error: OSError | None = None) -> None:
        self.written = b""
        self._error = error

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return True

    def write(self, data) -> int:
        if self._error is not None:
            raise self._error
        self.written += bytes(data)
        return len(data)


def guarded(
    machine: pytest.MonkeyPatch, console: Console, encoding: str = "utf-8"
) -> list[OSError]:
    """Guard a standard output that goes to a console; returns where its error is put."""
    stdout = io.TextIOWrapper(io.BufferedWriter(console), encoding=encoding)
    machine.setattr(sys, "stdout", stdout)
    machine.setattr(sys, "stderr", io.StringIO())
    lost: list[OSError] = []
    guard_streams(lost.append)
    assert sys.stdout is not stdout
    return lost


def test_a_console_that_is_no_file_is_written_to_itself(monkeypatch: pytest.MonkeyPatch):
    console = Console()
    guarded(monkeypatch, console)
    print("20 °C")
    assert console.written.decode().splitlines() == ["20 °C"]
    assert sys.stdout.isatty()


def test_what_an_encoding_lacks_is_written_with_escapes(monkeypatch: pytest.MonkeyPatch):
    console = Console()
    guarded(monkeypatch, console, "cp1252")
    print("20 °C → λ")
    assert console.written.decode("cp1252").split() == ["20", "°C", r"\u2192", r"\u03bb"]


def test_only_the_first_write_that_fails_is_reported(monkeypatch: pytest.MonkeyPatch):
    error = OSError(28, "No space left on device")
    lost = guarded(monkeypatch, Console(error))
    print("one")
    print("two")
    assert lost == [error]


def test_a_handler_that_was_set_meanwhile_stays():
    """That of a program that has done its work, and must not be broken off any more."""
    before = signal.getsignal(signal.SIGINT)
    try:
        with Interrupts():
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
