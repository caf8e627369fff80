"""DJI: R-JPEGs are told apart, and read by DJI's tool, or a stand-in with its options."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mrgs.data.radiometric import Overrides, read_thermal_photo
from mrgs.data.radiometric.dji import SIZES, TOOL, run_tool
from mrgs.errors import SceneError, ToolError


def drone_photo(path, signal_bytes: int, make: str = "DJI"):
    exif = Image.Exif()
    exif[0x010F] = make
    Image.new("RGB", (64, 51), (90, 20, 120)).save(path, exif=exif)
    data = path.read_bytes()
    segment = b"\xff\xe3" + (signal_bytes + 2).to_bytes(2, "big") + bytes(signal_bytes)
    path.write_bytes(data[:2] + segment + data[2:])
    return path


STAND_IN = """#!{python}
import sys, time
import numpy as np

arguments = dict(zip(sys.argv[1::2], sys.argv[2::2]))
with open({log!r}, "w") as log:
    log.write(repr(sys.argv[1:]))
celsius = np.full((512, 640), 20.0, "<f4")
celsius[100, 200] = 5 + float(arguments.get("--emissivity", 1.0))
{body}
"""
"""Has the options of DJI's tool."""

WRITES = 'open(arguments["-o"], "wb").write(celsius.tobytes())'


@pytest.fixture
def tool(tmp_path, monkeypatch):
    """Puts a stand-in for DJI's tool on PATH; returns the file with its last arguments."""

    def install(body: str = WRITES) -> Path:
        folder, log = tmp_path / "bin", tmp_path / "arguments"
        folder.mkdir()
        program = folder / TOOL
        program.write_text(STAND_IN.format(python=sys.executable, log=str(log), body=body))
        program.chmod(0o755)
        monkeypatch.setenv("PATH", str(folder))
        return log

    return install


def r_jpeg(folder):
    return drone_photo(folder / "DJI_0001_T.JPG", 60_000)


def test_without_the_tool_an_r_jpeg_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    command = "dji_irp -s DJI_0001_T.JPG -a measure -o DJI_0001_T.raw --measurefmt float32"
    with pytest.raises(ToolError, match=r"Thermal SDK") as caught:
        read_thermal_photo(r_jpeg(tmp_path))
    assert command in str(caught.value)  # to be run elsewhere


def test_with_the_tool_it_is_read(tmp_path, tool):
    log = tool()
    path = r_jpeg(tmp_path)
    photo = read_thermal_photo(path)
    assert photo.temperature_c.shape == (512, 640)
    assert photo.temperature_c[0, 0] == 20
    assert TOOL in photo.facts.source
    arguments = ast.literal_eval(log.read_text())
    assert arguments[:4] == ["-s", str(path), "-a", "measure"]
    assert arguments[-2:] == ["--measurefmt", "float32"]
    assert not Path(arguments[5]).exists()


def test_what_the_user_knows_better_is_handed_on(tmp_path, tool):
    log = tool()
    overrides = Overrides(
        emissivity=0.93, distance_m=12, humidity=0.55, reflected_c=-4.5, window_c=20
    )
    photo = read_thermal_photo(r_jpeg(tmp_path), overrides)
    given = ast.literal_eval(log.read_text())[8:]
    assert dict(zip(given[::2], given[1::2], strict=True)) == {
        "--emissivity": "0.93",
        "--distance": "12",
        "--humidity": "55",
        "--reflection": "-4.5",
    }
    assert photo.temperature_c[100, 200] == pytest.approx(5.93)
    assert dict(photo.facts.record.given) == {
        "emissivity": 0.93, "distance_m": 12, "humidity": 0.55, "reflected_c": -4.5,
    }  # fmt: skip
    (warning,) = photo.facts.warnings
    assert warning.startswith("window_c had no effect")


