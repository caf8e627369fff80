// Areas with an emissivity of their own: what a camera sees there is corrected as the marks are, by the same rules as
// in `mrgs.marks.regions` and `mrgs.marks.emissivity`.

const ZERO_CELSIUS_K = 273.15;
const WIDEST_LIMITS = 50; // the farthest over the nearest
const RIM = 0.01; // of the picture, about what the middles of an area's pixels span

class Areas {
  // The depths are those that each area's own camera sees; 0 where it does not see the area.
  constructor({ modality, near, law, areas }, depths, scale) {
    this.modality = modality;
    this.list = areas.map((area, index) => new Area({ ...area, near, law, scale, depths: depths[index] }));
  }

  seenFrom(camera) {
    return new SeenAreas(camera, this.list);
  }
}

class Area {
  constructor(facts) {
    Object.assign(this, facts);
    this.corners = this.boxCorners();
  }

  // Of the box about all that may lie on it.
  boxCorners() {
    const { camera, depths, near } = this;
    const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    for (let i = 0; i < depths.length; i++) {
      if (!depths[i]) continue;
      const pixel = [(i % camera.width) + 0.5, Math.floor(i / camera.width) + 0.5];
      for (const share of [1 - near, 1 + near]) {
        pointAt(camera, pixel, share * depths[i]).forEach((at, axis) => {
          low[axis] = Math.min(low[axis], at);
          high[axis] = Math.max(high[axis], at);
        });
      }
    }
    return Array.from({ length: 8 }, (_, corner) => low.map((at, axis) => (corner & (1 << axis) ? high[axis] : at)));
  }

  // A normalised temperature with the settings of the area; where there is none the value stays.
  withSettings(value) {
    const { gain, offset, scale } = this;
    const { amplitude, b, f } = this.law;
    const kelvin = scale.shown(value) + ZERO_CELSIUS_K;
    const signal = (gain * amplitude) / (Math.exp(b / kelvin) - f) + offset;
    const found = scale.normalised(b / Math.log(amplitude / signal + f) - ZERO_CELSIUS_K);
    return signal > 0 && Number.isFinite(found) ? found : value;
  }
}

// The areas in the axes of a camera, in which single precision serves.
class SeenAreas {
  constructor(camera, list) {
    this.camera = camera;
    this.views = list.map((area) => ({ area, ...turnedTo(camera, area) }));
    const corners = list.flatMap((area) => area.corners);
    this.limits = this.depthLimits(corners.map((corner) => this.inCamera(corner)[2]), list[0].near);
    this.rectangle = this.rectangleAbout(corners);
  }

  // Of what may lie on an area, before it is moved to the area's plane.
  depthLimits(depths, near) {
    const farthest = Math.max(...depths) / (1 - near);
    return [Math.max(Math.min(...depths) / (1 + near), farthest / WIDEST_LIMITS), farthest];
  }

  // Of the picture, as shares of it; all of it where an area reaches behind the camera.
  rectangleAbout(corners) {
    const { width, height } = this.camera;
    const places = corners.map((corner) => project(this.camera, corner));
    if (places.includes(null)) return [0, 0, 1, 1];
    const [across, down] = [places.map(([x]) => x / width), places.map(([, y]) => y / height)];
    const [left, top] = [across, down].map((each) => Math.max(0, Math.min(...each) - RIM));
    const [right, bottom] = [across, down].map((each) => Math.min(1, Math.max(...each) + RIM));
    return [left, top, Math.max(left, right), Math.max(top, bottom)];
  }

  // Whether any may be in the picture.
  get areInPicture() {
    const [left, top, right, bottom] = this.rectangle;
    return left < right && top < bottom && this.limits[1] > 0;
  }

  inCamera(point) {
    return transformed(this.camera.rotation, subtract(point, this.camera.position));
  }

  // A normalised temperature that is seen at a pixel, at a depth; of two areas the later counts.
  corrected(value, pixel, depth) {
    const point = this.inCamera(pointAt(this.camera, pixel, depth));
    const found = this.views.slice().reverse().find((view) => holds(view, point));
    return found ? found.area.withSettings(value) : value;
  }
}

// Whether a point lies on an area. On a flat one it is moved along its ray to the plane first: single depths are
// uneven.
function holds({ area, turn, shift, normal, offset }, point) {
  const along = dot(normal, point);
  const isNear = along !== 0 && Math.abs(offset / along - 1) < area.near;
  const [x, y, z] = add(transformed(turn, isNear ? multiply(point, offset / along) : point), shift);
  const { fx, fy, cx, cy, width, height } = area.camera;
  const [column, row] = [Math.floor((fx * x) / z + cx), Math.floor((fy * y) / z + cy)];
  if (!(z > 0 && column >= 0 && row >= 0 && column < width && row < height)) return false;
  const seen = area.depths[row * width + column];
  return seen > 0 && Math.abs(seen - z) < area.near * seen;
}

// From the axes of a camera to those of the area's, and the area's plane in the first; without a plane its normal
// is 0.
function turnedTo(camera, { camera: own, plane }) {
  const axes = [0, 3, 6].map((row) => camera.rotation.slice(row, row + 3));
  const turned = axes.map((axis) => transformed(own.rotation, axis));
  return {
    turn: [0, 1, 2].flatMap((row) => turned.map((axis) => axis[row])),
    shift: transformed(own.rotation, subtract(camera.position, own.position)),
    normal: axes.map((axis) => dot(axis, plane.normal)),
    offset: plane.offset - dot(camera.position, plane.normal),
  };
}

function transformed(matrix, point) {
  return [0, 3, 6].map((row) => dot(matrix.slice(row, row + 3), point));
}
