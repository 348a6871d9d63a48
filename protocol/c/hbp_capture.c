/* hbp_capture.c: samples and edges held in memory and frozen by a trigger (chapter 19 of SPEC). See hbp.h.
 *
 * The memory is two rings, one of edges and one of records behind it. The interrupts write into them while `running`; hbp_tick ends that
 * once it has taken what must follow the trigger. From then on the main loop has all of it to itself: it looks for the first record and the
 * first edge, makes the CRC in parts, and tells.
 */
#include "hbp_way.h"

#include <string.h>

#if HBP_CAPTURE

#define EDGE_BYTES 8u
#define ID_BYTES 2u
#define HEAD 22u          /* of CAPTURE_ARM */
#define REPLY_HEAD 66u
#define ILLEGAL 0x40u
#define NO_CODE 0xFFu
#define SIGN 0x80000000u
#define INFINITE 0x7F800000u
#define FAULT_MASK 0x00FFFFFFu

enum { FIRST, RECORDS, EDGES, EDGES_LOST, FIRST_EDGE, SIZE, CRC, ROOM, TICK, TICK_HIGH, INDEX, FAULTS };

/* ---- conditions on a channel: a range of its raw values, so that the interrupt compares whole numbers ------------------------ */

/* What the values of a type are exclusive-or'd with to be in order from 0 on: the sign's bit. */
static uint32_t flip_of(uint8_t type)
{
    int has_sign = type == HBP_RAW_I8 || type == HBP_RAW_I16 || type >= HBP_RAW_I32;
    return has_sign ? SIGN >> (32u - 8u * hbp_widths[type]) : 0;
}

/* By which a value fills 32 bits: there signed ones are in order as others are, but for where they begin. */
static uint32_t shift_of(const struct hbp_capture *c)
{
    return 32u - 8u * c->width;
}

/* From a value to the next one. */
static uint32_t step_of(const struct hbp_capture *c)
{
    return 1u << shift_of(c);
}

/* The range becomes that of all other values. */
static void take_others(struct hbp_capture *c)
{
    c->low += c->span + step_of(c);
    c->span = 0u - c->span - 2u * step_of(c);
}

static uint32_t value_in(const struct hbp_capture *c, const uint8_t *sample)
{
    const uint8_t *from = sample + c->at;
    uint32_t raw;
    uint16_t half;
    if (c->width > 2u) {
        memcpy(&raw, from, sizeof raw);
        return raw ^ ((0u - (raw >> 31)) & c->turned);
    }
    if (c->width < 2u) return (uint32_t)*from << 24;
    memcpy(&half, from, sizeof half);
    return (uint32_t)half << 16;
}

static int fulfilled(const struct hbp_capture *c, uint32_t value)
{
    return value - c->low <= c->span;
}

static float physical(const struct hbp_channel *channel, uint32_t key)
{
    uint32_t flip = flip_of(channel->type), bits;
    float raw;
    if (channel->type == HBP_RAW_F32) {
        bits = key & SIGN ? key ^ SIGN : ~key;
        memcpy(&raw, &bits, sizeof raw);
    } else {
        raw = flip ? (float)(int32_t)(key - flip) : (float)key;
    }
    return raw * channel->scale + channel->offset;
}

/* The values that are above `level`, or below it: a range that ends where those of the type end. */
static void find_range(struct hbp_capture *c, const struct hbp_channel *channel, float level, int above)
{
    uint32_t shift = shift_of(c), least = 0, most = 0xFFFFFFFFu >> shift, low, high;
    int rising = (channel->scale > 0.0f) == above;
    if (channel->type == HBP_RAW_F32) {
        least = ~(INFINITE | SIGN);
        most = INFINITE | SIGN;
    }
    low = least, high = most;
    for (;;) { /* the first key at which it changes, if it does: low = high */
        uint32_t middle = low + (high - low) / 2u;
        float value = physical(channel, middle);
        int there = above ? value > level : value < level;
        if (low == high) {
            c->low = rising ? low : least;
            c->span = rising ? most - low : low - least;
            if (there) break;
            if (rising || low == least) c->width = 0; /* none */
            else c->span--;
            break;
        }
        if (there == rising) high = middle;
        else low = middle + 1u;
    }
    c->low = (c->low ^ flip_of(channel->type)) << shift;
    c->span <<= shift;
}

