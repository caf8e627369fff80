// The page: its controls, its read-out, and when to draw.

const MAX_PIXEL_RATIO = 2;
const SLOW_FRAME_MS = 60;
const COARSEST = 0.35;
const REST_MS = 200;
const DRAWING_SHARE = 4; // while parts come, this many times as long goes by between two pictures as one takes
const SURFACE_ALPHA = 0.5;
const FIT_WIDTH_PX = 240;
const HIDDEN_BEHIND = 1.05; // a mark that lies this much deeper than what is seen there is hidden by it

const modalityButtons = () => document.querySelectorAll("button[data-modality]");
const json = (id) => JSON.parse(element(id).textContent);

class Page {
  constructor(facts) {
    this.facts = facts;
    this.modalities = modalitiesOf(facts);
    this.shown = this.modalities[facts.modalities[0].name];
    this.range = [0, 1];
    this.isotherm = [1, 0];
    this.canvas = element("view");
    this.palettes = palettesOf(facts);
    this.renderer = new Renderer(this.canvas, facts, this.palettes);
    this.startWorker();
    this.viewpoint = new Viewpoint(facts.world, () => this.viewChanged());
    this.version = 0;
    this.resolution = 1;
    this.lastMove = -Infinity;
    this.lastFrame = 0;
    this.overMs = 0;
    this.inMotion = false;
    this.hover = null;
    this.hidden = new Set();
    this.memory = new Memory(element("facts").textContent);
    const scales = Object.fromEntries(Object.values(this.modalities).map(({ name, scale }) => [name, scale]));
    this.spots = new Spots(scales, this.memory, () => this.spotsChanged());
    const { palette } = this.memory.kept;
    if (typeof palette === "string" && Object.hasOwn(this.palettes, palette)) element("palette").value = palette;
    this.connectControls();
    this.listMarks();
    this.navigation = new Navigation(this.canvas, this.viewpoint, {
      onHover: (x, y) => this.hoverAt(x, y),
      onLeave: () => this.hoverAt(null),
      onTap: (x, y) => this.placeSpot(x, y),
      onMove: () => this.moving(),
      onHome: () => this.jumpTo(this.start),
    });
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.resize();
    const metric = facts.modalities.find((each) => each.metric);
    if (metric) this.setScaled(this.modalities[metric.name]);
    this.start = element("camera").selectedIndex;
    this.jumpTo(this.start);
  }

  startWorker() {
    const source = new Blob([element("worker").textContent], { type: "text/javascript" });
    const address = URL.createObjectURL(source);
    this.worker = new Worker(address);
    this.sorting = false;
    this.reading = null;
    this.waiting = null;
    this.clicks = [];
    this.round = 0;
    this.held = [];
    this.partsSent = 0;
    this.partsShown = 0;
    this.drawnAt = -Infinity;
    this.drawMs = 0;
    const { model, modalities, readable, areas, photos } = this.facts;
    this.worker.postMessage({ open: { ...model, modalities, readable, photos, areas: areas?.areas } });
    this.worker.onmessage = ({ data }) => {
      if (data.failure) showFailure(data.failure);
      else if (data.depths) this.takeAreas(data.depths);
      else if (data.part) this.partDecoded(data.part);
      else if (data.order) this.sorted(data);
      else if (data.id !== undefined) this.seen(data);
      else this.answered(data);
    };
  }

  // Until the first part is drawn, the others wait: decoding them would keep it back.
  addPart(text) {
    if (this.held.length || this.partsSent === 1 && this.sortedVersion === undefined) this.held.push(text);
    else this.sendPart(text);
  }

  sendPart(text) {
    this.partsSent++;
    this.worker.postMessage({ part: text });
  }

  partDecoded(part) {
    this.renderer.add(part);
    this.partsShown++;
    const { parts } = this.facts.model;
    element("progress").hidden = this.complete;
    element("progress").textContent = `Loading details: ${Math.round((100 * this.partsShown) / parts)} %`;
    this.canvas.dataset.settled = "false";
    clearTimeout(this.refinement);
    const wait = this.complete ? 0 : this.drawnAt + DRAWING_SHARE * this.drawMs - performance.now();
    this.refinement = setTimeout(() => this.refine(), Math.max(0, wait));
  }

  // Draw with the parts that have come since the last picture.
  refine() {
    this.version++;
    this.sortIfIdle();
  }

