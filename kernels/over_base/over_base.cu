// Gaussians over a base, summed in no order, and the gradient. Formulas: gsfusion_nb/render/over_base.py.
//
// Layout: see square.cuh. No pixel is finished early, and nothing is carried from one Gaussian to the next: forward, a
// pixel keeps five sums; backward, what it gives to every Gaussian are four numbers, q and -q . C. The lists need no
// order of depth; atomics add the moments up, so they repeat to rounding. What limits it: not measured on a GPU.
#include "square.cuh"

// The base: colour, depth (0: no surface) and weight; how far behind the surface a Gaussian is drawn, metres.
struct Surface {
    const float *rgb, *depth, *weight;
    float behind;
};

struct Blended {
    float *rgb, *depth, *weight;
};

// A picture and dL/d of its colour.
struct Seen {
    const float *rgb, *weight, *v_rgb;
};

__device__ __forceinline__ float reciprocal(float x) { return x > 0.0f ? 1.0f / x : 0.0f; }

// The largest depth of a Gaussian that is drawn in a pixel; of a pixel outside the image none is.
__device__ __forceinline__ float limit_of(const Surface& base, long long at, bool inside) {
    const float infinite = __int_as_float(0x7f800000);
    if (!inside) return -infinite;
    return base.depth[at] > 0.0f ? base.depth[at] + base.behind : infinite;
}

extern "C" __global__ void __launch_bounds__(128) over_base_forward(Work work, Surface base, Blended image) {
    __shared__ Entry entries[THREADS];
    const Square s = square_of(work);
    const float x = (float)s.x + 0.5f, y[2] = {(float)s.y[0] + 0.5f, (float)s.y[1] + 0.5f};
    float limit[2], red[2] = {}, green[2] = {}, blue[2] = {}, z[2] = {}, sum[2] = {};
#pragma unroll
    for (int i = 0; i < 2; i++) limit[i] = limit_of(base, (long long)s.y[i] * work.width + s.x, s.inside[i]);
    const int end = work.offset[blockIdx.x + 1];
    for (int start = work.offset[blockIdx.x]; start < end; start += THREADS) {
        __syncthreads();
        fetch(&entries[threadIdx.x], work, start + threadIdx.x, end, nullptr);
        __syncthreads();
        for (int group = 0; group < THREADS; group += 32) {
            unsigned reached = __ballot_sync(FULL, entries[group + s.lane].flags >> s.warp & 1);
            while (reached) {
                const Entry& e = entries[group + __ffs(reached) - 1];
                reached &= reached - 1;
                const float dx = x - e.u, dy[2] = {y[0] - e.v, y[1] - e.v};
                float alpha[2];
                if (!alphas(e, dx, dy, alpha)) continue;
#pragma unroll
                for (int i = 0; i < 2; i++) {
                    const float w = e.z <= limit[i] ? alpha[i] : 0.0f;
                    red[i] = fmaf(w, e.red, red[i]), green[i] = fmaf(w, e.green, green[i]);
                    blue[i] = fmaf(w, e.blue, blue[i]), z[i] = fmaf(w, e.z, z[i]);
                    sum[i] += w;
                }
            }
        }
    }
#pragma unroll
    for (int i = 0; i < 2; i++) {
        if (!s.inside[i]) continue;
        const long long at = (long long)s.y[i] * work.width + s.x;
        const float b = base.weight[at], D = base.depth[at], per = reciprocal(b + sum[i]);
        image.rgb[3 * at] = fmaf(b, base.rgb[3 * at], red[i]) * per;
        image.rgb[3 * at + 1] = fmaf(b, base.rgb[3 * at + 1], green[i]) * per;
        image.rgb[3 * at + 2] = fmaf(b, base.rgb[3 * at + 2], blue[i]) * per;
        image.weight[at] = sum[i];
        image.depth[at] = D > 0.0f ? (D + z[i]) / (1.0f + sum[i]) : z[i] * reciprocal(sum[i]);
    }
}

// What a pixel gives to every Gaussian over it: q, dL/d of the sum of w c, and -q . C.
struct Pixel {
    float q_r, q_g, q_b, minus_qC, limit;
};

