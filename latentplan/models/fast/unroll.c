// The RSSM over whole sequences, and its gradients. A thread computes all steps of one block of rows before the next
// block, so that its working memory stays in the core's cache. The gradients of weights are left to one product over
// all steps, whose factors these functions write. Arrays are (step, row, size); arrays of `half` have padded sizes.

#include "layers.h"

typedef struct {
    Layer input, gates, hidden, output;  // of the GRU, then from deter to the latent (prior or posterior)
    Layer actor[3];                      // the policy of imagined steps
    long rows, steps, action, latent, deter;
    long has_frames;  // the first step then has a frame and no action; else it takes an action from the start
    long keeps_inputs;  // the weights need gradients
    long has_actor;   // the actor then chooses the actions, for the draws in `action_noise`
    double decay;     // share of a state's gradient that a step passes back to the step before
    // Read. `embeddings` (without frames) and `noise` (for the mean of the latent) may be NULL.
    const real *start_deter, *start_stoch, *embeddings, *noise, *action_noise;
    real *actions;  // written by the actor
    // Written, and read by the backward pass. Rows of deters and stochs begin `state_stride` numbers apart.
    long state_stride[2];
    real *deters, *stochs, *means, *stds;
    half *first, *gate_products, *second, *raw;       // sums before the norms, and of the output
    half *inputs, *gate_inputs, *afters, *hiddens;    // inputs of the layers, of one step if not `keeps_inputs`
} Unroll;

// Gradients of the results, any of which may be NULL; then what the backward pass writes. `norms` holds the gradients
// of scale and shift of input, gates and hidden, side by side.
typedef struct {
    long state_stride[2];  // of the gradients of deters and stochs
    const real *of_deters, *of_stochs, *of_means, *of_stds;
    half *of_first, *of_gates, *of_second, *of_raw;
    real *of_actions, *of_embeddings, *norms;
} Gradients;

typedef struct {
    half *input, *gates, *hidden, *output, *actor[3], *actor_error;
} Weights;

// Rows of one block, from `first` on.
typedef struct {
    const Unroll *unroll;
    const Weights *weights;
    long first, count;
} Block;

static inline long row_of(const Block *block, long step, long r) { return step * block->unroll->rows + block->first + r; }

// The row of inputs and of factors of gradients, which only the weights need at every step.
static inline long input_row_of(const Block *block, long step) {
    return row_of(block, block->unroll->keeps_inputs ? step : 0, 0);
}

static const real *deter_before(const Block *block, long step, long r) {
    const Unroll *u = block->unroll;
    return step > 0 ? u->deters + row_of(block, step - 1, r) * u->state_stride[0]
                    : u->start_deter + (block->first + r) * u->deter;
}

static const real *stoch_before(const Block *block, long step, long r) {
    const Unroll *u = block->unroll;
    return step > 0 ? u->stochs + row_of(block, step - 1, r) * u->state_stride[1]
                    : u->start_stoch + (block->first + r) * u->latent;
}

static void apply(const Block *block, const half *rows, const half *weights, const Layer *layer, real *to) {
    long inputs = padded(layer->inputs), outputs = padded(layer->outputs);
    multiply(rows, inputs, block->count, weights, inputs, outputs, to, outputs, 0);
}

// Writes the actions of a step, a sample of the actor.
static void act(const Block *block, long step) {
    const Unroll *u = block->unroll;
    long features = padded(u->actor[0].inputs), hidden = padded(u->actor[0].outputs);
    long outputs = padded(u->actor[2].outputs), size = u->actor[2].outputs / 2;
    half rows[BLOCK * features], layer[BLOCK * hidden];
    real product[BLOCK * hidden], raw[BLOCK * outputs], error[BLOCK * outputs];
    for (long r = 0; r < block->count; r++) {
        half *row = rows + r * features;
        write_row(row, deter_before(block, step, r), u->deter);
        write_row(row + u->deter, stoch_before(block, step, r), u->latent);
        clear_row(row, u->deter + u->latent, features);
        clear_row(layer + r * hidden, u->actor[0].outputs, hidden);
    }
    apply(block, rows, block->weights->actor[0], &u->actor[0], product);
    for (long r = 0; r < block->count; r++) norm_silu(layer + r * hidden, product + r * hidden, &u->actor[0]);
    apply(block, layer, block->weights->actor[1], &u->actor[1], product);
    for (long r = 0; r < block->count; r++) norm_silu(layer + r * hidden, product + r * hidden, &u->actor[1]);
    apply(block, layer, block->weights->actor[2], &u->actor[2], raw);
    apply(block, layer, block->weights->actor_error, &u->actor[2], error);
    for (long r = 0; r < block->count; r++) {
        long place = row_of(block, step, r) * size;
        for (long i = 0; i < size; i++) {
            long at = r * outputs + i, spread = at + size;
            real std = raw[spread] + error[spread] + u->actor[2].shift[size + i];
            std = (real)0.9 * sigmoid(std + 2) + (real)0.1;
            real mean = hyperbolic_tangent(raw[at] + error[at] + u->actor[2].shift[i]);
            real action = mean + std * u->action_noise[place + i];
            u->actions[place + i] = action > 1 ? 1 : action < -1 ? -1 : action;
        }
    }
}

