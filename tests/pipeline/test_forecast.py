"""How long work takes: what makes it longer, what a stage reports, and the pace so far."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from mrgs.data import load_scene
from mrgs.export.formats import FORMATS
from mrgs.pipeline.forecast import Forecast, Workload, pace_so_far, stage_parts
from mrgs.pipeline.plan import QUALITIES, Intake
from mrgs.pipeline.run import disk_bytes, needed_memory
from mrgs.scene import RGB, THERMAL
from mrgs.training import estimate_bytes

PHOTOS = Intake(
    Path("photos"), "photos", 24, 3, {RGB: (1014, 760), THERMAL: (640, 480)}, "", False, None, 10**7
)


def workload(
    intake: Intake = PHOTOS, quality: str = "default", compiling_s: float = 0.0
) -> Workload:
    return Workload.of(intake, QUALITIES[quality], compiling_s)


def seconds(work: Workload, stage: str) -> float:
    return sum(stage_parts(work, cores=1)[stage].values())


@pytest.mark.parametrize("stage", stage_parts(workload()))
def test_every_stage_takes_time_and_more_photos_take_more(stage):
    more = workload(replace(PHOTOS, views=80, held_out=10))
    assert seconds(workload(), stage) > 0
    if stage != "train":  # whose steps are the same
        assert seconds(workload(), stage) < seconds(more, stage)


@pytest.mark.parametrize("stage", ["train", "score", "render", "report", "exports"])
def test_a_better_quality_takes_longer(stage):
    fast, default, best = (seconds(workload(quality=name), stage) for name in QUALITIES)
    assert fast < default <= best


def test_more_cores_take_less_time_but_not_in_proportion():
    one, two, many = (sum(stage_parts(workload(), n)["train"].values()) for n in (1, 2, 64))
    assert two < one
    assert one / 3 < many < two


def test_given_poses_need_not_be_found():
    given = stage_parts(workload(replace(PHOTOS, poses_given=True)))["prepare"]
    assert not any(part.startswith("poses") for part in given)
    assert stage_parts(workload())["prepare"].keys() > given.keys()


def test_every_export_takes_time():
    stages = stage_parts(workload())
    parts = stages["page"] | stages["exports"]
    assert all(parts[name] > 0 for name in FORMATS)


def test_kernels_are_compiled_once():
    first, again = (seconds(workload(compiling_s=each), "train") for each in (34.0, 0.0))
    assert first - again == pytest.approx(34.0)


def test_photos_are_reduced_to_the_resolution_of_the_quality():
    large = replace(PHOTOS, sizes={RGB: (4000, 3000), THERMAL: (640, 512)})
    fast, default = workload(large, "fast"), workload(large, "default")
    assert fast.kpx == pytest.approx(640 * 480 / 1e3 + 640 * 512 / 1e3)
    assert default.kpx == pytest.approx(1024 * 768 / 1e3 + 640 * 512 / 1e3)


def test_many_photos_are_not_all_matched_with_each_other():
    few, many = (stage_parts(workload(replace(PHOTOS, views=n)))["prepare"] for n in (100, 300))
    assert many["poses: matching"] < 3 * few["poses: matching"]


def test_a_scene_is_checked_and_needs_no_poses():
    scene = replace(PHOTOS, kind="scene", points=5000)
    assert next(iter(stage_parts(workload(scene)))) == "check"
    assert seconds(workload(scene), "check") < seconds(workload(), "prepare")
    assert workload(scene).start == 5000


def test_one_camera_needs_no_calibration():
    alone = replace(PHOTOS, sizes={THERMAL: (640, 480)})
    assert not any("camera" in part for part in stage_parts(workload(alone))["prepare"])


def test_room_that_is_needed_grows_with_the_photos_and_the_model():
    def room(quality: str, photos: Intake = PHOTOS) -> int:
        return disk_bytes(workload(quality=quality), photos, QUALITIES[quality])

    assert room("fast") < room("best")
    assert room("fast") < room("fast", replace(PHOTOS, bytes=10**9))


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


class Clock:
    """A clock that is set by hand."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_at_the_start_it_is_what_was_expected(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    assert forecast.left("a", 0.0) == pytest.approx(40.0)


def test_at_the_expected_pace_it_counts_down(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    clock.now = 25.0
    assert forecast.left("b", 0.5) == pytest.approx(15.0)
    clock.now = 40.0
    assert forecast.left("b", 1.0) == 0.0


def test_it_follows_the_measured_pace(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    clock.now = 60.0  # three times as long as expected
    left = forecast.left("b", 1 / 3)
    assert left is not None
    assert 50.0 < left < 60.0


def test_where_progress_is_not_known_time_passes_all_the_same(clock):
    forecast = Forecast({"a": 10.0, "b": 30.0}, clock)
    assert forecast.left("a") == pytest.approx(40.0)
    clock.now = 5.0
    assert forecast.left("a") == pytest.approx(35.0)
    clock.now = 500.0  # it takes much longer; something must still be left
    left = forecast.left("a")
    assert left is not None
    assert left > 30.0


@pytest.mark.parametrize("parts", [{"a": 0.0}, {"a": 0.0, "b": 0.0}])
def test_work_of_no_length_takes_no_time(parts, clock):
    assert Forecast(parts, clock).left("a") == 0.0


def test_an_unknown_part_has_no_time_left(clock):
    assert Forecast({"a": 10.0}, clock).left("b") is None


def test_a_step_counts_as_its_part_or_as_a_part_of_its_own(clock):
    forecast = Forecast({"images": 10.0, "thermal camera: matching": 90.0}, clock)
    assert forecast.left("images: reading and writing", 0.0) == pytest.approx(100.0)
    clock.now = 55.0
    assert forecast.left("thermal camera: matching", 0.5) == pytest.approx(45.0)


def test_a_short_stage_that_takes_five_times_as_long_says_little_of_a_long_one():
    assert pace_so_far(5.0, 1.0, 200.0) < 1.25
    assert pace_so_far(500.0, 100.0, 200.0) > 4.0
    assert pace_so_far(0.0, 0.0, 0.0) == 1.0
