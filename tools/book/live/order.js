// Two Gaussians and their order: the nearer one hides the other.
const CAMERA = { width: 96, height: 60, fx: 60, fy: 60, cx: 48, cy: 30 };
const ORANGE = [1, 0.62, 0.1], BLUE = [0.16, 0.44, 0.95];

function start(section) {
  const state = { orange: [-0.2, 0.02], blue: [0.2, 0.04], probe: [46.5, 20.5] };
  const panel = openPanel(section, { draw, words: { orange: (z) => `${z} m`, blue: (z) => `${z} m` } });
  const view = panel.picture("view", CAMERA), side = panel.chart("side");
  const at = (name) => () => state[name].map((x, k) => CAMERA.fx * x + [CAMERA.cx, CAMERA.cy][k]);
  const move = (name) => (u, v) => {
    state[name] = [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy];
  };
  panel.handle(view, "Orange Gaussian", { at: at("orange"), move: move("orange") });
  panel.handle(view, "Blue Gaussian", { at: at("blue"), move: move("blue") });
  const probe = (u, v) => {
    state.probe = [u, v].map((x, k) => Math.min([CAMERA.width, CAMERA.height][k] - 1, Math.floor(x)) + 0.5);
  };
  panel.handle(view, "The pixel below", { at: () => state.probe, move: probe, className: "gsnb-live-ring" });
  panel.press(view, probe);
  panel.inputs.swap.addEventListener("click", () => {
    const { orange, blue } = panel.inputs;
    [orange.value, blue.value] = [blue.value, orange.value];
    panel.redraw();
  });

  /** Both keep their place and size on the image at every distance. */
  function twoGaussians({ orange, blue, opacity }) {
    const map = emptyMap(2);
    [[state.orange, orange, ORANGE], [state.blue, blue, BLUE]].forEach(([place, z, rgb], i) => {
      map.xyz_W.set([place[0] * z, place[1] * z, z], 3 * i);
      map.log_scale.fill(Math.log(0.2 * z), 3 * i, 3 * i + 3);
      map.quat[4 * i] = 1;
      map.opacity_logit[i] = Math.log(opacity / (1 - opacity));
      map.sh.set(rgb.map((c) => (c - 0.5) / SH_C0), 3 * i);
    });
    return map;
  }

  function drawSide({ orange, blue }) {
    const x = (z) => 60 + 100 * (z - 0.8), blob = (z, rgb, y, name) =>
      `<ellipse cx="${x(z)}" cy="${y}" rx="16" ry="11" style="fill:${cssColour(rgb)};stroke:none"/><text x="${x(z)}" y="${y < 50 ? y - 16 : y + 26}" text-anchor="middle">${name}</text>`;
    const ticks = [1, 2, 3, 4].map((z) => `<path d="M${x(z)} 96v5"/><text x="${x(z)}" y="116" text-anchor="middle">${z}</text>`);
    side.innerHTML = `<svg viewBox="0 0 420 136" role="img" aria-label="From the side: camera on the left, orange at ${orange} m, blue at ${blue} m">
      <path d="M14 34h20v22H14zM34 40l10-8v26l-10-8"/><path d="M60 96H400"/>${ticks.join("")}<text x="230" y="133" text-anchor="middle">distance z, m</text>
      ${blob(orange, ORANGE, 36, "orange")}${blob(blue, BLUE, 60, "blue")}</svg>`;
  }

  function draw(values) {
    const { splats, rgb } = renderMap(twoGaussians(values), CAMERA, IDENTITY_VIEW), [u, v] = state.probe;
    const alpha = [0, 1].map((i) => alphaAt(splats, i, u, v)), colours = [ORANGE, BLUE];
    const mix = (first, second) => colours[first].map((c, k) => alpha[first] * c + (1 - alpha[first]) * alpha[second] * colours[second][k]);
    const front = values.orange <= values.blue ? 0 : 1, names = ["orange", "blue"];
    drawPixels(view, rgb, CAMERA);
    [0, 1].forEach((i) => drawEllipse(view, splats.uv[2 * i], splats.uv[2 * i + 1], covarianceOf(splats, i), 1, "#fff", 0.3));
    drawSide(values);
    const line = (first) => `${swatch(mix(first, 1 - first))} ${names[first]} in front: ${alpha[first].toFixed(2)} of ${names[first]} and
      (1 − ${alpha[first].toFixed(2)}) × ${alpha[1 - first].toFixed(2)} = ${((1 - alpha[first]) * alpha[1 - first]).toFixed(2)} of ${names[1 - first]}`;
    const bold = (first) => (first === front ? `<b>${line(first)}</b>` : line(first));
    return `The ringed pixel, with alpha ${alpha[0].toFixed(2)} of orange and ${alpha[1].toFixed(2)} of blue:<br>${bold(0)}<br>${bold(1)}`;
  }
}
