#!/bin/sh
# cityjson-threejs-loader 0.4.0 with three 0.150.1 (CityJSONLoader): trees that are turned or scaled stand outside of their city.
#
# A tree of CityJSON is mostly a template, a 4 x 4 matrix and a reference point. The loader moves the city to the origin, and moves
# templates as well: before the matrix, not after it.
# Seen: a city round (566783, 5538509). A house and a tree with the identity are drawn where they belong, beside the origin. With a
# scale of 2 the tree is 5567 km away, at (-566783, -5538509), with half a turn twice as far. And what the matrix itself shifts
# (here by 5 m, and 3 m up) is dropped. No error.
# Expected: the matrix first, then the reference point, then the move to the origin: every tree beside the house.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
npm install --prefix . --silent --no-audit --no-fund cityjson-threejs-loader@0.4.0 three@0.150.1 esbuild@0.28.2 >/dev/null
cat >seen.js <<'END'
import { Vector3 } from "three";
import { CityJSONLoader, CityJSONParser } from "cityjson-threejs-loader";

function corner(matrix) {
  const instance = { type: "GeometryInstance", template: 0, boundaries: [0], transformationMatrix: matrix };
  const loader = new CityJSONLoader(new CityJSONParser());
  loader.load({
    type: "CityJSON",
    version: "2.0",
    transform: { scale: [0.001, 0.001, 0.001], translate: [566783, 5538509, 0] },
    CityObjects: {
      tree: { type: "SolitaryVegetationObject", geometry: [instance] },
      house: { type: "Building", geometry: [{ type: "MultiSurface", lod: "0", boundaries: [[[1, 2, 3]]] }] },
    },
    vertices: [[0, 0, 0], [-10000, -10000, 0], [10000, -10000, 0], [10000, 10000, 0]],
    "geometry-templates": {
      templates: [{ type: "MultiSurface", lod: "1", boundaries: [[[0, 1, 2]]] }],
      "vertices-templates": [[0, 0, 0], [1, 0, 0], [0, 0, 2]],
    },
  });
  const place = new Vector3();
  const [house, tree] = loader.scene.children;
  place.fromBufferAttribute(house.geometry.getAttribute("position"), 0);
  if (place.length() > 20) throw Error(`house at ${place.toArray()}`);
  tree.getMatrixAt(0, house.matrix);
  place.fromBufferAttribute(tree.geometry.getAttribute("position"), 0).applyMatrix4(house.matrix);
  return place.toArray().map(Math.round).join(" ");
}

const cases = [
  ["the identity", [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "0 0 0"],
  ["a scale of 2", [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1], "-566783 -5538509 0"],
  ["half a turn", [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "1133566 11077018 0"],
  ["a shift", [1, 0, 0, 5, 0, 1, 0, 0, 0, 0, 1, 3, 0, 0, 0, 1], "0 0 0"],
];
for (const [name, matrix, seen] of cases) {
  const found = corner(matrix);
  if (found !== seen) {
    console.error(`changed: with ${name} the tree is at ${found}`);
    process.exitCode = 1;
  }
}
END
node_modules/.bin/esbuild seen.js --bundle --platform=node --outfile=bundle.cjs --log-level=error \
  --alias:three/examples/jsm=./node_modules/three/examples/jsm
node bundle.cjs
