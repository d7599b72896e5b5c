// Vectors for elementwise work that learns, as wide as the registers. `left` is how many numbers a row still has: beyond
// them, loads give zeros and stores write nothing.

#ifndef LATENTPLAN_WIDE_H
#define LATENTPLAN_WIDE_H

#include "products.h"

#ifdef __AVX512F__
#define LANES 16
#else
#define LANES 8
#endif

typedef real wide __attribute__((vector_size(LANES * sizeof(real))));

#define FOR_LANES(INDEX, LENGTH) for (long INDEX = 0; INDEX < (LENGTH); INDEX += LANES)

#if PAIR == 2

#include "vectors.h"

static inline __mmask16 mask_of(long left) { return left >= LANES ? 0xffff : (__mmask16)((1u << left) - 1); }
static inline wide load(const real *from, long left) { return (wide)_mm512_maskz_loadu_ps(mask_of(left), from); }
static inline void store(real *to, wide values, long left) { _mm512_mask_storeu_ps(to, mask_of(left), (__m512)values); }

static inline wide load_half(const half *from, long left) {
    __m512i bits = _mm512_cvtepu16_epi32(_mm256_maskz_loadu_epi16(mask_of(left), from));
    return (wide)_mm512_slli_epi32(bits, 16);
}

static inline void store_half(half *to, wide values, long left) {
    _mm256_mask_storeu_epi16(to, mask_of(left), (__m256i)_mm512_cvtneps_pbh((__m512)values));
}

static inline real sum_of(wide values) { return _mm512_reduce_add_ps((__m512)values); }

// The reciprocal with a step of Newton's method; 0 for infinity.
static inline wide reciprocal_of(wide x) {
    wide first = (wide)_mm512_rcp14_ps((__m512)x);
    return first + first * (wide)_mm512_fnmadd_ps((__m512)x, (__m512)first, _mm512_set1_ps(1.0f));
}

static inline wide sigmoid_of(wide x) {
    // Beyond 80 the sigmoid is 0 or 1 in float32; infinite powers would give NaN.
    wide limited = (wide)_mm512_max_ps(_mm512_set1_ps(-80.0f), (__m512)x);
    return reciprocal_of((wide)power_of_two((__m512)(limited * -1.44269504f)) + 1.0f);
}

#else

static inline wide load(const real *from, long left) {
    wide values = {0};
    // A copy of constant size is one instruction; the compiler calls a function for any other.
    if (left >= LANES)
        memcpy(&values, from, sizeof values);
    else
        for (long i = 0; i < left; i++) values[i] = from[i];
    return values;
}

static inline void store(real *to, wide values, long left) {
    if (left >= LANES)
        memcpy(to, &values, sizeof values);
    else
        for (long i = 0; i < left; i++) to[i] = values[i];
}

static inline wide load_half(const half *from, long left) { return load(from, left); }
static inline void store_half(half *to, wide values, long left) { store(to, values, left); }

static inline real sum_of(wide values) {
    real sum = 0;
    for (int i = 0; i < LANES; i++) sum += values[i];
    return sum;
}

static inline wide sigmoid_of(wide x) {
    real rows[LANES];
    memcpy(rows, &x, sizeof rows);
    VECTOR() for (int i = 0; i < LANES; i++) rows[i] = sigmoid(rows[i]);
    memcpy(&x, rows, sizeof rows);
    return x;
}

#endif

static inline wide tanh_of(wide x) { return 2 * sigmoid_of(2 * x) - 1; }

static inline wide normed_of(const Norm *norm, long i, long length) {
    wide centred = (load(norm->row + i, length - i) - norm->mean) * norm->factor;
    return centred * load(norm->scale + i, length - i) + load(norm->shift + i, length - i);
}

#if PAIR != 2

// SiLU of the layer norm of a row.
static inline void silu_row(half *to, const real *row, const real *scale, const real *shift, long length) {
    Norm norm = compute_norm(row, scale, shift, length);
    FOR_LANES(i, length) {
        wide x = normed_of(&norm, i, length);
        store_half(to + i, x * sigmoid_of(x), length - i);
    }
}

// The next state of the GRU, and its copy as a factor; a row holds reset, candidate and update gates.
static inline void gate_row(real *deter, half *rounded, const real *row, const real *scale, const real *shift,
                            long size) {
    Norm norm = compute_norm(row, scale, shift, 3 * size);
    FOR_LANES(i, size) {
        wide reset = sigmoid_of(normed_of(&norm, i, 3 * size));
        wide candidate = tanh_of(reset * normed_of(&norm, size + i, 3 * size));
        wide update = sigmoid_of(normed_of(&norm, 2 * size + i, 3 * size) - 1);
        wide before = load(deter + i, size - i), after = before + update * (candidate - before);
        store(deter + i, after, size - i);
        store_half(rounded + i, after, size - i);
    }
}

// The mean of the bins' values under the softmax of a row of logits.
static inline real expected_of(const real *row, const real *values, long size) { return expected(row, values, size); }

#endif

#endif
