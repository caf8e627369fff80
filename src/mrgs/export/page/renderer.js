// Draws the splats: blended into a 16-bit float image, then shown as colours or through a palette.

const SPLATS_PER_ROW = 512;
const NO_RADIANCE = { gain: 0, b: 0, offset: 0, least: 1, low_k: 0, span_k: 1 };

class Renderer {
  constructor(canvas, { model, modalities }, palettes) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser offers no WebGL2, which the 3D view needs.");
    this.gl = gl;
    this.canvas = canvas;
    this.count = 0;
    this.dilation = model.dilation;
    this.radiance = model.radiance;
    this.floatTarget = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.splats = buildProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.screen = buildProgram(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.rows = model.slots / SPLATS_PER_ROW;
    if (this.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("This model is too large for the graphics of this device.");
    this.geometry = newTexture(gl, gl.RGBA32F, 3 * SPLATS_PER_ROW, this.rows, gl.NEAREST);
    this.appearances = Object.fromEntries(
      modalities.map(({ name, channels }) => [name, { channels, texture: newTexture(gl, gl.RG32F, SPLATS_PER_ROW, this.rows, gl.NEAREST) }]),
    );
    for (const appearance of Object.values(this.appearances)) addHarmonics(gl, appearance, this.rows, 0, []);
    this.palettes = Object.fromEntries(Object.entries(palettes).map(([name, rgb]) => [name, paletteTexture(gl, rgb)]));
    this.target = new Target(gl, 1, this.floatTarget ? gl.RGBA16F : gl.RGBA8, gl.LINEAR);
    this.surface = null;
    this.createArrays();
  }

  createArrays() {
    const gl = this.gl;
    this.arrays = gl.createVertexArray();
    this.order = gl.createBuffer();
    gl.bindVertexArray(this.arrays);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    const place = gl.getAttribLocation(this.splats.program, "splat");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribIPointer(place, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(place, 1);
    this.noArrays = gl.createVertexArray();
  }

  // Put a part's splats into the textures, from a row of their own on.
  add({ first, count, geometry, appearances }) {
    const gl = this.gl;
    const row = first / SPLATS_PER_ROW;
    writeRows(gl, this.geometry, row, 3, geometry, gl.RGBA, gl.FLOAT);
    for (const [name, { texels, sh, bands }] of Object.entries(appearances)) {
      const appearance = this.appearances[name];
      writeRows(gl, appearance.texture, row, 1, texels, gl.RG, gl.FLOAT);
      if (!sh) continue;
      if (!appearance.texelsPerSplat) addHarmonics(gl, appearance, this.rows, sh.length / count / 16, bands);
      writeRows(gl, appearance.harmonics, row, appearance.texelsPerSplat, new Uint32Array(sh.buffer), gl.RGBA_INTEGER, gl.UNSIGNED_INT);
    }
  }

  // The depths of areas, as textures, if the device can draw what they are compared with; returns whether it can.
  addAreas({ list }) {
    const gl = this.gl;
    if (!this.floatTarget) return false;
    this.surface = new Surface(gl);
    for (const area of list) {
      const { width, height } = area.camera;
      area.texture = newTexture(gl, gl.R32F, width, height, gl.NEAREST);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RED, gl.FLOAT, area.depths);
    }
    return true;
  }

  setOrder(order) {
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
    gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
    this.count = order.length;
  }

  // The camera is in pixels of the image that is drawn, which may be coarser than the canvas.
  draw(camera, look) {
    this.blend(camera, look);
    const { gl, screen } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.disable(gl.BLEND);
    gl.useProgram(screen.program);
    gl.bindVertexArray(this.noArrays);
    bindTexture(gl, 0, this.target.textures[0], screen.at("blended"));
    bindTexture(gl, 1, this.palettes[look.palette ?? "grey"], screen.at("palette"));
    gl.uniform1i(screen.at("mapped"), look.palette !== null);
    gl.uniform2fv(screen.at("range"), look.range);
    gl.uniform2fv(screen.at("isotherm"), look.isotherm);
    gl.uniform1i(screen.at("ofArea"), false);
    const law = (look.modality === "thermal" && this.radiance) || NO_RADIANCE;
    gl.uniform4f(screen.at("radiance"), law.gain, law.b, law.offset, law.least);
    gl.uniform2f(screen.at("kelvin"), law.low_k, law.span_k);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    if (look.areas) this.inside(look.areas.rectangle, this.canvas, () => look.areas.views.forEach((view) => this.drawArea(view, camera)));
  }

  // Draw only within a rectangle of an image: left, top, right and bottom as shares of it.
  inside([left, top, right, bottom], { width, height }, draw) {
    const { gl } = this;
    const [x, y] = [Math.floor(left * width), Math.floor((1 - bottom) * height)];
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(x, y, Math.ceil(right * width) - x, Math.ceil((1 - top) * height) - y);
    draw();
    gl.disable(gl.SCISSOR_TEST);
  }

  // The pixels of an area once more, corrected.
  drawArea({ area, turn, shift, normal, offset }, camera) {
    const { gl, screen } = this;
    const { near, law, scale } = area;
    const { fx, fy, cx, cy } = area.camera;
    gl.uniform1i(screen.at("ofArea"), true);
    bindTexture(gl, 2, area.texture, screen.at("depths"));
    bindTexture(gl, 3, this.surface.depths.textures[0], screen.at("surface"));
    gl.uniform1f(screen.at("farthest"), this.surface.farthest);
    gl.uniform2f(screen.at("size"), camera.width, camera.height);
    gl.uniform4f(screen.at("lens"), camera.fx, camera.fy, camera.cx, camera.cy);
    gl.uniform4f(screen.at("areaLens"), fx, fy, cx, cy);
    gl.uniformMatrix3fv(screen.at("turn"), true, turn);
    gl.uniform3fv(screen.at("shift"), shift);
    gl.uniform4f(screen.at("plane"), ...normal, offset);
    gl.uniform1f(screen.at("near"), near);
    gl.uniform3f(screen.at("law"), law.amplitude, law.b, law.f);
    gl.uniform2f(screen.at("change"), area.gain, area.offset);
    gl.uniform2f(screen.at("kelvin"), scale.min + ZERO_CELSIUS_K, scale.span);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Wait until all is drawn.
  finish() {
    const gl = this.gl;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  // Value, place and, where there are areas, depth of all pixels that show a surface, of an image that is drawn for
  // this alone.
  seenPixels(camera, look, surfaceAlpha) {
    const { gl } = this;
    this.blend(camera, look);
    const depths = look.areas ? this.surface.read(camera) : [];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    const pixels = new (this.floatTarget ? Float32Array : Uint8Array)(4 * camera.width * camera.height);
    gl.readPixels(0, 0, camera.width, camera.height, gl.RGBA, this.floatTarget ? gl.FLOAT : gl.UNSIGNED_BYTE, pixels);
    const one = this.floatTarget ? 1 : 255;
    const seen = [];
    for (let i = 0; i < pixels.length; i += 4) {
      if (pixels[i + 3] < surfaceAlpha * one) continue;
      const [row, column] = [Math.floor(i / 4 / camera.width), (i / 4) % camera.width];
      seen.push([valueOfBlend(this.radiance, look.modality, pixels[i] / one), [column + 0.5, camera.height - row - 0.5], depths[i / 4]]);
    }
    return seen;
  }

  blend(camera, { modality, areas }) {
    const { gl, splats } = this;
    const drawSplats = (program) => this.drawSplats(program, camera, this.appearances[modality]);
    if (areas) this.inside(areas.rectangle, camera, () => this.surface.draw(camera, areas.limits, drawSplats));
    this.target.begin(camera.width, camera.height, 0);
    gl.useProgram(splats.program);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    drawSplats(splats);
  }

  // With a program that is in use.
  drawSplats(splats, camera, appearance) {
    const { gl } = this;
    gl.bindVertexArray(this.arrays);
    bindTexture(gl, 0, this.geometry, splats.at("geometry"));
    bindTexture(gl, 1, appearance.harmonics, splats.at("harmonics"));
    bindTexture(gl, 2, appearance.texture, splats.at("appearance"));
    gl.uniform1i(splats.at("splatsPerRow"), SPLATS_PER_ROW);
    gl.uniform1i(splats.at("texelsPerSplat"), appearance.texelsPerSplat);
    gl.uniform1i(splats.at("channels"), appearance.channels);
    gl.uniformMatrix3fv(splats.at("rotation"), true, camera.rotation);
    gl.uniform3fv(splats.at("translation"), camera.translation);
    gl.uniform3fv(splats.at("eye"), camera.position);
    gl.uniform2f(splats.at("focal"), camera.fx, camera.fy);
    gl.uniform1f(splats.at("dilation"), dilationOf(this.dilation, camera));
    gl.uniform2f(splats.at("centre"), camera.cx, camera.cy);
    gl.uniform2f(splats.at("size"), camera.width, camera.height);
    gl.uniform1i(splats.at("degree"), appearance.degree);
    gl.uniform2fv(splats.at("bands"), appearance.bands);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
  }
}

function buildProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  const places = new Map();
  const at = (name) => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(program, name));
    return places.get(name);
  };
  return { program, at };
}

