// Decisions about single frames, in float32: the belief after an action and the frame that the action led to, the actor,
// and how far the frame is from the prediction. Vectors, in the notation of GCC and Clang, are as long as the processor's
// registers. The result of a row does not depend on other rows, and NaN in gives NaN out.

#include <stdlib.h>

#include "rows.h"

#define SIDE 64  // of a frame
#define COLOURS 3
#define PATCH 4
#define KERNEL 4
#define STRIDE 2
#define MOST_PICTURES 5
#define MIN_STD 0.1f
#define ALIGNMENT 64
#define TILE 16  // outputs of a tile of weights
#define TILES 4  // tiles that one row is multiplied with at once
#define ROWS 4   // rows that are multiplied at once

// The numbers in a vector, and the tiles that ROWS rows are multiplied with at once: their sums fit the registers.
#if defined(__AVX512F__)
#define LANES 16
#define TILES_OF_ROWS 4
#elif defined(__AVX__)
#define LANES 8
#define TILES_OF_ROWS 1
#else
#define LANES 4
#define TILES_OF_ROWS 1
#endif
#define PARTS (TILE / LANES)

typedef float Vector __attribute__((vector_size(LANES * sizeof(float)), aligned(sizeof(float)), may_alias));

// Weights lie in tiles, (outputs / TILE, inputs, TILE). Tiles and bias have zeros up to a whole tile of outputs. The bias
// may be NULL. Scale and shift belong to the norm behind the product, and are NULL where there is no norm.
typedef struct {
    const float *weights, *bias, *scale, *shift;
    long inputs, outputs;
} Layer;

// The first layer of `pictures` reads patches of pixels, the others windows of the picture before. The inputs of the
// other layers are [latent | action], [hidden | deter]; [last picture | deter], hidden; deter, hidden; and for the actor
// [deter | latent], hidden, hidden.
typedef struct {
    Layer pictures[MOST_PICTURES], input, gates, posterior, posterior_output, prior, prior_output, actor[3];
    long num_pictures, action, latent, deter, hidden;
} FrameModel;

// Inputs and results of some rows. A step is left out if its input or its result is NULL.
typedef struct {
    const float *deter, *stoch;      // the belief before the action, (rows, deter) and (rows, latent)
    const float *action;             // (rows, action); NULL: `deter` is the state at the frame
    const uint8_t *is_first;         // (rows,), whether a row's state at the frame is zero; NULL: never
    const uint8_t *frames;           // (rows, 64, 64, 3); NULL: `stoch` is the latent of the result
    float *next_deter, *next_stoch;  // the belief at the frame, as `deter` and `stoch`
    float *mean, *std;               // of the actor's action, (rows, action) each
    float *surprise, *mismatch;      // distance of the latent from the prior, and KL(posterior || prior), (rows,) each
} Decision;

// Rows of numbers, which begin `width` numbers apart.
typedef struct {
    float *first;
    long width;
} Rows;

// The working memory of a thread: one frame, its pictures but the last one, and up to ROWS rows. A row of `inputs` holds
// [last picture | deter | latent | action]; behind the numbers of a hidden layer fits deter.
typedef struct {
    float *pixels, *pictures;
    Rows inputs, deter, stoch, action, hidden, product, posterior;
    long count;
} Workspace;

// Products of some rows with the weights of a layer. An input consists of lines, which are `apart` numbers apart.
typedef struct {
    const Layer *layer;
    const float *from[ROWS];
    float *to[ROWS];
    long count, lines, apart;
} Product;

static long padded(long size) { return (size + TILE - 1) / TILE * TILE; }
static void copy(float *to, const float *from, long size) { memcpy(to, from, (size_t)size * sizeof(float)); }

