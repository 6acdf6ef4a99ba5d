#!/bin/sh
# laspy 2.7.0 (header.parse_crs): metres are said to be degrees, and heights lose their system.
#
# LAS files up to 1.3 give their system as GeoTIFF keys. A projection without a code has ProjectedCSTypeGeoKey 32767 ("user
# defined") and the datum's code beside it.
# Seen: with 32767, its definition and GeographicTypeGeoKey 4258, parse_crs returns the geographic system ETRS89 for points at
# (500000, 5500000). With ProjectedCSTypeGeoKey 25832 and VerticalCSTypeGeoKey 7837 it returns EPSG:25832 alone. No warning.
# Expected: None for what is not understood, as its documentation says, and a compound system.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
python3 -m venv venv
venv/bin/python -m pip install --quiet --disable-pip-version-check laspy==2.7.0 pyproj==3.7.2
venv/bin/python -W ignore - <<'END'
import io, struct

import laspy
from laspy.vlrs.known import GeoKeyDirectoryVlr


def system(keys):
    vlr = GeoKeyDirectoryVlr()
    vlr.parse_record_data(struct.pack("<4H", 1, 1, 0, len(keys)) + b"".join(struct.pack("<4H", k, 0, 1, v) for k, v in keys))
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.scales = [0.01] * 3
    header.vlrs.append(vlr)
    cloud, file = laspy.LasData(header), io.BytesIO()
    cloud.x, cloud.y, cloud.z = [500000.0], [5500000.0], [100.0]
    cloud.write(file)
    return laspy.read(io.BytesIO(file.getvalue())).header.parse_crs()


# Transverse Mercator (3075: 1) in metres (3076: 9001), on ETRS89 (2048: 4258).
own = system([(1024, 1), (2048, 4258), (3072, 32767), (3074, 32767), (3075, 1), (3076, 9001)])
compound = system([(1024, 1), (3072, 25832), (4096, 7837)])
if (own and own.to_epsg(), own and own.is_geographic, compound.is_compound, compound.to_epsg()) != (4258, True, False, 25832):
    raise SystemExit(f"changed: {own and own.name}, {compound.name}")
END
