"use strict";

/**
 * The principal components of a family of images: weights of all Gaussians for each component.
 * A picture is the base set, plus sum_j (z_j - z0_j) deviation_j weights_j in each channel.
 */
class Model {
  constructor(facts, set) {
    this.set = set;
    this.matrix = facts.matrix; // from the channels of the model to RGB
    this.channels = facts.channels.map((channel) => {
      const { weights, deviations, scales } = channel;
      const components = deviations.map((deviation, j) => {
        const column = Float32Array.from({ length: set.count + 1 }, (_, i) => weights[i * deviations.length + j]);
        // The background is last.
        return { deviation: deviation * scales[j], gaussians: set.sorted(column.subarray(0, -1), 1), background: column[set.count] };
      });
      return { name: channel.name, components };
    });
    const zeros = this.channels.map(({ components }) => components.map(() => 0));
    this.bases = { mean: { color: set.color, background: set.background, scores: zeros } };
    if (facts.photo) {
      const color = set.sorted(facts.photo.color, 3);
      const background = Float32Array.from(facts.photo.background);
      this.bases.photo = { color, background, scores: facts.photo.scores };
    }
    this.start(facts.photo ? "photo" : "mean");
  }

  /** Return to the mean image or to the photo. */
  start(name) {
    this.base = this.bases[name];
    this.scores = this.base.scores.map((values) => [...values]);
    this.mix();
  }

  /** Draw an image from the prior: every score is normal, with a deviation of 1. */
  draw() {
    this.base = this.bases.mean;
    const normal = () => Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
    this.scores = this.base.scores.map((values) => values.map(normal));
    this.mix();
  }

  /** Compute the colours of the set from the scores. */
  mix() {
    const { color, background, scores } = this.base;
    const count = this.set.count;
    const moved = this.channels.map(() => new Float64Array(count + 1));
    this.channels.forEach(({ components }, c) =>
      components.forEach(({ deviation, gaussians, background: last }, j) => {
        const amount = (this.scores[c][j] - scores[c][j]) * deviation;
        if (!amount) return;
        for (let i = 0; i < count; i++) moved[c][i] += amount * gaussians[i];
        moved[c][count] += amount * last;
      }));
    const mixed = (k, i) => this.matrix[k].reduce((sum, entry, c) => sum + entry * moved[c][i], 0);
    this.set.color = color.map((value, at) => value + mixed(at % 3, Math.floor(at / 3)));
    this.set.background = background.map((value, k) => value + mixed(k, count));
  }
}