// Products of `count` rows, the first of them `first`, with some tiles of weights; `count` and `tiles` are constants.
static inline __attribute__((always_inline)) void multiply_block(const Product *product, long tile, long first, int count,
                                                                 int tiles) {
    Vector sums[ROWS][TILES * PARTS];
    const Layer *layer = product->layer;
    const float *const *from = product->from + first, *weights = layer->weights + tile * TILE * layer->inputs;
    long length = layer->inputs / product->lines, next = TILE * layer->inputs;
    for (int part = 0; part < tiles * PARTS; part++) {
        Vector bias = {0.0f};
        if (layer->bias != NULL) bias = *(const Vector *)(layer->bias + tile * TILE + part * LANES);
        for (int r = 0; r < count; r++) sums[r][part] = bias;
    }
    for (long line = 0; line < product->lines; line++)
        for (long k = line * product->apart; k < line * product->apart + length; k++, weights += TILE)
            for (int part = 0; part < tiles * PARTS; part++) {
                Vector column = *(const Vector *)(weights + part / PARTS * next + part % PARTS * LANES);
                for (int r = 0; r < count; r++) sums[r][part] += column * from[r][k];
            }
    for (int r = 0; r < count; r++)
        for (int part = 0; part < tiles * PARTS; part++)
            *(Vector *)(product->to[first + r] + tile * TILE + part * LANES) = sums[r][part];
}

static inline __attribute__((always_inline)) void multiply_tiles(const Product *product, long tile, long tiles,
                                                                 long first, int count) {
    switch (tiles) {
        case 4: multiply_block(product, tile, first, count, 4); break;
        case 3: multiply_block(product, tile, first, count, 3); break;
        case 2: multiply_block(product, tile, first, count, 2); break;
        default: multiply_block(product, tile, first, count, 1);
    }
}

static void multiply(const Product *product) {
    long tiles = padded(product->layer->outputs) / TILE, most = product->count == ROWS ? TILES_OF_ROWS : TILES;
    for (long tile = 0; tile < tiles; tile += most) {
        long here = smaller(most, tiles - tile);
        if (product->count == ROWS) multiply_tiles(product, tile, here, 0, ROWS);
        else for (long r = 0; r < product->count; r++) multiply_tiles(product, tile, here, r, 1);
    }
}

// SiLU of a layer at each window of a picture whose lines are `wide`; the square result has a side and a border.
static void convolve(const Layer *layer, const float *picture, long wide, long stride, float *result, long side,
                     long border) {
    long channels = layer->inputs / (KERNEL * KERNEL), outputs = padded(layer->outputs);
    Product product = {.layer = layer, .lines = KERNEL, .apart = wide * channels};
    for (long first = 0; first < side * side; first += ROWS) {
        product.count = smaller(ROWS, side * side - first);
        for (long r = 0; r < product.count; r++) {
            long y = (first + r) / side, x = (first + r) % side;
            product.from[r] = picture + (y * wide + x) * stride * channels;
            product.to[r] = result + ((y + border) * (side + 2 * border) + x + border) * outputs;
        }
        multiply(&product);
        for (long r = 0; r < product.count; r++) {
            float *to = product.to[r];
            VECTOR() for (long i = 0; i < outputs; i++) to[i] = silu(to[i]);
        }
    }
}

static long picture_side(long index) { return (SIDE / PATCH) >> index; }

// The numbers of a picture with the border that the next layer reads.
static long picture_size(const FrameModel *model, long index) {
    long wide = picture_side(index) + (index + 1 < model->num_pictures ? 2 : 0);
    return wide * wide * padded(model->pictures[index].outputs);
}

// The last picture of a frame, (height, width, channel).
static void encode(const Workspace *work, const FrameModel *model, const uint8_t *frame, float *result) {
    float *pixels = work->pixels, *next = work->pictures;
    VECTOR() for (long i = 0; i < SIDE * SIDE * COLOURS; i++) pixels[i] = (float)frame[i] * (1.0f / 255.0f) - 0.5f;
    const float *from = pixels;
    long wide = SIDE, last = model->num_pictures - 1;
    for (long i = 0; i <= last; i++) {
        float *to = i < last ? next : result;
        convolve(model->pictures + i, from, wide, i > 0 ? STRIDE : PATCH, to, picture_side(i), i < last);
        from = to, wide = picture_side(i) + 2, next += picture_size(model, i);
    }
}

