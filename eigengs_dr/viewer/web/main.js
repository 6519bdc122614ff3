"use strict";

/** Start the page: window.viewer, .model and .lights are for tests and for the curious. */
async function start() {
  const facts = await inflateAll(JSON.parse(byId("facts").textContent));
  const set = new GaussianSet(facts.set);
  const viewer = new Viewer(byId("view"), set, facts.light, facts.channels);
  window.viewer = viewer;
  connectView(viewer);
  connectCount(viewer, facts.set.levels);
  if (facts.photo) connectPhoto(viewer, facts.photo);
  if (facts.model) {
    window.model = new Model(facts.model, set);
    connectModel(viewer, window.model);
  }
  let steer = () => false;
  if (facts.lights) {
    window.lights = new Lights(facts.lights, set);
    steer = connectLights(viewer, window.lights);
  }
  const choose = (x, y) => showChosen(viewer, viewer.choose(x, y));
  listen(viewer.canvas, viewer.camera, {
    moved: () => viewer.redraw(true),
    steered: steer,
    pointed: (x, y) => {
      const isLight = x !== null && steer(x, y); // which no outline disturbs
      choose(isLight ? null : x, y);
    },
    centred: facts.lights ? () => {} : choose,
  });
  viewer.draw();
  viewer.renderer.finish();
  viewer.ready = performance.now();
}

start().catch((error) => {
  byId("failure").hidden = false;
  byId("failure").textContent = `The picture cannot be drawn: ${error.message}. Try a recent Firefox, Chrome, Edge or Safari.`;
  throw error;
});
