// One step of Adam on all columns of a map, or on one parameter. Every number, its gradient and its two moments are read
// and written once: memory is what limits it (28 bytes a number).
//
// Layout: a thread takes four numbers in a row, a block 1024 of one column; the blocks of a column follow those of the
// one before. The four are read together where the address allows it and the column does not end among them.
constexpr int THREADS = 256, IN_ROW = 4;

struct Columns {
    float *xyz_W, *log_scale, *quat, *opacity_logit, *sh;
};

struct ColumnRates {
    float xyz_W, log_scale, quat, opacity_logit, sh_dc, sh_rest;
};

struct Decay {
    float beta1, one_minus_beta1, beta2, one_minus_beta2, eps;
};

// The step count t of every row, in one of two arrays; without them the corrections are the same for all rows:
// first = 1 / (1 - beta1^t), second = 1 / sqrt(1 - beta2^t).
struct Steps {
    const int* of_row;
    const long long* of_row_64;
    float ln_beta1, ln_beta2, first, second;
};

struct Column {
    float* param;
    const float* gradient;
    float *exp_avg, *exp_avg_sq;
};

struct Corrections {
    float first, second;
};

// 1 - b^t = -expm1(t ln b) keeps its digits where b^t is close to 1.
__device__ __forceinline__ Corrections corrections_of(const Steps& steps, int row) {
    if (!steps.of_row && !steps.of_row_64) return {steps.first, steps.second};
    const float t = steps.of_row ? (float)steps.of_row[row] : (float)steps.of_row_64[row];
    return {1.0f / -expm1f(t * steps.ln_beta1), 1.0f / sqrtf(-expm1f(t * steps.ln_beta2))};
}

__device__ __forceinline__ void update(
    float& p, float g, float& m, float& v, float lr, const Corrections& c, const Decay& decay) {
    m = decay.beta1 * m + decay.one_minus_beta1 * g;
    v = decay.beta2 * v + decay.one_minus_beta2 * g * g;
    p -= lr * c.first * m / (sqrtf(v) * c.second + decay.eps);
}

__device__ __forceinline__ bool is_aligned(const Column& c) {
    return (((size_t)c.param | (size_t)c.gradient | (size_t)c.exp_avg | (size_t)c.exp_avg_sq) & 15) == 0;
}

// This thread's numbers of a column of `total`, `width` in a row. rate(place in the row): learning rate.
template <class Rate>
__device__ __forceinline__ void update_in_row(
    const Column& column, int block, int total, int width, const Steps& steps, const Decay& decay, Rate rate) {
    const int first = (block * THREADS + (int)threadIdx.x) * IN_ROW;
    if (first >= total) return;
    int row = first / width, place = first - row * width;
    Corrections c = corrections_of(steps, row);
    const auto next = [&](float& p, float g, float& m, float& v) {
        if (place == width) place = 0, c = corrections_of(steps, ++row);
        update(p, g, m, v, rate(place++), c, decay);
    };
    if (first + IN_ROW <= total && is_aligned(column)) {
        const int i = first / IN_ROW;
        const float4 g = reinterpret_cast<const float4*>(column.gradient)[i];
        float4 p = reinterpret_cast<float4*>(column.param)[i];
        float4 m = reinterpret_cast<float4*>(column.exp_avg)[i];
        float4 v = reinterpret_cast<float4*>(column.exp_avg_sq)[i];
        next(p.x, g.x, m.x, v.x);
        next(p.y, g.y, m.y, v.y);
        next(p.z, g.z, m.z, v.z);
        next(p.w, g.w, m.w, v.w);
        reinterpret_cast<float4*>(column.param)[i] = p;
        reinterpret_cast<float4*>(column.exp_avg)[i] = m;
        reinterpret_cast<float4*>(column.exp_avg_sq)[i] = v;
    } else {
        for (int i = first; i < first + IN_ROW && i < total; i++)
            next(column.param[i], column.gradient[i], column.exp_avg[i], column.exp_avg_sq[i]);
    }
}

// Whether block `block`, counted from the first one of a column of `total` numbers, is one of its blocks; otherwise it
// is counted from the first one of the next column from then on.
__device__ __forceinline__ bool is_of(int& block, int total) {
    constexpr int NUMBERS = THREADS * IN_ROW;
    const int blocks = (total + NUMBERS - 1) / NUMBERS;
    if (block < blocks) return true;
    block -= blocks;
    return false;
}

// Columns of N rows, K coefficients of SH in each. Blocks: those of each column, one after another.
extern "C" __global__ void __launch_bounds__(256) update_map(
    Columns params, Columns gradients, Columns exp_avg, Columns exp_avg_sq, ColumnRates rates, Steps steps, Decay decay, int N,
    int K) {
    int block = blockIdx.x;
    if (is_of(block, 3 * N)) {
        const Column c = {params.xyz_W, gradients.xyz_W, exp_avg.xyz_W, exp_avg_sq.xyz_W};
        update_in_row(c, block, 3 * N, 3, steps, decay, [&](int) { return rates.xyz_W; });
    } else if (is_of(block, 3 * N)) {
        const Column c = {params.log_scale, gradients.log_scale, exp_avg.log_scale, exp_avg_sq.log_scale};
        update_in_row(c, block, 3 * N, 3, steps, decay, [&](int) { return rates.log_scale; });
    } else if (is_of(block, 4 * N)) {
        const Column c = {params.quat, gradients.quat, exp_avg.quat, exp_avg_sq.quat};
        update_in_row(c, block, 4 * N, 4, steps, decay, [&](int) { return rates.quat; });
    } else if (is_of(block, N)) {
        const Column c = {
            params.opacity_logit, gradients.opacity_logit, exp_avg.opacity_logit, exp_avg_sq.opacity_logit};
        update_in_row(c, block, N, 1, steps, decay, [&](int) { return rates.opacity_logit; });
    } else {
        const Column c = {params.sh, gradients.sh, exp_avg.sh, exp_avg_sq.sh};
        const auto rate = [&](int place) { return place < 3 ? rates.sh_dc : rates.sh_rest; };
        update_in_row(c, block, 3 * K * N, 3 * K, steps, decay, rate);
    }
}

// One parameter of `total` numbers, `width` in a row. rate: learning rate of each place in a row, or null for `lr`.
extern "C" __global__ void __launch_bounds__(256) update_parameter(
    Column column, const float* rate, float lr, Steps steps, Decay decay, int total, int width) {
    const auto rate_of = [&](int place) { return rate ? rate[place] : lr; };
    update_in_row(column, blockIdx.x, total, width, steps, decay, rate_of);
}
