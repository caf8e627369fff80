// Vectors, and what cameras see; for the pages and the worker beside them.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const multiply = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const normalized = (a) => multiply(a, 1 / Math.hypot(...a));

// The point of the world that a camera sees at a pixel, at a depth.
function pointAt(camera, [x, y], depth) {
  const inCamera = [((x - camera.cx) / camera.fx) * depth, ((y - camera.cy) / camera.fy) * depth, depth];
  const r = camera.rotation;
  return [0, 1, 2].map((i) => camera.position[i] + r[i] * inCamera[0] + r[3 + i] * inCamera[1] + r[6 + i] * inCamera[2]);
}

// Where a camera sees a point of the world; null behind it.
function project(camera, point) {
  const from = subtract(point, camera.position);
  const [x, y, z] = [0, 3, 6].map((row) => dot(camera.rotation.slice(row, row + 3), from));
  return z > 0.01 ? [(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy] : null;
}
