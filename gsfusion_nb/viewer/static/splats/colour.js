// The colour of each projected Gaussian: its own, or one that shows a quantity.

/** 256 colours, 0..1, from "rrggbbrrggbb...". */
export function palette(hex) {
  return Float32Array.from({ length: 768 }, (_, k) => parseInt(hex.slice(2 * k, 2 * k + 2), 16) / 255);
}

/** Colour seen from `centre`: max(0, 1/2 + sum_k Y_k(d) sh_k), signs and order as geometry/spherical_harmonics.py. */
export function harmonicColour(rows, row, centre, out, at) {
  const K = rows.layout.harmonics, sh = rows.sh, base = 3 * K * row;
  let r = 0.5 + 0.28209479177387814 * sh[base], g = 0.5 + 0.28209479177387814 * sh[base + 1];
  let b = 0.5 + 0.28209479177387814 * sh[base + 2];
  if (K > 1) {
    let x = rows.xyz[3 * row] - centre[0], y = rows.xyz[3 * row + 1] - centre[1], z = rows.xyz[3 * row + 2] - centre[2];
    const inv = 1 / Math.max(Math.sqrt(x * x + y * y + z * z), 1e-12);
    basis(x * inv, y * inv, z * inv, K);
    for (let k = 1, i = base + 3; k < K; k++, i += 3) {
      r += Y[k] * sh[i];
      g += Y[k] * sh[i + 1];
      b += Y[k] * sh[i + 2];
    }
  }
  out[at] = Math.max(0, r);
  out[at + 1] = Math.max(0, g);
  out[at + 2] = Math.max(0, b);
}

const Y = new Float64Array(16);

function basis(x, y, z, K) {
  const xx = x * x, yy = y * y, zz = z * z;
  Y[1] = -0.4886025119029199 * y;
  Y[2] = 0.4886025119029199 * z;
  Y[3] = -0.4886025119029199 * x;
  if (K < 9) return;
  Y[4] = 1.0925484305920792 * x * y;
  Y[5] = -1.0925484305920792 * y * z;
  Y[6] = 0.31539156525252005 * (2 * zz - xx - yy);
  Y[7] = -1.0925484305920792 * x * z;
  Y[8] = 0.5462742152960396 * (xx - yy);
  if (K < 16) return;
  Y[9] = -0.5900435899266435 * y * (3 * xx - yy);
  Y[10] = 2.890611442640554 * x * y * z;
  Y[11] = -0.4570457994644658 * y * (4 * zz - xx - yy);
  Y[12] = 0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy);
  Y[13] = -0.4570457994644658 * x * (4 * zz - xx - yy);
  Y[14] = 1.445305721320277 * z * (xx - yy);
  Y[15] = -0.5900435899266435 * x * (xx - 3 * yy);
}

/**
 * Colours of the projected Gaussians. [3 count]
 * paint: {by: "rgb" | "depth" | "opacity" | "column", column, low, high, palette (hex)}
 */
export function colours(rows, p, centre, paint, out) {
  const { row, count } = p;
  if (paint.by === "rgb") {
    for (let i = 0; i < count; i++) harmonicColour(rows, row[i], centre, out, 3 * i);
    return;
  }
  const table = palette(paint.palette);
  const columns = rows.layout.columns;
  const step = 255 / Math.max(paint.high - paint.low, 1e-9);
  for (let i = 0; i < count; i++) {
    let value = p.depth[i];
    if (paint.by === "opacity") value = rows.opacity[row[i]];
    if (paint.by === "column") value = rows.values[columns * row[i] + paint.column];
    const level = Math.max(0, Math.min(255, Math.round((value - paint.low) * step)));
    for (let k = 0; k < 3; k++) out[3 * i + k] = table[3 * level + k];
  }
}

/** 2nd and 98th percentile of the depths in view, metres: the range of the depth colours. */
export function depthRange({ depth, count }) {
  if (!count) return [0, 1];
  const stride = Math.ceil(count / 4000);
  const some = Float32Array.from({ length: Math.ceil(count / stride) }, (_, k) => depth[k * stride]).sort();
  const at = (q) => some[Math.floor(q * (some.length - 1))];
  return [at(0.02), Math.max(at(0.98), at(0.02) + 1e-3)];
}