@pytest.mark.parametrize("name", ["unit", "bounds_c"])
def test_what_is_meant_by_numbers_that_it_does_not_hold_has_no_effect(tmp_path, tool, name):
    tool()
    overrides = Overrides(**{name: {"unit": "kelvin", "bounds_c": (0, 50)}[name]})
    photo = read_thermal_photo(r_jpeg(tmp_path), overrides)
    assert photo.temperature_c[0, 0] == 20
    (warning,) = photo.facts.warnings
    assert warning.startswith(f"{name} had no effect")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            "print('ERROR: not a valid R-JPEG')\nsys.exit(3)",
            r"status 3 \(ERROR: not a valid R-JPEG\)",
        ),
        ("sys.exit(1)", r"status 1 \(no message\)"),
        ("", "wrote 0 bytes"),
        ("open(arguments['-o'], 'wb').write(bytes(1000))", "wrote 1000 bytes"),
        ("open(arguments['-o'], 'wb').truncate(10**9)", "wrote 1000000000 bytes"),
        (
            "open(arguments['-o'], 'wb').write(np.full(640 * 512, 9e9, '<f4').tobytes())",
            "temperature in celsius",
        ),
    ],
    ids=["fails", "fails silently", "nothing", "too little", "too much", "nonsense"],
)
def test_a_tool_that_does_not_work_is_one_line(tmp_path, tool, body, message):
    tool(body)
    with pytest.raises(SceneError, match=message) as caught:
        read_thermal_photo(r_jpeg(tmp_path))
    assert "\n" not in str(caught.value)


def test_a_tool_that_hangs_is_given_up(tmp_path, tool):
    log = tool("time.sleep(60)")
    program = log.parent / "bin" / TOOL
    with pytest.raises(ToolError, match=r"within 0\.5 s"):
        run_tool(str(program), r_jpeg(tmp_path), tmp_path / "out", {}, limit_s=0.5)


def test_a_tool_that_is_no_program_is_one_line(tmp_path, tool):
    tool()
    (tmp_path / "bin" / TOOL).write_bytes(b"\x7fELF nothing")
    with pytest.raises(SceneError, match="cannot be run"):
        read_thermal_photo(r_jpeg(tmp_path))


@pytest.mark.parametrize(("signal_bytes", "make"), [(100, "DJI"), (60_000, "Canon")])
def test_other_photos_are_pictures_without_temperatures(tmp_path, signal_bytes, make):
    photo = read_thermal_photo(drone_photo(tmp_path / "a.jpg", signal_bytes, make))
    assert photo.temperature_c is None
    assert photo.relative.shape == (51, 64)


def test_all_sizes_differ_in_bytes():
    sizes = [width * height * bytes_ for width, height in SIZES for bytes_ in (2, 4)]
    assert len(set(sizes)) == len(sizes)


@pytest.mark.parametrize(("form", "factor"), [("<f4", 1), ("<i2", 10)])
def test_bare_numbers(save, form, factor):
    celsius = np.linspace(-12, 45, 512 * 640).reshape(512, 640)
    photo = read_thermal_photo(
        save("a.raw", np.rint(celsius * 10 / (10 / factor)).astype(form).tobytes())
    )
    np.testing.assert_allclose(photo.temperature_c, celsius, atol=0.51 if factor == 1 else 0.051)
    assert "SDK" in photo.facts.source


@pytest.mark.parametrize("counts", [(2_600, 21_500), (27_315, 31_000)])
def test_counts_are_no_tenths_of_a_degree(save, counts):
    """As of ``dji_irp -a extract``, or a camera's dump in hundredths of a K."""
    numbers = np.linspace(*counts, 512 * 640).astype("<u2")
    with pytest.raises(SceneError, match="-a measure, or give the unit"):
        read_thermal_photo(save("a.raw", numbers.tobytes()))
    hot = read_thermal_photo(save("a.raw", numbers.tobytes()), Overrides(unit="celsius*10"))
    assert hot.temperature_c.flat[0] == pytest.approx(counts[0] / 10)


def test_bare_numbers_of_another_length(save):
    with pytest.raises(SceneError, match="1000 bytes"):
        read_thermal_photo(save("a.raw", bytes(1000)))
