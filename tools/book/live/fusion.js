// Chapter 2: the depth of several frames, averaged along the rays of one row of pixels.
const NEAR = 0.42, STEP = 0.04, SAMPLES = 85, FAR = 3.8, PX = 100; // samples of a ray, metres; pixels per metre

async function start(place) {
  const { camera, poses } = DATA, { width, height, fx, cx } = camera, n = width * height, middle = Math.ceil((cx / fx) * FAR * PX);
  const [truth, ...depths] = await unpacked(DATA.depth, Uint16Array, n, 1e-4);
  const photo = await bitmap((await unpacked(DATA.rgb, Uint8Array, 3 * n, 1))[0], camera);
  const size = { width: 2 * middle, height: FAR * PX }, zOf = (k) => NEAR + STEP * k, y = (z) => size.height - z * PX;
  const controls = {
    u: { label: "pixel column u", min: 0, max: width - 1, value: 27 },
    v: { label: "pixel row v", min: 0, max: height - 1, value: 22 },
    frames: { label: "frames", min: 1, max: poses.length, value: 1 },
    truncation: { label: "truncation, cm", min: 1, max: 64, value: 16 },
    maxWeight: { label: "largest weight", min: 1, max: poses.length, value: poses.length },
  };
  const canvas = preparePanel(place, controls, draw);
  const first = canvas(camera, 6, "frame 0: press a pixel", (u, v) => ({ u, v }));
  const rayAt = (x, y) => ({ u: ((x - middle) / (size.height - y)) * fx + cx });
  const slice = canvas(size, 1, "its row from above: red behind, blue free, black D = 0", rayAt);
  const curve = place.firstChild.appendChild(create("figure"));

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
    stroke(slice, `M${middle} ${y(0)}L${x(u + 0.5, FAR)} 0`, "#ffb300", 2);
  }

  function drawCurve(ray, said, eps, z) {
    const X = (at) => 170 + 320 * (at - z), Y = (D) => 110 - 85 * D, near = [...ray.keys()].filter((k) => Math.abs(zOf(k) - z) < 0.45);
    const line = (known, D, style) => `<polyline ${style} points="${near.filter(known).map((k) => [X(zOf(k)), Y(D(k))])}"/>`;
    const each = said[0].map((_, i) => line((k) => said[k][i] > -eps, (k) => Math.min(1, said[k][i] / eps), 'opacity="0.35"'));
    const ticks = [-1, 0, 1].map((t) => `<text y="222" x="${170 + 128 * t}" text-anchor="middle">${(z + 0.4 * t).toFixed(2)} m</text><text x="2" y="${Y(t) + 5}">${t}</text>`);
    curve.innerHTML = `<svg viewBox="0 0 340 226" role="img" aria-label="D along the ray">${ticks.join("")}
      <path d="M24 ${Y(0)}H320"/><path d="M${X(z)} 20V200" stroke-dasharray="4 4"/>${each.join("")}${line((k) => ray[k][1] > 0, (k) => ray[k][0], 'class="gsnb-live-mean"')}</svg>
      <figcaption>D along the ray: each frame (thin), the average, the true depth (dashed)</figcaption>`;
  }

  function draw({ u, v, frames, truncation, maxWeight }) {
    const at = (column, k) => apply(poses[0], backproject(camera, column + 0.5, v + 0.5, zOf(k)));
    const measured = (xyz_W) => poses.slice(0, frames).map((T, i) => signedDistance(camera, depths[i], T, xyz_W));
    const said = Array.from({ length: width }, (_, column) => Array.from({ length: SAMPLES }, (_, k) => measured(at(column, k))));
    const eps = truncation / 100, rays = said.map((ray) => ray.map((distances) => fused(distances, eps, maxWeight)));
    const crossings = rays.map((ray) => zeroCrossing(ray, NEAR, STEP)), right = (column) => truth[v * width + column];
    first.drawImage(photo, 0, 0);
    stroke(first, `M0 ${v + 0.5}H${width}M${u + 0.5} ${v - 2}v5`, "#ffb300", 0.5);
    drawSlice(rays, crossings, u);
    drawCurve(rays[u], said[u], eps, right(u));
    const off = (z, column) => 1000 * Math.abs(z - right(column)), z = crossings[u];
    const errors = crossings.map(off).filter((mm) => mm >= 0).sort((a, b) => a - b);
    const where = z > 0 ? `at z = <b>${z.toFixed(3)} m</b>, ${off(z, u).toFixed(0)} mm off` : "nowhere on this ray";
    return `Pixel (${u}, ${v}): the surface is at ${right(u).toFixed(3)} m. After ${frames} frame${frames > 1 ? "s" : ""} D is zero ${where}.<br>
      ${errors.length} of the ${width} rays of this row cross zero, half of them less than ${(errors[errors.length >> 1] ?? 0).toFixed(0)} mm off.`;
  }
}
