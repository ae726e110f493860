// Which Gaussians made a pixel, front to back: the formulas of gsfusion_nb/render/composite.py in the page. Without a page, so
// that node runs it, too.
const ALPHA_MAX = 0.99, ALPHA_MIN = 1 / 255, LIGHT_MIN = 1e-4;
const COLUMNS = 11; // u, v, A, B, C, opacity, depth, red, green, blue, row

/** The Gaussians on the screen, nearest first, from the float32 values that book/views/microscopes.py wrote. */
export function splatsOf(values) {
  return { values, count: values.length / COLUMNS };
}

export function splat({ values }, k) {
  const [u, v, A, B, C, opacity, depth, r, g, b, row] = values.subarray(k * COLUMNS, (k + 1) * COLUMNS);
  return { u, v, A, B, C, opacity, depth, rgb: [r, g, b], row };
}

/** Alpha of Gaussian `k` at the centre of a pixel. */
function alphaAt({ values }, k, u, v) {
  const at = k * COLUMNS;
  const dx = u + 0.5 - values[at], dy = v + 0.5 - values[at + 1];
  const sigma = (values[at + 2] * dx * dx + values[at + 4] * dy * dy) / 2 + values[at + 3] * dx * dy;
  return Math.min(values[at + 5] * Math.exp(-sigma), ALPHA_MAX);
}

/** The stack of the pixel in column `u` and row `v`: every Gaussian with a weight, and the light that is left behind all. */
export function stackAt(splats, u, v) {
  const stack = [], colour = [0, 0, 0];
  let light = 1; // T
  for (let k = 0; k < splats.count; k++) {
    const alpha = alphaAt(splats, k, u, v);
    if (!(alpha >= ALPHA_MIN)) continue;
    if (light * (1 - alpha) < LIGHT_MIN) break; // blending stops before the Gaussian behind which no light would be left
    const weight = alpha * light;
    const one = { ...splat(splats, k), alpha, light, weight };
    one.rgb.forEach((c, i) => (colour[i] += weight * c));
    stack.push(one);
    light *= 1 - alpha;
  }
  return { u, v, stack, colour, light };
}

/** The ellipse of one standard deviation as points, pixels. */
export function outline({ u, v, A, B, C }, points = 48) {
  const det = A * C - B * B;
  const uu = C / det, uv = -B / det, vv = A / det;
  const l11 = Math.sqrt(uu), l21 = uv / l11, l22 = Math.sqrt(Math.max(vv - l21 * l21, 0));
  return Array.from({ length: points }, (_, k) => {
    const t = (2 * Math.PI * k) / points;
    return [u + l11 * Math.cos(t), v + l21 * Math.cos(t) + l22 * Math.sin(t)];
  });
}
