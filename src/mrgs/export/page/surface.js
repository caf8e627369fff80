// The depth of the surface that each pixel shows, between limits: first which of seven intervals holds the place where
// half of the light is blocked, then the mean of the splats in it.

class Surface {
  constructor(gl) {
    this.gl = gl;
    this.passed = buildProgram(gl, SPLAT_VERTEX, PASSED_FRAGMENT);
    this.within = buildProgram(gl, SPLAT_VERTEX, SURFACE_FRAGMENT);
    this.intervals = new Target(gl, 2);
    this.depths = new Target(gl, 1);
  }

  // `drawSplats` draws all splats with a program, farthest first.
  draw({ width, height }, [nearest, farthest], drawSplats) {
    const { gl, passed, within, intervals, depths } = this;
    const steps = Array.from({ length: 8 }, (_, k) => nearest * (farthest / nearest) ** (k / 7));
    intervals.begin(width, height, 1);
    gl.useProgram(passed.program);
    gl.uniform1fv(passed.at("steps"), steps);
    gl.blendFunc(gl.ZERO, gl.ONE_MINUS_SRC_COLOR);
    drawSplats(passed);
    depths.begin(width, height, 0);
    gl.useProgram(within.program);
    gl.uniform1fv(within.at("steps"), steps);
    bindTexture(gl, 3, intervals.textures[0], within.at("nearer"));
    bindTexture(gl, 4, intervals.textures[1], within.at("farther"));
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    drawSplats(within);
    this.farthest = farthest;
  }

  // Of an image that was drawn, from its lowest row on; 0 where there is none.
  read({ width, height }) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.depths.framebuffer);
    const pixels = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, pixels);
    return Float32Array.from({ length: width * height }, (_, i) => (this.farthest * pixels[4 * i]) / (pixels[4 * i + 3] || 1));
  }
}

// Images of one size that are drawn at once; of 16-bit floats, or bytes where the device has no others.
class Target {
  constructor(gl, count, format = gl.RGBA16F, filter = gl.NEAREST) {
    Object.assign(this, { gl, count, format, filter, textures: [] });
    this.framebuffer = gl.createFramebuffer();
  }

  // Draw into it from now on, onto one number in all channels.
  begin(width, height, ground) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    this.resize(width, height);
    gl.viewport(0, 0, width, height);
    gl.clearColor(ground, ground, ground, ground);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
  }

  resize(width, height) {
    if (width === this.width && height === this.height) return;
    const { gl } = this;
    Object.assign(this, { width, height });
    this.textures.forEach((texture) => gl.deleteTexture(texture));
    this.textures = Array.from({ length: this.count }, () => newTexture(gl, this.format, width, height, this.filter));
    const places = this.textures.map((_, index) => gl.COLOR_ATTACHMENT0 + index);
    this.textures.forEach((texture, index) => gl.framebufferTexture2D(gl.FRAMEBUFFER, places[index], gl.TEXTURE_2D, texture, 0));
    gl.drawBuffers(places);
  }
}
