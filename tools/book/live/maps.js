// Maps that Python stored: what each of them adds to the one before.

/** Maps in the order of their storing: 8192 levels between the ends of its range for a place, 128 for the rest. */
async function storedMaps({ counts, ranges, wide, narrow }) {
  const most = Math.max(...counts);
  const wideDeltas = new Uint16Array(await inflated(wide)), narrowDeltas = new Uint8Array(await inflated(narrow));
  const levels = { xyz_W: new Uint16Array(3 * most) };
  for (const name of ["log_scale", "quat", "opacity_logit", "sh"]) levels[name] = new Uint8Array(COLUMNS[name] * most);
  const read = { wide: 0, narrow: 0 };
  return counts.map((n) => {
    const map = emptyMap(n);
    for (const [name, width] of Object.entries(COLUMNS)) {
      const [deltas, kind, top] = name === "xyz_W" ? [wideDeltas, "wide", 8191] : [narrowDeltas, "narrow", 127];
      const [low, high] = ranges[name];
      for (let c = 0; c < width; c++) {
        for (let i = 0; i < n; i++) levels[name][width * i + c] += deltas[read[kind]++]; // it wraps around, as in Python
      }
      for (let k = 0; k < n * width; k++) map[name][k] = low + (levels[name][k] / top) * (high - low);
    }
    return map;
  });
}
