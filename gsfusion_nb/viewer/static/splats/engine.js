// All slow computations, behind one function: message in, reply out. It runs in a Web Worker, or in the page if there is none.
import { Rows } from "./rows.js";
import { alphaAt, depthOrder, pickAt, project } from "../projection.js";
import { colours, depthRange } from "./colour.js";
import { rasterise } from "./raster.js";

export class Engine {
  constructor() {
    this.rows = new Rows();
    this.p = {};
    this.rgb = new Float32Array(0);
    this.scratch = {};
    this.range = [0, 1];
  }

  /** The reply, and the parts of it that can be transferred without a copy. */
  handle(message) {
    if (message.kind === "rows") return this.receive(message);
    const { view, look, rules } = message;
    const began = performance.now();
    const p = project(this.rows, view, look, rules, this.p);
    const order = depthOrder(p);
    if (message.kind === "pick") return [{ kind: "picked", ...this.pick(message, order) }, []];
    if (!message.coarse) this.range = depthRange(p); // while moving, the range of the colours is kept
    if (this.rgb.length < 3 * p.count) this.rgb = new Float32Array(3 * p.row.length);
    const paint = look.paint.by === "depth" ? { ...look.paint, low: this.range[0], high: this.range[1] } : look.paint;
    colours(this.rows, p, view.centre, paint, this.rgb);
    const reply = { depthRange: this.range, mark: this.mark(look.picked), drawn: p.count, thinned: this.thinned(look) };
    if (message.kind === "sort") {
      Object.assign(reply, { kind: "order", ...this.instances(order) });
      return [reply, [reply.order.buffer, reply.colours.buffer]];
    }
    const pixels = rasterise(p, order, this.rgb, view.width, view.height, look.background, rules, this.scratch);
    Object.assign(reply, { kind: "picture", pixels, width: view.width, height: view.height });
    reply.ms = performance.now() - began;
    return [reply, [pixels.buffer]];
  }

  receive({ head, index, bytes, geometry }) {
    if (!this.rows.receive(head, index, bytes)) return [{ kind: "incomplete" }, []];
    const texture = geometry ? this.texture() : null;
    return [{ kind: "received", n: this.rows.n, texture }, texture ? [texture.buffer] : []];
  }

  /** Three texels per row, 1024 rows per line: x y z o | xx xy xz yy | yz zz 0 0. */
  texture() {
    const { n, xyz, cov, opacity } = this.rows;
    const out = new Float32Array(Math.max(1, Math.ceil(n / 1024)) * 3 * 1024 * 4);
    for (let i = 0; i < n; i++) {
      out.set(xyz.subarray(3 * i, 3 * i + 3), 12 * i);
      out[12 * i + 3] = opacity[i];
      out.set(cov.subarray(6 * i, 6 * i + 6), 12 * i + 4);
    }
    return out;
  }

  /** Row and colour of the Gaussians to draw, farthest first, for the graphics card. */
  instances(nearestFirst) {
    const count = this.p.count;
    const order = new Uint32Array(count), out = new Uint8ClampedArray(4 * count);
    for (let k = 0; k < count; k++) {
      const i = nearestFirst[count - 1 - k];
      order[k] = this.p.row[i];
      for (let c = 0; c < 3; c++) out[4 * k + c] = 255 * this.rgb[3 * i + c];
      out[4 * k + 3] = 255;
    }
    return { order, colours: out };
  }

  pick({ x, y, rules }, order) {
    const i = pickAt(this.p, order, x, y, rules);
    return i < 0 ? { row: null } : { row: this.p.row[i], depth: this.p.depth[i], alpha: alphaAt(this.p, i, x, y) };
  }

  /** The ellipse of the picked row, if it is in view. */
  mark(row) {
    const { p } = this;
    const i = row === null ? -1 : p.row.subarray(0, p.count).indexOf(row);
    return i < 0 ? null : { u: p.u[i], v: p.v[i], A: p.A[i], B: p.B[i], C: p.C[i] };
  }

  thinned(look) {
    return this.rows.n > (look.limit ?? Infinity) ? { shown: look.limit, of: this.rows.n } : null;
  }
}
