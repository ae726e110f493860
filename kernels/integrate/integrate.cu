// Fold a frame into the voxel blocks: list the blocks in view, then update the voxels of each.
//
// Layout: 128 threads a voxel block, four neighbours along z a thread, so that distance, weight and the three planes of
// colour move 16 bytes at a time. Blocks of threads stay and take one voxel block after another from the list, whose
// length the host never asks for; a thread's four voxels have the same offsets in every block and keep them in
// registers. What limits it: memory, 40 bytes a voxel that is observed; blocks that are hidden or free of depth are
// projected, and cost the reading of depth alone. Rounding is the reference's: corners in float64, offsets in float32.
// Formulas: gsfusion_nb/tsdf/integrate.py.
constexpr int VOXELS = 512;
constexpr float EPS_M = 1e-4f;
constexpr float MISSING = -1e9f;

struct Lens {
    float fx, fy, cx, cy;
};

// The blocks, where the camera is, its lens and the edge of a voxel, and the size of the images.
struct View {
    const int* coords;
    const float* T_WC;
    double fx, fy, cx, cy, voxel;
    int width, height;
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

__device__ __forceinline__ void turn(const double* T, double x, double y, double z, double* out) {
#pragma unroll
    for (int k = 0; k < 3; k++) out[k] = T[4 * k] * x + T[4 * k + 1] * y + T[4 * k + 2] * z;
}

__device__ __forceinline__ void corner_of(const Grid& g, const int* coords, int block, double* out) {
    const double side = 8.0 * g.voxel;
    turn(g.T, coords[3 * block] * side, coords[3 * block + 1] * side, coords[3 * block + 2] * side, out);
#pragma unroll
    for (int k = 0; k < 3; k++) out[k] += g.T[4 * k + 3];
}

// Homogeneous pixel coordinates (U, V, Z) of a camera-frame point: pixel = (U / Z, V / Z).
__device__ __forceinline__ float3 homogeneous(const Grid& g, const double* p) {
    return make_float3((float)(g.fx * p[0] + g.cx * p[2]), (float)(g.fy * p[1] + g.cy * p[2]), (float)p[2]);
}

// Whether a sphere reaches between two side planes of the view, f x = low z and f x = high z.
__device__ __forceinline__ bool between(float x, float z, float f, float low, float high, float radius) {
    return f * x - low * z > -radius * sqrtf(f * f + low * low) &&
           high * z - f * x > -radius * sqrtf(f * f + high * high);
}

// The counts of a frame: blocks in view, and voxels that were observed.
enum { IN_VIEW, OBSERVED };

// rows: the blocks whose bounding sphere meets the view up to the far plane, in any order.
extern "C" __global__ void __launch_bounds__(128) visible_blocks(
    View view, int n_blocks, float far, int* rows, int* count) {
    const int block = blockIdx.x * blockDim.x + threadIdx.x;
    bool seen = false;
    if (block < n_blocks) {
        const Grid g = make_grid(view);
        double p[3], half[3];
        corner_of(g, view.coords, block, p);
        const double h = 4.0 * g.voxel;
        turn(g.T, h, h, h, half);
        const float x = (float)(p[0] + half[0]), y = (float)(p[1] + half[1]), z = (float)(p[2] + half[2]);
        const float radius = 1.7320508f * (float)h, left = (float)-view.cx, top = (float)-view.cy;
        const float half_z = (float)(h * (fabs(g.T[8]) + fabs(g.T[9]) + fabs(g.T[10])));
        seen = z > -half_z && z < far + half_z &&
               between(x, z, (float)view.fx, left, (float)view.width + left, radius) &&
               between(y, z, (float)view.fy, top, (float)view.height + top, radius);
    }
    const unsigned found = __ballot_sync(0xffffffffu, seen);
    const int lane = threadIdx.x % 32;
    int first = 0;
    if (found && lane == 0) first = atomicAdd(count + IN_VIEW, __popc(found));
    first = __shfl_sync(0xffffffffu, first, 0);
    if (seen) rows[first + __popc(found & ((1u << lane) - 1))] = block;
}

struct Band {
    float near, truncation, inv_truncation, max_weight;
    int ray;
};

struct Frame {
    const float *depth, *rgb;
};

struct Voxels {
    float4 *D, *W, *planes;
};

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

extern "C" __global__ void __launch_bounds__(128) fuse_blocks(
    View view, Frame frame, Band band, Voxels voxels, const int* rows, int* count) {
    const Grid g = make_grid(view);
    const Lens lens = {(float)g.fx, (float)g.fy, (float)g.cx, (float)g.cy};
    const int n = 4 * threadIdx.x;
    float3 offset[4];
#pragma unroll
    for (int k = 0; k < 4; k++) {
        double p[3];
        turn(g.T, ((n >> 6) + 0.5) * g.voxel, ((n >> 3 & 7) + 0.5) * g.voxel, ((n & 7) + k + 0.5) * g.voxel, p);
        offset[k] = homogeneous(g, p);
    }
    int updated = 0;
    for (int i = blockIdx.x; i < count[IN_VIEW]; i += gridDim.x) {
        const int block = rows[i];
        double p[3];
        corner_of(g, view.coords, block, p);
        const float3 corner = homogeneous(g, p);
        float sdf[4];
        long long pixel[4];
        bool observed[4], any = false;
#pragma unroll
        for (int k = 0; k < 4; k++) {
            const float U = corner.x + offset[k].x, V = corner.y + offset[k].y, Z = corner.z + offset[k].z;
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
        for (int k = 0; k < 4; k++) {
            step[k] = 0.0f;
            if (!observed[k]) continue;
            const float next = fminf(w[k] + 1.0f, band.max_weight);
            const float value = fminf(fmaxf(sdf[k] * band.inv_truncation, -1.0f), 1.0f);
            step[k] = 1.0f / next;
            d[k] += step[k] * (value - d[k]);
            w[k] = next;
        }
        voxels.D[at] = d4, voxels.W[at] = w4;
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
