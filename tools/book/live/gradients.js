// The gradients of splats.js by hand, the loss and Adam: the equations of gsfusion_nb/render and gsfusion_nb/optim. v_x is dL/dx.

/** dL/dq of rotation(q) from dL/dR, nine numbers (Kerbl, appendix A), for the unit quaternion and through its normalisation. */
function rotationVjp(quat, at, v) {
  const norm = Math.hypot(quat[at], quat[at + 1], quat[at + 2], quat[at + 3]) || 1e-12;
  const [w, x, y, z] = [0, 1, 2, 3].map((k) => quat[at + k] / norm);
  const v_unit = [
    2 * (x * (v[7] - v[5]) + y * (v[2] - v[6]) + z * (v[3] - v[1])),
    2 * (-2 * x * (v[4] + v[8]) + y * (v[1] + v[3]) + z * (v[2] + v[6]) + w * (v[7] - v[5])),
    2 * (x * (v[1] + v[3]) - 2 * y * (v[0] + v[8]) + z * (v[5] + v[7]) + w * (v[2] - v[6])),
    2 * (x * (v[2] + v[6]) + y * (v[5] + v[7]) - 2 * z * (v[0] + v[4]) + w * (v[3] - v[1])),
  ];
  const along = w * v_unit[0] + x * v_unit[1] + y * v_unit[2] + z * v_unit[3];
  return [w, x, y, z].map((q, k) => (v_unit[k] - q * along) / norm);
}

/** Gradient of composite from v_rgb of the picture: {uv, conic, opacity, rgb}, row after row. Equations: composite.py. */
function compositeVjp(splats, { rgb, tiles }, camera, v_rgb) {
  const { n, uv, conic, opacity, rgb: colour } = splats;
  const v = { uv: new Float64Array(2 * n), conic: new Float64Array(3 * n), opacity: new Float64Array(n), rgb: new Float64Array(3 * n) };
  eachPixel(tiles, camera, (list, pixel, x, y) => {
    const r = v_rgb[3 * pixel], g = v_rgb[3 * pixel + 1], b = v_rgb[3 * pixel + 2];
    if (r === 0 && g === 0 && b === 0) return;
    let T = 1, behind = rgb[3 * pixel] * r + rgb[3 * pixel + 1] * g + rgb[3 * pixel + 2] * b; // S_k: of those behind
    for (let k = 0; k < list.length; k++) {
      const i = list[k], alpha = alphaAt(splats, i, x, y);
      if (alpha === 0) continue;
      if (T * (1 - alpha) < TRANSMITTANCE_MIN) break;
      const w = alpha * T, c_dot_v = colour[3 * i] * r + colour[3 * i + 1] * g + colour[3 * i + 2] * b;
      behind -= w * c_dot_v;
      v.rgb[3 * i] += w * r;
      v.rgb[3 * i + 1] += w * g;
      v.rgb[3 * i + 2] += w * b;
      if (alpha < ALPHA_MAX) {
        const v_alpha = T * c_dot_v - behind / (1 - alpha), v_sigma = -v_alpha * alpha;
        const dx = x - uv[2 * i], dy = y - uv[2 * i + 1];
        v.opacity[i] += (v_alpha * alpha) / opacity[i];
        v.uv[2 * i] -= v_sigma * (conic[3 * i] * dx + conic[3 * i + 1] * dy);
        v.uv[2 * i + 1] -= v_sigma * (conic[3 * i + 1] * dx + conic[3 * i + 2] * dy);
        v.conic[3 * i] += (v_sigma * dx * dx) / 2;
        v.conic[3 * i + 1] += v_sigma * dx * dy;
        v.conic[3 * i + 2] += (v_sigma * dy * dy) / 2;
      }
      T *= 1 - alpha;
    }
  });
  return v;
}