// The part `chunk` of the gates' norm, from place i of `size` on.
static inline wide gate_of(const Norm *norm, long chunk, long i, long size) {
    long at = chunk * size;
    Norm part = {norm->row + at, norm->scale + at, norm->shift + at, norm->mean, norm->factor};
    return normed_of(&part, i, size);
}

// The next state of the GRU.
static inline void update_row(real *after, const Norm *norm, const real *before, long size) {
    FOR_LANES(i, size) {
        wide candidate = tanh_of(sigmoid_of(gate_of(norm, 0, i, size)) * gate_of(norm, 1, i, size));
        wide update = sigmoid_of(gate_of(norm, 2, i, size) - 1), old = load(before + i, size - i);
        store(after + i, old + update * (candidate - old), size - i);
    }
}

// The deters of a step, the `index`th with an action.
static void advance(const Block *block, long step, long index) {
    const Unroll *u = block->unroll;
    long inputs = padded(u->input.inputs), hidden = padded(u->input.outputs);
    long gate_inputs = padded(u->gates.inputs), gates = padded(u->gates.outputs);
    half *input_rows = u->inputs + input_row_of(block, index) * inputs;
    half *gate_rows = u->gate_inputs + input_row_of(block, index) * gate_inputs;
    real first[BLOCK * hidden], products[BLOCK * gates];
    for (long r = 0; r < block->count; r++) {
        half *row = input_rows + r * inputs;
        write_row(row, stoch_before(block, step, r), u->latent);
        write_row(row + u->latent, u->actions + row_of(block, index, r) * u->action, u->action);
        clear_row(row, u->latent + u->action, inputs);
    }
    apply(block, input_rows, block->weights->input, &u->input, first);
    for (long r = 0; r < block->count; r++) {
        half *row = gate_rows + r * gate_inputs;
        write_row(u->first + row_of(block, index, r) * hidden, first + r * hidden, u->input.outputs);
        norm_silu(row, first + r * hidden, &u->input);
        write_row(row + u->input.outputs, deter_before(block, step, r), u->deter);
        clear_row(row, u->gates.inputs, gate_inputs);
    }
    apply(block, gate_rows, block->weights->gates, &u->gates, products);
    for (long r = 0; r < block->count; r++) {
        const real *before = deter_before(block, step, r);
        real *after = u->deters + row_of(block, step, r) * u->state_stride[0];
        write_row(u->gate_products + row_of(block, index, r) * gates, products + r * gates, u->gates.outputs);
        Norm norm = compute_norm(products + r * gates, u->gates.scale, u->gates.shift, u->gates.outputs);
        update_row(after, &norm, before, u->deter);
    }
}

