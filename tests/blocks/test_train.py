from __future__ import annotations

import json
import math
import re
import shutil
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file

from mrgs.blocks import refinement
from mrgs.blocks.plan import BlockOptions, Surveyor, counted_places, make_plan, read_plan, views_of
from mrgs.blocks.refinement import SEAM_WIDTH, Part
from mrgs.blocks.region import Rectangle, Ring, ScenePlane
from mrgs.blocks.train import BlockTraining
from mrgs.data import load_scene
from mrgs.errors import ConfigError, FolderInUseError, RunError
from mrgs.evaluation import evaluate_run
from mrgs.method.camera_model.point_spread import PointSpread
from mrgs.run_files.folder import RunFolder
from mrgs.runs.open import load_run
from mrgs.scene import PointCloud
from mrgs.training.checkpoint import load_state
from mrgs.training.start import Hooks
from tests.helpers.gaussians import random_gaussians
from tests.helpers.scenes import write_scene
from tests.helpers.training import short_config

STEPS = 8


class KilledError(Exception):
    """Ends a training at once, without a checkpoint."""


def training(folder: Path, scene: Path, **changes) -> BlockTraining:
    """Two blocks of the scene of soft balls, of Gaussians smaller than the strip at their edge."""
    config = short_config("mrgs-plus", max_steps=STEPS, checkpoint_every=4)
    options = BlockOptions("1x2", 0.2)
    loaded = load_scene(scene)
    points, generator = loaded.points, torch.Generator().manual_seed(0)
    jitter = 0.01 * torch.randn(4, *points.positions.shape, generator=generator)
    small = PointCloud((points.positions + jitter).flatten(0, 1), points.colors.repeat(4, 1))
    made = BlockTraining(replace(loaded, points=small), RunFolder(folder), config, options)
    return replace(made, **changes)


