// The encoder with its gradients. A thread computes all layers of one block of frames before the next block.

#include "convolutions.h"

#define PATCH 4
#define GRID (FRAME / PATCH)
#define MOST 4  // convolutions
#define ROWS_AT_ONCE_WANTED 64

typedef struct {
    Layer patches, linear;
    Convolution convolutions[MOST];
    long num_convolutions, rows;
    const uint8_t *frames;  // (rows, 64, 64, 3)
    real *embeddings;       // (rows, outputs of `linear`)
    half *kept;             // sums before every SiLU, (rows, kept_size)
} Encoder;

typedef struct {
    const real *of_embeddings;
    LayerGradients patches, linear, convolutions[MOST];  // for each thread, side by side
} EncoderGradients;

typedef struct {
    half *patches, *linear, *convolutions[MOST];
} EncoderWeights;

// The working memory of a thread. `grids` and `of_grids` hold the inputs of one convolution for a block of frames.
typedef struct {
    half *grids, *next_grids, *rows, *flat, *of_outputs, *of_inputs, *scratch;
    real *product, *slopes, *of_grid;
    void *memory;
} Scratch;

static long places_after(const Encoder *e, long layer) {
    return layer == 0 ? GRID * GRID : count_places(&e->convolutions[layer - 1]);
}

static const Layer *layer_of(const Encoder *e, long layer) {
    return layer == 0 ? &e->patches : &e->convolutions[layer - 1].layer;
}

static long kept_before(const Encoder *e, long layer) {
    long size = 0;
    for (long i = 0; i < layer; i++) size += places_after(e, i) * layer_of(e, i)->outputs;
    return size;
}

static long kept_size(const Encoder *e) { return kept_before(e, e->num_convolutions + 1); }

// Frames whose places fill the rows of one product.
static long frames_at_once(long places) {
    long frames = places >= ROWS_AT_ONCE_WANTED ? 1 : ROWS_AT_ONCE_WANTED / places;
    return frames < BLOCK ? frames : BLOCK;
}

// Lays out the working memory; returns its size if `base` is NULL.
static size_t lay_out(Scratch *s, const Encoder *e, char *base) {
    long flat = padded(e->linear.inputs), grids = 1, rows = 1, product = BLOCK * larger(flat, padded(e->linear.outputs));
    long outputs = BLOCK * padded(e->linear.outputs), slopes = BLOCK * flat, grid = 1;
    long scratch = scratch_size(&e->linear, BLOCK);
    for (long layer = 0; layer <= e->num_convolutions; layer++) {
        const Layer *l = layer_of(e, layer);
        long places = places_after(e, layer), count = padded(frames_at_once(places) * places);
        rows = larger(rows, count * padded(l->inputs));
        product = larger(product, count * larger(padded(l->inputs), padded(l->outputs)));
        outputs = larger(outputs, (BLOCK * places + count) * padded(l->outputs));
        scratch = larger(scratch, scratch_size(l, count));
        if (layer == 0) continue;
        slopes = larger(slopes, frames_at_once(places) * places_after(e, layer - 1) * layer_of(e, layer - 1)->outputs);
        grids = larger(grids, BLOCK * grid_size(&e->convolutions[layer - 1]));
        grid = larger(grid, grid_size(&e->convolutions[layer - 1]));
    }
    char *place = base;
    s->memory = base;
    s->grids = take(&place, grids);
    s->next_grids = take(&place, grids);
    s->rows = take(&place, rows);
    s->flat = take(&place, BLOCK * flat);
    s->of_outputs = take(&place, outputs);
    s->of_inputs = take(&place, outputs);
    s->scratch = take(&place, scratch);
    s->product = take_real(&place, product);
    s->slopes = take_real(&place, slopes);
    s->of_grid = take_real(&place, grid);
    return (size_t)(place - base);
}

// Writes a row of numbers for each patch of 4 x 4 pixels.
static void fill_patches(half *to, const uint8_t *frame, long width) {
    long strip = PATCH * COLOURS;
    for (long line = 0; line < FRAME; line++) {
        half numbers[FRAME * COLOURS];
        const uint8_t *pixels = frame + line * FRAME * COLOURS;
        VECTOR() for (long i = 0; i < FRAME * COLOURS; i++) numbers[i] = write_half((real)pixels[i]);
        half *row = to + line / PATCH * GRID * width + line % PATCH * strip;
        for (long patch = 0; patch < GRID; patch++)
            memcpy(row + patch * width, numbers + patch * strip, PATCH * COLOURS * sizeof(half));
    }
    for (long patch = 0; patch < GRID * GRID; patch++) clear_row(to + patch * width, PATCH * strip, width);
}

// Where the outputs of a layer begin for a frame of the block: in the grid of the next convolution, or in a flat row.
static half *target(const Encoder *e, half *grids, half *flat, long layer, long frame, long place) {
    if (layer < e->num_convolutions) {
        const Convolution *next = &e->convolutions[layer];
        return grids + frame * grid_size(next) + place_in_grid(next, place);
    }
    return flat + frame * padded(e->linear.inputs) + place * layer_of(e, layer)->outputs;
}

