// What a camera sees of the volume: steps and tests are those of gsfusion_nb/tsdf/raycast.py.
//
// Layout: one ray a thread, a warp takes 8 x 4 pixels, which walk through the same blocks. Where a ray starts and ends is
// told per tile of 16 x 16 pixels by one pass over the blocks, a warp each. What limits it: the latency of the walk, 20 to
// 60 dependent reads a ray, most of them from caches.
#include "lookup.cuh"

constexpr int TILE = 16, WIDE = 16, HIGH = 8;  // a block of threads takes WIDE x HIGH pixels
constexpr float NEAR = 0.01f;

struct Lens {
    const float* T_WC;
    float fx, fy, cx, cy;
    int width, height;
};

// Metres; step: the share of the stored distance that a ray advances; close: where D is interpolated, metres;
// refinements: number of interpolations after the first, linear one.
struct Sizes {
    float voxel, block, truncation, step, close;
    int refinements;
};

// Nearest and farthest depth of any block in each tile, as the bits of floats above 0, which sort as the floats do.
struct Spans {
    int *first, *last;
    int tiles_x, tiles_y;
};

struct Images {
    float *depth, *normal, *rgb;
};

// coords: of each of the n blocks.
extern "C" __global__ void __launch_bounds__(128) block_spans(
    const int* coords, int n, Lens lens, Sizes sizes, Spans spans) {
    const int b = (blockIdx.x * blockDim.x + threadIdx.x) / 32, lane = threadIdx.x % 32;
    if (b >= n) return;
    const float* T = lens.T_WC;
    const double side = sizes.block;
    const float infinite = __int_as_float(0x7f800000);
    float low[3] = {infinite, infinite, infinite}, high[3] = {-infinite, -infinite, -infinite};  // of u, v (tiles), z
    for (int c = 0; c < 8; c++) {
        const float x = (float)((coords[3 * b] + (c & 1)) * side - T[3]);
        const float y = (float)((coords[3 * b + 1] + (c >> 1 & 1)) * side - T[7]);
        const float z = (float)((coords[3 * b + 2] + (c >> 2)) * side - T[11]);
        const float X = T[0] * x + T[4] * y + T[8] * z, Y = T[1] * x + T[5] * y + T[9] * z;
        const float Z = T[2] * x + T[6] * y + T[10] * z, safe = fmaxf(Z, NEAR);
        const float value[3] = {(lens.fx * X / safe + lens.cx) / TILE, (lens.fy * Y / safe + lens.cy) / TILE, Z};
#pragma unroll
        for (int a = 0; a < 3; a++) low[a] = fminf(low[a], value[a]), high[a] = fmaxf(high[a], value[a]);
    }
    if (!(high[2] > 0.0f)) return;
    const int tiles[2] = {spans.tiles_x, spans.tiles_y};
    int from[2], size[2];
#pragma unroll
    for (int a = 0; a < 2; a++) {
        const bool behind = low[2] <= NEAR;  // it is taken to cover the whole picture
        const float top = (float)tiles[a];
        const float start = behind ? 0.0f : fminf(fmaxf(low[a], 0.0f), top), end = behind ? top : fminf(high[a], top);
        from[a] = (int)floorf(start);
        size[a] = max(min((int)floorf(fmaxf(end, -1.0f)), tiles[a] - 1) - from[a] + 1, 0);
    }
    const int nearest = __float_as_int(fmaxf(low[2], 0.0f)), farthest = __float_as_int(high[2]);
    for (int k = lane; k < size[0] * size[1]; k += 32) {
        const int tile = (from[1] + k / size[0]) * spans.tiles_x + from[0] + k % size[0];
        atomicMin(&spans.first[tile], nearest);
        atomicMax(&spans.last[tile], farthest);
    }
}

// Place of a voxel in the pool, -1 if its block is not allocated.
__device__ __forceinline__ long long place_of(const Table& table, const int* voxel) {
    const int block[3] = {voxel[0] >> 3, voxel[1] >> 3, voxel[2] >> 3};
    const int row = row_of(table, block);
    return row < 0 ? -1 : (long long)row * VOXELS + number_of(voxel);
}

// The eight voxels whose centres surround a point: corner x + 2 y + 4 z.
struct Corners {
    float D[8], f[3];
    long long at[8];
};

// False if one of them has not been observed.
__device__ __forceinline__ bool corners_of(const Table& table, const Pool& pool, const float* p, float size, Corners& c) {
    int lowest[3];
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const float q = p[a] / size - 0.5f, whole = floorf(q);
        lowest[a] = (int)whole, c.f[a] = q - whole;
    }
#pragma unroll
    for (int k = 0; k < 8; k++) {
        const int voxel[3] = {lowest[0] + (k & 1), lowest[1] + (k >> 1 & 1), lowest[2] + (k >> 2)};
        c.at[k] = place_of(table, voxel);
        if (c.at[k] < 0 || !(pool.W[c.at[k]] > 0.0f)) return false;
        c.D[k] = pool.D[c.at[k]];
    }
    return true;
}

__device__ __forceinline__ float mix(float a, float b, float c, float d, float s, float t) {
    const float low = a + (b - a) * s, high = c + (d - c) * s;
    return low + (high - low) * t;
}

__device__ __forceinline__ float mix8(const float* v, const float* f) {
    const float a = mix(v[0], v[1], v[2], v[3], f[0], f[1]), b = mix(v[4], v[5], v[6], v[7], f[0], f[1]);
    return a + (b - a) * f[2];
}

// Depth to add so that a point leaves its block, plus a hundredth of a voxel to be surely outside.
__device__ __forceinline__ float to_exit(const float* p, const float* d, const Sizes& sizes) {
    float least = __int_as_float(0x7f800000);
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const float q = p[a] / sizes.block, done = q - floorf(q);
        least = fminf(least, (d[a] > 0.0f ? 1.0f - done : done) * sizes.block / fmaxf(fabsf(d[a]), 1e-9f));
    }
    return least + 0.01f * sizes.voxel;
}

