// What the panels share: stored arrays, controls, and canvases that a pointer can touch.
const create = (tag, values, ...children) => {
  const element = Object.assign(document.createElement(tag), values);
  element.append(...children);
  return element;
};

/** Images of n numbers each, which Python packed in units of `unit`. */
async function unpacked(packed, Type, n, unit) {
  const bytes = Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const numbers = Float64Array.from(new Type(await new Response(stream).arrayBuffer()), (x) => x * unit);
  return Array.from({ length: numbers.length / n }, (_, i) => numbers.subarray(i * n, (i + 1) * n));
}

/** A picture, 3 bytes for each pixel, as a promise of something that a canvas can draw. */
function bitmap(rgb, { width, height }) {
  const rgba = Uint8ClampedArray.from({ length: 4 * width * height }, (_, i) => (i % 4 < 3 ? rgb[3 * (i >> 2) + (i % 4)] : 255));
  return createImageBitmap(new ImageData(rgba, width, height));
}

/** Draws a path in the syntax of SVG. */
const stroke = (context, path, strokeStyle, lineWidth) => Object.assign(context, { strokeStyle, lineWidth }).stroke(new Path2D(path));

/**
 * Pictures with sliders and lists below; draw(values) after every change gives a text as HTML. The result adds a canvas.
 *
 * controls: name -> {label, min, max, step, value, from (value at a position of the slider)} or {label, options}
 */
function preparePanel(place, controls, draw) {
  const pictures = create("div", { className: "gsnb-live-pictures" }), text = create("p", { role: "status" });
  const inputs = {};
  const rows = Object.entries(controls).map(([name, { label, options, from, ...range }]) => {
    const list = () => create("select", { ariaLabel: label }, ...options.map((words) => new Option(words)));
    inputs[name] = options ? list() : create("input", { type: "range", ariaLabel: label, ...range });
    return create("label", {}, create("span", { textContent: label }), inputs[name], create("output"));
  });
  place.replaceChildren(pictures, create("div", { className: "gsnb-live-controls", oninput: redraw }, ...rows), text);
  queueMicrotask(redraw);

  function redraw() {
    const values = {};
    for (const [name, { options, from = Number }] of Object.entries(controls)) {
      values[name] = options ? inputs[name].value : from(inputs[name].value);
      if (!options) inputs[name].ariaValueText = inputs[name].nextSibling.textContent = Number(values[name].toPrecision(3));
    }
    text.innerHTML = draw(values);
  }

  /** A canvas of so many units, each of `scale` dots. touch(x, y) gives the sliders' positions where it is pressed. */
  return ({ width, height }, scale, title, touch) => {
    const element = create("canvas", { width: width * scale, height: height * scale, role: "img", ariaLabel: title });
    pictures.append(create("figure", {}, element, create("figcaption", { textContent: title })));
    const press = ({ offsetX, offsetY }) => {
      const positions = touch((offsetX / element.clientWidth) * width, (offsetY / element.clientHeight) * height);
      for (const [name, position] of Object.entries(positions)) inputs[name].value = Math.floor(position);
      redraw();
    };
    if (touch) {
      element.className = "gsnb-live-touch";
      element.onpointerdown = (event) => element.setPointerCapture(event.pointerId) ?? press(event);
      element.onpointermove = (event) => element.hasPointerCapture(event.pointerId) && press(event);
    }
    const context = element.getContext("2d");
    context.scale(scale, scale);
    return Object.assign(context, { imageSmoothingEnabled: false });
  };
}
