// From 3D Gaussians to pixels: the equations of gsfusion_nb/render (project.py, composite.py), in double precision.
//
// A map is {n, xyz_W, log_scale, quat, opacity_logit, sh}: one Float64Array per parameter, row after row, colours of degree 0.
const NEAR_PLANE_M = 0.2;
const SCREEN_BLUR_PX2 = 0.3;
const FRUSTUM_CLAMP = 1.3;
const ALPHA_MAX = 0.99;
const ALPHA_MIN = 1 / 255;
const TRANSMITTANCE_MIN = 1e-4;
const SH_C0 = 0.28209479177387814;
const TILE_PX = 8;
const COLUMNS = { xyz_W: 3, log_scale: 3, quat: 4, opacity_logit: 1, sh: 3 };

/** A map of n Gaussians, all numbers 0. */
function emptyMap(n) {
  const columns = Object.entries(COLUMNS).map(([name, width]) => [name, new Float64Array(n * width)]);
  return { n, ...Object.fromEntries(columns) };
}

/** The three rows of a product of 3x3 matrices, nine numbers each. */
function product(a, b) {
  const out = new Float64Array(9);
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) out[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  }
  return out;
}

/** Rotation matrix of a quaternion wxyz at q[at], normalised first. */
function rotation(quat, at = 0) {
  const norm = Math.hypot(quat[at], quat[at + 1], quat[at + 2], quat[at + 3]) || 1e-12;
  const w = quat[at] / norm, x = quat[at + 1] / norm, y = quat[at + 2] / norm, z = quat[at + 3] / norm;
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/** World to camera {W, t} from a pose T_WC, three rows of four. */
function viewOf(T_WC) {
  const W = [0, 1, 2].flatMap((j) => [0, 1, 2].map((i) => T_WC[i][j]));
  const t = [0, 1, 2].map((i) => -(W[3 * i] * T_WC[0][3] + W[3 * i + 1] * T_WC[1][3] + W[3 * i + 2] * T_WC[2][3]));
  return { W, t };
}

const IDENTITY_VIEW = { W: [1, 0, 0, 0, 1, 0, 0, 0, 1], t: [0, 0, 0] };
const sigmoid = (x) => 1 / (1 + Math.exp(-x));

/**
 * One Gaussian on its way to the screen, with the papers' letters; null behind the near plane.
 * M = J W R S [2, 3], cov = M M^T + 0.3 I (Kerbl Eq. 5 and 6), conic = its inverse.
 */
function splatOf(map, i, camera, { W, t }) {
  const [a, b, c] = [map.xyz_W[3 * i], map.xyz_W[3 * i + 1], map.xyz_W[3 * i + 2]];
  const x = W[0] * a + W[1] * b + W[2] * c + t[0];
  const y = W[3] * a + W[4] * b + W[5] * c + t[1];
  const z = W[6] * a + W[7] * b + W[8] * c + t[2];
  if (!(z > NEAR_PLANE_M)) return null;
  const limitX = (FRUSTUM_CLAMP * 0.5 * camera.width) / camera.fx, limitY = (FRUSTUM_CLAMP * 0.5 * camera.height) / camera.fy;
  const tx = Math.max(-limitX, Math.min(limitX, x / z)), ty = Math.max(-limitY, Math.min(limitY, y / z));
  const f = camera.fx / z, g = camera.fy / z;
  const R = rotation(map.quat, 4 * i), WR = product(W, R);
  const s = [0, 1, 2].map((k) => Math.exp(map.log_scale[3 * i + k]));
  const M = new Float64Array(6);
  for (let k = 0; k < 3; k++) {
    M[k] = (f * WR[k] - f * tx * WR[6 + k]) * s[k];
    M[3 + k] = (g * WR[3 + k] - g * ty * WR[6 + k]) * s[k];
  }
  const uu = M[0] * M[0] + M[1] * M[1] + M[2] * M[2] + SCREEN_BLUR_PX2;
  const vv = M[3] * M[3] + M[4] * M[4] + M[5] * M[5] + SCREEN_BLUR_PX2;
  const uv = M[0] * M[3] + M[1] * M[4] + M[2] * M[5];
  const det = uu * vv - uv * uv;
  return { x, y, z, tx, ty, f, g, R, WR, s, M, cov: [uu, uv, vv], conic: [vv / det, -uv / det, uu / det] };
}

/** Every Gaussian of a map as an ellipse: {n, uv, conic, depth_m, opacity, extent_px, rgb, visible}, row after row. */
function projectGaussians(map, camera, view) {
  const { n } = map;
  const splats = {
    n, uv: new Float64Array(2 * n), conic: new Float64Array(3 * n), depth_m: new Float64Array(n), opacity: new Float64Array(n),
    extent_px: new Float64Array(2 * n), rgb: new Float64Array(3 * n), visible: new Uint8Array(n),
  };
  for (let i = 0; i < n; i++) {
    const s = splatOf(map, i, camera, view);
    splats.opacity[i] = sigmoid(map.opacity_logit[i]);
    for (let k = 3 * i; k < 3 * i + 3; k++) splats.rgb[k] = Math.max(0, 0.5 + SH_C0 * map.sh[k]);
    if (!s) continue;
    splats.uv[2 * i] = (camera.fx * s.x) / s.z + camera.cx;
    splats.uv[2 * i + 1] = (camera.fy * s.y) / s.z + camera.cy;
    splats.conic.set(s.conic, 3 * i);
    splats.depth_m[i] = s.z;
    const reach = 2 * Math.log(Math.max(1, splats.opacity[i] / ALPHA_MIN)); // o exp(-sigma) = 1/255
    splats.extent_px[2 * i] = Math.sqrt(reach * s.cov[0]);
    splats.extent_px[2 * i + 1] = Math.sqrt(reach * s.cov[2]);
    splats.visible[i] = splats.opacity[i] >= ALPHA_MIN && Number.isFinite(splats.extent_px[2 * i]) ? 1 : 0;
  }
  return splats;
}

/** Rows that are drawn, nearest first. */
const nearestFirst = ({ n, visible, depth_m }) =>
  Array.from({ length: n }, (_, i) => i).filter((i) => visible[i]).sort((i, j) => depth_m[i] - depth_m[j]);

/** alpha of Gaussian i at a point of the image: at most 0.99, and 0 below 1/255 (RTG-SLAM Eq. 2). */
function alphaAt({ uv, conic, opacity }, i, x, y) {
  const dx = x - uv[2 * i], dy = y - uv[2 * i + 1];
  const sigma = (conic[3 * i] * dx * dx + conic[3 * i + 2] * dy * dy) / 2 + conic[3 * i + 1] * dx * dy;
  const alpha = Math.min(ALPHA_MAX, opacity[i] * Math.exp(-sigma));
  return alpha >= ALPHA_MIN ? alpha : 0;
}

/** What is blended at a point, nearest first: [{row, alpha, T, w}], until less than 1e-4 of the light would be left. */
function stackAt(splats, order, x, y) {
  const stack = [];
  let T = 1;
  for (const row of order) {
    const alpha = alphaAt(splats, row, x, y);
    if (!alpha) continue;
    if (T * (1 - alpha) < TRANSMITTANCE_MIN) break;
    stack.push({ row, alpha, T, w: alpha * T });
    T *= 1 - alpha;
  }
  return stack;
}

/** Lists of rows, nearest first, for each tile of 8x8 pixels that their boxes touch. */
function tileLists(splats, order, { width, height }) {
  const across = Math.ceil(width / TILE_PX), down = Math.ceil(height / TILE_PX);
  const lists = Array.from({ length: across * down }, () => []);
  const { uv, extent_px } = splats;
  for (const i of order) {
    const x0 = Math.max(0, Math.floor((uv[2 * i] - extent_px[2 * i]) / TILE_PX));
    const x1 = Math.min(across - 1, Math.floor((uv[2 * i] + extent_px[2 * i]) / TILE_PX));
    const y0 = Math.max(0, Math.floor((uv[2 * i + 1] - extent_px[2 * i + 1]) / TILE_PX));
    const y1 = Math.min(down - 1, Math.floor((uv[2 * i + 1] + extent_px[2 * i + 1]) / TILE_PX));
    for (let y = y0; y <= y1; y++) for (let x = x0; x <= x1; x++) lists[y * across + x].push(i);
  }
  return { lists, across };
}

/** Calls visit(tile's list, pixel's index, x, y) for every pixel. */
function eachPixel({ lists, across }, { width, height }, visit) {
  lists.forEach((list, tile) => {
    const left = (tile % across) * TILE_PX, top = Math.floor(tile / across) * TILE_PX;
    for (let y = top; y < Math.min(top + TILE_PX, height); y++) {
      for (let x = left; x < Math.min(left + TILE_PX, width); x++) visit(list, y * width + x, x + 0.5, y + 0.5);
    }
  });
}

/** The picture over black, C = sum_k alpha_k T_k c_k front to back (Kerbl Eq. 3), and the tiles it was made with. */
function composite(splats, camera, order = nearestFirst(splats)) {
  const rgb = new Float64Array(3 * camera.width * camera.height), tiles = tileLists(splats, order, camera);
  const colour = splats.rgb;
  eachPixel(tiles, camera, (list, pixel, x, y) => {
    let T = 1, r = 0, g = 0, b = 0;
    for (let k = 0; k < list.length; k++) {
      const i = list[k], alpha = alphaAt(splats, i, x, y);
      if (alpha === 0) continue;
      const behind = T * (1 - alpha);
      if (behind < TRANSMITTANCE_MIN) break;
      const w = alpha * T;
      r += w * colour[3 * i];
      g += w * colour[3 * i + 1];
      b += w * colour[3 * i + 2];
      T = behind;
    }
    rgb[3 * pixel] = r;
    rgb[3 * pixel + 1] = g;
    rgb[3 * pixel + 2] = b;
  });
  return { rgb, tiles };
}

/** The picture of a map. */
function renderMap(map, camera, view) {
  const splats = projectGaussians(map, camera, view);
  return { splats, ...composite(splats, camera) };
}
