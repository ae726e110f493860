// Chapter 1: a pixel, its ray and its point, and where another camera sees them.
async function start(section) {
  const { camera, poses } = DATA, n = camera.width * camera.height;
  const depths = await unpacked(DATA.depth, Uint16Array, n, 1e-4);
  const photos = await Promise.all(DATA.photos.map(photograph));
  const panel = openPanel(section, { draw });
  const first = panel.picture("first", camera), second = panel.picture("second", camera);
  const choose = (u, v) => {
    panel.inputs.u.value = Math.floor(u);
    panel.inputs.v.value = Math.floor(v);
  };
  panel.press(first, choose);
  panel.handle(first, "Pixel", { at: () => [Number(panel.inputs.u.value) + 0.5, Number(panel.inputs.v.value) + 0.5], move: choose, className: "gsnb-live-ring" });
  const cross = (context, [x, y], colour) => stroke(context, `M${x - 4} ${y}h8M${x} ${y - 4}v8`, colour, 0.8);
  const list = (numbers, digits) => `(${numbers.map((x) => written(x.toFixed(digits))).join(", ")})`;

  function draw({ u, v }) {
    const z = depths[0][v * camera.width + u], point = (depth) => backproject(camera, u + 0.5, v + 0.5, depth);
    const across = (depth) => applyInverse(poses[1], apply(poses[0], point(depth)));
    const ray = Array.from({ length: 120 }, (_, k) => across(0.3 + 0.05 * k)).filter((xyz) => xyz[2] > 0.05);
    const seen = across(z), uv = project(camera, seen), at = seen[2] > 0 ? pixelAt(camera, uv) : -1, there = depths[1][at];
    drawImage(first, photos[0]);
    drawImage(second, photos[1]);
    stroke(second, `M${ray.map((xyz) => project(camera, xyz)).join("L")}`, "#000", 1);
    stroke(second, `M${ray.map((xyz) => project(camera, xyz)).join("L")}`, "#ffb000", 0.6);
    if (at >= 0) cross(second, uv, "#000");
    if (at >= 0) cross(second, uv, "#fff");
    const what = Math.abs(there - seen[2]) < 0.03 * seen[2] ? "the same surface" : "another surface";
    const other = at < 0 ? "outside its picture" : `where it measured ${there.toFixed(3)} m: ${what}`;
    return `Pixel (${u}, ${v}), centre ${list([u + 0.5, v + 0.5], 1)}: z = <b>${z.toFixed(3)} m</b>,
      x<sub>C</sub> = ${list(point(z), 3)} m, x<sub>W</sub> = ${list(apply(poses[0], point(z)), 3)} m.<br>
      Frame 2 sees this point at ${list(uv, 1)}, z = ${seen[2].toFixed(3)} m, ${other}.`;
  }
}
