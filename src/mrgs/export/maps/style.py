"""How QGIS shows a map when it is opened: in °C, in the colours of the picture.

Without a style it takes the first three bands for red, green and blue.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from mrgs.pictures.drawing import Scale
from mrgs.pictures.numbers import number_text
from mrgs.pictures.palette import palette_table
from mrgs.system.atomic import write_text

STOPS = 16
"""Colours between which QGIS interpolates."""


def write_style(path: Path, scale: Scale) -> Path:
    """Write the style of a map, which QGIS applies by its name: ``NAME.qml`` beside ``NAME.tif``;
    returns the path.

    Args:
        path: of the style.
        scale: colours of the first band.

    Raises:
        RunError: the file cannot be written.
    """
    low, high = min(scale.low, scale.high), max(scale.low, scale.high)
    document = ElementTree.Element("qgis", styleCategories="Symbology")
    renderer = ElementTree.SubElement(
        ElementTree.SubElement(document, "pipe"),
        "rasterrenderer",
        type="singlebandpseudocolor", band="1", opacity="1", alphaBand="-1",
        classificationMin=f"{low:.4f}", classificationMax=f"{high:.4f}",
    )  # fmt: skip
    ramp = ElementTree.SubElement(
        ElementTree.SubElement(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED", classificationMode="1", clip="0",
        minimumValue=f"{low:.4f}", maximumValue=f"{high:.4f}",
    )  # fmt: skip
    shares = np.linspace(0, 1, STOPS)
    values = scale.low + shares * (scale.high - scale.low)
    colors = palette_table(scale.palette)[np.rint(255 * shares).astype(int)]
    for value, color in sorted(zip(values.tolist(), colors.tolist(), strict=True)):
        ElementTree.SubElement(
            ramp,
            "item",
            value=f"{value:.4f}", label=f"{number_text(value, 1)} {scale.unit}", alpha="255",
            color="#" + bytes(color).hex(),
        )  # fmt: skip
    ElementTree.indent(document)
    return write_text(path, ElementTree.tostring(document, encoding="unicode") + "\n")
