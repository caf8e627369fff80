// The reader's own spots: where they are, what they read, and how much each differs from the one that they are compared
// with; and what the browser keeps of a page until it is opened again.

const MOST_SPOTS = 99;

// What was kept of this very page; nothing where the browser keeps nothing.
class Memory {
  constructor(content) {
    let hash = 5381;
    for (let i = 0; i < content.length; i++) hash = ((hash * 33) ^ content.charCodeAt(i)) >>> 0;
    this.key = `mrgs page 1 ${hash} ${content.length}`;  // 1: of the layout of what is kept
    this.kept = {};
    try {
      const kept = JSON.parse(localStorage.getItem(this.key));
      if (typeof kept === "object" && kept !== null && !Array.isArray(kept)) this.kept = kept;
    } catch { /* a browser that keeps nothing, or something else under this name */ }
  }

  keep(change) {
    Object.assign(this.kept, change);
    try {
      localStorage.setItem(this.key, JSON.stringify(this.kept));
    } catch { /* the page works all the same */ }
  }
}

class Spots {
  // `scales` are those of the modalities, by name; `onChange` is called after each change.
  constructor(scales, memory, onChange) {
    Object.assign(this, { scales, memory, onChange });
    const { spots, reference = null } = memory.kept;
    const isSpot = (spot) => typeof spot?.name === "string" && Object.hasOwn(scales, spot.modality)
      && Array.isArray(spot.point) && spot.point.length === 3 && [...spot.point, spot.value].every(Number.isFinite);
    this.list = Array.isArray(spots) ? spots.filter(isSpot).slice(0, MOST_SPOTS) : [];
    this.reference = this.list.some(({ name }) => name === reference) ? reference : null;
    this.show();
  }

  add(point, { modality, value }) {
    const taken = new Set(this.list.map(({ name }) => name));
    if (taken.size >= MOST_SPOTS) return;
    let number = 1;
    while (taken.has(`P${number}`)) number++;
    this.list.push({ name: `P${number}`, point, modality, value });
    this.reference ??= `P${number}`;
    this.changed();
  }

  remove(name) {
    this.list = this.list.filter((spot) => spot.name !== name);
    if (this.reference === name) this.reference = this.list[0]?.name ?? null;
    this.changed();
  }

  clear() {
    [this.list, this.reference] = [[], null];
    this.changed();
  }

  refer(name) {
    this.reference = name;
    this.changed();
  }

  changed() {
    this.memory.keep({ spots: this.list, reference: this.reference });
    this.show();
    this.onChange();
  }

  textOf({ modality, value }) {
    const scale = this.scales[modality];
    return scale.text(scale.shown(value));
  }

  // To the reference; empty for the reference itself, and for values of another kind.
  differenceOf(spot) {
    const other = this.list.find(({ name }) => name === this.reference);
    if (!other || other === spot || other.modality !== spot.modality) return "";
    const { unit, span, decimals } = this.scales[spot.modality];
    const difference = span * (spot.value - other.value);
    const [sign, kelvin] = [difference > 0 ? "+" : "", unit === "°C" ? " K" : unit && ` ${unit}`];
    return `${unit === "°C" ? "ΔT" : "Δ"} ${sign}${withMinus(difference.toFixed(decimals))}${kelvin}`;
  }

  // As marks over the picture.
  get marks() {
    return this.list.map((spot) => ({ kind: "spot", name: spot.name, label: `${spot.name}  ${this.textOf(spot)}`, points: [spot.point] }));
  }

  show() {
    const focused = [...element("spot-list").querySelectorAll("button")].indexOf(document.activeElement);
    element("spots").hidden = !this.list.length;
    element("spot-list").replaceChildren(...this.list.map((spot) => {
      const row = document.createElement("div");
      const isReference = spot.name === this.reference;
      const name = document.createElement("button");
      name.textContent = spot.name;
      name.title = `Compare the others with ${spot.name}`;
      name.setAttribute("aria-pressed", String(isReference));
      name.addEventListener("click", () => this.refer(spot.name));
      const value = document.createElement("span");
      value.textContent = this.textOf(spot);
      const difference = document.createElement("span");
      difference.className = "muted";
      difference.textContent = isReference ? "reference" : this.differenceOf(spot);
      const drop = document.createElement("button");
      drop.textContent = "×";
      drop.setAttribute("aria-label", `Delete ${spot.name}`);
      drop.addEventListener("click", () => this.remove(spot.name));
      row.append(name, value, difference, drop);
      return row;
    }));
    element("spot-list").querySelectorAll("button")[focused]?.focus();
  }
}
