// How marks are drawn with the mouse or a finger, and how the panel lists them.

const FEWEST_CORNERS = { spot: 1, line: 2, box: 2, polygon: 3 };
const CLOSE_PX = 12;
const HINTS = {
  spot: "Click on the surface.",
  line: "Click where the line begins and at each corner, then Done; or drag it.",
  box: "Drag over the picture.",
  polygon: "Click on each corner, then Done or the first corner again.",
};

// One mark at a time: `onDrawn` receives its kind and its corners in pixels of the picture.
class MarkDrawing {
  constructor(onDrawn, say) {
    this.onDrawn = onDrawn;
    this.say = say;
    this.kind = null;
    this.selector = element("selector");
    this.over = this.selector.querySelector("svg");
    for (const button of this.buttons) button.addEventListener("click", () => this.arm(button.dataset.kind));
    element("finish").addEventListener("click", () => this.finish());
    element("cancel").addEventListener("click", () => this.arm(null));
    this.selector.addEventListener("pointerdown", (event) => this.press(event));
    this.selector.addEventListener("pointermove", (event) => this.move(event));
    this.selector.addEventListener("pointerup", (event) => this.release(event));
    addEventListener("keydown", (event) => {
      if (this.kind && event.key === "Escape") this.arm(null);
      if (this.kind && event.key === "Enter") this.finish();
    });
  }

  get buttons() { return document.querySelectorAll("#mark-tools button"); }

  arm(kind) {
    this.kind = kind === this.kind ? null : kind;
    this.corners = [];
    this.pressed = null;
    this.selector.hidden = element("drawing").hidden = !this.kind;
    for (const button of this.buttons) button.setAttribute("aria-pressed", String(button.dataset.kind === this.kind));
    this.say(this.kind ? HINTS[this.kind] : "");
    this.draw();
  }

  press(event) {
    this.pressed = [event.offsetX, event.offsetY];
    this.selector.setPointerCapture(event.pointerId);
  }

  move(event) {
    this.draw([event.offsetX, event.offsetY]);
  }

  release(event) {
    if (!this.pressed) return;
    const [from, to] = [this.pressed, [event.offsetX, event.offsetY]];
    this.pressed = null;
    const dragged = Math.hypot(to[0] - from[0], to[1] - from[1]) > TAP_PX;
    if (this.kind === "box" && !dragged) return;
    if (dragged && (this.kind === "box" || (this.kind === "line" && !this.corners.length))) this.corners = [from, to];
    else if (this.kind === "polygon" && this.closes(to)) return this.finish();
    else this.corners.push(to);
    const complete = this.kind === "spot" || this.kind === "box" || (this.kind === "line" && dragged);
    if (complete) this.finish();
    else this.draw();
  }

  closes([x, y]) {
    const [first] = this.corners;
    return this.corners.length >= FEWEST_CORNERS.polygon && Math.hypot(x - first[0], y - first[1]) < CLOSE_PX;
  }

  finish() {
    const { kind, corners } = this;
    if (corners.length < FEWEST_CORNERS[kind]) return;
    this.arm(null);
    this.onDrawn(kind, corners);
  }

  // What is drawn so far, up to where the pointer is.
  draw(pointer) {
    this.over.replaceChildren();
    element("finish").hidden = !this.kind || this.kind === "box" || this.corners.length < FEWEST_CORNERS[this.kind];
    if (!this.kind) return;
    const corners = [...this.corners];
    if (pointer && this.pressed && this.kind === "box") {
      const [[x0, y0], [x1, y1]] = [this.pressed, pointer];
      corners.push([x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]);
    } else if (pointer && this.pressed && this.kind === "line" && !corners.length) corners.push(this.pressed, pointer);
    else if (pointer && corners.length) corners.push(pointer);
    if (corners.length > 1) {
      for (const layer of ["under", "over"]) shape("path", { d: `M${corners.map((at) => at.join(" ")).join("L")}`, class: layer }, this.over);
    }
    for (const [cx, cy] of this.corners) shape("circle", { cx, cy, r: 4 }, this.over);
  }
}

// A mark in the panel: what was measured, and a form for what can be changed.
function markRow(mark, open, send) {
  const row = document.createElement("details");
  row.dataset.name = mark.name;
  row.open = open;
  const summary = document.createElement("summary");
  const texts = [["b", mark.name], ["span", mark.reference ? "reference" : mark.difference], ["span", mark.value]];
  summary.append(...texts.map(([tag, text]) => make(tag, text, tag === "span" && text !== mark.value ? "muted" : "")));
  const form = document.createElement("form");
  form.append(make("div", mark.lines.join("\n"), "lines muted"));
  if (mark.profile.length) form.append(profileChart(mark.profile));
  const fields = { name: field(form, "Name", "text", mark.name), note: field(form, "Note", "text", mark.note) };
  fields.severity = field(form, "Severity", "text", mark.severity, { maxLength: 40, placeholder: "class 1 to 3, or words" });
  fields.severity.setAttribute("list", "severities");
  if (mark.area) {
    fields.emissivity = field(form, "Emissivity", "number", mark.emissivity, { min: 0.01, max: 1, step: 0.01, placeholder: "as photos" });
    fields.reflected_c = field(form, "Reflected, °C", "number", mark.reflected_c, { step: "any", placeholder: "as photos" });
  }
  const number = (input) => (input && Number.isFinite(input.valueAsNumber) ? input.valueAsNumber : null);
  const save = () => send("change_mark", {
    mark: mark.name, name: fields.name.value, note: fields.note.value, severity: fields.severity.value,
    emissivity: number(fields.emissivity), reflected_c: number(fields.reflected_c),
  });
  for (const input of Object.values(fields)) input.addEventListener("change", () => form.reportValidity() && save());
  form.addEventListener("submit", (event) => event.preventDefault());
  const buttons = make("div", "", "row");
  buttons.append(button("Reference", () => send("refer_to", { mark: mark.name })), button("Delete", () => send("delete_mark", { mark: mark.name })));
  form.append(buttons);
  row.append(summary, form);
  return row;
}

// A proposal of the report, to be judged; its details are a tooltip.
function proposalRow(mark, send) {
  const row = make("div", "", "proposal");
  row.title = mark.lines.join("\n");
  const judge = (text, accept) => button(text, () => send("judge", { mark: mark.name, accept }));
  row.append(make("b", mark.name), make("span", mark.value), judge("Accept", true), judge("Drop", false));
  return row;
}

function make(tag, text, name) {
  const made = document.createElement(tag);
  made.textContent = text;
  if (name) made.className = name;
  return made;
}

function button(text, onClick) {
  const made = make("button", text);
  made.type = "button";
  made.addEventListener("click", onClick);
  return made;
}

function field(form, text, type, value, more = {}) {
  const label = make("label", text);
  const input = document.createElement("input");
  Object.assign(input, { type, value: value ?? "", ...more });
  input.setAttribute("aria-label", text);
  form.append(label, input);
  return input;
}
