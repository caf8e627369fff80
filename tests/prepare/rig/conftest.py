from __future__ import annotations

import pytest

from tests.helpers.rig_room import Room, build_room


@pytest.fixture(scope="session")
def room() -> Room:
    """Four pairs of a rigid rig; only to be read."""
    return build_room(views=4)
