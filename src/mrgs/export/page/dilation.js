// How much projected splats are dilated, by the camera.

// The variance in px² that is added to the diagonal of a projected covariance: where a camera has coarser pixels than
// the finest photos, as wide in angle as in them.
function dilationOf({ px2, finest_focal_px: finest, least_px2: least }, { fx, fy }) {
  if (finest === null) return px2;
  return Math.max(least, px2 * Math.min(1, (fx * fy) / finest ** 2));
}
