"use strict";
const one = (selector) => document.querySelector(selector);
const all = (selector) => [...document.querySelectorAll(selector)];
const KINDS = ["prior", "estimate", "truth"];
const bytesOf = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
const unpacked = (id) => {
  const stream = new Blob([bytesOf(one(`#${id}`).textContent)]).stream();
  return new Response(stream.pipeThrough(new DecompressionStream("gzip"))).text();
};
const whole = (base64) => new Int32Array(bytesOf(base64).buffer);
const summed = (steps) => {
  for (let i = 1; i < steps.length; i++) steps[i] += steps[i - 1];
  return steps;
};

// The city's geometry: corners are stored x, then y, then z, each as differences.
function cityGeometry(city) {
  const steps = whole(city.corners);
  const count = steps.length / 3;
  const places = new Float32Array(3 * count);
  for (let axis = 0; axis < 3; axis++) {
    const values = summed(steps.subarray(axis * count, (axis + 1) * count));
    for (let i = 0; i < count; i++) places[3 * i + axis] = values[i] * city.step_m;
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(places, 3));
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(summed(whole(city.triangles))), 1));
  geometry.computeBoundingBox();
  return geometry;
}

// The lowest corners around the cameras; a few may be cellars.
function groundBelow(geometry, low, high) {
  const places = geometry.getAttribute("position").array;
  const heights = [];
  for (let i = 0; i < places.length; i += 3) {
    const isNear = places[i] > low.x - 400 && places[i] < high.x + 400 && places[i + 1] > low.y - 400 && places[i + 1] < high.y + 400;
    if (isNear) heights.push(places[i + 2]);
  }
  if (!heights.length) return Math.min(geometry.boundingBox.min.z, low.z);
  return heights.sort((a, b) => a - b)[Math.floor(0.05 * heights.length)];
}

// Where a camera's middle ray meets the ground; no further than three times its height away.
function seenFrom(pose, ground) {
  const ray = [0, 1, 2].map((axis) => [0, 3, 6, 9].reduce((sum, at) => sum + pose.rays[at + axis], 0) / 4);
  const height = Math.max(pose.center[2] - ground, 1);
  const aside = Math.hypot(ray[0], ray[1]);
  const steps = ray[2] < 0 ? Math.min(-height / ray[2], (3 * height) / Math.max(aside, 1e-9)) : 0;
  return pose.center.map((value, axis) => value + steps * ray[axis]);
}

// The corners of the box that holds all faces of the city with a corner near the places, or null for none.
function boxNear(geometry, spots, reach) {
  const [least, most] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  const places = geometry.getAttribute("position").array;
  const faces = geometry.getIndex().array;
  const [west, east] = [Math.min(...spots.map((s) => s[0])) - reach, Math.max(...spots.map((s) => s[0])) + reach];
  const [south, north] = [Math.min(...spots.map((s) => s[1])) - reach, Math.max(...spots.map((s) => s[1])) + reach];
  const isNear = (corner) => {
    const [x, y] = [places[3 * corner], places[3 * corner + 1]];
    return x > west && x < east && y > south && y < north && spots.some((s) => Math.hypot(x - s[0], y - s[1]) < reach);
  };
  for (let i = 0; i < faces.length; i += 3) {
    const corners = [faces[i], faces[i + 1], faces[i + 2]];
    if (!corners.some(isNear)) continue;
    for (const corner of corners) {
      for (let axis = 0; axis < 3; axis++) {
        least[axis] = Math.min(least[axis], places[3 * corner + axis]);
        most[axis] = Math.max(most[axis], places[3 * corner + axis]);
      }
    }
  }
  if (least[0] > most[0]) return null;
  return [0, 1, 2, 3, 4, 5, 6, 7].map((k) => new THREE.Vector3(
    ...[0, 1, 2].map((axis) => (k & (1 << axis) ? most : least)[axis])));
}

// The place nearest to the points from which an eye turned so sees all of them, with a margin and below a bar that
// takes a share of the height; and the point in their middle that it turns about.
function fittingEye(points, turn, aspect, fov, bar) {
  const back = turn.clone().invert();
  const seen = points.map((p) => p.clone().applyQuaternion(back));
  const margin = 0.92;
  const tall = Math.tan((fov * Math.PI) / 360);
  const [across, down, up] = [margin * tall * aspect, margin * tall, tall * (margin - 2 * bar)];
  const most = (of) => Math.max(...seen.map(of));
  // How far out each edge of the view must reach for an eye at height 0 of the axis that it looks along.
  const [right, left] = [most((p) => p.x + across * p.z), most((p) => -p.x + across * p.z)];
  const [top, bottom] = [most((p) => p.y + up * p.z), most((p) => -p.y + down * p.z)];
  const z = Math.max((right + left) / (2 * across), (top + bottom) / (up + down), most((p) => p.z) + 1);
  const y = (top - up * z + down * z - bottom) / 2;
  const middle = seen.reduce((sum, p) => sum + p.z, 0) / seen.length;
  const place = new THREE.Vector3((right - left) / 2, y, z);
  return { position: place.clone().applyQuaternion(turn), target: place.setZ(middle).applyQuaternion(turn) };
}