__device__ __forceinline__ Pixel pixel_of(const Seen& image, const Surface& base, long long at, bool inside) {
    Pixel p = {0.0f, 0.0f, 0.0f, 0.0f, limit_of(base, at, inside)};
    if (!inside) return p;
    const float per = reciprocal(base.weight[at] + image.weight[at]);
    p.q_r = image.v_rgb[3 * at] * per, p.q_g = image.v_rgb[3 * at + 1] * per, p.q_b = image.v_rgb[3 * at + 2] * per;
    p.minus_qC = -(p.q_r * image.rgb[3 * at] + p.q_g * image.rgb[3 * at + 1] + p.q_b * image.rgb[3 * at + 2]);
    return p;
}

// sums [N, SPLAT_FLOATS], to which the sums of every Gaussian are added (splat.cuh); of the rows in trained, null: all.
// abs_sums [N, 2], likewise, if ABSOLUTE: sums over the pixels of |dL/du| and |dL/dv|.
template <bool ABSOLUTE>
__device__ __forceinline__ void backward(const Work& work, const Surface& base, const Seen& image,
                                         const unsigned char* trained, float* sums, float* abs_sums) {
    __shared__ Entry entries[THREADS];
    const Square s = square_of(work);
    const float x = (float)s.x + 0.5f, y[2] = {(float)s.y[0] + 0.5f, (float)s.y[1] + 0.5f};
    Pixel pixel[2];
#pragma unroll
    for (int i = 0; i < 2; i++) pixel[i] = pixel_of(image, base, (long long)s.y[i] * work.width + s.x, s.inside[i]);
    const int end = work.offset[blockIdx.x + 1];
    for (int start = work.offset[blockIdx.x]; start < end; start += THREADS) {
        __syncthreads();
        fetch(&entries[threadIdx.x], work, start + threadIdx.x, end, trained);
        __syncthreads();
        for (int group = 0; group < THREADS; group += 32) {
            const unsigned flags = entries[group + s.lane].flags;
            unsigned reached = __ballot_sync(FULL, (flags >> s.warp & 1) && (flags & TRAINED));
            while (reached) {
                const Entry& e = entries[group + __ffs(reached) - 1];
                reached &= reached - 1;
                const float dx = x - e.u, dy[2] = {y[0] - e.v, y[1] - e.v};
                float alpha[2], w[2], v[2];
                alphas(e, dx, dy, alpha);
#pragma unroll
                for (int i = 0; i < 2; i++) w[i] = e.z <= pixel[i].limit ? alpha[i] : 0.0f;
                if (!__any_sync(FULL, w[0] + w[1] > 0.0f)) continue;
#pragma unroll
                for (int i = 0; i < 2; i++) {
                    const Pixel& p = pixel[i];
                    const float v_w = fmaf(e.red, p.q_r, fmaf(e.green, p.q_g, fmaf(e.blue, p.q_b, p.minus_qC)));
                    v[i] = alpha[i] < GS_ALPHA_MAX ? v_w * w[i] : 0.0f;
                }
                const float both = v[0] + v[1], lever = fmaf(v[0], dy[0], v[1] * dy[1]);
                float own[SUMS];
                own[SUM_GX] = both * dx, own[SUM_GY] = lever;
                own[SUM_GXX] = both * dx * dx, own[SUM_GXY] = lever * dx;
                own[SUM_GYY] = fmaf(v[0] * dy[0], dy[0], v[1] * dy[1] * dy[1]), own[SUM_G] = both;
                own[SUM_RED] = fmaf(w[0], pixel[0].q_r, w[1] * pixel[1].q_r);
                own[SUM_GREEN] = fmaf(w[0], pixel[0].q_g, w[1] * pixel[1].q_g);
                own[SUM_BLUE] = fmaf(w[0], pixel[0].q_b, w[1] * pixel[1].q_b);
                own[SUM_DEPTH] = 0.0f;
                int which;
                const float sum = warp_sums(own, s.lane, &which);
                if (which >= 0) atomicAdd(sums + SPLAT_FLOATS * (long long)e.row + which, sum);
                if (ABSOLUTE) add_absolute(e, dx, dy, v, s.lane, abs_sums + 2 * (long long)e.row);
            }
        }
    }
}

extern "C" __global__ void __launch_bounds__(128) over_base_backward(
    Work work, Surface base, Seen image, const unsigned char* trained, float* sums) {
    backward<false>(work, base, image, trained, sums, nullptr);
}

extern "C" __global__ void __launch_bounds__(128) over_base_backward_abs(
    Work work, Surface base, Seen image, const unsigned char* trained, float* sums, float* abs_sums) {
    backward<true>(work, base, image, trained, sums, abs_sums);
}
