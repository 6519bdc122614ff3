"use strict";

/** Draws a set into a canvas by WebGL 2: sums it in floats, then turns the sums into a picture. */
class Renderer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { antialias: false, premultipliedAlpha: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    // Not every phone adds 32-bit floats; 16 bits keep errors below what 8-bit screens show.
    const exact = gl.getExtension("EXT_color_buffer_float") && gl.getExtension("EXT_float_blend");
    if (!exact && !gl.getExtension("EXT_color_buffer_float") && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("this browser's WebGL cannot add floats");
    }
    this.gl = gl;
    this.format = exact ? gl.RGBA32F : gl.RGBA16F;
    this.sum = this.program(SUM_VERTEX, SUM_FRAGMENT);
    this.picture = this.program(FULL_VERTEX, PICTURE_FRAGMENT);
    this.outline = this.program(OUTLINE_VERTEX, OUTLINE_FRAGMENT);
    this.sums = this.texture(gl.NEAREST);
    this.photo = this.texture(gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    this.target = gl.createFramebuffer();
    this.whole = this.texture(gl.NEAREST);
    this.rings = this.texture(gl.NEAREST);
  }

  program(vertex, fragment) {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(`WebGL refused a program: ${[...logs, gl.getProgramInfoLog(program)].join(" ")}`);
    }
    const uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      uniforms[name] = gl.getUniformLocation(program, name);
    }
    return { program, uniforms };
  }

  texture(filter) {
    const gl = this.gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Fill a texture with Gaussians: rows of mean (2), factor (3) and color (3). */
  fill(texture, { mean, factor, color }) {
    const gl = this.gl;
    const count = mean.length / 2;
    const height = Math.max(1, Math.ceil((2 * count) / TEXELS));
    const texels = new Float32Array(4 * TEXELS * height);
    for (let n = 0; n < count; n++) {
      texels.set(mean.subarray(2 * n, 2 * n + 2), 8 * n);
      texels.set(factor.subarray(3 * n, 3 * n + 3), 8 * n + 2);
      texels.set(color.subarray(3 * n, 3 * n + 3), 8 * n + 5);
    }
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, TEXELS, height, 0, gl.RGBA, gl.FLOAT, texels);
  }

  setPhoto(image) {
    const gl = this.gl;
    this.photo = this.texture(gl.LINEAR_MIPMAP_LINEAR);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
  }

  use({ program, uniforms }, values) {
    const gl = this.gl;
    gl.useProgram(program);
    for (const [name, value] of Object.entries(values)) {
      if (!(name in uniforms)) continue;
      if (Array.isArray(value)) gl[`uniform${value.length}fv`](uniforms[name], value);
      else gl.uniform1f(uniforms[name], value);
    }
    for (const [name, unit] of [["sums", 0], ["gaussians", 0], ["photo", 1]]) {
      if (name in uniforms) gl.uniform1i(uniforms[name], unit);
    }
  }

  /** Return what all programs need to know of the camera, for a canvas of some size. */
  placement(camera, look, width, height) {
    const high = [Math.fround(camera.x), Math.fround(camera.y)];
    const scale = (camera.scale * width) / camera.width;
    return {
      center: [...high, camera.x - high[0], camera.y - high[1]],
      canvas: [width, height],
      scale,
      cutoff: look.cutoff,
      box: Math.max(0, 1 - scale * scale) / 12, // the variance of a pixel's box less that of one of the image
    };
  }

  /** Sum the first Gaussians; a `share` below 1 sums fewer pixels, for a picture that moves. */
  addUp(camera, look, share) {
    const gl = this.gl;
    const [width, height] = [Math.ceil(camera.width * share), Math.ceil(camera.height * share)];
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.sums);
    if (this.sumsWidth !== width || this.sumsHeight !== height) {
      gl.texImage2D(gl.TEXTURE_2D, 0, this.format, width, height, 0, gl.RGBA, gl.FLOAT, null);
      Object.assign(this, { sumsWidth: width, sumsHeight: height });
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.sums, 0);
    gl.bindTexture(gl.TEXTURE_2D, this.whole);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    this.use(this.sum, this.placement(camera, look, width, height));
    gl.drawArrays(gl.TRIANGLES, 0, 6 * look.count);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  /** Turn the sums into a picture, with the photo right of the wipe, and outlines over it. */
  draw(camera, look) {
    const gl = this.gl;
    const placement = this.placement(camera, look, camera.width, camera.height);
    gl.viewport(0, 0, camera.width, camera.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.disable(gl.BLEND);
    this.use(this.picture, {
      ...placement,
      frame: camera.frame,
      background: look.background,
      imageSize: [camera.imageWidth, camera.imageHeight],
      wipe: look.wipe,
      share: this.sumsWidth / camera.width,
      exposure: look.exposure,
    });
    gl.uniform1i(this.picture.uniforms.light, look.light);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.photo);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.sums);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    // Outlines are those of the Gaussians themselves.
    for (const ring of look.rings) this.drawRings({ ...placement, box: 0, wipe: look.wipe }, ring);
  }

  /** Wait until everything is drawn. */
  finish() {
    this.gl.readPixels(0, 0, 1, 1, this.gl.RGBA, this.gl.UNSIGNED_BYTE, new Uint8Array(4));
  }

  drawRings(placement, { set, thickness }) {
    const gl = this.gl;
    this.fill(this.rings, set);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.use(this.outline, { ...placement, thickness });
    gl.drawArrays(gl.TRIANGLES, 0, 6 * (set.mean.length / 2));
  }
}
