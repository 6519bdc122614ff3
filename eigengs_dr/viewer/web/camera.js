"use strict";

const MAX_SCALE = 1e12; // beyond it, doubles cannot tell two pixels of the screen apart

/** What the canvas shows: the image point in its middle, and pixels of the screen for one of the image. */
class Camera {
  constructor(width, height) {
    Object.assign(this, { imageWidth: width, imageHeight: height, width: 1, height: 1 });
    this.fitted = true;
    this.resize(1, 1);
  }

  resize(width, height) {
    Object.assign(this, { width, height });
    if (this.fitted) this.fit();
    else this.keepInside();
  }

  get fitScale() {
    return 0.96 * Math.min(this.width / this.imageWidth, this.height / this.imageHeight);
  }

  fit() {
    this.place(this.imageWidth / 2, this.imageHeight / 2, this.fitScale);
    this.fitted = true;
  }

  /** Show one pixel of the image as one of the screen, exactly. */
  showActualSize() {
    const middle = (image, screen) => image / 2 + ((screen - image) / 2 - Math.round((screen - image) / 2));
    this.place(middle(this.imageWidth, this.width), middle(this.imageHeight, this.height), 1);
  }

  place(x, y, scale) {
    Object.assign(this, { x, y, scale, fitted: false });
    this.keepInside();
  }

  keepInside() {
    const least = Math.min(1, this.fitScale / 8);
    this.scale = Math.min(Math.max(this.scale, least), MAX_SCALE);
    this.x = Math.min(Math.max(this.x, 0), this.imageWidth);
    this.y = Math.min(Math.max(this.y, 0), this.imageHeight);
  }

  /** Return the image point at a pixel of the canvas. */
  toImage(px, py) {
    return [this.x + (px - this.width / 2) / this.scale, this.y + (py - this.height / 2) / this.scale];
  }

  /** Return the left, top, width and height of the image on the canvas. */
  get frame() {
    const [w, h] = [this.imageWidth * this.scale, this.imageHeight * this.scale];
    return [this.width / 2 - this.x * this.scale, this.height / 2 - this.y * this.scale, w, h];
  }

  pan(dx, dy) {
    this.place(this.x - dx / this.scale, this.y - dy / this.scale, this.scale);
  }

  /** Zoom by a factor; the image point at a pixel of the canvas stays there. */
  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.toImage(px, py);
    const scale = this.scale;
    this.place(this.x, this.y, scale * factor);
    const real = this.scale / scale;
    this.place(x + (this.x - x) / real, y + (this.y - y) / real, this.scale);
  }
}
