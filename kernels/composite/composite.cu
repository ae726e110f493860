// Front-to-back blending of each tile's list, and its gradient. Formulas: gsfusion_nb/render/composite.py.
//
// Layout: see square.cuh. A warp that is dark does nothing more but bring entries, and the block ends when all are dark.
// The gradient walks the list in the same order and makes alpha and T again with the same roundings; what lies behind a
// Gaussian is the pixel's total, known from the picture, less what has been passed.
// What limits it: instruction issue. Machine code for sm_90 has 53 instructions per square and entry forward, 27 where
// no pixel is reached, and 140 backward, 41 where none is; 64 pixels each.
#include "square.cuh"

// Weight of a pixel, whose light is dimmed.
__device__ __forceinline__ float blend(float alpha, float* light) {
    const float behind = *light * (1.0f - alpha), weight = alpha * *light;
    const bool on = behind >= GS_TRANSMITTANCE_MIN;
    *light = on ? behind : 0.0f;
    return on ? weight : 0.0f;
}

struct Images {
    float *rgb, *depth, *alpha;
    long long *first, *dominant, *hit;
};

template <bool INDICES, bool HITS>
__device__ __forceinline__ void composite_forward(const Work& work, const Images& image, float opaque_alpha) {
    __shared__ Entry entries[THREADS];
    Square s = square_of(work);
    const float x = (float)s.x + 0.5f, y[2] = {(float)s.y[0] + 0.5f, (float)s.y[1] + 0.5f};
    float red[2] = {}, green[2] = {}, blue[2] = {}, z[2] = {}, opacity[2] = {}, heaviest[2] = {};
    int first[2] = {-1, -1}, dominant[2] = {-1, -1}, hit[2] = {-1, -1};
    bool looking[2] = {HITS && s.light[0] > 0.0f, HITS && s.light[1] > 0.0f};
    const int end = work.offset[blockIdx.x + 1];
    for (int start = work.offset[blockIdx.x]; start < end; start += THREADS) {
        bool dark = s.light[0] + s.light[1] == 0.0f && !looking[0] && !looking[1];
        if (__syncthreads_count(dark) == THREADS) break;
        fetch(&entries[threadIdx.x], work, start + threadIdx.x, end, nullptr);
        __syncthreads();
        for (int group = 0; group < THREADS; group += 32) {
            dark = s.light[0] + s.light[1] == 0.0f && !looking[0] && !looking[1];
            if (__all_sync(FULL, dark)) break;
            unsigned reached = __ballot_sync(FULL, entries[group + s.lane].flags >> s.warp & 1);
            while (reached) {
                const Entry& e = entries[group + __ffs(reached) - 1];
                reached &= reached - 1;
                const float dx = x - e.u, dy[2] = {y[0] - e.v, y[1] - e.v};
                float alpha[2];
                if (!alphas(e, dx, dy, alpha)) continue;
#pragma unroll
                for (int i = 0; i < 2; i++) {
                    if (HITS && looking[i] && alpha[i] >= opaque_alpha) hit[i] = e.row, looking[i] = false;
                    const float w = blend(alpha[i], &s.light[i]);
                    red[i] = fmaf(w, e.red, red[i]), green[i] = fmaf(w, e.green, green[i]);
                    blue[i] = fmaf(w, e.blue, blue[i]), z[i] = fmaf(w, e.z, z[i]);
                    opacity[i] += w;
                    if (INDICES && w > 0.0f && first[i] < 0) first[i] = e.row;
                    if (INDICES && w > heaviest[i]) dominant[i] = e.row, heaviest[i] = w;
                }
            }
        }
    }
#pragma unroll
    for (int i = 0; i < 2; i++) {
        if (!s.inside[i]) continue;
        const long long at = (long long)s.y[i] * work.width + s.x;
        image.rgb[3 * at] = red[i], image.rgb[3 * at + 1] = green[i], image.rgb[3 * at + 2] = blue[i];
        image.depth[at] = z[i], image.alpha[at] = opacity[i];
        if (INDICES) image.first[at] = first[i], image.dominant[at] = dominant[i];
        if (HITS) image.hit[at] = hit[i];
    }
}

// Named after what they write besides the image: indices, hits.
extern "C" __global__ void __launch_bounds__(128) composite_00(Work work, Images image, float opaque_alpha) {
    composite_forward<false, false>(work, image, opaque_alpha);
}

extern "C" __global__ void __launch_bounds__(128) composite_01(Work work, Images image, float opaque_alpha) {
    composite_forward<false, true>(work, image, opaque_alpha);
}

extern "C" __global__ void __launch_bounds__(128, 7) composite_10(Work work, Images image, float opaque_alpha) {
    composite_forward<true, false>(work, image, opaque_alpha);
}

extern "C" __global__ void __launch_bounds__(128) composite_11(Work work, Images image, float opaque_alpha) {
    composite_forward<true, true>(work, image, opaque_alpha);
}

// What the gradient needs of a pixel: dL/d of its channels, and S, the total of (c . v) that has not been passed.
struct Pixel {
    float v_r, v_g, v_b, v_z, v_o, S;
};

