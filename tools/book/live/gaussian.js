// One Gaussian: dragged, turned and stretched; its footprint, its covariance on the image and its ellipse.
const CAMERA = { width: 80, height: 60, fx: 52, fy: 52, cx: 40, cy: 30 };
const POINTS = 300;

/** Numbers of a standard normal distribution, the same each time (Box and Muller). */
function normalNumbers(n, seed) {
  const random = randomNumbers(seed);
  return Array.from({ length: n }, () => Math.sqrt(-2 * Math.log(random() || 1e-9)) * Math.cos(2 * Math.PI * random()));
}

/** A map of one row: turned by `turn` about the viewing axis after `lean` about the vertical axis, degrees. */
function oneGaussian({ x, y, z, turn, lean, long, wide, opacity }) {
  const map = emptyMap(1), [t, l] = [turn, lean].map((degrees) => (degrees * Math.PI) / 360);
  map.xyz_W.set([x, y, z]);
  map.log_scale.set([long, wide, 0.03].map(Math.log));
  map.quat.set([Math.cos(t) * Math.cos(l), -Math.sin(t) * Math.sin(l), Math.cos(t) * Math.sin(l), Math.sin(t) * Math.cos(l)]);
  map.opacity_logit[0] = Math.log(opacity / (1 - opacity));
  map.sh.set([0.25, 0.6, 1].map((c) => (c - 0.5) / SH_C0));
  return map;
}

function start(section) {
  const centre = { x: -0.05, y: 0.02 };
  const panel = openPanel(section, { draw, words: { turn: (x) => `${x}°`, lean: (x) => `${x}°` } });
  const view = panel.picture("view", CAMERA);
  const cloud = [1, 2, 3].map((seed) => normalNumbers(POINTS, seed));
  const now = () => splatOf(oneGaussian({ ...panel.values(), ...centre }), 0, CAMERA, IDENTITY_VIEW);
  const middle = () => {
    const { x, y, z } = now();
    return [(CAMERA.fx * x) / z + CAMERA.cx, (CAMERA.fy * y) / z + CAMERA.cy];
  };
  const end = (axis) => () => {
    const { M } = now(), [u, v] = middle();
    return [u + 2 * M[axis], v + 2 * M[3 + axis]];
  };
  const set = (name, value) => {
    panel.inputs[name].value = value;
  };
  const stretch = (axis) => (px, py) => {
    const { z, lean } = panel.values(), [u, v] = middle(), [dx, dy] = [px - u, py - v];
    const size = ((Math.hypot(dx, dy) / 2) * z) / CAMERA.fx;
    set("turn", (Math.atan2(axis ? -dx : dy, axis ? dy : dx) * 180) / Math.PI);
    if (axis) set("wide", size);
    else set("long", size / Math.max(0.2, Math.cos((lean * Math.PI) / 180)));
  };
  panel.handle(view, "Middle of the Gaussian", {
    at: middle,
    move: (px, py) => {
      const { z } = panel.values();
      Object.assign(centre, { x: ((px - CAMERA.cx) / CAMERA.fx) * z, y: ((py - CAMERA.cy) / CAMERA.fy) * z });
    },
  });
  panel.handle(view, "End of its long axis", { at: end(0), move: stretch(0), className: "gsnb-live-square" });
  panel.handle(view, "End of its other axis", { at: end(1), move: stretch(1), className: "gsnb-live-square" });

  /** Points of the 3D Gaussian, each through the pinhole. */
  function drawPoints(map, { R, s, x, y, z }) {
    view.fillStyle = "#ffb000";
    for (let i = 0; i < POINTS; i++) {
      const offset = [0, 1, 2].map((row) => R[3 * row] * s[0] * cloud[0][i] + R[3 * row + 1] * s[1] * cloud[1][i] + R[3 * row + 2] * s[2] * cloud[2][i]);
      if (z + offset[2] < 0.05) continue;
      const [u, v] = project(CAMERA, [x + offset[0], y + offset[1], z + offset[2]]);
      view.fillRect(u - 0.25, v - 0.25, 0.5, 0.5);
    }
  }

  function draw(values) {
    const map = oneGaussian({ ...values, ...centre }), { splats, rgb } = renderMap(map, CAMERA, IDENTITY_VIEW);
    const cov = covarianceOf(splats, 0), [u, v] = splats.uv, { long, short, angle } = ellipseOf(cov);
    drawPixels(view, rgb, CAMERA);
    drawEllipse(view, u, v, cov, 1, "#fff", 0.35);
    drawEllipse(view, u, v, cov, 2, "#fff", 0.2);
    if (values.points) drawPoints(map, now());
    const covered = rgb.filter((c, k) => k % 3 === 2 && c > 0).length, [a, b, c] = cov.map((x) => written(x.toFixed(1)));
    const matrix = `<span class="gsnb-live-matrix" role="img" aria-label="rows ${a}, ${b} and ${b}, ${c}"><span>${a}</span><span>${b}</span><span>${b}</span><span>${c}</span></span>`;
    return `Covariance on the image, px²: ${matrix} Its ellipse of one standard deviation has half axes of <b>${long.toFixed(1)}</b> and
      <b>${short.toFixed(1)} px</b>, turned by ${written(((angle * 180) / Math.PI).toFixed(0))}°. It colours <b>${covered.toLocaleString("en")}</b> pixels.`;
  }
}
