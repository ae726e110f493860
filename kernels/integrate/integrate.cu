// Fold a frame into the voxel blocks: list the blocks in view, then update the voxels of each.
//
// Layout: 128 threads a voxel block, four neighbours along z a thread, so that distance, weight and the three planes of
// colour move 16 bytes at a time. Blocks of threads stay and take one voxel block after another from the list, whose
// length the host never asks for; a thread's four voxels have the same offsets in every block and keep them in
// registers. What limits it: memory, 16 bytes a voxel that is observed, 8 for the weight of its colour and 24 for colour
// where that counts; blocks that are hidden or free of depth are projected, and cost the reading of depth alone.
// Rounding is the reference's.
#include "voxel.cuh"

constexpr int VOXELS = 512;

// The counts of a frame: blocks in view, and voxels that were observed.
enum { IN_VIEW, OBSERVED };

__device__ __forceinline__ void corner_of_row(const Grid& g, const int* coords, int row, double* out) {
    corner_of(g, coords[3 * row], coords[3 * row + 1], coords[3 * row + 2], out);
}

// rows: the blocks whose bounding sphere meets the view up to the far plane, in any order.
extern "C" __global__ void __launch_bounds__(128) visible_blocks(
    View view, const int* coords, int n_blocks, float far, int* rows, int* count) {
    const int block = blockIdx.x * blockDim.x + threadIdx.x;
    bool seen = false;
    if (block < n_blocks) {
        const Grid g = make_grid(view);
        double corner[3];
        corner_of_row(g, coords, block, corner);
        seen = in_view(g, view, corner, far);
    }
    const unsigned found = __ballot_sync(0xffffffffu, seen);
    const int lane = threadIdx.x % 32;
    int first = 0;
    if (found && lane == 0) first = atomicAdd(count + IN_VIEW, __popc(found));
    first = __shfl_sync(0xffffffffu, first, 0);
    if (seen) rows[first + __popc(found & ((1u << lane) - 1))] = block;
}

struct Voxels {
    float4 *D, *W, *planes, *W_rgb;
};

extern "C" __global__ void __launch_bounds__(128) fuse_blocks(
    View view, const int* coords, Frame frame, Band band, Voxels voxels, const int* rows, int* count) {
    const Grid g = make_grid(view);
    const Lens lens = lens_of(g);
    const int n = 4 * threadIdx.x;
    float3 offset[4];
#pragma unroll
    for (int k = 0; k < 4; k++) offset[k] = offset_of(g, n >> 6, n >> 3 & 7, (n & 7) + k);
    int updated = 0;
    for (int i = blockIdx.x; i < count[IN_VIEW]; i += gridDim.x) {
        const int block = rows[i];
        double p[3];
        corner_of_row(g, coords, block, p);
        const float3 corner = homogeneous(g, p);
        float sdf[4], z[4];
        long long pixel[4];
        bool observed[4], any = false;
#pragma unroll
        for (int k = 0; k < 4; k++) {
            const float U = corner.x + offset[k].x, V = corner.y + offset[k].y, Z = corner.z + offset[k].z;
            z[k] = Z;
            sdf[k] = distance(view, frame, lens, band, U, V, Z, &pixel[k]);
            observed[k] = sdf[k] > -band.truncation;
            any = any || observed[k];
            updated += observed[k];
        }
        if (!any) continue;
        const long long at = (long long)block * (VOXELS / 4) + threadIdx.x;
        float4 d4 = voxels.D[at], w4 = voxels.W[at];
        float *d = &d4.x, *w = &w4.x, step[4];
#pragma unroll
        for (int k = 0; k < 4; k++) step[k] = observed[k] ? observe(band, sdf[k], d[k], w[k]) : 0.0f;
        voxels.D[at] = d4, voxels.W[at] = w4;
        if (weighs_colours(band)) {
            float4 weights = voxels.W_rgb[at];
            float* weight = &weights.x;
            any = false;
#pragma unroll
            for (int k = 0; k < 4; k++) {
                step[k] = observed[k] ? observe_colour(band, sdf[k], z[k], weight[k]) : 0.0f;
                observed[k] = step[k] > 0.0f;
                any = any || observed[k];
            }
            if (!any) continue;
            voxels.W_rgb[at] = weights;
        }
#pragma unroll
        for (int channel = 0; channel < 3; channel++) {
            const long long place = ((long long)block * 3 + channel) * (VOXELS / 4) + threadIdx.x;
            float4 c4 = voxels.planes[place];
            float* c = &c4.x;
#pragma unroll
            for (int k = 0; k < 4; k++)
                if (observed[k]) c[k] += step[k] * (frame.rgb[3 * pixel[k] + channel] - c[k]);
            voxels.planes[place] = c4;
        }
    }
#pragma unroll
    for (int step = 16; step > 0; step /= 2) updated += __shfl_xor_sync(0xffffffffu, updated, step);
    if (threadIdx.x % 32 == 0 && updated) atomicAdd(count + OBSERVED, updated);
}
