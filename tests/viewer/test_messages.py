from __future__ import annotations

import json
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from mrgs.system.message import Message
from mrgs.viewer.messages import Look, decode, encode

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
    with pytest.raises(ValueError, match="does not understand what the page sent: reload the page"):
        decode('{"type": "change_mark", "mark": 1, "note": 5}')


def test_a_text_with_values_is_sent_as_text():
    note = Message("The air is assumed to have {celsius} °C.", celsius="20")
    assert json.loads(encode({"notes": (note,)})) == {
        "notes": ["The air is assumed to have 20 °C."]
    }
