"use strict";

// Places on the canvas are in pixels, y down, as in the image. `center` holds the image point in the
// middle of the canvas as a float and its rounding error, so that any zoom is exact.
const TEXELS = 2048; // width of a texture of Gaussians
const PLACEMENT = `#version 300 es
precision highp float;
const int TEXELS = ${TEXELS};
uniform vec4 center;
uniform vec2 canvas;
uniform float scale, cutoff, box;
uniform highp sampler2D gaussians;  // two texels for each: x, y, a, b and c, R, G, B
flat out vec2 place;
flat out vec3 sharpness, color;

void load(int n) {
  ivec2 at = ivec2(2 * n % TEXELS, 2 * n / TEXELS);
  vec4 first = texelFetch(gaussians, at, 0), second = texelFetch(gaussians, at + ivec2(1, 0), 0);
  place = ((first.xy - center.xy) - center.zw) * scale + 0.5 * canvas;
  sharpness = vec3(first.zw, second.x) / scale;
  color = second.yzw;
  // A pixel that covers several of the image shows their average, as in gaussian/covariance.py.
  vec3 squares = box * sharpness * sharpness;
  float rows = 1.0 + squares.z;
  float amplitude = inversesqrt(rows * (1.0 + squares.x) + squares.y), narrower = inversesqrt(rows);
  sharpness *= vec3(sqrt(rows) * amplitude, narrower * amplitude, narrower);
  color *= amplitude;
}

// Draw a square in the units of standard deviations as two triangles. An instance for each Gaussian
// would be a call of its own where a processor draws, which takes three times as long.
vec4 around(float reach) {
  int corner = gl_VertexID % 6;
  vec2 side = vec2(corner == 1 || corner == 2 || corner == 4 ? 1.0 : -1.0, corner > 1 && corner != 3 ? 1.0 : -1.0);
  float y = reach * side.y / sharpness.z;
  vec2 at = place + vec2((reach * side.x - sharpness.y * y) / sharpness.x, y);
  // A square far larger than the canvas would lose digits: cover the canvas, or draw nothing.
  vec2 deviation = vec2(length(vec2(1.0, sharpness.y / sharpness.z)) / sharpness.x, 1.0 / sharpness.z);
  vec2 far = reach * deviation;
  if (max(far.x, far.y) > 4.0 * (canvas.x + canvas.y)) {
    bool away = any(lessThan(place + far, vec2(0.0))) || any(greaterThan(place - far, canvas));
    at = away ? vec2(-1.0) : (0.5 + 0.5 * side) * canvas;
  }
  return vec4(2.0 * at / canvas - 1.0, 0.0, 1.0);
}
`;

const SUM_VERTEX = PLACEMENT + `
void main() {
  load(gl_VertexID / 6);
  gl_Position = around(1.001 * cutoff);
}`;

const SUM_FRAGMENT = `#version 300 es
precision highp float;
uniform float cutoff;
flat in vec2 place;
flat in vec3 sharpness, color;
out vec4 result;
void main() {
  vec2 d = gl_FragCoord.xy - place;
  vec2 p = vec2(dot(sharpness.xy, d), sharpness.z * d.y);
  float q = dot(p, p);
  if (q > cutoff * cutoff) discard;
  result = vec4(color * exp(-0.5 * q), 0.0);
}`;

const FULL_VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(4.0 * float(gl_VertexID & 1) - 1.0, 2.0 * float(gl_VertexID & 2) - 1.0, 0.0, 1.0);
}`;

const PICTURE_FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D sums, photo;
uniform vec4 frame, center;
uniform vec3 background;
uniform vec2 canvas, imageSize;
uniform float scale, wipe, share, exposure;
uniform int light;  // 0: codes as they are, 1: linear light, 2: logarithms of light, 3: normals
out vec4 result;

vec3 toCoded(vec3 x) {
  return mix(12.92 * x, 1.055 * pow(max(x, 0.0031308), vec3(1.0 / 2.4)) - 0.055, greaterThan(x, vec3(0.0031308)));
}

void main() {
  vec2 at = vec2(gl_FragCoord.x, canvas.y - gl_FragCoord.y);
  vec2 inside = (at - frame.xy) / frame.zw;
  if (any(lessThan(inside, vec2(0.0))) || any(greaterThanEqual(inside, vec2(1.0)))) discard;
  if (at.x >= wipe) {
    vec2 x = (center.xy + (center.zw + (at - 0.5 * canvas) / scale)) / imageSize;
    result = vec4(texture(photo, x).rgb, 1.0);
    return;
  }
  vec3 sum = background + texelFetch(sums, ivec2(at * share), 0).rgb;
  if (light == 2) sum = (exp(sum * 4.6151205) - 1.0) * 0.01;  // log(101)
  if (light == 1 || light == 2) sum = toCoded(max(sum, 0.0) * exposure);
  if (light == 3) {  // as image/normals.py
    vec3 normal = 2.0 * sum - 1.0;
    sum = 0.5 + 0.5 * normal * inversesqrt(max(dot(normal, normal), 1e-6));
  }
  result = vec4(clamp(sum, 0.0, 1.0), 1.0);
}`;

const OUTLINE_VERTEX = PLACEMENT + `
uniform float thickness;
void main() {
  load(gl_VertexID / 6);
  // The ring reaches half a line and a pixel beyond one standard deviation along every axis.
  gl_Position = around(min(1.0 + (0.5 * thickness + 1.0) * length(sharpness), 1e6));
  gl_Position.y = -gl_Position.y;
}`;

const OUTLINE_FRAGMENT = `#version 300 es
precision highp float;
uniform vec2 canvas;
uniform float thickness, wipe;
flat in vec2 place;
flat in vec3 sharpness, color;
out vec4 result;
void main() {
  vec2 d = vec2(gl_FragCoord.x, canvas.y - gl_FragCoord.y) - place;
  vec2 p = vec2(dot(sharpness.xy, d), sharpness.z * d.y);
  float r = length(p);
  float slope = length(vec2(sharpness.x * p.x, sharpness.y * p.x + sharpness.z * p.y)) / max(r, 1e-9);
  float off = abs(r - 1.0) / max(slope, 1e-9);
  float alpha = 0.85 * clamp(0.5 * thickness + 0.5 - off, 0.0, 1.0);
  if (alpha <= 0.0 || gl_FragCoord.x >= wipe) discard;
  result = vec4(color * alpha, alpha);
}`;
