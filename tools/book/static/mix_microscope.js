// The microscope of GPS-SLAM without a kernel: surface and Gaussians of a pixel, and their mean in two orders.
class MixMicroscope extends Microscope {
  constructor(data, el) {
    super(data, el);
    this.below = { values: floats(data.below), width: data.width, behind: data.behind };
  }

  find(u, v) {
    return mixAt(this.splats, this.below, u, v);
  }

  drawGraph() {
    const { u, v, surface, stack } = this.found;
    const graph = new Graph(this.graph, { left: 64, below: 84, bars: stack.length + 1 });
    graph.text(graph.left, 14, "weight: the surface first, then the Gaussians, heaviest first");
    [surface, ...stack].forEach(({ weight, rgb }, k) => graph.bar(k, weight, rgb));
    const orders = { mean: stack, shuffled: shuffled(stack, u + 1000 * v) };
    Object.entries(orders).forEach(([name, order], i) => {
      graph.text(4, 182 + 24 * i, name);
      means([surface, ...order]).forEach((rgb, k) => graph.strip(k, 170 + 24 * i, rgb));
    });
    graph.text(graph.left, 234, "mean of the samples so far, left to right: another order, the same end");
  }

  graphWords() {
    return `weight of the surface and of each of the ${this.found.stack.length} Gaussians, and the mean in two orders`;
  }

  words() {
    const { stack, hidden, colour } = this.found;
    const behind = hidden ? `, ${hidden} behind the surface` : "";
    const total = `, W = ${weightOf(stack).toFixed(2)}, mean = ${rgbWords(colour)}`;
    return [make("b", {}, `surface and ${stack.length} Gaussians`), behind + total];
  }

  rows({ surface, stack, colour }) {
    const total = surface.weight + weightOf(stack);
    const share = (weight) => `${Math.round((100 * weight) / Math.max(total, 1e-9))}%`;
    const line = (k, row, depth, { weight, rgb }) => [k, row, depth, three(weight), share(weight), swatch(rgb), rgbWords(rgb)];
    const lines = [line("", "surface", "", surface)];
    stack.slice(0, TABLE_ROWS).forEach((one, k) => lines.push(line(k, one.row, three(one.depth), one)));
    const more = stack.slice(TABLE_ROWS);
    if (more.length) lines.push(["", `… ${more.length} more`, "", three(weightOf(more)), share(weightOf(more)), "", ""]);
    lines.push(["", "mean", "", three(total), "100%", swatch(colour), rgbWords(colour)]);
    return { heads: ["k", "row", "depth m", "weight", "share", "", "colour"], lines };
  }
}

export default {
  render({ model, el }) {
    new (model.below ? MixMicroscope : Microscope)(model, el);
  },
};
