#version 300 es
// alpha of one Gaussian at one pixel, premultiplied.
precision highp float;
uniform vec2 alphaRange;
in vec4 ink;
in vec2 offset;
out vec4 pixel;
void main() {
  float alpha = min(alphaRange.y, ink.a * exp(-0.5 * dot(offset, offset)));
  if (alpha < alphaRange.x) discard;
  pixel = vec4(ink.rgb * alpha, alpha);
}
