from __future__ import annotations

import signal
import threading

import pytest

from mrgs.system.ctrl_c import ctrl_c_waits


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def press_in_the_block(times: int, done: list[bool]) -> None:
    with ctrl_c_waits():
        for _ in range(times):
            press()
        done.append(True)


@pytest.mark.parametrize(("times", "is_done"), [(1, [True]), (2, [])])
def test_the_first_one_waits_for_the_end_of_the_block_and_the_second_does_not(times, is_done):
    done = []
    with pytest.raises(KeyboardInterrupt):
        press_in_the_block(times, done)
    assert done == is_done
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_error_in_the_block_goes_first():
    def fail() -> None:
        with ctrl_c_waits():
            press()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()


def test_a_handler_of_the_callers_is_left_alone():
    pressed = []
    signal.signal(signal.SIGINT, lambda *_: pressed.append(True))
    try:
        with ctrl_c_waits():
            press()
            assert pressed
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_other_threads_may_enter_it():
    entered = []

    def enter() -> None:
        with ctrl_c_waits():
            entered.append(True)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert entered
