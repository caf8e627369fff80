"""The model of the costs: what makes work longer, and what a computer makes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mrgs.data import load_scene
from mrgs.export.formats import FORMATS
from mrgs.pipeline.computer import Computer, measure_computer
from mrgs.pipeline.costs import Workload, stage_costs
from mrgs.pipeline.intake import Intake
from mrgs.pipeline.plan import disk_bytes, needed_memory, planned_seconds
from mrgs.pipeline.quality import QUALITIES
from mrgs.scene import RGB, THERMAL
from mrgs.system.threads import available_cores
from mrgs.training import estimate_bytes

PHOTOS = Intake(
    Path("photos"), "photos", 24, 3, {RGB: (1014, 760), THERMAL: (640, 480)}, "", False, None, 10**7
)
ONE_CORE = Computer(1, 1.0, 1.0)


def workload(
    intake: Intake = PHOTOS, quality: str = "default", compiling_s: float = 0.0
) -> Workload:
    return Workload.of(intake, QUALITIES[quality], compiling_s)


def seconds(work: Workload, stage: str, computer: Computer = ONE_CORE) -> float:
    return sum(planned_seconds(stage_costs(work)[stage], computer).values())


@pytest.mark.parametrize("stage", stage_costs(workload()))
def test_every_stage_takes_time_and_more_photos_take_more(stage):
    more = workload(replace(PHOTOS, views=80, held_out=10))
    assert seconds(workload(), stage) > 0
    if stage != "train":  # whose steps are the same
        assert seconds(workload(), stage) < seconds(more, stage)


@pytest.mark.parametrize("stage", ["train", "score", "render", "report", "exports"])
def test_a_better_quality_takes_longer(stage):
    assert (
        seconds(workload(quality="fast"), stage)
        < seconds(workload(), stage)
        <= seconds(workload(quality="best"), stage)
    )


def test_given_poses_need_not_be_found():
    parts = stage_costs(workload(replace(PHOTOS, poses_given=True)))["prepare"].parts
    assert not {"features", "matching", "mapping"} & parts.keys()
    assert stage_costs(workload())["prepare"].parts.keys() > parts.keys()


def test_every_export_takes_time():
    stages = stage_costs(workload())
    parts = stages["page"].parts | stages["exports"].parts
    assert all(parts[name] > 0 for name in FORMATS)


def test_kernels_are_compiled_once():
    first, again = (seconds(workload(compiling_s=each), "train") for each in (34.0, 0.0))
    assert first - again == pytest.approx(34.0)


def test_photos_are_reduced_to_the_resolution_of_the_quality():
    large = replace(PHOTOS, sizes={RGB: (4000, 3000), THERMAL: (640, 512)})
    fast, default = workload(large, "fast"), workload(large, "default")
    assert fast.kpx == pytest.approx(640 * 480 / 1e3 + 640 * 512 / 1e3)
    assert default.kpx == pytest.approx(1024 * 768 / 1e3 + 640 * 512 / 1e3)
    assert large.sizes[RGB][0] > 1600
    assert default.feature_px == 1600 * 1200


def test_many_photos_are_not_all_matched_with_each_other():
    few, many = (stage_costs(workload(replace(PHOTOS, views=n)))["prepare"] for n in (100, 300))
    assert many.parts["matching"] < 3 * few.parts["matching"]


def test_a_scene_is_checked_and_needs_no_poses():
    scene = replace(PHOTOS, kind="scene", points=5000)
    costs = stage_costs(workload(scene))
    assert next(iter(costs)) == "check"
    assert seconds(workload(scene), "check") < seconds(workload(), "prepare")
    assert workload(scene).start == 5000


def test_one_camera_needs_no_calibration():
    alone = replace(PHOTOS, sizes={THERMAL: (640, 480)})
    assert stage_costs(workload(alone))["prepare"].parts["thermal camera"] == 0


def test_time_on_a_computer():
    assert ONE_CORE.seconds(10, 0.5) == 10
    assert Computer(2, 2.0, 1.0).seconds(10, 0.5) == 7.5
    assert Computer(2, 2.0, 2.0).seconds(10, 0.5) == 3.75
    assert Computer(2, 0.5, 1.0).seconds(10, 0.5) == 20, "other programs have most of the time"
    assert Computer(64, 64.0, 1.0).seconds(10, 0.5) > 5, "the rest is done by one core"


def test_this_computer_is_measured():
    found = measure_computer()
    assert found.cores == available_cores()
    assert 0 < found.share <= found.cores
    assert found.speed > 0


def test_room_that_is_needed_grows_with_the_photos_and_the_model():
    small, large = workload(quality="fast"), workload(quality="best")
    assert disk_bytes(small, PHOTOS) < disk_bytes(large, PHOTOS)
    assert disk_bytes(small, PHOTOS) < disk_bytes(small, replace(PHOTOS, bytes=10**9))


def test_memory_is_that_which_the_training_states_for_the_same_photos(small_scene):
    scene, quality = load_scene(small_scene), QUALITIES["fast"]
    sizes = {
        modality: (camera.width, camera.height)
        for modality, camera in scene.train[0].cameras.items()
    }
    intake = replace(PHOTOS, views=len(scene.views), held_out=len(scene.eval), sizes=sizes)
    planned = needed_memory(workload(intake, "fast"), intake, quality)
    stated = estimate_bytes(scene, quality.config(), quality.max_gaussians)
    assert planned == pytest.approx(stated, rel=0.05)
    assert planned >= stated


def test_the_first_steps_cost_less_where_photos_are_large():
    work = workload(quality="fast")  # 640×480 each: a half of the steps on a quarter of the pixels
    assert work.kpx == pytest.approx(2 * 640 * 480 / 1e3, rel=1e-3)
    assert work.mean_kpx == pytest.approx((0.5 + 0.5 / 4) * work.kpx, rel=2e-3)
    small = Intake(
        Path("p"), "photos", 24, 3, {RGB: (320, 240), THERMAL: (160, 120)}, "", False, None, 10**7
    )
    assert workload(small).mean_kpx == pytest.approx(workload(small).kpx)