/* ---- arming ---------------------------------------------------------------------------------------------------------------- */

static void watch(struct hbp *h, uint8_t trigger, uint16_t id, float level)
{
    struct hbp_capture *c = h->capture;
    const struct hbp_channel *channel = hbp_find_channel(h, id);
    c->width = 0;
    if (trigger < HBP_TRIGGER_ABOVE || trigger > HBP_TRIGGER_CHANGES || !channel) return;
    c->width = hbp_widths[channel->type];
    c->turned = channel->type == HBP_RAW_F32 ? SIGN - 1u : 0; /* negative floats are in the order of their magnitudes */
    c->at = channel->at;
    c->leaves = trigger == HBP_TRIGGER_RISES || trigger == HBP_TRIGGER_FALLS;
    if (trigger != HBP_TRIGGER_CHANGES) find_range(c, channel, level, trigger == HBP_TRIGGER_ABOVE || trigger == HBP_TRIGGER_RISES);
    if (!c->width || !c->leaves) return;
    if (c->span == 0u - step_of(c)) c->width = 0; /* it is always so, and never begins to be so */
    else take_others(c);
}

/* Channels that stand side by side in the sample too are copied at once. */
static void find_runs(struct hbp *h)
{
    struct hbp_capture *c = h->capture;
    struct hbp_run *run = NULL;
    uint32_t runs = 0;
    for (uint32_t k = 0; k < c->channels; k++) {
        const struct hbp_channel *channel = &h->config->channels[c->take[k]];
        if (!run || run->at + run->bytes != channel->at) {
            run = &c->run[runs++];
            run->at = channel->at;
            run->bytes = 0;
        }
        run->bytes = (uint16_t)(run->bytes + hbp_widths[channel->type]);
    }
    c->runs_end = c->run + runs;
}

/* Begin a capture as a CAPTURE_ARM says that has been found right. */
static void begin(struct hbp *h, const uint8_t *in, uint32_t record_bytes)
{
    struct hbp_capture *c = h->capture;
    float level = hbp_get_float(in + 12), ticks = level * (float)h->config->tick_hz;
    c->running = 0;
    HBP_BARRIER(); /* the interrupts are out of it */
    c->trigger = c->cause = in[0];
    c->decimation = hbp_get16(in + 2);
    c->every = (uint16_t)(c->decimation - 1u);
    c->before = hbp_get32(in + 4);
    c->after = hbp_get32(in + 8);
    c->edge_room = hbp_get16(in + 18);
    c->channels = hbp_get16(in + 20);
    c->record_bytes = (uint16_t)record_bytes;
    c->number = hbp_next_number(c->number);
    c->records = h->config->capture + EDGE_BYTES * c->edge_room;
    c->ring_bytes = (c->before + c->after) * record_bytes;
    c->to = c->end = c->records + c->ring_bytes; /* the first record begins the first round */
    c->pulse = ticks >= 0.0f ? ticks < 4294967040.0f ? (uint32_t)ticks : 0xFFFFFFFFu : 0;
    hbp_take_channels(h, in + HEAD, c->channels, c->take);
    find_runs(h);
    watch(h, in[0], hbp_get16(in + 16), level);
    memset(c->told, 0, sizeof c->told);
    c->calls.any = 0;
    c->calls.by.fresh = 1;
    c->rounds = c->edge_wrapped = 0;
    c->before_last = NO_CODE;
    c->edge_to = 0;
    c->edge_end = h->edges;
    c->edges_begun = h->edges;
    c->left = 0;
    c->state = HBP_CAPTURE_ARMED;
    hbp_capture_ask(h, HBP_TRIGGER_NOW);
    HBP_BARRIER();
    c->running = 1;
}

