// What the panels share. The HTML of a panel has its posters, sliders, lists and text; this makes them live.
const create = (tag, values, ...children) => {
  const element = Object.assign(document.createElement(tag), values);
  element.append(...children);
  return element;
};

/** Images of n numbers each, which Python packed in units of `unit`. */
async function unpacked(packed, Type, n, unit) {
  const numbers = Float64Array.from(new Type(await inflated(packed)), (x) => x * unit);
  return Array.from({ length: numbers.length / n }, (_, i) => numbers.subarray(i * n, (i + 1) * n));
}

/** The bytes that Python compressed and wrote in base 64. */
function inflated(packed) {
  const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
  return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
}

/** A picture file, written in base 64 or chosen by the reader, as something that a canvas can draw. */
async function photograph(source) {
  const image = create("img", { src: typeof source === "string" ? `data:image/webp;base64,${source}` : URL.createObjectURL(source) });
  await image.decode();
  return image;
}

/** The pixels of an image, cut in the middle to the shape of a camera's picture and made as small: 0..1, three numbers each. */
function pixelsOf(image, { width, height }) {
  const canvas = create("canvas", { width, height }), context = canvas.getContext("2d", { willReadFrequently: true });
  const from = { width: image.naturalWidth ?? image.width, height: image.naturalHeight ?? image.height };
  const part = Math.min(from.width / width, from.height / height), [w, h] = [width * part, height * part];
  Object.assign(context, { imageSmoothingQuality: "high", fillStyle: "#fff" }).fillRect(0, 0, width, height);
  context.drawImage(image, (from.width - w) / 2, (from.height - h) / 2, w, h, 0, 0, width, height);
  const { data } = context.getImageData(0, 0, width, height);
  return Float64Array.from({ length: 3 * width * height }, (_, k) => data[4 * Math.floor(k / 3) + (k % 3)] / 255);
}

/** A source of numbers in 0..1, the same for the same seed (mulberry32). */
function randomNumbers(seed) {
  let state = seed;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let t = Math.imul(state ^ (state >>> 15), state | 1);
    t ^= t + Math.imul(t ^ (t >>> 7), t | 61);
    return ((t ^ (t >>> 14)) >>> 0) / 4294967296;
  };
}

/** Draws a path in the syntax of SVG. */
const stroke = (context, path, strokeStyle, lineWidth) => Object.assign(context, { strokeStyle, lineWidth }).stroke(new Path2D(path));

/** Draws an image over the whole picture. */
function drawImage(context, image, smooth = true) {
  context.imageSmoothingEnabled = smooth;
  context.drawImage(image, 0, 0, context.units.width, context.units.height);
}

/** Draws colours 0..1, three numbers for each pixel of a camera, over the whole picture. */
function drawPixels(context, rgb, { width, height }, smooth = false) {
  const image = new ImageData(width, height), small = create("canvas", { width, height });
  for (let i = 0; i < width * height; i++) {
    for (let c = 0; c < 3; c++) image.data[4 * i + c] = 255 * rgb[3 * i + c];
    image.data[4 * i + 3] = 255;
  }
  small.getContext("2d").putImageData(image, 0, 0);
  drawImage(context, small, smooth);
}

/** A number as text, with a minus in place of a hyphen. */
function written(number) {
  return String(number).replace(/^-/, "−");
}

/** The covariance [uu, uv, vv] of a row of projected Gaussians, px^2. */
function covarianceOf({ conic }, i) {
  const [A, B, C] = conic.subarray(3 * i, 3 * i + 3), det = A * C - B * B;
  return [C / det, -B / det, A / det];
}

/** Half axes of one standard deviation, px, and the direction of the longer one, radians. */
function ellipseOf([uu, uv, vv]) {
  const mean = (uu + vv) / 2, spread = Math.hypot((uu - vv) / 2, uv);
  return { long: Math.sqrt(mean + spread), short: Math.sqrt(Math.max(0, mean - spread)), angle: Math.atan2(2 * uv, uu - vv) / 2 };
}

