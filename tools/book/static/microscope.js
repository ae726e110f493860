// The pixel microscope without a kernel: a picture to click, the neighbourhood with the heaviest Gaussians, the stack as a
// graph and as a table. The numbers are computed in the page from the Gaussians on the screen (pixel_stack.js).
const OUTLINED = 12, TABLE_ROWS = 14, RADIUS = 12, LENS = 300;

const floats = (text) => new Float32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
const three = (x) => x.toFixed(3);
const css = (rgb) => `rgb(${rgb.map((c) => Math.round(255 * Math.min(Math.max(c, 0), 1))).join(" ")})`;

const rgbWords = (rgb) => rgb.map(three).join(" ");
const swatch = (rgb) => make("span", { class: "gsnb-pixels-swatch", style: `background:${css(rgb)}` });
const weightOf = (stack) => stack.reduce((sum, one) => sum + one.weight, 0);

function make(name, attributes = {}, ...children) {
  const space = /^(svg|path|rect|polyline|text|g|line)$/.test(name) ? "http://www.w3.org/2000/svg" : "http://www.w3.org/1999/xhtml";
  const element = document.createElementNS(space, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(...children);
  return element;
}

/** A graph with lines at 0, 0.5 and 1, a place for each bar, and strips of colours below. */
class Graph {
  constructor(svg, { left, below, bars }) {
    Object.assign(this, { svg, left, right: 548, top: 24, bottom: 240 - below });
    this.step = (this.right - left) / Math.max(bars, 1);
    svg.setAttribute("viewBox", "0 0 560 240");
    svg.replaceChildren();
    for (const value of [0, 0.5, 1]) {
      this.add("line", { x1: left, x2: this.right, y1: this.y(value), y2: this.y(value), class: "gsnb-pixels-grid" });
      this.text(8, this.y(value) + 4, value);
    }
  }

  x(k) {
    return this.left + k * this.step;
  }

  y(value) {
    return this.bottom + value * (this.top - this.bottom);
  }

  add(name, attributes, ...children) {
    this.svg.append(make(name, attributes, ...children));
  }

  text(x, y, words) {
    this.add("text", { x, y }, words);
  }

  bar(k, value, rgb, kind = "gsnb-pixels-weight") {
    const y = this.y(Math.min(value, 1)), width = Math.max(this.step - 1, 1);
    this.add("rect", { x: this.x(k), width, y, height: this.bottom - y, fill: css(rgb), class: kind });
  }

  strip(k, y, rgb) {
    this.add("rect", { x: this.x(k), width: this.step, y, height: 16, fill: css(rgb) });
  }
}

class Microscope {
  constructor({ splats, picture, width, height, pixel, shown }, el) {
    Object.assign(this, { splats: splatsOf(floats(splats)), width, height });
    this.image = make("img", { src: `data:image/png;base64,${picture}`, width: shown, tabindex: 0, class: "gsnb-click-image" });
    this.image.dataset.touch = "pixel";
    this.cross = make("path", { d: "M-13 0H-5M5 0H13M0 -13V-5M0 5V13", class: "gsnb-pixels-cross" });
    const over = make("svg", { class: "gsnb-pixels-over", "aria-hidden": "true" }, this.cross);
    this.lens = make("canvas", { width: LENS, height: LENS, role: "img" });
    this.rings = make("svg", { class: "gsnb-pixels-over", viewBox: `0 0 ${2 * RADIUS + 1} ${2 * RADIUS + 1}`, "aria-hidden": "true" });
    this.caption = make("p", { class: "gsnb-pixels-caption", role: "status" });
    this.graph = make("svg", { class: "gsnb-pixels-graph", role: "img" });
    this.table = make("div", { class: "gsnb-pixels-table", tabindex: 0, role: "group", "aria-label": "the numbers of the graph" });
    const box = (...parts) => make("div", { class: "gsnb-pixels-box" }, ...parts);
    const row = make("div", { class: "gsnb-pixels-row" }, box(this.image, over), box(this.lens, this.rings));
    el.append(make("div", { class: "gsnb-pixels" }, row, this.caption, this.graph, this.table));
    this.image.addEventListener("pointerdown", (event) => {
      this.image.focus({ preventScroll: true });
      this.image.setPointerCapture(event.pointerId);
      this.touch(event);
    });
    this.image.addEventListener("pointermove", (event) => event.buttons & 1 && this.touch(event));
    this.image.addEventListener("keydown", (event) => this.key(event));
    this.image.addEventListener("dragstart", (event) => event.preventDefault());
    new ResizeObserver(() => this.mark()).observe(this.image);
    this.image.decode().then(() => this.lookAt(...pixel));
  }

  touch(event) {
    const box = this.image.getBoundingClientRect();
    this.lookAt(((event.clientX - box.left) / box.width) * this.width, ((event.clientY - box.top) / box.height) * this.height);
  }

  key(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!step) return;
    event.preventDefault();
    this.lookAt(this.at[0] + step[0], this.at[1] + step[1]);
  }

  lookAt(u, v) {
    this.at = [u, v].map((x, k) => Math.min(Math.max(Math.floor(x), 0), [this.width, this.height][k] - 1));
    this.found = this.find(...this.at);
    this.mark();
    this.drawLens();
    this.drawGraph();
    this.write();
  }

  find(u, v) {
    return stackAt(this.splats, u, v);
  }

  mark() {
    if (!this.at) return;
    const zoom = this.image.clientWidth / this.width;
    this.cross.setAttribute("transform", `translate(${(this.at[0] + 0.5) * zoom} ${(this.at[1] + 0.5) * zoom})`);
  }

  drawLens() {
    const [u, v] = this.at, n = 2 * RADIUS + 1, context = this.lens.getContext("2d");
    context.fillStyle = "#ececec";
    context.fillRect(0, 0, LENS, LENS);
    context.imageSmoothingEnabled = false;
    context.drawImage(this.image, u - RADIUS, v - RADIUS, n, n, 0, 0, LENS, LENS);
    this.seen = [...context.getImageData(LENS / 2, LENS / 2, 1, 1).data.slice(0, 3)];
    const heaviest = [...this.found.stack].sort((a, b) => b.weight - a.weight).slice(0, OUTLINED).reverse();
    const rings = heaviest.flatMap((one, k) => {
      const d = `M${outline(one).map(([x, y]) => `${(x - u + RADIUS).toFixed(3)} ${(y - v + RADIUS).toFixed(3)}`).join("L")}Z`;
      const last = k === heaviest.length - 1;
      return [make("path", { d, class: "gsnb-pixels-halo" }), make("path", { d, class: last ? "gsnb-pixels-first" : "gsnb-pixels-ring" })];
    });
    this.rings.replaceChildren(...rings, make("rect", { x: RADIUS, y: RADIUS, width: 1, height: 1, class: "gsnb-pixels-here" }));
  }

  drawGraph() {
    const { stack, light } = this.found, graph = new Graph(this.graph, { left: 40, below: 66, bars: stack.length });
    graph.text(graph.left, 14, "red: light left T   pale: α   full: weight w = α T");
    graph.text(8, 212, "sum");
    const sum = [0, 0, 0], steps = [];
    stack.forEach(({ alpha, weight, rgb, light: before }, k) => {
      graph.bar(k, alpha, rgb, "gsnb-pixels-alpha");
      graph.bar(k, weight, rgb);
      rgb.forEach((c, i) => (sum[i] += weight * c));
      graph.strip(k, 200, sum);
      steps.push(`${graph.x(k)},${graph.y(before)} ${graph.x(k + 1)},${graph.y(before)}`);
    });
    steps.push(`${graph.right},${graph.y(light)}`);
    graph.add("polyline", { points: steps.join(" "), class: "gsnb-pixels-light" });
    graph.text(graph.left, 234, "nearest Gaussian first, to the farthest; below: the colour summed up so far");
  }

  write() {
    const where = `pixel (${this.found.u}, ${this.found.v})`;
    this.image.alt = `the rendered map; click a pixel, or use the arrow keys; now (${this.found.u}, ${this.found.v})`;
    this.lens.setAttribute("aria-label", `${where} and its neighbours, enlarged, with the ellipses of its Gaussians`);
    this.graph.setAttribute("aria-label", `${this.graphWords()}; the table has the numbers`);
    this.caption.replaceChildren(`${where}: `, ...this.words(), `; rendered (8 bit) ${this.seen.map((c) => three(c / 255)).join(" ")}`);
    const { heads, lines } = this.rows(this.found);
    const line = (cells) => make("tr", {}, ...cells.map((cell) => make("td", {}, cell)));
    const head = make("tr", {}, ...heads.map((words) => make("th", { scope: "col" }, words)));
    this.table.replaceChildren(make("table", {}, make("thead", {}, head), make("tbody", {}, ...lines.map(line))));
  }

  graphWords() {
    return `alpha, weight and light left for each of the ${this.found.stack.length} Gaussians`;
  }

  words() {
    const { stack, colour } = this.found;
    return [make("b", {}, `${stack.length} Gaussians`), `, sum of w c = ${rgbWords(colour)}`];
  }

  rows({ stack, colour, light }) {
    const lines = stack.slice(0, TABLE_ROWS).map((one, k) => [
      k, one.row, three(one.depth), three(one.alpha), three(one.light), three(one.weight), swatch(one.rgb),
      rgbWords(one.rgb.map((c) => one.weight * c)),
    ]);
    const more = stack.slice(TABLE_ROWS);
    if (more.length) {
      const rest = [0, 1, 2].map((i) => more.reduce((sum, one) => sum + one.weight * one.rgb[i], 0));
      lines.push(["", `… ${more.length} more`, "", "", "", three(weightOf(more)), "", rgbWords(rest)]);
    }
    lines.push(["", "sum", "", "", `left ${three(light)}`, three(weightOf(stack)), swatch(colour), rgbWords(colour)]);
    return { heads: ["k", "row", "depth m", "α", "T", "w = α T", "c", "w c"], lines };
  }
}