// The latents of a step, given its deters.
static void read_latent(const Block *block, long step) {
    const Unroll *u = block->unroll;
    long deter = padded(u->deter), hidden = padded(u->hidden.outputs), outputs = padded(u->output.outputs);
    half *afters = u->afters + input_row_of(block, step) * deter;
    half *hiddens = u->hiddens + input_row_of(block, step) * hidden;
    real second[BLOCK * hidden], raw[BLOCK * outputs];
    for (long r = 0; r < block->count; r++) {
        write_row(afters + r * deter, u->deters + row_of(block, step, r) * u->state_stride[0], u->deter);
        clear_row(afters + r * deter, u->deter, deter);
    }
    apply(block, afters, block->weights->hidden, &u->hidden, second);
    for (long r = 0; r < block->count; r++) {
        real *row = second + r * hidden;
        if (u->embeddings != NULL) {
            const real *embedding = u->embeddings + row_of(block, step, r) * u->hidden.outputs;
            VECTOR() for (long i = 0; i < u->hidden.outputs; i++) row[i] += embedding[i];
        }
        write_row(u->second + row_of(block, step, r) * hidden, row, u->hidden.outputs);
        norm_silu(hiddens + r * hidden, row, &u->hidden);
        clear_row(hiddens + r * hidden, u->hidden.outputs, hidden);
    }
    apply(block, hiddens, block->weights->output, &u->output, raw);
    for (long r = 0; r < block->count; r++) {
        real *row = raw + r * outputs;
        long place = row_of(block, step, r) * u->latent;
        real *stoch = u->stochs + row_of(block, step, r) * u->state_stride[1];
        VECTOR() for (long i = 0; i < 2 * u->latent; i++) row[i] += u->output.shift[i];
        write_row(u->raw + row_of(block, step, r) * outputs, row, 2 * u->latent);
        VECTOR() for (long i = 0; i < u->latent; i++) {
            real std = 2 * sigmoid(row[u->latent + i] / 2) + (real)0.1;
            u->means[place + i] = row[i];
            u->stds[place + i] = std;
            stoch[i] = row[i] + (u->noise == NULL ? 0 : std * u->noise[place + i]);
        }
    }
}

// The working memory of the backward pass of one block: gradients that a step passes to the step before.
typedef struct {
    real *of_hidden, *of_deter, *of_gate_inputs, *of_inputs, *directly, *sums;
} Passed;

// Writes the gradients of a step's deters through its latents, (count, padded deter), to `of_deter`.
static void read_latent_back(const Block *block, const Gradients *g, Passed *passed, long step, int has_later) {
    const Unroll *u = block->unroll;
    long deter = padded(u->deter), hidden = padded(u->hidden.outputs), outputs = padded(u->output.outputs);
    long inputs = padded(u->input.inputs);
    half *of_raw = g->of_raw + input_row_of(block, step) * outputs;
    half *of_second = g->of_second + input_row_of(block, step) * hidden;
    for (long r = 0; r < block->count; r++) {
        long place = row_of(block, step, r) * u->latent;
        const half *raw = u->raw + row_of(block, step, r) * outputs;
        const real *outer = g->of_stochs == NULL ? NULL : g->of_stochs + row_of(block, step, r) * g->state_stride[1];
        half *row = of_raw + r * outputs;
        VECTOR() for (long i = 0; i < u->latent; i++) {
            real gate = sigmoid(read_half(raw[u->latent + i]) / 2);
            real of_stoch = outer == NULL ? 0 : outer[i];
            if (has_later) of_stoch += (real)u->decay * passed->of_inputs[r * inputs + i];
            real of_std = u->noise == NULL ? 0 : of_stoch * u->noise[place + i];
            if (g->of_stds != NULL) of_std += g->of_stds[place + i];
            row[i] = write_half(of_stoch + (g->of_means == NULL ? 0 : g->of_means[place + i]));
            row[u->latent + i] = write_half(of_std * gate * (1 - gate));
        }
        clear_row(row, 2 * u->latent, outputs);
    }
    multiply(of_raw, outputs, block->count, block->weights->output, outputs, hidden, passed->of_hidden, hidden, 0);
    for (long r = 0; r < block->count; r++) {
        real second[LONGEST_ROW];
        read_row(second, u->second + row_of(block, step, r) * hidden, u->hidden.outputs);
        half *row = of_second + r * hidden;
        real *sums = passed->sums + 2 * (u->input.outputs + u->gates.outputs);
        norm_silu_back(row, passed->of_hidden + r * hidden, second, &u->hidden, sums);
        clear_row(row, u->hidden.outputs, hidden);
        if (g->of_embeddings != NULL) {
            real *to = g->of_embeddings + row_of(block, step, r) * u->hidden.outputs;
            VECTOR() for (long i = 0; i < u->hidden.outputs; i++) to[i] = read_half(row[i]);
        }
    }
    multiply(of_second, hidden, block->count, block->weights->hidden, hidden, deter, passed->of_deter, deter, 0);
}

