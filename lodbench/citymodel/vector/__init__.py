"""Footprints with heights from the formats of GIS, through GDAL; and GDAL itself."""
