// Chapter 3: the quadtree of a photograph.
async function start(section) {
  const { camera, colours } = DATA, { width, height } = camera;
  const [rgb] = await unpacked(DATA.rgb, Uint8Array, 3 * width * height, 1), photo = await photograph(DATA.photos[0]);
  const panel = openPanel(section, { draw, from: { threshold: (x) => 10 ** x } });
  const context = panel.picture("cells", camera);

  function draw({ show, ...settings }) {
    const leaves = quadtree(rgb, width, height, settings), deepest = Math.max(1, ...leaves.map((leaf) => leaf.level));
    drawImage(context, photo);
    context.lineWidth = 1 / 3;
    for (const { cell, level, mean } of leaves) {
      context.fillStyle = `rgb(${mean.map(Math.round)})`;
      context.strokeStyle = colours[Math.round((colours.length - 1) * (0.15 + (0.85 * level) / deepest))];
      show === "cells" ? context.strokeRect(...cell) : context.fillRect(...cell);
    }
    const squares = leaves.reduce((sum, { cell, variance: [r, g, b] }) => sum + cell[2] * cell[3] * (r + g + b), 0);
    const psnr = -10 * Math.log10(squares / (3 * width * height * 255 ** 2)), count = leaves.length.toLocaleString("en");
    return `<b>${count}</b> cells, one for every ${((width * height) / leaves.length).toFixed(0)} pixels.<br>
      The picture with each cell in its mean colour has a PSNR of ${psnr.toFixed(1)} dB.`;
  }
}