/** Draws the ellipse of `k` standard deviations. */
function drawEllipse(context, u, v, covariance, k, strokeStyle, lineWidth) {
  const { long, short, angle } = ellipseOf(covariance);
  Object.assign(context, { strokeStyle, lineWidth }).beginPath();
  context.ellipse(u, v, k * long, k * short, angle, 0, 2 * Math.PI);
  context.stroke();
}

/** Draws an arrow; `scale` is the size of its head. */
function drawArrow(context, [x0, y0], [x1, y1], colour, lineWidth, scale) {
  const length = Math.hypot(x1 - x0, y1 - y0);
  if (length < 1e-6) return;
  const [a, b] = [((x1 - x0) / length) * scale, ((y1 - y0) / length) * scale];
  const head = `M${x1 - 2 * a - b} ${y1 - 2 * b + a}L${x1} ${y1}L${x1 - 2 * a + b} ${y1 - 2 * b - a}`;
  stroke(context, `M${x0} ${y0}L${x1} ${y1}${head}`, colour, lineWidth);
}

const cssColour = (rgb) => `rgb(${rgb.map((c) => Math.round(255 * Math.max(0, Math.min(1, c))))})`;
const swatch = (rgb) => `<span class="gsnb-live-swatch" style="background:${cssColour(rgb)}"></span>`;

/** Four to ten round numbers from low to high. */
function ticksOf(low, high) {
  const rough = (high - low) / 4, unit = 10 ** Math.floor(Math.log10(rough));
  const step = unit * [5, 2, 1].find((k) => k * unit <= rough);
  const first = Math.ceil(low / step - 1e-9);
  return Array.from({ length: Math.floor(high / step + 1e-9) - first + 1 }, (_, k) => Number(((first + k) * step).toPrecision(6)));
}

/**
 * A graph with named axes as SVG. x, y: [name, low, high]; marks: SVG made by a function of (X, Y), from values to places;
 * lines: {points, style}.
 */
function graph(label, [xName, x0, x1], [yName, y0, y1], lines, marks = () => "") {
  const [left, right, top, bottom] = [46, 410, 12, 168];
  const X = (x) => Number((left + ((x - x0) / (x1 - x0)) * (right - left)).toFixed(2));
  const Y = (y) => Number((bottom - ((Math.max(y0, Math.min(y1, y)) - y0) / (y1 - y0)) * (bottom - top)).toFixed(2));
  const xTicks = ticksOf(x0, x1).map((x) => `<path d="M${X(x)} ${bottom}v4"/><text x="${X(x)}" y="${bottom + 17}" text-anchor="middle">${x}</text>`);
  const yTicks = ticksOf(y0, y1).map((y) => `<path d="M${left} ${Y(y)}h-4"/><text x="${left - 7}" y="${Y(y) + 4}" text-anchor="end">${y}</text>`);
  const drawn = lines.map(({ points, style }) => `<polyline ${style ?? ""} points="${points.map(([x, y]) => `${X(x)},${Y(y)}`).join(" ")}"/>`);
  return `<svg viewBox="0 0 420 206" role="img" aria-label="${label}"><path d="M${left} ${top}V${bottom}H${right}"/>${xTicks.join("")}${yTicks.join("")}
    <text x="${(left + right) / 2}" y="202" text-anchor="middle">${xName}</text>
    <text transform="translate(12 ${(top + bottom) / 2}) rotate(-90)" text-anchor="middle">${yName}</text>${drawn.join("")}${marks(X, Y)}</svg>`;
}

/**
 * Makes the panel of a section live: draw(values) after every change gives a text as HTML, or nothing to leave it.
 *
 * from: name of a slider -> its value at a position; words: name -> how a value is written
 */
