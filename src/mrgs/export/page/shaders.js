// The image model of mrgs, as in its rasterizer: dilated covariance, alpha from 1/255 to 0.999; what reaches the
// camera's plane is left out.

const SPLAT_VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform sampler2D geometry;    // per splat three: a coordinate of the mean, and an axis of the ellipsoid
uniform sampler2D appearance;  // per splat: opacity, value without view dependence
uniform usampler2D harmonics;  // per splat: the coefficients as bytes
uniform int splatsPerRow;
uniform int texelsPerSplat;    // of the harmonics; 0 without them
uniform int channels;          // 1 or 3
uniform mat3 rotation;         // world to camera
uniform vec3 translation;
uniform vec3 eye;
uniform vec2 focal;
uniform float dilation;        // of the projected covariance, px²
uniform vec2 centre;
uniform vec2 size;
uniform int degree;
uniform vec2 bands[4];         // lowest value and step of each degree

in uint splat;
out vec2 deviations;           // from the projected mean along the ellipse's axes, standard deviations
flat out vec4 value;           // what is blended, and the opacity
flat out float middle;         // z of the mean
out float nearness;            // z of the mean over z where the pixel's ray meets the splat

uvec4 texels[3];

float coefficient(int k) {
  return float((texels[k / 16][(k / 4) % 4] >> (8 * (k % 4))) & 255u);
}

vec3 band(int function, int degreeOf) {
  int first = channels * function;
  vec3 codes = vec3(coefficient(first));
  if (channels == 3) codes.yz = vec2(coefficient(first + 1), coefficient(first + 2));
  return bands[degreeOf].x + bands[degreeOf].y * codes;
}

vec3 shade(int index, vec3 d) {
  ivec2 at = ivec2((index % splatsPerRow) * texelsPerSplat, index / splatsPerRow);
  for (int k = 0; k < texelsPerSplat; k++) texels[k] = texelFetch(harmonics, at + ivec2(k, 0), 0);
  vec3 sum = 0.5 + 0.28209479 * band(0, 0);
  if (degree > 0) sum += 0.48860251 * (-d.y * band(1, 1) + d.z * band(2, 1) - d.x * band(3, 1));
  vec3 q = d * d;
  if (degree > 1) {
    sum += 1.09254843 * (d.x * d.y * band(4, 2) - d.y * d.z * band(5, 2) - d.x * d.z * band(7, 2))
      + 0.31539157 * (2.0 * q.z - q.x - q.y) * band(6, 2) + 0.54627422 * (q.x - q.y) * band(8, 2);
  }
  if (degree > 2) {
    sum += -0.59004359 * d.y * (3.0 * q.x - q.y) * band(9, 3) + 2.89061144 * d.x * d.y * d.z * band(10, 3)
      - 0.45704580 * d.y * (4.0 * q.z - q.x - q.y) * band(11, 3)
      + 0.37317633 * d.z * (2.0 * q.z - 3.0 * q.x - 3.0 * q.y) * band(12, 3)
      - 0.45704580 * d.x * (4.0 * q.z - q.x - q.y) * band(13, 3)
      + 1.44530572 * d.z * (q.x - q.y) * band(14, 3) - 0.59004359 * d.x * (q.x - 3.0 * q.y) * band(15, 3);
  }
  return max(sum, 0.0);
}

