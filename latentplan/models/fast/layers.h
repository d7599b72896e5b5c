// Layers of a network that learns: packing of weights, and the layer norm with its gradient.

#ifndef LATENTPLAN_LAYERS_H
#define LATENTPLAN_LAYERS_H

#include <stdlib.h>

#include "wide.h"

#define BLOCK 32         // rows that a thread computes before the next rows
#define LONGEST_ROW 4096

// A linear layer as torch stores it: weights (outputs, inputs). `scale` and `shift` belong to the norm after it; in an
// output layer `scale` is NULL and `shift` is the bias.
typedef struct {
    const real *weights, *scale, *shift;
    long inputs, outputs;
} Layer;

static void *allocate(size_t size) { return aligned_alloc(64, (size + 63) / 64 * 64); }

static inline size_t packed_size(const Layer *layer) {
    return (size_t)(padded(layer->inputs) * padded(layer->outputs)) * sizeof(half);
}

static inline void write_row(half *to, const real *from, long length) {
    FOR_LANES(i, length) store_half(to + i, load(from + i, length - i), length - i);
}

static inline void read_row(real *to, const half *from, long length) {
    FOR_LANES(i, length) store(to + i, load_half(from + i, length - i), length - i);
}

static inline void clear_row(half *to, long from, long until) {
    for (long i = from; i < until; i++) to[i] = 0;
}

// Packs TILE outputs, whose weights lie in the rows of `from`, for `multiply`.
static void interleave(half *to, half (*from)[LONGEST_ROW], long inputs) {
    for (long k = 0; k < inputs; k += PAIR)
        for (int column = 0; column < TILE; column++)
            memcpy(to + (k * TILE + column * PAIR), from[column] + k, PAIR * sizeof(half));
}

// Packs the weights for products with the layer's inputs. With `is_error`, packs what rounding took from the weights.
static void pack(half *to, const Layer *layer, int is_error) {
    long inputs = padded(layer->inputs), outputs = padded(layer->outputs);
    half rows[TILE][LONGEST_ROW];
    for (long tile = 0; tile < outputs; tile += TILE) {
        for (long r = 0; r < TILE; r++) {
            clear_row(rows[r], tile + r < layer->outputs ? layer->inputs : 0, inputs);
            if (tile + r >= layer->outputs) continue;
            const real *weights = layer->weights + (tile + r) * layer->inputs;
            VECTOR() for (long k = 0; k < layer->inputs; k++) {
                half rounded = write_half(weights[k]);
                rows[r][k] = is_error ? write_half(weights[k] - read_half(rounded)) : rounded;
            }
        }
        interleave(to + tile * inputs, rows, inputs);
    }
}

// Packs the weights for products with gradients of the layer's outputs.
static void pack_back(half *to, const Layer *layer) {
    long inputs = padded(layer->inputs), outputs = padded(layer->outputs);
    for (long tile = 0; tile < inputs; tile += TILE) {
        half *place = to + tile * outputs;
        long columns = layer->inputs - tile < TILE ? layer->inputs - tile : TILE;
        memset(place, 0, (size_t)(TILE * outputs) * sizeof(half));
        for (long k = 0; k < layer->outputs; k++) {
            const real *weights = layer->weights + k * layer->inputs + tile;
            half *row = place + k / PAIR * PAIR * TILE + k % PAIR;
            for (long column = 0; column < columns; column++) row[column * PAIR] = write_half(weights[column]);
        }
    }
}

// SiLU of the layer norm of a row.
static inline void norm_silu(half *to, const real *row, const Layer *layer) {
    long length = layer->outputs;
    Norm norm = compute_norm(row, layer->scale, layer->shift, length);
    FOR_LANES(i, length) {
        wide scaled = normed_of(&norm, i, length);
        store_half(to + i, scaled * sigmoid_of(scaled), length - i);
    }
}

// The gradient of a row before its norm, given the gradient of the scaled norm in `of_scaled`, which is overwritten.
// Adds the gradients of scale and shift to `sums`, which holds them side by side.
static inline void norm_back(half *to, real *of_scaled, const Norm *norm, long length, real *sums) {
    wide totals = {0}, alongs = {0};
    FOR_LANES(i, length) {
        long left = length - i;
        wide centred = (load(norm->row + i, left) - norm->mean) * norm->factor, gradient = load(of_scaled + i, left);
        store(sums + i, load(sums + i, left) + gradient * centred, left);
        store(sums + length + i, load(sums + length + i, left) + gradient, left);
        gradient *= load(norm->scale + i, left);
        store(of_scaled + i, gradient, left);
        totals += gradient;
        alongs += gradient * centred;
    }
    real total = sum_of(totals) / (real)length, along = sum_of(alongs) / (real)length;
    FOR_LANES(i, length) {
        long left = length - i;
        wide centred = (load(norm->row + i, left) - norm->mean) * norm->factor;
        store_half(to + i, norm->factor * (load(of_scaled + i, left) - total - centred * along), left);
    }
}

// The gradient of a row before norm and SiLU, given the gradient of the result.
static inline void norm_silu_back(half *to, const real *gradient, const real *row, const Layer *layer, real *sums) {
    long length = layer->outputs;
    real of_scaled[LONGEST_ROW];
    Norm norm = compute_norm(row, layer->scale, layer->shift, length);
    FOR_LANES(i, length) {
        wide scaled = normed_of(&norm, i, length), gate = sigmoid_of(scaled);
        store(of_scaled + i, load(gradient + i, length - i) * gate * (1 + scaled * (1 - gate)), length - i);
    }
    norm_back(to, of_scaled, &norm, length, sums);
}

// Adds the sums of all blocks, in the order of the blocks, so that results do not depend on the number of threads.
static inline void add_blocks(real *to, const real *sums, long blocks, long length) {
    for (long block = 0; block < blocks; block++)
        for (long i = 0; i < length; i++) to[i] += sums[block * length + i];
}

#endif