/** Gradient of one row of projectGaussians, written into a map of gradients. Equations: project.py. */
function splatVjp(map, i, camera, view, v, gradient) {
  const s = splatOf(map, i, camera, view);
  if (!s) return;
  const { M, WR, f, g, z } = s, [A, B, C] = s.conic;
  const v_A = v.conic[3 * i], v_B = v.conic[3 * i + 1] / 2, v_C = v.conic[3 * i + 2];
  // v_cov = -Q v_Q Q
  const a = A * v_A + B * v_B, b = A * v_B + B * v_C, c = B * v_A + C * v_B, d = B * v_B + C * v_C;
  const v_uu = -(a * A + b * B), v_uv = -(a * B + b * C), v_vv = -(c * B + d * C);
  // cov = M M^T + 0.3 I,  M = J (W R S)
  const v_M = new Float64Array(6);
  for (let k = 0; k < 3; k++) {
    v_M[k] = 2 * (v_uu * M[k] + v_uv * M[3 + k]);
    v_M[3 + k] = 2 * (v_uv * M[k] + v_vv * M[3 + k]);
  }
  const v_J = [0, 0, 0, 0, 0, 0];
  const J = [f, 0, -f * s.tx, 0, g, -g * s.ty], v_R = new Float64Array(9), W = view.W;
  for (let k = 0; k < 3; k++) {
    for (let row = 0; row < 3; row++) {
      v_J[row] += v_M[k] * WR[3 * row + k] * s.s[k];
      v_J[3 + row] += v_M[3 + k] * WR[3 * row + k] * s.s[k];
    }
    const v_WR = [0, 1, 2].map((row) => J[row] * v_M[k] + J[3 + row] * v_M[3 + k]); // J^T v_M, column k
    gradient.log_scale[3 * i + k] = s.s[k] * (WR[k] * v_WR[0] + WR[3 + k] * v_WR[1] + WR[6 + k] * v_WR[2]);
    for (let row = 0; row < 3; row++) {
      v_R[3 * row + k] = (W[row] * v_WR[0] + W[3 + row] * v_WR[1] + W[6 + row] * v_WR[2]) * s.s[k];
    }
  }
  gradient.quat.set(rotationVjp(map.quat, 4 * i, v_R), 4 * i);
  const v_tx = s.tx === s.x / z ? (-camera.fx / z) * v_J[2] : 0, v_ty = s.ty === s.y / z ? (-camera.fy / z) * v_J[5] : 0;
  const v_x = (camera.fx * v.uv[2 * i] + v_tx) / z, v_y = (camera.fy * v.uv[2 * i + 1] + v_ty) / z;
  const v_z = -(s.x * v_x + s.y * v_y + J.reduce((sum, value, k) => sum + value * v_J[k], 0)) / z;
  for (let k = 0; k < 3; k++) gradient.xyz_W[3 * i + k] = W[k] * v_x + W[3 + k] * v_y + W[6 + k] * v_z;
}

/** Gradient of renderMap from v_rgb of its picture: {map: of every parameter, splats: of every ellipse}. */
function renderMapVjp(map, camera, view, drawn, v_rgb) {
  const v = compositeVjp(drawn.splats, drawn, camera, v_rgb), gradient = emptyMap(map.n);
  for (let i = 0; i < map.n; i++) {
    if (drawn.splats.visible[i]) splatVjp(map, i, camera, view, v, gradient);
    gradient.opacity_logit[i] = v.opacity[i] * drawn.splats.opacity[i] * (1 - drawn.splats.opacity[i]);
    for (let k = 3 * i; k < 3 * i + 3; k++) gradient.sh[k] = drawn.splats.rgb[k] > 0 ? SH_C0 * v.rgb[k] : 0;
  }
  return { map: gradient, splats: v };
}

/** L1 of two pictures, its gradient, and the PSNR of the picture clamped to 0..1, dB (GSFusion Eq. 12). */
function pictureLoss(rgb, target) {
  const v_rgb = new Float64Array(rgb.length);
  let sum = 0, squares = 0;
  for (let k = 0; k < rgb.length; k++) {
    const gap = rgb[k] - target[k], shown = Math.max(0, Math.min(1, rgb[k])) - target[k];
    sum += Math.abs(gap);
    squares += shown * shown;
    v_rgb[k] = Math.sign(gap) / rgb.length;
  }
  return { value: sum / rgb.length, v_rgb, psnr: -10 * Math.log10(squares / rgb.length) };
}

/** One step of Adam, in place (Kingma & Ba, algorithm 1); t counts the steps, this one included. */
function adamUpdate(param, gradient, m, v, t, lr, { beta1, beta2, eps } = { beta1: 0.9, beta2: 0.999, eps: 1e-15 }) {
  const bias1 = 1 - beta1 ** t, bias2 = 1 - beta2 ** t;
  for (let k = 0; k < param.length; k++) {
    m[k] = beta1 * m[k] + (1 - beta1) * gradient[k];
    v[k] = beta2 * v[k] + (1 - beta2) * gradient[k] * gradient[k];
    param[k] -= (lr * (m[k] / bias1)) / (Math.sqrt(v[k] / bias2) + eps);
  }
}
