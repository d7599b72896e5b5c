// Elementwise work on single rows in float32, in loops that the compiler can vectorize.

#ifndef LATENTPLAN_ROWS_H
#define LATENTPLAN_ROWS_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define NORM_EPS 1e-5f

#define PRAGMA(TEXT) _Pragma(#TEXT)
#define VECTOR(HOW) PRAGMA(omp simd HOW)

typedef uint16_t bfloat16;

static inline float read_bfloat16(bfloat16 half) {
    uint32_t bits = (uint32_t)half << 16;
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline bfloat16 write_bfloat16(float value) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    uint32_t rounded = (bits + 0x7fffu + ((bits >> 16) & 1u)) >> 16;
    return (bfloat16)(value == value ? rounded : 0x7fc0u);
}

static inline float read_float(float value) { return value; }
static inline float write_float(float value) { return value; }

// exp(x) = 2^n exp(r) with |r| <= ln(2) / 2; the polynomial is Taylor's of degree 5, relative error 3e-6.
static inline float exponential(float x) {
    x = x > 88.0f ? 88.0f : x;
    x = x < -87.0f ? -87.0f : x;
    float n = rintf(x * 1.44269504f);
    float r = fmaf(n, -0.693147181f, x);
    float p = 1.0f / 120.0f;
    p = fmaf(p, r, 1.0f / 24.0f);
    p = fmaf(p, r, 1.0f / 6.0f);
    p = fmaf(p, r, 0.5f);
    p = fmaf(p, r, 1.0f);
    p = fmaf(p, r, 1.0f);
    int32_t bits = ((int32_t)n + 127) << 23;
    float power;
    memcpy(&power, &bits, sizeof power);
    return p * power;
}

static inline float sigmoid(float x) { return 1.0f / (1.0f + exponential(-x)); }
static inline float hyperbolic_tangent(float x) { return 2.0f * sigmoid(2.0f * x) - 1.0f; }

// A layer norm of one row: the mean, and the factor that scales deviations to a variance of 1.
typedef struct {
    const float *row, *scale, *shift;
    float mean, factor;
} Norm;

static inline Norm compute_norm(const float *row, const float *scale, const float *shift, long length) {
    float sum = 0.0f, squares = 0.0f;
    VECTOR(reduction(+ : sum)) for (long i = 0; i < length; i++) sum += row[i];
    float mean = sum / (float)length;
    VECTOR(reduction(+ : squares)) for (long i = 0; i < length; i++) squares += (row[i] - mean) * (row[i] - mean);
    return (Norm){row, scale, shift, mean, 1.0f / sqrtf(squares / (float)length + NORM_EPS)};
}

static inline float normed(const Norm *norm, long i) {
    return (norm->row[i] - norm->mean) * norm->factor * norm->scale[i] + norm->shift[i];
}

static inline float silu(float x) { return x * sigmoid(x); }

// The next state of unit i of the GRU; the row holds reset, candidate and update gates side by side.
static inline float gated(const Norm *norm, long i, long size, float before) {
    float reset = sigmoid(normed(norm, i));
    float candidate = hyperbolic_tangent(reset * normed(norm, size + i));
    return before + sigmoid(normed(norm, 2 * size + i) - 1.0f) * (candidate - before);
}

// The mean of the bins' values under the softmax of a row of logits.
static inline float expected(const float *row, const float *values, long size) {
    float highest = -INFINITY, sum = 0.0f, mean = 0.0f;
    VECTOR(reduction(max : highest)) for (long i = 0; i < size; i++) highest = row[i] > highest ? row[i] : highest;
    VECTOR(reduction(+ : sum, mean)) for (long i = 0; i < size; i++) {
        float weight = exponential(row[i] - highest);
        sum += weight;
        mean += weight * values[i];
    }
    return mean / sum;
}

#endif
