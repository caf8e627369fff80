"""The cameras that a caller asks to render."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from mrgs.scene import Camera, Modality


def asked_cameras(
    cameras: Camera | Mapping[Modality, Camera], modalities: Iterable[Modality]
) -> Mapping[Modality, Camera]:
    """The camera of each modality to render.

    Args:
        cameras: one for all modalities, or one for each modality to render.
        modalities: those of the model.

    Raises:
        ValueError: neither of the two.
    """
    if isinstance(cameras, Camera):
        return dict.fromkeys(modalities, cameras)
    if not isinstance(cameras, Mapping):
        raise ValueError(
            f"cameras must be a Camera or a mapping such as {{RGB: camera}}, not "
            f"{type(cameras).__name__}"
        )
    for modality, camera in cameras.items():
        if not isinstance(modality, Modality):
            raise ValueError(f"{modality!r} is not a modality: use mrgs.RGB or mrgs.THERMAL")
        if not isinstance(camera, Camera):
            raise ValueError(f"{modality} must have a Camera, not {type(camera).__name__}")
    return cameras
