// Fine pictures of a mesh take up to seconds. They are drawn in a worker made from this text, or in the page where a worker
// is not allowed, a slice at a time either way: a newer wish, or none, ends the present one within a slice.
import { MeshPainter } from "./raster.js";

const SLICE_MS = 12;

/** Draws what the newest message asks for; `reply(picture, transfer)` gets it when it is finished. */
export class FineDrawing {
  constructor(reply) {
    this.reply = reply;
  }

  /** {mesh: [xyz, faces, rgb]}, {id, view, shape, background}, or {id} alone: draw nothing. */
  handle({ mesh, id, view, shape, background }) {
    if (mesh) this.painter = new MeshPainter(...mesh);
    this.wanted = id;
    if (!view || !this.painter) return;
    const steps = this.painter.drawing(view, shape, background);
    const slice = () => {
      if (this.wanted !== id) return;
      const until = performance.now() + SLICE_MS;
      let step;
      do step = steps.next(); while (!step.done && performance.now() < until);
      if (step.done) this.finish(id, view);
      else setTimeout(slice);
    };
    slice();
  }

  finish(id, { width, height }) {
    const pixels = this.painter.pixels.slice(), nearness = this.painter.nearness.slice();
    this.reply({ id, pixels, nearness, width, height }, [pixels.buffer, nearness.buffer]);
  }
}

/** `post(message)` and `close()`; pictures arrive at `onPicture`. `mesh()` gives the mesh again if the worker fails. */
export function startFine(source, onPicture, mesh) {
  let worker = null;
  const here = new FineDrawing(onPicture);
  const local = (why) => {
    console.warn("no worker for the mesh viewer, drawing in the page instead:", why);
    worker = null;
    if (mesh()) here.handle({ mesh: mesh() });
  };
  try {
    const loop = "\nconst fine = new FineDrawing((picture, transfer) => postMessage(picture, transfer));\n"
      + "onmessage = (e) => fine.handle(e.data);";
    const url = URL.createObjectURL(new Blob([source + loop], { type: "text/javascript" }));
    worker = new Worker(url);
    worker.onmessage = (e) => onPicture(e.data);
    worker.onerror = (e) => {
      e.preventDefault();
      local(e.message);
    };
  } catch (error) {
    local(error);
  }
  return {
    post: (message) => (worker ? worker.postMessage(message) : here.handle(message)),
    close: () => (worker ? worker.terminate() : here.handle({ id: null })),
  };
}
