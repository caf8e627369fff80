// Numbers as people type them: with a decimal point or a decimal comma, and with either minus sign.

const TYPED_NUMBER = /^[+−-]?(\d+([.,]\d*)?|[.,]\d+)$/;

// A proper minus sign, which what is shown as zero never has.
const withMinus = (text) => text.replace(/^-(?=[0.]+$)/, "").replace("-", "−");

// NaN for everything else.
function numberOf(text) {
  const plain = text.trim();
  return TYPED_NUMBER.test(plain) ? Number(plain.replace("−", "-").replace(",", ".")) : NaN;
}

// The number in a field; null where there is none within the limits, and then the field is marked and `said` says what
// it takes.
function numberIn(input, said, what, [low, high]) {
  const number = numberOf(input.value);
  const fits = number >= low && number <= high;
  const limits = [low, high].map((end) => withMinus(String(end)));
  refuse([input], said, fits ? "" : `${what}: a number from ${limits.join(" to ")}.`);
  return fits ? number : null;
}

// Mark fields whose content is not used, and say why; an empty reason takes both back.
function refuse(inputs, said, reason) {
  for (const input of inputs) input.setAttribute("aria-invalid", String(Boolean(reason)));
  said.textContent = reason;
}
