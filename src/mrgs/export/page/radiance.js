// Temperatures are blended as radiance: see BandRadiance, which has what the law holds; null where they are not.

// What is blended of normalised temperatures.
function toRadiance(law, values) {
  const { gain, offset, b, low_k: low, span_k: span, coldest_k: coldest } = law;
  return values.map((value) => gain / Math.expm1(b / Math.max(low + span * value, coldest)) - offset);
}

// A modality's value where its splats blend to a number.
function valueOfBlend(law, modality, blended) {
  if (!law || modality !== "thermal") return blended;
  const received = Math.max(blended + law.offset, law.least);
  return (law.b / Math.log(law.gain / received + 1) - law.low_k) / law.span_k;
}
