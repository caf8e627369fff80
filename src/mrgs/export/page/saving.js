// A picture for a file: the model as it is seen, with the marks and the scale that lie over it.

const styleOf = (node) => {
  const style = getComputedStyle(node);
  return { style, font: `${style.fontWeight} ${style.fontSize} ${style.fontFamily}` };
};

// The whole stage as an image of the canvas' size; the canvas must have been drawn in the same task.
function composed(canvas, over, scales) {
  const image = document.createElement("canvas");
  [image.width, image.height] = [canvas.width, canvas.height];
  const context = image.getContext("2d");
  context.drawImage(canvas, 0, 0);
  const ratio = canvas.width / canvas.clientWidth;
  context.scale(ratio, ratio);
  for (const node of over.children) drawShape(context, node);
  for (const card of scales.children) drawScale(context, card, canvas.getBoundingClientRect());
  return image;
}

// A path, a circle or a text of the marks, in the page's style.
function drawShape(context, node) {
  const { style, font } = styleOf(node);
  const number = (name) => Number(node.getAttribute(name));
  Object.assign(context, { lineWidth: parseFloat(style.strokeWidth), lineJoin: "round", strokeStyle: style.stroke, fillStyle: style.fill, font });
  if (node.tagName === "text") {
    const text = node.textContent.replace(/\s+/g, " ");
    context.strokeText(text, number("x"), number("y"));
    context.fillText(text, number("x"), number("y"));
    return;
  }
  const path = new Path2D(node.getAttribute("d") ?? "");
  if (node.tagName === "circle") path.arc(number("cx"), number("cy"), number("r"), 0, 2 * Math.PI);
  if (style.fill !== "none") context.fill(path);
  if (style.stroke !== "none") context.stroke(path);
}

// A scale bar: its card, its colours, and its ticks.
function drawScale(context, card, stage) {
  const placed = (node) => {
    const { left, top, width, height } = node.getBoundingClientRect();
    return [left - stage.left, top - stage.top, width, height];
  };
  const { style } = styleOf(card);
  context.fillStyle = style.backgroundColor;
  context.fillRect(...placed(card));
  context.drawImage(card.querySelector("canvas"), ...placed(card.querySelector("canvas")));
  for (const label of card.querySelectorAll("span")) {
    const [left, top, , height] = placed(label);
    Object.assign(context, { font: styleOf(label).font, fillStyle: style.color, textBaseline: "middle" });
    context.fillText(label.textContent, left, top + height / 2);
    context.fillRect(left - 8, top + height / 2, 5, 1);
  }
  context.textBaseline = "alphabetic";
}

function saveImage(image, name) {
  image.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = name.replace(/[^\p{L}\p{N} ._-]+/gu, "");
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
  }, "image/png");
}
