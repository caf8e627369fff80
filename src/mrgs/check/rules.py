"""All rules by which a scene is judged."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from mrgs.check import cameras, photos
from mrgs.check.problem import Evidence, Problem
from mrgs.errors import warn_user
from mrgs.scene import Scene


class Rule(NamedTuple):
    """A rule, and whether it is fast enough for ``mrgs train`` to apply it before each training. A
    ``fast`` one judges what ``fast_problems`` reads: all poses, and the photos of a few views."""

    find: Callable[[Evidence], Iterable[Problem]]
    fast: bool = False


RULES = (
    Rule(cameras.number_of_views),
    Rule(cameras.near_plane, fast=True),
    Rule(cameras.extent),
    Rule(cameras.distance_from_origin, fast=True),
    Rule(cameras.no_points),
    Rule(cameras.equal_poses, fast=True),
    Rule(cameras.unseen_points, fast=True),
    Rule(cameras.lonely_views, fast=True),
    Rule(cameras.poses_and_points),
    Rule(cameras.similar_poses),
    Rule(cameras.rig),
    Rule(cameras.intrinsics),
    Rule(photos.unreadable),
    Rule(photos.missing, fast=True),
    Rule(photos.without_temperatures),
    Rule(photos.sizes),
    Rule(photos.used_twice, fast=True),
    Rule(photos.uniform, fast=True),
    Rule(photos.identical, fast=True),
    Rule(photos.few_bits, fast=True),
    Rule(photos.saturated),
    Rule(photos.outside, fast=True),
    Rule(photos.jumps),
    Rule(photos.blurred),
)
"""All rules, in the order in which problems are reported."""


def find_problems(evidence: Evidence, fast: bool = False) -> list[Problem]:
    """The problems that all rules find, or only the fast ones."""
    return [problem for rule in RULES if rule.fast or not fast for problem in rule.find(evidence)]


def fast_problems(scene: Scene) -> list[Problem]:
    """Problems of poses, and of ``photos.FEW_VIEWS`` views' photos; SceneError if unreadable."""
    return find_problems(Evidence(scene, photos.measure_few(scene)), fast=True)


def warn_of_problems(scene: Scene) -> None:
    """Warn of ``fast_problems`` and their remedies, but not of notes; errors as there."""
    for problem in fast_problems(scene):
        if problem.severity != "note":
            warn_user(f"{scene.name}: {problem.text} {problem.remedy}".rstrip())