/* What nobody asked for: the last periods before a fault, a quarter of a second at most. */
static uint32_t stand_by(struct hbp *h)
{
    const struct hbp_config *config = h->config;
    uint8_t *in = h->link->work;
    uint32_t n = 0, bytes = 0, wanted = config->pwm_hz / 4u, edges = 0, records, room;
    if (config->features & HBP_FEATURE_EDGES) edges = h->capture->room / 128u;
    if (edges > 1024u) edges = 1024u;
    room = h->capture->room - EDGE_BYTES * edges;
    if (config->fault_channels) {
        for (; n < config->n_fault_channels && n < HBP_CHANNELS; n++) (void)hbp_put16(in + HEAD + ID_BYTES * n, config->fault_channels[n]);
    } else {
        for (uint32_t k = 0; k < config->n_channels; k++) { /* as many as there is room for */
            if (config->channels[k].flags & HBP_FLAG_ON_REQUEST) continue;
            bytes += hbp_widths[config->channels[k].type];
            if (n && room / bytes < wanted) break;
            (void)hbp_put16(in + HEAD + ID_BYTES * n++, config->channels[k].id);
        }
    }
    if (!n || hbp_choose(h, in + HEAD, n, &bytes)) return HBP_WRONG_CAPTURE;
    records = room / bytes < wanted ? room / bytes : wanted;
    if (records < 5u) return HBP_WRONG_CAPTURE;
    memset(in, 0, HEAD);
    in[0] = HBP_TRIGGER_FAULT;
    in[2] = 1;
    (void)hbp_put32(hbp_put32(in + 4, records - records / 5u), records / 5u);
    (void)hbp_put16(hbp_put16(in + 18, edges), n);
    begin(h, in, bytes);
    return 0;
}

uint32_t hbp_capture_init(struct hbp *h)
{
    const struct hbp_config *config = h->config;
    if (!config->capture || !config->n_channels) return 0;
    if (config->capture_bytes > 0x7FFFFFFFu) return HBP_WRONG_CAPTURE;
    h->capture = &h->captured;
    h->capture->room = config->capture_bytes;
    h->features |= HBP_FEATURE_CAPTURE;
    return stand_by(h);
}

static uint16_t wrong(struct hbp *h, const uint8_t *in, uint32_t *bytes)
{
    uint32_t before = hbp_get32(in + 4), after = hbp_get32(in + 8), n = hbp_get16(in + 20), edges = EDGE_BYTES * hbp_get16(in + 18), fits;
    uint16_t code, trigger_id = hbp_get16(in + 16);
    float level = hbp_get_float(in + 12);
    if (!hbp_get16(in + 2) || !after) return HBP_ERROR_BAD_VALUE;
    if (!hbp_finite(level)) {
        h->detail = level;
        return HBP_ERROR_BAD_VALUE;
    }
    if (!n) return HBP_ERROR_BAD_VALUE;
    code = hbp_choose(h, in + HEAD, n, bytes);
    if (code) return code;
    if (in[0] >= HBP_TRIGGER_ABOVE && in[0] <= HBP_TRIGGER_CHANGES && !hbp_find_channel(h, trigger_id))
        return hbp_refuse(h, HBP_ERROR_UNKNOWN_ID, trigger_id);
    if (in[0] >= HBP_TRIGGER_ILLEGAL && !(h->config->features & HBP_FEATURE_EDGES))
        return hbp_refuse(h, HBP_ERROR_NOT_SUPPORTED, in[0]);
    fits = edges < h->capture->room ? (h->capture->room - edges) / *bytes : 0;
    return before > fits || after > fits - before ? hbp_refuse(h, HBP_ERROR_DOES_NOT_FIT, fits) : 0;
}

uint16_t hbp_capture_arm(struct hbp *h, const uint8_t *in)
{
    struct hbp_capture *c = h->capture;
    uint32_t bytes;
    uint16_t code;
    if (in[0] > HBP_TRIGGER_PULSE) return hbp_refuse(h, HBP_ERROR_BAD_VALUE, in[0]);
    if (in[0] == HBP_TRIGGER_OFF) {
        (void)stand_by(h);
    } else {
        if (c->state == HBP_CAPTURE_FROZEN) return hbp_refuse(h, HBP_ERROR_BUSY, c->number);
        code = wrong(h, in, &bytes);
        if (code) return code;
        begin(h, in, bytes);
    }
    return hbp_capture_status(h, in);
}