// Depths before and behind the surface, and D there.
struct Bracket {
    float z0, z1, D0, D1;
};

__device__ __forceinline__ void point_at(const float* origin, const float* d, float z, float* p) {
#pragma unroll
    for (int a = 0; a < 3; a++) p[a] = origin[a] + d[a] * z;
}

// Where a ray first changes from the free side of a surface to its inside; false where it does not.
__device__ __forceinline__ bool march(
    const Table& table, const Pool& pool, const Sizes& sizes, const float* origin, const float* d, float z, float z_end,
    Bracket& found) {
    const float per_m = 1.0f / sqrtf(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]);
    bool was_free = false, was_inside = false;
    float z_before = z, D_before = 1.0f;
    Corners c;
    while (z < z_end) {
        float p[3];
        point_at(origin, d, z, p);
        const int voxel[3] = {
            (int)floorf(p[0] / sizes.voxel), (int)floorf(p[1] / sizes.voxel), (int)floorf(p[2] / sizes.voxel)};
        const long long at = place_of(table, voxel);
        const bool observed = at >= 0 && pool.W[at] > 0.0f;
        float D = observed ? pool.D[at] : 0.0f;
        if (observed && fabsf(D) * sizes.truncation < sizes.close && corners_of(table, pool, p, sizes.voxel, c))
            D = mix8(c.D, c.f);
        const bool is_free = observed && D >= 0.0f, is_inside = observed && D < 0.0f;
        if (is_inside && was_free) {
            found = {z_before, z, D_before, D};
            return true;
        }
        if (is_free && was_inside) return false;
        const float known = observed ? fmaxf(sizes.step * sizes.truncation * fabsf(D), sizes.voxel) : sizes.voxel;
        z_before = z, D_before = D, was_free = is_free, was_inside = is_inside;
        z += at < 0 ? to_exit(p, d, sizes) : known * per_m;
    }
    return false;
}

// Depth of the zero of the interpolated D inside the bracket.
__device__ __forceinline__ float refine(
    const Table& table, const Pool& pool, const Sizes& sizes, const float* origin, const float* d, Bracket b) {
    float z = b.z0 + (b.z1 - b.z0) * (b.D0 / (b.D0 - b.D1));
    Corners c;
    for (int k = 0; k < sizes.refinements; k++) {
        float p[3];
        point_at(origin, d, z, p);
        if (corners_of(table, pool, p, sizes.voxel, c)) {
            const float D = mix8(c.D, c.f);
            if (D >= 0.0f)
                b.z0 = z, b.D0 = D;
            else
                b.z1 = z, b.D1 = D;
        }
        z = b.z0 + (b.z1 - b.z0) * (b.D0 / (b.D0 - b.D1));
    }
    return z;
}

// The pictures are zero where no ray meets a surface that is observed on all sides.
extern "C" __global__ void __launch_bounds__(128) raycast(
    Table table, Pool pool, Lens lens, Sizes sizes, Spans spans, Images out) {
    const int warp = threadIdx.x / 32, lane = threadIdx.x % 32, across = (lens.width + WIDE - 1) / WIDE;
    const int i = (int)blockIdx.x % across * WIDE + warp % 2 * 8 + lane % 8;
    const int j = (int)blockIdx.x / across * HIGH + warp / 2 * 4 + lane / 8;
    if (i >= lens.width || j >= lens.height) return;
    const float* T = lens.T_WC;
    const float x = ((float)i + (0.5f - lens.cx)) / lens.fx, y = ((float)j + (0.5f - lens.cy)) / lens.fy;
    const float origin[3] = {T[3], T[7], T[11]};
    const float d[3] = {
        T[0] * x + T[1] * y + T[2], T[4] * x + T[5] * y + T[6], T[8] * x + T[9] * y + T[10]};
    const int tile = j / TILE * spans.tiles_x + i / TILE;
    const float first = __int_as_float(spans.first[tile]), last = __int_as_float(spans.last[tile]);
    float z = 0.0f, normal[3] = {}, rgb[3] = {};
    Bracket bracket;
    Corners c;
    if (march(table, pool, sizes, origin, d, first, last, bracket)) {
        const float depth = refine(table, pool, sizes, origin, d, bracket);
        float p[3];
        point_at(origin, d, depth, p);
        if (corners_of(table, pool, p, sizes.voxel, c)) {
            const float *v = c.D, *f = c.f;
            z = depth;
            normal[0] = mix(v[1] - v[0], v[3] - v[2], v[5] - v[4], v[7] - v[6], f[1], f[2]);
            normal[1] = mix(v[2] - v[0], v[3] - v[1], v[6] - v[4], v[7] - v[5], f[0], f[2]);
            normal[2] = mix(v[4] - v[0], v[5] - v[1], v[6] - v[2], v[7] - v[3], f[0], f[1]);
            const float length = fmaxf(
                sqrtf(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]), 1e-12f);
#pragma unroll
            for (int a = 0; a < 3; a++) {
                float colour[8];
#pragma unroll
                for (int k = 0; k < 8; k++)
                    colour[k] = pool.planes[c.at[k] / VOXELS * (3 * VOXELS) + a * VOXELS + c.at[k] % VOXELS];
                normal[a] /= length, rgb[a] = mix8(colour, f);
            }
        }
    }
    const long long at = (long long)j * lens.width + i;
    out.depth[at] = z;
#pragma unroll
    for (int a = 0; a < 3; a++) out.normal[3 * at + a] = normal[a], out.rgb[3 * at + a] = rgb[a];
}
