"""Footprints with heights from the formats of GIS, through GDAL; and GDAL itself."""

from lodbench.citymodel.formats import Footprints as Footprints
