// The decoder's reconstruction error with its gradients. A thread computes all layers of one block of rows before the
// next block. A picture of 32 x 32 pixels, each the mean of 2 x 2 pixels of the frame, is painted as 8 x 8 patches.

#include "convolutions.h"

#define GRID 8
#define PLACES (GRID * GRID)
#define PATCH 4
#define SHRINK 2
#define SIDE (GRID * PATCH)
#define PIXELS (PATCH * PATCH * COLOURS)  // of a patch, in the order (y, x, colour)

typedef struct {
    Layer tokens, paint;
    Convolution mix;
    long rows;
    const real *features;   // (rows, inputs of `tokens`)
    const uint8_t *frames;  // (rows, 64, 64, 3)
    real *errors;           // squared differences, summed over the picture, (rows,)
    half *kept;             // sums before every SiLU, (rows, kept_size)
    half *differences;      // (rows, places, pixels)
} Decoder;

typedef struct {
    const real *of_errors;
    real *of_features;
    LayerGradients tokens, paint, mix;
} DecoderGradients;

typedef struct {
    half *tokens, *paint, *mix;
} DecoderWeights;

typedef struct {
    half *features, *grids, *rows, *hidden, *of_pixels, *of_hidden, *of_tokens, *scratch;
    real *product, *slopes, *of_grid;
} Scratch;

static long kept_size(const Decoder *d) { return d->tokens.outputs + PLACES * d->mix.layer.outputs; }

static size_t lay_out(Scratch *s, const Decoder *d, char *base) {
    long tokens = padded(d->tokens.outputs), features = padded(d->tokens.inputs), hidden = padded(d->mix.layer.outputs);
    long inputs = padded(d->mix.layer.inputs), scratch = scratch_size(&d->tokens, BLOCK);
    long product = BLOCK * larger(tokens, features);
    char *place = base;
    s->features = take(&place, BLOCK * features);
    s->grids = take(&place, BLOCK * grid_size(&d->mix));
    s->rows = take(&place, PLACES * inputs);
    s->hidden = take(&place, PLACES * hidden);
    s->of_pixels = take(&place, PLACES * padded(PIXELS));
    s->of_hidden = take(&place, PLACES * hidden);
    s->of_tokens = take(&place, BLOCK * tokens);
    scratch = larger(scratch, scratch_size(&d->mix.layer, PLACES));
    s->scratch = take(&place, larger(scratch, scratch_size(&d->paint, PLACES)));
    product = larger(product, PLACES * larger(inputs, larger(hidden, padded(PIXELS))));
    s->product = take_real(&place, product);
    s->slopes = take_real(&place, PLACES * larger(d->mix.layer.outputs, d->mix.channels));
    s->of_grid = take_real(&place, grid_size(&d->mix));
    return (size_t)(place - base);
}

static void fill_features(const Decoder *d, half *to, long first, long count) {
    long width = padded(d->tokens.inputs);
    clear_rows(to, 0, BLOCK, width);
    for (long r = 0; r < count; r++)
        write_row(to + r * width, d->features + (first + r) * d->tokens.inputs, d->tokens.inputs);
}

// Writes the mean of every 2 x 2 pixels of a frame, in [-0.5, 0.5].
static void shrink_frame(real *to, const uint8_t *frame) {
    for (long line = 0; line < SIDE; line++) {
        const uint8_t *upper = frame + SHRINK * line * FRAME * COLOURS, *lower = upper + FRAME * COLOURS;
        int sums[FRAME * COLOURS];
        VECTOR() for (long i = 0; i < FRAME * COLOURS; i++) sums[i] = upper[i] + lower[i];
        for (long x = 0; x < SIDE; x++)
            for (long i = 0; i < COLOURS; i++) {
                const int *left = sums + SHRINK * x * COLOURS + i;
                to[(line * SIDE + x) * COLOURS + i] = (real)(left[0] + left[COLOURS]) / (4 * 255) - (real)0.5;
            }
    }
}

