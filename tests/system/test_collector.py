from __future__ import annotations

import gc

import pytest

from mrgs.system.collector import collector_paused


def test_the_collector_comes_back_after_an_error():
    assert gc.isenabled()

    def fail() -> None:
        with collector_paused():
            assert not gc.isenabled()
            raise ValueError("from within")

    with pytest.raises(ValueError, match="from within"):
        fail()
    assert gc.isenabled()


def test_one_that_is_off_stays_off():
    gc.disable()
    try:
        with collector_paused():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
