from __future__ import annotations

import json
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.system.wording import Message
from mrgs.viewer.browser import Look, decode
from mrgs.viewer.facts import encode

LOOK = {
    "type": "look",
    "number": 1,
    "rotation": [0, 1, 0, 0, 0, -1, -1, 0, 0],
    "position": [3, 0, 0],
    "focal": [100, 110],
    "centre": [80, 60],
    "width": 160,
    "height": 120,
    "effort": "moving",
}


def look(**changed) -> str:
    return json.dumps({**LOOK, **changed})


def test_a_camera_arrives_as_it_was_sent():
    camera = decode(look()).camera()
    torch.testing.assert_close(camera.position, torch.tensor([3.0, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(camera.forward, torch.tensor([-1.0, 0, 0], dtype=torch.float64))
    assert camera.K.diagonal().tolist() == [100, 110, 1]
    assert (camera.width, camera.height) == (160, 120)


@pytest.mark.parametrize(
    "changed",
    [
        {"rotation": [1.0] * 9},
        {"rotation": [0.0] * 9},
        {"rotation": [1.0] * 8},
        {"position": [math.nan, 0, 0]},
        {"position": [math.inf, 0, 0]},
        {"position": [1e300, 0, 0]},
        {"focal": [0, 1]},
        {"focal": [-5, 1]},
        {"width": 0},
        {"width": -5},
        {"width": 10**9},
        {"height": 10**30},
        {"effort": "endless"},
        {"number": "1"},
        {"more": 1},
    ],
)
def test_what_is_no_camera_is_refused(changed):
    with pytest.raises(ValueError):  # noqa: PT011 - of many kinds
        decode(look(**changed)).camera()


@pytest.mark.parametrize(
    "data",
    [
        "",
        "{",
        "null",
        "[]",
        "5",
        '{"type": "unheard"}',
        '{"type": "look"}',
        b"\xff\x00",
        "[" * 5000,
    ],
)
def test_what_is_no_message_is_refused(data):
    with pytest.raises((ValueError, RecursionError)):
        decode(data)


@pytest.mark.parametrize(
    ("message", "wrong"),
    [
        ({"type": "hover", "x": 1, "y": 0}, {"x": 1.001}),
        ({"type": "read", "x": 0, "y": 1}, {"y": -0.001}),
        ({"type": "add_mark", "kind": "line", "points": [[0, 0]] * 200}, {"points": []}),
        ({"type": "add_mark", "kind": "spot", "points": [[1, 1]]}, {"points": [[0, 0]] * 201}),
        ({"type": "add_mark", "kind": "spot", "points": [[1, 1]]}, {"points": [[0, 1.5]]}),
        ({"type": "photo", "index": 0}, {"index": -1}),
        ({"type": "delete_mark", "mark": 10**9}, {"mark": 10**9 + 1}),
        ({"type": "judge", "mark": "a" * 10_000, "accept": True}, {"mark": "a" * 10_001}),
        ({"type": "video", "seconds": 0.5}, {"seconds": 0.49}),
        ({"type": "save_path", "seconds": 600}, {"seconds": 600.1}),
        ({"type": "keep", "kind": "polygon", "points": [[0, 0]] * 200}, {"points": [[0, 0]] * 201}),
        ({"type": "keep", "kind": "box", "points": [[0, 0], [1, 1]]}, {"points": [[0, 0], [1, 2]]}),
        ({"type": "keep", "kind": "sides", "sides": [1e9] * 6}, {"sides": [1e9] * 5 + [1.1e9]}),
        ({"type": "keep", "kind": "sides", "sides": [0] * 6}, {"sides": [0] * 5}),
        ({"type": "keep", "kind": "all"}, {"kind": "line"}),
        ({"type": "keep", "kind": "undo"}, {"file": "/etc"}),
        ({"type": "undo"}, {"type": "close"}),
        ({"type": "undo"}, {"where": "/etc"}),
    ],
)
def test_numbers_and_lengths_have_ends(message, wrong):
    decode(json.dumps(message))
    with pytest.raises(ValueError, match="does not understand"):
        decode(json.dumps(message | wrong))


def test_a_change_has_the_fields_that_were_sent_and_no_others():
    change = {"type": "change_mark", "mark": 3, "note": "", "emissivity": None}
    assert decode(json.dumps(change)).fields == {"note": "", "emissivity": None}


def test_the_principal_point_and_both_focal_lengths_arrive():
    camera = decode(look(focal=[100, 110], centre=[80, 60])).camera()
    assert camera.K.tolist() == [[100, 0, 80], [0, 110, 60], [0, 0, 1]]


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(sorted(LOOK)[:-1]), json_values, max_size=3))
def test_whatever_a_look_says_it_gives_a_finite_camera_or_is_refused(changed):
    try:
        message = decode(look(**changed))
        assert isinstance(message, Look)
        camera = message.camera()
    except ValueError:
        return
    assert torch.isfinite(camera.K).all()
    assert torch.isfinite(camera.viewmat).all()
    assert 1 <= camera.width <= 4096


def test_what_is_not_understood_is_said_in_words():
    with pytest.raises(ValueError, match="reload"):
        decode('{"type": "change_mark", "mark": 1, "note": 5}')


def test_a_name_that_is_not_utf_8_is_sent_as_far_as_it_can_be_read():
    facts = {"name": "caf\udce9", "views": ({"name": "é \udcff"}, 1.5, None), "far": math.inf}
    assert json.loads(encode(facts)) == {
        "name": "caf?", "views": [{"name": "é ?"}, 1.5, None], "far": None,
    }  # fmt: skip
    note = Message("{name} is new.", name="\udcff")
    assert json.loads(encode([note])) == ["? is new."]


def test_a_text_with_values_is_sent_as_text():
    note = Message("{celsius} °C.", celsius="20")
    assert json.loads(encode({"notes": (note,)})) == {"notes": ["20 °C."]}
