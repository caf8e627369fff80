// What every page with a 3D view reads of its facts, and shows of them.

const element = (id) => document.getElementById(id);

// By name: the bytes of the 256 colours.
const palettesOf = ({ palettes }) => Object.fromEntries(Object.entries(palettes).map(([name, text]) => [name, fromBase64(text)]));

// By name, each with its scale.
const modalitiesOf = ({ modalities }) => Object.fromEntries(modalities.map((each) => [each.name, { ...each, scale: new Scale(each.scale) }]));

const scaleTitle = ({ label, scale: { unit } }) => `${label} scale${unit ? `, ${unit}` : ""}`;

// Beside the cursor: to its left where a picture of this width has no room to its right.
function placeTip(tip, x, y, width) {
  const flip = x + 24 + tip.offsetWidth > width;
  tip.style.transform = `translate(${flip ? x - 14 - tip.offsetWidth : x + 14}px, ${y + 14}px)`;
}
