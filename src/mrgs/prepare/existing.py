"""Poses given by the user, as a COLMAP model or in nerfstudio's format."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TypeVar

import torch

from mrgs.data.colmap import (
    MODEL_FOLDERS,
    RegisteredImage,
    find_model,
    largest_model,
    read_images,
    read_points3d,
)
from mrgs.data.files import composed, without_image_suffix
from mrgs.data.nerfstudio import find_transforms, read_transforms
from mrgs.data.sources import ReadingNotes, point_cloud
from mrgs.errors import SceneError, scene_error
from mrgs.prepare.contract import MIN_VIEWS, PhotoPair, Reconstruction, Skipped
from mrgs.scene import Modality, PointCloud, WorldFrame
from mrgs.scene.lens import Lens
from mrgs.scene.modality import in_order

Item = TypeVar("Item")
_ASPECT_TOLERANCE = 0.01


def existing_poses(
    folder: Path,
    images: Mapping[str, Path],
    sizes: Mapping[str, tuple[int, int]],
    *,
    pairs: Sequence[PhotoPair] = (),
    two_cameras: bool = True,
) -> Reconstruction:
    """The poses in a folder for images with the same names (extensions may differ, and folders
    where names without them tell the images apart).

    The folder has a ``transforms.json`` with its images, or a COLMAP model. Where an image is
    larger or smaller than the one in the file, the lens is scaled. SceneError if no poses are
    found, they are damaged, or fewer than three belong to the images.

    Args:
        folder: with the poses, or a transforms file.
        images: files by the views' names, without folders and extension.
        sizes: width and height of each, in pixels.
        pairs: of the views, if the poses' images have the names of the photos.
        two_cameras: whether there is a thermal camera to be found, which needs points.
    """
    given, cloud, file, notes, world = _read(folder)
    photos = {
        pair.name: tuple(map(composed, _first(pair.photos).with_suffix("").parts)) for pair in pairs
    }
    tries = [photos] if photos.keys() >= images.keys() else []
    if not tries or len({path[-1] for path in photos.values()}) < len(photos):
        tries.append({name: (name,) for name in images})
    poses, several = max((_matched(each, given) for each in tries), key=lambda each: len(each[0]))
    if several:
        raise scene_error(
            folder,
            f"has several poses named {', '.join(several[:3])}; name them in it like the photos, "
            f"with their folders",
        )
    viewmats = {name: poses[name].viewmat for name in images if name in poses}
    if len(viewmats) < MIN_VIEWS:
        like = ", ".join(sorted(pose.name for pose in given)[:3])
        raise scene_error(
            folder,
            f"{len(viewmats)} of {len(images)} photos have a pose of their name there, and "
            f"{MIN_VIEWS} are needed; names there are like {like}: give the poses of these photos",
        )
    warnings = tuple(notes.repaired)
    if cloud is None and two_cameras:
        warnings += (
            f"{file} has no points: the thermal camera cannot be found from the photos without "
            f"them.",
        )
    reason = f"{file} has no pose of this name"
    return Reconstruction(
        viewmats,
        {name: _scaled(poses[name].lens, images[name], sizes[name]) for name in viewmats},
        cloud or PointCloud(torch.zeros(0, 3), torch.zeros(0, 3)),
        None,
        tuple(Skipped(name, reason) for name in images if name not in poses),
        None,
        f"The poses of {len(viewmats)} of {len(images)} photos are those of {file}.",
        warnings=warnings,
        world=world,
    )


def _matched(
    photos: Mapping[str, tuple[str, ...]], given: Sequence[RegisteredImage]
) -> tuple[dict[str, RegisteredImage], list[str]]:
    """The pose of each photo: the one whose path has the longest end in common with the photo's, if
    no other photo has that end, and with its folder, if names without folders repeat; and the ends
    that several poses have."""
    poses = defaultdict[tuple[str, ...], list[RegisteredImage]](list)
    for pose in given:
        parts = _parts(pose.name)
        for start in range(len(parts)):
            poses[parts[start:]].append(pose)
    repeat = any(len(end) == 1 and len(same) > 1 for end, same in poses.items())
    ends = {name: [path[at:] for at in range(len(path))] for name, path in photos.items()}
    shared = Counter(end for each in ends.values() for end in each)
    found, several = dict[str, RegisteredImage](), set[str]()
    for name, each in ends.items():
        end = next((end for end in each if end in poses), ())
        same = poses.get(end, [])
        if len(same) > 1:
            several.add("/".join(end))
        elif same and shared[end] == 1 and len(end) >= min(1 + repeat, len(_parts(same[0].name))):
            found[name] = same[0]
    return found, sorted(several)


def _read(
    folder: Path,
) -> tuple[Sequence[RegisteredImage], PointCloud | None, str, ReadingNotes, WorldFrame]:
    """Poses by the names of their images, points, the name of the file, what was repaired, and what
    is known of the world."""
    if folder.is_dir():
        root = folder.resolve()
        file = find_transforms(root)
    elif folder.suffix == ".json" and folder.is_file():
        root = folder.parent.resolve()
        file = root / folder.name
    else:
        raise scene_error(folder, "is not a folder; give the one with the poses")
    if file is not None:
        source = read_transforms(root, file)
        firsts = [(view.key, _first(view.images)) for view in source.views]
        poses = [RegisteredImage(key, image.lens, image.viewmat) for key, image in firsts]
        return poses, source.points, file.name, source.notes, source.world
    notes = ReadingNotes()
    model = largest_model(root, notes) or find_model(root, ["."])
    if model is None:
        looked_for = ", ".join(f"{name}/cameras.bin or .txt" for name in MODEL_FOLDERS)
        raise scene_error(
            folder,
            f"holds no poses; looked for transforms.json, {looked_for}; give the folder with one",
        )
    points = point_cloud(*read_points3d(model), notes)
    return read_images(model), points, model.file("images").name, notes, WorldFrame()


def _first(images: Mapping[Modality, Item]) -> Item:
    """The image that the poses belong to: RGB if there is one."""
    return images[in_order(images)[0]]


def _parts(path: str) -> tuple[str, ...]:
    return PurePosixPath(composed(without_image_suffix(path.replace("\\", "/")))).parts


def _scaled(lens: Lens, path: Path, size: tuple[int, int]) -> Lens:
    """The lens at the size of the image, which must have the pose's aspect ratio."""
    width, height = size
    if abs(width / lens.width / (height / lens.height) - 1) > _ASPECT_TOLERANCE:
        raise SceneError(
            f"{path} is {width}×{height} px, but its pose is for "
            f"{lens.width}×{lens.height} px; give the photos as they were when the poses were "
            f"made, not cropped"
        )
    return lens.resized(width, height)
