"""The processes are threads here: the store is all that the queue needs of them."""

from __future__ import annotations

import pytest
import torch.distributed as dist

from mrgs.distributed.launch import Launch
from mrgs.distributed.processes import Processes
from mrgs.distributed.work_queue import WorkQueue
from mrgs.errors import LinkError, PeerError
from tests.helpers.threaded_processes import together


def test_each_piece_is_taken_once_and_all_results_arrive():
    def work(processes):
        queue = WorkQueue(processes, "blocks")
        if processes.is_first:
            queue.fill([{"block": number} for number in range(7)])
        taken = []
        while (piece := queue.take()) is not None:
            queue.report(doing=piece.content["block"])
            taken.append(piece.number)
            queue.finish(piece, piece.content["block"] ** 2)
        assert queue.take() is None
        results = list(queue.messages()) if processes.is_first else []
        return taken, {each["finished"]: each["result"] for each in results if "finished" in each}

    found = together(work)
    assert sorted(number for taken, _ in found for number in taken) == list(range(7))
    assert found[0][1] == {number: number**2 for number in range(7)}


def test_an_empty_queue_is_finished_at_once():
    def work(processes):
        queue = WorkQueue(processes, "none")
        if processes.is_first:
            queue.fill([])
            return [*queue.messages()]
        return queue.take()

    assert together(work, 2) == [[], None]


def test_processes_that_are_started_again_meet_in_a_round_of_their_own():
    store = dist.HashStore()

    def work(processes):
        was_there = processes.remembers("begun")
        if processes.is_first:
            WorkQueue(processes, "blocks").fill([1])
            processes.remember("begun")
        return was_there, WorkQueue(processes, "blocks").take() is not None

    first, second = (together(work, 2, store) for _ in range(2))
    assert first[0][0] is False
    assert all(was_there for was_there, _ in second)
    assert [sum(taken for _, taken in found) for found in (first, second)] == [1, 1]


def test_one_of_several_failures_is_said():
    def lose(processes):
        with pytest.raises((LinkError, PeerError)) as error, processes.linked():
            raise RuntimeError("connection closed by peer")
        return type(error.value)

    assert sorted(kind.__name__ for kind in together(lose)) == ["LinkError"] + 2 * ["PeerError"]


def test_a_process_that_the_others_do_not_come_to_is_named():
    with pytest.raises(LinkError, match=r"process 0 .* torchrun"):
        Processes(Launch(0, 2, 2, 0), dist.HashStore(), join_s=0.0)