// The gradient of a row of gates; `gradient` is that of the next deter, and becomes the part that passes directly to
// the deter before.
static void gates_back(half *to, real *gradient, const real *before, const real *product, const Layer *layer, long size,
                       real *sums) {
    real of_scaled[LONGEST_ROW];
    Norm norm = compute_norm(product, layer->scale, layer->shift, layer->outputs);
    FOR_LANES(i, size) {
        long left = size - i;
        wide reset = sigmoid_of(gate_of(&norm, 0, i, size)), raw = gate_of(&norm, 1, i, size);
        wide update = sigmoid_of(gate_of(&norm, 2, i, size) - 1), candidate = tanh_of(reset * raw);
        wide of_next = load(gradient + i, left), inner = of_next * update * (1 - candidate * candidate);
        store(of_scaled + i, inner * raw * reset * (1 - reset), left);
        store(of_scaled + size + i, inner * reset, left);
        store(of_scaled + 2 * size + i, of_next * (candidate - load(before + i, left)) * update * (1 - update), left);
        store(gradient + i, of_next * (1 - update), left);
    }
    norm_back(to, of_scaled, &norm, 3 * size, sums);
}

// Passes the gradients of a step's deters to its inputs. `of_deter` holds the gradients through the latents.
static void advance_back(const Block *block, const Gradients *g, Passed *passed, long step, long index, int has_later) {
    const Unroll *u = block->unroll;
    long inputs = padded(u->input.inputs), hidden = padded(u->input.outputs), deter = padded(u->deter);
    long gate_inputs = padded(u->gates.inputs), gates = padded(u->gates.outputs);
    half *of_gates = g->of_gates + input_row_of(block, index) * gates;
    half *of_first = g->of_first + input_row_of(block, index) * hidden;
    for (long r = 0; r < block->count; r++) {
        real *direct = passed->directly + r * deter, *of_deter = passed->of_deter + r * deter;
        const real *later = passed->of_gate_inputs + r * gate_inputs + u->input.outputs;
        const real *outer = g->of_deters == NULL ? NULL : g->of_deters + row_of(block, step, r) * g->state_stride[0];
        VECTOR() for (long i = 0; i < u->deter; i++) {
            real gradient = of_deter[i] + (outer == NULL ? 0 : outer[i]);
            direct[i] = gradient + (has_later ? (real)u->decay * (direct[i] + later[i]) : 0);
        }
        real product[LONGEST_ROW];
        read_row(product, u->gate_products + row_of(block, index, r) * gates, u->gates.outputs);
        real *sums = passed->sums + 2 * u->input.outputs;
        gates_back(of_gates + r * gates, direct, deter_before(block, step, r), product, &u->gates, u->deter, sums);
        clear_row(of_gates + r * gates, 3 * u->deter, gates);
    }
    multiply(of_gates, gates, block->count, block->weights->gates, gates, gate_inputs, passed->of_gate_inputs,
             gate_inputs, 0);
    for (long r = 0; r < block->count; r++) {
        real first[LONGEST_ROW];
        read_row(first, u->first + row_of(block, index, r) * hidden, u->input.outputs);
        norm_silu_back(of_first + r * hidden, passed->of_gate_inputs + r * gate_inputs, first, &u->input, passed->sums);
        clear_row(of_first + r * hidden, u->input.outputs, hidden);
    }
    multiply(of_first, hidden, block->count, block->weights->input, hidden, inputs, passed->of_inputs, inputs, 0);
    if (g->of_actions != NULL)
        for (long r = 0; r < block->count; r++)
            memcpy(g->of_actions + row_of(block, index, r) * u->action, passed->of_inputs + r * inputs + u->latent,
                   (size_t)u->action * sizeof(real));
}

static void unroll_block(const Unroll *u, const Weights *weights, long first, long count) {
    Block block = {u, weights, first, count};
    for (long r = first; u->has_frames && r < first + count; r++)
        memcpy(u->deters + r * u->state_stride[0], u->start_deter + r * u->deter, (size_t)u->deter * sizeof(real));
    for (long step = 0; step < u->steps; step++) {
        if (u->has_actor) act(&block, step);
        if (step >= u->has_frames) advance(&block, step, step - u->has_frames);
        read_latent(&block, step);
    }
}