function newTexture(gl, format, width, height, filter) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, filter);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return texture;
}

function bindTexture(gl, unit, texture, place) {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.uniform1i(place, unit);
}

// Write splats into a texture from a row on; the last row may be filled in part.
function writeRows(gl, texture, row, texelsPerSplat, values, format, type) {
  const channels = format === gl.RG ? 2 : 4;
  const width = texelsPerSplat * SPLATS_PER_ROW;
  const rows = Math.ceil(values.length / (channels * width));
  const whole = new values.constructor(rows * width * channels);
  whole.set(values);
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, rows, format, type, whole);
}

// The texture of a modality's harmonics, and lowest value and step of each degree; a modality without harmonics has one
// empty texel.
function addHarmonics(gl, appearance, rows, texelsPerSplat, bands) {
  const limits = new Float32Array(8);
  bands.forEach((band, degree) => limits.set(band, 2 * degree));
  const [width, height] = texelsPerSplat ? [texelsPerSplat * SPLATS_PER_ROW, rows] : [1, 1];
  const harmonics = newTexture(gl, gl.RGBA32UI, width, height, gl.NEAREST);
  Object.assign(appearance, { texelsPerSplat, degree: bands.length - 1, bands: limits, harmonics });
}

function paletteTexture(gl, rgb) {
  const texture = newTexture(gl, gl.RGB8, 256, 1, gl.NEAREST);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, 1, gl.RGB, gl.UNSIGNED_BYTE, rgb);
  return texture;
}
