// The nearest points of each point by all distances. Formulas: gsfusion_nb/seeding/points.py.
//
// Layout: a thread looks for the neighbours of one point, a block reads the others into shared memory piece by piece.
// Each thread keeps its best in registers, nearest first; of equal distances the lower row comes first. What limits it
// is arithmetic: about 10 instructions for each pair.
constexpr int BLOCK = 128, MOST = 8;

// distance, row: [M, k], infinite and N where there are fewer than k; k is at most MOST.
extern "C" __global__ void __launch_bounds__(128) nearest(
    const float* xyz, const float* others, float* distance, long long* row, int M, int N, int k) {
    __shared__ float piece[BLOCK][3];
    const int i = blockIdx.x * BLOCK + threadIdx.x, own = 3 * min(i, M - 1);
    const float x = xyz[own], y = xyz[own + 1], z = xyz[own + 2];
    const float infinite = __int_as_float(0x7f800000);
    float best[MOST], limit = infinite;
    int at[MOST];
#pragma unroll
    for (int j = 0; j < MOST; j++) best[j] = infinite, at[j] = N;
    for (int start = 0; start < N; start += BLOCK) {
        const int count = min(BLOCK, N - start);
        __syncthreads();
        if ((int)threadIdx.x < count)
            for (int c = 0; c < 3; c++) piece[threadIdx.x][c] = others[3 * (start + (int)threadIdx.x) + c];
        __syncthreads();
        for (int n = 0; n < count; n++) {
            const float dx = piece[n][0] - x, dy = piece[n][1] - y, dz = piece[n][2] - z;
            float square = dx * dx + dy * dy + dz * dz;
            if (!(square < limit)) continue;
            int found = start + n;
#pragma unroll
            for (int j = 0; j < MOST; j++) {
                if (square < best[j]) {
                    const float farther = best[j];
                    const int other = at[j];
                    best[j] = square, at[j] = found, square = farther, found = other;
                }
                if (j == k - 1) limit = best[j];
            }
        }
    }
    if (i >= M) return;
#pragma unroll
    for (int j = 0; j < MOST; j++)
        if (j < k) distance[(long long)i * k + j] = sqrtf(best[j]), row[(long long)i * k + j] = at[j];
}
