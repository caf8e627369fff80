from __future__ import annotations

import threading

from mrgs.system.turns import Turns


def test_a_thread_that_waits_is_not_overtaken_by_the_one_that_gives_back():
    turns, order = Turns(), []
    asks = threading.Event()

    def ask() -> None:
        asks.set()
        with turns.taken():
            order.append("other")

    thread = threading.Thread(target=ask)
    with turns.taken():
        thread.start()
        asks.wait()
        while not turns._door.locked():
            pass
    for _ in range(3):
        with turns.taken():
            order.append("own")
    thread.join()
    assert order == ["other", "own", "own", "own"]


def test_the_thread_that_holds_it_may_take_it_again():
    turns = Turns()
    with turns.taken(), turns.taken():
        pass
    with turns.taken():
        pass
