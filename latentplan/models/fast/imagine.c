// Rollouts along the mean of the prior. A thread computes all steps of 32 rows before the next 32, so that its working
// memory stays in the core's cache. Factors of products are `half`; sums and elementwise work are float32.

#include <stdlib.h>

#include "wide.h"

#define BLOCK 32
#define ALIGNMENT 64

// Weights lie as `multiply` reads them. `inputs` and `outputs` are multiples of 32.
typedef struct {
    const half *weights;
    const float *scale, *shift;
    long inputs, outputs;
} Layer;

typedef struct {
    Layer first, second, output;
} Mlp;

typedef struct {
    Layer input, gates, prior, mean;
    Mlp head, actor, value;
    const float *bin_values;  // the same for the reward head and the value head
    long action, latent, deter, hidden, bins;
} Model;

// The working memory of a thread: up to BLOCK rows of [action, padded to 32 | stoch | deter | hidden] as factors, and
// deter and the last product in float32.
typedef struct {
    half *rows, *stoch, *rounded, *hidden;
    float *deter, *product;
    long width, count;
} Workspace;

static void apply(Workspace *work, const half *rows, const Layer *layer) {
    long count = (work->count + TILE - 1) / TILE * TILE, outputs = layer->outputs;
    multiply(rows, work->width, count, layer->weights, layer->inputs, outputs, work->product, outputs, 0);
}

// One hidden layer of every row, written to `hidden`.
static void apply_layer(Workspace *work, const half *from, const Layer *layer) {
    apply(work, from, layer);
    for (long r = 0; r < work->count; r++) {
        const float *row = work->product + r * layer->outputs;
        silu_row(work->hidden + r * work->width, row, layer->scale, layer->shift, layer->outputs);
    }
}

// The output of an Mlp at every row. Where factors are bfloat16, its weights are two matrices side by side, the second of
// rounding errors, whose products are added.
static void apply_mlp(Workspace *work, const Mlp *mlp) {
    const Layer *output = &mlp->output;
    long size = output->outputs / PAIR;
    apply_layer(work, work->stoch, &mlp->first);
    apply_layer(work, work->hidden, &mlp->second);
    apply(work, work->hidden, output);
    for (long r = 0; r < work->count; r++) {
        float *row = work->product + r * output->outputs;
        VECTOR() for (long i = 0; i < size; i++) row[i] += (PAIR == 2 ? row[size + i] : 0.0f) + output->shift[i];
    }
}

static void advance(Workspace *work, const Model *model) {
    apply_layer(work, work->rows, &model->input);
    apply(work, work->rounded, &model->gates);
    for (long r = 0; r < work->count; r++) {
        const float *row = work->product + r * model->gates.outputs;
        float *deter = work->deter + r * model->deter;
        gate_row(deter, work->rounded + r * work->width, row, model->gates.scale, model->gates.shift, model->deter);
    }
    apply_layer(work, work->rounded, &model->prior);
    apply(work, work->hidden, &model->mean);
    for (long r = 0; r < work->count; r++) {
        const float *row = work->product + r * model->latent;
        half *stoch = work->stoch + r * work->width;
        VECTOR() for (long i = 0; i < model->latent; i++) stoch[i] = write_half(row[i] + model->mean.shift[i]);
    }
}

// The scalar of a head at every row, written with a stride of `apart`.
static void read_bins(Workspace *work, const Model *model, const Mlp *head, float *scalars, long apart) {
    apply_mlp(work, head);
    for (long r = 0; r < work->count; r++)
        scalars[r * apart] = expected_of(work->product + r * head->output.outputs, model->bin_values, model->bins);
}

static size_t workspace_bytes(const Model *model) {
    long widest = 3 * model->deter;
    widest = widest > model->hidden ? widest : model->hidden;
    widest = widest > model->latent ? widest : model->latent;
    widest = widest > model->head.output.outputs ? widest : model->head.output.outputs;
    widest = widest > model->actor.output.outputs ? widest : model->actor.output.outputs;
    long width = padded(model->action) + model->latent + model->deter + model->hidden;
    return (size_t)(BLOCK * width) * sizeof(half) + (size_t)(BLOCK * (model->deter + widest)) * sizeof(float);
}

