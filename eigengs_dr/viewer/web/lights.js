"use strict";

/** An object under any light: a picture is a sum of planes, with factors that depend on the light. */
class Lights {
  constructor(facts, set) {
    Object.assign(this, { set, kind: facts.kind, background: facts.background });
    this.lights = new Float64Array(decodeBytes(facts.lights).buffer);
    this.coefficients = new Float64Array(decodeBytes(facts.coefficients).buffer);
    const count = facts.scales.length;
    const rows = facts.planes.map((value, at) => value * facts.scales[at % count]);
    this.planes = set.sorted(rows, count);
    this.aim(...facts.start);
  }

  /** Return the functions of a direction whose sums the factors are, see LightTable. */
  functions(x, y, z) {
    if (this.kind === "thin_plate") {
      const plates = [];
      for (let i = 0; i < this.lights.length; i += 3) {
        const square = (x - this.lights[i]) ** 2 + (y - this.lights[i + 1]) ** 2 + (z - this.lights[i + 2]) ** 2;
        plates.push(0.5 * square * Math.log(Math.max(square, 1e-20)));
      }
      return [...plates, 1, x, y, z];
    }
    z = Math.max(z, 1e-4);
    const [root, ratio, tilt] = [Math.sqrt(z / (1 + z)), z / (1 + z), 2 * z - 1];
    const second = [(x * x - y * y) * ratio, tilt * x * root, 6 * z * z - 6 * z + 1, tilt * y * root];
    return [1, x * root, tilt, y * root, ...second, 2 * x * y * ratio];
  }

  /** Turn the light to a direction, and compute the colours of the set. */
  aim(x, y, z) {
    const length = Math.hypot(x, y, z);
    this.direction = [x / length, y / length, z / length];
    const values = this.functions(...this.direction);
    const count = this.background.length;
    const factors = new Float64Array(3 * (count + 1));
    values.forEach((value, b) => {
      for (let k = 0; k < factors.length; k++) factors[k] += value * this.coefficients[b * factors.length + k];
    });
    const total = (row, at, c) => {
      let sum = 0;
      for (let k = 0; k < count; k++) sum += factors[c * (count + 1) + k] * row[at + k];
      return sum;
    };
    const color = new Float32Array(3 * this.set.count);
    for (let i = 0; i < color.length; i++) color[i] = total(this.planes, Math.floor(i / 3) * count, i % 3);
    this.set.color = color;
    this.set.background = Float32Array.from([0, 1, 2], (c) => total(this.background, 0, c) + factors[(c + 1) * (count + 1) - 1]);
  }

  /** Turn the light to a point of the image: in the middle it is overhead, at the rim at the horizon. */
  aimAt(px, py) {
    const [x, y] = [(2 * px) / this.set.width - 1, 1 - (2 * py) / this.set.height];
    const shrink = Math.min(1, LOWEST / Math.max(Math.hypot(x, y), 1e-9));
    this.aim(x * shrink, y * shrink, Math.sqrt(1 - (x * shrink) ** 2 - (y * shrink) ** 2));
  }
}

const LOWEST = 0.995; // of the way from overhead to the horizon, where photos seldom have a light
