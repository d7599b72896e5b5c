// Heads that learn: networks of two normed hidden layers, distributions over scalars, and returns, with gradients.

#include "layers.h"

typedef struct {
    Layer first, second, output;
    long rows;
    const real *features;  // (rows, inputs)
    real *results;         // (rows, outputs)
    // Written, and read by the backward pass, with padded sizes: sums before the norms, and the inputs of the layers.
    // The inputs are NULL if the weights need no gradient.
    half *products, *last_products, *inputs, *hidden, *last;
} Network;

// `norms` holds the gradients of scale and shift of the first and the second layer, side by side. The factors of the
// weights' gradients are NULL if the weights need none.
typedef struct {
    const real *of_results;
    half *of_output, *of_second, *of_first;
    real *of_features, *norms;  // `of_features` may be NULL
} Gradients;

static void pack_network(half *places[4], const Network *n, half *memory, int is_back) {
    const Layer *layers[] = {&n->first, &n->second, &n->output};
    for (int i = 0; i < 3; i++) {
        places[i] = memory;
        if (is_back) pack_back(memory, layers[i]);
        else pack(memory, layers[i], 0);
        memory += packed_size(layers[i]) / sizeof(half);
    }
    places[3] = memory;
    if (!is_back) pack(memory, &n->output, 1);
}

static half *allocate_network(const Network *n) {
    return allocate(packed_size(&n->first) + packed_size(&n->second) + 2 * packed_size(&n->output));
}

// Keeps the sums of a layer, and writes the SiLU of their norm.
static void hide(half *to, half *kept, const real *sums, const Layer *layer, long count) {
    long outputs = padded(layer->outputs);
    for (long r = 0; r < count; r++) {
        write_row(kept + r * outputs, sums + r * outputs, layer->outputs);
        norm_silu(to + r * outputs, sums + r * outputs, layer);
        clear_row(to + r * outputs, layer->outputs, outputs);
    }
}

static void apply_block(const Network *n, half *const weights[4], long from, long count) {
    long inputs = padded(n->first.inputs), hidden = padded(n->first.outputs), last = padded(n->second.outputs);
    long outputs = padded(n->output.outputs), widest = larger(hidden, larger(last, outputs));
    real sums[BLOCK * widest], error[BLOCK * outputs];
    half own_rows[BLOCK * inputs], own_middle[BLOCK * hidden], own_end[BLOCK * last];
    half *rows = n->inputs == NULL ? own_rows : n->inputs + from * inputs;
    half *middle = n->inputs == NULL ? own_middle : n->hidden + from * hidden;
    half *end = n->inputs == NULL ? own_end : n->last + from * last;
    for (long r = 0; r < count; r++) {
        write_row(rows + r * inputs, n->features + (from + r) * n->first.inputs, n->first.inputs);
        clear_row(rows + r * inputs, n->first.inputs, inputs);
    }
    multiply(rows, inputs, count, weights[0], inputs, hidden, sums, hidden, 0);
    hide(middle, n->products + from * hidden, sums, &n->first, count);
    multiply(middle, hidden, count, weights[1], hidden, last, sums, last, 0);
    hide(end, n->last_products + from * last, sums, &n->second, count);
    multiply(end, last, count, weights[2], last, outputs, sums, outputs, 0);
    // The last layer is as precise as its inputs: a second product has what rounding took from the weights.
    multiply(end, last, count, weights[3], last, outputs, error, outputs, 0);
    for (long r = 0; r < count; r++) {
        real *row = n->results + (from + r) * n->output.outputs;
        VECTOR() for (long i = 0; i < n->output.outputs; i++)
            row[i] = sums[r * outputs + i] + error[r * outputs + i] + n->output.shift[i];
    }
}

// Passes gradients through the SiLU and the norm of a layer, whose sums were kept.
static void hide_back(half *to, const real *gradient, const half *kept, const Layer *layer, real *sums, long count) {
    long outputs = padded(layer->outputs);
    for (long r = 0; r < count; r++) {
        real row[LONGEST_ROW];
        read_row(row, kept + r * outputs, layer->outputs);
        norm_silu_back(to + r * outputs, gradient + r * outputs, row, layer, sums);
        clear_row(to + r * outputs, layer->outputs, outputs);
    }
}

static void apply_block_back(const Network *n, const Gradients *g, half *const weights[4], real *sums, long from,
                             long count) {
    long inputs = padded(n->first.inputs), hidden = padded(n->first.outputs), last = padded(n->second.outputs);
    long outputs = padded(n->output.outputs);
    real gradient[BLOCK * larger(inputs, larger(hidden, last))];
    half own_output[BLOCK * outputs], own_second[BLOCK * last], own_first[BLOCK * hidden];
    half *of_output = n->inputs == NULL ? own_output : g->of_output + from * outputs;
    half *of_second = n->inputs == NULL ? own_second : g->of_second + from * last;
    half *of_first = n->inputs == NULL ? own_first : g->of_first + from * hidden;
    for (long r = 0; r < count; r++) {
        write_row(of_output + r * outputs, g->of_results + (from + r) * n->output.outputs, n->output.outputs);
        clear_row(of_output + r * outputs, n->output.outputs, outputs);
    }
    multiply(of_output, outputs, count, weights[2], outputs, last, gradient, last, 0);
    hide_back(of_second, gradient, n->last_products + from * last, &n->second, sums + 2 * n->first.outputs, count);
    multiply(of_second, last, count, weights[1], last, hidden, gradient, hidden, 0);
    hide_back(of_first, gradient, n->products + from * hidden, &n->first, sums, count);
    if (g->of_features == NULL) return;
    multiply(of_first, hidden, count, weights[0], hidden, inputs, gradient, inputs, 0);
    for (long r = 0; r < count; r++)
        memcpy(g->of_features + (from + r) * n->first.inputs, gradient + r * inputs,
               (size_t)n->first.inputs * sizeof(real));
}

