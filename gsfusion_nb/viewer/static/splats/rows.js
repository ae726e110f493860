// The rows of a map, in the packed form that is sent and in the form in which they are stored.
// The records are packed by gsfusion_nb/viewer/splat_rows.py:
// xyz 3 x f32 | quaternion wxyz 4 x f16 | log scale 3 x f16 | opacity f16 | columns C x f32 | harmonics 3 K x f16.

/** Every float16 as a float32. Not all browsers have Float16Array. */
const HALF = (() => {
  const table = new Float32Array(65536);
  for (let bits = 0; bits < 65536; bits++) {
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    let value = exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024);
    if (exponent === 31) value = fraction ? NaN : Infinity;
    table[bits] = bits & 32768 ? -value : value;
  }
  return table;
})();

export class Rows {
  constructor() {
    this.n = 0;
    this.layout = null;
  }

  /**
   * Take in records: all of the map, or those of the rows in `index` (changed and new ones).
   * A part that does not fit what is here already is refused: false means that everything must be sent again.
   */
  receive({ n, stride, columns, harmonics, all }, index, bytes) {
    if (!all && (!this.layout || this.layout.stride !== stride || n < this.n)) return false;
    if (all) Object.assign(this, { n: 0, layout: { stride, columns, harmonics } });
    this.resize(n);
    const f32 = new Float32Array(bytes);
    const u16 = new Uint16Array(bytes);
    const count = bytes.byteLength / stride;
    for (let k = 0; k < count; k++) this.unpack(index ? index[k] : k, f32, u16, k * stride);
    this.cut = null;
    return true;
  }

  resize(n) {
    const { columns, harmonics } = this.layout;
    const keep = (old, width) => {
      const length = n * width;
      if (this.n && old.length >= length) return old;
      const grown = new Float32Array(this.n ? Math.ceil(length * 1.3) : length);
      if (this.n) grown.set(old.subarray(0, this.n * width));
      return grown;
    };
    this.xyz = keep(this.xyz, 3);
    this.cov = keep(this.cov, 6); // xx xy xz yy yz zz, m^2
    this.opacity = keep(this.opacity, 1);
    this.importance = keep(this.importance, 1);
    this.values = keep(this.values, columns);
    this.sh = keep(this.sh, 3 * harmonics);
    this.n = n;
  }

  unpack(row, f32, u16, at) {
    const { columns, harmonics } = this.layout;
    const word = at >> 2;
    for (let k = 0; k < 3; k++) this.xyz[3 * row + k] = f32[word + k];
    const half = (at >> 1) + 6;
    const s = [4, 5, 6].map((k) => Math.exp(2 * HALF[u16[half + k]])); // variances
    this.covariance(row, HALF[u16[half]], HALF[u16[half + 1]], HALF[u16[half + 2]], HALF[u16[half + 3]], s);
    this.opacity[row] = HALF[u16[half + 7]];
    this.importance[row] = this.opacity[row] * Math.sqrt(s[0] * s[1] + s[1] * s[2] + s[2] * s[0]); // opacity x area
    for (let k = 0; k < columns; k++) this.values[columns * row + k] = f32[word + 7 + k];
    const colour = (at >> 1) + 14 + 2 * columns;
    for (let k = 0; k < 3 * harmonics; k++) this.sh[3 * harmonics * row + k] = HALF[u16[colour + k]];
  }

  /** R diag(s) R^T of the unit quaternion. */
  covariance(row, w, x, y, z, s) {
    const n = 2 / (w * w + x * x + y * y + z * z || 1);
    const R = [
      1 - n * (y * y + z * z), n * (x * y - w * z), n * (x * z + w * y),
      n * (x * y + w * z), 1 - n * (x * x + z * z), n * (y * z - w * x),
      n * (x * z - w * y), n * (y * z + w * x), 1 - n * (x * x + y * y),
    ];
    let at = 6 * row;
    for (let i = 0; i < 3; i++) {
      for (let j = i; j < 3; j++) {
        this.cov[at++] = R[3 * i] * R[3 * j] * s[0] + R[3 * i + 1] * R[3 * j + 1] * s[1] + R[3 * i + 2] * R[3 * j + 2] * s[2];
      }
    }
  }

  /** The importance that `limit` rows reach; -1 where all rows may be drawn. */
  threshold(limit) {
    if (this.n <= limit) return -1;
    if (this.cut?.limit !== limit) {
      const sorted = this.importance.slice(0, this.n).sort();
      this.cut = { limit, value: sorted[this.n - limit] };
    }
    return this.cut.value;
  }
}
