// Chapter 1: a pixel, its ray and its point, and where another camera sees them.
async function start(place) {
  const { camera, poses } = DATA, n = camera.width * camera.height;
  const depths = await unpacked(DATA.depth, Uint16Array, n, 1e-4);
  const photos = await Promise.all((await unpacked(DATA.rgb, Uint8Array, 3 * n, 1)).map((rgb) => bitmap(rgb, camera)));
  const controls = {
    u: { label: "pixel column u", min: 0, max: camera.width - 1, value: 62 },
    v: { label: "pixel row v", min: 0, max: camera.height - 1, value: 72 },
  };
  const canvas = preparePanel(place, controls, draw);
  const first = canvas(camera, 4, "frame 0: press a pixel", (u, v) => ({ u, v }));
  const second = canvas(camera, 4, "frame 2: the ray and the point of this pixel");
  const cross = (context, [x, y]) => stroke(context, `M${x - 4} ${y}h8M${x} ${y - 4}v8`, "#ff3040", 0.8);
  const list = (numbers, digits) => `(${numbers.map((x) => x.toFixed(digits)).join(", ")})`;

  function draw({ u, v }) {
    const z = depths[0][v * camera.width + u], point = (depth) => backproject(camera, u + 0.5, v + 0.5, depth);
    const across = (depth) => applyInverse(poses[1], apply(poses[0], point(depth)));
    const ray = Array.from({ length: 120 }, (_, k) => across(0.3 + 0.05 * k)).filter((xyz) => xyz[2] > 0.05);
    const seen = across(z), uv = project(camera, seen), at = seen[2] > 0 ? pixelAt(camera, uv) : -1, there = depths[1][at];
    first.drawImage(photos[0], 0, 0);
    cross(first, [u + 0.5, v + 0.5]);
    second.drawImage(photos[1], 0, 0);
    stroke(second, `M${ray.map((xyz) => project(camera, xyz)).join("L")}`, "#ffb300", 0.6);
    if (at >= 0) cross(second, uv);
    const what = Math.abs(there - seen[2]) < 0.03 * seen[2] ? "the same surface" : "another surface";
    const other = at < 0 ? "outside its picture" : `where it measured ${there.toFixed(3)} m: ${what}`;
    return `Pixel (${u}, ${v}), centre ${list([u + 0.5, v + 0.5], 1)}: z = <b>${z.toFixed(3)} m</b>,
      x<sub>C</sub> = ${list(point(z), 3)} m, x<sub>W</sub> = ${list(apply(poses[0], point(z)), 3)} m.<br>
      Frame 2 sees this point at ${list(uv, 1)}, z = ${seen[2].toFixed(3)} m, ${other}.`;
  }
}
