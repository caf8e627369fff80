"""The training views of a run where its model has seen them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float64
from torch import Tensor

from mrgs.method.camera_model.pose_refinement import PoseRefinement
from mrgs.scene import Camera, Modality, Scene, View


@torch.no_grad()
def with_refined_poses(scene: Scene, poses: PoseRefinement) -> Scene:
    """The scene with the poses of its training views as they were refined on it, and a note of how
    far they were moved, in pixels of each view's first camera; held-out views keep theirs."""
    views, shifts = scene.train, poses.shifts().tolist()
    train = tuple(
        moved_view(view, poses.motion(torch.tensor([number]))) for number, view in enumerate(views)
    )
    pixels = [shift * view.camera.focal_px for shift, view in zip(shifts, views, strict=True)]
    farthest = max(range(len(views)), key=pixels.__getitem__)
    note = (
        f"the poses of the training photos were refined, by {sum(pixels) / len(pixels):.1f} px on "
        f"average and at most {pixels[farthest]:.1f} px ({views[farthest].name})"
    )
    return replace(scene, train=train, notes=(*scene.notes, note))


def moved_cameras(
    cameras: Mapping[Modality, Camera], motion: Float64[Tensor, "4 4"]
) -> dict[Modality, Camera]:
    """Cameras that see the world moved, in scene units."""
    return {
        modality: Camera(camera.K, camera.viewmat @ motion, camera.width, camera.height)
        for modality, camera in cameras.items()
    }


def moved_view(view: View, motion: Float64[Tensor, "4 4"]) -> View:
    """The view with the cameras that see the world moved."""
    cameras = moved_cameras(view.cameras, motion)
    images = {each: replace(view.images[each], camera=cameras[each]) for each in view.images}
    return replace(view, images=images)