static float *row_of(Rows rows, long r) { return rows.first + r * rows.width; }

static void apply_linear(const Layer *layer, Rows from, Rows to, long count) {
    Product product = {.layer = layer, .count = count, .lines = 1};
    for (long r = 0; r < count; r++) product.from[r] = row_of(from, r), product.to[r] = row_of(to, r);
    multiply(&product);
}

static void apply_hidden(const Layer *layer, Rows from, Rows to, long count) {
    apply_linear(layer, from, to, count);
    for (long r = 0; r < count; r++) {
        float *row = row_of(to, r);
        Norm norm = compute_norm(row, layer->scale, layer->shift, layer->outputs);
        VECTOR() for (long i = 0; i < layer->outputs; i++) row[i] = silu(normed(&norm, i));
    }
}

static void advance(const Workspace *work, const FrameModel *model) {
    apply_hidden(&model->input, work->stoch, work->hidden, work->count);
    for (long r = 0; r < work->count; r++)
        copy(row_of(work->hidden, r) + model->hidden, row_of(work->deter, r), model->deter);
    apply_linear(&model->gates, work->hidden, work->product, work->count);
    for (long r = 0; r < work->count; r++) {
        float *deter = row_of(work->deter, r);
        const Layer *gates = &model->gates;
        Norm norm = compute_norm(row_of(work->product, r), gates->scale, gates->shift, gates->outputs);
        VECTOR() for (long i = 0; i < model->deter; i++) deter[i] = gated(&norm, i, model->deter, deter[i]);
    }
}

static void see(const Workspace *work, const FrameModel *model) {
    apply_hidden(&model->posterior, work->inputs, work->hidden, work->count);
    apply_linear(&model->posterior_output, work->hidden, work->posterior, work->count);
    for (long r = 0; r < work->count; r++) copy(row_of(work->stoch, r), row_of(work->posterior, r), model->latent);
}

static void act(const Workspace *work, const FrameModel *model, float *means, float *stds) {
    apply_hidden(&model->actor[0], work->deter, work->hidden, work->count);
    apply_hidden(&model->actor[1], work->hidden, work->product, work->count);
    apply_linear(&model->actor[2], work->product, work->hidden, work->count);
    for (long r = 0; r < work->count; r++) {
        const float *raw = row_of(work->hidden, r);
        for (long i = 0; i < model->action; i++) {
            means[r * model->action + i] = hyperbolic_tangent(raw[i]);
            stds[r * model->action + i] = 0.9f * sigmoid(raw[model->action + i] + 2.0f) + 0.1f;
        }
    }
}

static float latent_std(float raw) { return 2.0f * sigmoid(0.5f * raw) + MIN_STD; }

// Writes half the squared distance of the latent from the prior to `surprise`, and KL(posterior || prior) to `mismatch`.
static void compare(const Workspace *work, const FrameModel *model, float *surprise, float *mismatch) {
    apply_hidden(&model->prior, work->deter, work->hidden, work->count);
    apply_linear(&model->prior_output, work->hidden, work->product, work->count);
    for (long r = 0; r < work->count; r++) {
        const float *stoch = row_of(work->stoch, r), *posterior = row_of(work->posterior, r);
        const float *prior = row_of(work->product, r);
        float distance = 0.0f, spread = 0.0f;
        for (long i = 0; i < model->latent; i++) {
            float std = latent_std(prior[model->latent + i]), away = (stoch[i] - prior[i]) / std;
            distance += away * away;
            if (mismatch == NULL) continue;
            float ratio = latent_std(posterior[model->latent + i]) / std;
            spread += ratio * ratio - 1.0f - 2.0f * logf(ratio);
        }
        if (surprise != NULL) surprise[r] = 0.5f * distance;
        if (mismatch != NULL) mismatch[r] = 0.5f * (distance + spread);
    }
}

