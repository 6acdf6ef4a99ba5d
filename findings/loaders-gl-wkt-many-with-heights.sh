#!/bin/sh
# @loaders.gl/wkt 4.5.2 (WKTLoader): "MULTIPOLYGON Z" and "MULTILINESTRING Z" are read as empty.
#
# This is how PostGIS and Shapely write such geometry with heights.
# Seen: "POLYGON Z (...)" and "MULTIPOINT Z (...)" have their coordinates; of "MULTIPOLYGON Z (...)" and "MULTILINESTRING Z (...)" the
# type is read and the coordinates are [], without an error. Without the Z, as EWKT has it, the same numbers are read with heights.
# Expected: two polygons and two lines, or null, as for other text that it does not understand.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
npm install --prefix . --silent --no-audit --no-fund @loaders.gl/core@4.5.4 @loaders.gl/wkt@4.5.2 >/dev/null
node --input-type=module - <<'END'
import { parseSync } from "@loaders.gl/core";
import { WKTLoader } from "@loaders.gl/wkt";

const rings = [
  [[0, 0, 5], [10, 0, 5], [10, 10, 9], [0, 0, 5]],
  [[20, 0, 5], [30, 0, 5], [30, 10, 9], [20, 0, 5]],
];
const text = (ring) => `(${ring.map((point) => point.join(" ")).join(", ")})`;
const polygons = `(${rings.map((ring) => `(${text(ring)})`).join(", ")})`;
const lines = `(${rings.map(text).join(", ")})`;
const cases = [
  [`POLYGON Z (${text(rings[0])})`, [rings[0]]],
  [`MULTIPOINT Z ${text(rings[0])}`, rings[0]],
  [`MULTIPOLYGON Z ${polygons}`, []],
  [`MULTIPOLYGON ${polygons}`, rings.map((ring) => [ring])],
  [`MULTILINESTRING Z ${lines}`, []],
  [`MULTILINESTRING ${lines}`, rings],
];
for (const [wkt, seen] of cases) {
  const found = JSON.stringify(parseSync(wkt, WKTLoader)?.coordinates);
  if (found !== JSON.stringify(seen)) {
    console.error(`changed: ${wkt} is read as ${found}`);
    process.exitCode = 1;
  }
}
END
