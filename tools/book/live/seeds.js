// A frame becomes seeds: the quadtree's cells, and the Gaussian behind the middle of each.
async function start(section) {
  const { camera } = DATA, n = camera.width * camera.height;
  const [bytes] = await unpacked(DATA.rgb, Uint8Array, 3 * n, 1), [depth] = await unpacked(DATA.depth, Uint16Array, n, 1e-4);
  const photo = await photograph(DATA.photo);
  const from = { threshold: (x) => 10 ** x, largest: (x) => 10 ** x };
  const panel = openPanel(section, { draw, from, words: { largest: (x) => `${(100 * x).toFixed(x < 0.1 ? 1 : 0)} cm`, side: (x) => `${x}°` } });
  const cells = panel.picture("cells", camera), view = panel.picture("view", camera);
  const nearest = depth.filter((z) => z > 0).sort();
  const pivot = nearest[nearest.length >> 1];

  /** A camera turned about the vertical axis through a point in the middle of the scene. */
  function turned(degrees) {
    const [c, s] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
    return viewOf([[c, 0, -s, pivot * s], [0, 1, 0, 0], [s, 0, c, pivot - pivot * c]]);
  }

  function seedMap(leaves) {
    const seeds = leaves.map(({ cell }) => seedOf(cell, camera, depth)).filter(({ z }) => z > 0), map = emptyMap(seeds.length);
    seeds.forEach(({ xyz, scale, pixel }, i) => {
      map.xyz_W.set(xyz, 3 * i);
      map.log_scale.fill(Math.log(scale), 3 * i, 3 * i + 3);
      map.quat[4 * i] = 1;
      for (let c = 0; c < 3; c++) map.sh[3 * i + c] = (bytes[3 * pixel + c] / 255 - 0.5) / SH_C0;
    });
    return map;
  }

  function draw({ threshold, largest, side, size }) {
    const leaves = quadtree(bytes, camera.width, camera.height, { threshold, min: 1, contrast: "released" });
    const all = cutToSize(leaves, camera, depth, largest, 1), map = seedMap(all);
    drawImage(cells, photo);
    Object.assign(cells, { lineWidth: 0.22, strokeStyle: "rgb(255 255 255 / 0.7)" });
    for (const { cell } of all) cells.strokeRect(...cell);
    if (size !== "as seeded") for (let k = 0; k < map.log_scale.length; k++) map.log_scale[k] -= Math.log(4);
    drawPixels(view, renderMap(map, camera, turned(side)).rgb, camera, true);
    const cutLater = all.length - leaves.length;
    return `<b>${all.length.toLocaleString("en")} cells, ${map.n.toLocaleString("en")} Gaussians</b>, one for ${(n / map.n).toFixed(0)} pixels.
      ${cutLater ? `The limit of size made ${cutLater.toLocaleString("en")} of them.` : "The limit of size cuts none of them."}`;
  }
}
