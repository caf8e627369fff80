from __future__ import annotations

import os
from unittest.mock import patch

import pytest
import torch

from mrgs.distributed.launch import Launch
from mrgs.distributed.processes import joined
from mrgs.system.threads import available_cores

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


def test_each_process_of_a_machine_has_a_gpu_of_its_own():
    launches = [Launch(4 + rank, 8, 4, rank) for rank in range(4)]
    assert [launch.gpu(4) for launch in launches] == [0, 1, 2, 3]
    assert [launch.gpu(2) for launch in launches] == [0, 1, 0, 1]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"OMP_NUM_THREADS": "1"}, ("share", "share")),  # torchrun's own default
        ({}, ("share", "share")),
        ({"OMP_NUM_THREADS": "777"}, ("777", "share")),
        ({"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "778"}, ("778", "778")),
    ],
)
@pytest.mark.parametrize("processes", [1, 2])
def test_each_process_takes_its_share_of_the_cores(given, expected, processes, monkeypatch):
    share = str(max(1, available_cores() // processes))
    for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    with patch.dict(os.environ):  # Numba would change its threads in the tests to come
        Launch(0, processes, processes, 0).share_cores()
        found = os.environ["OMP_NUM_THREADS"], os.environ["NUMBA_NUM_THREADS"]
    assert found == tuple(share if each == "share" else each for each in expected)


def test_a_process_has_at_least_one_thread():
    count = 2 * available_cores()
    assert Launch(0, count, count, 0).threads == 1


def test_a_process_takes_its_gpu_when_it_joins(monkeypatch):
    taken = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", taken.append)
    for name, value in {"RANK": "0", "WORLD_SIZE": "1", "MASTER_ADDR": "127.0.0.1"}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("MASTER_PORT", "0")  # the system chooses one
    with joined(Launch(rank=0, world_size=1, local_world_size=2, local_rank=1)):
        assert taken == [1]
