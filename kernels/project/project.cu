// Projection and colour of every Gaussian, and their gradient, each in one pass over the rows.
//
// Layout: one thread a row, 128 a block; every intermediate stays in registers. Quaternions, splats and, for degrees 1
// and 3, the coefficients are read 16 bytes at a time. What limits it is memory: 56 + 12 K bytes in and 52 out forward.
// Coefficients are read only of rows that are drawn. Activations (exp, sigmoid) are part of the pass, and so is the
// chain rule from the sums of composite.cu to the conic. Formulas: gsfusion_nb/render/project.py.
#include "harmonics.cuh"
#include "splat.cuh"

struct ProjectionLens {
    float fx, fy, cx, cy, limit_x, limit_y, near_m, far_m;
};

struct Params {
    const float *xyz_W, *log_scale;
    const float4* quat;
    const float *opacity_logit, *sh, *pose;  // pose: T_WC, 4 x 4 row by row
};

// A row's values on the way to the screen; the gradient makes them again.
struct Steps {
    float X, Y, Z;            // from the camera's centre, world frame
    float x, y, z, inv_z, x_z, y_z, tx, ty;
    float R[9], R_q[9];       // R_WC; of the Gaussian
    float q[4], norm, s[3];
    float B[9];               // R_CW R_q S
    float a, b, mu[3], mv[3];
};

__device__ __forceinline__ void camera_axes(const Params& p, int i, Steps& t) {
    const float* T = p.pose;
#pragma unroll
    for (int k = 0; k < 9; k++) t.R[k] = T[4 * (k / 3) + k % 3];
    t.X = p.xyz_W[3 * i] - T[3], t.Y = p.xyz_W[3 * i + 1] - T[7], t.Z = p.xyz_W[3 * i + 2] - T[11];
    t.x = t.R[0] * t.X + t.R[3] * t.Y + t.R[6] * t.Z;
    t.y = t.R[1] * t.X + t.R[4] * t.Y + t.R[7] * t.Z;
    t.z = t.R[2] * t.X + t.R[5] * t.Y + t.R[8] * t.Z;
}

// The rest of the steps, of a row in front of the near plane.
__device__ __forceinline__ void ellipse(const Params& p, const ProjectionLens& c, int i, Steps& t) {
    t.inv_z = 1.0f / t.z;
    t.x_z = t.x * t.inv_z, t.y_z = t.y * t.inv_z;
    t.tx = fminf(fmaxf(t.x_z, -c.limit_x), c.limit_x);
    t.ty = fminf(fmaxf(t.y_z, -c.limit_y), c.limit_y);
    const float4 raw = p.quat[i];
    t.norm = fmaxf(sqrtf(raw.x * raw.x + raw.y * raw.y + raw.z * raw.z + raw.w * raw.w), 1e-12f);
    const float w = raw.x / t.norm, x = raw.y / t.norm, y = raw.z / t.norm, z = raw.w / t.norm;
    t.q[0] = w, t.q[1] = x, t.q[2] = y, t.q[3] = z;
    t.R_q[0] = 1.0f - 2.0f * (y * y + z * z), t.R_q[1] = 2.0f * (x * y - w * z), t.R_q[2] = 2.0f * (x * z + w * y);
    t.R_q[3] = 2.0f * (x * y + w * z), t.R_q[4] = 1.0f - 2.0f * (x * x + z * z), t.R_q[5] = 2.0f * (y * z - w * x);
    t.R_q[6] = 2.0f * (x * z - w * y), t.R_q[7] = 2.0f * (y * z + w * x), t.R_q[8] = 1.0f - 2.0f * (x * x + y * y);
    t.a = c.fx * t.inv_z, t.b = c.fy * t.inv_z;
#pragma unroll
    for (int k = 0; k < 3; k++) {
        t.s[k] = expf(p.log_scale[3 * i + k]);
#pragma unroll
        for (int row = 0; row < 3; row++) {
            const float turned = t.R[row] * t.R_q[k] + t.R[3 + row] * t.R_q[3 + k] + t.R[6 + row] * t.R_q[6 + k];
            t.B[3 * row + k] = turned * t.s[k];
        }
        t.mu[k] = t.a * (t.B[k] - t.tx * t.B[6 + k]);
        t.mv[k] = t.b * (t.B[3 + k] - t.ty * t.B[6 + k]);
    }
}

