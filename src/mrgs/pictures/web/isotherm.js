// Which temperatures are marked in one colour: above, below or between two; where air would condense; where a wall is
// insulated badly. `mrgs.marks.moisture` has the same formulas.

const OPEN_END = 1e6;
const MAGNUS_A = 17.62;
const MAGNUS_B = 243.12;

// By mode: the label of each number, and what it starts with (null: of the scale).
const ISOTHERM_FIELDS = {
  above: [["Above", null]],
  below: [["Below", null]],
  between: [["From", null], ["to", null]],
  dew: [["Air, °C", 20], ["humidity, %", 50]],
  insulation: [["Inside, °C", 20], ["outside, °C", -5], ["fRsi", 0.7]],
};

function dewPoint(air, humidity) {
  const exponent = Math.log(humidity) + (MAGNUS_A * air) / (MAGNUS_B + air);
  return (MAGNUS_B * exponent) / (MAGNUS_A - exponent);
}

// First and last value of the band, or null where the numbers give none.
function isothermBand(mode, values) {
  if (!mode || !values.every(Number.isFinite)) return null;
  const [a, b, c] = values;
  if (mode === "above") return [a, OPEN_END];
  if (mode === "below") return [-OPEN_END, a];
  if (mode === "between") return [Math.min(a, b), Math.max(a, b)];
  if (mode === "dew") return b > 0 && b <= 100 ? [-OPEN_END, dewPoint(a, b / 100)] : null;
  return a > b ? [-OPEN_END, b + c * (a - b)] : null;
}

// The choice and its numbers; `onChange` is called after each change.
class IsothermControl {
  constructor(onChange) {
    this.onChange = onChange;
    this.select = document.getElementById("isotherm");
    this.row = document.getElementById("isotherm-values");
    this.said = document.getElementById("isotherm-said");
    this.kept = {};
    this.select.addEventListener("change", () => this.show());
  }

  // Of the scale that the numbers belong to: where they begin, and whether they are °C.
  reset(range, scale) {
    this.scale = scale;
    this.kept = { above: [range[0] + 0.75 * (range[1] - range[0])], below: [range[0] + 0.25 * (range[1] - range[0])] };
    this.kept.between = [this.kept.above[0], scale.max];
    for (const option of this.select.options) option.hidden = option.dataset.celsius !== undefined && scale.unit !== "°C";
    this.show();
  }

  show() {
    const mode = this.select.value;
    const fields = ISOTHERM_FIELDS[mode] ?? [];
    const values = this.kept[mode] ?? fields.map(([, value]) => value);
    this.inputs = fields.map(([text], index) => {
      const input = document.createElement("input");
      input.type = "number";
      input.step = "any";
      input.id = `isotherm-${["low", "high", "third"][index]}`;
      input.value = ["above", "below", "between"].includes(mode) ? values[index].toFixed(this.scale.decimals) : values[index];
      input.addEventListener("change", () => this.changed());
      const label = document.createElement("label");
      label.append(`${text} `, input);
      return [label, input];
    });
    this.row.replaceChildren(...this.inputs.map(([label]) => label));
    this.row.hidden = !fields.length;
    this.changed();
  }

  changed() {
    const mode = this.select.value;
    if (mode) this.kept[mode] = this.inputs.map(([, input]) => input.valueAsNumber);
    const band = this.band;
    const alarm = { dew: "Condensation at or below", insulation: "Too cold at or below" }[mode];
    this.said.textContent = !alarm ? "" : band ? `${alarm} ${withMinus(band[1].toFixed(1))} °C.` : "These numbers give no limit.";
    this.onChange();
  }

  get band() {
    return isothermBand(this.select.value, this.inputs.map(([, input]) => input.valueAsNumber));
  }
}
