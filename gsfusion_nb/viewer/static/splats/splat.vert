#version 300 es
// The projection of projection.js for one corner of one Gaussian's quad.
precision highp float;
precision highp sampler2D;
uniform sampler2D rowData;
uniform mat3 R;          // R_CW
uniform vec3 t;
uniform vec4 lens;       // fx fy cx cy
uniform vec2 size;
uniform vec4 look;       // size, opacity, points, clamp
uniform vec3 rules;      // near_m, blur_px2, alpha_min
layout(location = 0) in vec2 corner;
layout(location = 1) in uint row;
layout(location = 2) in vec4 colour;
out vec4 ink;
out vec2 offset;         // in standard deviations times reach
void main() {
  int line = int(row >> 10u), column = 3 * int(row & 1023u);
  vec4 a = texelFetch(rowData, ivec2(column, line), 0);
  vec4 b = texelFetch(rowData, ivec2(column + 1, line), 0);
  vec4 c = texelFetch(rowData, ivec2(column + 2, line), 0);
  vec3 p = R * a.xyz + t;
  float o = look.z > 0.5 ? min(1.0, a.w * 255.0) * 0.99 : min(1.0, a.w * look.y);
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  if (p.z <= rules.x || o < rules.z) return;
  mat2 cov = mat2(1.0) * look.x * look.x;
  if (look.z < 0.5) {
    vec2 limit = look.w * 0.5 * size / lens.xy;
    vec2 s = clamp(p.xy / p.z, -limit, limit);
    vec2 f = lens.xy / p.z;
    vec3 m0 = f.x * vec3(R[0][0] - s.x * R[0][2], R[1][0] - s.x * R[1][2], R[2][0] - s.x * R[2][2]);
    vec3 m1 = f.y * vec3(R[0][1] - s.y * R[0][2], R[1][1] - s.y * R[1][2], R[2][1] - s.y * R[2][2]);
    mat3 S = mat3(b.x, b.y, b.z, b.y, b.w, c.x, b.z, c.x, c.y);
    float uv = dot(m0, S * m1);
    cov = look.x * look.x * mat2(dot(m0, S * m0), uv, uv, dot(m1, S * m1)) + mat2(rules.y, 0.0, 0.0, rules.y);
  }
  // Half axes of the ellipse: eigenvectors of the 2D covariance.
  float mid = 0.5 * (cov[0][0] + cov[1][1]), d = 0.5 * (cov[0][0] - cov[1][1]);
  float spread = length(vec2(d, cov[0][1]));
  float big = mid + spread, small = max(mid - spread, 1e-6);
  vec2 axis = d >= 0.0 ? vec2(spread + d, cov[0][1]) : vec2(cov[0][1], spread - d);
  axis = spread < 1e-9 ? vec2(1.0, 0.0) : normalize(axis);
  float reach = sqrt(2.0 * log(o / rules.z));
  offset = corner * reach;
  vec2 at = lens.xy * p.xy / p.z + lens.zw
    + offset.x * sqrt(big) * axis + offset.y * sqrt(small) * vec2(-axis.y, axis.x);
  gl_Position = vec4(2.0 * at.x / size.x - 1.0, 1.0 - 2.0 * at.y / size.y, 0.0, 1.0);
  ink = vec4(colour.rgb, o);
}