void main() {
  int index = int(splat);
  ivec2 at = ivec2((index % splatsPerRow) * 3, index / splatsPerRow);
  vec4 first = texelFetch(geometry, at, 0);
  vec4 second = texelFetch(geometry, at + ivec2(1, 0), 0);
  vec4 third = texelFetch(geometry, at + ivec2(2, 0), 0);
  vec2 own = texelFetch(appearance, ivec2(index % splatsPerRow, index / splatsPerRow), 0).xy;
  float opacity = own.x;
  vec3 position = vec3(first.x, second.x, third.x);
  mat3 axes = mat3(first.yzw, second.yzw, third.yzw);
  vec3 mean = rotation * position + translation;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (mean.z < 0.01 || opacity < 1.0 / 255.0) return;

  vec2 slope = mean.xy / mean.z;
  vec2 margin = 0.15 * size / focal;
  vec2 uv = clamp(slope, -centre / focal - margin, (size - centre) / focal + margin);
  vec3 depthRow = vec3(rotation[0].z, rotation[1].z, rotation[2].z);
  vec3 jx = focal.x / mean.z * (vec3(rotation[0].x, rotation[1].x, rotation[2].x) - uv.x * depthRow);
  vec3 jy = focal.y / mean.z * (vec3(rotation[0].y, rotation[1].y, rotation[2].y) - uv.y * depthRow);
  if (length(depthRow * axes) > mean.z) return;
  vec3 n0 = jx * axes;
  vec3 n1 = jy * axes;
  float xx = dot(n0, n0);
  float xy = dot(n0, n1);
  float yy = dot(n1, n1);
  // Not (xx + d)(yy + d) - xy², which for a needle cancels to rounding errors.
  vec3 area = cross(n0, n1);
  float determinant = dot(area, area) + dilation * (xx + yy + dilation);

  float halfTrace = 0.5 * (xx + yy);
  float halfDifference = 0.5 * (xx - yy);
  float radius = length(vec2(halfDifference, xy));
  float largest = halfTrace + radius + dilation;
  vec2 axis = radius < 1e-6 * (halfTrace + dilation) ? vec2(1.0, 0.0)
    : xx > yy ? normalize(vec2(radius + halfDifference, xy)) : normalize(vec2(xy, radius - halfDifference));
  float tau = sqrt(2.0 * log(255.0 * opacity));
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  deviations = tau * corner;
  vec2 offset = deviations.x * sqrt(largest) * axis
    + deviations.y * sqrt(determinant / largest) * vec2(-axis.y, axis.x);
  vec2 place = (focal * slope + centre + offset) / size;
  gl_Position = vec4(2.0 * place.x - 1.0, 1.0 - 2.0 * place.y, 0.0, 1.0);
  value = vec4(vec3(own.y), opacity);
  vec2 withDepth = vec2(dot(n0, depthRow * axes), dot(n1, depthRow * axes));
  vec2 depthSlope = vec2((yy + dilation) * withDepth.x - xy * withDepth.y, (xx + dilation) * withDepth.y - xy * withDepth.x);
  middle = mean.z;
  nearness = 1.0 - dot(offset, depthSlope) / (determinant * mean.z);
  if (texelsPerSplat > 0) value.rgb = shade(index, normalize(position - eye));
}`;

const SPLAT_ALPHA = `
in vec2 deviations;
flat in vec4 value;

float alphaHere() {
  return min(0.999, value.a * exp(-0.5 * dot(deviations, deviations)));
}`;

const SPLAT_FRAGMENT = `#version 300 es
precision highp float;
${SPLAT_ALPHA}
out vec4 blended;

void main() {
  float alpha = alphaHere();
  if (alpha < 1.0 / 255.0) discard;
  blended = vec4(value.rgb * alpha, alpha);
}`;

const SPLAT_DEPTH = `
flat in float middle;
in float nearness;
uniform float steps[8];        // rising z

float depthHere() {
  return middle / max(nearness, 0.25);
}`;

// What passes the splats before each of eight steps of depth.
const PASSED_FRAGMENT = `#version 300 es
precision highp float;
${SPLAT_ALPHA}
${SPLAT_DEPTH}
layout(location = 0) out vec4 nearer;
layout(location = 1) out vec4 farther;

void main() {
  float depth = depthHere();
  if (depth > steps[7]) discard;
  float alpha = alphaHere();
  if (alpha < 1.0 / 255.0) discard;
  nearer = alpha * step(depth, vec4(steps[0], steps[1], steps[2], steps[3]));
  farther = alpha * step(depth, vec4(steps[4], steps[5], steps[6], steps[7]));
}`;

// The mean depth, in units of the last step, of the splats between the two steps where half of the light is blocked.
const SURFACE_FRAGMENT = `#version 300 es
precision highp float;
${SPLAT_ALPHA}
${SPLAT_DEPTH}
uniform sampler2D nearer;
uniform sampler2D farther;
out vec4 blended;

