// Marks over a picture, and the profiles of lines; for every page that shows them.

const SVG = element("marks").namespaceURI;

function shape(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text) made.textContent = text;
  parent.append(made);
  return made;
}

// Where a label may stand beside its place, in lines of text from it: not so far that it could be another's.
const LABEL_SHIFTS = [0, 1, -1, 2, -2];
const LABEL_MARGIN = 2;

// By text: its box where its left end lies at the origin. Measuring makes the browser lay out the page.
const labelBoxes = new Map();
const MOST_BOXES = 5000;

function labelBox(text, over) {
  if (!labelBoxes.has(text)) {
    if (labelBoxes.size >= MOST_BOXES) labelBoxes.clear();
    const measured = shape("text", {}, over, text);
    const { y, width, height } = measured.getBBox();
    measured.remove();
    if (!width) return { y, width, height }; // nothing is laid out yet
    labelBoxes.set(text, { y, width, height });
  }
  return labelBoxes.get(text);
}

// The labels over a picture of this size, none of which covers another.
class Labels {
  constructor(over, width, height) {
    Object.assign(this, { over, width, height });
    this.taken = [];
  }

  put(text, x, y) {
    const box = labelBox(text, this.over);
    this.taken.push({ x, y: y + box.y, width: box.width, height: box.height });
    shape("text", { x, y }, this.over, text);
  }

  // Beside a place, to its right or left: the first of some texts, the longest first, that covers no other label and
  // lies within the picture; nothing where there is no room for any.
  write(x, y, gap, texts) {
    for (const text of texts) {
      const box = text && labelBox(text, this.over);
      const place = box && freePlace(box, [x + gap, x - gap], y, this.taken, [this.width, this.height]);
      if (place) return this.put(text, place.x, place.y);
    }
  }
}

// The first place for a box of text whose left or right end is at one of two abscissas; null if all are taken.
function freePlace(box, [right, left], y, others, [width, height]) {
  for (const shift of LABEL_SHIFTS) {
    for (const x of [right, left - box.width]) {
      const top = y + box.y + shift * box.height;
      const fits = x >= LABEL_MARGIN && x + box.width <= width - LABEL_MARGIN && top >= 0 && top + box.height <= height;
      const covers = (other) => other.x < x + box.width && x < other.x + other.width
        && other.y < top + box.height && top < other.y + other.height;
      if (fits && !others.some(covers)) return { x, y: y + shift * box.height };
    }
  }
  return null;
}

// A cross with its label: the whole one, and that for little room.
function drawMark(labels, x, y, texts) {
  const cross = `M${x - 9} ${y}H${x + 9}M${x} ${y - 9}V${y + 9}`;
  for (const layer of ["under", "over"]) shape("path", { d: cross, class: layer }, labels.over);
  labels.write(x, y - 10, 13, texts);
}

// A line or an area with its label at the highest corner in the picture, and dots at its extremes; `at` maps its places
// to pixels of the picture.
function drawOutline(labels, at, { corners, closed, label, short, low, high }) {
  const { over, width, height } = labels;
  const places = corners.map((corner) => at(...corner));
  const d = `M${places.map((place) => place.map((n) => n.toFixed(1)).join(" ")).join("L")}${closed ? "Z" : ""}`;
  for (const layer of ["under", "over"]) shape("path", { d, class: layer }, over);
  for (const [name, place] of [["low", low], ["high", high]]) {
    if (!place) continue;
    const [cx, cy] = at(...place);
    shape("circle", { cx, cy, r: 4, class: name }, over);
  }
  const inside = places.filter(([x, y]) => x >= 0 && x <= width && y >= 0 && y <= height);
  if (!inside.length) return;
  const [x, y] = inside.reduce((best, place) => (place[1] < best[1] ? place : best));
  labels.write(x, Math.max(y - 8, 14), 6, [label, short]);
}

// The values along a line as a small chart: pairs of distance and value, null where there is no surface; `ends` are its
// lowest and highest value and its length as text.
function profileChart({ profile, ends }) {
  const [width, height, bottom, digit] = [270, 96, 14, 6];
  const chart = document.createElementNS(SVG, "svg");
  chart.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const known = profile.filter(([, value]) => value !== null).map(([, value]) => value);
  if (!known.length) return chart;
  const [low, high, end] = [Math.min(...known), Math.max(...known), profile[profile.length - 1][0]];
  chart.setAttribute("role", "img");
  chart.setAttribute("aria-label", `Profile: ${ends[0]} to ${ends[1]}`);
  const left = 8 + digit * Math.max(ends[0].length, ends[1].length);
  const span = Math.max(high - low, 1e-6);
  const x = (distance) => left + ((width - left - 4) * distance) / end;
  const y = (value) => 8 + ((height - bottom - 14) * (high - value)) / span;
  let pen = "M";
  let d = "";
  for (const [distance, value] of profile) {
    if (value === null) pen = "M";
    else {
      d += `${pen}${x(distance).toFixed(1)} ${y(value).toFixed(1)}`;
      pen = "L";
    }
  }
  for (const [value, text] of [[low, ends[0]], [high, ends[1]]]) {
    shape("line", { x1: left, x2: width, y1: y(value), y2: y(value) }, chart);
    shape("text", { x: left - 4, y: y(value) + 4, "text-anchor": "end" }, chart, text);
  }
  shape("path", { d }, chart);
  shape("text", { x: left, y: height - 1 }, chart, "0");
  shape("text", { x: width, y: height - 1, "text-anchor": "end" }, chart, ends[2]);
  return chart;
}
