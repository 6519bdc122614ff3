"use strict";

const ZOOM_STEP = 1.25;

/**
 * Pan and zoom by mouse, touch, pen and keyboard.
 * `moved()` runs after every change, `pointed(x, y)` with the pixel under the pointer or null.
 * After a key, `centred(x, y)` gets the pixel in the middle.
 * `steered(x, y)` gets the pixel under a single finger first: if it returns true, the picture stays.
 */
function listen(canvas, camera, { moved, steered, pointed, centred }) {
  const pointers = new Map();
  let travelled = 0;
  let lastTap = 0;
  const pixel = (event) => {
    const box = canvas.getBoundingClientRect();
    return [(event.clientX - box.left) * devicePixelRatio, (event.clientY - box.top) * devicePixelRatio];
  };
  const middle = () => [0, 1].map((k) => [...pointers.values()].reduce((sum, p) => sum + p[k], 0) / pointers.size);
  const spread = () => {
    const [a, b] = pointers.values();
    return b ? Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1])) : 1;
  };

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, pixel(event));
    if (pointers.size === 1) travelled = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    const at = pixel(event);
    if (!pointers.has(event.pointerId)) {
      if (event.pointerType !== "touch") pointed(...at);
      return;
    }
    const [before, width] = [middle(), spread()];
    pointers.set(event.pointerId, at);
    const after = middle();
    travelled += Math.hypot(after[0] - before[0], after[1] - before[1]) + Math.abs(spread() - width);
    if (pointers.size === 1 && event.pointerType === "touch" && steered(...at)) return;
    camera.pan(after[0] - before[0], after[1] - before[1]);
    camera.zoom(spread() / width, ...after);
    moved();
  });
  const release = (event) => {
    if (!pointers.delete(event.pointerId) || event.type === "pointercancel") return;
    if (pointers.size || travelled > 6 * devicePixelRatio) return;
    const at = pixel(event);
    pointed(...at);
    if (event.timeStamp - lastTap < 300) {
      camera.zoom(2, ...at);
      moved();
    }
    lastTap = event.timeStamp;
  };
  canvas.addEventListener("pointerup", release);
  canvas.addEventListener("pointercancel", release);
  canvas.addEventListener("pointerleave", (event) => {
    if (event.pointerType !== "touch") pointed(null);
  });
  // The divider and the buttons lie over the picture, in the same element.
  canvas.parentElement.addEventListener("wheel", (event) => {
    // Inside another page, the wheel scrolls that page until the picture is chosen.
    if (self !== top && !canvas.parentElement.contains(document.activeElement) && !event.ctrlKey) return;
    event.preventDefault();
    const lines = event.deltaMode === 1 ? 16 * event.deltaY : event.deltaY;
    camera.zoom(2 ** (-Math.max(-300, Math.min(lines, 300)) / (event.ctrlKey ? 100 : 300)), ...pixel(event));
    moved();
  }, { passive: false });

  const step = () => 0.1 * Math.min(camera.width, camera.height);
  const keys = {
    ArrowLeft: () => camera.pan(step(), 0),
    ArrowRight: () => camera.pan(-step(), 0),
    ArrowUp: () => camera.pan(0, step()),
    ArrowDown: () => camera.pan(0, -step()),
    "+": () => camera.zoom(ZOOM_STEP),
    "=": () => camera.zoom(ZOOM_STEP),
    "-": () => camera.zoom(1 / ZOOM_STEP),
    0: () => camera.fit(),
    1: () => camera.showActualSize(),
  };
  document.addEventListener("keydown", (event) => {
    if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.target.closest("input, select, [role=slider]")) return; // which have keys of their own
    event.preventDefault();
    keys[event.key]();
    moved();
    centred(camera.width / 2, camera.height / 2);
  });
}