static void activate_layer(const Encoder *e, const Scratch *s, half *grids, long layer, long first, long from, long count) {
    const Layer *l = layer_of(e, layer);
    long places = places_after(e, layer), size = kept_size(e), before = kept_before(e, layer);
    for (long f = 0; f < count; f++)
        for (long place = 0; place < places; place++) {
            half *kept = e->kept + (first + from + f) * size + before + place * l->outputs;
            const real *product = s->product + (f * places + place) * padded(l->outputs);
            activate(target(e, grids, s->flat, layer, from + f, place), kept, product, l->shift, l->outputs);
        }
}

static void clear_grids(const Encoder *e, half *grids, long layer, long count) {
    if (layer < e->num_convolutions)
        memset(grids, 0, (size_t)(count * grid_size(&e->convolutions[layer])) * sizeof(half));
}

static void encode_block(const Encoder *e, const EncoderWeights *w, const Scratch *s, long first, long count) {
    half *grids = s->grids, *next = s->next_grids;
    long width = padded(e->patches.inputs), flat = padded(e->linear.inputs);
    memset(s->flat, 0, (size_t)(BLOCK * flat) * sizeof(half));
    clear_grids(e, grids, 0, count);
    for (long f = 0; f < count; f++) {
        fill_patches(s->rows, e->frames + (first + f) * FRAME * FRAME * COLOURS, width);
        long outputs = padded(e->patches.outputs);
        multiply(s->rows, width, GRID * GRID, w->patches, width, outputs, s->product, outputs, 0);
        activate_layer(e, s, grids, 0, first, f, 1);
    }
    for (long layer = 1; layer <= e->num_convolutions; layer++) {
        const Convolution *c = &e->convolutions[layer - 1];
        long places = count_places(c), at_once = frames_at_once(places), inputs = padded(c->layer.inputs);
        clear_grids(e, next, layer, count);
        for (long from = 0; from < count; from += at_once) {
            long here = smaller(at_once, count - from), rows = padded(here * places);
            for (long f = 0; f < here; f++)
                fill_rows(s->rows + f * places * inputs, grids + (from + f) * grid_size(c), c);
            clear_rows(s->rows, here * places, rows, inputs);
            long outputs = padded(c->layer.outputs);
            multiply(s->rows, inputs, rows, w->convolutions[layer - 1], inputs, outputs, s->product, outputs, 0);
            activate_layer(e, s, next, layer, first, from, here);
        }
        half *swapped = grids;
        grids = next;
        next = swapped;
    }
    long outputs = padded(e->linear.outputs);
    multiply(s->flat, flat, padded_to_tile(count), w->linear, flat, outputs, s->product, outputs, 0);
    for (long f = 0; f < count; f++)
        for (long i = 0; i < e->linear.outputs; i++)
            e->embeddings[(first + f) * e->linear.outputs + i] = s->product[f * outputs + i] + e->linear.shift[i];
}

// Writes the gradients of the last SiLUs' inputs of a block to `of_outputs`, (frames x places, padded channels).
static void linear_back(const Encoder *e, const EncoderGradients *g, const EncoderWeights *w, const Scratch *s, long first,
                        long count) {
    long flat = padded(e->linear.inputs), outputs = padded(e->linear.outputs), last = e->num_convolutions;
    long places = places_after(e, last), channels = layer_of(e, last)->outputs, stride = padded(channels);
    long size = kept_size(e), before = kept_before(e, last);
    memset(s->flat, 0, (size_t)(BLOCK * flat) * sizeof(half));
    clear_rows(s->of_inputs, count, BLOCK, outputs);
    for (long f = 0; f < count; f++) {
        write_row(s->of_inputs + f * outputs, g->of_embeddings + (first + f) * e->linear.outputs, e->linear.outputs);
        clear_row(s->of_inputs + f * outputs, e->linear.outputs, outputs);
        activate_again(s->flat + f * flat, s->slopes + f * flat, e->kept + (first + f) * size + before, places * channels);
    }
    accumulate(&g->linear, &e->linear, s->of_inputs, s->flat, BLOCK, s->scratch);
    multiply(s->of_inputs, outputs, padded_to_tile(count), w->linear, outputs, flat, s->product, flat, 0);
    for (long f = 0; f < count; f++)
        for (long place = 0; place < places; place++) {
            const real *gradient = s->product + f * flat + place * channels, *slope = s->slopes + f * flat + place * channels;
            half *row = s->of_outputs + (f * places + place) * stride;
            multiply_row(row, gradient, slope, channels);
            clear_row(row, channels, stride);
        }
}