__device__ __forceinline__ float dot3(const float* a, const float* b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

__device__ __forceinline__ float3 direction(const Steps& t, float* distance) {
    *distance = fmaxf(sqrtf(t.X * t.X + t.Y * t.Y + t.Z * t.Z), 1e-12f);
    return make_float3(t.X / *distance, t.Y / *distance, t.Z / *distance);
}

template <int K>
__device__ __forceinline__ void project(Params p, ProjectionLens c, float4* splats, float* depth, int N, int width, int height) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= N) return;
    Steps t;
    camera_axes(p, i, t);
    const float opacity = 1.0f / (1.0f + expf(-p.opacity_logit[i]));
    depth[i] = __int_as_float(0x7f800000);  // infinite: not drawn
    if (!(t.z > c.near_m && t.z <= c.far_m && opacity >= GS_ALPHA_MIN)) return;
    ellipse(p, c, i, t);
    const float uu = dot3(t.mu, t.mu), vv = dot3(t.mv, t.mv), uv = dot3(t.mu, t.mv);
    // det(M M^T + e I) = |m_u x m_v|^2 + e (uu + vv) + e^2: no difference of large numbers
    const float c0 = t.mu[1] * t.mv[2] - t.mu[2] * t.mv[1], c1 = t.mu[2] * t.mv[0] - t.mu[0] * t.mv[2];
    const float c2 = t.mu[0] * t.mv[1] - t.mu[1] * t.mv[0], blur = GS_SCREEN_BLUR_PX2;
    const float inv_det = 1.0f / (c0 * c0 + c1 * c1 + c2 * c2 + blur * (uu + vv) + blur * blur);
    Splat s;
    s.ln_o = logf(opacity);
    const float reach = 2.0f * fmaxf(reach_of(s.ln_o), 0.0f);
    s.u = c.fx * t.x_z + c.cx, s.v = c.fy * t.y_z + c.cy;
    s.e_u = sqrtf(reach * (uu + blur)), s.e_v = sqrtf(reach * (vv + blur));
    const float far = GS_FARTHEST_PX, infinite = __int_as_float(0x7f800000);
    if (!(fabsf(s.u) < far && fabsf(s.v) < far && s.e_u < far && s.e_v < far)) return;  // also a NaN
    const bool across = s.u + s.e_u > 0.0f && s.u - s.e_u < (float)width;
    if (!(across && s.v + s.e_v > 0.0f && s.v - s.e_v < (float)height)) return;
    s.A = (vv + blur) * inv_det, s.B = -uv * inv_det, s.C = (uu + blur) * inv_det;
    float distance, Y[K], h[3 * K], colour[3] = {0.5f, 0.5f, 0.5f};
    const float3 d = direction(t, &distance);
    harmonics<K>(d.x, d.y, d.z, Y);
    load_coefficients<K>(p.sh, i, h);
#pragma unroll
    for (int k = 0; k < 3 * K; k++) colour[k % 3] += Y[k / 3] * h[k];
    if (!(fabsf(colour[0]) < infinite && fabsf(colour[1]) < infinite && fabsf(colour[2]) < infinite)) return;
    depth[i] = t.z;
    splats[SPLAT_VECTORS * (long long)i] = make_float4(s.u, s.v, s.A, s.B);
    splats[SPLAT_VECTORS * (long long)i + 1] = make_float4(s.C, s.ln_o, fmaxf(colour[0], 0.0f), fmaxf(colour[1], 0.0f));
    splats[SPLAT_VECTORS * (long long)i + 2] = make_float4(fmaxf(colour[2], 0.0f), t.z, s.e_u, s.e_v);
}

struct Gradients {
    float *xyz_W, *log_scale;
    float4* quat;
    float *opacity_logit, *sh;
};

template <int K>
__device__ __forceinline__ void no_gradient(const Gradients& o, int i) {
#pragma unroll
    for (int k = 0; k < 3; k++) o.xyz_W[3 * i + k] = o.log_scale[3 * i + k] = 0.0f;
    o.quat[i] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    o.opacity_logit[i] = 0.0f;
    const float none[3 * K] = {};
    store_coefficients<K>(o.sh, i, none);
}

