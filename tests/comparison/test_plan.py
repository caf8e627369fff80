from __future__ import annotations

import json
import re
import shutil

import pytest
from PIL import Image

from mrgs.errors import ConfigError, MrgsWarning, SceneError
from mrgs.training import train
from mrgs_compare.plan import Options, Variant, neighbour_methods, plan
from tests.helpers.comparison import tiny_options
from tests.helpers.scenes import write_scene


def test_every_seed_is_done_for_all_before_the_next(small_scene, tmp_path):
    jobs = plan(
        [small_scene, write_scene(tmp_path / "scene")],
        tmp_path / "out",
        tiny_options(seeds=2, neighbours=(1, 3)),
    )
    assert [(job.scene_name, job.method, job.seed) for job in jobs[:4]] == [
        ("balls", "3dgs-rgbt", 0), ("balls", "mrgs", 0), ("balls", "mrgs-n1", 0),
        ("scene", "3dgs-rgbt", 0),
    ]  # fmt: skip
    assert len(jobs) == 2 * 2 * 3
    assert jobs[-1].folder == tmp_path / "out" / "runs" / "scene" / "mrgs-n1" / "seed_1"
    assert (jobs[-1].config.seed, jobs[-1].config.field.neighbours_n) == (1, 1)


def test_mrgs_itself_stands_for_its_own_number_of_neighbours():
    assert neighbour_methods(tiny_options(neighbours=(1, 3, 5))) == {
        1: "mrgs-n1",
        3: "mrgs",
        5: "mrgs-n5",
    }


def test_variants_come_between_the_methods_and_the_neighbours(small_scene, tmp_path):
    variant = Variant("half", "mrgs", "densification: {max_gaussians: 30}", "half.yaml")
    jobs = plan(
        [small_scene],
        tmp_path,
        tiny_options(methods=("mrgs",), variants=(variant,), neighbours=(1,)),
    )
    assert [job.method for job in jobs] == ["mrgs", "half", "mrgs-n1"]
    assert [job.config.densification.max_gaussians for job in jobs] == [60, 30, 60]


def test_the_neighbours_alone_need_no_method(small_scene, tmp_path):
    jobs = plan([small_scene], tmp_path, tiny_options(methods=(), neighbours=(1, 3)))
    assert [job.method for job in jobs] == ["mrgs-n1", "mrgs"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": 0}, "seeds .* 0"),
        ({"methods": ()}, "one method"),
        ({"methods": ("magic",)}, "method 'magic'"),
        ({"preset": "slow"}, "preset 'slow'"),
        ({"neighbours": (0,)}, "neighbours_n"),
    ],
)
def test_options_that_are_not_allowed(changes, message, small_scene, tmp_path):
    with pytest.raises(ConfigError, match=message):
        plan([small_scene], tmp_path / "out", tiny_options(**changes))
    assert not (tmp_path / "out").exists()


def test_at_least_one_scene(tmp_path):
    with pytest.raises(ConfigError, match="one scene"):
        plan([], tmp_path, tiny_options())


def test_scenes_of_one_name_are_told_apart_by_the_user(small_scene, tmp_path):
    twin = shutil.copytree(small_scene, tmp_path / "elsewhere" / small_scene.name)
    with pytest.raises(ConfigError, match=rf"{twin.parent.name}/balls .*rename"):
        plan([small_scene, twin], tmp_path / "out", tiny_options())
    assert len(plan([small_scene, small_scene], tmp_path / "out", tiny_options())) == 2


def test_a_name_stands_for_one_folder_over_time(small_scene, tmp_path):
    twin = shutil.copytree(small_scene, tmp_path / "elsewhere" / small_scene.name)
    plan([small_scene], tmp_path / "out", tiny_options())
    with pytest.raises(ConfigError, match=rf"of {re.escape(str(small_scene))} .*scenes\.json"):
        plan([twin], tmp_path / "out", tiny_options())
    (tmp_path / "out" / "scenes.json").write_text("[1]")
    with pytest.raises(ConfigError, match=r"scenes\.json .*remove"):
        plan([small_scene], tmp_path / "out", tiny_options())


def test_a_scene_without_held_out_views(tmp_path):
    scene = write_scene(tmp_path / "scene")
    content = json.loads((scene / "transforms.json").read_text())
    content["train_filenames"] = [frame["file_path"] for frame in content["frames"]]
    (scene / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(SceneError, match="held out"):
        plan([scene], tmp_path, tiny_options())


def test_a_folder_with_another_run_is_found_before_anything_runs(small_scene, tmp_path):
    options = tiny_options(methods=("3dgs-rgbt",))
    (job,) = plan([small_scene], tmp_path, options)
    train(small_scene, job.folder, job.config)
    plan([small_scene], tmp_path, options)
    with pytest.raises(ConfigError, match=r"seed_0 .*max_steps is 3"):
        plan([small_scene], tmp_path, tiny_options(methods=("3dgs-rgbt",), max_steps=4))


def test_a_scene_that_is_odd_is_said_before_anything_runs(small_scene, tmp_path):
    scene = shutil.copytree(small_scene, tmp_path / "odd")
    for photo in (scene / "images").iterdir():
        with Image.open(photo) as image:
            Image.new(image.mode, image.size).save(photo)
    with pytest.warns(MrgsWarning, match=r"^odd: .*black"):
        plan([scene], tmp_path / "out", tiny_options())


def test_the_setup_of_the_runs_is_a_sentence():
    options = Options(seeds=3, preset="fast", max_steps=1000, max_gaussians=8000, resolution=160)
    assert options.setup(48) == (
        "3 seeds; preset fast, 1,000 steps, at most 8,000 Gaussians, images at most 160 px wide; "
        "48 held-out views."
    )
    assert Options().setup(1) == "1 seed; preset default; 1 held-out view."
