// Triangles to pixels with a z-buffer: the picture of painter.py, with colours interpolated over each triangle.
const NEAR_M = 0.05;
const GREY = 217; // 0.85
const STEP = 2000; // triangles between two pauses of drawing()

export class MeshPainter {
  /** xyz [3 V] metres, faces [3 F], rgb [3 V] bytes. */
  constructor(xyz, faces, rgb) {
    Object.assign(this, { xyz, faces, rgb });
    const n = xyz.length / 3;
    this.at = ["u", "v", "z", "x", "y"].reduce((all, name) => ({ ...all, [name]: new Float32Array(n) }), {});
  }

  /**
   * The picture from `view` (see viewOf). Triangles seen from behind or cut by the near plane are left out.
   * shape: grey instead of the colours; background: three bytes.
   */
  draw(view, shape, background) {
    for (const _ of this.drawing(view, shape, background));
    return { pixels: this.pixels, nearness: this.nearness, width: view.width, height: view.height };
  }

  /** The same with a pause after every few triangles; the picture is in `pixels` and `nearness` at the end. */
  *drawing(view, shape, background) {
    const { width, height } = view;
    if (this.nearness?.length !== width * height) {
      this.nearness = new Float32Array(width * height); // 1 / z: linear in the picture, unlike z
      this.pixels = new Uint8ClampedArray(4 * width * height);
    }
    this.nearness.fill(0);
    const [r, g, b] = background;
    new Uint32Array(this.pixels.buffer).fill((255 << 24) | (b << 16) | (g << 8) | r);
    this.project(view);
    const { faces, at: { x, y, z } } = this;
    for (let f = 0; f < faces.length; f += 3) {
      if (f % (3 * STEP) === 0) yield;
      const i = faces[f], j = faces[f + 1], k = faces[f + 2];
      if (!(z[i] > NEAR_M && z[j] > NEAR_M && z[k] > NEAR_M)) continue;
      const ax = x[j] - x[i], ay = y[j] - y[i], az = z[j] - z[i];
      const bx = x[k] - x[i], by = y[k] - y[i], bz = z[k] - z[i];
      const nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
      const mx = x[i] + x[j] + x[k], my = y[i] + y[j] + y[k], mz = z[i] + z[j] + z[k];
      const facing = -(nx * mx + ny * my + nz * mz);
      if (!(facing > 0)) continue;
      const cosine = facing / Math.sqrt((nx * nx + ny * ny + nz * nz) * (mx * mx + my * my + mz * mz));
      this.fill(i, j, k, shape ? 0.2 + 0.8 * cosine : 0.7 + 0.3 * cosine, shape, width, height);
    }
  }

  /** z-depth of the surface at a point of a picture, metres; null if there is none. */
  static depthAt({ nearness, width }, column, row) {
    const here = nearness[Math.floor(row) * width + Math.floor(column)];
    return here > 0 ? 1 / here : null;
  }

  project({ R, t, fx, fy, cx, cy }) {
    const { xyz, at: { u, v, x, y, z } } = this;
    for (let i = 0, k = 0; k < z.length; i += 3, k++) {
      const a = xyz[i], b = xyz[i + 1], c = xyz[i + 2];
      x[k] = R[0] * a + R[1] * b + R[2] * c + t[0];
      y[k] = R[3] * a + R[4] * b + R[5] * c + t[1];
      z[k] = R[6] * a + R[7] * b + R[8] * c + t[2];
      u[k] = (fx * x[k]) / z[k] + cx;
      v[k] = (fy * y[k]) / z[k] + cy;
    }
  }

  /** One triangle: barycentric weights at the centres of the pixels of its box. */
  fill(i, j, k, light, shape, width, height) {
    const { at: { u, v, z }, rgb, nearness, pixels } = this;
    const area = (u[j] - u[i]) * (v[k] - v[i]) - (v[j] - v[i]) * (u[k] - u[i]);
    if (area === 0) return;
    const left = Math.max(0, Math.ceil(Math.min(u[i], u[j], u[k]) - 0.5));
    const right = Math.min(width - 1, Math.floor(Math.max(u[i], u[j], u[k]) - 0.5));
    const top = Math.max(0, Math.ceil(Math.min(v[i], v[j], v[k]) - 0.5));
    const bottom = Math.min(height - 1, Math.floor(Math.max(v[i], v[j], v[k]) - 0.5));
    const near = [1 / z[i], 1 / z[j], 1 / z[k]];
    const jx = (v[k] - v[i]) / area, jy = -(u[k] - u[i]) / area; // steps of the weights of j and k per pixel
    const kx = -(v[j] - v[i]) / area, ky = (u[j] - u[i]) / area;
    for (let row = top; row <= bottom; row++) {
      for (let column = left; column <= right; column++) {
        const dx = column + 0.5 - u[i], dy = row + 0.5 - v[i];
        const wj = dx * jx + dy * jy, wk = dx * kx + dy * ky, wi = 1 - wj - wk;
        if (wi < 0 || wj < 0 || wk < 0) continue;
        const here = wi * near[0] + wj * near[1] + wk * near[2];
        const at = row * width + column;
        if (here <= nearness[at]) continue;
        nearness[at] = here;
        for (let c = 0; c < 3; c++) {
          const own = shape ? GREY : wi * rgb[3 * i + c] + wj * rgb[3 * j + c] + wk * rgb[3 * k + c];
          pixels[4 * at + c] = own * light;
        }
      }
    }
  }
}
