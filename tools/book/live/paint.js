// Gaussians paint a photograph: forward, gradient by hand, Adam, each step visible.
const RATES = { xyz_W: 2e-3, log_scale: 2e-2, quat: 2e-2, opacity_logit: 5e-2, sh: 2e-2 };
const CANVAS = { width: 96, height: 72, fx: 90, fy: 90, cx: 48, cy: 36 };
const LEAST_PSNR = 8;
const SPEEDS = [1, 2, 5, 10, 20, 60]; // steps a second
const ARROW_PX = 22; // of the longest arrow

/** Grey Gaussians at random places in front of the camera, together as large as the picture. */
function greyStart(n) {
  const map = emptyMap(n), random = randomNumbers(1);
  for (let i = 0; i < n; i++) {
    const z = 1.5 + random();
    map.xyz_W.set(backproject(CANVAS, random() * CANVAS.width, random() * CANVAS.height, z), 3 * i);
    map.log_scale.fill(Math.log(((0.5 * z) / CANVAS.fx) * Math.sqrt((CANVAS.width * CANVAS.height) / n)), 3 * i, 3 * i + 3);
    map.quat[4 * i] = 1;
  }
  return map;
}

/** The optimisation of a map: step() changes it, look() only computes. */
class Fit {
  constructor(n, target) {
    Object.assign(this, { map: greyStart(n), target, moments: [emptyMap(n), emptyMap(n)], curve: [], t: 0 });
    this.look();
  }

  look() {
    this.drawn = renderMap(this.map, CANVAS, IDENTITY_VIEW);
    this.loss = pictureLoss(this.drawn.rgb, this.target);
    this.gradient = renderMapVjp(this.map, CANVAS, IDENTITY_VIEW, this.drawn, this.loss.v_rgb);
  }

  step() {
    this.t += 1;
    const [m, v] = this.moments;
    for (const [name, lr] of Object.entries(RATES)) adamUpdate(this.map[name], this.gradient.map[name], m[name], v[name], this.t, lr);
    this.look();
    this.curve.push(this.loss.psnr);
  }
}