function openPanel(section, { from = {}, words = {}, draw }) {
  const inputs = Object.fromEntries([...section.querySelectorAll("[name]")].map((element) => [element.name, element]));
  const status = section.querySelector("[role=status]"), handles = [];
  const value = (name) => {
    const input = inputs[name];
    if (input.type === "checkbox") return input.checked;
    return input.type === "range" ? (from[name] ?? Number)(input.value) : input.value;
  };

  function values() {
    const names = Object.keys(inputs).filter((name) => inputs[name].type !== "button" && inputs[name].type !== "file");
    return Object.fromEntries(names.map((name) => [name, value(name)]));
  }

  function redraw() {
    const now = values();
    for (const [name, input] of Object.entries(inputs)) {
      if (input.type !== "range") continue;
      const text = (words[name] ?? ((x) => Number(x.toPrecision(3))))(now[name]);
      input.nextElementSibling.textContent = written(text);
      input.setAttribute("aria-valuetext", input.nextElementSibling.textContent);
    }
    const text = draw(now);
    if (text !== undefined) status.innerHTML = text;
    for (const place of handles) place();
  }

  /** The context of a picture of so many units; the poster makes way. */
  function picture(name, { width, height }) {
    const stage = section.querySelector(`[data-picture="${name}"]`), poster = stage.querySelector("img");
    const canvas = create("canvas", { width: poster.width, height: poster.height });
    canvas.width = Number(poster.getAttribute("width"));
    canvas.height = Number(poster.getAttribute("height"));
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", poster.alt);
    poster.replaceWith(canvas);
    const context = canvas.getContext("2d");
    context.scale(canvas.width / width, canvas.height / height);
    return Object.assign(context, { units: { width, height }, stage });
  }

  const unitsAt = ({ units, canvas }, { clientX, clientY }) => {
    const box = canvas.getBoundingClientRect();
    return [((clientX - box.left) / box.width) * units.width, ((clientY - box.top) / box.height) * units.height];
  };

  /** A tap on a picture; moving over it scrolls the page. */
  function press(context, act) {
    context.canvas.classList.add("gsnb-live-touch");
    context.canvas.addEventListener("click", (event) => {
      act(...unitsAt(context, event));
      redraw();
    });
  }

  /** A round button over a picture that is dragged, or moved with the arrow keys. at() is its place; null hides it. */
  function handle(context, label, { at, move, step = 1, className = "", end = () => {} }) {
    const button = create("button", { type: "button", className: `gsnb-live-handle ${className}` });
    button.setAttribute("aria-label", `${label}: move with the arrow keys`);
    button.title = label;
    const held = { grip: null };
    const go = (x, y) => {
      move(Math.max(0, Math.min(context.units.width, x)), Math.max(0, Math.min(context.units.height, y)));
      redraw();
    };
    button.addEventListener("pointerdown", (event) => {
      const [x, y] = unitsAt(context, event), [u, v] = at();
      held.grip = [u - x, v - y];
      button.setPointerCapture(event.pointerId);
    });
    button.addEventListener("pointermove", (event) => {
      if (!held.grip) return;
      const [x, y] = unitsAt(context, event);
      go(x + held.grip[0], y + held.grip[1]);
    });
    for (const type of ["pointerup", "pointercancel"]) {
      button.addEventListener(type, () => {
        held.grip = null;
        end();
      });
    }
    button.addEventListener("keydown", (event) => {
      const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key] ?? [0, 0];
      if (!dx && !dy) return;
      event.preventDefault();
      const [x, y] = at();
      go(x + step * dx, y + step * dy);
    });
    context.stage.append(button);
    handles.push(() => {
      const place = at();
      button.hidden = !place;
      if (!place) return;
      button.style.left = `${(100 * place[0]) / context.units.width}%`;
      button.style.top = `${(100 * place[1]) / context.units.height}%`;
    });
    return button;
  }

  for (const input of Object.values(inputs)) input.disabled = false;
  section.addEventListener("input", (event) => event.target.name in inputs && event.target.type !== "file" && redraw());
  queueMicrotask(redraw);
  const chart = (name) => section.querySelector(`[data-chart="${name}"]`);
  return { inputs, status, values, redraw, picture, press, handle, chart };
}

/** Calls act(whether the section is seen) when that changes. */
const whileSeen = (section, act) => new IntersectionObserver(([entry]) => act(entry.isIntersecting), { threshold: 0.2 }).observe(section);
