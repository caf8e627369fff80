"""What the processes of a training agree on before its first step."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace

import pytest
import torch

from mrgs.data import load_scene
from mrgs.errors import ConfigError, MrgsError, PeerError, RunError
from mrgs.training import peers as peers_module
from mrgs.training.checkpoint import tensors_of
from mrgs.training.facts import CheckpointFacts
from mrgs.training.peers import FollowedRun, Peers, require_alike, require_same_version
from mrgs.training.replicas import align_replicas
from mrgs.training.run_folder import RunFolder
from mrgs.training.state import initial_state
from tests.helpers.threaded_processes import HOST, together
from tests.helpers.training import short_config

CONFIG = short_config("3dgs-rgbt", batch=2)


def errors(found: list) -> list[tuple[type, str]]:
    assert all(isinstance(each, MrgsError) for each in found), found
    return [(type(each), str(each)) for each in found]


def test_all_take_the_first_ones_state(small_scene, tmp_path):
    scene = load_scene(small_scene)

    def start(processes):
        peers = Peers(processes, HOST, None, ())
        folder, resume = peers.agree(RunFolder(tmp_path), CONFIG, False)
        assert not resume
        assert not peers.were_restarted(folder)
        if peers.lead:
            state, facts = initial_state(scene, CONFIG), CheckpointFacts.at_start(scene)
            peers.share(state, facts)
            return tensors_of(state), facts
        assert isinstance(folder, FollowedRun)
        state, facts = peers.receive(scene, CONFIG)
        return tensors_of(state), facts

    (expected, facts), *others = together(start, 2)
    for tensors, same_facts in others:
        assert same_facts == facts
        assert tensors.keys() == expected.keys()
        assert all(torch.equal(tensors[name], expected[name]) for name in expected)


def test_a_process_that_follows_writes_nothing(tmp_path):
    run = FollowedRun(tmp_path / "run", "{}")
    with run.training(CONFIG, resume=False):
        run.append_log({"step": 1})
        run.cut_log(0)
        run.drop_old_checkpoints()
    assert not run.path.exists()


@pytest.mark.parametrize(
    ("own", "named"),
    [
        (replace(CONFIG, seed=3), r"process 1 .*seed: 3, not 0"),
        (replace(CONFIG, sh_every=7), r"process 1 .*sh_every: 7, not 2"),
    ],
)
def test_another_configuration_stops_all_with_one_line(own, named, tmp_path):
    def start(processes):
        config = own if processes.rank == 1 else CONFIG
        Peers(processes, HOST, None, ()).agree(RunFolder(tmp_path), config, False)

    found = errors(together(start, 2))
    assert [kind for kind, _ in found] == [RunError, PeerError]
    assert re.search(named, found[0][1])


@pytest.fixture
def two_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    """The two processes of a test have different ones installed."""
    versions = iter(["1.0", "2.0"])
    monkeypatch.setattr(peers_module, "version", lambda name: next(versions))


def test_another_version_stops_all_with_one_line(tmp_path, two_versions):
    def start(processes):
        Peers(processes, HOST, None, ()).agree(RunFolder(tmp_path), CONFIG, False)

    (kind, text), _ = errors(together(start, 2))
    assert kind is RunError
    assert {"1.0", "2.0"} <= set(re.findall(r"\d\.\d", text))


def test_another_scene_stops_all_with_one_line(small_scene, make_scene):
    other = make_scene()
    photos = sorted((other / "images").glob("*train*"))
    shutil.copy(photos[2], photos[1])
    scenes = [load_scene(small_scene), load_scene(other)]

    def start(processes):
        peers, scene = Peers(processes, HOST, None, ()), scenes[processes.rank]
        if peers.lead:
            peers.share(initial_state(scene, CONFIG), CheckpointFacts.at_start(scene))
        else:
            peers.receive(scene, CONFIG)

    (kind, message), other = errors(together(start, 2))
    assert (kind, other[0]) == (RunError, PeerError)
    assert re.search(r"process 1 .* scene .*photos of", message)


def test_processes_that_do_parts_of_one_work_are_alike(small_scene, make_scene):
    other = make_scene()
    (other / "temperature_bounds.json").write_text(
        '{"absolute_min_temperature": 1, "absolute_max_temperature": 2}'
    )
    scenes = [load_scene(small_scene), load_scene(other)]
    configs = [CONFIG, replace(CONFIG, seed=3)]

    def start(scene, config):
        return together(
            lambda processes: require_alike(
                processes, configs[processes.rank * config], scenes[processes.rank * scene]
            ),
            2,
        )

    assert start(scene=0, config=0) == [None, None]
    for found, named in (
        (start(scene=1, config=0), "temperature"),
        (start(scene=0, config=1), "seed: 3, not 0"),
    ):
        (kind, text), (other_kind, _) = errors(found)
        assert (kind, other_kind) == (RunError, PeerError)
        assert named in text


def test_processes_that_do_parts_of_one_work_are_of_one_version(two_versions):
    (kind, text), (other_kind, _) = errors(together(require_same_version, 2))
    assert (kind, other_kind) == (RunError, PeerError)
    assert {"1.0", "2.0"} <= set(re.findall(r"\d\.\d", text))


def test_more_processes_than_views_in_a_step_are_refused(tmp_path):
    def start(processes):
        Peers(processes, HOST, None, ()).agree(RunFolder(tmp_path), CONFIG, False)

    first = together(start, 3)[0]
    assert isinstance(first, ConfigError)
    assert re.search(r"batch of 2 .* at most 2", str(first))


@pytest.mark.parametrize(("count", "odd"), [(2, 1), (3, 1), (3, 2)])
def test_models_that_differ_become_the_first_ones(small_scene, count, odd):
    scene = load_scene(small_scene)

    def train(processes):
        state = initial_state(scene, CONFIG)
        before = align_replicas(processes, state)
        if processes.rank == odd:
            with torch.no_grad():
                state.model.gaussians.means[3, 1] += 1e-6
        return before, align_replicas(processes, state), state.model.gaussians.means.detach()

    found = together(train, count)
    assert [(before, after) for before, after, _ in found] == [(False, True)] * count
    assert all(torch.equal(found[0][2], means) for _, _, means in found)
