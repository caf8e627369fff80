// Where the viewer stands, and how the mouse, fingers and keys move it. Cameras have OpenCV axes: the rows of the
// rotation are right, down and forward.

const WHEEL_ZOOM = 0.0012;
const KEY_STEP = 0.06;
const TAP_PX = 6;

// Whether a key belongs to the browser, such as Ctrl+S.
const isShortcut = (event) => event.ctrlKey || event.metaKey || event.altKey;

class Viewpoint {
  constructor(world, onChange) {
    this.up = world.up;
    this.focus = world.focus;
    this.onChange = onChange;
  }

  jumpTo(camera) {
    this.frame = camera;
    this.rotation = camera.rotation.slice();
    this.position = camera.position.slice();
    const ahead = dot(this.forward, subtract(this.focus, this.position));
    this.distance = ahead > 0 ? ahead : Math.hypot(...subtract(this.focus, this.position)) || 1;
    this.onChange();
  }

  get right() { return this.rotation.slice(0, 3); }
  get down() { return this.rotation.slice(3, 6); }
  get forward() { return this.rotation.slice(6, 9); }

  // The camera for an image of this size that shows the whole frame of the captured one.
  cameraFor(width, height) {
    const { frame, rotation, position } = this;
    const scale = Math.min(width / frame.width, height / frame.height);
    return {
      width, height, rotation, position,
      fx: scale * frame.fx,
      fy: scale * frame.fy,
      cx: width / 2 + scale * (frame.cx - frame.width / 2),
      cy: height / 2 + scale * (frame.cy - frame.height / 2),
      translation: [0, 3, 6].map((row) => -dot(rotation.slice(row, row + 3), position)),
    };
  }

  orbit(yaw, pitch) {
    const target = add(this.position, multiply(this.forward, this.distance));
    const steepness = dot(turn(this.forward, this.right, pitch), this.up);
    this.turnAxes(this.up, yaw);
    if (Math.abs(steepness) < 0.99 || Math.abs(steepness) < Math.abs(dot(this.forward, this.up))) {
      this.turnAxes(this.right, pitch);
    }
    this.position = subtract(target, multiply(this.forward, this.distance));
    this.onChange();
  }

  turnAxes(axis, angle) {
    const axes = [this.right, this.down, this.forward].map((row) => turn(row, axis, angle));
    this.rotation = orthonormal(axes).flat();
  }

  // By a share of the image's height, as if the scene were held at the point that is orbited.
  pan(x, y) {
    const span = (this.distance * this.frame.height) / this.frame.fy;
    this.position = subtract(this.position, add(multiply(this.right, x * span), multiply(this.down, y * span)));
    this.onChange();
  }

  zoom(factor) {
    const target = add(this.position, multiply(this.forward, this.distance));
    this.distance = Math.max(this.distance * factor, 0.02);
    this.position = subtract(target, multiply(this.forward, this.distance));
    this.onChange();
  }

  // Orbit from now on around what lies at this depth ahead.
  holdAt(depth) {
    this.distance = Math.max(depth, 0.02);
  }
}

// Rodrigues' rotation of a vector around a unit axis.
function turn(vector, axis, angle) {
  const along = multiply(axis, dot(axis, vector) * (1 - Math.cos(angle)));
  return add(add(multiply(vector, Math.cos(angle)), multiply(cross(axis, vector), Math.sin(angle))), along);
}

function orthonormal([right, , forward]) {
  const ahead = normalized(forward);
  const down = normalized(cross(ahead, right));
  return [cross(down, ahead), down, ahead];
}

// Mouse, fingers and keys on the canvas. Hover and tap are reported in CSS pixels of the canvas.
class Navigation {
  constructor(canvas, viewpoint, { onHover, onLeave, onTap, onMove, onHome }) {
    this.canvas = canvas;
    this.viewpoint = viewpoint;
    this.handlers = { onHover, onLeave, onTap, onMove, onHome };
    this.pointers = new Map();
    this.travelled = 0;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => onLeave());
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  }

  get dragging() {
    return this.pointers.size > 0 && this.travelled > TAP_PX;
  }

  press(event) {
    if (this.pointers.size === 0) this.travelled = 0;
    this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    this.canvas.setPointerCapture(event.pointerId);
  }

  move(event) {
    const before = this.pointers.get(event.pointerId);
    const now = [event.offsetX, event.offsetY];
    if (!before) {
      this.handlers.onHover(...now);
      return;
    }
    const step = [now[0] - before[0], now[1] - before[1]];
    this.travelled += Math.hypot(...step);
    if (this.travelled > TAP_PX) this.drag(event, before, now, step);
    this.pointers.set(event.pointerId, now);
  }

  drag(event, before, now, step) {
    const height = this.canvas.clientHeight;
    this.handlers.onMove();
    if (this.pointers.size === 1) {
      if (event.shiftKey || event.buttons & 6) this.viewpoint.pan(step[0] / height, step[1] / height);
      else this.viewpoint.orbit((3 * step[0]) / height, (-3 * step[1]) / height);
      return;
    }
    const [id] = [...this.pointers.keys()].filter((key) => key !== event.pointerId);
    const other = this.pointers.get(id);
    const spread = (point) => Math.max(Math.hypot(point[0] - other[0], point[1] - other[1]), 1);
    this.viewpoint.pan(step[0] / 2 / height, step[1] / 2 / height);
    this.viewpoint.zoom(spread(before) / spread(now));
  }

  release(event) {
    const isTap = event.button === 0; // other buttons move the view
    if (this.pointers.delete(event.pointerId) && isTap && this.travelled <= TAP_PX && this.pointers.size === 0) {
      this.handlers.onTap(event.offsetX, event.offsetY);
    }
  }

  wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * (event.deltaMode === 1 ? 30 : 1);
    this.handlers.onMove();
    this.viewpoint.zoom(Math.exp(Math.max(-300, Math.min(300, pixels)) * WHEEL_ZOOM));
  }

  key(event) {
    const actions = {
      ArrowLeft: () => this.viewpoint.orbit(KEY_STEP, 0),
      ArrowRight: () => this.viewpoint.orbit(-KEY_STEP, 0),
      ArrowUp: () => this.viewpoint.orbit(0, KEY_STEP),
      ArrowDown: () => this.viewpoint.orbit(0, -KEY_STEP),
      "+": () => this.viewpoint.zoom(0.9),
      "-": () => this.viewpoint.zoom(1 / 0.9),
      h: () => this.handlers.onHome(),
      Home: () => this.handlers.onHome(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action || isShortcut(event)) return;
    event.preventDefault();
    this.handlers.onMove();
    action();
  }
}
