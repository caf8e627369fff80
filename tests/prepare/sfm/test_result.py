from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from mrgs.errors import SceneError
from mrgs.prepare.sfm.reconstruct import read_result
from mrgs.scene import RGB, THERMAL


def image(group: int | None, features: int | None = 900, matches: int = 200) -> dict:
    return {
        "features": features,
        "matches": matches,
        "with": "000001.jpg" if matches else None,
        "group": group,
    }


def write(
    folder, images: list[dict], groups: list[int], reprojection_px: float = 0.5, nearby=False
) -> None:
    """What the process leaves: views named a, b, c, …; the largest model has one camera, and three
    points."""
    files = [f"{number:06d}.jpg" for number in range(1, len(images) + 1)]
    names = [{"file": file, "name": "abcdefghijklmno"[index]} for index, file in enumerate(files)]
    (folder / "job.json").write_text(json.dumps({"images": names}))
    model = folder / "model"
    model.mkdir()
    report = {
        "images": images,
        "groups": groups,
        "reprojection_px": reprojection_px if groups else None,
        "nearby": nearby,
    }
    (model / "report.json").write_text(json.dumps(report))
    registered = [index for index, own in enumerate(images) if own["group"] == 0]
    (model / "cameras.bin").write_bytes(
        struct.pack("<QIiQQ4d", 1, 1, 2, 40, 30, 35.0, 20.0, 15.0, 0.01)
    )
    body = struct.pack("<Q", len(registered))
    for index in registered:
        body += (
            struct.pack("<I7dI", index + 7, 1, 0, 0, 0, 0.1 * index, 0, 3, 1)
            + files[index].encode()
            + b"\0"
        )
        body += struct.pack("<Q", 0)
    (model / "images.bin").write_bytes(body)
    np.savez(
        model / "points.npz",
        positions=np.arange(9.0).reshape(3, 3),
        colors=np.array([[255, 0, 51], [0, 255, 0], [1, 2, 3]], dtype=np.uint8),
        seen=np.array([[0, 0], [0, 2], [1, 1], [3, 0]]),
    )


def test_poses_points_and_what_each_view_sees(tmp_path):
    write(tmp_path, [image(0), image(0), image(None, matches=12), image(0)], [3])
    found = read_result(tmp_path, RGB)
    assert list(found.viewmats) == list(found.lenses) == ["a", "b", "d"]
    assert found.viewmats["d"][0, 3] == pytest.approx(0.3)
    assert found.lenses["a"].radial[0] == 0.01
    assert found.points.positions.shape == (3, 3)
    assert found.points.colors[0].tolist() == pytest.approx([1, 0, 0.2])
    assert {name: seen.tolist() for name, seen in found.visible.items()} == {
        "a": [0, 2],
        "b": [1],
        "d": [0],
    }
    assert (found.reprojection_px, found.images, found.warnings) == (0.5, RGB, ())
    for told in ("COLMAP", "3 of 4 photos", "3 points"):
        assert told in found.source
    (left,) = found.failed
    assert left.name == "c"
    assert "12 matches at most, with a)" in left.reason


def test_matches_by_gps_are_told(tmp_path):
    write(tmp_path, [image(0)] * 4, [4], nearby=True)
    assert "GPS" in read_result(tmp_path, RGB).source


@pytest.mark.parametrize(
    ("own", "reason"),
    [
        (image(None, features=None), "not be read"),
        (image(None, features=31), "(31 features)"),
        (image(None, matches=0), "(0 matches at most)"),
        (image(1), "group of 2"),
        (image(None), "(200 at most, with"),
    ],
)
def test_why_an_image_has_no_pose(tmp_path, own, reason):
    write(tmp_path, [image(0), image(0), image(0), own], [3, 2])
    (failed,) = read_result(tmp_path, RGB).failed
    assert failed.name == "d"
    assert reason in failed.reason


def test_groups_that_are_not_connected_are_told(tmp_path):
    write(tmp_path, [image(0)] * 5 + [image(1)] * 3, [5, 3])
    (warning,) = read_result(tmp_path, THERMAL).warnings
    assert "2 groups" in warning
    assert "(5, 3 photos)" in warning


def test_rough_poses_are_told(tmp_path):
    write(tmp_path, [image(0)] * 4, [4], reprojection_px=1.34)
    (warning,) = read_result(tmp_path, THERMAL).warnings
    assert "rough" in warning
    assert "1.3 px" in warning


def test_too_few_views(tmp_path):
    write(
        tmp_path,
        [image(0), image(0)] + [image(None, features=12)] * 8 + [image(None, matches=0)],
        [2],
    )
    with pytest.raises(SceneError) as error:
        read_result(tmp_path, RGB)
    for told in ("2 of 11", "(c, d, e, f, g, h and 2 more: ", "; k: "):
        assert told in str(error.value)


def test_no_model_at_all(tmp_path):
    write(tmp_path, [image(None, matches=0)] * 4, [])
    with pytest.raises(SceneError, match="0 of 4"):
        read_result(tmp_path, RGB)
