// The camera of a view: a pose (OpenCV axes: right, down, forward) that turns around a pivot.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => a.map((v, k) => v - b[k]);
const along = (a, b, s) => a.map((v, k) => v + s * b[k]);

/** `v` turned by `angle` around the unit vector `axis` (Rodrigues). */
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), d = dot(axis, v) * (1 - c);
  const [x, y, z] = axis;
  const cross = [y * v[2] - z * v[1], z * v[0] - x * v[2], x * v[1] - y * v[0]];
  return v.map((a, k) => a * c + cross[k] * s + axis[k] * d);
}

export class OrbitCamera {
  /** T_WC as 16 numbers by rows; the pivot lies `distance` metres ahead; `up` is a unit vector. */
  constructor(pose, distance, up) {
    this.up = up;
    this.distance = distance;
    this.place(pose);
  }

  place(pose) {
    this.axes = [0, 1, 2].map((k) => [pose[k], pose[4 + k], pose[8 + k]]);
    this.centre = [pose[3], pose[7], pose[11]];
    this.pivot = along(this.centre, this.axes[2], this.distance);
  }

  pose() {
    const [r, d, f] = this.axes;
    return [0, 1, 2].flatMap((k) => [r[k], d[k], f[k], this.centre[k]]).concat([0, 0, 0, 1]);
  }

  /** The scene follows the pointer: yaw around the world's up, pitch around the camera's right, but not over the poles. */
  orbit(dx, dy, about = this.pivot) {
    this.turn(this.up, -dx, about);
    const forward = turned(this.axes[2], this.axes[0], -dy);
    if (Math.abs(dot(forward, this.up)) < 0.9995) this.turn(this.axes[0], -dy, about);
  }

  /** Rotate in place. */
  look(dx, dy) {
    const reach = Math.sqrt(dot(minus(this.pivot, this.centre), minus(this.pivot, this.centre)));
    this.orbit(-dx, -dy, this.centre);
    this.pivot = along(this.centre, this.axes[2], reach);
  }

  turn(axis, angle, about) {
    this.axes = this.axes.map((a) => turned(a, axis, angle));
    this.centre = along(about, turned(minus(this.centre, about), axis, angle), 1);
  }

  /** Move sideways and up, so that points at the pivot's depth stay under the pointer. */
  pan(dx, dy, focal) {
    const depth = Math.max(Math.abs(dot(minus(this.pivot, this.centre), this.axes[2])), 0.1);
    for (const [k, amount] of [[0, dx], [1, dy]]) {
      this.centre = along(this.centre, this.axes[k], (-amount * depth) / focal);
      this.pivot = along(this.pivot, this.axes[k], (-amount * depth) / focal);
    }
  }

  /** Move towards the pivot by a factor; near the pivot, the pivot is moved ahead. */
  zoom(factor) {
    const offset = minus(this.centre, this.pivot);
    const reach = Math.sqrt(dot(offset, offset));
    if (reach * factor < 0.1) this.pivot = along(this.pivot, this.axes[2], 0.3);
    else this.centre = along(this.pivot, offset, factor);
  }

  /** Make the point at `depth` in pixel (x, y) of the picture the new pivot. */
  aim(x, y, depth, [fx, fy, cx, cy]) {
    const ray = [(x - cx) / fx, (y - cy) / fy, 1];
    this.pivot = ray.reduce((p, amount, k) => along(p, this.axes[k], amount * depth), this.centre);
  }
}
