#!/bin/sh
# citygml-to-3dtiles 0.1.6 with cesium 1.43.0: triangles whose coordinates stand on lines of their own are left out.
#
# gml:posList is a list of XML Schema: any white space parts its numbers. Here only a space does, so that what a line break joins is
# read as one number. Four points of a closed triangle, one a line, are nine words, which pass for three points.
# Seen: a roof of one triangle has 1 triangle where the coordinates stand on one line, none where each point has its own; the file is
# converted without an error, with a warning of rings with less than 4 points. (Rings of other lengths mostly end in an error.)
# Expected: 1 triangle either way.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
npm install --prefix . --silent --no-audit --no-fund citygml-to-3dtiles@0.1.6 cesium@1.43.0 >/dev/null
cat >seen.mjs <<'END'
import { writeFileSync } from "fs";
import CityDocument from "citygml-to-3dtiles/src/citygml/Document.mjs";

const points = ["390000 5820000 40", "390020 5820000 40", "390020 5820020 40", "390000 5820000 40"];

function triangles(separator) {
  writeFileSync("town.gml", `<?xml version="1.0" encoding="UTF-8"?>
<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:gml="http://www.opengis.net/gml"
 xmlns:bldg="http://www.opengis.net/citygml/building/2.0"><gml:boundedBy><gml:Envelope srsName="EPSG:25833" srsDimension="3">
<gml:lowerCorner>390000 5820000 40</gml:lowerCorner><gml:upperCorner>390020 5820020 40</gml:upperCorner></gml:Envelope></gml:boundedBy>
<cityObjectMember><bldg:Building gml:id="b"><bldg:boundedBy><bldg:RoofSurface gml:id="r"><bldg:lod2MultiSurface><gml:MultiSurface>
<gml:surfaceMember><gml:Polygon gml:id="p"><gml:exterior><gml:LinearRing gml:id="e">
<gml:posList srsDimension="3">${points.join(separator)}</gml:posList></gml:LinearRing></gml:exterior></gml:Polygon></gml:surfaceMember>
</gml:MultiSurface></bldg:lod2MultiSurface></bldg:RoofSurface></bldg:boundedBy></bldg:Building></cityObjectMember></CityModel>`);
  const [building] = CityDocument.fromFile("town.gml").getCityModel().getCityObjects();
  return building.getTriangleMesh().getTriangles().length;
}

console.error = () => {}; // the warning
const found = [triangles(" "), triangles("\n")].join(" and ");
if (found !== "1 and 0") {
  console.log(`changed: ${found} triangles on one line and on four`);
  process.exitCode = 1;
}
END
node seen.mjs
