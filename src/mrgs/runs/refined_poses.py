"""The training views of a run where its model has seen them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from mrgs.method.camera_model.pose_refinement import PoseRefinement
from mrgs.scene import Camera, Scene, View


@torch.no_grad()
def with_refined_poses(scene: Scene, poses: PoseRefinement) -> Scene:
    """The scene with the poses of its training views as they were refined, and a note of how far
    they were moved; held-out views keep theirs.

    Args:
        scene: that the poses were refined on.
        poses: as learned.
    """
    train = tuple(_refined(view, number, poses) for number, view in enumerate(scene.train))
    note = _note(scene.train, poses.shifts().tolist())
    return replace(scene, train=train, notes=(*scene.notes, note))


def _refined(view: View, number: int, poses: PoseRefinement) -> View:
    motion = poses.motion(torch.tensor([number]))
    images = {
        modality: replace(image, camera=_moved(image.camera, motion))
        for modality, image in view.images.items()
    }
    return replace(view, images=images)


def _moved(camera: Camera, motion: torch.Tensor) -> Camera:
    return Camera(camera.K, camera.viewmat @ motion, camera.width, camera.height)


def _note(views: Sequence[View], shifts: Sequence[float]) -> str:
    """How far the poses were moved, in pixels of each view's first camera."""
    pixels = [shift * view.camera.focal_px for shift, view in zip(shifts, views, strict=True)]
    farthest = max(range(len(views)), key=pixels.__getitem__)
    return (
        f"the poses of the training photos were refined, by {sum(pixels) / len(pixels):.1f} px on "
        f"average and at most {pixels[farthest]:.1f} px ({views[farthest].name})"
    )
