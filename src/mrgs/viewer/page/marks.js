// How marks are drawn with the mouse or a finger, and how the panel lists them.

const FEWEST_CORNERS = { spot: 1, line: 2, box: 2, polygon: 3 };
const CLOSE_PX = 12;
const HINTS = {
  spot: "Click on the surface; or cancel, and press s in the picture for a spot in its middle.",
  line: "Click where the line begins and at each corner, then Done; or drag it.",
  box: "Drag over the picture.",
  polygon: "Click on each corner, then Done or the first corner again.",
};

const KEEP_HINTS = {
  box: "Drag tightly over what is to be kept: a box around all surface that is seen there, also behind the object.",
  polygon: "From above, click on each corner of what is to be kept, then Done: all above and below the outline stays.",
};

// One mark, or what is to be kept, at a time: `onDrawn` receives its kind and its corners in pixels of the picture, and
// whether they are of what is to be kept, as `say` does of a text.
class MarkDrawing {
  constructor(onDrawn, say) {
    this.onDrawn = onDrawn;
    this.say = say;
    this.tool = null;
    this.selector = element("selector");
    this.over = this.selector.querySelector("svg");
    for (const button of this.buttons) button.addEventListener("click", () => this.arm(button));
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

  get buttons() { return document.querySelectorAll("#mark-tools button, #keep-tools button"); }

  get kind() { return this.tool?.dataset.kind ?? this.tool?.dataset.keep ?? null; }

  get keeps() { return this.tool?.dataset.keep !== undefined; }

  arm(tool) {
    if (this.tool) this.say("", this.keeps);
    this.tool = tool === this.tool ? null : tool;
    this.corners = [];
    this.pressed = null;
    this.selector.hidden = element("drawing").hidden = !this.kind;
    for (const button of this.buttons) button.setAttribute("aria-pressed", String(button === this.tool));
    if (this.tool) this.say((this.keeps ? KEEP_HINTS : HINTS)[this.kind], this.keeps);
    this.draw();
  }

  press(event) {
    if (event.button) return;
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
    const { kind, corners, keeps } = this;
    if (corners.length < FEWEST_CORNERS[kind]) return;
    this.arm(null);
    this.onDrawn(kind, corners, keeps);
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

// The marks in the panel. A row stays the same as long as its mark has the same number, whatever else changes: so it
// keeps what is unfolded, what is being typed, and the cursor.
class MarkList {
  constructor(list, limits, send) {
    this.list = list;
    this.limits = limits;
    this.send = send;
    this.rows = new Map();
  }

  show(marks) {
    const rows = new Map(marks.map((mark) => [mark.id, this.rows.get(mark.id) ?? new MarkRow(mark, this.limits, this.send)]));
    for (const [number, row] of this.rows) if (!rows.has(number)) row.root.remove();
    this.rows = rows;
    marks.forEach((mark, index) => {
      const row = rows.get(mark.id);
      const there = this.list.children[index];
      if (there !== row.root) this.list.insertBefore(row.root, there ?? null);
      row.update(mark);
    });
  }

  // Why a mark was not changed, said in its row; returns whether it could be.
  refuse(number, reason) {
    return this.rows.get(number)?.refuse(reason) ?? false;
  }
}

// One mark: what was measured, and a form for what can be changed.
class MarkRow {
  constructor(mark, limits, send) {
    this.root = document.createElement("details");
    this.texts = { name: make("b"), difference: make("span", "", "muted"), value: make("span") };
    this.problem = make("div", "", "problem warning");
    this.lines = make("div", "", "lines muted");
    this.chart = make("div", "", "profile");
    this.form = document.createElement("form");
    this.form.addEventListener("submit", (event) => event.preventDefault());
    this.form.append(this.problem, this.lines, this.chart);
    this.fields = markFields(mark, limits).map((field) => new MarkField(this.form, field, (change) => {
      send("change_mark", { mark: mark.id, ...change });
    }));
    const buttons = make("div", "", "row");
    buttons.append(
      button("Reference", () => send("refer_to", { mark: mark.id })),
      button("Delete", () => send("delete_mark", { mark: mark.id })),
    );
    this.form.append(buttons);
    const summary = document.createElement("summary");
    summary.append(...Object.values(this.texts));
    this.root.append(summary, this.form);
  }

  update(mark) {
    this.texts.name.textContent = mark.name;
    this.texts.difference.textContent = mark.reference ? "reference" : mark.difference;
    this.texts.value.textContent = mark.value;
    this.problem.textContent = mark.problem;
    this.lines.textContent = mark.lines.join("\n");
    this.chart.replaceChildren(...(mark.profile.length ? [profileChart(mark)] : []));
    for (const field of this.fields) field.update(mark);
  }

  // Of a change that was sent: its field keeps what was typed, and is marked. Returns whether there is one.
  refuse(reason) {
    const sent = this.fields.filter((field) => field.isSent);
    for (const field of this.fields) field.pending = null;
    for (const { input, said } of sent) refuse([input], said, `Not saved: ${reason}.`);
    return sent.length > 0;
  }
}

// The fields of a mark: their labels, the limits of numbers, and more attributes.
function markFields({ area }, { name, note, severity, emissivity, reflected_c }) {
  const texts = [
    { name: "name", label: "Name", more: { maxLength: name } },
    { name: "note", label: "Note", more: { maxLength: note } },
    { name: "severity", label: "Severity", more: { maxLength: severity, placeholder: "class 1 to 3, or words" }, list: "severities" },
  ];
  if (!area) return texts;
  return [
    ...texts,
    { name: "emissivity", label: "Emissivity", limits: emissivity, more: { inputMode: "decimal", placeholder: "as photos" } },
    { name: "reflected_c", label: "Reflected, °C", limits: reflected_c, more: { placeholder: "as photos" } },
  ];
}

// A field of a mark. What is typed and not saved yet is overwritten by no answer.
class MarkField {
  constructor(form, { name, label, limits, more, list }, send) {
    Object.assign(this, { name, label, limits, send });
    this.saved = "";
    this.pending = null; // what was sent and is not answered yet
    this.input = document.createElement("input");
    Object.assign(this.input, { type: "text", autocomplete: "off", ...more });
    if (list) this.input.setAttribute("list", list);
    this.input.setAttribute("aria-label", label);
    this.input.addEventListener("change", () => this.changed());
    this.said = make("p", "", "said warning");
    this.said.setAttribute("role", "status");
    form.append(make("label", label), this.input, this.said);
  }

  // Whether what it shows has been sent, and is not saved.
  get isSent() { return this.pending !== null && this.pending === this.input.value; }

  // Every answer has all fields: it may be that to another change.
  update(mark) {
    const { saved: before, pending } = this;
    this.saved = String(mark[this.name] ?? "");
    if (this.saved === pending) this.pending = null;
    const typed = pending !== null || this.input.value !== before;
    if (typed && this.input.value !== this.saved) {
      if (pending === null && this.saved !== before) this.said.textContent = `Meanwhile saved as: ${this.saved || "(empty)"}`;
      return;
    }
    this.input.value = this.saved;
    refuse([this.input], this.said, "");
  }

  changed() {
    const value = this.limits ? this.number() : this.input.value;
    if (value === undefined) return;
    this.input.value = String(value ?? "");
    refuse([this.input], this.said, "");
    if (this.input.value === (this.pending ?? this.saved)) return;
    this.pending = this.input.value;
    this.send({ [this.name]: value });
  }

  // Null for an empty field, undefined for what is no number.
  number() {
    if (!this.input.value.trim()) return null;
    const number = numberIn(this.input, this.said, `Not saved: ${this.label}`, this.limits);
    return number ?? undefined;
  }
}

// What of the model is shown, and the sides of its box as numbers.
class KeptPart {
  constructor(onSides) {
    this.said = element("keep-said");
    this.inputs = [[], []]; // low and high ends of x, y and z
    for (const axis of ["x", "y", "z"]) {
      const row = make("div", "", "row");
      row.append(make("span", axis));
      ["from", "to"].forEach((word, end) => {
        const input = document.createElement("input");
        Object.assign(input, { type: "text", autocomplete: "off" });
        input.setAttribute("aria-label", `${axis} ${word}`);
        input.addEventListener("change", () => this.changed(onSides));
        this.inputs[end].push(input);
        row.append(...(end ? [make("span", "to"), input] : [input]));
      });
      element("sides").append(row);
    }
  }

  // Told again whenever marks have been measured: what is typed or said stays then.
  show({ box, left_out: leftOut, shown }) {
    if (this.known === JSON.stringify(box)) return;
    this.known = JSON.stringify(box);
    const [low, high, outlines] = box ?? [[], [], []];
    const share = leftOut / (leftOut + shown);
    const percent = share > 0 && share < 0.01 ? "less than 1" : String(Math.round(100 * share));
    const what = outlines.length ? `What is in ${outlines.length > 1 ? `${outlines.length} outlines` : "an outline"} and this box` : "What is in this box";
    element("kept").textContent = box ? `${what} is shown; ${percent} % of the model is left out.` : "All of the model is shown.";
    element("sides").hidden = !box;
    [low, high].forEach((end, i) => end.forEach((number, axis) => {
      this.inputs[i][axis].value = withMinus(String(Number(number.toPrecision(6))));
    }));
    refuse(this.inputs.flat(), this.said, "");
  }

  changed(onSides) {
    const inputs = this.inputs.flat();
    const wrong = inputs.filter(({ value }) => Number.isNaN(numberOf(value)));
    refuse(inputs, this.said, "");
    if (wrong.length) refuse(wrong, this.said, "Not changed: a number, such as 2.5.");
    else onSides(inputs.map(({ value }) => numberOf(value)));
  }
}

// A proposal of the report, to be judged; its details are a tooltip.
function proposalRow(mark, send) {
  const row = make("div", "", "proposal");
  row.title = mark.lines.join("\n");
  const judge = (text, accept) => button(text, () => send("judge", { mark: mark.name, accept }));
  row.append(make("b", mark.name), make("span", mark.value), judge("Accept", true), judge("Drop", false));
  return row;
}

function make(tag, text = "", name = "") {
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
