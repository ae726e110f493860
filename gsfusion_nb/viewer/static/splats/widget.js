// The widget: rows are received, pictures are requested one at a time, coarser while the camera moves.
import { viewOf } from "../projection.js";
import { OrbitCamera } from "../camera.js";
import { GpuPainter, gpuName, imitatesGpu } from "./webgl.js";
import { startEngine } from "./worker.js";
import { buildPanel, drawMark, showLegend, showRecord } from "./panel.js";
import { whenLost } from "../lost.js";
import { listenTo } from "../mouse.js";
import { TimeLine } from "./time.js";

const STILL_MS = 160; // ms without a movement after which a fine picture is drawn
const GOAL_MS = 40; // target time of one picture while moving, ms
const PATIENCE_MS = 10000;
const TRIES = 3;
const WIDEST = 2; // screen pixels per canvas pixel, at most: the viewer is as wide as the cell
const REDRAWN_BY = ["colour_by", "size", "opacity", "points", "background", "picked", "columns", "notice", "cut_m"];

class SplatView {
  constructor(model, el) {
    this.model = model;
    for (const name of ["width", "height", "intrinsics", "rules"]) this[name] = model.get(name);
    this.focal = this.intrinsics[0] / this.width;
    this.quality = 1;
    this.n = null; // rows received; null: none yet
    const { nodes, listeners } = buildPanel(model);
    this.nodes = nodes;
    for (const layer of [nodes.software, nodes.gpu, nodes.marks]) Object.assign(layer, { width: this.width, height: this.height });
    nodes.root.style.maxWidth = `${WIDEST * this.width}px`;
    nodes.scene.style.aspectRatio = `${this.width} / ${this.height}`;
    for (const name of Object.keys(model.get("places"))) {
      nodes.places.append(Object.assign(document.createElement("button"), { textContent: name, onclick: () => this.lookFrom(name) }));
    }
    el.append(nodes.root);
    this.place(model.get("pose"), model.get("pivot_m"));
    const ready = () => model.send({ kind: "ready" });
    this.engine = startEngine(ENGINE_SOURCE, (reply) => this.receive(reply), ready);
    this.time = new TimeLine(model, nodes, () => this.request());
    this.listeners = [
      ["msg:custom", (message, buffers) => this.rows(message, buffers)],
      ["change:pose", () => this.follow()],
      ["change:renderer", () => this.chooseRenderer()],
      ["change:record", () => showRecord(nodes.record, model.get("record"))],
      ...REDRAWN_BY.map((trait) => [`change:${trait}`, () => this.request()]),
      ...listeners,
      ...this.time.listeners,
    ];
    for (const [event, act] of this.listeners) model.on(event, act);
    listenTo(nodes.scene, this);
    showRecord(nodes.record, model.get("record"));
    this.chooseRenderer();
    this.say("waiting for the map ...");
    const late = "No answer from Python: it is busy, or the kernel was restarted. Run the cell again.";
    let tries = 0;
    this.patience = setInterval(() => {
      if (this.n !== null || ++tries > TRIES) return clearInterval(this.patience);
      this.say(late);
      ready(); // the first message may have been lost while the kernel was busy
    }, PATIENCE_MS);
    this.forget = whenLost(model, el, (words) => this.say(words));
    ready();
  }

  close() {
    for (const [event, act] of this.listeners) this.model.off(event, act);
    this.forget();
    clearInterval(this.patience);
    clearTimeout(this.still);
    clearInterval(this.time.timer);
    this.engine.close();
    this.gpu?.close();
  }

  save(values) {
    this.model.set(values);
    this.model.save_changes();
  }

  say(text) {
    this.nodes.message.textContent = text;
  }

  rows(message, buffers) {
    if (message.kind !== "rows") return;
    const copies = buffers.map((b) => b.buffer.slice(b.byteOffset, b.byteOffset + b.byteLength));
    const bytes = copies.pop();
    const index = copies.length ? new Int32Array(copies[0]) : null;
    this.engine.post({ kind: "rows", head: message.head, index, bytes, geometry: Boolean(this.gpu) }, [bytes]);
  }

  receive(reply) {
    if (reply.kind === "incomplete") this.model.send({ kind: "ready" });
    else if (reply.kind === "picked") this.picked(reply);
    else if (reply.kind === "received") {
      this.n = reply.n;
      if (reply.texture) this.gpu?.receive(reply.texture);
      this.say(reply.n ? "" : "The map is empty: nothing to show yet.");
      this.request();
    } else this.arrived(reply);
  }

  chooseRenderer() {
    const wish = this.model.get("renderer");
    const name = wish === "software" ? "" : gpuName();
    this.gpu?.close();
    this.gpu = null;
    if (name && (wish === "webgl" || !imitatesGpu(name))) this.startGpu();
    this.trouble = wish === "webgl" && !this.gpu ? "this browser has no WebGL2" : "";
    this.nodes.software.hidden = Boolean(this.gpu);
    this.nodes.gpu.hidden = !this.gpu;
    this.save({ renderer_used: this.gpu ? "webgl" : "software", gpu: name });
    if (this.n !== null) this.model.send({ kind: "ready" });
  }

  startGpu() {
    const fresh = Object.assign(this.nodes.gpu.cloneNode(), { width: this.width, height: this.height });
    this.nodes.gpu.replaceWith(fresh); // a lost context cannot be restored
    this.nodes.gpu = fresh;
    try {
      const painter = (this.gpu = new GpuPainter(fresh));
      fresh.addEventListener("webglcontextlost", () => this.gpu === painter && this.save({ renderer: "software" }));
    } catch (error) {
      console.warn("the splat viewer draws without the graphics card:", error);
    }
  }

