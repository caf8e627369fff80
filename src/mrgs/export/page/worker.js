// Beside the page's thread: decoding, the order of the splats, and what is under the cursor.

const NEAR_PLANE = 0.01;
const ALPHA_MAX = 0.999;
const ALPHA_MIN = 1 / 255;
const TRANSMITTANCE_MIN = 1e-4;
const FRUSTUM_MARGIN = 0.3;
const SURFACE_TRANSMITTANCES = [0.6, 0.4];
const STEEPEST = 4;
const ALPHA_OF_SURFACE = 0.5;
const SAME_SURFACE = 0.03;
const SPOT_PX = 3;
// A pixel of each eighth of a disc, on the circle that halves its area.
const SPOT_PATTERN = [0, 1, 2, 3, 4, 5, 6, 7].map((k) => [Math.cos, Math.sin].map((part) => Math.SQRT1_2 * part((k * Math.PI) / 4)));
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

// Room for all splats, of which none is there yet. The depths of areas come before the first part.
function open({ slots, dilation, radiance, readable, areas, photos, ...rest }) {
  modalities = rest.modalities;
  if (areas) decoding = Promise.all(areas.map(decodeDepths)).then((depths) => postMessage({ depths }));
  model = {
    slots,
    dilation,
    radiance,
    photos,
    active: [], // first and behind the last of the splats that are shown
    means: new Float32Array(3 * slots),
    axes: new Float32Array(9 * slots),
    largestScale: new Float32Array(slots),
    appearances: Object.fromEntries(readable.map((name) => [name, { opacity: new Float32Array(slots) }])),
  };
}

