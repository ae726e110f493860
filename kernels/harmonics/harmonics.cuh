// Real spherical harmonics up to degree 3 at unit directions; order, signs and constants of Kerbl et al. 2023.
#pragma once

constexpr float C0 = 0.28209479177387814f;  // 1 / (2 sqrt(pi))
constexpr float C1 = 0.4886025119029199f;   // sqrt(3 / 4 pi)
constexpr float C20 = 1.0925484305920792f, C21 = 0.31539156525252005f, C22 = 0.5462742152960396f;
constexpr float C30 = 0.5900435899266435f, C31 = 2.890611442640554f, C32 = 0.4570457994644658f;
constexpr float C33 = 0.3731763325901154f, C34 = 1.445305721320277f;

template <int K>
__device__ __forceinline__ void harmonics(float x, float y, float z, float* Y) {
    Y[0] = C0;
    if constexpr (K >= 4) {
        Y[1] = -C1 * y, Y[2] = C1 * z, Y[3] = -C1 * x;
    }
    const float xx = x * x, yy = y * y, zz = z * z;
    if constexpr (K >= 9) {
        Y[4] = C20 * x * y, Y[5] = -C20 * y * z, Y[6] = C21 * (2.0f * zz - xx - yy);
        Y[7] = -C20 * x * z, Y[8] = C22 * (xx - yy);
    }
    if constexpr (K >= 16) {
        Y[9] = -C30 * y * (3.0f * xx - yy), Y[10] = C31 * x * y * z, Y[11] = -C32 * y * (4.0f * zz - xx - yy);
        Y[12] = C33 * z * (2.0f * zz - 3.0f * xx - 3.0f * yy), Y[13] = -C32 * x * (4.0f * zz - xx - yy);
        Y[14] = C34 * z * (xx - yy), Y[15] = -C30 * x * (xx - 3.0f * yy);
    }
}

// Sum over k of w_k times the gradient of the polynomial Y_k.
template <int K>
__device__ __forceinline__ float3 harmonics_gradient(float x, float y, float z, const float* w) {
    float gx = 0.0f, gy = 0.0f, gz = 0.0f;
    if constexpr (K >= 4) {
        gx = -C1 * w[3], gy = -C1 * w[1], gz = C1 * w[2];
    }
    const float xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    if constexpr (K >= 9) {
        const float a = C20 * w[4], b = C20 * w[5], c = 2.0f * C21 * w[6], d = C20 * w[7], e = 2.0f * C22 * w[8];
        gx += a * y - c * x - d * z + e * x;
        gy += a * x - b * z - c * y - e * y;
        gz += -b * y + 2.0f * c * z - d * x;
    }
    if constexpr (K >= 16) {
        const float a = C30 * w[9], b = C31 * w[10], c = C32 * w[11], d = 3.0f * C33 * w[12];
        const float e = C32 * w[13], f = C34 * w[14], g = C30 * w[15];
        gx += -6.0f * a * xy + b * yz + 2.0f * c * xy - 2.0f * d * xz - e * (4.0f * zz - 3.0f * xx - yy);
        gx += 2.0f * f * xz - 3.0f * g * (xx - yy);
        gy += -3.0f * a * (xx - yy) + b * xz - c * (4.0f * zz - xx - 3.0f * yy) - 2.0f * d * yz;
        gy += 2.0f * e * xy - 2.0f * f * yz + 6.0f * g * xy;
        gz += b * xy - 8.0f * c * yz + d * (2.0f * zz - xx - yy) - 8.0f * e * xz + f * (xx - yy);
    }
    return make_float3(gx, gy, gz);
}

// The K x 3 coefficients of a row; four at a time where rows are multiples of 16 bytes (degrees 1 and 3).
template <int K>
__device__ __forceinline__ void load_coefficients(const float* sh, long long row, float* out) {
    if constexpr (3 * K % 4 == 0) {
        const float4* from = reinterpret_cast<const float4*>(sh) + row * (3 * K / 4);
#pragma unroll
        for (int i = 0; i < 3 * K / 4; i++) {
            const float4 four = from[i];
            out[4 * i] = four.x, out[4 * i + 1] = four.y, out[4 * i + 2] = four.z, out[4 * i + 3] = four.w;
        }
    } else {
#pragma unroll
        for (int i = 0; i < 3 * K; i++) out[i] = sh[row * (3 * K) + i];
    }
}

// Writes them, in the same way.
template <int K>
__device__ __forceinline__ void store_coefficients(float* sh, long long row, const float* values) {
    if constexpr (3 * K % 4 == 0) {
        float4* to = reinterpret_cast<float4*>(sh) + row * (3 * K / 4);
#pragma unroll
        for (int i = 0; i < 3 * K / 4; i++)
            to[i] = make_float4(values[4 * i], values[4 * i + 1], values[4 * i + 2], values[4 * i + 3]);
    } else {
#pragma unroll
        for (int i = 0; i < 3 * K; i++) sh[row * (3 * K) + i] = values[i];
    }
}