// dL/dq of R(q / |q|) from dL/dR: of the unit quaternion, then v_q = (v - q (q . v)) / |q|.
__device__ __forceinline__ float4 rotation_vjp(const float* q, float norm, const float* m) {
    const float w = q[0], x = q[1], y = q[2], z = q[3];
    const float e0 = 2.0f * (x * (m[7] - m[5]) + y * (m[2] - m[6]) + z * (m[3] - m[1]));
    const float e1 = 2.0f * (y * (m[1] + m[3]) + z * (m[2] + m[6]) + w * (m[7] - m[5]) - 2.0f * x * (m[4] + m[8]));
    const float e2 = 2.0f * (x * (m[1] + m[3]) + z * (m[5] + m[7]) + w * (m[2] - m[6]) - 2.0f * y * (m[0] + m[8]));
    const float e3 = 2.0f * (x * (m[2] + m[6]) + y * (m[5] + m[7]) + w * (m[3] - m[1]) - 2.0f * z * (m[0] + m[4]));
    const float along = w * e0 + x * e1 + y * e2 + z * e3;
    return make_float4(
        (e0 - w * along) / norm, (e1 - x * along) / norm, (e2 - y * along) / norm, (e3 - z * along) / norm);
}

// n_j = Q m_j of the columns of M, Q = (M M^T + blur I)^-1:  (sum_k (m_k x m_j) (-m_kv, m_ku) + blur m_j) / det, whose
// large term k = j is zero. A mu + B mv, with the conic, would lose it to rounding.
__device__ __forceinline__ void solved(const Steps& t, float* n_u, float* n_v) {
    const float c[3] = {
        t.mu[1] * t.mv[2] - t.mu[2] * t.mv[1], t.mu[2] * t.mv[0] - t.mu[0] * t.mv[2],
        t.mu[0] * t.mv[1] - t.mu[1] * t.mv[0]};
    const float blur = GS_SCREEN_BLUR_PX2, trace = dot3(t.mu, t.mu) + dot3(t.mv, t.mv);
    const float inv_det = 1.0f / (dot3(c, c) + blur * trace + blur * blur);
#pragma unroll
    for (int k = 0; k < 3; k++) {
        const int next = (k + 1) % 3, last = (k + 2) % 3;
        n_u[k] = (c[last] * t.mv[next] - c[next] * t.mv[last] + blur * t.mu[k]) * inv_det;
        n_v[k] = (c[next] * t.mu[last] - c[last] * t.mu[next] + blur * t.mv[k]) * inv_det;
    }
}

// sums: of every row, see splat.cuh.
// trained: rows to be differentiated, or null for all. A row that is not drawn (infinite depth) has no gradient.
template <int K>
__device__ __forceinline__ void project_vjp(
    Params p, ProjectionLens c, const float4* splats, const float* depth, const float4* sums, const unsigned char* trained,
    Gradients o, int N) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= N) return;
    if (!(depth[i] < __int_as_float(0x7f800000)) || (trained && !trained[i])) {
        no_gradient<K>(o, i);
        return;
    }
    Steps t;
    camera_axes(p, i, t);
    ellipse(p, c, i, t);
    const Splat s = load_splat(splats, i);
    float sum[SPLAT_FLOATS];
    load_row(sums, i, sum);
    const float v_u = s.A * sum[SUM_GX] + s.B * sum[SUM_GY], v_v = s.B * sum[SUM_GX] + s.C * sum[SUM_GY];
    // v_m = 2 v_cov m = -2 Q (v_Q n) with n = Q m, and the gradient of the log scale is m . v_m = -2 n . (v_Q n): for a
    // needle m . (v_cov m) is a difference of numbers as large as 1 / blur^2. Of Q, v_Q = -sums / 2.
    float n_u[3], n_v[3];
    solved(t, n_u, n_v);
    float w[9], v_log_scale[3], along = 0.0f, v_tx = 0.0f, v_ty = 0.0f;  // w: dL/dB
#pragma unroll
    for (int k = 0; k < 3; k++) {
        const float q_u = sum[SUM_GXX] * n_u[k] + sum[SUM_GXY] * n_v[k];
        const float q_v = sum[SUM_GXY] * n_u[k] + sum[SUM_GYY] * n_v[k];
        v_log_scale[k] = n_u[k] * q_u + n_v[k] * q_v;
        w[k] = t.a * (s.A * q_u + s.B * q_v), w[3 + k] = t.b * (s.B * q_u + s.C * q_v);
        w[6 + k] = -(t.tx * w[k] + t.ty * w[3 + k]);
        v_tx -= t.B[6 + k] * w[k], v_ty -= t.B[6 + k] * w[3 + k];
        along += v_log_scale[k];
    }
    const float v_xz = c.fx * v_u + (t.tx == t.x_z ? v_tx : 0.0f), v_yz = c.fy * v_v + (t.ty == t.y_z ? v_ty : 0.0f);
    const float v_x = v_xz * t.inv_z, v_y = v_yz * t.inv_z;
    const float v_z = sum[SUM_DEPTH] - t.inv_z * (t.x_z * v_xz + t.y_z * v_yz + along);
    float m[9];  // dL/dR_q = R_WC dL/dB S
