// A Gaussian on the screen: 12 floats, three 16-byte loads; and where the ellipse alpha = 1/255 reaches.
#pragma once

constexpr int TILE = 16;      // edge of a tile, pixels
constexpr int SPLAT_VECTORS = 3;
constexpr unsigned FULL = 0xffffffffu;

struct Splat {
    float u, v, A, B;         // centre, pixels; conic: sigma = (A dx^2 + C dy^2) / 2 + B dx dy
    float C, ln_o, r, g;      // ln(opacity); colour
    float b, z, e_u, e_v;     // depth; half width and half height of the ellipse
};

// Sums over the pixels of a Gaussian that compositing's gradient leaves for projection's, in a row as long as a splat's:
// of g dx, g dy, g dx^2, g dx dy, g dy^2, g with g = alpha dL/dalpha, and of w dL/d(colour, depth) with its weight w.
enum { SUM_GX, SUM_GY, SUM_GXX, SUM_GXY, SUM_GYY, SUM_G, SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH, SUMS };
constexpr int SPLAT_FLOATS = 4 * SPLAT_VECTORS;

__device__ __forceinline__ void load_row(const float4* rows, long long row, float* out) {
#pragma unroll
    for (int i = 0; i < SPLAT_VECTORS; i++) {
        const float4 four = rows[SPLAT_VECTORS * row + i];
        out[4 * i] = four.x, out[4 * i + 1] = four.y, out[4 * i + 2] = four.z, out[4 * i + 3] = four.w;
    }
}

__device__ __forceinline__ Splat load_splat(const float4* splats, long long row) {
    const float4 p = splats[SPLAT_VECTORS * row], q = splats[SPLAT_VECTORS * row + 1];
    const float4 s = splats[SPLAT_VECTORS * row + 2];
    return {p.x, p.y, p.z, p.w, q.x, q.y, q.z, q.w, s.x, s.y, s.z, s.w};
}

// ln(255 o): the largest sigma that is drawn
__device__ __forceinline__ float reach_of(float ln_o) { return ln_o - logf(GS_ALPHA_MIN); }

struct Range {
    int first, end;
};

// First tile, and one past the last, with a pixel centre i + 0.5 between low and high.
__device__ __forceinline__ Range tile_range(float low, float high, int size) {
    const float slack = 1e-2f;  // for rounding; a few more entries, the same picture
    const float top = (float)size;
    const float first = fminf(fmaxf(ceilf(low - 0.5f - slack), 0.0f), top);
    const float end = fminf(fmaxf(floorf(high - 0.5f + slack) + 1.0f, 0.0f), top);
    const int first_tile = (int)first / TILE;
    return {first_tile, end > first ? ((int)end + TILE - 1) / TILE : first_tile};
}

__device__ __forceinline__ Range tile_rows(const Splat& s, int height) {
    return tile_range(s.v - s.e_v, s.v + s.e_v, height);
}

// Tiles of row ty that the ellipse meets. The ellipse is dx = -B/A dy +- h sqrt(1 - (dy / e_v)^2), and of its part in
// the band the rightmost point is where dy is nearest to -B/C e_u (Hanson et al. 2025): exact, two roots a row.
__device__ __forceinline__ Range tile_columns(const Splat& s, int ty, int width) {
    const float top = (float)(ty * TILE) + 0.5f - s.v, bottom = top + (float)(TILE - 1);
    const float turn = s.B / s.C * s.e_u, slope = s.B / s.A;
    const float dy_right = fminf(fmaxf(-turn, top), bottom), dy_left = fminf(fmaxf(turn, top), bottom);
    const float h = sqrtf(2.0f * fmaxf(reach_of(s.ln_o), 0.0f) / s.A), e_v = fmaxf(s.e_v, 1e-20f);
    const float p = dy_right / e_v, q = dy_left / e_v;
    const float right = s.u - slope * dy_right + h * sqrtf(fmaxf(1.0f - p * p, 0.0f));
    const float left = s.u - slope * dy_left - h * sqrtf(fmaxf(1.0f - q * q, 0.0f));
    return tile_range(left, right, width);
}

// Where sigma is least on a vertical line dx (at dy = steep dx) and on a horizontal one (at dx = flat dy); its limit.
struct Valley {
    float steep, flat, limit;
};

__device__ __forceinline__ Valley valley_of(const Splat& s) {
    return {-s.B / s.C, -s.B / s.A, reach_of(s.ln_o) + 1e-2f};
}

// Whether the ellipse reaches a box of pixel centres. Sigma is convex: outside the ellipse's centre, its least value in
// the box lies on an edge that faces the centre.
__device__ __forceinline__ bool meets_box(const Splat& s, const Valley& q, float x0, float y0, float x1, float y1) {
    const float left = x0 - s.u, right = x1 - s.u, top = y0 - s.v, bottom = y1 - s.v;
    const bool beside = left > 0.0f || right < 0.0f, above = top > 0.0f || bottom < 0.0f;
    bool met = !(beside || above);
    if (beside) {
        const float dx = left > 0.0f ? left : right, dy = fminf(fmaxf(q.steep * dx, top), bottom);
        const float size = 0.5f * (s.A * dx * dx + s.C * dy * dy);
        met = met || size + s.B * dx * dy <= q.limit + 4e-6f * size;
    }
    if (above) {
        const float dy = top > 0.0f ? top : bottom, dx = fminf(fmaxf(q.flat * dy, left), right);
        const float size = 0.5f * (s.A * dx * dx + s.C * dy * dy);
        met = met || size + s.B * dx * dy <= q.limit + 4e-6f * size;
    }
    return met;
}