struct Seen {
    const float *rgb, *depth, *alpha, *v_rgb, *v_depth, *v_alpha;  // v_depth, v_alpha: null is zero
};

__device__ __forceinline__ Pixel pixel_of(const Seen& image, long long at, bool lit) {
    Pixel p = {};
    if (!lit) return p;
    p.v_r = image.v_rgb[3 * at], p.v_g = image.v_rgb[3 * at + 1], p.v_b = image.v_rgb[3 * at + 2];
    p.S = p.v_r * image.rgb[3 * at] + p.v_g * image.rgb[3 * at + 1] + p.v_b * image.rgb[3 * at + 2];
    if (image.v_depth) p.v_z = image.v_depth[at], p.S += p.v_z * image.depth[at];
    if (image.v_alpha) p.v_o = image.v_alpha[at], p.S += p.v_o * image.alpha[at];
    return p;
}

// sums [N, SPLAT_FLOATS], to which the sums of every Gaussian are added (splat.cuh); of the rows in trained, null: all.
// abs_sums [N, 2], likewise, if ABSOLUTE: sums over the pixels of |dL/du| and |dL/dv|.
template <bool ABSOLUTE>
__device__ __forceinline__ void backward(
    const Work& work, const Seen& image, const unsigned char* trained, float* sums, float* abs_sums) {
    __shared__ Entry entries[THREADS];
    Square s = square_of(work);
    const float x = (float)s.x + 0.5f, y[2] = {(float)s.y[0] + 0.5f, (float)s.y[1] + 0.5f};
    Pixel pixel[2];
#pragma unroll
    for (int i = 0; i < 2; i++) pixel[i] = pixel_of(image, (long long)s.y[i] * work.width + s.x, s.light[i] > 0.0f);
    const int end = work.offset[blockIdx.x + 1];
    for (int start = work.offset[blockIdx.x]; start < end; start += THREADS) {
        if (__syncthreads_count(s.light[0] + s.light[1] == 0.0f) == THREADS) break;
        fetch(&entries[threadIdx.x], work, start + threadIdx.x, end, trained);
        __syncthreads();
        for (int group = 0; group < THREADS; group += 32) {
            if (__all_sync(FULL, s.light[0] + s.light[1] == 0.0f)) break;
            unsigned reached = __ballot_sync(FULL, entries[group + s.lane].flags >> s.warp & 1);
            while (reached) {
                const Entry& e = entries[group + __ffs(reached) - 1];
                reached &= reached - 1;
                const float dx = x - e.u, dy[2] = {y[0] - e.v, y[1] - e.v};
                float alpha[2], w[2], v[2];
                alphas(e, dx, dy, alpha);
#pragma unroll
                for (int i = 0; i < 2; i++) w[i] = blend(alpha[i], &s.light[i]);
                if (!__any_sync(FULL, w[0] + w[1] > 0.0f)) continue;
#pragma unroll
                for (int i = 0; i < 2; i++) {
                    Pixel& p = pixel[i];
                    const float rest = fmaf(e.blue, p.v_b, fmaf(e.z, p.v_z, p.v_o));
                    const float w_cv = w[i] * fmaf(e.red, p.v_r, fmaf(e.green, p.v_g, rest));
                    p.S -= w_cv;
                    const float passed = fmaf(-p.S, alpha[i] * quick_reciprocal(1.0f - alpha[i]), w_cv);
                    v[i] = w[i] > 0.0f && alpha[i] < GS_ALPHA_MAX ? passed : 0.0f;
                }
                if (!(e.flags & TRAINED)) continue;
                const float both = v[0] + v[1], lever = fmaf(v[0], dy[0], v[1] * dy[1]);
                float own[SUMS];
                own[SUM_GX] = both * dx, own[SUM_GY] = lever;
                own[SUM_GXX] = both * dx * dx, own[SUM_GXY] = lever * dx;
                own[SUM_GYY] = fmaf(v[0] * dy[0], dy[0], v[1] * dy[1] * dy[1]), own[SUM_G] = both;
                own[SUM_RED] = fmaf(w[0], pixel[0].v_r, w[1] * pixel[1].v_r);
                own[SUM_GREEN] = fmaf(w[0], pixel[0].v_g, w[1] * pixel[1].v_g);
                own[SUM_BLUE] = fmaf(w[0], pixel[0].v_b, w[1] * pixel[1].v_b);
                own[SUM_DEPTH] = fmaf(w[0], pixel[0].v_z, w[1] * pixel[1].v_z);
                int which;
                const float sum = warp_sums(own, s.lane, &which);
                if (which >= 0) atomicAdd(sums + SPLAT_FLOATS * (long long)e.row + which, sum);
                if (ABSOLUTE) add_absolute(e, dx, dy, v, s.lane, abs_sums + 2 * (long long)e.row);
            }
        }
    }
}

extern "C" __global__ void __launch_bounds__(128) composite_backward(
    Work work, Seen image, const unsigned char* trained, float* sums) {
    backward<false>(work, image, trained, sums, nullptr);
}

extern "C" __global__ void __launch_bounds__(128) composite_backward_abs(
    Work work, Seen image, const unsigned char* trained, float* sums, float* abs_sums) {
    backward<true>(work, image, trained, sums, abs_sums);
}