// Adds the bias to the painted patch of a place, and subtracts the picture; returns the sum of squares.
static real compare_patch(half *differences, const real *product, const real *bias, const real *picture, long place) {
    real sum = 0;
    for (long y = 0; y < PATCH; y++) {
        const real *pixels = picture + ((place / GRID * PATCH + y) * SIDE + place % GRID * PATCH) * COLOURS;
        long strip = PATCH * COLOURS;
        VECTOR(reduction(+ : sum)) for (long i = 0; i < PATCH * COLOURS; i++) {
            real difference = product[y * strip + i] + bias[y * strip + i] - pixels[i];
            differences[y * strip + i] = write_half(difference);
            sum += difference * difference;
        }
    }
    return sum;
}

static void decode_row(const Decoder *d, const DecoderWeights *w, const Scratch *s, const half *grid, long row) {
    const Layer *mix = &d->mix.layer;
    long inputs = padded(mix->inputs), hidden = padded(mix->outputs), pixels = padded(PIXELS);
    half *kept = d->kept + row * kept_size(d) + d->tokens.outputs;
    fill_rows(s->rows, grid, &d->mix);
    multiply(s->rows, inputs, PLACES, w->mix, inputs, hidden, s->product, hidden, 0);
    for (long place = 0; place < PLACES; place++) {
        half *to = s->hidden + place * hidden;
        activate(to, kept + place * mix->outputs, s->product + place * hidden, mix->shift, mix->outputs);
        clear_row(to, mix->outputs, hidden);
    }
    multiply(s->hidden, hidden, PLACES, w->paint, hidden, pixels, s->product, pixels, 0);
    real sum = 0, picture[SIDE * SIDE * COLOURS];
    shrink_frame(picture, d->frames + row * FRAME * FRAME * COLOURS);
    for (long place = 0; place < PLACES; place++) {
        half *differences = d->differences + (row * PLACES + place) * PIXELS;
        sum += compare_patch(differences, s->product + place * pixels, d->paint.shift, picture, place);
    }
    d->errors[row] = sum;
}

static void decode_block(const Decoder *d, const DecoderWeights *w, const Scratch *s, long first, long count) {
    long features = padded(d->tokens.inputs), tokens = padded(d->tokens.outputs), channels = d->mix.channels;
    fill_features(d, s->features, first, count);
    memset(s->grids, 0, (size_t)(BLOCK * grid_size(&d->mix)) * sizeof(half));
    multiply(s->features, features, padded_to_tile(count), w->tokens, features, tokens, s->product, tokens, 0);
    for (long r = 0; r < count; r++) {
        half *kept = d->kept + (first + r) * kept_size(d), *grid = s->grids + r * grid_size(&d->mix);
        const real *product = s->product + r * tokens;
        for (long i = 0; i < d->tokens.outputs; i += channels)
            activate(grid + place_in_grid(&d->mix, i / channels), kept + i, product + i, d->tokens.shift + i, channels);
    }
    for (long r = 0; r < count; r++) decode_row(d, w, s, s->grids + r * grid_size(&d->mix), first + r);
}

// Passes the gradient of a row's error back to its tokens, whose gradients are written to a row of `of_tokens`.
static void decode_row_back(const Decoder *d, const DecoderGradients *g, const DecoderWeights *w, const Scratch *s,
                            long row, half *of_tokens) {
    const Layer *mix = &d->mix.layer;
    long inputs = padded(mix->inputs), hidden = padded(mix->outputs), pixels = padded(PIXELS);
    const half *kept = d->kept + row * kept_size(d);
    for (long place = 0; place < PLACES; place++) {
        const half *difference = d->differences + (row * PLACES + place) * PIXELS;
        half *to = s->of_pixels + place * pixels;
        FOR_LANES(i, PIXELS)
            store_half(to + i, 2 * g->of_errors[row] * load_half(difference + i, PIXELS - i), PIXELS - i);
        clear_row(to, PIXELS, pixels);
        const half *sums = kept + d->tokens.outputs + place * mix->outputs;
        activate_again(s->hidden + place * hidden, s->slopes + place * mix->outputs, sums, mix->outputs);
        clear_row(s->hidden + place * hidden, mix->outputs, hidden);
    }
    accumulate(&g->paint, &d->paint, s->of_pixels, s->hidden, PLACES, s->scratch);
    multiply(s->of_pixels, pixels, PLACES, w->paint, pixels, hidden, s->product, hidden, 0);
    for (long place = 0; place < PLACES; place++) {
        const real *gradient = s->product + place * hidden, *slope = s->slopes + place * mix->outputs;
        half *to = s->of_hidden + place * hidden;
        multiply_row(to, gradient, slope, mix->outputs);
        clear_row(to, mix->outputs, hidden);
    }
    fill_grid(s->grids, s->slopes, kept, &d->mix);
    fill_rows(s->rows, s->grids, &d->mix);
    accumulate(&g->mix, mix, s->of_hidden, s->rows, PLACES, s->scratch);
    multiply(s->of_hidden, hidden, PLACES, w->mix, hidden, inputs, s->product, inputs, 0);
    memset(s->of_grid, 0, (size_t)grid_size(&d->mix) * sizeof(real));
    add_rows(s->of_grid, s->product, &d->mix);
    grid_back(of_tokens, s->of_grid, s->slopes, &d->mix, d->mix.channels);
    clear_row(of_tokens, d->tokens.outputs, padded(d->tokens.outputs));
}