static half *allocate_workspace(const Model *model) {
    set_up_products();
    return aligned_alloc(ALIGNMENT, (workspace_bytes(model) + ALIGNMENT - 1) / ALIGNMENT * ALIGNMENT);
}

static void free_workspace(half *memory) {
    free(memory);
    tear_down_products();
}

// Copies up to BLOCK rows into the working memory of a thread; missing rows are zeros.
static Workspace copy_rows(half *memory, const Model *model, const float *deter, const float *stoch, long rows) {
    long width = padded(model->action) + model->latent + model->deter + model->hidden;
    half *stochs = memory + padded(model->action), *rounded = stochs + model->latent, *hidden = rounded + model->deter;
    float *deters = (float *)(memory + BLOCK * width);
    Workspace work = {memory, stochs, rounded, hidden, deters, deters + BLOCK * model->deter, width, rows};
    memset(memory, 0, workspace_bytes(model));
    memcpy(work.deter, deter, (size_t)(rows * model->deter) * sizeof(float));
    for (long r = 0; r < rows; r++) {
        for (long i = 0; i < model->latent; i++)
            work.stoch[r * width + i] = write_half(stoch[r * model->latent + i]);
        for (long i = 0; i < model->deter; i++)
            work.rounded[r * width + i] = write_half(deter[r * model->deter + i]);
    }
    return work;
}

static void set_actions(Workspace *work, const Model *model, const float *actions, long time) {
    for (long r = 0; r < work->count; r++)
        for (long i = 0; i < model->action; i++)
            work->rows[r * work->width + i] = write_half(actions[r * time * model->action + i]);
}

// Replaces standard normal draws by the actor's actions: the mean plus std times the draw, clamped to [-1, 1].
static void sample_actions(Workspace *work, const Model *model, float *actions, long time) {
    apply_mlp(work, &model->actor);
    for (long r = 0; r < work->count; r++) {
        const float *raw = work->product + r * model->actor.output.outputs;
        float *action = actions + r * time * model->action;
        for (long i = 0; i < model->action; i++) {
            float std = 0.9f * sigmoid(raw[model->action + i] + 2.0f) + 0.1f;
            float value = hyperbolic_tangent(raw[i]) + std * action[i];
            action[i] = value > 1.0f ? 1.0f : value < -1.0f ? -1.0f : value;
        }
    }
}

// Writes rewards (rows, time) along actions (rows, time, action), and replaces the start states by the last states. If
// `rewards` is NULL, `actions` holds standard normal draws, which the actor's actions replace. If `values` is not NULL,
// it receives the values of the last states, (rows,). Returns 0, or 1 if memory could not be allocated.
int imagine(const Model *model, float *deter, float *stoch, float *actions, float *rewards, float *values, long rows,
            long time, int threads) {
    int failed = 0;
    long blocks = (rows + BLOCK - 1) / BLOCK;
    if (blocks == 0) return failed;
#pragma omp parallel num_threads(threads < blocks ? threads : (int)blocks) reduction(| : failed)
    {
        half *memory = allocate_workspace(model);
        failed = memory == NULL;
#pragma omp for schedule(static)
        for (long block = 0; block < blocks; block++) {
            if (memory == NULL) continue;
            long from = block * BLOCK, here = rows - from < BLOCK ? rows - from : BLOCK;
            float *deters = deter + from * model->deter, *stochs = stoch + from * model->latent;
            Workspace work = copy_rows(memory, model, deters, stochs, here);
            for (long step = 0; step < time; step++) {
                float *action = actions + (from * time + step) * model->action;
                if (rewards == NULL) sample_actions(&work, model, action, time);
                set_actions(&work, model, action, time);
                advance(&work, model);
                if (rewards != NULL) read_bins(&work, model, &model->head, rewards + from * time + step, time);
            }
            if (values != NULL) read_bins(&work, model, &model->value, values + from, 1);
            memcpy(deters, work.deter, (size_t)(here * model->deter) * sizeof(float));
            for (long r = 0; r < here; r++)
                for (long i = 0; i < model->latent; i++)
                    stochs[r * model->latent + i] = read_half(work.stoch[r * work.width + i]);
        }
        free_workspace(memory);
    }
    return failed;
}
