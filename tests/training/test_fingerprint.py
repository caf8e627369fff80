"""What a run was trained on."""

from __future__ import annotations

from mrgs.data import load_scene
from mrgs.data.posed import photos_read
from mrgs.training.fingerprint import fingerprints


def test_photos_are_counted_while_their_digests_are_taken(small_scene):
    scene = load_scene(small_scene)
    before = photos_read()
    found = fingerprints(scene)
    assert photos_read() - before == len(found) > 0
