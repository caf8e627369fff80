"""Reads maps with QGIS's library, which belongs to the system's Python: read_qgis.py REQUEST.json

The request holds ``rasters``, each with its ``path`` and ``points`` (map coordinates), and ``crs``,
definitions as text. The answer on standard output describes each of them.
"""

import json
import sys
from pathlib import Path

from qgis.core import (
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsPointXY,
    QgsRasterLayer,
    QgsUnitTypes,
)


def described_crs(crs):
    return {
        "valid": crs.isValid(),
        "code": crs.authid(),
        "geographic": crs.isGeographic(),
        "unit": QgsUnitTypes.toString(crs.mapUnits()),
        "wkt": crs.toWkt(),
    }


def described_renderer(renderer):
    """How the layer is shown when it is opened."""
    if renderer.type() != "singlebandpseudocolor":
        return {"type": renderer.type(), "bands": renderer.usesBands()}
    items = renderer.shader().rasterShaderFunction().colorRampItemList()
    return {
        "type": renderer.type(),
        "bands": renderer.usesBands(),
        "colors": [[item.value, item.color.name(), item.label] for item in items],
    }


def described_raster(path, points):
    layer = QgsRasterLayer(path, "map")
    data, extent = layer.dataProvider(), layer.extent()
    bands = range(1, layer.bandCount() + 1)
    return {
        "valid": layer.isValid(),
        "bands": [layer.bandName(band) for band in bands],
        "nodata": [data.sourceNoDataValue(band) for band in bands],
        "renderer": described_renderer(layer.renderer()),
        "extent": [extent.xMinimum(), extent.yMinimum(), extent.xMaximum(), extent.yMaximum()],
        "size": [layer.width(), layer.height()],
        "crs": described_crs(layer.crs()),
        "values": [[data.sample(QgsPointXY(x, y), band)[0] for band in bands] for x, y in points],
    }


def main(request):
    application = QgsApplication([], False)
    application.initQgis()
    answer = {
        "rasters": [described_raster(each["path"], each["points"]) for each in request["rasters"]],
        "crs": [described_crs(QgsCoordinateReferenceSystem(text)) for text in request["crs"]],
    }
    application.exitQgis()
    return answer


print(json.dumps(main(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))))
