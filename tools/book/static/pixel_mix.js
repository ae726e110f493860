// What is mixed in a pixel of GPS-SLAM, in any order: the formulas of gsfusion_nb/render/over_base.py in the page.
const BELOW_COLUMNS = 5; // red, green, blue, depth and weight of the surface, for each pixel

/** Surface and Gaussians of the pixel in column `u` and row `v`, the heaviest Gaussian first; `hidden` lie behind the surface. */
export function mixAt(splats, { values: below, width, behind }, u, v) {
  const [r, g, b, depth, weight] = below.subarray((v * width + u) * BELOW_COLUMNS, (v * width + u + 1) * BELOW_COLUMNS);
  const reach = [];
  for (let k = 0; k < splats.count; k++) {
    const alpha = alphaAt(splats, k, u, v);
    if (alpha >= ALPHA_MIN) reach.push({ ...splat(splats, k), weight: alpha });
  }
  const stack = reach.filter((one) => !(depth > 0 && one.depth > Math.fround(depth + behind)));
  stack.sort((a, b) => b.weight - a.weight || a.row - b.row);
  const surface = { rgb: [r, g, b], weight };
  return { u, v, surface, stack, hidden: reach.length - stack.length, colour: means([surface, ...stack]).at(-1) };
}

/** The weighted mean of the first, of the first two, and so on. */
export function means(samples) {
  const sum = [0, 0, 0];
  let total = 0;
  return samples.map(({ rgb, weight }) => {
    total += weight;
    return rgb.map((c, i) => (sum[i] += weight * c) / Math.max(total, 1e-9));
  });
}

/** The same samples in another order, always the same one for a pixel. */
export function shuffled(samples, seed) {
  const order = [...samples];
  let state = seed;
  for (let k = order.length - 1; k > 0; k--) {
    state = (Math.imul(1664525, state) + 1013904223) >>> 0; // a linear congruential generator
    const other = Math.floor((state / 2 ** 32) * (k + 1));
    [order[k], order[other]] = [order[other], order[k]];
  }
  return order;
}
