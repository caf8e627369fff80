// Marks over a picture, and the profiles of lines; for every page that shows them.

const SVG = document.getElementById("marks").namespaceURI;

function shape(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text) made.textContent = text;
  parent.append(made);
  return made;
}

// The label of a place: on its other side where it would leave the picture, and lower where it would cover another one.
function writeLabel(over, x, y, gap, text, right) {
  const others = [...over.querySelectorAll("text")].map((each) => each.getBBox());
  const label = shape("text", { x: x + gap, y }, over, text);
  if (x + gap + label.getBBox().width > right) {
    label.setAttribute("x", x - gap);
    label.setAttribute("text-anchor", "end");
  }
  const own = label.getBBox();
  const top = own.y;
  const covers = (other) => own.x < other.x + other.width && other.x < own.x + own.width
    && own.y < other.y + other.height && other.y < own.y + own.height;
  for (const other of others.sort((a, b) => a.y - b.y)) if (covers(other)) own.y = other.y + other.height;
  label.setAttribute("dy", own.y - top);
}

// A cross with its label.
function drawMark(over, x, y, label, right) {
  const cross = `M${x - 9} ${y}H${x + 9}M${x} ${y - 9}V${y + 9}`;
  for (const layer of ["under", "over"]) shape("path", { d: cross, class: layer }, over);
  writeLabel(over, x, y - 10, 13, label, right);
}

// A line or an area with its label at the highest corner, and dots at its extremes; `at` maps its places to pixels.
function drawOutline(over, at, { corners, closed, label, low, high }, right) {
  const places = corners.map((corner) => at(...corner));
  const d = `M${places.map((place) => place.map((n) => n.toFixed(1)).join(" ")).join("L")}${closed ? "Z" : ""}`;
  for (const layer of ["under", "over"]) shape("path", { d, class: layer }, over);
  for (const [name, place] of [["low", low], ["high", high]]) {
    if (!place) continue;
    const [cx, cy] = at(...place);
    shape("circle", { cx, cy, r: 4, class: name }, over);
  }
  const [x, y] = places.reduce((best, place) => (place[1] < best[1] ? place : best));
  writeLabel(over, x, Math.max(y - 8, 14), 6, label, right);
}

// The values along a line as a small chart: pairs of distance and value, null where there is no surface.
function profileChart(profile) {
  const [width, height, left, bottom] = [270, 96, 34, 14];
  const chart = document.createElementNS(SVG, "svg");
  chart.setAttribute("viewBox", `0 0 ${width} ${height}`);
  const known = profile.filter(([, value]) => value !== null).map(([, value]) => value);
  if (!known.length) return chart;
  const [low, high, end] = [Math.min(...known), Math.max(...known), profile[profile.length - 1][0]];
  chart.setAttribute("role", "img");
  chart.setAttribute("aria-label", `Profile: ${[low, high].map((value) => withMinus(value.toFixed(1))).join(" to ")}`);
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
  for (const value of [low, high]) {
    shape("line", { x1: left, x2: width, y1: y(value), y2: y(value) }, chart);
    shape("text", { x: left - 4, y: y(value) + 4, "text-anchor": "end" }, chart, withMinus(value.toFixed(1)));
  }
  shape("path", { d }, chart);
  shape("text", { x: left, y: height - 1 }, chart, "0");
  shape("text", { x: width, y: height - 1, "text-anchor": "end" }, chart, end.toPrecision(3));
  return chart;
}