  takeAreas(depths) {
    const { areas } = this.facts;
    this.areas = new Areas(areas, depths, this.modalities[areas.modality].scale);
    this.drawsAreas = this.renderer.addAreas(this.areas);
    element("uncorrected").hidden = this.drawsAreas;
  }

  // The areas in what a camera sees of a modality; null where there are none.
  areasFor(modality, camera) {
    return this.areas?.modality === modality ? this.areas.seenFrom(camera) : null;
  }

  // Those that a picture must be corrected in.
  drawnAreas(modality, camera) {
    const areas = this.drawsAreas ? this.areasFor(modality, camera) : null;
    return areas?.areInPicture ? areas : null;
  }

  get complete() {
    return this.partsShown === this.facts.model.parts;
  }

  connectControls() {
    for (const button of modalityButtons()) button.addEventListener("click", () => this.show(button.dataset.modality));
    element("palette").addEventListener("change", () => {
      this.memory.keep({ palette: element("palette").value });
      this.drawScale();
    });
    element("clear-spots").addEventListener("click", () => this.spots.clear());
    element("save").addEventListener("click", () => this.savePicture());
    for (const id of ["photo", "photo-large"]) element(id).addEventListener("click", () => this.enlargePhoto(id === "photo"));
    addEventListener("keydown", (event) => { if (event.key === "Escape") this.enlargePhoto(false); });
    document.addEventListener("DOMContentLoaded", () => this.showPhoto());
    this.rangeControl = new RangeControl((low, high) => this.setRange(low, high));
    element("fit").addEventListener("click", () => this.fit());
    element("whole").addEventListener("click", () => this.setRange(this.scaled.scale.min, this.scaled.scale.max));
    this.isothermControl = new IsothermControl(() => this.readIsotherm(), this.facts.air);
    const cameras = element("camera");
    cameras.addEventListener("change", () => this.jumpTo(cameras.selectedIndex));
    element("previous").addEventListener("click", () => this.jumpTo(cameras.selectedIndex - 1));
    element("next").addEventListener("click", () => this.jumpTo(cameras.selectedIndex + 1));
    element("home").addEventListener("click", () => this.jumpTo(this.start));
    element("back").addEventListener("click", () => this.jumpTo(cameras.selectedIndex));
    this.canvas.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" || event.repeat || isShortcut(event)) return;
      this.placeSpot(this.canvas.clientWidth / 2, this.canvas.clientHeight / 2);
      event.preventDefault();
    });
    this.canvas.addEventListener("webglcontextlost", () => showFailure("The graphics driver stopped: reload the page."));
  }

  jumpTo(index) {
    const cameras = element("camera");
    cameras.selectedIndex = (index + cameras.length) % cameras.length;
    this.viewpoint.jumpTo(this.facts.cameras[cameras.selectedIndex]);
    this.showPhoto();
  }

  // The photo of the view that is chosen; they come last in the file.
  showPhoto() {
    const source = document.querySelector(`script.photo[data-camera="${element("camera").selectedIndex}"]`)?.textContent;
    element("photo").hidden = !source;
    if (source) element("photo").firstChild.src = source;
    if (!element("photo-large").hidden) this.enlargePhoto(Boolean(source));
  }

  // Over the picture, until it is clicked.
  enlargePhoto(large) {
    element("photo-large").hidden = !large;
    if (large) element("photo-large").src = element("photo").firstChild.src;
  }

  savePicture() {
    const camera = this.viewpoint.cameraFor(this.canvas.width, this.canvas.height);
    this.renderer.draw(camera, this.look(camera));
    const { selectedOptions } = element("camera");
    saveImage(composed(this.canvas, element("marks"), element("scales")), `${document.title} ${selectedOptions[0].text}.png`);
  }

  show(name) {
    this.shown = this.modalities[name];
    for (const button of modalityButtons()) button.setAttribute("aria-pressed", String(button.dataset.modality === name));
    if (this.shown.metric && this.shown !== this.scaled) this.setScaled(this.shown);
    else this.drawScale();
  }

  // The modality that the palette's range and the isotherm apply to.
  setScaled(modality) {
    this.scaled = modality;
    element("scale-title").textContent = scaleTitle(modality);
    this.isothermControl.reset(modality.range, modality.scale);
    this.setRange(...keptRange(this.memory.kept.ranges?.[modality.name]) ?? modality.range);
  }

  // The modality whose values are read: the one that is shown if it has one channel.
  get read() {
    const { readable } = this.facts;
    return this.modalities[readable.includes(this.shown.name) ? this.shown.name : readable[0]];
  }

  // Numbers as on the page.
  setRange(low, high) {
    this.range = [low, high];
    this.memory.keep({ ranges: { ...this.memory.kept.ranges, [this.scaled.name]: this.range } });
    this.rangeControl.show(this.range, this.scaled.scale);
    this.readIsotherm();
    this.drawScale();
  }

  // The range of what is seen now, but for half a percent at each end, widened to round numbers.
  fit() {
    const { width, height } = this.canvas;
    const share = Math.min(1, FIT_WIDTH_PX / width);
    const camera = this.viewpoint.cameraFor(...[width, height].map((side) => Math.max(1, Math.round(side * share))));
    const { name, scale } = this.scaled;
    const areas = this.drawnAreas(name, camera);
    const pixels = this.renderer.seenPixels(camera, { modality: name, areas }, SURFACE_ALPHA);
    const seen = pixels.map(([value, at, depth]) => areas?.corrected(value, at, depth) ?? value).sort((a, b) => a - b);
    this.requestFrame();
    if (!seen.length) return;
    const [low, high] = [0.005, 0.995].map((part) => scale.shown(seen[Math.round(part * (seen.length - 1))]));
    const step = Math.max(high > low ? tickStep(low, high, 20) : 0, 10 ** -scale.decimals);
    const first = Math.floor(low / step + 1e-6);
    this.setRange(first * step, Math.max(Math.ceil(high / step - 1e-6), first + 1) * step);
  }

  readIsotherm() {
    const band = this.isothermControl.band;
    this.isotherm = band ? band.map((number) => this.scaled.scale.normalised(number)) : [1, 0];
    this.requestFrame();
  }

  drawScale() {
    this.bar?.remove();
    this.bar = null;
    this.requestFrame();
    if (!this.shown.metric) return;
    const [low, high] = this.range;
    const colours = this.palettes[element("palette").value];
    this.bar = new ScaleBar(element("scales"));
    this.bar.show({ low, high, unit: this.scaled.scale.unit, colours }, barHeight(this.canvas.clientHeight));
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((n) => Math.max(1, Math.round(n * ratio)));
    if (width === this.canvas.width && height === this.canvas.height) return;
    [this.canvas.width, this.canvas.height] = [width, height];
    if (!this.viewpoint.frame) return;
    this.drawScale();
    this.viewChanged();
  }

  // --- when to draw ---

  moving() {
    this.lastMove = performance.now();
  }

  viewChanged() {
    this.version++;
    this.hover = null;
    element("tip").hidden = true;
    this.sortIfIdle();
    this.requestFrame();
  }

  sortIfIdle() {
    if (this.sorting || this.sortedVersion === this.version || !this.partsShown) return;
    this.sorting = true;
    const { rotation, translation } = this.viewpoint.cameraFor(this.canvas.width, this.canvas.height);
    this.worker.postMessage({ sort: { rotation, translation, version: this.version } });
  }

  sorted({ order, version }) {
    element("status").hidden = !element("status").dataset.failed;
    this.held.splice(0).forEach((text) => this.sendPart(text));
    this.renderer.setOrder(order);
    this.sorting = false;
    this.sortedVersion = version;
    this.sortIfIdle();
    this.requestFrame();
  }

  requestFrame() {
    this.canvas.dataset.settled = "false";
    if (this.frameRequested) return;
    this.frameRequested = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  // While the view moves, a frame that took long makes the next ones coarser; at rest the image is sharp.
  frame(now) {
    this.frameRequested = false;
    const inMotion = this.navigation.dragging || performance.now() - this.lastMove < REST_MS;
    const elapsed = now - this.lastFrame - this.overMs; // marks are not drawn faster at a coarser resolution
    const wasInMotion = this.inMotion;
    this.lastFrame = now;
    this.inMotion = inMotion;
    if (inMotion && wasInMotion) {
      if (elapsed > SLOW_FRAME_MS) this.resolution = Math.max(COARSEST, this.resolution * 0.75);
      else if (elapsed < SLOW_FRAME_MS / 3) this.resolution = Math.min(1, this.resolution * 1.1);
    }
    const share = inMotion ? this.resolution : 1;
    const [width, height] = [this.canvas.width, this.canvas.height].map((n) => Math.max(1, Math.round(n * share)));
    const camera = this.viewpoint.cameraFor(width, height);
    this.renderer.draw(camera, this.look(camera));
    if (!this.complete) this.timeDrawing();
    const drawn = performance.now();
    this.drawMarks();
    this.overMs = performance.now() - drawn;
    if (inMotion) {
      clearTimeout(this.rest);
      this.rest = setTimeout(() => this.requestFrame(), REST_MS);
    } else if (this.complete && this.sortedVersion === this.version) {
      this.canvas.dataset.settled = "true";
      this.lookForMarks();
    }
  }

  timeDrawing() {
    const begun = performance.now();
    this.renderer.finish();
    this.drawnAt = performance.now();
    this.drawMs = this.drawnAt - begun;
  }

  look(camera) {
    const { name, metric, scale } = this.shown;
    return {
      modality: name,
      areas: this.drawnAreas(name, camera),
      palette: metric ? element("palette").value : null,
      range: this.range.map((number) => scale.normalised(number)),
      isotherm: this.isotherm,
    };
  }

  // --- the read-out ---

  hoverAt(x, y) {
    this.hover = x === null ? null : [x, y];
    if (x === null) element("tip").hidden = true;
    else this.ask(x, y, (reading) => this.showTip(reading, x, y));
  }

  placeSpot(x, y) {
    this.hoverAt(null);
    this.ask(x, y, (reading, camera, pixel) => {
      this.showReading(reading);
      const seen = reading.alpha >= SURFACE_ALPHA;
      if (!seen) return;
      this.viewpoint.holdAt(reading.depth);
      this.spots.add(pointAt(camera, pixel, reading.depth), reading);
    }, true);
  }

  // One question at a time: while one is being answered, all clicks wait, and of what the pointer shows the newest.
  ask(x, y, then, isClick = false) {
    if (!this.read) return;
    const { width, height, clientWidth, clientHeight } = this.canvas;
    const pixel = [Math.floor((x * width) / clientWidth) + 0.5, Math.floor((y * height) / clientHeight) + 0.5];
    const question = { camera: this.viewpoint.cameraFor(width, height), pixel, modality: this.read.name, then };
    if (isClick) this.clicks.push(question);
    else this.waiting = question;
    this.askIfIdle();
  }

  askIfIdle() {
    if (this.reading) return;
    this.reading = this.clicks.shift() ?? this.waiting;
    if (!this.reading) return;
    if (this.reading === this.waiting) this.waiting = null;
    const { camera, pixel, modality } = this.reading;
    this.worker.postMessage({ read: { camera, x: pixel[0], y: pixel[1], modality } });
  }

  answered({ reading }) {
    const { then, camera, pixel } = this.reading;
    this.reading = null;
    const areas = this.areasFor(reading.modality, camera);
    const value = areas?.corrected(reading.value, pixel, reading.depth) ?? reading.value;
    then({ ...reading, recorded: reading.value, value }, camera, pixel);
    this.askIfIdle();
  }

  textOf({ modality, value }) {
    const { scale } = this.modalities[modality];
    return scale.text(scale.shown(value));
  }

  showTip(reading, x, y) {
    const tip = element("tip");
    tip.hidden = this.hover === null;
    tip.textContent = reading.alpha < SURFACE_ALPHA ? "no surface" : this.textOf(reading);
    placeTip(tip, x, y, this.canvas.clientWidth);
    this.showReading(reading);
  }

  showReading(reading) {
    const seen = reading.alpha >= SURFACE_ALPHA;
    const { label, metric, scale } = this.modalities[reading.modality];
    const [value, recorded] = [reading.value, reading.recorded].map((each) => scale.shown(each));
    if (this.facts.readable.length > 1) element("reading-of").textContent = `: ${label}`;
    element("value").textContent = seen ? this.textOf(reading) : "–";
    element("depth").textContent = seen ? `depth ${reading.depth.toFixed(2)} ${this.facts.length_unit}` : "no surface here";
    element("clipped").hidden = !seen || !metric || (recorded > scale.min && recorded < scale.max);
    element("value").dataset.value = seen ? String(value) : "";
    element("value").dataset.depth = seen ? String(reading.depth) : "";
  }

  // --- marks ---

  listMarks() {
    if (!this.facts.marks.length) return;
    element("show-marks").addEventListener("change", () => this.drawMarks());
    element("mark-list").append(...this.facts.marks.map((mark) => {
      const row = document.createElement("details");
      const summary = document.createElement("summary");
      const difference = mark.reference ? "reference" : mark.difference;
      for (const [tag, text, name] of [["b", mark.name, ""], ["span", difference, "muted"], ["span", mark.value, ""]]) {
        const part = document.createElement(tag);
        part.textContent = text;
        part.className = name;
        summary.append(part);
      }
      const lines = document.createElement("div");
      lines.className = "lines muted";
      lines.textContent = [mark.severity && `Severity ${mark.severity}`, mark.problem, ...mark.lines, mark.note].filter(Boolean).join("\n");
      row.append(summary, lines);
      if (mark.profile.length) row.append(profileChart(mark));
      return row;
    }));
  }

  // Those of the run, and the reader's spots.
  get marks() {
    return [...this.facts.marks, ...this.spots.marks];
  }

  spotsChanged() {
    this.hidden = new Set([...this.hidden].filter((index) => index < this.facts.marks.length));
    this.lookedVersion = null;
    this.requestFrame();
  }

  drawMarks() {
    const over = element("marks");
    over.replaceChildren();
    const first = element("show-marks")?.checked === false ? this.facts.marks.length : 0;
    const { clientWidth, clientHeight } = this.canvas;
    const camera = this.viewpoint.cameraFor(clientWidth, clientHeight);
    const place = (point) => point && project(camera, point);
    const labels = new Labels(over, clientWidth, clientHeight);
    this.marks.forEach((mark, index) => {
      const corners = mark.points.map(place);
      if (index < first || this.hidden.has(index) || corners.includes(null)) return;
      const { name: short, label, closed } = mark;
      if (mark.kind === "spot") drawMark(labels, ...corners[0], [label, short]);
      else drawOutline(labels, (...at) => at, { corners, closed, label, short, low: place(mark.lowAt), high: place(mark.highAt) });
    });
  }

  // Ask, once the view rests, which marks lie behind something.
  lookForMarks() {
    if (this.lookedVersion === this.version || !this.read) return;
    this.lookedVersion = this.version;
    this.round++;
    this.lookForMark(0);
  }

  // One at a time, so that clicks and a new view need not wait for all.
  lookForMark(first) {
    const { clientWidth, clientHeight } = this.canvas;
    const camera = this.viewpoint.cameraFor(clientWidth, clientHeight);
    const { marks } = this;
    for (let index = first; index < marks.length; index++) {
      const place = project(camera, marks[index].points[0]);
      if (!place) continue;
      const id = [index, this.version, this.round];
      this.worker.postMessage({ read: { camera, x: place[0], y: place[1], modality: this.read.name, id } });
      return;
    }
  }

  seen({ reading, id: [index, version, round] }) {
    if (version !== this.version || round !== this.round || index >= this.marks.length) return;
    this.lookForMark(index + 1);
    const { position, rotation } = this.viewpoint;
    const depth = dot(rotation.slice(6, 9), subtract(this.marks[index].points[0], position));
    if (reading.alpha >= SURFACE_ALPHA && depth > HIDDEN_BEHIND * reading.depth) this.hidden.add(index);
    else this.hidden.delete(index);
    this.drawMarks();
  }
}

// Two rising numbers; null for anything else.
const keptRange = (range) =>
  (Array.isArray(range) && range.length === 2 && range.every(Number.isFinite) && range[0] < range[1] ? range : null);

function showFailure(message) {
  element("status").dataset.failed = "true";
  element("status").hidden = false;
  element("status").textContent = message;
}

function start() {
  try {
    if (!("DecompressionStream" in window)) {
      throw new Error("This browser is too old for this page: use Chrome 80, Firefox 113, Safari 16.4 or later.");
    }
    const facts = json("facts");
    const page = new Page(facts);
    let parts = 0;
    const take = (text) => {
      page.addPart(text);
      parts++;
    };
    readParts(take, () => {
      if (parts < facts.model.parts) showFailure("A part of this file is missing: copy or download it again.");
    });
  } catch (error) {
    showFailure(error.message);
  }
}

start();
