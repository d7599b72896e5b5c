// Elementwise work of the GRU and the heads, one pass per row.
// Rows are bfloat16 or float32; sums, means and functions are float32. NaN in gives NaN out.

#include "rows.h"

#define LONGEST_ROW 4096
#define ROWS_PER_THREAD 16

#define PARALLEL PRAGMA(omp parallel for schedule(static) num_threads(threads) if (rows >= threads * ROWS_PER_THREAD))
#define READ_ROW(READ)                                                                                         \
    float row[LONGEST_ROW];                                                                                    \
    VECTOR() for (long i = 0; i < length; i++) row[i] = READ(place[i]);                                        \
    Norm norm = compute_norm(row, scale, shift, length);

#define NORM_SILU(NAME, TYPE, READ, WRITE)                                                                     \
    void NAME(TYPE *product, const float *scale, const float *shift, long rows, long length, int threads) {    \
        PARALLEL for (long r = 0; r < rows; r++) {                                                             \
            TYPE *place = product + r * length;                                                                \
            READ_ROW(READ)                                                                                     \
            VECTOR() for (long i = 0; i < length; i++) place[i] = WRITE(silu(normed(&norm, i)));               \
        }                                                                                                      \
    }

NORM_SILU(norm_silu_bfloat16, bfloat16, read_bfloat16, write_bfloat16)
NORM_SILU(norm_silu_float32, float, read_float, write_float)

#define GATES(NAME, TYPE, READ, WRITE)                                                                         \
    void NAME(const TYPE *product, const float *scale, const float *shift, const float *deter, float *next,    \
              TYPE *rounded, long rows, long size, int threads) {                                              \
        PARALLEL for (long r = 0; r < rows; r++) {                                                             \
            long length = 3 * size;                                                                            \
            const TYPE *place = product + r * length;                                                          \
            READ_ROW(READ)                                                                                     \
            VECTOR() for (long i = 0; i < size; i++) {                                                         \
                float after = gated(&norm, i, size, deter[r * size + i]);                                      \
                next[r * size + i] = after;                                                                    \
                rounded[r * size + i] = WRITE(after);                                                          \
            }                                                                                                  \
        }                                                                                                      \
    }

GATES(gates_bfloat16, bfloat16, read_bfloat16, write_bfloat16)
GATES(gates_float32, float, read_float, write_float)

void expectation(const float *logits, const float *values, float *means, long rows, long size, int threads) {
    PARALLEL for (long r = 0; r < rows; r++) means[r] = expected(logits + r * size, values, size);
}