uint16_t hbp_capture_status(struct hbp *h, const uint8_t *in)
{
    const struct hbp_capture *c = h->capture;
    uint8_t *to = h->link->work, asked = c->calls.by.asked, state = c->state;
    uint32_t most = (h->peer->tx_max - REPLY_HEAD) / ID_BYTES, channels = c->channels < most ? c->channels : most;
    (void)in;
    if (state != HBP_CAPTURE_ARMED) asked = c->cause;
    else if (asked) state = HBP_CAPTURE_TRIGGERED;
    *to++ = state;
    *to++ = asked ? asked : c->trigger;
    to = hbp_put16(hbp_put16(hbp_put16(to, c->number), c->decimation), c->record_bytes);
    to = hbp_put32(hbp_put32(to, c->before), c->after);
    for (unsigned k = FIRST; k <= FAULTS; k++)
        to = hbp_put32(to, k == ROOM ? c->room : state == HBP_CAPTURE_FROZEN ? c->told[k] : 0);
    to = hbp_put16(to, channels);
    for (uint32_t k = 0; k < channels; k++) to = hbp_put16(to, h->config->channels[c->take[k]].id);
    return hbp_finish(h, to);
}

/* ---- the interrupts -------------------------------------------------------------------------------------------------------- */

void hbp_capture_ask(struct hbp *h, uint8_t trigger)
{
    struct hbp_capture *c = h->capture;
    if (c->state != HBP_CAPTURE_ARMED || c->calls.by.asked || (trigger != HBP_TRIGGER_FAULT && trigger != c->trigger)) return;
    c->asked_faults = h->faults;
    c->asked_tick = (uint32_t)h->now;
    HBP_BARRIER();
    c->calls.by.asked = trigger;
}

/* Bytes of the records that the ring has. */
static uint32_t held(const struct hbp_capture *c)
{
    return c->rounds == 1 ? (uint32_t)(c->to - c->records) : c->rounds ? c->ring_bytes : 0;
}

static void take(const struct hbp *h, const uint8_t *sample, struct hbp_capture *c)
{
    uint8_t *to = c->to;
    if (to == c->end) {
        to = c->records;
        c->edges_begun = h->edges;
        c->rounds = (uint8_t)(2u * c->rounds | 1u);
    }
    c->skip = c->every;
#if HBP_LITTLE_ENDIAN
    const struct hbp_run *run = c->run, *end = c->runs_end;
    do { /* there is one at least */
        const uint8_t *from = sample + run->at, *words_end = from + (run->bytes & ~3u), *end_of_run = from + run->bytes;
        uint32_t word;
        for (; from != words_end; from += 4, to += 4) {
            memcpy(&word, from, sizeof word);
            memcpy(to, &word, sizeof word);
        }
        for (; from != end_of_run; from++) *to++ = *from;
    } while (++run != end);
#else
    hbp_copy_sample(h, c->take, c->channels, sample, to);
    to += c->record_bytes;
#endif
    c->to = to;
    if (c->left && --c->left == 0) c->running = 0;
}

/* The trigger has come, `late` periods before this one, of which no record is taken yet. */
static void trigger(struct hbp *h, struct hbp_capture *c, uint8_t cause, uint32_t late)
{
    uint32_t back = (late + c->skip) / c->decimation; /* records that were taken since */
    uint32_t have = held(c) / c->record_bytes, raised = h->raised;
    if (back > have) back = have;
    c->back = back;
    c->index = h->index + c->skip - (uint64_t)back * c->decimation;
    c->faults = c->calls.by.asked ? c->asked_faults : h->faults | (raised == h->seen ? 0 : raised & FAULT_MASK);
    c->cause = cause;
    c->width = 0;
    c->left = back < c->after ? c->after - back : 0;
    c->state = HBP_CAPTURE_TRIGGERED;
    if (!c->left) {
        c->running = 0;
        c->skip = 1; /* all records have been taken */
    }
}

