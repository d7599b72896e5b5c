// Convolutions over square grids that learn, each as one product of rows that hold the inputs of one output place.
// Grids are (y, x, channel) with a border of zeros that is one place wide.

#ifndef LATENTPLAN_CONVOLUTIONS_H
#define LATENTPLAN_CONVOLUTIONS_H

#include <omp.h>

#include "layers.h"

#define FRAME 64  // side of a frame in pixels
#define COLOURS 3

// The layer's weights are (output, kernel, kernel, channel); its inputs are kernel x kernel x channels.
typedef struct {
    Layer layer;
    long side, channels, kernel, stride;
} Convolution;

// Gradients of a layer, for each thread, side by side: of its weights (outputs padded to TILE, padded inputs), and of its bias.
typedef struct {
    real *weights, *shift;
} LayerGradients;

static inline long padded_to_tile(long size) { return (size + TILE - 1) / TILE * TILE; }
static inline long count_places(const Convolution *c) { return (c->side / c->stride) * (c->side / c->stride); }
static inline long grid_size(const Convolution *c) { return (c->side + 2) * (c->side + 2) * c->channels; }

// Takes the next part of working memory.
static half *take(char **place, long halves) {
    half *part = (half *)*place;
    *place += ((size_t)halves * sizeof(half) + 63) / 64 * 64;
    return part;
}

static real *take_real(char **place, long reals) {
    return (real *)take(place, reals * (long)(sizeof(real) / sizeof(half)));
}

static void clear_rows(half *rows, long from, long until, long width) {
    if (until > from) memset(rows + from * width, 0, (size_t)((until - from) * width) * sizeof(half));
}

// Where a place of a grid begins, without its border.
static inline long place_in_grid(const Convolution *c, long place) {
    return ((place / c->side + 1) * (c->side + 2) + place % c->side + 1) * c->channels;
}

// Writes the inputs of every output place to a row.
static void fill_rows(half *to, const half *grid, const Convolution *c) {
    long side = c->side / c->stride, width = padded(c->layer.inputs), strip = c->kernel * c->channels;
    for (long place = 0; place < side * side; place++) {
        const half *from = grid + ((place / side) * (c->side + 2) + place % side) * c->stride * c->channels;
        for (long y = 0; y < c->kernel; y++)
            memcpy(to + place * width + y * strip, from + y * (c->side + 2) * c->channels, (size_t)strip * sizeof(half));
        clear_row(to + place * width, c->layer.inputs, width);
    }
}

// Adds the gradients of these inputs to the gradient of the grid.
static void add_rows(real *grid, const real *from, const Convolution *c) {
    long side = c->side / c->stride, width = padded(c->layer.inputs), strip = c->kernel * c->channels;
    for (long place = 0; place < side * side; place++) {
        real *to = grid + ((place / side) * (c->side + 2) + place % side) * c->stride * c->channels;
        for (long y = 0; y < c->kernel; y++) {
            real *row = to + y * (c->side + 2) * c->channels;
            const real *gradient = from + place * width + y * strip;
            FOR_LANES(i, strip) store(row + i, load(row + i, strip - i) + load(gradient + i, strip - i), strip - i);
        }
    }
}

// Adds the bias to a product, keeps the sum, and writes its SiLU.
static inline void activate(half *to, half *kept, const real *product, const real *bias, long length) {
    FOR_LANES(i, length) {
        long left = length - i;
        wide sum = load(product + i, left) + load(bias + i, left);
        store_half(kept + i, sum, left);
        store_half(to + i, sum * sigmoid_of(sum), left);
    }
}

// Writes the SiLU of kept sums, and its slope.
static inline void activate_again(half *to, real *slope, const half *kept, long length) {
    FOR_LANES(i, length) {
        wide value = load_half(kept + i, length - i), gate = sigmoid_of(value);
        store_half(to + i, value * gate, length - i);
        store(slope + i, gate * (1 + value * (1 - gate)), length - i);
    }
}

// Writes the products of two rows.
static inline void multiply_row(half *to, const real *left, const real *right, long length) {
    FOR_LANES(i, length) store_half(to + i, load(left + i, length - i) * load(right + i, length - i), length - i);
}

