"""Processes that train together, as torchrun starts them."""

from __future__ import annotations

import json
import re
import socket
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from mrgs.method.config import from_yaml, make_config
from mrgs.training import train
from mrgs.training.run_folder import RunFolder
from tests.faults.program import (
    SMALL,
    Ended,
    Started,
    ended,
    logged_step,
    newest_step,
    start,
    wait_until,
)

EVENTFUL = "densification: {start: 1, stop: 9, every: 4, gradient_threshold: 1.0e-6}\n"
"""Densifies at steps 4 and 8."""

STEPS = 10


def run_processes(count: int, *arguments: object) -> list[Ended]:
    """The program in several processes, to the end."""
    return [ended(process) for process in started(count, *arguments)]


def started(count: int, *arguments: object) -> list[Started]:
    """The program in several processes; torchrun itself would take a second more."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = []
    for rank in range(count):
        variables = {
            "TORCHELASTIC_RUN_ID": "test",
            "RANK": str(rank),
            "LOCAL_RANK": str(rank),
            "WORLD_SIZE": str(count),
            "LOCAL_WORLD_SIZE": str(count),
            "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(port),
        }
        processes.append(start(*arguments, variables=variables))
    return processes


@pytest.mark.slow
def test_two_processes_do_bit_by_bit_what_one_does_with_two_views_per_step(small_scene, tmp_path):
    (tmp_path / "eventful.yaml").write_text(EVENTFUL)
    options = (*SMALL, "--max-steps", STEPS, "--config", tmp_path / "eventful.yaml")
    first, second = run_processes(2, "train", small_scene, "--output", tmp_path / "two", *options)
    assert (first.status, second.status) == (0, 0), f"{first.err}\n{second.err}"
    assert "next: mrgs eval" in first.out
    assert (second.out, second.err) == ("", "")

    config = make_config("mrgs-plus", "fast", max_steps=STEPS, max_gaussians=100, batch=2)
    config = from_yaml(EVENTFUL, "eventful.yaml", config)
    train(small_scene, tmp_path / "one", config)
    one, two = (RunFolder(tmp_path / name) for name in ("one", "two"))
    assert two.config_file.read_text() == one.config_file.read_text()
    expected, found = (load_file(folder.newest_checkpoint()) for folder in (one, two))
    assert len(expected["gaussians.means"]) > 25
    assert [name for name in expected if not torch.equal(found[name], expected[name])] == []
    assert [entries_of(folder.path) for folder in (one, two)] == [entries_of(one.path)] * 2


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_others_with_one_line(small_scene, tmp_path):
    output = tmp_path / "run"
    options = (*SMALL, "--max-steps", 100_000, "--output", output)
    processes = started(2, "train", small_scene, *options)
    wait_until(lambda: logged_step(output) >= 10, processes[0])
    processes[1].kill()
    first, _ = (ended(process) for process in processes)
    assert first.is_refusal, first.err
    assert re.search(r"process 0 of 2 .*network", first.err)
    assert newest_step(output) >= 10


def entries_of(run: Path) -> list[dict]:
    """The log without its times."""
    entries = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    return [{name: each for name, each in e.items() if name != "seconds"} for e in entries]
