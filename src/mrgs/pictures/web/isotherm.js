// Which temperatures are marked in one colour: above, below or between two; where air would condense; where a wall is
// insulated badly: below the temperature factor f_Rsi of ISO 13788, which DIN 4108-2 wants to be 0.7.

const OPEN_END = 1e6;
// Magnus' formula over water (WMO, Guide to Instruments and Methods of Observation).
const MAGNUS_A = 17.62;
const MAGNUS_B = 243.12;
const MAGNUS_LIMITS = [-45, 60];
const AIR_LIMITS = [-90, 90];

// By mode: the label of each number, what it starts with, and its limits (null: of the scale). The survey of the run
// may state what the air was like.
const isothermFields = ({ inside_c, outside_c, humidity_percent }) => ({
  above: [["Above", null, null]],
  below: [["Below", null, null]],
  between: [["From", null, null], ["to", null, null]],
  dew: [["Air, °C", inside_c ?? 20, MAGNUS_LIMITS], ["humidity, %", humidity_percent ?? 50, [1, 100]]],
  insulation: [["Inside, °C", inside_c ?? 20, AIR_LIMITS], ["outside, °C", outside_c ?? -5, AIR_LIMITS], ["fRsi", 0.7, [0, 1]]],
});

function dewPoint(air, humidity) {
  const exponent = Math.log(humidity) + (MAGNUS_A * air) / (MAGNUS_B + air);
  return (MAGNUS_B * exponent) / (MAGNUS_A - exponent);
}

// First and last value of the band, or null where the numbers give none.
function isothermBand(mode, values) {
  if (!mode || values.includes(null)) return null;
  const [a, b, c] = values;
  if (mode === "above") return [a, OPEN_END];
  if (mode === "below") return [-OPEN_END, a];
  if (mode === "between") return [Math.min(a, b), Math.max(a, b)];
  if (mode === "dew") return [-OPEN_END, dewPoint(a, b / 100)];
  return a > b ? [-OPEN_END, b + c * (a - b)] : null;
}

// The choice and its numbers; `onChange` is called after each change.
class IsothermControl {
  constructor(onChange, air = {}) {
    this.onChange = onChange;
    this.fields = isothermFields(air);
    this.select = element("isotherm");
    this.row = element("isotherm-values");
    this.said = element("isotherm-said");
    this.kept = {};
    this.band = null;
    this.select.addEventListener("change", () => this.show());
  }

  // Of the scale that the numbers belong to: where they begin, and whether they are °C.
  reset(range, scale) {
    this.scale = scale;
    const [lower, upper] = [0.25, 0.75].map((share) => scale.number(range[0] + share * (range[1] - range[0])));
    this.kept = { above: [upper], below: [lower], between: [upper, scale.number(scale.max)] };
    for (const option of this.select.options) {
      option.hidden = option.disabled = option.dataset.celsius !== undefined && scale.unit !== "°C";
    }
    if (this.select.selectedOptions[0]?.disabled) this.select.selectedIndex = 0;
    this.show();
  }

  show() {
    const mode = this.select.value;
    const fields = this.fields[mode] ?? [];
    const texts = this.kept[mode] ?? fields.map(([, number]) => withMinus(String(number)));
    this.inputs = fields.map((_, index) => {
      const input = document.createElement("input");
      Object.assign(input, { type: "text", className: "number", autocomplete: "off", value: texts[index] });
      input.id = `isotherm-${["low", "high", "third"][index]}`;
      input.addEventListener("change", () => this.changed());
      return input;
    });
    this.row.replaceChildren(...this.inputs.map((input, index) => {
      const label = document.createElement("label");
      label.append(`${fields[index][0]} `, input);
      return label;
    }));
    this.row.hidden = !fields.length;
    this.changed();
  }

  // Says what the numbers give, or what is wrong with the first that is none.
  changed() {
    const mode = this.select.value;
    if (mode) this.kept[mode] = this.inputs.map((input) => input.value);
    const reasons = [];
    const values = this.inputs.map((input, index) => {
      const [what, , limits] = this.fields[mode][index];
      const value = numberIn(input, this.said, what, limits ?? scaleLimits(this.scale));
      reasons.push(this.said.textContent);
      return value;
    });
    this.band = isothermBand(mode, values);
    this.said.textContent = reasons.find(Boolean) ?? this.given(mode);
    this.onChange();
  }

  given(mode) {
    const alarm = { dew: "Condensation at or below", insulation: "Too cold at or below" }[mode];
    if (!alarm) return "";
    return this.band ? `${alarm} ${withMinus(this.band[1].toFixed(1))} °C.` : "It must be warmer inside than outside.";
  }
}
