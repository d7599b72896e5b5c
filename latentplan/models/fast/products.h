// Matrix products of a block of rows with packed weights. Processors with bfloat16 products round the factors to
// bfloat16 and sum in float32; others, and EXACT, compute in `real`.

#ifndef LATENTPLAN_PRODUCTS_H
#define LATENTPLAN_PRODUCTS_H

#include <stddef.h>

#include "rows.h"

#define TILE 16
#define MULTIPLE 32  // padded sizes are multiples of this

// The number format of factors, and how many neighbouring rows of weights share a place in a tile.
#if defined(__AVX512BF16__) && !defined(EXACT)
#include <immintrin.h>
typedef bfloat16 half;
#define PAIR 2
static inline half write_half(real value) { return write_bfloat16(value); }
static inline real read_half(half value) { return read_bfloat16(value); }
#else
typedef real half;
#define PAIR 1
static inline half write_half(real value) { return value; }
static inline real read_half(half value) { return value; }
#endif

// A function of its own has all registers for its loop.
#define SEPARATE static __attribute__((noinline))

static inline long padded(long size) { return (size + MULTIPLE - 1) / MULTIPLE * MULTIPLE; }

// Packed weights lie in tiles of TILE outputs: (output tile, input / PAIR, TILE, PAIR). `inputs` and `outputs` of
// `multiply` are padded sizes. `count` is a multiple of TILE; a row of `rows` has `width` places, one of `to` `stride`.
// With `adds`, the product is added to what `to` holds.

#if PAIR == 2 && defined(__AMX_BF16__) && defined(__linux__)
#include <sys/syscall.h>
#include <unistd.h>
#define ASK_FOR_TILES 0x1023  // ARCH_REQ_XCOMP_PERM of arch_prctl(2)
#define TILE_DATA 18

static inline int can_multiply(void) { return syscall(SYS_arch_prctl, ASK_FOR_TILES, TILE_DATA) == 0; }

static inline void set_up_products(void) {
    struct {
        uint8_t palette, start_row, reserved[14];
        uint16_t bytes[16];
        uint8_t rows[16];
    } __attribute__((aligned(64))) tiles = {.palette = 1};
    for (int i = 0; i < 8; i++) {
        tiles.bytes[i] = 64;
        tiles.rows[i] = 16;
    }
    _tile_loadconfig(&tiles);
}

static inline void tear_down_products(void) { _tile_release(); }

SEPARATE void multiply_32(const half *rows, long width, const half *weights, long inputs, long outputs, real *to,
                               long stride, int adds) {
    for (long column = 0; column < outputs; column += 2 * TILE) {
        const half *left = weights + column * inputs, *right = left + TILE * inputs;
        real *upper = to + column, *lower = upper + TILE * stride;
        if (adds) {
            _tile_loadd(0, upper, stride * 4);
            _tile_loadd(1, upper + TILE, stride * 4);
            _tile_loadd(2, lower, stride * 4);
            _tile_loadd(3, lower + TILE, stride * 4);
        } else {
            _tile_zero(0);
            _tile_zero(1);
            _tile_zero(2);
            _tile_zero(3);
        }
        for (long k = 0; k < inputs; k += 32) {
            _tile_loadd(4, rows + k, width * 2);
            _tile_loadd(6, left + k * TILE, 64);
            _tile_loadd(5, rows + TILE * width + k, width * 2);
            _tile_loadd(7, right + k * TILE, 64);
            _tile_dpbf16ps(0, 4, 6);
            _tile_dpbf16ps(1, 4, 7);
            _tile_dpbf16ps(2, 5, 6);
            _tile_dpbf16ps(3, 5, 7);
        }
        _tile_stored(0, upper, stride * 4);
        _tile_stored(1, upper + TILE, stride * 4);
        _tile_stored(2, lower, stride * 4);
        _tile_stored(3, lower + TILE, stride * 4);
    }
}

