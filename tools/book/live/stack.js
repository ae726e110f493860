// Press a pixel and see its stack: the Gaussians that made it, nearest first, with alpha, light and weight.
const SHOWN = 8;

async function start(section) {
  const { camera, pose } = DATA, sizes = { width: camera.width, height: camera.height };
  const [map] = await storedMaps(DATA.map), state = { pixel: [87.5, 62.5] };
  const drawn = renderMap(map, camera, viewOf(pose)), order = nearestFirst(drawn.splats);
  const panel = openPanel(section, { draw });
  const view = panel.picture("view", sizes), table = panel.chart("table");
  const choose = (u, v) => {
    state.pixel = [u, v].map((x, k) => Math.min([camera.width, camera.height][k] - 1, Math.floor(x)) + 0.5);
  };
  panel.handle(view, "Pixel", { at: () => state.pixel, move: choose, className: "gsnb-live-ring" });
  panel.press(view, choose);

  const bar = (x, kind) => `<td class="gsnb-live-bar"><span class="gsnb-live-${kind}" style="width:${(100 * x).toFixed(1)}%"></span><span>${x.toFixed(2)}</span></td>`;
  const rgbOf = (row) => [...drawn.splats.rgb.subarray(3 * row, 3 * row + 3)];

  function draw({ show }) {
    const [u, v] = state.pixel, stack = stackAt(drawn.splats, order, u, v);
    const heavy = new Set([...stack].sort((a, b) => b.w - a.w).slice(0, SHOWN));
    const shown = stack.filter((entry) => heavy.has(entry)), rest = stack.filter((entry) => !heavy.has(entry));
    drawPixels(view, drawn.rgb, camera, true);
    for (const { row, w } of shown) {
      view.globalAlpha = 0.25 + 0.75 * Math.min(1, 3 * w);
      if (show === "their ellipses") drawEllipse(view, drawn.splats.uv[2 * row], drawn.splats.uv[2 * row + 1], covarianceOf(drawn.splats, row), 1, "#fff", 0.5);
    }
    view.globalAlpha = 1;
    const rows = shown.map(({ row, alpha, T, w }) => `<tr><td>${swatch(rgbOf(row))}</td><td>${drawn.splats.depth_m[row].toFixed(2)}</td>${bar(alpha, "alpha")}${bar(T, "light")}${bar(w, "weight")}</tr>`);
    const blank = Array.from({ length: SHOWN - shown.length }, () => "<tr><td>&nbsp;</td><td></td><td></td><td></td><td></td></tr>");
    table.innerHTML = `<table><thead><tr><th><span class="gsnb-live-hidden">colour</span></th><th>z, m</th><th>alpha</th><th>light T</th><th>weight</th></tr></thead>
      <tbody>${rows.join("")}${blank.join("")}</tbody></table>`;
    const colour = [0, 1, 2].map((c) => stack.reduce((sum, { row, w }) => sum + w * drawn.splats.rgb[3 * row + c], 0));
    const last = stack.at(-1), light = last ? last.T * (1 - last.alpha) : 1, others = rest.reduce((sum, { w }) => sum + w, 0);
    return `Pixel (${u - 0.5}, ${v - 0.5}): <b>${stack.length} Gaussians</b>. ${rest.length} fainter ones are not listed; together they weigh ${others.toFixed(2)}.
      The weighted sum of the colours is ${swatch(colour)}, and ${(100 * light).toFixed(1)} % of the light is left behind the last one.`;
  }
}