static void decode_block_back(const Decoder *d, const DecoderGradients *g, const DecoderWeights *w, const Scratch *s,
                              long first, long count) {
    long features = padded(d->tokens.inputs), tokens = padded(d->tokens.outputs);
    memset(s->grids, 0, (size_t)grid_size(&d->mix) * sizeof(half));
    for (long r = 0; r < count; r++) decode_row_back(d, g, w, s, first + r, s->of_tokens + r * tokens);
    clear_rows(s->of_tokens, count, BLOCK, tokens);
    fill_features(d, s->features, first, count);
    accumulate(&g->tokens, &d->tokens, s->of_tokens, s->features, BLOCK, s->scratch);
    multiply(s->of_tokens, tokens, padded_to_tile(count), w->tokens, tokens, features, s->product, features, 0);
    for (long r = 0; r < count; r++)
        memcpy(g->of_features + (first + r) * d->tokens.inputs, s->product + r * features,
               (size_t)d->tokens.inputs * sizeof(real));
}

static half *pack_decoder(const Decoder *d, DecoderWeights *w, int is_back) {
    const Layer *layers[] = {&d->tokens, &d->paint, &d->mix.layer};
    half **parts[] = {&w->tokens, &w->paint, &w->mix};
    half *memory = allocate(packed_size(layers[0]) + packed_size(layers[1]) + packed_size(layers[2])), *place = memory;
    if (memory == NULL) return NULL;
    for (int i = 0; i < 3; i++) {
        if (is_back) pack_back(place, layers[i]);
        else pack(place, layers[i], 0);
        *parts[i] = place;
        place += packed_size(layers[i]) / sizeof(half);
    }
    return memory;
}

// Runs all blocks, forwards, or backwards if `g` is not NULL. Returns 0, or 1 if memory could not be allocated.
int decode(const Decoder *d, const DecoderGradients *g, int threads) {
    DecoderWeights weights = {0};
    half *packed = pack_decoder(d, &weights, g != NULL);
    int failed = packed == NULL;
    long blocks = (d->rows + BLOCK - 1) / BLOCK;
    if (failed || blocks == 0) threads = 0;
    if (threads > 0) {
#pragma omp parallel num_threads(threads < blocks ? threads : (int)blocks) reduction(| : failed)
        {
            Scratch scratch;
            char *memory = allocate(lay_out(&scratch, d, NULL));
            failed = memory == NULL;
            if (!failed) lay_out(&scratch, d, memory);
            DecoderGradients own = {0};
            if (g != NULL) {
                own = *g;
                own.tokens = of_thread(&g->tokens, &d->tokens);
                own.paint = of_thread(&g->paint, &d->paint);
                own.mix = of_thread(&g->mix, &d->mix.layer);
            }
            set_up_products();
#pragma omp for schedule(static)
            for (long block = 0; block < blocks; block++) {
                long first = block * BLOCK, count = smaller(BLOCK, d->rows - first);
                if (failed) continue;
                if (g == NULL) decode_block(d, &weights, &scratch, first, count);
                else decode_block_back(d, &own, &weights, &scratch, first, count);
            }
            tear_down_products();
            free(memory);
        }
    }
    free(packed);
    return failed;
}
