// Beside the page's thread: decoding, the order of the splats, and what is under the cursor.

const NEAR_PLANE = 0.01;
const ALPHA_MAX = 0.999;
const ALPHA_MIN = 1 / 255;
const TRANSMITTANCE_MIN = 1e-4;
const FRUSTUM_MARGIN = 0.3;
const LARGEST_TAU2 = 2 * Math.log(255);

let model;
let modalities;
let decoding = Promise.resolve();

onmessage = ({ data }) => {
  if (data.open) open(data.open);
  if (data.part) decoding = decoding.then(() => take(data.part)).catch(({ message }) => postMessage({ failure: message }));
  if (data.sort) {
    const order = farToNear(data.sort.rotation, data.sort.translation);
    postMessage({ order, version: data.sort.version }, [order.buffer]);
  }
  if (data.read) postMessage({ reading: readPixel(data.read), id: data.read.id });
};

// Room for all splats, of which none is there yet.
function open({ slots, dilation, readable, ...rest }) {
  modalities = rest.modalities;
  model = {
    slots,
    dilation,
    active: [], // first and behind the last of the splats that are shown
    means: new Float32Array(3 * slots),
    covariances: new Float32Array(6 * slots),
    largestScale: new Float32Array(slots),
    appearances: Object.fromEntries(readable.map((name) => [name, { opacity: new Float32Array(slots) }])),
  };
}

// Add a part to what is shown, in the place of the coarse splats that stood for it, and give it to the page to draw.
async function take(text) {
  const part = await decodePart(text, modalities);
  const { first, count, replaces, appearances } = part;
  model.means.set(part.means, 3 * first);
  model.covariances.set(part.covariances, 6 * first);
  model.largestScale.set(part.largestScale, first);
  for (const [name, own] of Object.entries(model.appearances)) keepAppearance(own, appearances[name], first, count);
  model.active = model.active.flatMap((range) => without(range, replaces));
  model.active.push([first, first + count]);
  const drawn = { first, count, geometry: geometryTexels(part), appearances: drawnAppearances(appearances, count) };
  const buffers = Object.values(drawn.appearances).flatMap(({ texels, sh }) => (sh ? [texels.buffer, sh.buffer] : [texels.buffer]));
  postMessage({ part: drawn }, [drawn.geometry.buffer, ...buffers]);
}

function keepAppearance(own, { opacity, values, sh, bands }, first, count) {
  own.opacity.set(opacity, first);
  const name = values ? "values" : "sh";
  const stride = (values ?? sh).length / count;
  own[name] ??= new (values ?? sh).constructor(stride * model.slots);
  own[name].set(values ?? sh, stride * first);
  own.bands = bands;
}

function without([start, end], [from, to]) {
  return [[start, Math.min(end, from)], [Math.max(start, to), end]].filter(([low, high]) => low < high);
}

// As the page's textures hold them: mean | covariance | its end; opacity, value without view dependence.
function geometryTexels({ count, means, covariances }) {
  const texels = new Float32Array(12 * count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) texels[12 * i + k] = means[3 * i + k];
    for (let k = 0; k < 6; k++) texels[12 * i + 4 + k] = covariances[6 * i + k];
  }
  return texels;
}

function drawnAppearances(appearances, count) {
  const drawn = {};
  for (const [name, { opacity, values, sh, bands }] of Object.entries(appearances)) {
    const texels = new Float32Array(2 * count);
    for (let i = 0; i < count; i++) {
      texels[2 * i] = opacity[i];
      if (values) texels[2 * i + 1] = values[i];
    }
    drawn[name] = { texels, sh, bands };
  }
  return drawn;
}

// Indices of the splats in front of the camera, farthest first: two counting sorts by 16 bits of the depth. The bits of
// a positive float rise with its value, so that both together sort exactly.
function farToNear(rotation, translation) {
  const { means, slots, active } = model;
  const depths = new Float32Array(slots);
  const [x, y, z, offset] = [rotation[6], rotation[7], rotation[8], translation[2]];
  let visible = new Uint32Array(slots);
  let inFront = 0;
  for (const [start, end] of active) {
    for (let i = start; i < end; i++) {
      const depth = x * means[3 * i] + y * means[3 * i + 1] + z * means[3 * i + 2] + offset;
      depths[i] = depth;
      if (depth >= NEAR_PLANE) visible[inFront++] = i;
    }
  }
  const keys = new Uint32Array(depths.buffer);
  visible = visible.subarray(0, inFront);
  const byLowBits = countingSort(visible, (i) => ~keys[i] & 0xffff);
  return countingSort(byLowBits, (i) => (~keys[i] >>> 16) & 0xffff);
}

function countingSort(indices, key) {
  const starts = new Uint32Array(65537);
  for (const i of indices) starts[key(i) + 1]++;
  for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
  const sorted = new Uint32Array(indices.length);
  for (const i of indices) sorted[starts[key(i)]++] = i;
  return sorted;
}

