"""The attacks on processes, files and names in short; ``make faults`` runs them at length."""

from __future__ import annotations

import sys

import pytest

from tests.faults import fuzz, interruptions, kills, messages, places, texts
from tests.faults.tally import Tally

on_linux = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux's signals and /proc")


def holds(tally: Tally) -> bool:
    assert tally.tried > 0
    assert tally.failures == []
    return True


@on_linux
def test_a_request_to_stop_leaves_a_checkpoint(tmp_path):
    assert holds(interruptions.trainings(tmp_path, ["TERM"]))


@on_linux
def test_ctrl_c_while_loading_is_one_line(tmp_path):
    assert holds(interruptions.imports(tmp_path, [0.5]))


@pytest.mark.slow
@on_linux
def test_a_training_whose_output_is_closed_saves_what_it_has(tmp_path):
    assert holds(interruptions.outputs(tmp_path, ["full output"]))


@on_linux
def test_what_killed_processes_leave_is_removed(tmp_path):
    assert holds(kills.writes(tmp_path))


@pytest.mark.slow
@on_linux
def test_a_file_that_cannot_grow_is_one_line(tmp_path):
    assert holds(places.file_size(tmp_path, [2048], "check"))


@pytest.mark.slow
@on_linux
def test_a_name_that_is_not_text_is_printed_in_ascii(tmp_path):
    assert holds(places.names(tmp_path, ["\udcff [a](b)|c"]))


def test_damaged_thermal_photos(tmp_path):
    assert holds(fuzz.radiometric(tmp_path, 60))


def test_texts_that_are_almost_right(tmp_path):
    assert holds(texts.attacks(tmp_path, 300))


@pytest.mark.filterwarnings("ignore::mrgs.errors.MrgsWarning")
def test_odd_pose_files(tmp_path):
    assert holds(fuzz.poses(tmp_path, 60))


def test_whatever_a_browser_sends_is_answered(gaussians_base, tmp_path):
    assert holds(messages.messages(tmp_path, gaussians_base, 60))