void main() {
  float depth = depthHere();
  if (depth <= steps[0] || depth > steps[7]) discard;
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 ones = vec4(1.0);
  int before = int(dot(ones, step(0.5, texelFetch(nearer, at, 0))) + dot(ones, step(0.5, texelFetch(farther, at, 0))));
  if (before == 0 || before == 8 || depth <= steps[before - 1] || depth > steps[before]) discard;
  float alpha = alphaHere();
  if (alpha < 1.0 / 255.0) discard;
  blended = vec4(depth / steps[7] * alpha, 0.0, 0.0, alpha);
}`;

const SCREEN_VERTEX = `#version 300 es
out vec2 place;
void main() {
  place = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0;
  gl_Position = vec4(place * 2.0 - 1.0, 0.0, 1.0);
}`;

const SCREEN_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D blended;
uniform sampler2D palette;
uniform bool mapped;       // through the palette; else the blended values are colours
uniform vec2 range;        // normalised values of the palette's ends
uniform vec2 isotherm;     // of the band; empty where the first is larger
uniform bool ofArea;       // draw the pixels of an area alone, corrected; as in areas.js, which has what follows
uniform sampler2D depths;
uniform sampler2D surface; // its depth in units of the farthest, times alpha
uniform float farthest;
uniform vec2 size;
uniform vec4 lens;
uniform vec4 areaLens;
uniform mat3 turn;
uniform vec3 shift;
uniform vec4 plane;
uniform float near;
uniform vec3 law;
uniform vec2 change;
uniform vec2 kelvin;       // of the normalised value 0, and the span to 1
uniform vec4 radiance;     // gain, b, offset and least of the law by which values are blended; a gain of 0 for none
in vec2 place;
out vec4 shown;

const vec3 NOTHING_SEEN = vec3(0.227, 0.259, 0.306);
const vec3 ISOTHERM = vec3(0.20, 0.95, 0.35);

bool isOfArea(float depth) {
  vec2 pixel = vec2(place.x, 1.0 - place.y) * size;
  vec3 point = depth * vec3((pixel - lens.zw) / lens.xy, 1.0);
  float along = dot(plane.xyz, point);
  if (along != 0.0 && abs(plane.w / along - 1.0) < near) point *= plane.w / along;
  vec3 there = turn * point + shift;
  ivec2 at = ivec2(floor(areaLens.xy * there.xy / there.z + areaLens.zw));
  if (there.z <= 0.0 || any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, textureSize(depths, 0)))) return false;
  float seen = texelFetch(depths, at, 0).r;
  return seen > 0.0 && abs(seen - there.z) < near * seen;
}

float withSettings(float value) {
  float signal = change.x * law.x / (exp(law.y / (kelvin.x + kelvin.y * value)) - law.z) + change.y;
  float found = (law.y / log(law.x / signal + law.z) - kelvin.x) / kelvin.y;
  return signal > 0.0 && !isnan(found) && !isinf(found) ? found : value;
}

void main() {
  vec4 sum = texture(blended, place);
  vec3 value = sum.rgb;
  if (radiance.x > 0.0) {
    float signal = max(value.r + radiance.z, radiance.w);
    value.r = (radiance.y / log(radiance.x / signal + 1.0) - kelvin.x) / kelvin.y;
  }
  if (ofArea) {
    vec4 there = texture(surface, place);
    if (sum.a < 0.5 || there.a == 0.0 || !isOfArea(farthest * there.r / there.a)) discard;
    value.r = withSettings(value.r);
  }
  if (!mapped) {
    shown = vec4(value, 1.0);
    return;
  }
  float position = clamp((value.r - range.x) / (range.y - range.x), 0.0, 1.0);
  vec3 mapped = texelFetch(palette, ivec2(int(position * 255.0 + 0.5), 0), 0).rgb;
  if (value.r >= isotherm.x && value.r <= isotherm.y) mapped = ISOTHERM;
  shown = vec4(sum.a < 0.5 ? NOTHING_SEEN : mapped, 1.0);
}`;
