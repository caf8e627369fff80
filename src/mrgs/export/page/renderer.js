// Draws the splats: blended into a 16-bit float image, then shown as colours or through a palette.

const SPLATS_PER_ROW = 512;

class Renderer {
  constructor(canvas, model, palettes) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This browser offers no WebGL2, which the 3D view needs.");
    this.gl = gl;
    this.canvas = canvas;
    this.count = 0;
    this.floatTarget = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
    this.splats = buildProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.screen = buildProgram(gl, SCREEN_VERTEX, SCREEN_FRAGMENT);
    this.geometry = geometryTexture(gl, model);
    this.appearances = Object.fromEntries(
      Object.entries(model.appearances).map(([name, appearance]) => [name, appearanceTextures(gl, appearance, model.count)]),
    );
    this.palettes = Object.fromEntries(Object.entries(palettes).map(([name, rgb]) => [name, paletteTexture(gl, rgb)]));
    this.target = null;
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
    bindTexture(gl, 0, this.target.texture, screen.at("blended"));
    bindTexture(gl, 1, this.palettes[look.palette ?? "grey"], screen.at("palette"));
    gl.uniform1i(screen.at("mapped"), look.palette !== null);
    gl.uniform2fv(screen.at("range"), look.range);
    gl.uniform2fv(screen.at("isotherm"), look.isotherm);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The normalised values of all pixels that show a surface, of an image that is drawn for this alone.
  seenValues(camera, look, surfaceAlpha) {
    const { gl } = this;
    this.blend(camera, look);
    const pixels = new (this.floatTarget ? Float32Array : Uint8Array)(4 * camera.width * camera.height);
    gl.readPixels(0, 0, camera.width, camera.height, gl.RGBA, this.floatTarget ? gl.FLOAT : gl.UNSIGNED_BYTE, pixels);
    const one = this.floatTarget ? 1 : 255;
    const values = [];
    for (let i = 0; i < pixels.length; i += 4) if (pixels[i + 3] >= surfaceAlpha * one) values.push(pixels[i] / one);
    return values;
  }

  blend(camera, look) {
    const { gl, splats } = this;
    const appearance = this.appearances[look.modality];
    this.resizeTarget(camera.width, camera.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target.framebuffer);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(splats.program);
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
    gl.uniform2f(splats.at("centre"), camera.cx, camera.cy);
    gl.uniform2f(splats.at("size"), camera.width, camera.height);
    gl.uniform1i(splats.at("degree"), appearance.degree);
    gl.uniform2fv(splats.at("bands"), appearance.bands);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
  }

  resizeTarget(width, height) {
    const gl = this.gl;
    if (this.target && this.target.width === width && this.target.height === height) return;
    if (this.target) {
      gl.deleteTexture(this.target.texture);
      gl.deleteFramebuffer(this.target.framebuffer);
    }
    const texture = newTexture(gl, this.floatTarget ? gl.RGBA16F : gl.RGBA8, width, height, gl.LINEAR);
    const framebuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { texture, framebuffer, width, height };
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

function geometryTexture(gl, model) {
  const rows = Math.ceil(model.count / SPLATS_PER_ROW);
  const texels = new Float32Array(rows * SPLATS_PER_ROW * 12);
  for (let i = 0; i < model.count; i++) {
    texels.set(model.means.subarray(3 * i, 3 * i + 3), 12 * i);
    texels.set(model.covariances.subarray(6 * i, 6 * i + 6), 12 * i + 4);
  }
  const texture = newTexture(gl, gl.RGBA32F, 3 * SPLATS_PER_ROW, rows, gl.NEAREST);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 3 * SPLATS_PER_ROW, rows, gl.RGBA, gl.FLOAT, texels);
  return texture;
}

// A modality's opacities and values as one texture, its harmonics as another; a modality without harmonics has one
// empty texel.
function appearanceTextures(gl, { channels, opacity, values, sh, bands }, count) {
  const rows = Math.ceil(count / SPLATS_PER_ROW);
  const texels = new Float32Array(rows * SPLATS_PER_ROW * 2);
  for (let i = 0; i < count; i++) texels.set([opacity[i], values ? values[i] : 0], 2 * i);
  const texture = newTexture(gl, gl.RG32F, SPLATS_PER_ROW, rows, gl.NEAREST);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, SPLATS_PER_ROW, rows, gl.RG, gl.FLOAT, texels);
  const texelsPerSplat = sh ? sh.length / count / 16 : 0;
  const limits = new Float32Array(8);
  (bands ?? []).forEach((band, degree) => limits.set(band, 2 * degree));
  const degree = (bands ?? []).length - 1;
  return { channels, texture, texelsPerSplat, degree, bands: limits, harmonics: harmonicsTexture(gl, sh, rows, texelsPerSplat) };
}

function harmonicsTexture(gl, sh, rows, texelsPerSplat) {
  if (!sh) return newTexture(gl, gl.RGBA32UI, 1, 1, gl.NEAREST);
  const width = texelsPerSplat * SPLATS_PER_ROW;
  const bytes = new Uint8Array(rows * width * 16);
  bytes.set(sh);
  const texture = newTexture(gl, gl.RGBA32UI, width, rows, gl.NEAREST);
  const words = new Uint32Array(bytes.buffer);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, rows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words);
  return texture;
}

function paletteTexture(gl, rgb) {
  const texture = newTexture(gl, gl.RGB8, 256, 1, gl.NEAREST);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, 1, gl.RGB, gl.UNSIGNED_BYTE, rgb);
  return texture;
}
