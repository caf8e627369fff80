from __future__ import annotations

import os
from unittest.mock import patch

import pytest

from mrgs.distributed import launch
from mrgs.distributed.launch import Launch

TORCHRUN = {
    "TORCHELASTIC_RUN_ID": "some",
    "RANK": "5",
    "WORLD_SIZE": "8",
    "LOCAL_WORLD_SIZE": "4",
    "LOCAL_RANK": "1",
}


def test_torchruns_variables_place_a_process():
    found = Launch.from_environment(TORCHRUN)
    assert found == Launch(rank=5, world_size=8, local_world_size=4, local_rank=1)
    assert not found.is_first
    assert Launch.from_environment({"RANK": "1", "WORLD_SIZE": "2"}) is None


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"OMP_NUM_THREADS": "1"}, ("3", "3")),  # torchrun's own default
        ({}, ("3", "3")),
        ({"OMP_NUM_THREADS": "2"}, ("2", "3")),
        ({"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}, ("1", "1")),
    ],
)
def test_each_process_takes_its_share_of_the_cores(given, expected, monkeypatch):
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(launch, "available_cores", lambda: 12)
    with patch.dict(os.environ):  # Numba would change its threads in the tests to come
        Launch(0, 4, 4, 0).share_cores()
        found = os.environ["OMP_NUM_THREADS"], os.environ["NUMBA_NUM_THREADS"]
    assert found == expected


def test_a_process_has_at_least_one_thread(monkeypatch):
    monkeypatch.setattr(launch, "available_cores", lambda: 2)
    assert Launch(0, 4, 4, 0).threads == 1