static inline long count_rows(const Network *n, long block) {
    return n->rows - block * BLOCK < BLOCK ? n->rows - block * BLOCK : BLOCK;
}

#define PARALLEL PRAGMA(omp parallel for schedule(static) num_threads(threads < blocks ? threads : (int)blocks))
#define FOR_BLOCKS PARALLEL for (long block = 0; block < blocks; block++)

// The outputs at all rows. Returns 0, or 1 if memory could not be allocated.
int apply_network(const Network *n, int threads) {
    long blocks = (n->rows + BLOCK - 1) / BLOCK;
    half *memory = allocate_network(n), *weights[4];
    if (memory == NULL) return 1;
    pack_network(weights, n, memory, 0);
    FOR_BLOCKS {
        set_up_products();
        apply_block(n, weights, block * BLOCK, count_rows(n, block));
        tear_down_products();
    }
    free(memory);
    return 0;
}

// The gradients at all rows. Returns 0, or 1 if memory could not be allocated.
int apply_network_back(const Network *n, const Gradients *g, int threads) {
    long blocks = (n->rows + BLOCK - 1) / BLOCK, length = 2 * (n->first.outputs + n->second.outputs);
    half *memory = allocate_network(n), *weights[4];
    real *sums = calloc((size_t)(blocks * length), sizeof(real));
    int failed = memory == NULL || sums == NULL;
    if (!failed) {
        pack_network(weights, n, memory, 1);
        FOR_BLOCKS {
            set_up_products();
            apply_block_back(n, g, weights, sums + block * length, block * BLOCK, count_rows(n, block));
            tear_down_products();
        }
        add_blocks(g->norms, sums, blocks, length);
    }
    free(sums);
    free(memory);
    return failed;
}

// Writes the probabilities of a row of logits, and returns the logarithm of the sum that divides them.
static real softmax(real *to, const real *logits, long size) {
    real highest = -INFINITY, sum = 0;
    for (long i = 0; i < size; i++) highest = logits[i] > highest ? logits[i] : highest;
    VECTOR(reduction(+ : sum)) for (long i = 0; i < size; i++) sum += to[i] = exponential(logits[i] - highest);
    VECTOR() for (long i = 0; i < size; i++) to[i] /= sum;
    return highest + logarithm(sum);
}

// The mean of the values under the softmax of each row, and, if `of_logits` is not NULL, the mean's gradients.
void mean_of_bins(const real *logits, const real *values, real *means, real *of_logits, long rows, long size) {
    for (long r = 0; r < rows; r++) {
        real shares[LONGEST_ROW], mean = 0;
        softmax(shares, logits + r * size, size);
        VECTOR(reduction(+ : mean)) for (long i = 0; i < size; i++) mean += shares[i] * values[i];
        means[r] = mean;
        if (of_logits != NULL)
            VECTOR() for (long i = 0; i < size; i++) of_logits[r * size + i] = shares[i] * (values[i] - mean);
    }
}

// The first place in [1, size) of rising values at which the value is not below the target.
static long place_of(const real *values, real target, long size) {
    long low = 1, high = size - 1;
    while (low < high) {
        long middle = (low + high) / 2;
        if (values[middle] < target) low = middle + 1;
        else high = middle;
    }
    return low;
}

// The cross-entropy of each row to the two bins around its target, and its gradients.
void cross_entropy(const real *logits, const real *values, const real *targets, real *losses, real *of_logits, long rows,
                   long size) {
    for (long r = 0; r < rows; r++) {
        const real *row = logits + r * size;
        real *gradient = of_logits + r * size;
        long place = place_of(values, targets[r], size);
        real above = (targets[r] - values[place - 1]) / (values[place] - values[place - 1]);
        above = above < 0 ? 0 : above > 1 ? 1 : above;
        real log_sum = softmax(gradient, row, size);
        losses[r] = log_sum - (1 - above) * row[place - 1] - above * row[place];
        gradient[place - 1] -= 1 - above;
        gradient[place] -= above;
    }
}

// Lambda-returns (steps, rows); `following` are the values after the last step.
void lambda_return(const real *rewards, const real *discounts, const real *values, double lambda, real *returns, long steps,
                   long rows) {
    const real *following = values + (steps - 1) * rows;
    real longer = (real)lambda, shorter = (real)(1 - lambda);
    for (long step = steps - 1; step >= 0; step--) {
        long at = step * rows;
        VECTOR() for (long r = 0; r < rows; r++)
            returns[at + r] = rewards[at + r] + discounts[at + r] * (shorter * values[at + r] + longer * following[r]);
        following = returns + at;
    }
}

// The gradients of rewards, discounts and values, given those of the returns.
void lambda_return_back(const real *discounts, const real *values, const real *returns, double lambda, const real *gradient,
                        real *of_rewards, real *of_discounts, real *of_values, long steps, long rows) {
    real longer = (real)lambda, shorter = (real)(1 - lambda);
    for (long step = 0; step < steps; step++) {
        long at = step * rows, last = step == steps - 1;
        const real *following = last ? values + at : returns + at + rows;
        VECTOR() for (long r = 0; r < rows; r++) {
            long i = at + r;
            real passed = step == 0 ? 0 : longer * discounts[i - rows] * of_rewards[i - rows];
            of_rewards[i] = gradient[i] + passed;
            of_discounts[i] = of_rewards[i] * (shorter * values[i] + longer * following[r]);
            of_values[i] = of_rewards[i] * discounts[i] * (last ? 1 : shorter);
        }
    }
}
