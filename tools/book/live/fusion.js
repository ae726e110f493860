// Chapter 2: the depth of several frames, averaged along the rays of one row of pixels.
const NEAR = 0.42, STEP = 0.04, SAMPLES = 85, FAR = 3.8, PX = 100; // samples of a ray, metres; pixels per metre

async function start(section) {
  const { camera, poses } = DATA, { width, height, fx, cx } = camera, n = width * height, middle = Math.ceil((cx / fx) * FAR * PX);
  const [truth, ...depths] = await unpacked(DATA.depth, Uint16Array, n, 1e-4), photo = await photograph(DATA.photos[0]);
  const size = { width: 2 * middle, height: FAR * PX }, zOf = (k) => NEAR + STEP * k, y = (z) => size.height - z * PX;
  const panel = openPanel(section, { draw });
  const first = panel.picture("first", camera), slice = panel.picture("slice", size), curve = panel.chart("curve");
  const choose = (u, v) => {
    panel.inputs.u.value = Math.floor(u);
    if (v !== undefined) panel.inputs.v.value = Math.floor(v);
  };
  panel.press(first, choose);
  panel.handle(first, "Pixel", { at: () => [Number(panel.inputs.u.value) + 0.5, Number(panel.inputs.v.value) + 0.5], move: choose, className: "gsnb-live-ring" });
  panel.press(slice, (x, z) => choose(Math.max(0, Math.min(width - 1, ((x - middle) / (size.height - z)) * fx + cx))));

  function drawSlice(rays, crossings, u) {
    const x = (column, z) => middle + ((column - cx) / fx) * z * PX;
    const mix = (colour, part) => `rgb(${colour.map((c) => 255 + (c - 255) * part)})`;
    Object.assign(slice, { fillStyle: "#888" }).fillRect(0, 0, size.width, size.height);
    rays.forEach((ray, column) => ray.forEach(([D, W], k) => {
      slice.fillStyle = D < 0 ? mix([178, 34, 52], -D) : mix([44, 98, 168], D);
      if (W > 0) slice.fillRect(x(column, zOf(k)), y(zOf(k + 0.5)), (zOf(k) / fx) * PX + 0.5, STEP * PX + 0.5);
    }));
    slice.fillStyle = "#000";
    crossings.forEach((z, column) => slice.fillRect(x(column + 0.5, z) - 2, y(z) - 2, 4, 4));
    stroke(slice, `M${middle} ${y(0)}L${x(u + 0.5, FAR)} 0`, "#ffb000", 2);
  }

  function drawAxes() {
    Object.assign(slice, { fillStyle: "#fff", font: "24px sans-serif", textAlign: "center", strokeStyle: "#000", lineWidth: 4 });
    const write = (text, at, height) => {
      slice.strokeText(text, at, height);
      slice.fillText(text, at, height);
    };
    for (const z of [1, 2, 3]) write(`z = ${z} m`, 62, y(z) + 8);
    [["x = −1", -1], ["0", 0], ["1 m", 1]].forEach(([text, x]) => write(text, middle + x * PX, 26));
  }

  function drawCurve(ray, said, eps, z) {
    const near = [...ray.keys()].filter((k) => Math.abs(zOf(k) - z) < 0.45);
    const line = (known, D, style) => ({ points: near.filter(known).map((k) => [zOf(k), D(k)]), style });
    const each = said[0].map((_, i) => line((k) => said[k][i] > -eps, (k) => Math.min(1, said[k][i] / eps), 'opacity="0.35"'));
    const mean = line((k) => ray[k][1] > 0, (k) => ray[k][0], 'class="gsnb-live-mean"');
    const marks = (X, Y) => `<path d="M46 ${Y(0)}H410"/><path d="M${X(z)} ${Y(1)}V${Y(-1)}" stroke-dasharray="4 4"/>`;
    curve.innerHTML = graph("D along the ray", ["distance z, m", z - 0.45, z + 0.45], ["D", -1.1, 1.1], [...each, mean], marks);
  }

  function draw({ u, v, frames, truncation, maxWeight }) {
    const at = (column, k) => apply(poses[0], backproject(camera, column + 0.5, v + 0.5, zOf(k)));
    const measured = (xyz_W) => poses.slice(0, frames).map((T, i) => signedDistance(camera, depths[i], T, xyz_W));
    const said = Array.from({ length: width }, (_, column) => Array.from({ length: SAMPLES }, (_, k) => measured(at(column, k))));
    const eps = truncation / 100, rays = said.map((ray) => ray.map((distances) => fused(distances, eps, maxWeight)));
    const crossings = rays.map((ray) => zeroCrossing(ray, NEAR, STEP)), right = (column) => truth[v * width + column];
    drawImage(first, photo);
    stroke(first, `M0 ${v + 0.5}H${width}`, "#ffb000", 0.4);
    drawSlice(rays, crossings, u);
    drawAxes();
    drawCurve(rays[u], said[u], eps, right(u));
    const off = (z, column) => 1000 * Math.abs(z - right(column)), z = crossings[u];
    const errors = crossings.map(off).filter((mm) => mm >= 0).sort((a, b) => a - b);
    const where = z > 0 ? `at z = <b>${z.toFixed(3)} m</b>, ${off(z, u).toFixed(0)} mm off` : "nowhere on this ray";
    return `Pixel (${u}, ${v}): the surface is at ${right(u).toFixed(3)} m. After ${frames} frame${frames > 1 ? "s" : ""} D is zero ${where}.<br>
      ${errors.length} of the ${width} rays of this row cross zero, half of them less than ${(errors[errors.length >> 1] ?? 0).toFixed(0)} mm off.`;
  }
}