/* Something but a channel tells that the trigger has come; where an edge tells, perhaps only with a later period. */
static void called(struct hbp *h, struct hbp_capture *c, uint32_t value)
{
    uint32_t tick = (uint32_t)h->config->tick0 + (uint32_t)h->index * h->period, late = tick - c->asked_tick;
    if (c->calls.by.fresh) {
        c->skip = (uint16_t)(hbp_rounded_up(h->index, c->decimation) * c->decimation - (uint32_t)h->index);
        c->calls.by.fresh = 0;
        if (c->width && c->trigger == HBP_TRIGGER_CHANGES) {
            c->low = value;
            c->span = 0;
            take_others(c);
        }
    }
    if (c->state != HBP_CAPTURE_ARMED) return;
    if (c->calls.by.raised) trigger(h, c, HBP_TRIGGER_FAULT, 0);
    else if (c->calls.by.asked) trigger(h, c, c->calls.by.asked, late < h->config->tick_hz ? late / h->period : 0);
    else if (c->calls.by.edged && c->edge_tick - tick - 1u >= h->period) trigger(h, c, c->trigger, 0);
}

/* Of hbp_capture_tick, what is seldom: by itself, so that the rest needs no registers saved. `value`: of the channel that is watched. */
static HBP_APART void tick_seldom(struct hbp *h, const uint8_t *sample, struct hbp_capture *c, uint32_t value)
{
    if (c->calls.any) called(h, c, value);
    if (c->width && fulfilled(c, value)) {
        if (!c->leaves) trigger(h, c, c->trigger, 0);
        else take_others(c);
        c->leaves = 0;
    }
    if (c->skip) c->skip--;
    else take(h, sample, c);
}

void hbp_capture_tick(struct hbp *h, const uint8_t *sample)
{
    struct hbp_capture *c = h->capture;
    uint32_t value = 0;
    int met = 0;
    if (c->width) {
        value = value_in(c, sample);
        met = fulfilled(c, value);
    }
    if (met || c->calls.any) tick_seldom(h, sample, c, value);
    else if (c->skip) c->skip--;
    else take(h, sample, c);
}

void hbp_capture_edge(struct hbp *h, uint32_t tick, uint8_t codes, uint16_t encoder)
{
    struct hbp_capture *c = h->capture;
    int back = (codes >> 3 & 7u) == c->before_last && tick - c->last_tick <= c->pulse;
    c->before_last = codes & 7u;
    c->last_tick = tick;
    if (!c->calls.by.edged && (c->trigger == HBP_TRIGGER_ILLEGAL ? (codes & ILLEGAL) != 0 : c->trigger == HBP_TRIGGER_PULSE && back)) {
        c->edge_tick = tick;
        c->calls.by.edged = 1;
    }
    c->lost_tick = tick;
    if (c->edge_room) {
        uint8_t *to = h->config->capture + EDGE_BYTES * c->edge_to;
        c->lost_tick = hbp_get32(to); /* where the ring has been filled before */
        (void)hbp_put32(hbp_put32(to, tick), codes | (uint32_t)encoder << 16);
        if (++c->edge_to == c->edge_room) {
            c->edge_to = 0;
            c->edge_wrapped = 1;
        }
    }
    c->edge_end = h->edges + 1u;
}

/* ---- what has been frozen -------------------------------------------------------------------------------------------------- */

static uint32_t later(uint32_t at, uint32_t bytes, uint32_t ring) /* bytes < ring */
{
    return at + bytes < ring ? at + bytes : at + bytes - ring;
}

