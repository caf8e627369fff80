// Colour scales: numbers with their unit, and a bar with round ticks that lies over the picture as part of the page.

const TICK_PX = 34;

class Scale {
  // The normalised values of a modality as the numbers of the page: in its unit, or as they are without one.
  constructor({ min, max, unit, decimals }) {
    Object.assign(this, { min, max, unit, decimals });
    this.span = max - min;
  }

  shown(value) { return this.min + value * this.span; }
  normalised(number) { return (number - this.min) / this.span; }
  number(number) { return withMinus(number.toFixed(this.decimals)); }
  text(number) { return this.number(number) + (this.unit ? ` ${this.unit}` : ""); }
}

// The smallest of 1, 2, 2.5 or 5 times a power of ten that divides a range into at most about `count` parts.
function tickStep(low, high, count) {
  const rough = (high - low) / Math.max(count, 1);
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * [1, 2, 2.5, 5, 10].find((factor) => factor * power >= rough * (1 - 1e-9));
}

// Round numbers between two limits, at most about `count`.
function roundTicks(low, high, count) {
  const step = tickStep(low, high, count);
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k <= Math.floor(high / step + 1e-9); k++) ticks.push(k * step);
  return ticks;
}

// The numbers as text with one number of decimals, as few as tell them exactly.
function tickLabels(ticks) {
  let decimals = 0;
  const exact = (tick) => Math.abs(tick - Number(tick.toFixed(decimals))) < 1e-6 * Math.max(Math.abs(tick), 1e-3);
  while (decimals < 6 && !ticks.every(exact)) decimals++;
  return ticks.map((tick) => withMinus(tick.toFixed(decimals)));
}

// Of a picture of this height, pixels.
const barHeight = (height) => Math.min(240, 70 + 0.2 * height);

class ScaleBar {
  constructor(parent) {
    this.root = document.createElement("div");
    this.root.className = "scale";
    this.bar = document.createElement("canvas");
    [this.bar.width, this.bar.height] = [1, 256];
    this.ticks = document.createElement("div");
    this.root.append(this.bar, this.ticks);
    parent.append(this.root);
  }

  // `low` may be the larger number: then the palette runs the other way, and still has its last colour on top.
  show({ low, high, unit, colours, signed }, height) {
    this.root.style.height = `${height}px`;
    const context = this.bar.getContext("2d");
    const image = context.createImageData(1, 256);
    for (let i = 0; i < 256; i++) image.data.set([...colours.subarray(3 * (255 - i), 3 * (255 - i) + 3), 255], 4 * i);
    context.putImageData(image, 0, 0);
    const ticks = roundTicks(Math.min(low, high), Math.max(low, high), Math.max(2, height / TICK_PX));
    const labels = tickLabels(ticks);
    const top = low < high ? ticks.length - 1 : 0;
    this.ticks.replaceChildren(...ticks.map((tick, i) => {
      const label = document.createElement("span");
      const plus = signed && tick > 0 ? "+" : "";
      label.textContent = plus + labels[i] + (i === top && unit ? ` ${unit}` : "");
      label.style.bottom = `${(100 * (tick - low)) / (high - low)}%`;
      return label;
    }));
    const widest = Math.max(...[...this.ticks.children].map((label) => label.offsetLeft + label.offsetWidth));
    this.ticks.style.minWidth = `${widest}px`;
  }

  remove() { this.root.remove(); }
}
