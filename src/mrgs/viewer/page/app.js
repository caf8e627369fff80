// The viewer's page. The server draws pictures; where the camera is, and all that lies over the picture, is the page's.

const REST_MS = 160;
const STILL_MS = 500;
const MAX_PIXEL_RATIO = 3;
const FRUSTUM_DEPTH = 0.06; // of the distance between the camera and what it turns about

class Connection {
  constructor(handlers, onPicture, onClose) {
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/socket`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onclose = onClose;
    this.socket.onmessage = ({ data }) => {
      if (data instanceof ArrayBuffer) return onPicture(...splitPicture(data));
      const { type, ...facts } = JSON.parse(data);
      return handlers[type](facts);
    };
  }

  send(type, facts = {}) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ type, ...facts }));
  }
}

// Length of the facts, the facts, the picture.
function splitPicture(data) {
  const length = new DataView(data).getUint32(0, true);
  const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
  return [facts, new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" })];
}

// Asks for pictures: soon while the camera moves, sharp once it rests, at full resolution if it goes on resting. Only
// visible pages are called back for a frame, so a hidden one asks for nothing.
class Pictures {
  constructor(connection, canvas, longestSide, cameraFor, onShown) {
    this.connection = connection;
    this.longestSide = longestSide;
    this.canvas = canvas;
    this.cameraFor = cameraFor;
    this.onShown = onShown;
    this.asked = null;
    this.due = null;
    this.count = 0;
    this.shown = null;
  }

  moving() {
    this.ask("moving");
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.ask("resting"), REST_MS);
  }

  ask(effort) {
    this.canvas.dataset.settled = "false";
    this.due = effort;
    if (this.frame) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = null;
      this.askIfFree();
    });
  }

  askIfFree() {
    if (!this.due || (this.asked && this.asked.effort === "moving")) return;
    const camera = this.cameraFor(...this.size());
    this.asked = { number: ++this.count, effort: this.due, camera };
    this.due = null;
    const { rotation, position, fx, fy, cx, cy, width, height } = camera;
    this.connection.send("look", {
      number: this.count, effort: this.asked.effort, rotation, position, focal: [fx, fy], centre: [cx, cy], width, height,
    });
  }

  size() {
    const { clientWidth, clientHeight } = this.canvas;
    const ratio = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO, this.longestSide / Math.max(clientWidth, clientHeight, 1));
    return [clientWidth, clientHeight].map((side) => Math.max(1, Math.floor(side * ratio)));
  }

  // A picture that could not be drawn is not waited for.
  undrawn({ number }) {
    if (this.asked?.number !== number) return;
    this.asked = null;
    this.askIfFree();
  }

  async received(facts, blob) {
    const asked = this.asked;
    if (!asked || facts.number !== asked.number) return; // overtaken by a newer place
    this.asked = null;
    this.askIfFree();
    const bitmap = await createImageBitmap(blob);
    if (this.shown && facts.number < this.shown.facts.number) return;
    this.shown = { facts, camera: asked.camera };
    [this.canvas.width, this.canvas.height] = [bitmap.width, bitmap.height];
    this.canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
    this.onShown(facts, asked.camera);
    this.refine(facts);
  }

  refine({ effort, full }) {
    if (effort === "moving" || this.due || this.asked) return;
    if (full) this.canvas.dataset.settled = "true";
    else {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.ask("still"), STILL_MS);
    }
  }
}

class Page {
  constructor() {
    this.canvas = element("view");
    this.bars = [];
    this.hovered = null;
    const handlers = {
      hello: (facts) => this.begin(facts),
      changed: () => this.pictures.ask("resting"),
      undrawn: (facts) => this.pictures.undrawn(facts),
      note: ({ text }) => this.noted(text),
      hover: ({ text }) => this.showTip(text),
      point: ({ of }) => this.showPoint(of),
      measuring: () => this.measuring(true),
      marks: (facts) => this.marksChanged(facts),
      kept: (facts) => this.keptPart.show(facts),
      refused: ({ mark, text }) => { if (mark === "keep" || !this.marks.refuse(mark, text)) this.sayOf(mark === "keep", text, true); },
      limits: ({ of }) => this.limitsChanged(of),
      status: ({ text, failed }) => this.say(text, failed),
      keyframes: ({ text }) => { element("keyframes").textContent = text; },
    };
    this.connection = new Connection(handlers, (facts, blob) => this.pictures.received(facts, blob), () => this.ended());
  }

  begin(facts) {
    this.facts = facts;
    this.modalities = modalitiesOf(facts);
    for (const modality of Object.values(this.modalities)) modality.follow = false;
    this.palettes = palettesOf(facts);
    element("known").textContent = facts.known;
    element("note").textContent = facts.note;
    this.viewpoint = new Viewpoint(facts.start.world, () => this.moved());
    this.pictures = new Pictures(
      this.connection, this.canvas, facts.longest_side_px,
      (width, height) => this.viewpoint.cameraFor(width, height),
      (shown, camera) => this.shown(shown, camera),
    );
    this.fillControls();
    this.connectControls();
    this.navigation = new Navigation(this.canvas, this.viewpoint, {
      onHover: (x, y) => this.hoverAt(x, y),
      onLeave: () => this.hoverAt(null),
      onTap: (x, y) => this.connection.send("read", this.shareOf(x, y)),
      onMove: () => {},
      onHome: () => this.home(),
    });
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    this.setMode(0);
    this.ready = true;
    this.home();
    new ResizeObserver(() => this.pictures.moving()).observe(this.canvas);
  }

  fillControls() {
    const { modes, views, choices, marks, keeps } = this.facts;
    const plain = modes.map((mode, index) => ({ ...mode, index })).filter((mode) => !mode.compares);
    for (const { label, index } of plain) {
      const button = document.createElement("button");
      button.textContent = label;
      button.dataset.mode = index;
      button.addEventListener("click", () => this.choose(index));
      element("modes").append(button);
    }
    modes.forEach(({ label, compares }, index) => { if (compares) element("compare").add(new Option(label, index)); });
    for (const name of choices) element("palette").add(new Option(name === "grey" ? "grey (white-hot)" : name, name));
    element("palette").value = this.facts.palette;
    for (const { name } of views) element("photo").add(new Option(name));
    element("photo-section").hidden = views.length === 0;
    element("measure-section").hidden = !marks;
    element("spot-key").hidden = !marks;
    element("keep-section").hidden = !keeps;
    if (marks) this.canvas.setAttribute("aria-label", `${this.canvas.getAttribute("aria-label")}, s marks it as a spot`);
  }

  connectControls() {
    const pressed = (id, then) => element(id).addEventListener("click", then);
    const changed = (ids, then) => ids.forEach((id) => element(id).addEventListener("change", then));
    const send = (type) => () => this.connection.send(type);
    pressed("home", () => this.home());
    changed(["compare"], () => this.choose(element("compare").value === "" ? 0 : Number(element("compare").value)));
    element("share").addEventListener("input", () => this.sendChoices());
    changed(["palette", "show-marks"], () => this.sendChoices());
    this.range = new RangeControl((low, high) => this.setRange(low, high));
    this.isotherm = new IsothermControl(() => { if (this.ready) this.sendChoices(); }, this.facts.air);
    changed(["follow"], () => this.setFollow(element("follow").checked));
    pressed("fit", () => { this.setFollow(false); this.connection.send("fit"); });
    pressed("whole", () => this.setRange(this.scaled.scale.min, this.scaled.scale.max));
    pressed("undo", send("undo"));
    pressed("no-reference", () => this.connection.send("refer_to", { mark: null }));
    this.drawing = new MarkDrawing((kind, corners, keeps) => {
      const points = corners.map((corner) => Object.values(this.shareOf(...corner)));
      this.connection.send(keeps ? "keep" : "add_mark", { kind, points });
    }, (text, keeps) => this.sayOf(keeps, text, false));
    this.keptPart = new KeptPart((sides) => this.connection.send("keep", { kind: "sides", sides }));
    pressed("keep-undo", () => this.connection.send("keep", { kind: "undo" }));
    pressed("keep-all", () => this.connection.send("keep", { kind: "all" }));
    this.marks = new MarkList(element("mark-list"), this.facts.mark_limits, (type, facts) => this.connection.send(type, facts));
    pressed("screenshot", send("screenshot"));
    pressed("add-keyframe", send("add_keyframe"));
    pressed("clear-path", send("clear_path"));
    pressed("video", () => this.sendPath("video"));
    pressed("save-path", () => this.sendPath("save_path"));
    const photo = element("photo");
    changed(["photo"], () => this.goToPhoto(photo.selectedIndex));
    pressed("previous", () => this.goToPhoto(photo.selectedIndex - 1));
    pressed("next", () => this.goToPhoto(photo.selectedIndex + 1));
    changed(["show-cameras"], () => this.drawOver());
  }

  // --- the camera ---

  home() {
    this.viewpoint.jumpTo(this.facts.start.camera);
  }

  goToPhoto(index) {
    const { views } = this.facts;
    const chosen = (index + views.length) % views.length;
    element("photo").selectedIndex = chosen;
    this.connection.send("photo", { index: chosen });
    this.viewpoint.jumpTo(views[chosen]);
  }

  moved() {
    this.showTip("");
    this.pictures.moving();
  }

  // The middle of the picture, of its last part if it has several, without a pointer.
  key(event) {
    if (event.repeat || isShortcut(event)) return;
    const panes = this.pictures.shown?.facts.panes;
    if (!panes?.length) return;
    const [left, top, width, height] = panes[panes.length - 1].place;
    const [x, y] = [left + width / 2, top + height / 2];
    if (event.key === "Enter") this.connection.send("read", { x, y });
    else if (event.key.toLowerCase() === "s" && this.facts.marks) this.connection.send("add_mark", { kind: "spot", points: [[x, y]] });
    else return;
    event.preventDefault();
  }

  // --- choices ---

  choose(index) {
    this.setMode(index);
    this.sendChoices();
  }

  setMode(index) {
    const mode = this.facts.modes[index];
    this.mode = index;
    for (const button of element("modes").children) button.setAttribute("aria-pressed", String(Number(button.dataset.mode) === index));
    element("compare").value = mode.compares ? String(index) : "";
    element("share-row").hidden = !mode.slider;
    const first = this.facts.modalities.find((each) => each.metric);
    this.setScaled(mode.scaled ?? this.scaled?.name ?? first?.name);
    element("scale-section").hidden = !mode.palette;
    element("range-controls").hidden = element("isotherm-controls").hidden = !mode.scaled;
    element("scale-title").textContent = mode.scaled ? scaleTitle(this.scaled) : "Colours";
  }

  // The modality that the limits and the isotherm apply to.
  setScaled(name) {
    if (!name || this.scaled?.name === name) return;
    this.scaled = this.modalities[name];
    this.isotherm.reset(this.scaled.range, this.scaled.scale);
    this.showRange();
  }

  showRange() {
    const { scale, range, follow } = this.scaled;
    this.range.show(range, scale);
    element("follow").checked = follow;
  }

  setRange(low, high) {
    this.scaled.range = [low, high];
    this.scaled.follow = false;
    this.showRange();
    this.sendChoices();
  }

  setFollow(follow) {
    this.scaled.follow = follow;
    this.showRange();
    this.sendChoices();
  }

  limitsChanged(limits) {
    for (const [name, range] of Object.entries(limits)) this.modalities[name].range = range;
    if (this.scaled) this.showRange();
  }

  sendChoices() {
    this.connection.send("choose", {
      mode: this.mode,
      palette: element("palette").value,
      scaled: this.scaled?.name ?? null,
      limits: this.scaled && !this.scaled.follow ? this.scaled.range : null,
      isotherm: this.scaled ? this.isotherm.band : null,
      share: Number(element("share").value) / 100,
      marks: element("show-marks").checked,
    });
  }

  sendPath(type) {
    const seconds = numberIn(element("seconds"), element("seconds-said"), "Seconds", this.facts.video_seconds);
    if (seconds !== null) this.connection.send(type, { seconds });
  }

  // --- what is shown ---

  shown(facts) {
    if (!this.hasEnded) element("status").hidden = true;
    if (facts.photo !== null && document.activeElement !== element("photo")) element("photo").selectedIndex = facts.photo;
    if (this.scaled?.follow) this.followPicture(facts.panes);
    this.drawOver();
    if (this.hovered) this.askHover();
  }

  followPicture(panes) {
    const scale = panes.map((pane) => pane.scale).find((each) => each && this.facts.choices.includes(each.palette));
    if (!scale) return;
    this.scaled.range = [scale.low, scale.high];
    this.showRange();
  }

  // Values are grey while they are being measured again.
  measuring(begun) {
    for (const id of ["measure-section", "marks"]) element(id).classList.toggle("measuring", begun);
  }

  marksChanged({ of: marks, proposals, notes, problems }) {
    this.measuring(false);
    const send = (type, facts) => this.connection.send(type, facts);
    this.marks.show(marks);
    element("proposal-list").replaceChildren(...proposals.map((mark) => proposalRow(mark, send)));
    element("proposals").hidden = !proposals.length;
    element("mark-notes").textContent = notes.join(" ");
    element("mark-problems").textContent = problems.join(" ");
    element("no-reference").hidden = !marks.some((mark) => mark.reference);
    if (!this.drawing.kind) this.sayOf(false, "", false);
  }

  noted(text) {
    element("note").textContent = text;
    this.pictures.ask("resting");
  }

  say(text, failed) {
    element("said").textContent = text;
    element("said").classList.toggle("warning", failed);
  }

  // Of what is kept, or of marks.
  sayOf(keeps, text, failed) {
    const said = element(keeps ? "keep-said" : "marks-said");
    said.textContent = text;
    said.classList.toggle("warning", failed);
  }

  ended() {
    this.hasEnded = true; // a picture may still be on its way to the screen
    element("status").hidden = false;
    element("status").textContent = "The connection to the viewer is lost. Reload the page; if that fails, start the viewer again, and open its new address.";
  }

  // --- over the picture ---

  drawOver() {
    const { shown } = this.pictures;
    if (!shown) return;
    const over = element("marks");
    over.replaceChildren();
    const { clientWidth, clientHeight } = this.canvas;
    this.bars.forEach((bar) => bar.remove());
    this.bars = [];
    for (const pane of shown.facts.panes) {
      const [left, top, width, height] = pane.place.map((share, i) => share * (i % 2 ? clientHeight : clientWidth));
      if (pane.free && pane.place[2] === 1 && element("show-cameras").checked) this.drawCameras(over, shown.camera);
      const own = shape("svg", { x: left, y: top, width, height }, over); // which clips what lies beside the pane
      const at = (x, y) => [x * width, y * height];
      const labels = new Labels(own, width, height);
      if (pane.title) labels.put(pane.title, 12, 24);
      for (const outline of pane.outlines) drawOutline(labels, at, outline);
      for (const [x, y, ...texts] of pane.marks) drawMark(labels, ...at(x, y), texts);
      if (pane.scale && height > 140) this.addBar(pane.scale, left, clientHeight - top - height, height);
    }
  }

  addBar(scale, left, bottom, height) {
    const bar = new ScaleBar(element("scales"));
    const colours = this.palettes[scale.palette];
    const unit = scale.unit === "normalised" ? "" : scale.unit;
    bar.show({ ...scale, unit, colours, signed: scale.palette === "error" }, barHeight(height));
    bar.root.style.left = `${left + 10}px`;
    bar.root.style.bottom = `${bottom + 10}px`;
    this.bars.push(bar);
  }

  // The captured cameras as small pyramids; a click goes there.
  drawCameras(over, seenFrom) {
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const scale = width / seenFrom.width;
    const own = { ...seenFrom, fx: scale * seenFrom.fx, fy: scale * seenFrom.fy, cx: scale * seenFrom.cx, cy: scale * seenFrom.cy };
    const depth = FRUSTUM_DEPTH * this.viewpoint.distance;
    this.facts.views.forEach((view, index) => {
      const corners = [[0, 0], [view.width, 0], [view.width, view.height], [0, view.height]];
      const places = [view.position, ...corners.map((corner) => pointAt(view, corner, depth))].map((point) => project(own, point));
      if (places.includes(null) || !places.some(([x, y]) => x > 0 && y > 0 && x < width && y < height)) return;
      const [apex, a, b, c, d] = places.map(([x, y]) => `${x.toFixed(1)} ${y.toFixed(1)}`);
      const outline = `M${a}L${b}L${c}L${d}Z M${apex}L${a} M${apex}L${b} M${apex}L${c} M${apex}L${d}`;
      const drawn = shape("path", { d: outline, class: "camera" }, over);
      shape("title", {}, drawn, view.name);
      drawn.addEventListener("click", () => this.goToPhoto(index));
    });
  }

  // --- the cursor ---

  shareOf(x, y) {
    const share = (part, whole) => Math.min(Math.max(part / whole, 0), 1);
    return { x: share(x, this.canvas.clientWidth), y: share(y, this.canvas.clientHeight) };
  }

  hoverAt(x, y) {
    this.hovered = x === null ? null : [x, y];
    if (this.hovered) this.askHover();
    else this.showTip("");
  }

  // One question at a time; the newest place is asked for after the answer.
  askHover() {
    if (this.asking) {
      this.askAgain = true;
      return;
    }
    this.asking = true;
    this.connection.send("hover", this.shareOf(...this.hovered));
  }

  showTip(text) {
    this.asking = false;
    if (this.askAgain && this.hovered) {
      this.askAgain = false;
      this.askHover();
    }
    if (text && !this.point) element("value").textContent = text;
    const tip = element("tip");
    tip.hidden = !text || !this.hovered;
    if (tip.hidden) return;
    tip.textContent = text;
    placeTip(tip, ...this.hovered, this.canvas.clientWidth);
  }

  showPoint(point) {
    this.point = point;
    element("value").textContent = point ? point.value || "–" : "–";
    element("deviation").textContent = point ? point.deviation : "Point at the picture; click to mark a place.";
    element("lines").textContent = point ? point.lines.join("\n") : "";
    if (point) this.say("", false);
  }
}

new Page();
