// Values of the voxels that contain points: as they are, and as they will be once a frame is fused.
//
// Layout: one point a thread. What limits it: a few thousand points are one wave of threads, so the chain of reads of
// one point: its block's node and row from the table (of a block that is not allocated yet, a binary search among the
// sorted codes of the new ones), the voxel, and for the preview the depth and colour of its pixel.
#include "lookup.cuh"
#include "morton.cuh"
#include "voxel.cuh"

constexpr float FARTHEST = 16777216.0f;  // voxel numbers from here on are not whole in float32, and no block is there
constexpr int NEW = -2;                  // row of a block that is not allocated, but will be

struct Points {
    const float* xyz;
    int count;
};

// Sorted Morton codes of the blocks that will be allocated.
struct NewBlocks {
    const long long* codes;
    int count;
};

struct Sample {
    float *D, *W, *rgb, *W_rgb;
};

struct Voxel {
    float D, W, rgb[3], W_rgb;
};

__device__ __forceinline__ bool will_be(const NewBlocks& fresh, const int* block) {
    unsigned long long wanted = 0;
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const int shifted = block[a] + OFFSET;
        if (shifted < 0 || shifted >= 2 * OFFSET) return false;
        wanted |= spread(shifted) << a;
    }
    int first = 0, last = fresh.count;
    while (first < last) {
        const int middle = (first + last) / 2;
        if ((unsigned long long)fresh.codes[middle] < wanted)
            first = middle + 1;
        else
            last = middle;
    }
    return first < fresh.count && (unsigned long long)fresh.codes[first] == wanted;
}

// The voxel that contains point i; false if no block can be there.
__device__ __forceinline__ bool voxel_of(const Points& points, int i, float size, int* voxel) {
    bool near = true;
#pragma unroll
    for (int a = 0; a < 3; a++) {
        const float x = points.xyz[3ll * i + a] / size;
        near = near && fabsf(x) < FARTHEST;
        voxel[a] = near ? (int)floorf(x) : 0;
    }
    return near;
}

// What a voxel holds; 1, 0 and black where its block is not allocated.
__device__ __forceinline__ Voxel read(const Pool& pool, int row, const int* voxel) {
    if (row < 0) return {1.0f, 0.0f, {0.0f, 0.0f, 0.0f}, 0.0f};
    const int number = number_of(voxel);
    const long long at = (long long)row * VOXELS + number;
    const float* plane = pool.planes + (long long)row * (3 * VOXELS) + number;
    return {pool.D[at], pool.W[at], {plane[0], plane[VOXELS], plane[2 * VOXELS]}, pool.W_rgb[at]};
}

__device__ __forceinline__ void write(const Sample& out, int i, const Voxel& v) {
    out.D[i] = v.D, out.W[i] = v.W, out.W_rgb[i] = v.W_rgb;
#pragma unroll
    for (int channel = 0; channel < 3; channel++) out.rgb[3ll * i + channel] = v.rgb[channel];
}

// Adds what the frame observes of a voxel that is allocated, or will be.
__device__ __forceinline__ void fuse(
    const View& view, const Frame& frame, const Band& band, const int* voxel, const int* block, Voxel& v) {
    const Grid g = make_grid(view);
    double p[3];
    corner_of(g, block[0], block[1], block[2], p);
    if (!in_view(g, view, p, band.far)) return;
    const float3 corner = homogeneous(g, p), offset = offset_of(g, voxel[0] & 7, voxel[1] & 7, voxel[2] & 7);
    const float U = corner.x + offset.x, V = corner.y + offset.y, Z = corner.z + offset.z;
    long long pixel;
    const float sdf = distance(view, frame, lens_of(g), band, U, V, Z, &pixel);
    if (!(sdf > -band.truncation)) return;
    float step = observe(band, sdf, v.D, v.W);
    if (weighs_colours(band))
        step = observe_colour(band, sdf, Z, v.W_rgb);
    else
        v.W_rgb = v.W;
#pragma unroll
    for (int channel = 0; channel < 3; channel++)
        v.rgb[channel] += step * (frame.rgb[3 * pixel + channel] - v.rgb[channel]);
}

extern "C" __global__ void __launch_bounds__(128) sample_voxels(
    Points points, Table table, Pool pool, float size, Sample out) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= points.count) return;
    int voxel[3];
    const bool near = voxel_of(points, i, size, voxel);
    const int block[3] = {voxel[0] >> 3, voxel[1] >> 3, voxel[2] >> 3};
    write(out, i, read(pool, near ? row_of(table, block) : NONE, voxel));
}

extern "C" __global__ void __launch_bounds__(128) sample_fused_voxels(
    Points points, Table table, Pool pool, NewBlocks fresh, View view, Frame frame, Band band, Sample out) {
    const int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= points.count) return;
    int voxel[3], row = NONE;
    const bool near = voxel_of(points, i, (float)view.voxel, voxel);
    const int block[3] = {voxel[0] >> 3, voxel[1] >> 3, voxel[2] >> 3};
    if (near) row = row_of(table, block);
    if (near && row < 0 && will_be(fresh, block)) row = NEW;
    Voxel v = read(pool, row, voxel);
    if (row != NONE) fuse(view, frame, band, voxel, block, v);
    write(out, i, v);
}
