#!/bin/sh
# wkx 0.5.0 (toTwkb, parseTwkb): projected coordinates come back as other places.
#
# TWKB writes whole numbers of any size as bytes of seven bits each. wkx always writes five decimals, and counts in 32 bits, one of them
# for the sign: beyond 10737.41 a coordinate no longer fits, which every easting of UTM is. Degrees are right.
# Seen: POINT(566783.25 5538509.5) comes back as (8437.50152, -1998.31184), and 15000 as -6474.83648. The bytes for the first point at five
# decimals as the format has them are read as (8437.50164, -1998.31056), and at two decimals, which fits, as they should be. No error.
# Expected: the coordinate that was written, or an error where it does not fit.
set -eu
place=$(mktemp -d)
trap 'rm -rf "$place"' EXIT
cd "$place"
npm install --prefix . --silent --no-audit --no-fund wkx@0.5.0 >/dev/null
node --no-deprecation - <<'END'
const { Geometry } = require("wkx");

function bytes(whole) {
  let value = BigInt(whole) << 1n; // positive numbers only
  const out = [];
  for (; value > 127n; value >>= 7n) out.push(Number(value & 127n) | 128);
  return [...out, Number(value)];
}

const point = (decimals) => {
  const [x, y] = [566783.25, 5538509.5].map((v) => bytes(Math.round(v * 10 ** decimals)));
  return Buffer.from([(decimals * 2 << 4) | 1, 0, ...x, ...y]);
};
const again = (text) => Geometry.parseTwkb(Geometry.parse(text).toTwkb()).toWkt();
const found = [
  again("POINT(9.93176 49.99516)"),
  again("POINT(566783.25 5538509.5)"),
  again("POINT(10737.41 15000)"),
  Geometry.parseTwkb(point(2)).toWkt(),
  Geometry.parseTwkb(point(5)).toWkt(),
].join("; ");
const seen = [
  "POINT(9.93176 49.99516)",
  "POINT(8437.50152 -1998.31184)",
  "POINT(10737.41 -6474.83648)",
  "POINT(566783.25 5538509.5)",
  "POINT(8437.50164 -1998.31056)",
].join("; ");
if (found !== seen) {
  console.error(`changed: ${found}`);
  process.exitCode = 1;
}
END
