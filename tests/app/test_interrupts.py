"""What ends a command early, and what no longer does."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from mrgs.app.interrupts import Interrupted, Interrupts


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    """The handlers are as before afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def test_a_request_ends_a_command_and_handlers_are_back_afterwards():
    before = signal.getsignal(signal.SIGTERM)
    interrupts = Interrupts()
    with pytest.raises(Interrupted), interrupts:
        signal.raise_signal(signal.SIGTERM)
    assert interrupts.received is not None
    assert interrupts.received.status == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_command_that_is_done_is_ended_by_ctrl_c_alone():
    ctrl_c = signal.getsignal(signal.SIGINT)
    interrupts = Interrupts()
    with interrupts:
        interrupts.command_is_done()
        signal.raise_signal(signal.SIGTERM)
    signal.raise_signal(signal.SIGHUP)
    assert interrupts.received is None
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    assert signal.getsignal(signal.SIGINT) is ctrl_c
