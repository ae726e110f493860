// The widget: the mesh is sent once. Pictures are coarse while the camera moves or a button is down, and drawn here; when it
// stops, a fine one comes from fine.js, and a movement before that ends its drawing.
import { viewOf } from "../projection.js";
import { OrbitCamera } from "../camera.js";
import { whenLost } from "../lost.js";
import { listenTo } from "../mouse.js";
import { startFine } from "./fine.js";
import { MeshPainter } from "./raster.js";

const STILL_MS = 160; // ms without a movement, and with no button down, after which a fine picture is drawn
const GOAL_MS = 30; // target time of one picture while moving, ms
const FINE = 2; // pixels of the fine picture per canvas pixel, along each axis

class MeshView {
  constructor(model, el) {
    this.model = model;
    for (const name of ["width", "height", "intrinsics"]) this[name] = model.get(name);
    this.focal = this.intrinsics[0] / this.width;
    this.quality = 1;
    this.wish = 0; // number of the last fine picture asked for
    el.innerHTML = MESH_HTML;
    this.scene = el.querySelector(".gsnb-mesh-scene");
    this.canvas = el.querySelector("canvas");
    this.words = el.querySelector(".gsnb-mesh-words");
    Object.assign(this.canvas, { width: this.width, height: this.height });
    this.scene.style.width = `${this.width}px`;
    this.scene.style.aspectRatio = `${this.width} / ${this.height}`;
    this.place(model.get("pose"));
    this.listeners = [
      ["msg:custom", (message, buffers) => this.receive(message, buffers)],
      ["change:pose", () => this.follow()],
      ["change:shading", () => this.request()],
    ];
    for (const [event, act] of this.listeners) model.on(event, act);
    listenTo(this.scene, this);
    this.fine = startFine(FINE_SOURCE, (picture) => this.show(picture), () => this.mesh);
    this.forget = whenLost(model, el, (words) => (this.words.textContent = words));
    model.send({ kind: "ready" });
  }

  close() {
    for (const [event, act] of this.listeners) this.model.off(event, act);
    this.forget();
    clearTimeout(this.still);
    this.fine.close();
  }

  receive(message, buffers) {
    if (message.kind !== "mesh") return;
    const [xyz, faces, rgb] = buffers.map((b) => b.buffer.slice(b.byteOffset, b.byteOffset + b.byteLength));
    this.mesh = [new Float32Array(xyz), new Int32Array(faces), new Uint8Array(rgb)];
    this.painter = new MeshPainter(...this.mesh);
    this.fine.post({ mesh: this.mesh });
    this.words.textContent = "";
    this.request();
  }

  request() {
    if (!this.painter || this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = null;
      this.paint();
    });
  }

  /** A coarse picture now; a fine one is asked for when nothing moves. */
  paint() {
    const began = performance.now();
    this.put(this.painter.draw(...this.seen(this.quality)), "coarse");
    const ms = performance.now() - began;
    if (ms > GOAL_MS) this.quality = Math.max(0.25, this.quality * 0.85);
    else if (ms < 0.6 * GOAL_MS) this.quality = Math.min(1, this.quality * 1.08);
    if (!this.moving && !this.down) this.refine();
  }

  /** What a painter needs for the present view, at `scale` pixels per canvas pixel. */
  seen(scale) {
    const view = viewOf(this.camera.pose(), this.intrinsics, this.width, this.height, scale);
    return [view, this.model.get("shading") === "shape", this.model.get("background")];
  }

  refine() {
    const [view, shape, background] = this.seen(FINE);
    this.asked = performance.now();
    this.fine.post({ id: ++this.wish, view, shape, background });
  }

  /** A fine picture has arrived. */
  show(picture) {
    if (picture.id !== this.wish || this.moving || this.down) return;
    this.put(picture, "fine");
    this.report(performance.now() - this.asked);
  }

  put(picture, kind) {
    this.scene.dataset.picture = kind;
    const { pixels, width, height } = (this.shown = picture);
    const paper = Object.assign((this.paper ??= document.createElement("canvas")), { width, height });
    paper.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
    this.canvas.getContext("2d").drawImage(paper, 0, 0, this.width, this.height);
  }

  /** Measurements of the last fine picture, for tests. */
  report(ms) {
    this.pictures = (this.pictures ?? 0) + 1;
    this.save({ stats: { ms, quality: this.quality, pictures: this.pictures } });
  }

  save(values) {
    this.model.set(values);
    this.model.save_changes();
  }

  moved() {
    this.moving = true;
    this.wait();
    this.request();
  }

  /** A button or finger went down, or the last one went up. */
  grabbed(down) {
    this.down = down;
    this.wait();
  }

  /** No fine picture for now; one when the camera has rested and no button is down. */
  wait() {
    this.fine.post({ id: ++this.wish });
    clearTimeout(this.still);
    this.still = setTimeout(() => {
      this.save({ pose: this.camera.pose() });
      if (this.down || !this.painter) return;
      this.moving = false;
      this.refine();
    }, STILL_MS);
  }

  /** Python, or another view of the same widget, has moved the camera. */
  follow() {
    const here = this.camera.pose();
    if (this.model.get("pose").every((v, k) => Math.abs(v - here[k]) < 1e-6)) return;
    this.camera.place(this.model.get("pose"));
    this.request();
  }

  place(pose) {
    this.camera = new OrbitCamera(pose, this.model.get("pivot_m"), this.model.get("up_W"));
  }

  reset() {
    this.place(this.model.get("home"));
    this.moved();
  }

  pick(x, y) {
    this.pointed = [x, y];
  }

  /** Set by a double click, after the pick: the camera then turns around the point under the pointer. */
  set aiming(_) {
    if (!this.shown) return;
    const [x, y] = this.pointed;
    const depth = MeshPainter.depthAt(this.shown, x * this.shown.width, y * this.shown.height);
    if (depth) this.camera.aim(x * this.width, y * this.height, depth, this.intrinsics);
  }
}

export default {
  render({ model, el }) {
    const view = new MeshView(model, el);
    return () => view.close();
  },
};
