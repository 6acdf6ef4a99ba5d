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
