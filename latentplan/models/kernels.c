// Elementwise work between the matrix products of the recurrence and the heads, one pass per row.
// Rows are bfloat16 or float32; sums, means and functions are float32. NaN in gives NaN out.

#include <math.h>
#include <stdint.h>
#include <string.h>

#define LONGEST_ROW 4096
#define NORM_EPS 1e-5f
#define ROWS_PER_THREAD 16

#define PRAGMA(TEXT) _Pragma(#TEXT)
#define VECTOR(HOW) PRAGMA(omp simd HOW)
#define PARALLEL PRAGMA(omp parallel for schedule(static) num_threads(threads) if (rows >= threads * ROWS_PER_THREAD))

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

// Reads a row, and finds its mean and what its deviations are multiplied with to have a variance of 1.
#define MOMENTS(READ)                                                                                          \
    float row[LONGEST_ROW], sum = 0.0f, squares = 0.0f;                                                        \
    VECTOR(reduction(+ : sum)) for (long i = 0; i < length; i++) {                                             \
        row[i] = READ(place[i]);                                                                               \
        sum += row[i];                                                                                         \
    }                                                                                                          \
    float mean = sum / (float)length;                                                                          \
    VECTOR(reduction(+ : squares)) for (long i = 0; i < length; i++) {                                         \
        squares += (row[i] - mean) * (row[i] - mean);                                                          \
    }                                                                                                          \
    float factor = 1.0f / sqrtf(squares / (float)length + NORM_EPS);

#define NORMED(I) ((row[I] - mean) * factor * scale[I] + shift[I])

#define NORM_SILU(NAME, TYPE, READ, WRITE)                                                                     \
    void NAME(TYPE *product, const float *scale, const float *shift, long rows, long length, int threads) {    \
        PARALLEL for (long r = 0; r < rows; r++) {                                                             \
            TYPE *place = product + r * length;                                                                \
            MOMENTS(READ)                                                                                      \
            VECTOR() for (long i = 0; i < length; i++) {                                                       \
                float x = NORMED(i);                                                                           \
                place[i] = WRITE(x * sigmoid(x));                                                              \
            }                                                                                                  \
        }                                                                                                      \
    }

NORM_SILU(norm_silu_bfloat16, bfloat16, read_bfloat16, write_bfloat16)
NORM_SILU(norm_silu_float32, float, read_float, write_float)

// The gates of the recurrence: reset, candidate and update, side by side in a row.
#define GATES(NAME, TYPE, READ, WRITE)                                                                         \
    void NAME(const TYPE *product, const float *scale, const float *shift, const float *deter, float *next,    \
              TYPE *rounded, long rows, long size, int threads) {                                              \
        PARALLEL for (long r = 0; r < rows; r++) {                                                             \
            long length = 3 * size;                                                                            \
            const TYPE *place = product + r * length;                                                          \
            MOMENTS(READ)                                                                                      \
            VECTOR() for (long i = 0; i < size; i++) {                                                         \
                float reset = sigmoid(NORMED(i));                                                              \
                float candidate = 2.0f * sigmoid(2.0f * reset * NORMED(size + i)) - 1.0f;                      \
                float update = sigmoid(NORMED(2 * size + i) - 1.0f);                                           \
                float before = deter[r * size + i];                                                            \
                float after = before + update * (candidate - before);                                          \
                next[r * size + i] = after;                                                                    \
                rounded[r * size + i] = WRITE(after);                                                          \
            }                                                                                                  \
        }                                                                                                      \
    }

GATES(gates_bfloat16, bfloat16, read_bfloat16, write_bfloat16)
GATES(gates_float32, float, read_float, write_float)

// The mean under softmax(logits) of the bins' values, for each row.
void expectation(const float *logits, const float *values, float *means, long rows, long size, int threads) {
    PARALLEL for (long r = 0; r < rows; r++) {
        const float *row = logits + r * size;
        float highest = -INFINITY, sum = 0.0f, mean = 0.0f;
        VECTOR(reduction(max : highest)) for (long i = 0; i < size; i++) highest = row[i] > highest ? row[i] : highest;
        VECTOR(reduction(+ : sum, mean)) for (long i = 0; i < size; i++) {
            float weight = exponential(row[i] - highest);
            sum += weight;
            mean += weight * values[i];
        }
        means[r] = mean / sum;
    }
}
