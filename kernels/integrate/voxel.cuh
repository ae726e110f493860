// What a frame makes of a voxel: where its block is, whether the frame observes it, and its new values (Eq. 6 to 9).
// The fusion and its preview round alike because both use these functions. Corners of blocks are in float64, offsets
// from them in float32. Formulas: gsfusion_nb/tsdf/integrate.py.
#pragma once

constexpr float EPS_M = 1e-4f;
constexpr float MISSING = -1e9f;
constexpr float LEAST_COLOUR_WEIGHT = 1e-3f, LITTLE_COLOUR = 0.0495f, NEAREST_COLOUR_M = 0.1f;  // as in the reference

struct Lens {
    float fx, fy, cx, cy;
};

// Where the camera is, its lens and the edge of a voxel, and the size of the images.
struct View {
    const float* T_WC;
    double fx, fy, cx, cy, voxel;
    int width, height;
};

// The largest depth of a block in view; the smallest depth that is used, half the width of the band around it, the
// largest weight; one over half the width of the band in which colours count, 0 for none; ray: whether distances are
// along the ray; by_distance, falling: whether the weights of colours fall with the distance, and within the band.
struct Band {
    float far, near, truncation, inv_truncation, max_weight, inv_colour_band;
    int ray, by_distance, falling;
};

struct Frame {
    const float *depth, *rgb;
};

// The camera, its principal point moved by one pixel so that the reference's border of missing pixels is at 0; the edge
// of a voxel; T_CW, three rows of four.
struct Grid {
    double fx, fy, cx, cy, voxel, T[12];
};

__device__ __forceinline__ Grid make_grid(const View& view) {
    const float* T_WC = view.T_WC;
    Grid g = {view.fx, view.fy, view.cx + 1.0, view.cy + 1.0, view.voxel, {}};
#pragma unroll
    for (int k = 0; k < 3; k++) {
#pragma unroll
        for (int j = 0; j < 3; j++) g.T[4 * k + j] = T_WC[4 * j + k];
        g.T[4 * k + 3] = -(g.T[4 * k] * T_WC[3] + g.T[4 * k + 1] * T_WC[7] + g.T[4 * k + 2] * T_WC[11]);
    }
    return g;
}

__device__ __forceinline__ Lens lens_of(const Grid& g) {
    return {(float)g.fx, (float)g.fy, (float)g.cx, (float)g.cy};
}

__device__ __forceinline__ void turn(const double* T, double x, double y, double z, double* out) {
#pragma unroll
    for (int k = 0; k < 3; k++) out[k] = T[4 * k] * x + T[4 * k + 1] * y + T[4 * k + 2] * z;
}

// Lowest corner of block (x, y, z), camera frame.
__device__ __forceinline__ void corner_of(const Grid& g, int x, int y, int z, double* out) {
    const double side = 8.0 * g.voxel;
    turn(g.T, x * side, y * side, z * side, out);
#pragma unroll
    for (int k = 0; k < 3; k++) out[k] += g.T[4 * k + 3];
}

// Homogeneous pixel coordinates (U, V, Z) of a camera-frame point: pixel = (U / Z, V / Z).
__device__ __forceinline__ float3 homogeneous(const Grid& g, const double* p) {
    return make_float3((float)(g.fx * p[0] + g.cx * p[2]), (float)(g.fy * p[1] + g.cy * p[2]), (float)p[2]);
}

// The same of the centre of voxel (x, y, z) of a block, relative to the block's corner.
__device__ __forceinline__ float3 offset_of(const Grid& g, int x, int y, int z) {
    double p[3];
    turn(g.T, (x + 0.5) * g.voxel, (y + 0.5) * g.voxel, (z + 0.5) * g.voxel, p);
    return homogeneous(g, p);
}

// Whether a sphere reaches between two side planes of the view, f x = low z and f x = high z.
__device__ __forceinline__ bool between(float x, float z, float f, float low, float high, float radius) {
    return f * x - low * z > -radius * sqrtf(f * f + low * low) &&
           high * z - f * x > -radius * sqrtf(f * f + high * high);
}

// Whether the bounding sphere of the block with this corner meets the view up to the far plane.
__device__ __forceinline__ bool in_view(const Grid& g, const View& view, const double* corner, float far) {
    const double h = 4.0 * g.voxel;
    double half[3];
    turn(g.T, h, h, h, half);
    const float x = (float)(corner[0] + half[0]), y = (float)(corner[1] + half[1]), z = (float)(corner[2] + half[2]);
    const float radius = 1.7320508f * (float)h, left = (float)-view.cx, top = (float)-view.cy;
    const float half_z = (float)(h * (fabs(g.T[8]) + fabs(g.T[9]) + fabs(g.T[10])));
    return z > -half_z && z < far + half_z &&
           between(x, z, (float)view.fx, left, (float)view.width + left, radius) &&
           between(y, z, (float)view.fy, top, (float)view.height + top, radius);
}

// Signed distance of a voxel, MISSING or below where there is none, and the pixel that it projects to.
__device__ __forceinline__ float distance(
    const View& view, const Frame& f, const Lens& c, const Band& band, float U, float V, float Z, long long* pixel) {
    *pixel = 0;
    if (!(Z >= EPS_M)) return MISSING;
    const float inv_z = 1.0f / Z, u = U * inv_z, v = V * inv_z;
    if (!(u >= 1.0f && v >= 1.0f && u < (float)(view.width + 1) && v < (float)(view.height + 1))) return MISSING;
    *pixel = (long long)((int)v - 1) * view.width + ((int)u - 1);
    const float d = f.depth[*pixel];
    if (!(d > 0.0f && d >= band.near && d < __int_as_float(0x7f800000))) return MISSING;
    const float sdf = d - Z;
    if (!band.ray) return sdf;
    const float x = (u - c.cx) / c.fx, y = (v - c.cy) / c.fy;
    return sdf * sqrtf(x * x + y * y + 1.0f);
}

// Whether colours have weights of their own, other than the observation count.
__device__ __forceinline__ bool weighs_colours(const Band& band) { return band.by_distance || band.inv_colour_band > 0.0f; }

// Adds an observation at depth z to the weight of a voxel's colour; the part of the way that it goes to the new one.
__device__ __forceinline__ float observe_colour(const Band& band, float sdf, float z, float& weight) {
    float w = 1.0f;
    if (band.by_distance) w = 1.0f / fmaxf(z * z, NEAREST_COLOUR_M * NEAREST_COLOUR_M);
    const float inside = 1.0f - fabsf(sdf) * band.inv_colour_band;
    w *= band.falling ? fmaxf(inside, 0.0f) : (inside >= 0.0f ? 1.0f : 0.0f);
    if (weight < LITTLE_COLOUR) w = fmaxf(w, LEAST_COLOUR_WEIGHT);
    weight = fminf(weight + w, band.max_weight);
    return fminf(w / fmaxf(weight, LEAST_COLOUR_WEIGHT), 1.0f);
}

// Adds an observation to the distance and the weight of a voxel; the part of the way that the distance goes, and its
// colour, unless colours have weights.
__device__ __forceinline__ float observe(const Band& band, float sdf, float& d, float& w) {
    const float next = fminf(w + 1.0f, band.max_weight);
    const float value = fminf(fmaxf(sdf * band.inv_truncation, -1.0f), 1.0f);
    const float step = 1.0f / next;
    d += step * (value - d);
    w = next;
    return step;
}
