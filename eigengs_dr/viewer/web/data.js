"use strict";

/** Decode base64 to bytes. */
const decodeBytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

/** Decode 16-bit floats to a Float32Array. */
function decodeHalves(codes) {
  return Float32Array.from(codes, (bits) => {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    return exponent ? sign * 2 ** (exponent - 25) * (1024 + fraction) : sign * 2 ** -24 * fraction;
  });
}

/** Decode rows of floats to a Float32Array, see `deflated` in view.py. */
async function inflateRows({ rows, columns, kind, deflated }) {
  const stream = new Blob([decodeBytes(deflated)]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const size = bytes.length / Math.max(rows * columns, 1);
  const numbers = new Uint8Array(bytes.length);
  for (let c = 0; c < columns; c++) {
    for (let k = 0; k < size; k++) {
      for (let i = 0; i < rows; i++) numbers[(i * columns + c) * size + k] = bytes[(c * size + k) * rows + i];
    }
  }
  return kind === "<f2" ? decodeHalves(new Uint16Array(numbers.buffer)) : new Float32Array(numbers.buffer);
}

/** Inflate all rows in the facts of a page. */
async function inflateAll(facts) {
  if (typeof facts !== "object" || facts === null) return facts;
  if ("deflated" in facts) return inflateRows(facts);
  const entries = await Promise.all(Object.entries(facts).map(async ([name, value]) => [name, await inflateAll(value)]));
  return Array.isArray(facts) ? entries.map(([, value]) => value) : Object.fromEntries(entries);
}

/**
 * N Gaussians: I(x) = background + sum_n color_n exp(-1/2 |F_n (x - mean_n)|^2), F = [[a, b], [0, c]].
 * They are kept in the order in which they are drawn; `number[i]` counts from 1 in the order of the file.
 */
class GaussianSet {
  constructor(facts) {
    Object.assign(this, { width: facts.width, height: facts.height, cutoff: facts.cutoff });
    const { factor } = facts;
    this.count = factor.length / 3;
    const order = Array.from({ length: this.count }, (_, i) => i);
    // Without levels, any first part of the file is arbitrary: show the large Gaussians first.
    if (!facts.levels.length) {
      order.sort((i, j) => factor[3 * i] * factor[3 * i + 2] - factor[3 * j] * factor[3 * j + 2]);
    }
    const sorted = (rows, size) => {
      const result = new Float32Array(rows.length);
      order.forEach((from, to) => {
        for (let k = 0; k < size; k++) result[size * to + k] = rows[size * from + k];
      });
      return result;
    };
    this.sorted = sorted;
    this.number = Uint32Array.from(order, (i) => i + 1);
    this.channels = facts.background.length;
    this.mean = sorted(facts.mean, 2);
    this.factor = sorted(factor, 3);
    // Lights have planes instead, whose sums they set.
    this.color = facts.color ? sorted(facts.color, this.channels) : new Float32Array(this.count * this.channels);
    this.background = Float32Array.from(facts.background);
  }

  /** Return three channels of all Gaussians, and of the background behind them. */
  pick(channels) {
    const rows = new Float32Array(3 * this.count);
    for (let i = 0; i < this.count; i++) {
      for (let k = 0; k < 3; k++) rows[3 * i + k] = this.color[this.channels * i + channels[k]];
    }
    return { color: rows, background: channels.map((c) => this.background[c]) };
  }

  /** Return the distance of a point from a Gaussian in standard deviations, squared: |F (x - mean)|^2. */
  distance(i, x, y) {
    const dx = x - this.mean[2 * i];
    const dy = y - this.mean[2 * i + 1];
    const u = this.factor[3 * i] * dx + this.factor[3 * i + 1] * dy;
    const v = this.factor[3 * i + 2] * dy;
    return u * u + v * v;
  }

  /**
   * Find the smallest of the first Gaussians whose outline holds a point, or else the nearest one in
   * standard deviations, and how many reach the point. The index is -1 if none does.
   */
  find(x, y, first) {
    let [index, least, reach] = [-1, Infinity, 0];
    for (let i = 0; i < first; i++) {
      const q = this.distance(i, x, y);
      if (q > this.cutoff * this.cutoff) continue;
      reach++;
      const area = 1 / (this.factor[3 * i] * this.factor[3 * i + 2]);
      const rank = q <= 1 ? -1 / area : q;
      if (rank < least) [index, least] = [i, rank];
    }
    return { index, reach, weight: index < 0 ? 0 : Math.exp(-0.5 * this.distance(index, x, y)) };
  }

  /** Return the standard deviations along both axes, and the angle of the longer one, in degrees. */
  axes(i) {
    const [a, b, c] = this.factor.subarray(3 * i, 3 * i + 3);
    const [ia, t, ic] = [1 / a, -b / (a * c), 1 / c]; // F^-1 = [[ia, t], [0, ic]]
    const [xx, xy, yy] = [ia * ia + t * t, t * ic, ic * ic];
    const middle = (xx + yy) / 2;
    const root = Math.hypot((xx - yy) / 2, xy);
    const angle = (Math.atan2(2 * xy, xx - yy) / 2) * (180 / Math.PI);
    return { long: Math.sqrt(middle + root), short: (ia * ic) / Math.sqrt(middle + root), angle: (angle + 180) % 180 };
  }
}
