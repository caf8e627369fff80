// Parts of the model, from the text in the page to arrays. The layout is that of packing.py.

const SQRT_HALF = Math.SQRT1_2;

async function decodePart(text, modalities) {
  const { header, data } = JSON.parse(text);
  const planes = splitPlanes(await gunzip(fromBase64(data)), header.planes);
  const { count, first, replaces } = header;
  const part = {
    count,
    first,
    replaces,
    means: decodeMeans(planes, count, header.chunk),
    axes: new Float32Array(9 * count),
    largestScale: new Float32Array(count),
    appearances: Object.fromEntries(modalities.map(({ name, channels }) => [name, decodeAppearance(planes, header, name, channels)])),
  };
  decodeShapes(planes, header.limits.scales, part);
  return part;
}

// Opacity, and either values without view dependence or the coefficients of the harmonics as bytes.
function decodeAppearance(planes, header, name, channels) {
  const opacities = planes[`opacity_${name}`];
  const appearance = { channels, opacity: scaled(opacities, 0, 1, opacities.BYTES_PER_ELEMENT === 1 ? 255 : 65535) };
  const sh = planes[`sh_${name}`];
  if (!sh) return { ...appearance, values: scaled(planes[`values_${name}`], ...header.limits.values[name], 65535) };
  return {
    ...appearance,
    sh: interleave(sh, header.count, sh.length / header.count),
    // Lowest value and step of each degree.
    bands: header.limits.sh[name].map(([low, high], degree) => [low, (high - low) / header.sh_steps[degree]]),
  };
}

// Of an area, as its camera sees it: steps of the logarithm, from 1 for the nearest; 0 where it does not see the area.
async function decodeDepths({ depths, nearest, step }) {
  const codes = new Uint16Array(await gunzip(fromBase64(depths)));
  return Float32Array.from(codes, (code) => (code ? nearest * Math.exp(step * (code - 1)) : 0));
}

async function gunzip(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

function splitPlanes(buffer, descriptions) {
  const types = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };
  const planes = {};
  let offset = 0;
  for (const [name, type, length] of descriptions) {
    planes[name] = new types[type](buffer, offset, length);
    offset += planes[name].byteLength;
  }
  return planes;
}

function scaled(codes, low, high, steps) {
  return Float32Array.from(codes, (code) => low + ((high - low) * code) / steps);
}

function decodeMeans(planes, count, chunk) {
  const means = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) {
    const bounds = 3 * Math.floor(i / chunk);
    for (let axis = 0; axis < 3; axis++) {
      const low = planes.chunk_low[bounds + axis];
      const span = planes.chunk_high[bounds + axis] - low;
      means[3 * i + axis] = low + (span * planes.positions[axis * count + i]) / 65535;
    }
  }
  return means;
}

// The three axes of each splat's ellipsoid, as long as its standard deviations. A covariance made of them in single
// precision would not hold the shape of a needle.
function decodeShapes(planes, [low, high], part) {
  const { axes, largestScale, count } = part;
  const step = (high - low) / 1023;
  const quat = new Float64Array(4);
  for (let i = 0; i < count; i++) {
    const code = planes.scales[i];
    const sx = Math.exp(low + step * (code >>> 20));
    const sy = Math.exp(low + step * ((code >>> 10) & 1023));
    const sz = Math.exp(low + step * (code & 1023));
    largestScale[i] = Math.max(sx, sy, sz);
    decodeQuat(planes.rotations[i], quat);
    const [w, x, y, z] = quat;
    const at = 9 * i;
    axes[at] = (1 - 2 * (y * y + z * z)) * sx;
    axes[at + 1] = 2 * (x * y + w * z) * sx;
    axes[at + 2] = 2 * (x * z - w * y) * sx;
    axes[at + 3] = 2 * (x * y - w * z) * sy;
    axes[at + 4] = (1 - 2 * (x * x + z * z)) * sy;
    axes[at + 5] = 2 * (y * z + w * x) * sy;
    axes[at + 6] = 2 * (x * z + w * y) * sz;
    axes[at + 7] = 2 * (y * z - w * x) * sz;
    axes[at + 8] = (1 - 2 * (x * x + y * y)) * sz;
  }
}

function decodeQuat(code, quat) {
  const largest = code >>> 30;
  let squares = 0;
  for (let component = 0, shift = 20; component < 4; component++) {
    if (component === largest) continue;
    quat[component] = (2 * ((code >>> shift) & 1023) / 1023 - 1) * SQRT_HALF;
    squares += quat[component] ** 2;
    shift -= 10;
  }
  quat[largest] = Math.sqrt(Math.max(0, 1 - squares));
}

// From one plane per coefficient to the coefficients of each splat side by side, filled up to whole texels of 16 bytes.
function interleave(plane, count, coefficients) {
  const stride = 16 * Math.ceil(coefficients / 16);
  const bytes = new Uint8Array(count * stride);
  for (let k = 0; k < coefficients; k++) {
    for (let i = 0, from = k * count, to = k; i < count; i++, from++, to += stride) bytes[to] = plane[from];
  }
  return bytes;
}
