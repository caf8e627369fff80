// How much projected splats are dilated, by the camera.

const LEAST_DILATION_PX2 = 0.01;

// The variance in px² that is added to the diagonal of a projected covariance: where a camera has coarser pixels than
// the finest photos, as wide in angle as in them.
function dilationOf({ px2, finest_focal_px: finest }, { fx, fy }) {
  if (finest === null) return px2;
  return Math.max(LEAST_DILATION_PX2, px2 * Math.min(1, (fx * fy) / finest ** 2));
}
