// What blending a tile's list of Gaussians and its gradient begin and end with, in order (composite.cu) or without one
// (over_base.cu): the pixels of a thread, the entries that a block brings into shared memory, alpha, and sums over a warp.
//
// Layout: a block is a tile of 16 x 16 pixels, four warps of 8 x 8 pixels, two pixels a thread (same column, four rows
// apart: they share dx). The block brings 128 entries at a time into shared memory, one a thread, which also tests its
// Gaussian against the four 8 x 8 squares; each warp then walks only the entries that reach its own square. Of the
// gradient, ten moments per (square, Gaussian) are summed over the warp in 12 shuffles (each halving also halves the
// values a lane carries) and added by one atomic instruction of ten lanes to 40 neighbouring bytes, and only where the
// square sees the Gaussian and it is not frozen.
#pragma once
#include "splat.cuh"

constexpr int SQUARE = 8;
constexpr int THREADS = 128;
constexpr float LOG2_E = 1.4426950408889634f;

struct alignas(16) Entry {
    float u, v, a, b;      // exponent of two: log2(alpha) = l + a dx^2 + b dx dy + c dy^2
    float c, l, red, green;
    float blue, z;
    int row;
    unsigned flags;        // bit w: reaches square w; TRAINED: its gradient is wanted
};

constexpr unsigned TRAINED = 1u << 4;

// What is to be composited: the list of each tile, and the pixels that are to be drawn (null: all).
struct Work {
    const float4* splats;
    const int *ids, *offset;
    const unsigned char* pixels;
    int width, height, tiles_x;
};

struct Square {
    int x, y[2], warp, lane;
    bool inside[2];
    float light[2];        // transmittance; 0 once the pixel has stopped, and where nothing is to be drawn
};

__device__ __forceinline__ Square square_of(const Work& work) {
    Square s;
    const int tile = blockIdx.x;
    s.warp = threadIdx.x / 32, s.lane = threadIdx.x % 32;
    s.x = tile % work.tiles_x * TILE + s.warp % 2 * SQUARE + s.lane % SQUARE;
    s.y[0] = tile / work.tiles_x * TILE + s.warp / 2 * SQUARE + s.lane / SQUARE;
    s.y[1] = s.y[0] + SQUARE / 2;
#pragma unroll
    for (int i = 0; i < 2; i++) {
        s.inside[i] = s.x < work.width && s.y[i] < work.height;
        const long long at = (long long)s.y[i] * work.width + s.x;
        s.light[i] = s.inside[i] && (!work.pixels || work.pixels[at]) ? 1.0f : 0.0f;
    }
    return s;
}

// Entry number k of the tile's list as the block keeps it; flags 0 beyond the end. trained: rows, or null for all.
__device__ __forceinline__ void fetch(Entry* entry, const Work& work, int k, int end, const unsigned char* trained) {
    entry->flags = 0;
    if (k >= end) return;
    const int row = work.ids[k];
    const Splat s = load_splat(work.splats, row);
    const Valley valley = valley_of(s);
    const float left = (float)((int)blockIdx.x % work.tiles_x * TILE) + 0.5f;
    const float top = (float)((int)blockIdx.x / work.tiles_x * TILE) + 0.5f;
    unsigned flags = !trained || trained[row] ? TRAINED : 0u;
#pragma unroll
    for (int w = 0; w < 4; w++) {
        const float x = left + (float)(w % 2 * SQUARE), y = top + (float)(w / 2 * SQUARE);
        if (meets_box(s, valley, x, y, x + (float)(SQUARE - 1), y + (float)(SQUARE - 1))) flags |= 1u << w;
    }
    const float half = -0.5f * LOG2_E;
    *entry = {s.u, s.v, half * s.A, -LOG2_E * s.B, half * s.C, LOG2_E * s.ln_o, s.r, s.g, s.b, s.z, row, flags};
}

// One instruction each on a GPU, good to 22 bits; for arguments whose results are no denormal numbers.
__device__ __forceinline__ float quick_exp2(float x) {
#ifdef __CUDA_ARCH__
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return exp2f(x);
#endif
}

__device__ __forceinline__ float quick_reciprocal(float x) {
#ifdef __CUDA_ARCH__
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return 1.0f / x;
#endif
}

// alpha of both pixels, 0 below the cut; returns whether either has any.
__device__ __forceinline__ bool alphas(const Entry& e, float dx, const float* dy, float* alpha) {
    const float along = fmaf(e.a * dx, dx, e.l), across = e.b * dx;
#pragma unroll
    for (int i = 0; i < 2; i++) {
        const float value = fminf(quick_exp2(fmaf(dy[i], fmaf(e.c, dy[i], across), along)), GS_ALPHA_MAX);
        alpha[i] = value > GS_ALPHA_MIN ? value : 0.0f;
    }
    return alpha[0] + alpha[1] > 0.0f;
}

__device__ __forceinline__ float exchange(float keep, float send, int distance) {
    return keep + __shfl_xor_sync(FULL, send, distance);
}

// Sums of ten values over the warp: 12 shuffles instead of 50. Value number ``*which`` ends in this lane, or none (-1).
__device__ __forceinline__ float warp_sums(const float* v, int lane, int* which) {
    const bool b4 = lane & 16, b3 = lane & 8, b2 = lane & 4, b1 = lane & 2;
    float five[5];
#pragma unroll
    for (int i = 0; i < 5; i++) five[i] = exchange(b4 ? v[i + 5] : v[i], b4 ? v[i] : v[i + 5], 16);
    const float p0 = exchange(b3 ? five[3] : five[0], b3 ? five[0] : five[3], 8);
    const float p1 = exchange(b3 ? five[4] : five[1], b3 ? five[1] : five[4], 8);
    float p2 = exchange(five[2], five[2], 8);
    float one = exchange(b2 ? p1 : p0, b2 ? p0 : p1, 4);
    p2 = exchange(p2, p2, 4);
    one = exchange(b1 ? p2 : one, b1 ? one : p2, 2);
    one = exchange(one, one, 1);
    const int local = b1 ? 2 : 3 * b3 + b2;
    const bool mine = !(lane & 1) && (!b1 || (!b3 && !b2));
    *which = mine ? 5 * b4 + local : -1;
    return one;
}

// Adds to two neighbouring floats the sums over the warp of |dL/du| and |dL/dv|, with g = alpha dL/dalpha (v).
__device__ __forceinline__ void add_absolute(
    const Entry& e, float dx, const float* dy, const float* v, int lane, float* to) {
    const float A_dx = -2.0f / LOG2_E * e.a * dx, B = -1.0f / LOG2_E * e.b, C = -2.0f / LOG2_E * e.c;
    float own[2] = {};
#pragma unroll
    for (int i = 0; i < 2; i++) {
        own[0] += fabsf(v[i] * fmaf(B, dy[i], A_dx));
        own[1] += fabsf(v[i] * fmaf(C, dy[i], B * dx));
    }
    float sum = exchange(lane & 16 ? own[1] : own[0], lane & 16 ? own[0] : own[1], 16);
#pragma unroll
    for (int distance = 8; distance; distance /= 2) sum = exchange(sum, sum, distance);
    if (lane % 16 == 0) atomicAdd(to + lane / 16, sum);
}
