// The software rasteriser: front-to-back blending as in gsfusion_nb/render/composite.py, one Gaussian after another.

/** Block of pixels for which one test decides whether anything behind is still visible. */
const BLOCK = 8;

/**
 * Blend the projected Gaussians over a background into RGBA bytes.
 *
 *   alpha = min(alpha_max, o exp(-sigma)), skipped below alpha_min; a pixel ends before T < transmittance_min
 *
 * Along a line of pixels exp(-sigma) follows a recurrence of two products per pixel, so no exp is in the inner loop.
 */
export function rasterise(p, order, rgb, width, height, background, rules, scratch = {}) {
  const n = width * height;
  if (scratch.light?.length !== n) {
    Object.assign(scratch, { light: new Float32Array(n), sum: new Float32Array(3 * n) });
  }
  const { light, sum } = scratch; // light: transmittance, negative where the pixel is finished
  light.fill(1);
  sum.fill(0);
  const blocksX = Math.ceil(width / BLOCK);
  const open = openPixels(width, height, blocksX);
  const { alpha_min: least, alpha_max: most, transmittance_min: end } = rules;
  for (let k = 0; k < order.length; k++) {
    const i = order[k];
    const u = p.u[i], v = p.v[i], A = p.A[i], B = p.B[i], C = p.C[i], o = p.opacity[i];
    const reach = 2 * Math.log(o / least);
    const y0 = Math.max(0, Math.ceil(v - p.halfHeight[i] - 0.5)), y1 = Math.min(height - 1, Math.floor(v + p.halfHeight[i] - 0.5));
    const left = Math.max(0, Math.ceil(u - p.halfWidth[i] - 0.5)), right = Math.min(width - 1, Math.floor(u + p.halfWidth[i] - 0.5));
    if (left > right || y0 > y1 || allFinished(open, blocksX, left, right, y0, y1)) continue;
    const r = rgb[3 * i], g = rgb[3 * i + 1], b = rgb[3 * i + 2];
    const bend = Math.exp(-A);
    for (let y = y0; y <= y1; y++) {
      const dy = y + 0.5 - v;
      const under = B * B * dy * dy - A * (C * dy * dy - reach); // where on this line alpha reaches alpha_min
      if (under < 0) continue;
      const half = Math.sqrt(under) / A, middle = u - (B * dy) / A - 0.5;
      const x0 = Math.max(0, Math.ceil(middle - half)), x1 = Math.min(width - 1, Math.floor(middle + half));
      if (x0 > x1) continue;
      const dx = x0 + 0.5 - u;
      let value = o * Math.exp(-0.5 * (A * dx * dx + C * dy * dy) - B * dx * dy);
      let ratio = Math.exp(-A * (dx + 0.5) - B * dy);
      for (let at = y * width + x0, last = y * width + x1; at <= last; at++) {
        const T = light[at];
        if (T > 0) {
          const alpha = value < most ? value : most;
          const next = T * (1 - alpha);
          if (next < end) {
            light[at] = -T;
            open[(y >> 3) * blocksX + ((at - y * width) >> 3)]--;
          } else {
            const w = alpha * T;
            sum[3 * at] += w * r;
            sum[3 * at + 1] += w * g;
            sum[3 * at + 2] += w * b;
            light[at] = next;
          }
        }
        value *= ratio;
        ratio *= bend;
      }
    }
  }
  return blended(light, sum, background);
}

/** How many pixels of each block are unfinished. */
function openPixels(width, height, blocksX) {
  const blocksY = Math.ceil(height / BLOCK);
  const open = new Uint8Array(blocksX * blocksY);
  for (let y = 0; y < blocksY; y++) {
    for (let x = 0; x < blocksX; x++) {
      open[y * blocksX + x] = Math.min(BLOCK, width - x * BLOCK) * Math.min(BLOCK, height - y * BLOCK);
    }
  }
  return open;
}

function allFinished(open, blocksX, left, right, top, bottom) {
  for (let y = top >> 3; y <= bottom >> 3; y++) {
    for (let x = left >> 3; x <= right >> 3; x++) if (open[y * blocksX + x]) return false;
  }
  return true;
}

function blended(light, sum, [r, g, b]) {
  const out = new Uint8ClampedArray(4 * light.length); // clamps and rounds
  for (let i = 0; i < light.length; i++) {
    const T = Math.abs(light[i]);
    out[4 * i] = 255 * (sum[3 * i] + T * r);
    out[4 * i + 1] = 255 * (sum[3 * i + 1] + T * g);
    out[4 * i + 2] = 255 * (sum[3 * i + 2] + T * b);
    out[4 * i + 3] = 255;
  }
  return out;
}
