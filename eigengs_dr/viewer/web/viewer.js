"use strict";

const MAX_OUTLINES = 2000; // more of them hide each other
const SLOW_FRAME = 60; // milliseconds; after a slower one, a moving picture has a quarter of the pixels
const INK = { small: [1, 0.55, 0.1], large: [0.25, 0.5, 1], chosen: [0.1, 1, 0.6] };

/** The picture: a set, where one looks at it from, and what is drawn over it. */
class Viewer {
  constructor(canvas, set, light, channels) {
    Object.assign(this, { canvas, set, share: 1, chosen: null, outlined: false, photo: null });
    this.camera = new Camera(set.width, set.height);
    this.look = { count: set.count, cutoff: set.cutoff, light, exposure: 1, wipe: Infinity, rings: [], background: [0, 0, 0] };
    this.wipe = 0.5; // share of the canvas left of the photo
    this.channels = channels;
    // A fixed shuffle, so that a part of the outlines is spread over the image.
    let seed = 1;
    const keys = Float64Array.from(set.number, () => (seed = (seed * 48271) % 2147483647));
    this.shuffled = Uint32Array.from(keys.keys()).sort((i, j) => keys[i] - keys[j]);
    this.inks = this.inksBySize();
    this.listeners = [];
    this.start();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => this.start());
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
  }

  start() {
    this.renderer = new Renderer(this.canvas);
    if (this.photo) this.renderer.setPhoto(this.photo);
    this.recolor();
  }

  /** Upload the colours of the set. */
  recolor() {
    const { color, background } = this.set.pick(this.channels);
    this.renderer.fill(this.renderer.whole, { mean: this.set.mean, factor: this.set.factor, color });
    this.look.background = background;
    this.redraw();
  }

  setPhoto(image) {
    this.photo = image;
    this.renderer.setPhoto(image);
    this.refresh();
  }

  resize() {
    const [width, height] = ["clientWidth", "clientHeight"].map((side) =>
      Math.max(1, Math.min(Math.round(this.canvas[side] * devicePixelRatio), 4096)));
    Object.assign(this.canvas, { width, height });
    this.camera.resize(width, height);
    this.stale = true;
    this.draw(); // at once, as the browser shows an empty canvas otherwise
  }

  /** Sum the Gaussians anew, soon; a picture that moves may be coarse until it rests. */
  redraw(moving = false) {
    clearTimeout(this.rest);
    if (moving) this.rest = setTimeout(() => this.redraw(), 150);
    this.moving = moving;
    this.stale = true;
    this.refresh();
  }

  /** Draw soon what lies over the sums: the photo and outlines. */
  refresh() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame((now) => {
      this.waiting = false;
      if (this.moving && now - this.last > SLOW_FRAME && now - this.last < 1000) this.share = 0.5;
      this.last = this.moving ? now : NaN;
      this.draw();
    });
  }

  draw() {
    this.look.wipe = this.photo && this.comparing ? Math.round(this.wipe * this.camera.width) : 1e9;
    this.look.rings = this.rings();
    if (this.stale) this.renderer.addUp(this.camera, this.look, this.moving ? this.share : 1);
    this.stale = false;
    this.renderer.draw(this.camera, this.look);
    for (const listener of this.listeners) listener();
  }

  /** Return the outlines to draw: of all Gaussians in view, or a part of them, and of the chosen one. */
  rings() {
    const { mean, factor } = this.set;
    const gather = (indices, inkOf) => ({
      mean: Float32Array.from(indices.flatMap((i) => [mean[2 * i], mean[2 * i + 1]])),
      factor: Float32Array.from(indices.flatMap((i) => [...factor.subarray(3 * i, 3 * i + 3)])),
      color: Float32Array.from(indices.flatMap(inkOf)),
    });
    const result = [];
    if (this.outlined) {
      const inView = this.inView();
      const thickness = 0.5 * devicePixelRatio; // the picture shows through
      this.hidden = Math.max(0, inView.length - MAX_OUTLINES);
      result.push({ set: gather(inView.slice(0, MAX_OUTLINES), (i) => this.inks[i]), thickness });
    }
    if (this.chosen !== null) {
      result.push({ set: gather([this.chosen], () => INK.chosen), thickness: 2 * devicePixelRatio });
    }
    return result;
  }

  /** Return colours of outlines, from small to large: in between by the logarithm of the area. */
  inksBySize() {
    const { factor } = this.set;
    const sizes = Float64Array.from({ length: factor.length / 3 }, (_, i) => -Math.log(factor[3 * i] * factor[3 * i + 2]));
    const ranked = sizes.slice().sort();
    const [low, high] = [0.02, 0.98].map((share) => ranked[Math.floor(share * (ranked.length - 1))]);
    return Array.from(sizes, (size) => {
      const share = high > low ? Math.max(0, Math.min((size - low) / (high - low), 1)) : 1;
      return INK.small.map((value, k) => value + share * (INK.large[k] - value));
    });
  }

  inView() {
    const { mean, factor } = this.set;
    const [x0, y0] = this.camera.toImage(0, 0);
    const [x1, y1] = this.camera.toImage(this.camera.width, this.camera.height);
    const result = [];
    for (const i of this.shuffled) {
      if (i >= this.look.count) continue;
      const [x, y] = [mean[2 * i], mean[2 * i + 1]];
      const [a, b, c] = [factor[3 * i], factor[3 * i + 1], factor[3 * i + 2]];
      const [rx, ry] = [Math.hypot(1, b / c) / a, 1 / c];
      if (x + rx > x0 && x - rx < x1 && y + ry > y0 && y - ry < y1) result.push(i);
    }
    return result;
  }

  /** Choose the Gaussian at a pixel of the canvas; none outside the image. */
  choose(px, py) {
    const [x, y] = px === null ? [-1, -1] : this.camera.toImage(px, py);
    const inside = x >= 0 && y >= 0 && x < this.set.width && y < this.set.height;
    const found = inside ? this.set.find(x, y, this.look.count) : { index: -1 };
    const chosen = found.index < 0 ? null : found.index;
    if (chosen !== this.chosen) this.refresh();
    this.chosen = chosen;
    return inside ? { ...found, x, y } : null;
  }
}
