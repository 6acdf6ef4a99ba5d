#!/bin/sh
# flatgeobuf 4.5.0 for JavaScript (geojson.serialize): the first feature decides which attributes all others have, and of which type.
#
# In GeoJSON every feature has its own properties.
# Seen, each time without an error while writing: an attribute that the first feature lacks is not in the file. Where the first has 5, a
# later "unknown" is NaN and false is 0; where the first has true, a later 5 is true. Where the first has an object and a later one
# lacks it, the file cannot be read to its end: its own reader stops there with "Unexpected end of JSON input" (null is fine).
# Expected: columns for the attributes of all features, or an error while writing.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
npm install --prefix . --silent --no-audit --no-fund flatgeobuf@4.5.0 >/dev/null
node --input-type=module - <<'END'
import { inspect } from "node:util";
import { geojson } from "flatgeobuf";

async function again(...properties) {
  const features = properties.map((each, i) => ({ type: "Feature", geometry: { type: "Point", coordinates: [i, 0] }, properties: each }));
  const file = geojson.serialize({ type: "FeatureCollection", features });
  const found = [];
  try {
    for await (const feature of geojson.deserialize(file)) found.push(feature.properties);
  } catch (error) {
    found.push(error.message);
  }
  return found;
}

const owner = { name: "a" };
const cases = [
  [[{ storeys: 2 }, { storeys: 3, height: 9.5 }], [{ storeys: 2 }, { storeys: 3 }]],
  [[{ storeys: 5 }, { storeys: "unknown" }, { storeys: false }], [{ storeys: 5 }, { storeys: NaN }, { storeys: 0 }]],
  [[{ flat: true }, { flat: 5 }], [{ flat: true }, { flat: true }]],
  [[{ owner }, {}, { owner }], [{ owner }, "Unexpected end of JSON input"]],
  [[{ owner }, { owner: null }, { owner }], [{ owner }, {}, { owner }]],
];
for (const [properties, seen] of cases) {
  const found = inspect(await again(...properties));
  if (found !== inspect(seen)) {
    console.error(`changed: ${inspect(properties)} is read as ${found}`);
    process.exitCode = 1;
  }
}
END