/* The edges from the first record to the last one, which are `span` ticks apart. */
static void find_edges(struct hbp *h, uint32_t last_tick, uint64_t span, uint32_t begun)
{
    struct hbp_capture *c = h->capture;
    uint32_t ring = EDGE_BYTES * c->edge_room, held = c->edge_wrapped ? c->edge_room : c->edge_to, n = 0;
    uint32_t at = EDGE_BYTES * c->edge_to, end = c->edge_end, tick, later_tick = last_tick;
    uint64_t age = 0;
    int lost = c->edge_room ? c->edge_wrapped : c->before_last != NO_CODE;
    for (; held; held--) {
        uint32_t before = at ? at - EDGE_BYTES : ring - EDGE_BYTES;
        tick = hbp_get32(h->config->capture + before);
        if (n == 0 && (int32_t)(tick - last_tick) > 0) { /* after the last record */
            end--;
        } else {
            age += later_tick - tick;
            if (age > span) break;
            later_tick = tick;
            n++;
        }
        at = before;
    }
    c->edge_start = at;
    c->told[EDGES] = n;
    c->told[FIRST_EDGE] = n ? end - n : 0;
    if (held) return;
    /* Those before are lost, back to the first record: it is only known how many came since the ring of records began anew. */
    if ((int32_t)(end - n - begun) > 0) c->told[EDGES_LOST] = end - n - begun;
    else if (lost && age + (later_tick - c->lost_tick) <= span) c->told[EDGES_LOST] = 1;
}

/* Where blob 1 is in the rings. */
static void find_blob(struct hbp *h)
{
    struct hbp_capture *c = h->capture;
    uint32_t bytes = c->record_bytes, have = held(c) / bytes, end = (uint32_t)(c->to - c->records) % c->ring_bytes;
    uint32_t behind = c->back > c->after ? c->back - c->after : 0; /* records that are newer than what was asked for */
    uint32_t first = have - (behind + c->after), records;
    uint64_t tick = h->config->tick0 + c->index * h->period;
    if (first > c->before) first = c->before;
    records = first + c->after;
    c->start = later(end, c->ring_bytes - (behind + records) * bytes, c->ring_bytes);
    c->told[FIRST] = first;
    c->told[RECORDS] = records;
    c->told[TICK] = (uint32_t)tick;
    c->told[TICK_HIGH] = (uint32_t)(tick >> 32);
    c->told[INDEX] = (uint32_t)c->index;
    c->told[FAULTS] = c->faults;
    c->told[CRC] = 0xFFFFFFFFu;
    bytes = c->decimation * h->period; /* ticks from record to record */
    find_edges(h, (uint32_t)tick + (c->after - 1u) * bytes, (uint64_t)(records - 1u) * c->decimation * h->period, c->edges_begun);
    c->told[SIZE] = records * c->record_bytes + EDGE_BYTES * c->told[EDGES];
}

const uint8_t *hbp_capture_blob(const struct hbp *h, uint32_t offset, uint32_t *n)
{
    const struct hbp_capture *c = h->capture;
    const uint8_t *memory = c->records;
    uint32_t start = c->start, ring = c->ring_bytes, whole = c->told[RECORDS] * c->record_bytes, at;
    if (offset >= whole) {
        offset -= whole;
        memory = h->config->capture;
        start = c->edge_start;
        ring = EDGE_BYTES * c->edge_room;
        whole = EDGE_BYTES * c->told[EDGES];
    }
    at = later(start, offset, ring);
    if (*n > whole - offset) *n = whole - offset;
    if (*n > ring - at) *n = ring - at;
    return memory + at;
}

uint32_t hbp_capture_blob_bytes(const struct hbp *h)
{
    return h->capture->state == HBP_CAPTURE_FROZEN ? h->capture->told[SIZE] : 0;
}

void hbp_capture_poll(struct hbp *h)
{
    struct hbp_capture *c = h->capture;
    uint32_t left = HBP_CAPTURE_PART;
    if (c->state != HBP_CAPTURE_TRIGGERED || c->running) return;
    HBP_BARRIER();
    if (!c->told[SIZE]) {
        find_blob(h);
        c->summed = 0;
    }
    while (left && c->summed < c->told[SIZE]) {
        uint32_t n = left;
        const uint8_t *from = hbp_capture_blob(h, c->summed, &n);
        c->told[CRC] = hbp_crc(c->told[CRC], from, n);
        c->summed += n;
        left -= n;
    }
    if (c->summed < c->told[SIZE]) return;
    c->told[CRC] ^= 0xFFFFFFFFu;
    c->state = HBP_CAPTURE_FROZEN;
    hbp_event(h, HBP_EVENT_CAPTURED, (float)c->number, (float)c->cause);
}

#else

typedef int hbp_capture_is_off; /* a file needs something in it */

#endif
