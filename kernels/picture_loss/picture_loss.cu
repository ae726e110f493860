// Mean absolute or squared difference, its gradient and the squared error as shown. Formulas: gsfusion_nb/optim/losses.py.
//
// Layout: each thread takes PER_THREAD values, a block apart; a block leaves its two sums, and one more block adds up
// those of all, always in the same order. What limits it is memory: 8 bytes in and 4 out for each value.
constexpr int BLOCK = 256, PER_THREAD = 16;

struct Errors {
    double value, square;
};

// The sum over the block, in its first thread.
__device__ __forceinline__ Errors sum_of_block(Errors own) {
    __shared__ Errors sums[BLOCK];
    sums[threadIdx.x] = own;
    for (int half = BLOCK / 2; half > 0; half /= 2) {
        __syncthreads();
        if ((int)threadIdx.x < half) {
            sums[threadIdx.x].value += sums[threadIdx.x + half].value;
            sums[threadIdx.x].square += sums[threadIdx.x + half].square;
        }
    }
    return sums[threadIdx.x];
}

// partial: sums of |C - C^|, or (C - C^)^2 if SQUARED, and (clamp C^ - C)^2 of each block.
template <bool SQUARED>
__device__ __forceinline__ void pass(
    const float* rgb, const float* target, float* v_rgb, double* partial, int total, float scale) {
    float value = 0.0f, square = 0.0f;
    const long long start = (long long)blockIdx.x * (BLOCK * PER_THREAD) + threadIdx.x;
#pragma unroll
    for (int k = 0; k < PER_THREAD; k++) {
        const long long i = start + k * BLOCK;
        if (i >= total) break;
        const float shown = rgb[i], wanted = target[i], gap = shown - wanted;
        v_rgb[i] = SQUARED ? gap * scale : gap > 0.0f ? scale : gap < 0.0f ? -scale : 0.0f;
        const float off = (shown < 0.0f ? 0.0f : shown > 1.0f ? 1.0f : shown) - wanted;  // NaN stays NaN
        value += SQUARED ? gap * gap : fabsf(gap), square += off * off;
    }
    const Errors sum = sum_of_block({value, square});
    if (threadIdx.x == 0) partial[2 * blockIdx.x] = sum.value, partial[2 * blockIdx.x + 1] = sum.square;
}

extern "C" __global__ void __launch_bounds__(256) l1_pass(
    const float* rgb, const float* target, float* v_rgb, double* partial, int total, float scale) {
    pass<false>(rgb, target, v_rgb, partial, total, scale);
}

extern "C" __global__ void __launch_bounds__(256) l2_pass(
    const float* rgb, const float* target, float* v_rgb, double* partial, int total, float scale) {
    pass<true>(rgb, target, v_rgb, partial, total, scale);
}

// means: of both, over the whole picture.
extern "C" __global__ void __launch_bounds__(256) mean_errors(const double* partial, float* means, int blocks, int total) {
    Errors own = {0.0, 0.0};
    for (int b = threadIdx.x; b < blocks; b += BLOCK) own.value += partial[2 * b], own.square += partial[2 * b + 1];
    const Errors sum = sum_of_block(own);
    if (threadIdx.x == 0) means[0] = (float)(sum.value / total), means[1] = (float)(sum.square / total);
}