def copy_of(joined: Path, folder: Path, *names: str) -> Path:
    """A folder in which some of the runs of another one are finished."""
    for name in names:
        shutil.copytree(joined / "blocks" / name, folder / "blocks" / name)
    shutil.copy(joined / "blocks/plan.json", folder / "blocks")
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def joined(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("blocks") / "run"
    assert training(folder, scene).train_all()
    return folder


def test_blocks_become_a_run_like_any_other(joined, scene):
    run = load_run(joined)
    metrics = evaluate_run(run)
    assert run.facts.step == STEPS
    assert metrics.truth is None
    state = load_state(run.folder.newest_checkpoint(), run.config)
    assert state.step == STEPS


def test_each_gaussian_comes_from_the_block_in_whose_cell_it_lies(joined, scene):
    """Unchanged but along the cut, where all have been refined together."""
    run, plan = load_run(joined), read_plan(joined / "blocks/plan.json")
    means = run.model.gaussians.means
    places = plan.plane.coordinates(means)
    cut = plan.cells[0].region.high[0]
    owner = torch.stack([cell.region.contains(places) for cell in plan.cells])
    # As far as Gaussians of the strip along the cut may have moved.
    at_cut = (places[:, 0] - cut).abs() < 2 * SEAM_WIDTH * plan.overlap
    assert (owner.sum(dim=0) == 1).all()
    refined: set[tuple[float, ...]] = set()
    for number, mine in enumerate(owner, start=1):
        block = load_run(joined / f"blocks/{number:03d}").model.gaussians.means
        known = set(map(tuple, block.tolist()))
        found = set(map(tuple, means[mine & ~at_cut].tolist()))
        assert found
        assert found <= known
        refined |= set(map(tuple, means[mine & at_cut].tolist())) - known
    assert refined


def test_the_blur_is_the_mean_of_the_blocks_refined_along_the_cut(joined):
    first, second, seam = (
        load_run(joined / "blocks" / name).image_model.point_spread.log_sigma.item()
        for name in ("001", "002", "seam-002")
    )
    found = load_run(joined).image_model.point_spread.log_sigma.item()
    assert found == seam
    assert found != pytest.approx((first + second) / 2, abs=1e-6)


def test_what_lies_outside_of_a_block_stays_as_it_is(joined, scene):
    """The coarse model's Gaussians beyond the margin are in the block unchanged."""
    done = training(joined, scene)
    block = load_run(joined / "blocks/001").model.gaussians
    region = done.plan.cells[0].region.grown(done.plan.overlap)
    outside = ~Part(done.plan.plane, region, region, done.scene.reach).contains(block.means)
    assert outside.any()
    coarse = done.coarse.model.gaussians
    for name, tensor in block.tensors().items():
        known = set(map(tuple, coarse.tensors()[name].detach().flatten(1).tolist()))
        assert set(map(tuple, tensor[outside].flatten(1).tolist())) <= known, name


def test_blocks_take_over_no_gaussian_too_wide_for_any_but_those_of_the_background(joined, scene):
    done = training(joined, scene)
    gaussians, reach = done.coarse.model.gaussians, done.scene.reach

    def rows_of_block() -> set[int]:
        block = refinement.block(done.coarse, done.scene, done.plan, 0, done.config)
        return set(block.rows.tolist())

    wide, far, *others = sorted(rows_of_block())
    with torch.no_grad():
        gaussians.means[wide] = gaussians.means[others[0]]
        direction = gaussians.means[far] - reach.centre.float()
        gaussians.means[far] += 2 * reach.background_distance * direction / direction.norm()
        gaussians.log_scales[[wide, far]] = torch.tensor(10.0 * done.plan.overlap).log()
    assert rows_of_block() == {far, *others}


def test_a_block_begins_with_a_new_blur(joined, scene):
    done = training(joined, scene)
    learned = done.coarse.image_model.point_spread.log_sigma.item()
    block = refinement.block(done.coarse, done.scene, done.plan, 0, done.config)
    start = block.start.image_model.point_spread.log_sigma.item()
    assert start == PointSpread().log_sigma.item() != learned
    assert done.coarse.image_model.point_spread.log_sigma.item() == learned


def test_a_block_starts_from_the_points_where_these_are_more(joined, scene):
    done = training(joined, scene)
    region = done.plan.cells[0].region.grown(done.plan.overlap)
    part = Part(done.plan.plane, region, region, done.scene.reach)
    inside = part.contains(done.coarse.model.gaussians.means)

    def state(points: PointCloud):
        whole = replace(done.scene, points=points)
        block = refinement.block(done.coarse, whole, done.plan, 0, done.config)
        strategy = block.training_part.strategy
        return block, block._initial_state(strategy, whole, block.config, torch.device("cpu"))

    points = done.scene.points
    many = PointCloud(points.positions.repeat(9, 1), points.colors.repeat(9, 1))
    block, begun = state(many)
    there = part.contains(many.positions)
    assert len(block.rows) > 0
    assert not inside[block.rows].any()
    gaussians = begun.model.gaussians
    start = gaussians.means[len(block.rows) :]
    most = done.config.densification.max_gaussians
    assert len(start) == min(int(there.sum()), most) > int(inside.sum())
    assert part.contains(start).all()
    few = PointCloud(points.positions[:3], points.colors[:3])
    for no_better in (few, replace(many, random=True)):
        block, _ = state(no_better)
        assert inside[block.rows].any()


def test_a_gaussian_that_reaches_beyond_what_counts_is_not_held(scene):
    gaussians = random_gaussians(4)
    gaussians.means[:] = torch.tensor([[0.0], [0.0], [0.9], [2.0]]) * torch.tensor([1.0, 0.0, 0.0])
    gaussians.log_scales[:] = torch.tensor([0.3, 0.4, 0.1, 0.1]).log()[:, None]
    plane = ScenePlane(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (-1.0, -1.0), (1.0, 1.0))
    region = Rectangle((-1.0, -1.0), (1.0, 1.0))
    reach = load_scene(scene).reach
    held = Part(plane, region, region, reach).holds(gaussians)
    assert held.tolist() == [True, False, False, False]
    ring = Ring(region.grown(0.5), region.grown(-0.5))
    counted = Ring(region.grown(1.0), region.grown(-0.8))
    held = Part(plane, ring, counted, reach).holds(gaussians)
    assert held.tolist() == [False, False, True, False]


@pytest.mark.slow
def test_a_training_that_was_killed_goes_on(joined, scene, tmp_path):
    """After a block, within one, and while the blocks are joined; the result is the same to the
    bit."""
    folder = copy_of(joined, tmp_path / "run", "coarse", "001")

    def killing(title: str, step: int):
        @contextmanager
        def follow(now: str):
            def on_step(statistics):
                if now.startswith(title) and statistics.step == step:
                    raise KilledError

            yield Hooks(on_step=on_step)

        return follow

    for title, step in (("block 2", 7), ("seam of block 2", 1)):
        with pytest.raises(KilledError):
            training(folder, scene, follow=killing(title, step)).train_all()
        assert not RunFolder(folder).checkpoints()
    assert training(folder, scene).train_all()
    one, other = (load_run(path).model.gaussians.tensors() for path in (joined, folder))
    assert all(torch.equal(tensor, other[name]) for name, tensor in one.items())


def test_single_blocks_are_trained_for_job_arrays_and_joined_later(scene, tmp_path, joined):
    """One that another process trains is left to it."""
    folder = copy_of(joined, tmp_path / "run", "coarse", "001")
    started = training(folder, scene)
    with RunFolder(folder / "blocks/002").locked():
        with pytest.raises(FolderInUseError, match="in use"):
            started.train_block(2)
        assert not started.train_all()
        assert started.unfinished() == [2]
    started.train_block(2)
    assert started.unfinished() == []
    assert not RunFolder(folder).checkpoints()
    assert started.train_all()
    assert load_run(folder).gaussian_count == load_run(joined).gaussian_count
    with pytest.raises(ConfigError, match=r"block 3: .* 2"):
        started.train_block(3)


def test_a_joined_run_names_the_replaced_equations_of_all_its_parts(scene, tmp_path, joined):
    folder = copy_of(joined, tmp_path / "run", "coarse", "001", "002", "seam-001", "seam-002")
    lines = [f"equation: {name}: mine.{name}" for name in ("first", "second")]
    RunFolder(folder / "blocks/coarse").note_custom_parts(lines[:1])
    RunFolder(folder / "blocks/002").note_custom_parts(lines)
    assert training(folder, scene).join()
    assert sorted(RunFolder(folder).custom_parts) == lines


@pytest.mark.slow
def test_a_method_with_heads_gives_the_same_bits_whatever_was_drawn_before(scene, tmp_path):
    config = short_config("mrgs", max_steps=4, checkpoint_every=4)
    found = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        folder = tmp_path / str(seed)
        before = torch.get_rng_state()
        assert training(folder, scene, config=config).train_all()
        assert torch.equal(torch.get_rng_state(), before)
        found.append(load_file(RunFolder(folder).newest_checkpoint()))
    assert [name for name in found[0] if not torch.equal(found[0][name], found[1][name])] == []


def test_another_density_control_is_refused(scene, tmp_path):
    other = replace(training(tmp_path / "run", scene).config)
    object.__setattr__(other, "densification", SimpleNamespace(name="prune-only"))
    with pytest.raises(ConfigError, match=r"'adaptive', .*'prune-only'"):
        training(tmp_path / "run", scene, config=other).train_all()
    assert not (tmp_path / "run").exists()


def test_blocks_of_something_else_are_refused(joined, scene, tmp_path):
    start = training(joined, scene)
    for changed, message in (
        ({"config": replace(start.config, max_steps=9)}, r"max steps 8\b"),
        ({"options": BlockOptions("2x2", 0.2)}, r"blocks 1x2\b"),
        ({"options": BlockOptions("1x2", 0.3)}, r"overlap 0\.2\b"),
    ):
        with pytest.raises(RunError, match=message):
            replace(start, **changed).train_all()
    other = load_scene(write_scene(tmp_path / "other"))
    with pytest.raises(RunError, match=r"\(scene "):
        replace(start, scene=other).train_all()


def test_a_block_without_a_photo_is_left_to_its_neighbour(scene, tmp_path):
    start = training(tmp_path / "run", scene, options=BlockOptions("1x2", 0.0))
    points = start.scene.points
    above = points.positions + torch.tensor([0.0, 0.0, 7.0])  # of all cameras
    both = PointCloud(torch.cat([points.positions, above]), torch.cat([points.colors] * 2))
    said: list[str] = []
    start = replace(start, scene=replace(start.scene, points=both), say=said.append)
    assert start.train_all()
    assert "1 of 2" in said[-2]
    assert "6 photos" in said[-1]
    assert [len(cell.views) for cell in start.plan.cells] == [6]


def test_a_folder_that_holds_another_run_is_refused(joined, scene, tmp_path):
    folder = tmp_path / "run"
    (folder / "checkpoints").mkdir(parents=True)
    (folder / "config.yaml").write_text("method: mrgs\n")
    (folder / "checkpoints/step_000001.safetensors").write_bytes(b"")
    with pytest.raises(RunError, match="already holds"):
        training(folder, scene).train_all()


def refusal(path: Path) -> str:
    """Why a plan is refused; empty if it is read."""
    try:
        read_plan(path)
    except RunError as error:
        return str(error)
    return ""


def test_a_plan_that_is_none_is_refused(tmp_path):
    path = tmp_path / "plan.json"
    for text in ("", "[]", "{}", '{"format": 2}'):
        path.write_text(text)
        assert re.search(r"plan\.json .*folder", refusal(path)), text


def test_a_plan_that_was_damaged_is_refused(joined, tmp_path):
    content = json.loads((joined / "blocks/plan.json").read_text(encoding="utf-8"))
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    assert read_plan(path) == read_plan(joined / "blocks/plan.json")
    for damage in (
        {"format": 2},
        {"cells": []},
        {"cells": [{"region": [[None, None], [None, None]], "views": []}]},
        {"cells": [{"region": [[None, None], [None, None]], "views": [-1]}]},
        {"cells": [{"region": [[None, None], [None, None]], "views": [math.inf]}]},
        {"cells": [{"region": [[None, None]], "views": [0]}]},
        {"overlap": -1.0},
        {"overlap": math.inf},
        {"overlap": math.nan},
        {"overlap": 10**400},
        {"plane": {"axes": [[1, 0, 0], [0, 1]], "low": [0, 0], "high": [1, 1]}},
        {"options": {"blocks": "1x2", "rows": 1}},
    ):
        path.write_text(json.dumps(content | damage), encoding="utf-8")
        assert re.search(r"plan\.json .*folder", refusal(path)), damage


def test_blocks_of_a_scene_that_had_more_photos_are_refused(joined, scene):
    start = training(joined, scene)
    views = max(view for cell in start.plan.cells for view in cell.views)
    fewer = replace(start.scene, train=start.scene.train[:views])
    with pytest.raises(RunError, match=rf"views {views + 1}\b"):
        start.plan.require_same(joined / "blocks/plan.json", fewer, start.config, start.options)


def test_the_photos_of_a_block_are_those_that_show_it_with_its_margin(joined, scene):
    done, options = training(joined, scene), BlockOptions("3x3", 0.1)
    plan = make_plan(done.coarse.model, done.scene, {}, options, lambda line: None)
    places = counted_places(Surveyor(done.coarse.model, done.scene, plan.plane), done.scene)
    regions = [cell.region for cell in plan.cells]
    assert [cell.views for cell in plan.cells] == [
        views_of(region.grown(0.1), places) for region in regions
    ]
    assert [cell.views for cell in plan.cells] != [views_of(region, places) for region in regions]


def test_the_margin_is_a_share_of_the_narrowest_block(joined, scene):
    done, options = training(joined, scene), BlockOptions("1x2", None)
    plan = make_plan(done.coarse.model, done.scene, {}, options, lambda line: None)
    narrowest = min(min(plan.plane.clipped(cell.region)) for cell in plan.cells)
    assert plan.overlap == pytest.approx(0.15 * narrowest)


def test_a_joined_run_counts_what_all_its_parts_took(joined):
    parts = [load_run(path.parent).facts for path in joined.glob("blocks/*/config.yaml")]
    assert len(parts) >= 4  # coarse, two blocks, what lies along their cut
    facts = load_run(joined).facts
    assert facts.train_seconds == pytest.approx(sum(each.train_seconds for each in parts))
    assert facts.peak_memory_bytes == max(each.peak_memory_bytes for each in parts)


def test_a_coarse_model_that_shows_nothing_is_said(joined, scene):
    done, options = training(joined, scene), BlockOptions("1x2", None)
    model = deepcopy(done.coarse.model)
    with torch.no_grad():
        for logits in model.gaussians.opacity_logits.values():
            logits.fill_(-10.0)
    with pytest.raises(ConfigError, match="show no surface of the coarse model"):
        make_plan(model, done.scene, {}, options, lambda line: None)


def test_an_overlap_that_does_not_fit_is_refused(scene, tmp_path):
    with pytest.raises(ConfigError, match=r"overlap .*\b5 "):
        training(tmp_path, scene, options=BlockOptions("1x2", 5.0)).train_all()


def test_a_scene_that_has_changed_is_refused(joined, scene):
    start = training(joined, scene)
    views = start.scene.train
    changed = replace(start.scene, train=(*views[1:], views[0]))
    with pytest.raises(RunError, match="has changed"):
        replace(start, scene=changed).train_all()
