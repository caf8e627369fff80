"""DJI's R-JPEGs, read by DJI's own tool where that is installed, and the tool's bare numbers."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from mrgs.data.radiometric.exif import read_exif
from mrgs.data.radiometric.photo import Overrides, PhotoFacts, ThermalPhoto
from mrgs.data.radiometric.raster import finished
from mrgs.data.radiometric.units import FLOAT_UNITS, typical
from mrgs.errors import ToolError, scene_error

SIZES = ((640, 512), (1280, 1024), (336, 256), (160, 120), (320, 256), (640, 480))
"""Width and height of the thermal images of DJI's cameras, which bare numbers do not have."""

TOOL = "dji_irp"
"""The program of DJI's Thermal SDK, or one with the same options, somewhere on PATH."""

TIME_LIMIT_S = 60.0
"""Seconds that DJI's tool may take for one photo; it needs less than one."""

MAX_BYTES = max(width * height for width, height in SIZES) * 4

MESSAGE_LENGTH = 120
"""Number of characters of the tool's message that are shown."""

_OPTIONS = {
    "emissivity": ("--emissivity", 1.0),
    "distance_m": ("--distance", 1.0),
    "humidity": ("--humidity", 100.0),
    "reflected_c": ("--reflection", 1.0),
    "atmospheric_c": ("--ambient", 1.0),
}
"""The tool's option for each value that a user may override, and what turns our unit into its."""


def read_r_jpeg(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in an R-JPEG, whose signal only DJI's library turns into temperatures. ``TOOL`` is
    run with a time limit, and what it writes is checked like any file. Overrides of emissivity,
    distance, humidity, reflected and air temperature are handed on; the photo's own count
    otherwise. ToolError if the tool is not installed, cannot be run, does not end or fails;
    SceneError if it writes what is not an image of a DJI camera."""
    tool = shutil.which(TOOL)
    if tool is None:
        raise _tool_error(
            path,
            f"is a DJI R-JPEG, whose temperatures only DJI's Thermal SDK can read; install the SDK "
            f"(free, from DJI's website) so that its program {TOOL} is on PATH, or convert the "
            f"photo elsewhere: {TOOL} -s {path.name} -a measure -o {path.stem}.raw --measurefmt "
            f"float32",
        )
    exif = read_exif(data)
    given = {name: v for name, v in overrides.of_parameters().items() if name in _OPTIONS}
    with tempfile.TemporaryDirectory(prefix="mrgs-") as folder:
        output = Path(folder, "measured.raw")
        run_tool(tool, path, output, given)
        size = output.stat().st_size if output.is_file() else 0
        numbers = output.read_bytes() if 0 < size <= MAX_BYTES else b""
    source = f"DJI R-JPEG, read by {TOOL}"
    facts = PhotoFacts(source, exif.model, taken=exif.taken, gps=exif.gps, given=given)
    unit = Overrides(unit="celsius")
    return _bare_numbers(numbers, path, facts, unit, f"{TOOL} wrote {size} bytes")


def run_tool(
    tool: str, path: Path, output: Path, given: dict[str, float], limit_s: float = TIME_LIMIT_S
) -> None:
    """Run DJI's tool on a photo, with the values that replace the photo's own."""
    arguments = ["-s", os.path.abspath(path), "-a", "measure", "-o", str(output)]
    arguments += ["--measurefmt", "float32"]
    for name, value in given.items():
        option, factor = _OPTIONS[name]
        arguments += [option, f"{value * factor:g}"]
    try:
        done = subprocess.run(
            [tool, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        problem = f"{tool} did not end within {limit_s:g} s; try it by hand"
        raise _tool_error(path, problem) from None
    except OSError as error:
        problem = f"{tool} cannot be run ({error.strerror}); install it again"
        raise _tool_error(path, problem) from error
    if done.returncode != 0:
        lines = done.stdout.decode("utf-8", errors="replace").split("\n")
        said = " ".join(" ".join(line for line in lines if "ERROR" in line).split()) or "no message"
        raise _tool_error(
            path,
            f"{tool} failed with status {done.returncode} ({said[:MESSAGE_LENGTH]}); check the "
            f"photo, and that the version of the tool knows the camera and the options given",
        )


def _tool_error(path: Path, problem: str) -> ToolError:
    return ToolError(str(scene_error(path, problem)))


def read_bare_numbers(data: bytes, path: Path, overrides: Overrides) -> ThermalPhoto:
    """The photo in a ``.raw`` file of ``dji_irp -a measure``: float32 in °C, or int16 in 0.1 °C;
    little-endian, of one of ``SIZES`` by its length. SceneError if no DJI camera gives this length,
    or the numbers are not temperatures."""
    facts = PhotoFacts("output of DJI's Thermal SDK")
    return _bare_numbers(data, path, facts, overrides, f"has {len(data)} bytes")


def _bare_numbers(
    data: bytes, path: Path, facts: PhotoFacts, overrides: Overrides, has: str
) -> ThermalPhoto:
    for form, unit in (("<f4", FLOAT_UNITS), ("<i2", ("celsius*10",))):
        for width, height in SIZES:
            if len(data) == width * height * np.dtype(form).itemsize:
                values = np.frombuffer(data, form).reshape(height, width).astype(np.float32)
                is_guess = overrides.unit is None and form == "<i2"
                if is_guess and typical(values)[0] > 1_500:  # counts
                    why = f"holds no usual 0.1 °C; make it with {TOOL} -a measure, or give the unit"
                    raise scene_error(path, why, options=("unit",))
                return finished(values, unit, path, facts, overrides)
    raise scene_error(
        path, f"{has}, which is not an image of a DJI camera; make it with {TOOL} -a measure"
    )
