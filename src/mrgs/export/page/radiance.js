// Temperatures from the band radiance in which they are blended (BandRadiance, which has what the law holds).

// A modality's value where its splats blend to a number.
function valueOfBlend(law, modality, blended) {
  if (law?.modality !== modality) return blended;
  const signal = Math.max(blended + law.offset, Number.MIN_VALUE);
  return (law.b / Math.log(law.gain / signal + 1) - law.low_k) / law.span_k;
}
