// The values of the palette's first and last colour.

const SPANS_BEYOND = 100; // of what was recorded, that a colour may stand for
const COLDEST_C = -273;
const HOTTEST_C = 5000;

// What a number on a scale may be.
function scaleLimits({ min, max, span, unit }) {
  return unit === "°C" ? [COLDEST_C, HOTTEST_C] : [min - SPANS_BEYOND * span, max + SPANS_BEYOND * span];
}

// Its two fields; `onChange` is called with what was typed. What is used is what the fields show.
class RangeControl {
  constructor(onChange) {
    this.onChange = onChange;
    this.inputs = ["low", "high"].map(element);
    this.said = element("range-said");
    for (const input of this.inputs) input.addEventListener("change", () => this.read());
  }

  show(range, scale) {
    this.scale = scale;
    this.inputs.forEach((input, index) => { input.value = scale.number(range[index]); });
    refuse(this.inputs, this.said, "");
  }

  read() {
    const { scale, said } = this;
    refuse(this.inputs, said, "");
    const numbers = [];
    for (const input of this.inputs) {
      const number = numberIn(input, said, "The scale", scaleLimits(scale));
      if (number === null) return;
      numbers.push(Number(number.toFixed(scale.decimals)));
    }
    const [low, high] = numbers;
    if (low < high) this.onChange(low, high);
    else refuse(this.inputs, said, "The upper end must be above the lower.");
  }
}