// Passes the gradient of a grid through the SiLU before it, whose slopes are given, to rows of `stride` numbers.
static void grid_back(half *to, const real *of_grid, const real *slopes, const Convolution *c, long stride) {
    for (long place = 0; place < c->side * c->side; place++) {
        const real *gradient = of_grid + place_in_grid(c, place), *slope = slopes + place * c->channels;
        multiply_row(to + place * stride, gradient, slope, c->channels);
        clear_row(to + place * stride, c->channels, stride);
    }
}

// Writes the activations of a grid from kept sums, and their slopes.
static void fill_grid(half *grid, real *slopes, const half *kept, const Convolution *c) {
    for (long place = 0; place < c->side * c->side; place++)
        activate_again(grid + place_in_grid(c, place), slopes + place * c->channels, kept + place * c->channels, c->channels);
}

#if PAIR == 2

static inline void turn_8(half *to, long to_width, const half *from, long from_width) {
    __m128i r[8], s[8];
    for (int i = 0; i < 8; i++) r[i] = _mm_loadu_si128((const __m128i *)(from + i * from_width));
    for (int i = 0; i < 4; i++) {
        s[2 * i] = _mm_unpacklo_epi16(r[i], r[i + 4]);
        s[2 * i + 1] = _mm_unpackhi_epi16(r[i], r[i + 4]);
    }
    for (int i = 0; i < 4; i++) {
        r[2 * i] = _mm_unpacklo_epi16(s[i], s[i + 4]);
        r[2 * i + 1] = _mm_unpackhi_epi16(s[i], s[i + 4]);
    }
    for (int i = 0; i < 4; i++) {
        s[2 * i] = _mm_unpacklo_epi16(r[i], r[i + 4]);
        s[2 * i + 1] = _mm_unpackhi_epi16(r[i], r[i + 4]);
    }
    for (int i = 0; i < 8; i++) _mm_storeu_si128((__m128i *)(to + i * to_width), s[i]);
}

#else

static inline void turn_8(half *to, long to_width, const half *from, long from_width) {
    for (int y = 0; y < 8; y++)
        for (int x = 0; x < 8; x++) to[x * to_width + y] = from[y * from_width + x];
}

#endif

// Packs inputs (rows, padded size) as the weights of a product over the rows.
static void pack_rows(half *to, const half *from, long rows, long size) {
    for (long r = 0; r < rows; r += PAIR)
        for (long tile = 0; tile < size; tile += TILE) {
            half *place = to + tile * rows + r * TILE;
            const half *row = from + r * size + tile;
            VECTOR() for (long i = 0; i < TILE; i++)
                for (long p = 0; p < PAIR; p++) place[i * PAIR + p] = row[p * size + i];
        }
}

// Memory that `accumulate` needs for rows of a layer.
static inline long scratch_size(const Layer *layer, long rows) {
    return rows * (padded(layer->inputs) + padded_to_tile(layer->outputs));
}

// Adds the gradients of a layer, given the gradients of its outputs and its inputs at some rows (rows, padded size).
// The number of rows is a multiple of MULTIPLE; rows that are not used are zero.
static void accumulate(const LayerGradients *to, const Layer *layer, const half *of_outputs, const half *inputs,
                       long rows, half *scratch) {
    long width = padded(layer->inputs), height = padded_to_tile(layer->outputs), outputs = padded(layer->outputs);
    half *turned = scratch, *packed = scratch + height * rows;
    for (long n = 0; n < height; n += 8)
        for (long r = 0; r < rows; r += 8) turn_8(turned + n * rows + r, rows, of_outputs + r * outputs + n, outputs);
    pack_rows(packed, inputs, rows, width);
    multiply(turned, rows, height, packed, rows, width, to->weights, width, 1);
    FOR_LANES(i, layer->outputs) {
        long left = layer->outputs - i;
        wide sum = load(to->shift + i, left);
        for (long r = 0; r < rows; r++) sum += load_half(of_outputs + r * outputs + i, left);
        store(to->shift + i, sum, left);
    }
}

// The gradients that this thread adds to.
static LayerGradients of_thread(const LayerGradients *g, const Layer *layer) {
    long thread = omp_get_thread_num(), size = padded_to_tile(layer->outputs) * padded(layer->inputs);
    return (LayerGradients){g->weights + thread * size, g->shift + thread * layer->outputs};
}

#endif