// What a one-channel image and its depth show at the pixel with the centre (x, y): blended here in full precision,
// because what the screen holds is rounded.
function readPixel({ camera, x, y, modality }) {
  const appearance = model.appearances[modality];
  const dilation = dilationOf(model.dilation, camera);
  const hits = [];
  for (const [start, end] of model.active) {
    for (let i = start; i < end; i++) {
      const hit = splatAt(camera, dilation, x, y, i, appearance.opacity[i]);
      if (hit) hits.push(hit);
    }
  }
  hits.sort((a, b) => a.depth - b.depth || a.index - b.index);
  let transmittance = 1;
  let value = 0;
  let depth = 0;
  for (const hit of hits) {
    if (transmittance < TRANSMITTANCE_MIN) break;
    const weight = hit.alpha * transmittance;
    value += weight * valueOf(appearance, hit.index, camera.position);
    depth += weight * hit.depth;
    transmittance *= 1 - hit.alpha;
  }
  const alpha = 1 - transmittance;
  return { modality, value, depth: depth / Math.max(alpha, 1e-9), alpha };
}

// A splat's value as seen from a point.
function valueOf({ values, sh, bands }, i, eye) {
  if (values) return values[i];
  const direction = [0, 1, 2].map((axis) => model.means[3 * i + axis] - eye[axis]);
  const length = Math.hypot(...direction);
  const functions = harmonics(direction.map((part) => part / length));
  const stride = sh.length / model.slots;
  let sum = 0.5;
  for (let degree = 0; degree < bands.length; degree++) {
    const [low, step] = bands[degree];
    for (let k = degree ** 2; k < (degree + 1) ** 2; k++) sum += functions[k] * (low + step * sh[i * stride + k]);
  }
  return Math.max(sum, 0);
}

// The real spherical harmonics up to degree 3 of a unit vector, in the order and with the signs of 3DGS.
function harmonics([x, y, z]) {
  const [xx, yy, zz] = [x * x, y * y, z * z];
  return [
    0.28209479,
    -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
    1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2 * zz - xx - yy), -1.09254843 * x * z, 0.54627422 * (xx - yy),
    -0.59004359 * y * (3 * xx - yy), 2.89061144 * x * y * z, -0.4570458 * y * (4 * zz - xx - yy),
    0.37317633 * z * (2 * zz - 3 * xx - 3 * yy), -0.4570458 * x * (4 * zz - xx - yy), 1.44530572 * z * (xx - yy),
    -0.59004359 * x * (xx - 3 * yy),
  ];
}

// The splat's alpha in an image at a pixel, or nothing below 1/255.
function splatAt(camera, dilation, px, py, i, opacity) {
  const { rotation: r, translation: t, fx, fy, cx, cy } = camera;
  const m = model.means;
  const [mx, my, mz] = [m[3 * i], m[3 * i + 1], m[3 * i + 2]];
  const z = r[6] * mx + r[7] * my + r[8] * mz + t[2];
  if (z < NEAR_PLANE) return null;
  const slopeX = (r[0] * mx + r[1] * my + r[2] * mz + t[0]) / z;
  const slopeY = (r[3] * mx + r[4] * my + r[5] * mz + t[1]) / z;
  const u = clampSlope(slopeX, cx, fx, camera.width);
  const v = clampSlope(slopeY, cy, fy, camera.height);
  const dx = px - (fx * slopeX + cx);
  const dy = py - (fy * slopeY + cy);
  const focal = (model.largestScale[i] * Math.max(fx, fy)) / z;
  if (dx * dx + dy * dy > LARGEST_TAU2 * (focal * focal * (1 + u * u + v * v) + dilation)) return null;
  if (varianceAlong(r[6], r[7], r[8], 6 * i) > z * z) return null;
  const [xx, xy, yy] = projectedCovariance(r, fx / z, fy / z, u, v, 6 * i);
  // Not (xx + d)(yy + d) - xy²: where the covariance was rounded, a needle's may be below 0.
  const determinant = Math.max(xx * yy - xy * xy, 0) + dilation * (xx + yy + dilation);
  const squared = (yy + dilation) * dx * dx - 2 * xy * dx * dy + (xx + dilation) * dy * dy;
  const falloff = Math.exp((-0.5 * Math.max(squared, 0)) / determinant);
  const alpha = Math.min(ALPHA_MAX, opacity * falloff);
  return alpha < ALPHA_MIN ? null : { index: i, depth: z, alpha };
}

function clampSlope(slope, centre, focal, size) {
  const margin = (FRUSTUM_MARGIN * size) / (2 * focal);
  return Math.min(Math.max(slope, -centre / focal - margin), (size - centre) / focal + margin);
}

// Along a unit vector.
function varianceAlong(x, y, z, at) {
  const s = model.covariances;
  return s[at] * x * x + s[at + 3] * y * y + s[at + 5] * z * z
    + 2 * (s[at + 1] * x * y + s[at + 2] * x * z + s[at + 4] * y * z);
}

function projectedCovariance(r, kx, ky, u, v, at) {
  const s = model.covariances;
  const [ax, ay, az] = [kx * (r[0] - u * r[6]), kx * (r[1] - u * r[7]), kx * (r[2] - u * r[8])];
  const [bx, by, bz] = [ky * (r[3] - v * r[6]), ky * (r[4] - v * r[7]), ky * (r[5] - v * r[8])];
  const [xx, xy, xz, yy, yz, zz] = [s[at], s[at + 1], s[at + 2], s[at + 3], s[at + 4], s[at + 5]];
  const [px, py, pz] = [xx * ax + xy * ay + xz * az, xy * ax + yy * ay + yz * az, xz * ax + yz * ay + zz * az];
  const [qx, qy, qz] = [xx * bx + xy * by + xz * bz, xy * bx + yy * by + yz * bz, xz * bx + yz * by + zz * bz];
  return [ax * px + ay * py + az * pz, ax * qx + ay * qy + az * qz, bx * qx + by * qy + bz * qz];
}
