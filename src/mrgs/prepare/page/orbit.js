// Cameras and points in 3D on plain canvases, seen from a viewpoint of navigation.js.

const CAMERA_COLOR = "#1f5fa8";
const HELD_COLOR = "#c2560a";
const INK = "#1d2126";
const NEAR_CAMERA_PX = 14;

class WorldView {
  constructor(canvas, facts, start) {
    this.canvas = canvas;
    this.facts = facts;
    this.start = start;
    this.viewpoint = new Viewpoint(facts.world, () => this.draw());
    this.viewpoint.jumpTo(start);
    new ResizeObserver(() => this.draw()).observe(canvas);
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
    const camera = this.viewpoint.cameraFor(width, height);
    facts.places.forEach((point, index) => {
      const place = project(camera, point);
      if (!place) return;
      context.fillStyle = facts.fills[index];
      context.fillRect(place[0] - 1, place[1] - 1, 2, 2);
    });
    this.apexes = facts.cameras.map((each) => this.drawCamera(context, camera, each));
    this.drawScale(context, camera.fx / this.viewpoint.distance, width, height);
  }

  // The pyramid of a camera; returns where its tip is, null if part of it is behind the viewer.
  drawCamera(context, seenFrom, camera) {
    const corners = [[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]];
    const points = [camera.position, ...corners.map((corner) => pointAt(camera, corner, this.facts.frustum))];
    const [apex, ...rim] = points.map((point) => project(seenFrom, point));
    if (!apex || rim.includes(null)) return null;
    context.strokeStyle = camera.heldOut ? HELD_COLOR : CAMERA_COLOR;
    context.lineWidth = camera === this.pointed ? 2.5 : 1;
    context.beginPath();
    for (const corner of rim) {
      context.moveTo(...apex);
      context.lineTo(...corner);
    }
    rim.forEach((corner, i) => (i ? context.lineTo(...corner) : context.moveTo(...corner)));
    context.closePath();
    context.stroke();
    return apex;
  }

  // A round length at the depth that is orbited.
  drawScale(context, size, width, height) {
    const most = (0.2 * width) / size;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = [5, 2, 1].map((factor) => factor * power).find((value) => value <= most);
    context.strokeStyle = context.fillStyle = INK;
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
}

// The view that is turned; a click on a camera picks it.
class Orbit extends WorldView {
  constructor(canvas, label, facts, onPick) {
    super(canvas, facts, facts.views.orbit);
    this.label = label;
    new Navigation(canvas, this.viewpoint, {
      onHover: (x, y) => this.point(x, y),
      onLeave: () => { label.hidden = true; },
      onTap: (x, y) => { if (this.nearest(x, y)) onPick(this.nearest(x, y).name); },
      onMove: () => { label.hidden = true; },
      onHome: () => this.viewpoint.jumpTo(this.start),
    });
  }

  nearest(x, y) {
    const distances = this.apexes.map((apex) => (apex ? Math.hypot(apex[0] - x, apex[1] - y) : Infinity));
    const best = distances.indexOf(Math.min(...distances));
    return distances[best] < NEAR_CAMERA_PX ? this.facts.cameras[best] : null;
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
}

function setUpWorld(facts) {
  const numbers = new Uint16Array(fromBase64(facts.points).buffer);
  const colors = fromBase64(facts.colors);
  const rows = Array.from({ length: numbers.length / 3 }, (_, row) => [3 * row, 3 * row + 1, 3 * row + 2]);
  facts.places = rows.map((row) => row.map((index, axis) => facts.low[axis] + facts.step * numbers[index]));
  facts.fills = rows.map((row) => `rgb(${row.map((index) => colors[index]).join(" ")})`);
  new Orbit(document.getElementById("orbit-canvas"), document.getElementById("orbit-name"), facts, showView);
  for (const name of ["above", "side"]) new WorldView(document.getElementById(`from-${name}`), facts, facts.views[name]);
}
