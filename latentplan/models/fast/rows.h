// Elementwise work on single rows, in loops that the compiler can vectorize. Numbers are float32; with EXACT they are
// float64, so that tests can compare formulas with autograd to the last digits.

#ifndef LATENTPLAN_ROWS_H
#define LATENTPLAN_ROWS_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#define NORM_EPS ((real)1e-5)

#define PRAGMA(TEXT) _Pragma(#TEXT)
#define VECTOR(HOW) PRAGMA(omp simd HOW)

typedef uint16_t bfloat16;

#ifdef EXACT
typedef double real;
#else
typedef float real;
#endif

static inline long larger(long a, long b) { return a > b ? a : b; }
static inline long smaller(long a, long b) { return a < b ? a : b; }

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

#ifdef EXACT

static inline real exponential(real x) { return exp(x); }
static inline real square_root(real x) { return sqrt(x); }
static inline real logarithm(real x) { return log(x); }

#else

static inline real square_root(real x) { return sqrtf(x); }
static inline real logarithm(real x) { return logf(x); }

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

#endif

static inline real sigmoid(real x) { return 1 / (1 + exponential(-x)); }
static inline real hyperbolic_tangent(real x) { return 2 * sigmoid(2 * x) - 1; }

// A layer norm of one row: the mean, and the factor that scales deviations to a variance of 1.
typedef struct {
    const real *row, *scale, *shift;
    real mean, factor;
} Norm;

static inline Norm compute_norm(const real *row, const real *scale, const real *shift, long length) {
    real sum = 0, squares = 0;
    VECTOR(reduction(+ : sum)) for (long i = 0; i < length; i++) sum += row[i];
    real mean = sum / (real)length;
    VECTOR(reduction(+ : squares)) for (long i = 0; i < length; i++) squares += (row[i] - mean) * (row[i] - mean);
    return (Norm){row, scale, shift, mean, 1 / square_root(squares / (real)length + NORM_EPS)};
}

static inline real normed(const Norm *norm, long i) {
    return (norm->row[i] - norm->mean) * norm->factor * norm->scale[i] + norm->shift[i];
}

static inline real silu(real x) { return x * sigmoid(x); }

// The next state of unit i of the GRU; the row holds reset, candidate and update gates side by side.
static inline real gated(const Norm *norm, long i, long size, real before) {
    real reset = sigmoid(normed(norm, i));
    real candidate = hyperbolic_tangent(reset * normed(norm, size + i));
    return before + sigmoid(normed(norm, 2 * size + i) - 1) * (candidate - before);
}

// The mean of the bins' values under the softmax of a row of logits.
static inline real expected(const real *row, const real *values, long size) {
    real highest = -INFINITY, sum = 0, mean = 0;
    VECTOR(reduction(max : highest)) for (long i = 0; i < size; i++) highest = row[i] > highest ? row[i] : highest;
    VECTOR(reduction(+ : sum, mean)) for (long i = 0; i < size; i++) {
        real weight = exponential(row[i] - highest);
        sum += weight;
        mean += weight * values[i];
    }
    return mean / sum;
}

#endif
