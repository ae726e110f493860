// The elements of viewer.html: controls bound to traits, the legend, the outline of the picked Gaussian.

/** All elements by the end of their class, and every control with `data-trait` bound to that trait. */
export function buildPanel(model) {
  const root = document.createElement("div");
  root.className = "gsnb-splat-root";
  root.innerHTML = PANEL_HTML;
  const nodes = { root };
  for (const node of root.querySelectorAll("*")) {
    for (const name of node.classList) nodes[name.replace("gsnb-splat-", "")] = node;
    // Keys typed here are not for the notebook; JupyterLab asks the focused element before its parents.
    node.setAttribute("data-lm-suppress-shortcuts", "true");
  }
  const fill = () => {
    const names = [["rgb", "colour"], ["depth", "depth from the camera"], ["opacity", "opacity"]];
    const known = names.concat(model.get("columns").map((c) => [c.name, c.label]));
    nodes.colour_by.replaceChildren(...known.map(([value, text]) => new Option(text, value)));
    nodes.colour_by.value = model.get("colour_by");
  };
  fill();
  nodes.cut.max = model.get("reach_m");
  const bound = [...root.querySelectorAll("[data-trait]")].map((control) => bind(model, control));
  return { nodes, listeners: [["change:columns", fill], ...bound] };
}

function bind(model, control) {
  const { trait, scale } = control.dataset;
  const field = control.type === "checkbox" ? "checked" : "value";
  const show = () => {
    const value = model.get(trait);
    control[field] = scale ? Math.log2(Math.max(value, 1e-3)) : value;
  };
  control.addEventListener("input", () => {
    const value = control.type === "range" ? Number(control.value) : control[field];
    model.set(trait, scale ? 2 ** value : value);
    model.save_changes();
  });
  show();
  return [`change:${trait}`, show];
}

const number = (v) => (Number.isInteger(v) ? String(v) : Math.abs(v) < 0.01 ? v.toExponential(1) : v.toFixed(2));

/** The legend of the colours: none, a bar with the values at its ends, or a swatch per name. */
export function showLegend(node, { by, names, low, high, palette: hex }, title, unit = "") {
  node.replaceChildren();
  if (by === "rgb") return;
  const at = (part) => `#${hex.slice(6 * Math.round(part * 255), 6 * Math.round(part * 255) + 6)}`;
  const patch = (kind, background) => {
    const span = document.createElement("span");
    span.className = `gsnb-splat-${kind}`;
    span.style.background = background;
    return span;
  };
  if (names) names.forEach((text, k) => node.append(patch("chip", at(k / Math.max(high - low, 1))), text));
  else {
    const ramp = [0, 0.2, 0.4, 0.6, 0.8, 1].map(at).join(",");
    node.append(`${title} ${number(low)}`, patch("bar", `linear-gradient(to right, ${ramp})`), `${number(high)}${unit}`);
  }
}

/** Names and values of the picked Gaussian. */
export function showRecord(node, lines) {
  const cell = (text) => Object.assign(document.createElement("span"), { textContent: text });
  node.replaceChildren(...lines.flatMap((line) => line.map(cell)));
}

/** The outline of the picked Gaussian: where its value is exp(-2) of that at its centre. */
export function drawMark(canvas, mark, scale) {
  const ctx = canvas.getContext("2d");
  ctx.clearRect(0, 0, canvas.width, canvas.height);
  if (!mark) return;
  const { u, v, A, B, C } = mark;
  const turn = 0.5 * Math.atan2(2 * B, A - C); // of the larger eigenvalue of the conic: the short axis
  const middle = 0.5 * (A + C), spread = Math.hypot(0.5 * (A - C), B);
  const [short, long] = [middle + spread, middle - spread].map((q) => Math.min(2 / Math.sqrt(Math.max(q, 1e-9)) / scale, 4000));
  for (const [colour, width] of [["#000", 4], ["#ff3df0", 2]]) {
    ctx.beginPath();
    ctx.ellipse(u / scale, v / scale, short + 2, long + 2, turn, 0, 2 * Math.PI);
    Object.assign(ctx, { strokeStyle: colour, lineWidth: width });
    ctx.stroke();
  }
}
