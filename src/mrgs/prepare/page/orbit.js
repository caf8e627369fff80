// Cameras and points in 3D on a plain canvas. Rows of a camera's rotation are right, down and forward.

const CAMERA_COLOR = "#1f5fa8";
const HELD_COLOR = "#c2560a";
const NEAR_CAMERA_PX = 14;

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((value) => value / Math.hypot(...a));

function bytesOf(base64) {
  return Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
}

class Orbit {
  constructor(canvas, label, facts, onPick) {
    this.canvas = canvas;
    this.label = label;
    this.facts = facts;
    this.onPick = onPick;
    this.yaw = -0.6;
    this.pitch = 0.5;
    this.zoom = 1;
    this.pointers = new Map();
    this.travelled = 0;
    const numbers = new Uint16Array(bytesOf(facts.points).buffer);
    this.colors = bytesOf(facts.colors);
    this.points = Float32Array.from(numbers, (value, index) => facts.low[index % 3] + facts.step * value);
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
    canvas.addEventListener("pointercancel", (event) => this.pointers.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => { this.label.hidden = true; });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.scale(Math.exp(-Math.max(-300, Math.min(300, event.deltaY)) * 0.0012));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  // The axes of the screen in the world: right, up, and towards the viewer.
  axes() {
    const { up } = this.facts;
    const side = Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0];
    const east = unit(cross(side, up));
    const north = cross(up, east);
    const flat = east.map((value, i) => value * Math.sin(this.yaw) - north[i] * Math.cos(this.yaw));
    const towards = flat.map((value, i) => value * Math.cos(this.pitch) + up[i] * Math.sin(this.pitch));
    const right = unit(cross(up, flat));
    return { right, above: cross(towards, right), towards };
  }

  draw() {
    const { canvas, facts } = this;
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!width || !height) return; // not shown, as in print
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const { right, above, towards } = this.axes();
    const size = (0.62 * Math.min(width, height) * this.zoom) / facts.radius;
    const place = (x, y, z) => {
      const [a, b, c] = [x - facts.centre[0], y - facts.centre[1], z - facts.centre[2]];
      const nearer = 1 / Math.max(0.15, 1 - (a * towards[0] + b * towards[1] + c * towards[2]) / (4 * facts.radius));
      return [
        width / 2 + size * nearer * (a * right[0] + b * right[1] + c * right[2]),
        height / 2 - size * nearer * (a * above[0] + b * above[1] + c * above[2]),
      ];
    };
    this.drawPoints(context, place);
    this.places = facts.cameras.map((camera) => this.drawCamera(context, place, camera));
    this.drawScale(context, size, width, height);
  }

  drawPoints(context, place) {
    for (let i = 0; i < this.points.length; i += 3) {
      const [x, y] = place(this.points[i], this.points[i + 1], this.points[i + 2]);
      context.fillStyle = `rgb(${this.colors[i]} ${this.colors[i + 1]} ${this.colors[i + 2]})`;
      context.fillRect(x - 1, y - 1, 2, 2);
    }
  }

  drawCamera(context, place, camera) {
    const { frustum } = this.facts;
    const apex = place(...camera.position);
    const [a, b] = camera.slopes;
    const corners = [[-a, -b], [a, -b], [a, b], [-a, b]].map(([x, y]) => place(...camera.position.map((value, i) =>
      value + frustum * (x * camera.rotation[i] + y * camera.rotation[3 + i] + camera.rotation[6 + i]))));
    context.strokeStyle = camera.heldOut ? HELD_COLOR : CAMERA_COLOR;
    context.lineWidth = camera === this.pointed ? 2.5 : 1;
    context.beginPath();
    for (const corner of corners) {
      context.moveTo(...apex);
      context.lineTo(...corner);
    }
    corners.forEach((corner, i) => (i ? context.lineTo(...corner) : context.moveTo(...corner)));
    context.closePath();
    context.stroke();
    return apex;
  }

  // A round length at the depth of the centre.
  drawScale(context, size, width, height) {
    const most = (0.2 * width) / size;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((factor) => factor * power).find((value) => value <= most);
    context.strokeStyle = context.fillStyle = "#1d2126";
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(14, height - 19);
    context.lineTo(14, height - 14);
    context.lineTo(14 + length * size, height - 14);
    context.lineTo(14 + length * size, height - 19);
    context.stroke();
    context.font = "12px system-ui, sans-serif";
    const number = Number(length.toPrecision(2));
    context.fillText(this.facts.metric ? `${number} m` : `${number} unit${number === 1 ? "" : "s"}, scale not known`, 14, height - 24);
  }

  nearest(x, y) {
    const distances = this.places.map(([a, b]) => Math.hypot(a - x, b - y));
    const best = distances.indexOf(Math.min(...distances));
    return distances[best] < NEAR_CAMERA_PX ? this.facts.cameras[best] : null;
  }

  press(event) {
    if (this.pointers.size === 0) this.travelled = 0;
    this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    this.canvas.setPointerCapture(event.pointerId);
  }

  move(event) {
    const now = [event.offsetX, event.offsetY];
    const before = this.pointers.get(event.pointerId);
    if (!before) {
      this.point(...now);
      return;
    }
    this.pointers.set(event.pointerId, now);
    const step = [now[0] - before[0], now[1] - before[1]];
    this.travelled += Math.hypot(...step);
    if (this.pointers.size === 1) {
      this.turn(-step[0] * 0.008, step[1] * 0.008);
      return;
    }
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)[1];
    const spread = (place) => Math.max(Math.hypot(place[0] - other[0], place[1] - other[1]), 1);
    this.scale(spread(now) / spread(before));
  }

  release(event) {
    if (!this.pointers.delete(event.pointerId) || this.travelled > 6) return;
    const camera = this.nearest(event.offsetX, event.offsetY);
    if (camera) this.onPick(camera.name);
  }

  point(x, y) {
    const camera = this.nearest(x, y);
    this.label.hidden = !camera;
    if (camera) {
      this.label.textContent = camera.name;
      this.label.style.transform = `translate(${x + 12}px, ${y - 24}px)`;
    }
    if (camera !== this.pointed) {
      this.pointed = camera;
      this.draw();
    }
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.max(-1.55, Math.min(1.55, this.pitch + pitch));
    this.draw();
  }

  scale(factor) {
    this.zoom = Math.max(0.2, Math.min(40, this.zoom * factor));
    this.draw();
  }

  key(event) {
    const actions = {
      ArrowLeft: () => this.turn(-0.1, 0),
      ArrowRight: () => this.turn(0.1, 0),
      ArrowUp: () => this.turn(0, 0.1),
      ArrowDown: () => this.turn(0, -0.1),
      "+": () => this.scale(1.15),
      "-": () => this.scale(1 / 1.15),
    };
    if (!actions[event.key]) return;
    event.preventDefault();
    actions[event.key]();
  }
}