SEPARATE void multiply_16(const half *rows, long width, const half *weights, long inputs, long outputs, real *to,
                               long stride, int adds) {
    for (long column = 0; column < outputs; column += 2 * TILE) {
        const half *left = weights + column * inputs, *right = left + TILE * inputs;
        if (adds) {
            _tile_loadd(0, to + column, stride * 4);
            _tile_loadd(1, to + column + TILE, stride * 4);
        } else {
            _tile_zero(0);
            _tile_zero(1);
        }
        for (long k = 0; k < inputs; k += 32) {
            _tile_loadd(4, rows + k, width * 2);
            _tile_loadd(6, left + k * TILE, 64);
            _tile_loadd(7, right + k * TILE, 64);
            _tile_dpbf16ps(0, 4, 6);
            _tile_dpbf16ps(1, 4, 7);
        }
        _tile_stored(0, to + column, stride * 4);
        _tile_stored(1, to + column + TILE, stride * 4);
    }
}

SEPARATE void multiply(const half *rows, long width, long count, const half *weights, long inputs, long outputs,
                            real *to, long stride, int adds) {
    long top = 0;
    for (; top + 32 <= count; top += 32)
        multiply_32(rows + top * width, width, weights, inputs, outputs, to + top * stride, stride, adds);
    if (top < count) multiply_16(rows + top * width, width, weights, inputs, outputs, to + top * stride, stride, adds);
}

#elif PAIR == 2

static inline int can_multiply(void) { return 1; }
static inline void set_up_products(void) {}
static inline void tear_down_products(void) {}

SEPARATE void multiply(const half *rows, long width, long count, const half *weights, long inputs, long outputs,
                            real *to, long stride, int adds) {
    for (long top = 0; top < count; top += TILE) {
        for (long column = 0; column < outputs; column += TILE) {
            const half *tiles = weights + column * inputs;
            real *place = to + top * stride + column;
            __m512 sums[TILE];
            for (int r = 0; r < TILE; r++) sums[r] = adds ? _mm512_loadu_ps(place + r * stride) : _mm512_setzero_ps();
            for (long k = 0; k < inputs; k += 2) {
                __m512i pairs = _mm512_loadu_si512(tiles + k * TILE);
                for (int r = 0; r < TILE; r++) {
                    int32_t pair;
                    memcpy(&pair, rows + (top + r) * width + k, sizeof pair);
                    sums[r] = _mm512_dpbf16_ps(sums[r], (__m512bh)_mm512_set1_epi32(pair), (__m512bh)pairs);
                }
            }
            for (int r = 0; r < TILE; r++) _mm512_storeu_ps(place + r * stride, sums[r]);
        }
    }
}

#else

#define ROWS_AT_ONCE 4

static inline int can_multiply(void) { return 1; }
static inline void set_up_products(void) {}
static inline void tear_down_products(void) {}

SEPARATE void multiply(const half *rows, long width, long count, const half *weights, long inputs, long outputs,
                            real *to, long stride, int adds) {
    for (long column = 0; column < outputs; column += TILE) {
        const half *tiles = weights + column * inputs;
        for (long top = 0; top < count; top += ROWS_AT_ONCE) {
            real sums[ROWS_AT_ONCE][TILE] = {{0}};
            for (int r = 0; adds && r < ROWS_AT_ONCE; r++)
                memcpy(sums[r], to + (top + r) * stride + column, sizeof sums[r]);
            for (long k = 0; k < inputs; k++)
                for (int r = 0; r < ROWS_AT_ONCE; r++) {
                    real value = rows[(top + r) * width + k];
                    VECTOR() for (int c = 0; c < TILE; c++) sums[r][c] += value * tiles[k * TILE + c];
                }
            for (int r = 0; r < ROWS_AT_ONCE; r++) memcpy(to + (top + r) * stride + column, sums[r], sizeof sums[r]);
        }
    }
}

#endif

#endif