static int unroll_block_back(const Unroll *u, const Gradients *g, const Weights *weights, real *sums, long first,
                             long count) {
    Block block = {u, weights, first, count};
    long hidden = padded(u->hidden.outputs), deter = padded(u->deter);
    long gate_inputs = padded(u->gates.inputs), inputs = padded(u->input.inputs);
    real *memory = allocate((size_t)(BLOCK * (hidden + 2 * deter + gate_inputs + inputs)) * sizeof(real));
    if (memory == NULL) return 1;
    Passed passed = {.of_hidden = memory, .sums = sums};
    passed.of_deter = passed.of_hidden + BLOCK * hidden;
    passed.directly = passed.of_deter + BLOCK * deter;
    passed.of_gate_inputs = passed.directly + BLOCK * deter;
    passed.of_inputs = passed.of_gate_inputs + BLOCK * gate_inputs;
    for (long step = u->steps - 1; step >= 0; step--) {
        int has_later = step < u->steps - 1;
        read_latent_back(&block, g, &passed, step, has_later);
        if (step >= u->has_frames) advance_back(&block, g, &passed, step, step - u->has_frames, has_later);
    }
    free(memory);
    return 0;
}

#define FOR_BLOCKS(FAILED)                                                                              \
    PRAGMA(omp parallel for schedule(static) num_threads(threads < blocks ? threads : (int)blocks) reduction(| : FAILED)) \
    for (long block = 0; block < blocks; block++)

static inline long count_rows(const Unroll *u, long block) {
    return u->rows - block * BLOCK < BLOCK ? u->rows - block * BLOCK : BLOCK;
}

static const Layer *recurrent_layer(const Unroll *u, int i) {
    return (const Layer *[]){&u->input, &u->gates, &u->hidden, &u->output}[i];
}

static half *pack_recurrence(const Unroll *u, Weights *weights, int is_back) {
    size_t sizes[4], total = 0;
    for (int i = 0; i < 4; i++) total += sizes[i] = packed_size(recurrent_layer(u, i));
    half *memory = allocate(total), *place = memory;
    if (memory == NULL) return NULL;
    half **parts[] = {&weights->input, &weights->gates, &weights->hidden, &weights->output};
    for (int i = 0; i < 4; i++) {
        if (is_back) pack_back(place, recurrent_layer(u, i));
        else pack(place, recurrent_layer(u, i), 0);
        *parts[i] = place;
        place += sizes[i] / sizeof(half);
    }
    return memory;
}

static half *pack_actor(const Unroll *u, Weights *weights) {
    size_t total = packed_size(&u->actor[2]);
    for (int i = 0; i < 3; i++) total += packed_size(&u->actor[i]);
    half *memory = allocate(total), *place = memory;
    if (memory == NULL) return NULL;
    for (int i = 0; i < 3; i++) {
        pack(weights->actor[i] = place, &u->actor[i], 0);
        place += packed_size(&u->actor[i]) / sizeof(half);
    }
    pack(weights->actor_error = place, &u->actor[2], 1);
    return memory;
}

// Computes all steps. Returns 0, or 1 if memory could not be allocated.
int unroll(const Unroll *u, int threads) {
    long blocks = (u->rows + BLOCK - 1) / BLOCK;
    Weights weights = {0};
    half *recurrence = pack_recurrence(u, &weights, 0), *actor = u->has_actor ? pack_actor(u, &weights) : NULL;
    int failed = recurrence == NULL || (u->has_actor && actor == NULL);
    if (!failed) {
        FOR_BLOCKS(failed) {
            set_up_products();
            unroll_block(u, &weights, block * BLOCK, count_rows(u, block));
            tear_down_products();
        }
    }
    free(recurrence);
    free(actor);
    return failed;
}

// Computes the gradients of all steps. Returns 0, or 1 if memory could not be allocated.
int unroll_back(const Unroll *u, const Gradients *g, int threads) {
    long blocks = (u->rows + BLOCK - 1) / BLOCK;
    long length = 2 * (u->input.outputs + u->gates.outputs + u->hidden.outputs);
    Weights weights = {0};
    half *recurrence = pack_recurrence(u, &weights, 1);
    real *sums = calloc((size_t)(blocks * length), sizeof(real));
    int failed = recurrence == NULL || sums == NULL;
    if (!failed) {
        FOR_BLOCKS(failed) {
            set_up_products();
            failed |= unroll_block_back(u, g, &weights, sums + block * length, block * BLOCK, count_rows(u, block));
            tear_down_products();
        }
        add_blocks(g->norms, sums, blocks, length);
    }
    free(sums);
    free(recurrence);
    return failed;
}

// The size of a factor of a product in bytes: 2, 4 or 8; 0 if the operating system forbids products.
int size_of_half(void) { return can_multiply() ? (int)sizeof(half) : 0; }
