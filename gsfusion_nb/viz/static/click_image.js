// A picture. With touch "stroke" it reports a drag, also by the arrow keys: where it began and where the pointer is. Of
// several positions that Python has not read, the newest counts.
const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const KEY_PX = 4; // an arrow key drags by this many pixels of the picture
const REST_MS = 800; // arrow keys within this time are one stroke

class Picture {
  constructor(model, el) {
    this.model = model;
    this.image = document.createElement("img");
    this.image.className = "gsnb-click-image";
    this.image.draggable = false;
    this.url = "";
    this.listeners = ["value", "width", "alt", "touch"].map((name) => [`change:${name}`, () => this.draw()]);
    for (const [event, act] of this.listeners) model.on(event, act);
    this.image.addEventListener("pointerdown", (event) => this.down(event));
    this.image.addEventListener("pointermove", (event) => this.move(event));
    this.image.addEventListener("keydown", (event) => this.key(event));
    this.draw();
    el.appendChild(this.image);
  }

  close() {
    for (const [event, act] of this.listeners) this.model.off(event, act);
    URL.revokeObjectURL(this.url);
  }

  get touch() {
    return this.model.get("touch");
  }

  draw() {
    const { image, model } = this;
    const value = model.get("value");
    if (value !== this.shown) {
      URL.revokeObjectURL(this.url);
      this.url = URL.createObjectURL(new Blob([value], { type: `image/${model.get("format")}` }));
      image.src = this.url;
      this.shown = value;
    }
    image.width = model.get("width");
    image.alt = model.get("alt");
    image.dataset.touch = this.touch;
    if (this.touch) image.tabIndex = 0;
    else image.removeAttribute("tabindex");
  }

  /** Where an event is, in pixels of the picture, with fractions. */
  place(event) {
    const box = this.image.getBoundingClientRect();
    const [columns, rows] = this.model.get("size");
    return [((event.clientX - box.left) / box.width) * columns, ((event.clientY - box.top) / box.height) * rows];
  }

  down(event) {
    if (!this.touch || event.button > 0) return;
    this.image.focus({ preventScroll: true });
    this.image.setPointerCapture(event.pointerId);
    this.held = event.pointerId;
    this.begin(this.place(event));
  }

  move(event) {
    if (!this.touch || this.held !== event.pointerId || !(event.buttons & 1)) return;
    this.drag(this.place(event));
  }

  key(event) {
    const step = STEPS[event.key];
    if (!this.touch || !step) return;
    event.preventDefault();
    event.stopPropagation();
    const [columns, rows] = this.model.get("size");
    const from = this.at ?? [columns / 2, rows / 2];
    if (!this.keys || performance.now() - this.keys > REST_MS) this.begin(from);
    this.drag([this.at[0] + KEY_PX * step[0], this.at[1] + KEY_PX * step[1]]);
    this.keys = performance.now();
  }

  begin(place) {
    this.keys = 0;
    this.start = [this.model.get("stroke")[0] + 1, ...place];
    this.drag(place);
  }

  drag(place) {
    this.at = place;
    this.save({ stroke: [...this.start, ...place] });
  }

  save(values) {
    this.model.set(values);
    this.model.save_changes();
  }
}

export default {
  render({ model, el }) {
    const picture = new Picture(model, el);
    return () => picture.close();
  },
};