async function start(section) {
  const room = pixelsOf(await photograph(DATA.photo), CANVAS);
  const state = { fit: new Fit(300, room), target: room, row: -1, running: false, pen: null, drawing: false };
  const panel = openPanel(section, { draw, words: { speed: (x) => `${SPEEDS[x]} a second`, count: (x) => String(x) } });
  const painting = panel.picture("painting", CANVAS), photo = panel.picture("photo", CANVAS), curve = panel.chart("curve");
  const { run, step, restart, pencil, file, colour } = panel.inputs;

  function begin(target = state.target) {
    Object.assign(state, { target, fit: new Fit(panel.values().count, target), row: -1 });
    panel.redraw();
  }

  // the clock: steps are taken while the panel is seen
  const clock = { seen: false, due: 0, last: 0 };
  function tick(time) {
    if (!state.running || !clock.seen) return;
    clock.due = Math.min(8, clock.due + ((time - clock.last) / 1000) * SPEEDS[panel.values().speed]);
    clock.last = time;
    const until = performance.now() + 30;
    let moved = false;
    for (; clock.due >= 1 && performance.now() < until; clock.due--, moved = true) state.fit.step();
    if (moved) panel.redraw();
    requestAnimationFrame(tick);
  }
  function setRunning(running) {
    state.running = running;
    run.textContent = running ? "Pause" : "Start";
    panel.status.setAttribute("aria-live", running ? "off" : "polite"); // a screen reader is not told every step of a run
    if (running) requestAnimationFrame((time) => tick((clock.last = time)));
    panel.redraw();
  }
  whileSeen(section, (seen) => {
    clock.seen = seen;
    if (seen && state.running) requestAnimationFrame((time) => tick((clock.last = time)));
  });

  run.addEventListener("click", () => setRunning(!state.running));
  step.addEventListener("click", () => {
    state.fit.step();
    setRunning(false);
  });
  restart.addEventListener("click", () => begin());
  panel.inputs.count.addEventListener("change", () => begin());

  // a photograph of the reader, which stays in the page
  async function take(chosen) {
    if (!chosen) return;
    try {
      const image = await photograph(chosen);
      begin(pixelsOf(image, CANVAS));
      setRunning(true);
    } catch {
      panel.status.textContent = `${chosen.name} is not a picture that this browser can read. Choose a JPEG, PNG or WebP file.`;
    }
  }
  file.addEventListener("change", () => take(file.files[0]));
  section.addEventListener("dragover", (event) => event.preventDefault());
  section.addEventListener("drop", (event) => {
    event.preventDefault();
    take(event.dataTransfer.files[0]);
  });

  // a drawing of the reader: then, and only then, a thumb on the photograph draws and does not scroll
  const sheet = create("canvas", { width: 4 * CANVAS.width, height: 4 * CANVAS.height }), paper = sheet.getContext("2d");
  pencil.addEventListener("click", () => {
    state.drawing = !state.drawing;
    pencil.textContent = state.drawing ? "Paint my drawing" : "Draw a picture";
    photo.canvas.classList.toggle("gsnb-live-draw", state.drawing);
    if (state.drawing) {
      setRunning(false);
      Object.assign(paper, { fillStyle: "#fff", lineCap: "round", lineJoin: "round", lineWidth: 26 }).fillRect(0, 0, sheet.width, sheet.height);
      panel.redraw();
    } else {
      begin(pixelsOf(sheet, CANVAS));
      setRunning(true);
    }
  });
  const place = ({ offsetX, offsetY }) => [offsetX, offsetY].map((x) => (x / photo.canvas.clientWidth) * sheet.width);
  photo.canvas.addEventListener("pointerdown", (event) => {
    if (!state.drawing) return;
    photo.canvas.setPointerCapture(event.pointerId);
    state.pen = place(event);
  });
  photo.canvas.addEventListener("pointermove", (event) => {
    if (!state.drawing || !state.pen) return;
    const next = place(event);
    stroke(paper, `M${state.pen.join(" ")}L${next.join(" ")}`, colour.value, 26);
    state.pen = next;
    panel.redraw();
  });
  for (const type of ["pointerup", "pointercancel"]) photo.canvas.addEventListener(type, () => (state.pen = null));

  // one Gaussian, pulled by hand
  panel.press(painting, (u, v) => {
    const { splats } = state.fit.drawn, stack = stackAt(splats, nearestFirst(splats), u, v);
    state.row = stack.length ? stack.reduce((a, b) => (b.w > a.w ? b : a)).row : -1;
    setRunning(false);
  });
  panel.handle(painting, "The chosen Gaussian", {
    at: () => (state.row < 0 ? null : [...state.fit.drawn.splats.uv.subarray(2 * state.row, 2 * state.row + 2)]),
    move: (u, v) => {
      const { map } = state.fit, at = 3 * state.row;
      map.xyz_W.set(backproject(CANVAS, u, v, map.xyz_W[at + 2]), at);
      state.fit.look();
    },
  });

  /** The ellipse of a chosen Gaussian and the way in which descent would move it. */
  function drawPull() {
    const { row, fit } = state, { uv } = fit.drawn.splats, v_uv = fit.gradient.splats.uv;
    const from = [uv[2 * row], uv[2 * row + 1]], pull = [-v_uv[2 * row], -v_uv[2 * row + 1]], size = Math.hypot(...pull);
    const length = (ARROW_PX * size) / (size + 1e-4);
    drawEllipse(painting, ...from, covarianceOf(fit.drawn.splats, row), 1, "#fff", 0.7);
    drawEllipse(painting, ...from, covarianceOf(fit.drawn.splats, row), 1, "#000", 0.3);
    const to = from.map((x, k) => x + (pull[k] / (size || 1)) * length);
    drawArrow(painting, from, to, "#000", 1.6, 2);
    drawArrow(painting, from, to, "#ffb000", 0.9, 2);
  }

  function drawPainting(show) {
    const { fit } = state, { splats, rgb } = fit.drawn;
    if (show === "its error") drawPixels(painting, rgb.map((c, k) => Math.min(1, 4 * Math.abs(c - fit.target[k]))), CANVAS);
    else drawPixels(painting, rgb, CANVAS, true);
    if (show !== "the ellipses") return;
    painting.fillStyle = "#0b0e12";
    painting.fillRect(0, 0, CANVAS.width, CANVAS.height);
    for (const i of nearestFirst(splats).reverse()) {
      drawEllipse(painting, splats.uv[2 * i], splats.uv[2 * i + 1], covarianceOf(splats, i), 1, cssColour(splats.rgb.subarray(3 * i, 3 * i + 3)), 0.45);
    }
  }

  function drawCurve() {
    const { curve: psnr } = state.fit, most = Math.max(100, psnr.length);
    const lines = [{ points: psnr.map((dB, k) => [k + 1, dB]), style: 'class="gsnb-live-mean"' }];
    curve.innerHTML = graph("PSNR of the painting after each step", ["step", 0, most], ["PSNR, dB", LEAST_PSNR, 30], lines);
  }

  function words() {
    const { fit, row } = state, psnr = `<b>Step ${fit.t}</b>: PSNR ${fit.loss.psnr.toFixed(2)} dB, L1 ${fit.loss.value.toFixed(4)}.`;
    if (row < 0) return `${psnr} Press the painting to choose a Gaussian and pull it.`;
    const { map, splats } = fit.gradient, write = (x) => x.toExponential(1).replace("e", "·10<sup>").concat("</sup>").replace("+", "");
    return `${psnr} Gaussian ${row}, pulled or not: its gradient is dL/du ${write(splats.uv[2 * row])}, dL/dv ${write(splats.uv[2 * row + 1])} per pixel,
      dL/d(opacity) ${write(splats.opacity[row])}, dL/d(log size) ${write(map.log_scale[3 * row])}. The arrow is minus the gradient: there descent moves it.`;
  }

  function draw({ show }) {
    drawPainting(show);
    if (state.row >= 0) drawPull();
    if (state.drawing) drawImage(photo, sheet);
    else drawPixels(photo, state.target, CANVAS, true);
    drawCurve();
    return words();
  }

  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) setRunning(true);
}
