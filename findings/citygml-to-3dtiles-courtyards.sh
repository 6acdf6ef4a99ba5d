#!/bin/sh
# citygml-to-3dtiles 0.1.6 with cesium 1.43.0: courtyards and holes of windows are covered, and counted as surface.
#
# Every LinearRing of a polygon becomes a face of its own, the interior rings too, instead of being cut out of the exterior.
# Seen: a flat roof of 20 x 20 m has 400 m2 of triangles; with a courtyard of 10 x 10 m in it 500 m2. No warning.
# Expected: 300 m2.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
npm install --prefix . --silent --no-audit --no-fund citygml-to-3dtiles@0.1.6 cesium@1.43.0 >/dev/null
cat >seen.mjs <<'END'
import { writeFileSync } from "fs";
import CityDocument from "citygml-to-3dtiles/src/citygml/Document.mjs";

const ring = (west, east, order) =>
  order.map(([x, y]) => `${390000 + (x ? east : west)} ${5820000 + (y ? east : west)} 40`).join(" ");
const outer = ring(0, 20, [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]);
const inner = ring(5, 15, [[0, 0], [0, 1], [1, 1], [1, 0], [0, 0]]);

function squareMetres(interior) {
  const polygon = `<gml:Polygon gml:id="p"><gml:exterior><gml:LinearRing gml:id="e"><gml:posList srsDimension="3">${outer}</gml:posList>
</gml:LinearRing></gml:exterior>${interior}</gml:Polygon>`;
  writeFileSync("town.gml", `<?xml version="1.0" encoding="UTF-8"?>
<CityModel xmlns="http://www.opengis.net/citygml/2.0" xmlns:gml="http://www.opengis.net/gml"
 xmlns:bldg="http://www.opengis.net/citygml/building/2.0"><gml:boundedBy><gml:Envelope srsName="EPSG:25833" srsDimension="3">
<gml:lowerCorner>390000 5820000 40</gml:lowerCorner><gml:upperCorner>390020 5820020 40</gml:upperCorner></gml:Envelope></gml:boundedBy>
<cityObjectMember><bldg:Building gml:id="b"><bldg:boundedBy><bldg:RoofSurface gml:id="r"><bldg:lod2MultiSurface><gml:MultiSurface>
<gml:surfaceMember>${polygon}</gml:surfaceMember></gml:MultiSurface></bldg:lod2MultiSurface></bldg:RoofSurface></bldg:boundedBy>
</bldg:Building></cityObjectMember></CityModel>`);
  const [building] = CityDocument.fromFile("town.gml").getCityModel().getCityObjects();
  let total = 0;
  for (const triangle of building.getTriangleMesh().getTriangles()) {
    const [a, b, c] = triangle.getVertices();
    const u = [b.x - a.x, b.y - a.y, b.z - a.z];
    const v = [c.x - a.x, c.y - a.y, c.z - a.z];
    total += Math.hypot(u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]) / 2;
  }
  return Math.round(total);
}

const hole = `<gml:interior><gml:LinearRing gml:id="i"><gml:posList srsDimension="3">${inner}</gml:posList></gml:LinearRing></gml:interior>`;
const found = [squareMetres(""), squareMetres(hole)].join(" and ");
if (found !== "400 and 500") {
  console.error(`changed: ${found} m2 without and with the courtyard`);
  process.exitCode = 1;
}
END
node seen.mjs
