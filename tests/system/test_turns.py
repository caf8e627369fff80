from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time

import pytest

from mrgs.system.threads import FairLock, ctrl_c_waits

DEADLINE_S = 60


def wait_until_awaited(turns: FairLock) -> None:
    until = time.monotonic() + DEADLINE_S
    while len(turns._queue) < 2:
        assert time.monotonic() < until, "the other thread never asked"
        time.sleep(0.001)


def test_a_thread_that_waits_is_not_overtaken_by_the_one_that_gives_back():
    turns, order = FairLock(), []

    def ask() -> None:
        with turns.taken():
            order.append("other")

    thread = threading.Thread(target=ask, daemon=True)
    with turns.taken():
        assert len(turns._queue) < 2
        thread.start()
        wait_until_awaited(turns)
    for _ in range(3):
        with turns.taken():
            order.append("own")
    thread.join(DEADLINE_S)
    assert order == ["other", "own", "own", "own"]


def test_no_two_threads_hold_it():
    turns, inside, most = FairLock(), [], []

    def work() -> None:
        for _ in range(200):
            with turns.taken():
                inside.append(1)
                most.append(len(inside))
                time.sleep(0)
                inside.pop()

    threads = [threading.Thread(target=work, daemon=True) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(DEADLINE_S)
    assert (len(most), max(most)) == (800, 1)


def test_the_thread_that_holds_it_may_take_it_again():
    turns = FairLock()
    with turns.taken(), turns.taken():
        pass
    with turns.taken():
        pass


CTRL_C_WHILE_WAITING = """
import os, signal, sys, threading, time
from mrgs.system.threads import FairLock

turns, held, pressed = FairLock(), threading.Event(), threading.Event()

def hold():
    with turns.taken():
        held.set()
        while len(turns._queue) < 2:
            time.sleep(0.001)
        press()
        pressed.set()
        time.sleep(0.05)

def press():
    if sys.argv[1] == "process":
        os.kill(os.getpid(), signal.SIGINT)  # wakes the main thread
    else:
        signal.raise_signal(signal.SIGINT)  # this thread gets it: the main thread, its turn

thread = threading.Thread(target=hold)
thread.start()
held.wait()
kept = None
try:
    with turns.taken():
        print("taken")
except KeyboardInterrupt as error:
    kept = error  # as a notebook keeps the last traceback
assert kept is not None and pressed.wait(30)

def take():
    with turns.taken():
        print("free")

other = threading.Thread(target=take, daemon=True)
other.start()
other.join(30)
with turns.taken():
    print("again")
"""


@pytest.mark.parametrize("receiver", ["process", "thread"])
def test_ctrl_c_while_a_thread_waits_leaves_it_free(receiver):
    done = subprocess.run(
        [sys.executable, "-c", CTRL_C_WHILE_WAITING, receiver],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert (done.stdout.split(), done.stderr) == (["free", "again"], "")


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
