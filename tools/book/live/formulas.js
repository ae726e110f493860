// The equations of gsfusion_nb/geometry, gsfusion_nb/tsdf and gsfusion_nb/seeding, for a few numbers at a time.
const LUMA_WEIGHTS = [0.2989, 0.587, 0.114], QUADTREE_NORMALISER = 9e7;

/** Eq. 10 without the pose: the point of a pixel (u, v) with z-depth z, camera frame. */
const backproject = (camera, u, v, z) => [((u - camera.cx) / camera.fx) * z, ((v - camera.cy) / camera.fy) * z, z];

/** Eq. 4. */
const project = (camera, [x, y, z]) => [(camera.fx * x) / z + camera.cx, (camera.fy * y) / z + camera.cy];

/** A point through a pose T, three rows of four, and back. */
const apply = (T, [x, y, z]) => T.map(([a, b, c, t]) => a * x + b * y + c * z + t);
const applyInverse = ([a, b, c], [x, y, z]) => [0, 1, 2].map((i) => a[i] * (x - a[3]) + b[i] * (y - b[3]) + c[i] * (z - c[3]));

/** The index of the pixel that contains (u, v); -1 outside the image. */
const pixelAt = ({ width: w, height: h }, [u, v]) => (u >= 0 && u < w && v >= 0 && v < h ? Math.floor(v) * w + Math.floor(u) : -1);

/** Eq. 6: what a frame says about a point of the world, metres; -Infinity where it measured nothing. */
function signedDistance(camera, depth, T_WC, xyz_W) {
  const xyz = applyInverse(T_WC, xyz_W), at = xyz[2] > 0 ? pixelAt(camera, project(camera, xyz)) : -1;
  return depth[at] > 0 ? depth[at] - xyz[2] : -Infinity;
}

/** Eq. 7 to 9: a voxel's [D, W] after its distances from several frames. */
const fused = (distances, truncation, maxWeight) => distances.filter((sdf) => sdf > -truncation).reduce(([D, W], sdf) => {
  const W_k = Math.min(W + 1, maxWeight);
  return [(D * (W_k - 1) + Math.max(-1, Math.min(1, sdf / truncation))) / W_k, W_k];
}, [1, 0]);

/** The first place on a ray where D changes from + to -, between observed samples `step` apart; NaN if there is none. */
function zeroCrossing(samples, start, step) {
  const k = samples.findIndex(([D, W], i) => i > 0 && W > 0 && samples[i - 1][1] > 0 && D < 0 && samples[i - 1][0] >= 0);
  return k < 0 ? NaN : start + step * (k - 1 + samples[k - 1][0] / (samples[k - 1][0] - samples[k][0]));
}

/** Mean and variance of red, green and blue in a cell (x0, y0, width, height). */
function statistics(rgb, imageWidth, [x, y, w, h]) {
  const sum = [0, 0, 0], squares = [0, 0, 0];
  for (let row = y; row < y + h; row++) {
    for (let i = 3 * (row * imageWidth + x); i < 3 * (row * imageWidth + x + w); i++) {
      sum[i % 3] += rgb[i];
      squares[i % 3] += rgb[i] * rgb[i];
    }
  }
  const mean = sum.map((s) => s / (w * h));
  return { mean, variance: squares.map((s, c) => s / (w * h) - mean[c] * mean[c]) };
}

/** Leaves {cell, level, mean, variance} of an image, depth first. */
function quadtree(rgb, width, height, settings, cell = [0, 0, width, height], level = 0) {
  const own = { cell, level, ...statistics(rgb, width, cell) }, [x, y, w, h] = cell, a = w >> 1, b = h >> 1;
  const V = LUMA_WEIGHTS.reduce((sum, weight, c) => sum + weight * own.variance[c], 0);
  const contrast = settings.contrast === "std" ? Math.sqrt(V) / 255 : (V * width * height) / QUADTREE_NORMALISER;
  if (a <= settings.min || b <= settings.min || !(contrast > settings.threshold)) return [own];
  const parts = [[x, y, a, b], [x, y + b, a, h - b], [x + a, y, w - a, b], [x + a, y + b, w - a, h - b]];
  return parts.flatMap((part) => quadtree(rgb, width, height, settings, part, level + 1));
}

/** Leaves cut further while the Gaussian of a cell, of standard deviation z r / fx, would be larger than `largest` metres. */
function cutToSize(leaves, camera, depth, largest, min) {
  const done = [];
  for (let open = leaves; open.length; ) {
    const next = [];
    for (const leaf of open) {
      const [x, y, w, h] = leaf.cell, a = w >> 1, b = h >> 1;
      const isCut = seedOf(leaf.cell, camera, depth).scale > largest && Math.min(a, b) > min;
      if (!isCut) done.push(leaf);
      const parts = [[x, y, a, b], [x, y + b, a, h - b], [x + a, y, w - a, b], [x + a, y + b, w - a, h - b]];
      if (isCut) next.push(...parts.map((cell) => ({ ...leaf, cell, level: leaf.level + 1 })));
    }
    open = next;
  }
  return done;
}

/** Eq. 10: the Gaussian of a cell {pixel, z, xyz in the camera's frame, scale}; its middle takes the depth of the pixel there. */
function seedOf([x, y, w, h], camera, depth) {
  const u = x + w / 2, v = y + h / 2, pixel = Math.floor(v) * camera.width + Math.floor(u), z = depth[pixel];
  return { pixel, z, xyz: backproject(camera, u, v, z), scale: (z * Math.hypot(w, h)) / 2 / camera.fx };
}