// Passes gradients through a convolution, and through the SiLU before it.
static void convolution_back(const Encoder *e, const EncoderGradients *g, const EncoderWeights *w, const Scratch *s,
                             long layer, long first, long count, half *of_outputs, half *of_inputs) {
    const Convolution *c = &e->convolutions[layer - 1];
    long places = count_places(c), at_once = frames_at_once(places), inputs = padded(c->layer.inputs);
    long outputs = padded(c->layer.outputs), before = c->side * c->side, kept = kept_before(e, layer - 1);
    clear_rows(of_outputs, count * places, padded(count * places), outputs);
    memset(s->grids, 0, (size_t)grid_size(c) * sizeof(half));
    for (long from = 0; from < count; from += at_once) {
        long here = smaller(at_once, count - from), rows = padded(here * places);
        const half *of_rows = of_outputs + from * places * outputs;
        for (long f = 0; f < here; f++) {
            const half *sums = e->kept + (first + from + f) * kept_size(e) + kept;
            fill_grid(s->grids, s->slopes + f * before * c->channels, sums, c);
            fill_rows(s->rows + f * places * inputs, s->grids, c);
        }
        clear_rows(s->rows, here * places, rows, inputs);
        accumulate(&g->convolutions[layer - 1], &c->layer, of_rows, s->rows, rows, s->scratch);
        multiply(of_rows, outputs, rows, w->convolutions[layer - 1], outputs, inputs, s->product, inputs, 0);
        for (long f = 0; f < here; f++) {
            memset(s->of_grid, 0, (size_t)grid_size(c) * sizeof(real));
            add_rows(s->of_grid, s->product + f * places * inputs, c);
            half *to = of_inputs + (from + f) * before * padded(c->channels);
            grid_back(to, s->of_grid, s->slopes + f * before * c->channels, c, padded(c->channels));
        }
    }
}

static void encode_block_back(const Encoder *e, const EncoderGradients *g, const EncoderWeights *w, const Scratch *s,
                              long first, long count) {
    linear_back(e, g, w, s, first, count);
    half *of_outputs = s->of_outputs, *of_inputs = s->of_inputs;
    for (long layer = e->num_convolutions; layer > 0; layer--) {
        convolution_back(e, g, w, s, layer, first, count, of_outputs, of_inputs);
        half *swapped = of_outputs;
        of_outputs = of_inputs;
        of_inputs = swapped;
    }
    long width = padded(e->patches.inputs), outputs = padded(e->patches.outputs);
    for (long f = 0; f < count; f++) {
        fill_patches(s->rows, e->frames + (first + f) * FRAME * FRAME * COLOURS, width);
        const half *of_frame = of_outputs + f * GRID * GRID * outputs;
        accumulate(&g->patches, &e->patches, of_frame, s->rows, GRID * GRID, s->scratch);
    }
}

static half *pack_encoder(const Encoder *e, EncoderWeights *w, int is_back) {
    size_t total = packed_size(&e->patches) + packed_size(&e->linear);
    for (long i = 0; i < e->num_convolutions; i++) total += packed_size(&e->convolutions[i].layer);
    half *memory = allocate(total), *place = memory;
    if (memory == NULL) return NULL;
    for (long i = -2; i < e->num_convolutions; i++) {
        const Layer *layer = i == -2 ? &e->patches : i == -1 ? &e->linear : &e->convolutions[i].layer;
        half **part = i == -2 ? &w->patches : i == -1 ? &w->linear : &w->convolutions[i];
        if (is_back) pack_back(place, layer);
        else pack(place, layer, 0);
        *part = place;
        place += packed_size(layer) / sizeof(half);
    }
    return memory;
}

static EncoderGradients encoder_of_thread(const Encoder *e, const EncoderGradients *g) {
    EncoderGradients own = *g;
    own.patches = of_thread(&g->patches, &e->patches);
    own.linear = of_thread(&g->linear, &e->linear);
    for (long i = 0; i < e->num_convolutions; i++)
        own.convolutions[i] = of_thread(&g->convolutions[i], &e->convolutions[i].layer);
    return own;
}

// Runs all blocks, forwards, or backwards if `g` is not NULL. Returns 0, or 1 if memory could not be allocated.
int encode(const Encoder *e, const EncoderGradients *g, int threads) {
    EncoderWeights weights = {0};
    half *packed = pack_encoder(e, &weights, g != NULL);
    int failed = packed == NULL;
    long blocks = (e->rows + BLOCK - 1) / BLOCK;
    if (failed || blocks == 0) threads = 0;
    if (threads > 0) {
#pragma omp parallel num_threads(threads < blocks ? threads : (int)blocks) reduction(| : failed)
        {
            Scratch scratch;
            char *memory = allocate(lay_out(&scratch, e, NULL));
            failed = memory == NULL;
            if (!failed) lay_out(&scratch, e, memory);
            EncoderGradients own = {0};
            if (g != NULL) own = encoder_of_thread(e, g);
            set_up_products();
#pragma omp for schedule(static)
            for (long block = 0; block < blocks; block++) {
                long first = block * BLOCK, count = smaller(BLOCK, e->rows - first);
                if (failed) continue;
                if (g == NULL) encode_block(e, &weights, &scratch, first, count);
                else encode_block_back(e, &own, &weights, &scratch, first, count);
            }
            tear_down_products();
            free(memory);
        }
    }
    free(packed);
    return failed;
}
