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
        modalities: those that can be rendered.

    Raises:
        ValueError: neither of the two, or a modality that cannot be rendered.
    """
    modalities = tuple(modalities)
    if isinstance(cameras, Camera):
        return dict.fromkeys(modalities, cameras)
    if not isinstance(cameras, Mapping):
        raise ValueError(
            f"cameras must be a Camera or a mapping such as {{RGB: camera}}, not "
            f"{type(cameras).__name__}"
        )
    names = " and ".join(map(str, modalities))
    if not cameras:
        raise ValueError(f"cameras is empty: give a Camera, or one for each of {names}")
    for modality, camera in cameras.items():
        if not isinstance(modality, Modality):
            raise ValueError(f"{modality!r} is not a modality: use mrgs.RGB or mrgs.THERMAL")
        if modality not in modalities:
            raise ValueError(f"{modality} cannot be rendered here, only {names}: leave it out")
        if not isinstance(camera, Camera):
            raise ValueError(f"{modality} must have a Camera, not {type(camera).__name__}")
    return cameras
