// Elementwise work on single rows for imagine.c, with vectors of sixteen floats. Lengths are multiples of 16. The same
// functions for other processors are in wide.h.
// Reciprocals have a precision of 14 bits; the next product reads 8.

#ifndef LATENTPLAN_VECTORS_H
#define LATENTPLAN_VECTORS_H

#include <immintrin.h>

#include "rows.h"

#define WIDTH 16

typedef struct {
    __m512 mean, factor;
    const float *row, *scale, *shift;
} WideNorm;

static inline WideNorm compute_wide_norm(const float *row, const float *scale, const float *shift, long length) {
    Norm norm = compute_norm(row, scale, shift, length);
    return (WideNorm){_mm512_set1_ps(norm.mean), _mm512_set1_ps(norm.factor), row, scale, shift};
}

static inline __m512 wide_normed(const WideNorm *norm, long i) {
    __m512 centred = _mm512_mul_ps(_mm512_sub_ps(_mm512_loadu_ps(norm->row + i), norm->mean), norm->factor);
    return _mm512_fmadd_ps(centred, _mm512_loadu_ps(norm->scale + i), _mm512_loadu_ps(norm->shift + i));
}

// 2^x = 2^n 2^f with |f| <= 1/2; the polynomial is Taylor's of degree 5, relative error 3e-6. For infinite x the
// fraction f is NaN, and scaling by infinity gives the right limit.
static inline __m512 power_of_two(__m512 x) {
    __m512 n = _mm512_roundscale_ps(x, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC), f = _mm512_sub_ps(x, n);
    __m512 p = _mm512_set1_ps(1.33335581e-3f);
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(9.61812911e-3f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(5.55041087e-2f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(2.40226507e-1f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(6.93147181e-1f));
    p = _mm512_fmadd_ps(p, f, _mm512_set1_ps(1.0f));
    return _mm512_scalef_ps(p, n);
}

static inline __m512 reciprocal_above_one(__m512 x) {
    return _mm512_rcp14_ps(_mm512_add_ps(power_of_two(x), _mm512_set1_ps(1.0f)));
}

static inline __m512 wide_sigmoid(__m512 x) {
    return reciprocal_above_one(_mm512_mul_ps(x, _mm512_set1_ps(-1.44269504f)));
}

static inline __m512 wide_tanh(__m512 x) {
    __m512 half = reciprocal_above_one(_mm512_mul_ps(x, _mm512_set1_ps(-2.88539008f)));
    return _mm512_fmsub_ps(half, _mm512_set1_ps(2.0f), _mm512_set1_ps(1.0f));
}

static inline void store_rounded(bfloat16 *place, __m512 values) {
    _mm256_storeu_si256((__m256i *)place, (__m256i)_mm512_cvtneps_pbh(values));
}

// SiLU of the layer norm of a row.
static inline void silu_row(bfloat16 *to, const float *row, const float *scale, const float *shift, long length) {
    WideNorm norm = compute_wide_norm(row, scale, shift, length);
    for (long i = 0; i < length; i += WIDTH) {
        __m512 x = wide_normed(&norm, i);
        store_rounded(to + i, _mm512_mul_ps(x, wide_sigmoid(x)));
    }
}

// The next state of the GRU, and its bfloat16 copy; a row holds reset, candidate and update gates.
static inline void gate_row(float *deter, bfloat16 *rounded, const float *row, const float *scale, const float *shift,
                            long size) {
    WideNorm norm = compute_wide_norm(row, scale, shift, 3 * size);
    for (long i = 0; i < size; i += WIDTH) {
        __m512 reset = wide_sigmoid(wide_normed(&norm, i));
        __m512 candidate = wide_tanh(_mm512_mul_ps(reset, wide_normed(&norm, size + i)));
        __m512 update = wide_normed(&norm, 2 * size + i);
        update = wide_sigmoid(_mm512_sub_ps(update, _mm512_set1_ps(1.0f)));
        __m512 before = _mm512_loadu_ps(deter + i);
        __m512 after = _mm512_fmadd_ps(update, _mm512_sub_ps(candidate, before), before);
        _mm512_storeu_ps(deter + i, after);
        store_rounded(rounded + i, after);
    }
}

// The mean of the bins' values under the softmax of a row of logits.
static inline float expected_of(const float *row, const float *values, long size) {
    __m512 highest = _mm512_loadu_ps(row), sum = _mm512_setzero_ps(), mean = sum;
    for (long i = WIDTH; i < size; i += WIDTH) highest = _mm512_max_ps(highest, _mm512_loadu_ps(row + i));
    highest = _mm512_set1_ps(_mm512_reduce_max_ps(highest));
    for (long i = 0; i < size; i += WIDTH) {
        __m512 distance = _mm512_sub_ps(_mm512_loadu_ps(row + i), highest);
        __m512 weight = power_of_two(_mm512_mul_ps(distance, _mm512_set1_ps(1.44269504f)));
        sum = _mm512_add_ps(sum, weight);
        mean = _mm512_fmadd_ps(weight, _mm512_loadu_ps(values + i), mean);
    }
    return _mm512_reduce_add_ps(mean) / _mm512_reduce_add_ps(sum);
}

#endif
