"use strict";

const SLIDERS = 8; // components of each channel that have a slider

const byId = (id) => document.getElementById(id);
const withCommas = (number) => Math.round(number).toLocaleString("en-US");

/** Connect the slider of how many Gaussians are drawn; it is logarithmic. */
function connectCount(viewer, levels) {
  const { count } = viewer.set;
  const slider = byId("count");
  const show = (number) => {
    viewer.look.count = Math.max(1, Math.min(number, count));
    slider.value = count > 1 ? 1000 * (Math.log(viewer.look.count) / Math.log(count)) : 1000;
    const text = viewer.look.count === count ? `all ${withCommas(count)}` : `${withCommas(viewer.look.count)} of ${withCommas(count)}`;
    byId("count-text").textContent = text;
    slider.setAttribute("aria-valuetext", text);
  };
  slider.addEventListener("input", () => {
    show(Math.round(count ** (slider.value / 1000)));
    viewer.redraw(true);
  });
  for (const level of levels) {
    const button = document.createElement("button");
    button.textContent = withCommas(level);
    button.addEventListener("click", () => (show(level), viewer.redraw()));
    byId("levels").append(button);
  }
  show(count);
}

/** Connect what is compared with the photo: a checkbox, and a divider to drag. */
function connectPhoto(viewer, uri) {
  const [box, divider] = [byId("compare"), byId("divider")];
  const image = new Image();
  image.addEventListener("load", () => viewer.setPhoto(image));
  image.src = uri;
  const place = () => {
    divider.hidden = !viewer.comparing;
    divider.style.left = `${100 * viewer.wipe}%`;
    divider.setAttribute("aria-valuenow", Math.round(100 * viewer.wipe));
  };
  const move = (wipe) => {
    viewer.wipe = Math.max(0, Math.min(wipe, 1));
    viewer.refresh();
  };
  viewer.listeners.push(place);
  box.addEventListener("change", () => {
    viewer.comparing = box.checked;
    viewer.refresh();
  });
  divider.addEventListener("pointerdown", (event) => divider.setPointerCapture(event.pointerId));
  divider.addEventListener("pointermove", (event) => {
    if (!divider.hasPointerCapture(event.pointerId)) return;
    const { left, width } = viewer.canvas.getBoundingClientRect();
    move((event.clientX - left) / width);
  });
  divider.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (step) move(viewer.wipe + step);
  });
}

/** Show the parameters of the Gaussian that was pointed at. */
function showChosen(viewer, found) {
  const facts = byId("chosen");
  const { set } = viewer;
  facts.hidden = !found || found.index < 0;
  byId("none").hidden = !facts.hidden;
  if (facts.hidden) return;
  const i = found.index;
  const { long, short, angle } = set.axes(i);
  const color = set.color.subarray(set.channels * i, set.channels * (i + 1));
  const digits = (values, places) => Array.from(values, (v) => v.toFixed(places)).join(", ");
  const shown = {
    number: `${withCommas(set.number[i])} of ${withCommas(set.count)}`,
    mean: `${digits(set.mean.subarray(2 * i, 2 * i + 2), 2)} px`,
    size: `${long.toPrecision(3)} × ${short.toPrecision(3)} px`,
    angle: `${angle.toFixed(0)}°`,
    color: color.length > 4 ? `${digits(color.subarray(0, 4), 3)}, …` : digits(color, 3),
    weight: `${(100 * found.weight).toFixed(1)} %`,
    reach: `${withCommas(found.reach)} Gaussians`,
  };
  for (const [name, text] of Object.entries(shown)) byId(`chosen-${name}`).textContent = text;
}

