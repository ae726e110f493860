// From 3D Gaussians to ellipses on the screen, front to back: the equations of gsfusion_nb/render/project.py.

/** A camera for this module from a pose (T_WC, 16 numbers by rows) and intrinsics at the size of the picture. */
export function viewOf(pose, intrinsics, width, height, scale = 1) {
  const [fx, fy, cx, cy] = intrinsics.map((v) => v * scale);
  const R = [pose[0], pose[4], pose[8], pose[1], pose[5], pose[9], pose[2], pose[6], pose[10]]; // R_CW = R_WC^T
  const centre = [pose[3], pose[7], pose[11]];
  const t = [0, 3, 6].map((i) => -(R[i] * centre[0] + R[i + 1] * centre[1] + R[i + 2] * centre[2]));
  return { R, t, centre, fx, fy, cx, cy, width: Math.round(width * scale), height: Math.round(height * scale) };
}

/** Arrays that are reused from picture to picture; they grow when the map does. */
function reserve(out, n) {
  if (out.row?.length >= n) return out;
  const length = Math.ceil(n * 1.2);
  out.row = new Int32Array(length);
  for (const name of ["u", "v", "A", "B", "C", "opacity", "halfWidth", "halfHeight", "depth"]) {
    out[name] = new Float32Array(length);
  }
  return out;
}

/**
 * Project the rows that can be seen in the picture. `out.count` entries of the arrays of `out` are filled, in the order
 * of the rows: row, (u, v), conic (A, B, C), opacity, half size of the box, depth.
 *
 * look: {size, opacity, points, bornUntil (null: all), birth (its column), limit (rows at most)}
 * rules: near_m, blur_px2, clamp, alpha_min, as in gsfusion_nb/constants.py
 */
export function project(rows, view, look, rules, out = {}) {
  reserve(out, rows.n);
  const { R, t, fx, fy, cx, cy, width, height, margin = 0 } = view;
  const { xyz, cov, values } = rows;
  const columns = rows.layout?.columns ?? 0;
  const limitX = (rules.clamp * 0.5 * width) / fx;
  const limitY = (rules.clamp * 0.5 * height) / fy;
  const grow = look.size * look.size;
  const scrub = look.bornUntil !== null && look.birth >= 0;
  const least = rows.threshold(look.limit ?? Infinity);
  let count = 0;
  for (let i = 0; i < rows.n; i++) {
    if (rows.importance[i] < least) continue;
    if (scrub && values[columns * i + look.birth] > look.bornUntil) continue;
    const a = xyz[3 * i], b = xyz[3 * i + 1], c = xyz[3 * i + 2];
    const z = R[6] * a + R[7] * b + R[8] * c + t[2];
    if (!(z > rules.near_m)) continue;
    const opacity = look.points ? Math.min(1, rows.opacity[i] * 255) * 0.99 : Math.min(1, rows.opacity[i] * look.opacity);
    if (opacity < rules.alpha_min) continue;
    const xz = (R[0] * a + R[1] * b + R[2] * c + t[0]) / z;
    const yz = (R[3] * a + R[4] * b + R[5] * c + t[1]) / z;
    const u = fx * xz + cx, v = fy * yz + cy;
    let uu, uv, vv;
    if (look.points) {
      uu = vv = grow;
      uv = 0;
    } else {
      const tx = Math.max(-limitX, Math.min(limitX, xz)), ty = Math.max(-limitY, Math.min(limitY, yz));
      const f = fx / z, g = fy / z; // rows of J R_CW
      const p0 = f * (R[0] - tx * R[6]), p1 = f * (R[1] - tx * R[7]), p2 = f * (R[2] - tx * R[8]);
      const q0 = g * (R[3] - ty * R[6]), q1 = g * (R[4] - ty * R[7]), q2 = g * (R[5] - ty * R[8]);
      const k = 6 * i;
      const s0 = cov[k] * p0 + cov[k + 1] * p1 + cov[k + 2] * p2;
      const s1 = cov[k + 1] * p0 + cov[k + 3] * p1 + cov[k + 4] * p2;
      const s2 = cov[k + 2] * p0 + cov[k + 4] * p1 + cov[k + 5] * p2;
      uu = grow * (p0 * s0 + p1 * s1 + p2 * s2) + rules.blur_px2;
      uv = grow * (q0 * s0 + q1 * s1 + q2 * s2);
      vv = grow * (cov[k] * q0 * q0 + cov[k + 3] * q1 * q1 + cov[k + 5] * q2 * q2
        + 2 * (cov[k + 1] * q0 * q1 + cov[k + 2] * q0 * q2 + cov[k + 4] * q1 * q2)) + rules.blur_px2;
    }
    const reach = 2 * Math.log(opacity / rules.alpha_min);
    const halfWidth = Math.sqrt(reach * uu), halfHeight = Math.sqrt(reach * vv);
    if (u + halfWidth < -margin || u - halfWidth > width + margin) continue;
    if (v + halfHeight < -margin || v - halfHeight > height + margin) continue;
    const det = uu * vv - uv * uv;
    if (!(det > 0)) continue;
    out.row[count] = i;
    out.u[count] = u;
    out.v[count] = v;
    out.A[count] = vv / det;
    out.B[count] = -uv / det;
    out.C[count] = uu / det;
    out.opacity[count] = opacity;
    out.halfWidth[count] = halfWidth;
    out.halfHeight[count] = halfHeight;
    out.depth[count++] = z;
  }
  out.count = count;
  return out;
}

/** Indices into the projected arrays, nearest first, by a counting sort over 65536 steps of depth. */
export function depthOrder({ depth, count }) {
  let near = Infinity, far = 0;
  for (let i = 0; i < count; i++) {
    if (depth[i] < near) near = depth[i];
    if (depth[i] > far) far = depth[i];
  }
  const step = 65535 / Math.max(far - near, 1e-9);
  const starts = new Uint32Array(65537);
  for (let i = 0; i < count; i++) starts[((depth[i] - near) * step | 0) + 1]++;
  for (let i = 1; i < 65537; i++) starts[i] += starts[i - 1];
  const order = new Uint32Array(count);
  for (let i = 0; i < count; i++) order[starts[(depth[i] - near) * step | 0]++] = i;
  return order;
}

/** alpha of projected Gaussian `i` at a point of the picture. */
export function alphaAt(p, i, x, y) {
  const dx = x - p.u[i], dy = y - p.v[i];
  return p.opacity[i] * Math.exp(-0.5 * (p.A[i] * dx * dx + p.C[i] * dy * dy) - p.B[i] * dx * dy);
}

/** The front-most Gaussian whose alpha at the point reaches `rules.pick_alpha`; else the strongest there; else -1. */
export function pickAt(p, order, x, y, rules) {
  let best = -1, strongest = rules.alpha_min;
  for (const i of order) {
    if (Math.abs(x - p.u[i]) > p.halfWidth[i] || Math.abs(y - p.v[i]) > p.halfHeight[i]) continue;
    const alpha = alphaAt(p, i, x, y);
    if (alpha >= rules.pick_alpha) return i;
    if (alpha >= strongest) [best, strongest] = [i, alpha];
  }
  return best;
}