  /** The rules of drawing, without what is cut away. */
  get limits() {
    return { ...this.rules, near_m: Math.max(this.rules.near_m, this.model.get("cut_m")) };
  }

  look() {
    const look = Object.fromEntries(["size", "opacity", "points", "picked"].map((k) => [k, this.model.get(k)]));
    const hex = this.model.get("background");
    const background = [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);
    const birth = this.model.get("columns").findIndex((c) => c.kind === "frame");
    const limit = this.gpu ? Infinity : this.rules.software_rows;
    return { ...look, background, birth, bornUntil: this.time.until, limit, paint: this.paint() };
  }

  paint() {
    const by = this.model.get("colour_by");
    const { turbo, viridis, ...others } = this.model.get("palettes");
    if (by === "depth") return { by, palette: turbo };
    if (by === "opacity") return { by, palette: viridis, low: 0, high: 1 };
    const columns = this.model.get("columns");
    const column = columns.findIndex((c) => c.name === by);
    return column < 0 ? { by: "rgb" } : { ...columns[column], by: "column", column, palette: others[columns[column].palette] ?? viridis };
  }

  view(scale = 1) {
    return viewOf(this.camera.pose(), this.intrinsics, this.width, this.height, scale);
  }

  request() {
    if (!this.n) return;
    if (this.gpu) requestAnimationFrame(() => this.gpu?.paint(this.view(), this.look(), this.limits));
    this.again = Boolean(this.busy);
    if (this.busy) return;
    this.busy = true;
    const coarse = Boolean(this.moving && !this.gpu);
    this.asked = { coarse, scale: coarse ? this.quality : 1 };
    const view = this.view(this.asked.scale);
    if (this.gpu) view.margin = this.width / 2; // also sorts what a small turn of the camera brings into view
    this.engine.post({ kind: this.gpu ? "sort" : "draw", view, look: this.look(), rules: this.limits, coarse });
  }

  arrived(reply) {
    this.busy = false;
    if (reply.kind === "picture") this.present(reply);
    else if (this.gpu) {
      this.gpu.arrange(reply.order, reply.colours);
      this.gpu.paint(this.view(), this.look(), this.limits);
    }
    drawMark(this.nodes.marks, reply.mark, this.asked.scale);
    this.describe(reply);
    if (this.moving) (this.shown ??= []).push(performance.now());
    if (this.again || (this.asked.coarse && !this.moving)) this.request();
    else if (!this.moving) this.report(reply);
  }

  present({ pixels, width, height, ms }) {
    const small = Object.assign((this.small ??= document.createElement("canvas")), { width, height });
    small.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
    this.nodes.software.getContext("2d").drawImage(small, 0, 0, this.width, this.height);
    if (!this.asked.coarse) return;
    if (ms > GOAL_MS) this.quality = Math.max(0.2, this.quality * 0.85);
    else if (ms < 0.6 * GOAL_MS) this.quality = Math.min(1, this.quality * 1.08);
  }

  /** The legend, and in the corner the renderer and its numbers. */
  describe({ drawn, thinned, depthRange: [low, high] }) {
    const paint = this.paint();
    if (paint.by === "depth") showLegend(this.nodes.legend, { ...paint, low, high }, "depth", " m");
    else showLegend(this.nodes.legend, paint, paint.label ?? paint.by);
    const count = (v) => v.toLocaleString("en");
    const few = thinned && `only the ${count(thinned.shown)} most important of ${count(thinned.of)} are drawn`;
    const renderer = this.model.get("names_renderer") === false ? "" : this.gpu ? "WebGL" : "software";
    const words = [`${count(drawn)} Gaussians in view`, renderer, few, this.trouble, this.model.get("notice")];
    this.nodes.status.textContent = words.filter(Boolean).join(" · ");
  }

  /** Measurements of the last movement, for tests. */
  report({ ms = 0, drawn }) {
    const { shown = [], quality } = this;
    const fps = shown.length > 2 ? ((shown.length - 1) * 1000) / (shown.at(-1) - shown[0]) : null;
    this.shown = [];
    this.pictures = (this.pictures ?? 0) + 1;
    this.save({ stats: { ...(fps && { fps, quality }), ms, drawn, pictures: this.pictures } });
  }

  moved() {
    this.moving = true;
    clearTimeout(this.still);
    this.still = setTimeout(() => {
      this.moving = false;
      this.save({ pose: this.camera.pose() });
      this.request();
    }, STILL_MS);
    this.request();
  }

  /** Python, or another view of the same widget, has moved the camera. */
  follow() {
    const here = this.camera.pose();
    if (this.model.get("pose").every((v, k) => Math.abs(v - here[k]) < 1e-6)) return;
    this.camera.distance = this.model.get("pivot_m");
    this.camera.place(this.model.get("pose"));
    this.request();
  }

  lookFrom(name) {
    const [pose, pivot_m, cut_m] = this.model.get("places")[name];
    this.save({ pose, pivot_m, cut_m });
    this.place(pose, pivot_m);
  }

  reset() {
    this.lookFrom("photo");
  }

  place(pose, pivot_m) {
    this.camera = new OrbitCamera(pose, pivot_m, this.model.get("up_W"));
    if (this.n) this.moved();
  }

  pick(x, y) {
    this.pointed = [x * this.width, y * this.height];
    const [px, py] = this.pointed;
    this.engine.post({ kind: "pick", view: this.view(), look: this.look(), rules: this.limits, x: px, y: py });
  }

  picked({ row, depth }) {
    if (this.aiming && row !== null) this.camera.aim(...this.pointed, depth, this.intrinsics);
    this.aiming = false;
    this.save({ picked: row });
  }
}

export default {
  render({ model, el }) {
    const view = new SplatView(model, el);
    return () => view.close();
  },
};