#pragma unroll
    for (int k = 0; k < 3; k++) {
        o.log_scale[3 * i + k] = v_log_scale[k];
#pragma unroll
        for (int row = 0; row < 3; row++)
            m[3 * row + k] = t.s[k] * (t.R[3 * row] * w[k] + t.R[3 * row + 1] * w[3 + k] + t.R[3 * row + 2] * w[6 + k]);
    }
    o.quat[i] = rotation_vjp(t.q, t.norm, m);
    o.opacity_logit[i] = sum[SUM_G] * (1.0f / (1.0f + expf(p.opacity_logit[i])));  // d ln o = (1 - o) d logit

    // a colour that is clamped has no gradient
    const float v[3] = {
        s.r > 0.0f ? sum[SUM_RED] : 0.0f, s.g > 0.0f ? sum[SUM_GREEN] : 0.0f, s.b > 0.0f ? sum[SUM_BLUE] : 0.0f};
    float distance, Y[K], h[3 * K], weight[K];
    const float3 d = direction(t, &distance);
    harmonics<K>(d.x, d.y, d.z, Y);
    float3 g = make_float3(0.0f, 0.0f, 0.0f);
    if constexpr (K > 1) {
        load_coefficients<K>(p.sh, i, h);
#pragma unroll
        for (int k = 0; k < K; k++) weight[k] = dot3(h + 3 * k, v);
        g = harmonics_gradient<K>(d.x, d.y, d.z, weight);
    }
    float v_h[3 * K];
#pragma unroll
    for (int k = 0; k < 3 * K; k++) v_h[k] = Y[k / 3] * v[k % 3];
    store_coefficients<K>(o.sh, i, v_h);
    const float radial = d.x * g.x + d.y * g.y + d.z * g.z;
    const float e[3] = {g.x - d.x * radial, g.y - d.y * radial, g.z - d.z * radial};
#pragma unroll
    for (int k = 0; k < 3; k++)
        o.xyz_W[3 * i + k] = t.R[3 * k] * v_x + t.R[3 * k + 1] * v_y + t.R[3 * k + 2] * v_z + e[k] / distance;
}

extern "C" __global__ void __launch_bounds__(128) project_1(
    Params p, ProjectionLens c, float4* splats, float* depth, int N, int width, int height) {
    project<1>(p, c, splats, depth, N, width, height);
}

extern "C" __global__ void __launch_bounds__(128) project_4(
    Params p, ProjectionLens c, float4* splats, float* depth, int N, int width, int height) {
    project<4>(p, c, splats, depth, N, width, height);
}

extern "C" __global__ void __launch_bounds__(128) project_9(
    Params p, ProjectionLens c, float4* splats, float* depth, int N, int width, int height) {
    project<9>(p, c, splats, depth, N, width, height);
}

extern "C" __global__ void __launch_bounds__(128) project_16(
    Params p, ProjectionLens c, float4* splats, float* depth, int N, int width, int height) {
    project<16>(p, c, splats, depth, N, width, height);
}

extern "C" __global__ void __launch_bounds__(128) project_vjp_1(
    Params p, ProjectionLens c, const float4* splats, const float* depth, const float4* sums,
    const unsigned char* trained, Gradients o, int N) {
    project_vjp<1>(p, c, splats, depth, sums, trained, o, N);
}

extern "C" __global__ void __launch_bounds__(128) project_vjp_4(
    Params p, ProjectionLens c, const float4* splats, const float* depth, const float4* sums,
    const unsigned char* trained, Gradients o, int N) {
    project_vjp<4>(p, c, splats, depth, sums, trained, o, N);
}

extern "C" __global__ void __launch_bounds__(128) project_vjp_9(
    Params p, ProjectionLens c, const float4* splats, const float* depth, const float4* sums,
    const unsigned char* trained, Gradients o, int N) {
    project_vjp<9>(p, c, splats, depth, sums, trained, o, N);
}

extern "C" __global__ void __launch_bounds__(128) project_vjp_16(
    Params p, ProjectionLens c, const float4* splats, const float* depth, const float4* sums,
    const unsigned char* trained, Gradients o, int N) {
    project_vjp<16>(p, c, splats, depth, sums, trained, o, N);
}