static float *allocate_workspace(const FrameModel *model, Workspace *work) {
    long last = model->num_pictures - 1, seen = picture_size(model, last), pixels = SIDE * SIDE * COLOURS, pictures = 0;
    for (long i = 0; i < last; i++) pictures += picture_size(model, i);
    long inputs = padded(seen + model->deter + model->latent + model->action);
    long widest = padded(larger(larger(model->hidden, 2 * model->latent), 2 * model->action));
    long hidden = padded(widest + model->deter), product = padded(larger(widest, 3 * model->deter));
    long posterior = padded(2 * model->latent);
    long size = pixels + pictures + ROWS * (inputs + hidden + product + posterior);
    float *memory = aligned_alloc(ALIGNMENT, (size_t)size * sizeof(float));
    if (memory == NULL) return memory;
    float *rows = memory + pixels + pictures;
    memset(memory + pixels, 0, (size_t)pictures * sizeof(float));  // borders stay zero
    work->pixels = memory, work->pictures = memory + pixels;
    work->inputs = (Rows){rows, inputs};
    work->deter = (Rows){rows + seen, inputs};
    work->stoch = (Rows){rows + seen + model->deter, inputs};
    work->action = (Rows){rows + seen + model->deter + model->latent, inputs};
    work->hidden = (Rows){rows + ROWS * inputs, hidden};
    work->product = (Rows){work->hidden.first + ROWS * hidden, product};
    work->posterior = (Rows){work->product.first + ROWS * product, posterior};
    return memory;
}

static void read_rows(Rows to, const float *from, long first, long count, long size) {
    for (long r = 0; r < count; r++) copy(row_of(to, r), from + (first + r) * size, size);
}

static void write_rows(float *to, Rows from, long first, long count, long size) {
    for (long r = 0; r < count; r++) copy(to + (first + r) * size, row_of(from, r), size);
}

// Decides about the rows of a block; the first of them is `first`.
static void decide_block(Workspace *work, const FrameModel *model, const Decision *of, long first) {
    long count = work->count, deter = model->deter, latent = model->latent, action = model->action;
    for (long r = 0; r < count && of->frames != NULL; r++)
        encode(work, model, of->frames + (first + r) * SIDE * SIDE * COLOURS, row_of(work->inputs, r));
    read_rows(work->deter, of->deter, first, count, deter);
    if (of->stoch != NULL) read_rows(work->stoch, of->stoch, first, count, latent);
    if (of->action != NULL) {
        read_rows(work->action, of->action, first, count, action);
        advance(work, model);
    }
    for (long r = 0; r < count && of->is_first != NULL; r++)
        if (of->is_first[first + r]) memset(row_of(work->deter, r), 0, (size_t)deter * sizeof(float));
    if (of->frames != NULL) see(work, model);
    if (of->next_deter != NULL) write_rows(of->next_deter, work->deter, first, count, deter);
    if (of->next_stoch != NULL) write_rows(of->next_stoch, work->stoch, first, count, latent);
    if (of->mean != NULL) act(work, model, of->mean + first * action, of->std + first * action);
    float *surprise = of->surprise == NULL ? NULL : of->surprise + first;
    float *mismatch = of->mismatch == NULL ? NULL : of->mismatch + first;
    if (surprise != NULL || mismatch != NULL) compare(work, model, surprise, mismatch);
}

// Returns 0, or 1 if memory could not be allocated.
int decide(const FrameModel *model, const Decision *of, long rows, int threads) {
    int failed = 0;
    long share = (rows + threads - 1) / threads, size = smaller(ROWS, larger(share, 1));
    long blocks = (rows + size - 1) / size;
#pragma omp parallel num_threads(threads < blocks ? threads : (int)blocks) if (blocks > 1) reduction(| : failed)
    {
        Workspace work;
        float *memory = allocate_workspace(model, &work);
        failed = memory == NULL;
#pragma omp for schedule(static)
        for (long block = 0; block < blocks; block++) {
            if (memory == NULL) continue;
            work.count = smaller(size, rows - block * size);
            decide_block(&work, model, of, block * size);
        }
        free(memory);
    }
    return failed;
}