// Add a part to what is shown, in the place of the coarse splats that stood for it, and give it to the page to draw.
async function take(text) {
  const part = await decodePart(text, modalities);
  const { first, count, replaces, appearances } = part;
  const { thermal } = appearances;
  if (model.radiance && thermal) thermal.values = toRadiance(model.radiance, thermal.values);
  model.means.set(part.means, 3 * first);
  model.axes.set(part.axes, 9 * first);
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

// As the page's texture holds them: a coordinate of the mean and an axis, three times.
function geometryTexels({ count, means, axes }) {
  const texels = new Float32Array(12 * count);
  for (let i = 0; i < 3 * count; i++) {
    texels[4 * i] = means[i];
    for (let k = 0; k < 3; k++) texels[4 * i + 1 + k] = axes[3 * i + k];
  }
  return texels;
}

// As the page's textures hold them: opacity, value without view dependence.
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

// Indices of the splats in front of the camera, farthest first: two counting sorts by 16 bits of the distance. The bits of
// a positive float rise with its value, so that both together sort exactly.
function farToNear(rotation, translation) {
  const { means, slots, active } = model;
  const distances = new Float32Array(slots);
  const [r, t] = [rotation, translation];
  let visible = new Uint32Array(slots);
  let inFront = 0;
  for (const [start, end] of active) {
    for (let i = start; i < end; i++) {
      const [mx, my, mz] = [means[3 * i], means[3 * i + 1], means[3 * i + 2]];
      const z = r[6] * mx + r[7] * my + r[8] * mz + t[2];
      if (z < NEAR_PLANE) continue;
      const x = r[0] * mx + r[1] * my + r[2] * mz + t[0];
      const y = r[3] * mx + r[4] * my + r[5] * mz + t[1];
      distances[i] = Math.sqrt(x * x + y * y + z * z);
      visible[inFront++] = i;
    }
  }
  const keys = new Uint32Array(distances.buffer);
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

// What a one-channel image shows at the pixel with the centre (x, y), and the depth of the surface, where half of the
// light is blocked: blended here in full precision, because what the screen holds is rounded. Where a spot of three pixels
// of the nearest photo is wider than a pixel, the mean over it, as the program's own spots have it; not for a question
// with an id, which asks only whether a place is seen.
function readPixel({ camera, x, y, modality, id }) {
  const appearance = model.appearances[modality];
  const [middle] = readPixels(camera, [x, y], 0, [[x, y]], appearance);
  const reach = id === undefined ? spotReach(camera, x, y, middle.depth) : 0;
  const about = SPOT_PATTERN.map(([dx, dy]) => [Math.floor(x + reach * dx) + 0.5, Math.floor(y + reach * dy) + 0.5]);
  const same = (reach > 1 ? readPixels(camera, [x, y], reach, about, appearance) : []).filter(
    ({ alpha, depth }) => alpha >= ALPHA_OF_SURFACE && Math.abs(depth - middle.depth) < SAME_SURFACE * middle.depth,
  );
  const value = [middle, ...same].reduce((sum, each) => sum + valueOfBlend(model.radiance, modality, each.value), 0);
  return { modality, value: value / (1 + same.length), depth: middle.depth, alpha: middle.alpha };
}

// Half the width, in pixels, of a spot of three pixels of the nearest photo that shows the place; 0 if none does.
function spotReach(camera, x, y, depth) {
  const place = pointAt(camera, [x, y], depth);
  let smallest = Infinity;
  for (const photo of model.photos) {
    const pixel = project(photo, place);
    if (!pixel || !pixel.every((each, axis) => each >= 0 && each < [photo.width, photo.height][axis])) continue;
    const z = dot(photo.rotation.slice(6), subtract(place, photo.position));
    smallest = Math.min(smallest, z / photo.fx);
  }
  return smallest < Infinity ? (0.5 * SPOT_PX * smallest * camera.fx) / depth : 0;
}

// Blends pixels that are no farther from the middle than the reach.
function readPixels(camera, middle, reach, pixels, appearance) {
  const dilation = dilationOf(model.dilation, camera);
  const hits = pixels.map(() => []);
  for (const [start, end] of model.active) {
    for (let i = start; i < end; i++) {
      const splat = splatNear(camera, dilation, middle, reach, i);
      if (!splat) continue;
      for (let k = 0; k < pixels.length; k++) {
        const hit = hitAt(splat, dilation, pixels[k][0], pixels[k][1], appearance.opacity[i]);
        if (hit) hits[k].push(hit);
      }
    }
  }
  return hits.map((each) => blended(each, appearance, camera));
}

function blended(hits, appearance, camera) {
  hits.sort((a, b) => a.distance - b.distance || a.index - b.index);
  let transmittance = 1;
  let value = 0;
  let depth = 0;
  let shares = 0;
  for (const hit of hits) {
    if (transmittance < TRANSMITTANCE_MIN) break;
    value += hit.alpha * transmittance * valueOf(appearance, hit.index, camera.position);
    const before = ofSurface(transmittance);
    transmittance *= 1 - hit.alpha;
    const share = before - ofSurface(transmittance);
    depth += share * hit.depth;
    shares += share;
  }
  return { value, depth: depth / Math.max(shares, 1e-9), alpha: 1 - transmittance };
}

function ofSurface(transmittance) {
  const [begins, ends] = SURFACE_TRANSMITTANCES;
  return Math.min(Math.max(transmittance, ends), begins);
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

// A splat as an image shows it, unless it is farther than the reach from a place of the image, by a circle about it.
function splatNear(camera, dilation, [x, y], reach, i) {
  const { rotation: r, translation: t, fx, fy, cx, cy } = camera;
  const m = model.means;
  const [mx, my, mz] = [m[3 * i], m[3 * i + 1], m[3 * i + 2]];
  const z = r[6] * mx + r[7] * my + r[8] * mz + t[2];
  if (z < NEAR_PLANE) return null;
  const slopeX = (r[0] * mx + r[1] * my + r[2] * mz + t[0]) / z;
  const slopeY = (r[3] * mx + r[4] * my + r[5] * mz + t[1]) / z;
  const u = clampSlope(slopeX, cx, fx, camera.width);
  const v = clampSlope(slopeY, cy, fy, camera.height);
  const [column, row] = [fx * slopeX + cx, fy * slopeY + cy];
  const focal = (model.largestScale[i] * Math.max(fx, fy)) / z;
  const radius = reach + Math.sqrt(LARGEST_TAU2 * (focal * focal * (1 + u * u + v * v) + dilation));
  if ((x - column) ** 2 + (y - row) ** 2 > radius * radius) return null;
  const along = alongAxes(r[6], r[7], r[8], i);
  if (dot(along, along) > z * z) return null;
  const n0 = alongAxes((fx / z) * (r[0] - u * r[6]), (fx / z) * (r[1] - u * r[7]), (fx / z) * (r[2] - u * r[8]), i);
  const n1 = alongAxes((fy / z) * (r[3] - v * r[6]), (fy / z) * (r[4] - v * r[7]), (fy / z) * (r[5] - v * r[8]), i);
  const covariances = [dot(n0, n0), dot(n0, n1), dot(n1, n1), dot(n0, along), dot(n1, along)];
  return { index: i, column, row, z, distance: z * Math.hypot(1, slopeX, slopeY), covariances };
}

// The splat's alpha at a pixel, and its z in the middle and where the pixel's ray meets it; nothing below 1/255.
function hitAt({ index, column, row, z, distance, covariances }, dilation, px, py, opacity) {
  const [xx, xy, yy, xz, yz] = covariances;
  const [dx, dy] = [px - column, py - row];
  const determinant = xx * yy - xy * xy + dilation * (xx + yy + dilation);
  const squared = (yy + dilation) * dx * dx - 2 * xy * dx * dy + (xx + dilation) * dy * dy;
  const falloff = Math.exp((-0.5 * Math.max(squared, 0)) / determinant);
  const alpha = Math.min(ALPHA_MAX, opacity * falloff);
  if (alpha < ALPHA_MIN) return null;
  const slope = [(yy + dilation) * xz - xy * yz, (xx + dilation) * yz - xy * xz].map((each) => each / determinant);
  const nearness = 1 - (dx * slope[0] + dy * slope[1]) / z;
  return { index, distance, depth: z / Math.max(nearness, 1 / STEEPEST), alpha };
}

function clampSlope(slope, centre, focal, size) {
  const margin = (FRUSTUM_MARGIN * size) / (2 * focal);
  return Math.min(Math.max(slope, -centre / focal - margin), (size - centre) / focal + margin);
}

// The scalar products of a vector and the axes of a splat.
function alongAxes(x, y, z, i) {
  const { axes } = model;
  return [9 * i, 9 * i + 3, 9 * i + 6].map((at) => x * axes[at] + y * axes[at + 1] + z * axes[at + 2]);
}
