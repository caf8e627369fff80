"""The exact truth of a generated scene: temperatures and depths that no camera has blurred or
rounded.

``SCENE/truth/temperature/NAME.tiff`` holds °C and ``SCENE/truth/depth/NAME.tiff`` z-depth in metres
(the scene's unit), both float32 and seen from the thermal camera of the view NAME. Temperatures
that are not finite and depths that are not finite and positive (sky) are left out.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from PIL import Image
from torch import Tensor

from mrgs.errors import SceneError
from mrgs.evaluation.figures import Figure, Figures, Missing, all_missing
from mrgs.evaluation.metrics import mean_absolute_error
from mrgs.scene import Pixels, Scene, TemperatureRange

TRUTH_FIGURES = ("mae_c", "camera_mae_c", "depth_median_relative_error")


@dataclass(frozen=True)
class Truth:
    """The folder ``truth`` of a generated scene; its files are read when a view is scored."""

    folder: Path

    @classmethod
    def find(cls, scene: Path) -> Truth | None:
        """The exact truth in a scene's folder; None if there is none, as for every real capture."""
        folder = scene / "truth"
        return cls(folder) if folder.is_dir() else None

    @classmethod
    def of(cls, scene: Scene) -> Truth | None:
        """The exact truth of a scene; None if there is none, or if it was made from arrays."""
        path = Path(scene.path)
        if not scene.path:
            return None
        return cls.find(path.parent if path.is_file() else path)

    def score(
        self,
        name: str,
        thermal: Float[Tensor, "h w 1"] | None,
        photo: Pixels | None,
        depth: Float[Tensor, "h w"] | None,
        temperature: TemperatureRange | None,
    ) -> Figures:
        """Score one view against the exact truth.

        Args:
            name: the view's.
            thermal: rendered normalised temperatures, [H, W, 1]; None without them.
            photo: the thermal photo; None without one.
            depth: rendered z-depth of the surface that the thermal camera sees, scene units,
                [H, W]; NaN where it sees none, which counts as an infinite error. None without a
                depth.
            temperature: the scene's scale; None without °C.

        Returns:
            ``mae_c``: |rendered − exact temperature|, mean over the frame. ``camera_mae_c``:
            |photo − exact temperature|, the error of the camera itself.
            ``depth_median_relative_error``: median of |rendered − exact| / exact.

        Raises:
            SceneError: a truth file is damaged, or lies outside the scene.
        """
        figures = all_missing(
            TRUTH_FIGURES, "the view has no thermal image, or the scene has no °C"
        )
        if temperature is not None and thermal is not None:
            figures["mae_c"] = self._temperature_error(name, thermal, None, temperature)
        if temperature is not None and photo is not None:
            figures["camera_mae_c"] = self._temperature_error(
                name, photo.values, photo.valid, temperature
            )
        figures["depth_median_relative_error"] = self._depth_error(name, depth)
        return figures

    def _temperature_error(
        self, name: str, thermal: Tensor, valid: Tensor | None, temperature: TemperatureRange
    ) -> Figure:
        exact = self.read("temperature", name, (thermal.shape[0], thermal.shape[1]))
        if isinstance(exact, Missing):
            return exact
        known = exact.isfinite() if valid is None else exact.isfinite() & valid.cpu()
        if not known.any():
            return Missing(f"no pixel of truth/temperature/{name}.tiff has a temperature")
        return mean_absolute_error(temperature.to_celsius(thermal[..., 0]).cpu(), exact, known)

    def _depth_error(self, name: str, depth: Tensor | None) -> Figure:
        if depth is None:
            return Missing("the model renders no depth")
        exact = self.read("depth", name, (depth.shape[0], depth.shape[1]))
        if isinstance(exact, Missing):
            return exact
        known = exact.isfinite() & (exact > 0)
        if not known.any():
            return Missing(f"no pixel of truth/depth/{name}.tiff has a depth")
        errors = (depth.detach().cpu()[known] - exact[known]).abs() / exact[known]
        median = float(np.median(errors.nan_to_num(nan=math.inf).numpy()))
        return median if math.isfinite(median) else Missing("most pixels show no surface")

    def read(
        self, kind: str, name: str, shape: tuple[int, int]
    ) -> Float32[Tensor, "h w"] | Missing:
        """The truth of one view at the size of a rendering; averaged over areas where that is
        smaller.

        Args:
            kind: ``temperature`` (°C) or ``depth`` (z-depth, metres).
            name: the view's.
            shape: rows and columns of the rendering.

        Raises:
            SceneError: the file is damaged, or lies outside the scene.
        """
        path = self.folder / kind / f"{name}.tiff"
        if not path.resolve().is_relative_to(self.folder.resolve()):
            raise SceneError(f"{path} lies outside {self.folder}: rename the view")
        if not path.is_file():
            return Missing(f"there is no truth/{kind}/{name}.tiff")
        exact = read_float_tiff(path)
        height, width = exact.shape
        if (height, width) != shape:
            if (
                shape[0] > height
                or shape[1] > width
                or abs(shape[0] * width - shape[1] * height) > max(width, height)
            ):
                return Missing(
                    f"truth/{kind} is {width}×{height}, the rendering {shape[1]}×{shape[0]}"
                )
            exact = np.asarray(
                Image.fromarray(exact).resize((shape[1], shape[0]), Image.Resampling.BOX)
            )
        return torch.from_numpy(np.array(exact))


def read_float_tiff(path: Path) -> Float32[np.ndarray, "h w"]:
    """Read a one-channel float32 TIFF.

    Raises:
        SceneError: the file is damaged or of another kind.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Pillow only warns of damaged tags
            image = Image.open(path)
        with image:
            if image.mode != "F":
                raise SceneError(
                    f"{path}: a one-channel float32 TIFF is expected, the file's mode is "
                    f"{image.mode}"
                )
            return np.asarray(image, dtype=np.float32)
    except (OSError, ValueError, SyntaxError, Warning, Image.DecompressionBombError) as error:
        raise SceneError(f"{path}: not a readable TIFF ({error})") from error