/** Build the sliders of a model, and connect its buttons. */
function connectModel(viewer, model) {
  const sliders = [];
  const update = (moving) => {
    model.mix();
    viewer.recolor();
    if (moving) viewer.redraw(true);
    for (const [slider, text, c, j] of sliders) {
      const score = Math.round(10 * model.scores[c][j]) / 10;
      slider.value = model.scores[c][j];
      text.textContent = (score < 0 ? "−" : "+") + Math.abs(score).toFixed(1);
    }
  };
  model.channels.forEach(({ name, components }, c) => {
    if (!components.length) return;
    const group = document.createElement("fieldset");
    const legend = document.createElement("legend");
    legend.textContent = name;
    group.append(legend);
    components.slice(0, SLIDERS).forEach((_, j) => {
      const [label, title, slider, text] = ["label", "span", "input", "output"].map((tag) => document.createElement(tag));
      const reach = Math.max(3, Math.ceil(Math.abs(model.bases.photo?.scores[c][j] ?? 0)));
      Object.assign(slider, { type: "range", min: -reach, max: reach, step: 0.05 });
      title.textContent = j + 1;
      slider.setAttribute("aria-label", `${name}, component ${j + 1}, standard deviations`);
      slider.addEventListener("input", () => {
        model.scores[c][j] = Number(slider.value);
        update(true);
      });
      slider.addEventListener("dblclick", () => {
        model.scores[c][j] = model.base.scores[c][j];
        update(false);
      });
      label.append(title, slider, text);
      group.append(label);
      sliders.push([slider, text, c, j]);
    });
    byId("components").append(group);
  });
  for (const [id, change] of [
    ["mean-image", () => model.start("mean")],
    ["random-image", () => model.draw()],
    ["photo-image", () => model.start("photo")],
  ]) byId(id)?.addEventListener("click", () => (change(), update(false)));
  update(false);
}

/** Connect the light: buttons and sliders for where it stands; return what turns it to a pixel of the canvas. */
function connectLights(viewer, lights) {
  const [turn, height, follows] = ["turn", "height", "follows"].map(byId);
  const degrees = Math.PI / 180;
  const show = (moving) => {
    const [x, y, z] = lights.direction;
    if (Math.hypot(x, y) > 1e-6) turn.value = (Math.round(Math.atan2(y, x) / degrees) + 360) % 360;
    height.value = Math.round(Math.asin(z) / degrees);
    byId("direction").textContent = lights.direction.map((v) => v.toFixed(2)).join(", ");
    viewer.recolor();
    if (moving) viewer.redraw(true);
  };
  for (const slider of [turn, height]) {
    slider.addEventListener("input", () => {
      const [a, b] = [turn.value * degrees, height.value * degrees];
      lights.aim(Math.cos(a) * Math.cos(b), Math.sin(a) * Math.cos(b), Math.sin(b));
      show(true);
    });
  }
  for (const button of document.querySelectorAll("#presets button")) {
    button.addEventListener("click", () => {
      follows.checked = false; // else the pointer turns it away on its way to the picture
      lights.aim(...button.dataset.light.split(",").map(Number));
      show(true);
    });
  }
  show(false);
  return (px, py) => {
    if (!follows.checked) return false;
    lights.aimAt(...viewer.camera.toImage(px, py));
    show(true);
    return true;
  };
}

/** Connect the other controls. */
function connectView(viewer) {
  const { camera } = viewer;
  const actions = {
    "zoom-in": () => camera.zoom(ZOOM_STEP),
    "zoom-out": () => camera.zoom(1 / ZOOM_STEP),
    fit: () => camera.fit(),
    "actual-size": () => camera.showActualSize(),
  };
  for (const [id, action] of Object.entries(actions)) {
    byId(id).addEventListener("click", () => (action(), viewer.redraw()));
  }
  viewer.listeners.push(() => {
    const percent = 100 * camera.scale;
    byId("zoom").textContent = `${percent < 10 ? percent.toPrecision(2) : percent < 1e7 ? withCommas(percent) : percent.toExponential(0)} %`;
    const part = `Shown for ${withCommas(MAX_OUTLINES)} of the ${withCommas(MAX_OUTLINES + viewer.hidden)} in view; zoom in to see all.`;
    byId("note").textContent = viewer.outlined ? `At one standard deviation, orange for small Gaussians, blue for large ones. ${viewer.hidden ? part : ""}` : "";
  });
  byId("outlines").addEventListener("change", (event) => {
    viewer.outlined = event.target.checked;
    viewer.refresh();
  });
  byId("exposure")?.addEventListener("input", (event) => {
    viewer.look.exposure = 2 ** event.target.value;
    byId("exposure-text").textContent = `${event.target.value > 0 ? "+" : ""}${event.target.value} stops`;
    viewer.refresh();
  });
  byId("channels")?.addEventListener("change", (event) => {
    viewer.channels = event.target.value.split(",").map(Number);
    viewer.recolor();
  });
}
