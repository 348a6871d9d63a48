/* hbp.c: see hbp.h. */
#include "hbp.h"

#include <string.h>

#include "hbp_way.h"

#define REPLY 0x10u
#define ERROR_FLAG 0x20u
#define MAJOR_MASK 0x0Fu
#define HEADER HBP_HEADER
#define CRC_BYTES HBP_CRC_BYTES
#define RECORD 32u
#define STREAM_HEADER 16u
#define EDGE_BYTES 8u
#define WATCHDOG_OFF 0xFFFFu
#define DEFAULT_WATCHDOG 0.2f
#define ARM_SECONDS 5u
#define MAX_LOAD 0.95f
#define MAX_DECIMATION 0xFFFFu
#define FAULT_MASK 0x00FFFFFFu
#define OVERRUN 1u
#define GIVEN (HBP_FEATURE_CAPTURE | HBP_FEATURE_MEANINGS | HBP_FEATURE_WAVEFORM) /* features by what the configuration gives */
#define LACKING (HBP_MEANS ? 0 : HBP_FEATURE_MEANS)
#define DESCRIPTOR 0u /* blobs */
#define CAPTURED 1u
#define MEANINGS 3u
#define WAVEFORM 4u
#define MAX_ENCODED 1041u /* of a frame, delimiters left out */

#define CHECK(name, condition) typedef char hbp_check_##name[(condition) ? 1 : -1]
CHECK(rx_max, HBP_RX_MAX >= 128 && HBP_RX_MAX <= 1024);
CHECK(tx_max, HBP_TX_MAX >= 128 && HBP_TX_MAX <= 1024);
CHECK(tx_bytes, (HBP_TX_BYTES & (HBP_TX_BYTES - 1)) == 0 && HBP_TX_BYTES >= 2 * (HBP_TX_MAX + 24));
CHECK(channels, HBP_CHANNELS >= 1 && HBP_CHANNELS <= 499 && 26 + 2 * HBP_CHANNELS <= HBP_TX_MAX);
CHECK(pools, HBP_POOLS >= 1 && HBP_POOLS <= HBP_STREAMS);
CHECK(pool_bytes, HBP_POOL_BYTES % 4 == 0 && HBP_POOL_BYTES >= 2 * (HBP_TX_MAX + 4));
CHECK(edges, (HBP_EDGES & (HBP_EDGES - 1)) == 0 && HBP_EDGES <= 32768);
CHECK(capture, HBP_CAPTURE == 0 || (HBP_CAPTURE == 1 && 22 + 2 * HBP_CHANNELS <= HBP_TX_MAX && HBP_CAPTURE_PART >= 1));
CHECK(means, HBP_MEANS == 0 || HBP_MEANS == 1);
CHECK(hosts, HBP_HOSTS >= 1 && HBP_HOSTS <= 16);

const uint8_t hbp_widths[] = {0, 1, 1, 2, 2, 4, 4, 4};

/* ---- bytes --------------------------------------------------------------------------------------------------------------- */

#ifdef HBP_BYTE_BY_BYTE
uint8_t *hbp_put16(uint8_t *to, uint32_t value)
{
    to[0] = (uint8_t)value;
    to[1] = (uint8_t)(value >> 8);
    return to + 2;
}

uint8_t *hbp_put32(uint8_t *to, uint32_t value)
{
    return hbp_put16(hbp_put16(to, value & 0xFFFFu), value >> 16);
}

uint16_t hbp_get16(const uint8_t *from)
{
    return (uint16_t)(from[0] | from[1] << 8);
}

uint32_t hbp_get32(const uint8_t *from)
{
    return hbp_get16(from) | (uint32_t)hbp_get16(from + 2) << 16;
}

#endif

static uint8_t *put64(uint8_t *to, uint64_t value)
{
    return hbp_put32(hbp_put32(to, (uint32_t)value), (uint32_t)(value >> 32));
}

static uint32_t bits_of(float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

static uint8_t *put_float(uint8_t *to, float value)
{
    return hbp_put32(to, bits_of(value));
}

static size_t text_length(const char *text)
{
    size_t n = 0;
    while (text && text[n]) n++;
    return n;
}

static int control(char letter)
{
    return (uint8_t)letter < 0x20u || letter == 0x7F;
}

static int same_text(const char *a, const char *b)
{
    while (*a && *a == *b) a++, b++;
    return *a == *b;
}

static uint8_t *put_text(uint8_t *to, const char *text, size_t size)
{
    size_t n = text_length(text);
    memset(to, 0, size);
    if (n) memcpy(to, text, n < size ? n : size);
    return to + size;
}

float hbp_get_float(const uint8_t *from)
{
    uint32_t bits = hbp_get32(from);
    float value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

int hbp_finite(float value)
{
    return (bits_of(value) & 0x7F800000u) != 0x7F800000u;
}

static int whole_number(float value)
{
    if (value >= 8388608.0f || value <= -8388608.0f) return 1; /* 2^23: no fraction is left */
    return (float)(int32_t)value == value;
}

/* n % d, bit by bit: the compiler's own division of 64 bits is 700 bytes, and this is seldom needed. */
static uint32_t remainder_of(uint64_t n, uint32_t d)
{
    uint64_t rest = 0;
    for (int bits = 64; bits; bits--, n <<= 1) {
        rest = rest << 1 | n >> 63;
        if (rest >= d) rest -= d;
    }
    return (uint32_t)rest;
}

/* So many milliseconds, in periods of a frequency. */
static uint32_t periods_in(uint32_t ms, uint32_t hz)
{
    return ms * (hz / 1000u) + ms * (hz % 1000u) / 1000u;
}

/* CRC-32/ISO-HDLC, polynomial 0xEDB88320 (reflected); begin with 0xFFFFFFFF, invert the end. */
uint32_t hbp_crc(uint32_t crc, const uint8_t *data, size_t n)
{
#if HBP_CRC_TABLE == 256
    static uint32_t table[256];
    if (!table[1]) {
        for (uint32_t k = 0; k < 256; k++) {
            uint32_t value = k;
            for (int bit = 0; bit < 8; bit++) value = value >> 1 ^ (value & 1 ? 0xEDB88320u : 0);
            table[k] = value;
        }
    }
    while (n--) crc = table[(crc ^ *data++) & 0xFF] ^ crc >> 8;
#else
    static const uint32_t table[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu,
    };
    while (n--) {
        crc ^= *data++;
        crc = table[crc & 15] ^ crc >> 4;
        crc = table[crc & 15] ^ crc >> 4;
    }
#endif
    return crc;
}

/* ---- messages to the host ------------------------------------------------------------------------------------------------ */

uint8_t *hbp_put_header(struct hbp *h, const struct hbp_message *message)
{
    uint8_t *start = h->link->work - HEADER, *to = start;
    *to++ = message->type;
    *to++ = message->flags;
    to = hbp_put16(hbp_put16(to, message->tid), message->n);
    *to++ = h->config->node;
    *to = 0;
    return start;
}

static int send(struct hbp *h, enum hbp_rank rank, uint8_t type, size_t n)
{
    struct hbp_message message = {type, HBP_MAJOR, 0, (uint16_t)n, rank, HBP_NEXT_TRANSFER};
    return h->link->way->send(h, &message);
}

void hbp_event(struct hbp *h, uint32_t code, float arg, float detail)
{
    uint8_t *to = put64(h->link->work, h->now);
    to = hbp_put16(to, code);
    *to++ = h->config->node;
    *to++ = 0;
    to = put_float(put_float(to, arg), detail);
    send(h, HBP_RANK_NEWS, HBP_TYPE_EVENT, (size_t)(to - h->link->work));
}

void hbp_log(struct hbp *h, uint8_t level, const char *text)
{
    size_t n = text_length(text), most = h->peer->tx_max;
    if (most > h->link->most_news) most = h->link->most_news;
    if (n >= most) n = most - 1u;
    h->link->work[0] = level;
    for (size_t k = 0; k < n; k++) h->link->work[1 + k] = (uint8_t)(control(text[k]) ? ' ' : text[k]);
    send(h, HBP_RANK_NEWS, HBP_TYPE_LOG, n + 1);
}

static int outputs_on(const struct hbp *h)
{
    return h->config->outputs_on(h->config->user) != 0;
}

/* ---- states, faults, watchdog -------------------------------------------------------------------------------------------- */

static float parameter_value(const struct hbp *h, uint16_t k)
{
    const struct hbp_config *config = h->config;
    return config->get ? config->get(config->user, k) : *config->parameters[k].value;
}

static uint32_t watchdog_ticks(const struct hbp *h)
{
    float seconds = h->watchdog == HBP_NONE ? DEFAULT_WATCHDOG : parameter_value(h, h->watchdog);
    return (uint32_t)(seconds * (float)h->config->tick_hz + 0.5f);
}

/* A value that is within its range, or that the application refuses. */
static uint16_t store_parameter(struct hbp *h, uint16_t k, float value)
{
    const struct hbp_config *config = h->config;
    float before = parameter_value(h, k), after;
    uint16_t code = config->set ? config->set(config->user, k, value, &h->detail) : 0;
    if (code) return code;
    if (!config->get) *config->parameters[k].value = value;
    if (k == h->watchdog) h->leash_ticks = watchdog_ticks(h);
    after = parameter_value(h, k);
    if (after < before || after > before) hbp_event(h, HBP_EVENT_PARAM_CHANGED, (float)config->parameters[k].id, after);
    return 0;
}

/* RUNNING has ended, or not yet begun. */
static void reset_volatile(struct hbp *h)
{
    for (uint16_t k = 0; k < h->config->n_parameters; k++) {
        const struct hbp_parameter *p = &h->config->parameters[k];
        float value = parameter_value(h, k);
        if ((p->flags & HBP_FLAG_VOLATILE) && (value < p->initial || value > p->initial)) (void)store_parameter(h, k, p->initial);
    }
}

static int live(const struct hbp *h)
{
    return h->state == HBP_STATE_ARMED || h->state == HBP_STATE_RUNNING;
}

static void feed(struct hbp *h)
{
    h->fed = h->now;
    h->leash = (uint32_t)h->now;
    h->leash_ticks = watchdog_ticks(h);
}

/* The trigger of a capture that waits for it has come. */
static void ask_capture(struct hbp *h, uint8_t trigger)
{
#if HBP_CAPTURE
    if (h->capture) hbp_capture_ask(h, trigger);
#else
    (void)h, (void)trigger;
#endif
}

/* A refusal whose detail is a whole number. */
uint16_t hbp_refuse(struct hbp *h, uint16_t code, uint32_t number)
{
    h->detail = (float)number;
    return code;
}

static uint16_t wrong_state(struct hbp *h)
{
    return hbp_refuse(h, HBP_ERROR_WRONG_STATE, h->state);
}

static uint16_t enter(struct hbp *h, uint8_t state)
{
    uint16_t code;
    uint8_t before = h->state;
    if (state == HBP_STATE_RUNNING) h->runs++;
    HBP_BARRIER();
    h->permit = state == HBP_STATE_RUNNING;
    HBP_BARRIER();
    code = h->config->enter(h->config->user, state, &h->detail);
    if (code && (state == HBP_STATE_ARMED || state == HBP_STATE_RUNNING)) {
        h->permit = h->state == HBP_STATE_RUNNING;
        return code;
    }
    if (h->faults && state != HBP_STATE_FAULT) return wrong_state(h); /* the application called hbp_fault meanwhile */
    h->state = state;
    hbp_event(h, HBP_EVENT_STATE_CHANGED, (float)state, 0.0f);
    ask_capture(h, HBP_TRIGGER_STATE);
    if (before == HBP_STATE_RUNNING || before == HBP_STATE_BOOT) reset_volatile(h);
    return 0;
}

void hbp_fault(struct hbp *h, uint32_t faults)
{
    uint32_t fresh = faults & FAULT_MASK & ~h->faults;
    float detail = h->detail; /* of a request that the application may be refusing */
    if (!fresh) return;
    if (!h->faults) h->first_fault = fresh;
    h->faults |= fresh;
    ask_capture(h, HBP_TRIGGER_FAULT);
    if (h->state != HBP_STATE_FAULT) enter(h, HBP_STATE_FAULT);
    h->detail = detail;
    hbp_event(h, HBP_EVENT_FAULT, (float)fresh, 0.0f);
}

/* Only the interrupt writes `raised`, only the main loop `seen`. What has been seen is begun anew, with another count; it counts new
 * bits only, so that it cannot come round to what has been seen however often a fault is raised. */
void hbp_raise(struct hbp *h, uint32_t faults)
{
    uint32_t raised = h->raised, before = raised == h->seen ? 0 : raised & FAULT_MASK;
    if (!(faults & FAULT_MASK & ~before)) return;
    h->raised = ((raised & ~FAULT_MASK) + FAULT_MASK + 1u) | before | (faults & FAULT_MASK);
#if HBP_CAPTURE
    if (h->capture && (faults & FAULT_MASK & ~h->faults)) h->capture->calls.by.raised = 1;
#endif
}

int hbp_may_run(struct hbp *h, uint32_t tick)
{
    if (!h->permit || h->cut == h->runs) return 0;
    if ((int32_t)(tick - h->leash) < (int32_t)h->leash_ticks) return 1;
    h->cut = h->runs; /* until the next START */
    return 0;
}

void hbp_pass_time(struct hbp *h, uint64_t now)
{
    uint32_t raised = h->raised;
    h->now = now;
    if (raised != h->seen) {
        h->seen = raised;
        hbp_fault(h, raised & FAULT_MASK);
    }
    if (h->state == HBP_STATE_BOOT) {
        enter(h, HBP_STATE_IDLE);
    } else if (live(h) && (now - h->fed >= watchdog_ticks(h) || (h->permit && h->cut == h->runs))) {
        hbp_fault(h, HBP_FAULT_WATCHDOG);
    } else if (h->state == HBP_STATE_ARMED && now - h->armed >= (uint64_t)ARM_SECONDS * h->config->tick_hz) {
        hbp_event(h, HBP_EVENT_ARM_LAPSED, (float)ARM_SECONDS, 0.0f);
        enter(h, HBP_STATE_IDLE);
    }
}

static uint16_t arm(struct hbp *h, uint32_t token)
{
    uint16_t code = 0;
    if (token != h->boot_id) return HBP_ERROR_BAD_TOKEN;
    if (h->state != HBP_STATE_IDLE && h->state != HBP_STATE_ARMED) return wrong_state(h);
    if (h->state == HBP_STATE_IDLE) code = enter(h, HBP_STATE_ARMED);
    if (code) return code;
    h->armed = h->now;
    feed(h);
    return 0;
}

static uint16_t start(struct hbp *h, uint32_t argument)
{
    if (argument) return hbp_refuse(h, HBP_ERROR_BAD_VALUE, argument);
    if (!live(h)) return wrong_state(h);
    return h->state == HBP_STATE_ARMED ? enter(h, HBP_STATE_RUNNING) : 0;
}

void hbp_stop(struct hbp *h)
{
    if (live(h)) enter(h, HBP_STATE_IDLE);
}

static uint16_t clear(struct hbp *h, uint32_t faults)
{
    uint32_t persist;
    if (h->state != HBP_STATE_FAULT) return wrong_state(h);
    if (faults != h->faults) return hbp_refuse(h, HBP_ERROR_FAULTS_CHANGED, h->faults);
    persist = h->config->clear ? h->config->clear(h->config->user, faults) : 0;
    if (persist) return hbp_refuse(h, HBP_ERROR_FAULT_PERSISTS, persist);
    h->faults = h->first_fault = 0;
    return enter(h, HBP_STATE_IDLE);
}

/* ---- requests: each writes its reply into link->work, and its length into h->answered; or returns a code ----------------- */

typedef uint16_t answer(struct hbp *h, const uint8_t *in);

uint16_t hbp_finish(struct hbp *h, const uint8_t *end)
{
    h->answered = (uint16_t)(end - h->link->work);
    return 0;
}

uint16_t hbp_next_number(uint16_t number)
{
    return (uint16_t)(number < 0xFFFFu ? number + 1u : 1u);
}

static uint16_t hello(struct hbp *h, const uint8_t *in)
{
    const struct hbp_config *config = h->config;
    uint32_t nonce = hbp_get32(in);
    uint16_t rx_max = hbp_get16(in + 6);
    uint8_t *to = h->link->work;
    if (in[4] > HBP_MAJOR || in[5] < HBP_MAJOR) return hbp_refuse(h, HBP_ERROR_BAD_VERSION, HBP_MAJOR);
    if (rx_max < 128) return hbp_refuse(h, HBP_ERROR_OUT_OF_RANGE, 128);
    if (!h->peer->greeted || nonce != h->peer->nonce || rx_max != h->peer->rx_max) { /* a new host may use the same tids again */
        for (unsigned k = 0; k < HBP_KEPT; k++) h->peer->kept[k].there = 0;
        h->peer->nonce = nonce;
        h->peer->rx_max = rx_max;
        h->peer->tx_max = rx_max < h->link->most ? rx_max : h->link->most;
        h->peer->greeted = 1;
    }
    to = hbp_put32(hbp_put32(to, nonce), h->boot_id);
    *to++ = HBP_MAJOR;
    *to++ = HBP_MINOR;
    to = hbp_put16(hbp_put16(hbp_put16(to, HBP_RX_MAX), h->peer->tx_max), 0);
    to = hbp_put32(hbp_put32(to, h->features), h->schema_crc);
    to = hbp_put32(hbp_put32(to, config->tick_hz), config->pwm_hz);
    *to++ = h->state;
    *to++ = config->node;
    *to++ = config->role;
    *to++ = h->link->nodes;
    to = put_text(put_text(to, config->name, 16), config->firmware, 16);
    to = put_text(put_text(to, config->serial, 24), config->build, 24);
    return hbp_finish(h, to);
}

static uint16_t time_sync(struct hbp *h, const uint8_t *in)
{
    (void)in;
    return hbp_finish(h, put64(put64(h->link->work, h->now), h->now));
}

static uint16_t alive(struct hbp *h, const uint8_t *in)
{
    (void)in;
    feed(h);
    return 0;
}

static void record_bytes(const struct hbp_config *config, uint32_t k, uint8_t *to)
{
    uint32_t channel = k < config->n_channels;
    const struct hbp_channel *c = &config->channels[channel ? k : 0];
    const struct hbp_parameter *p = &config->parameters[channel ? 0 : k - config->n_channels];
    to = hbp_put16(to, channel ? c->id : p->id);
    *to++ = channel ? c->type : HBP_RAW_F32;
    *to++ = channel ? c->unit : p->unit;
    to = hbp_put16(to, channel ? c->flags | HBP_FLAG_CHANNEL : p->flags | HBP_FLAG_PARAMETER);
    to = hbp_put16(to, 0);
    to = put_float(put_float(to, channel ? c->scale : 1.0f), channel ? c->offset : 0.0f);
    put_text(to, channel ? c->name : p->name, 16);
}

/* Whether the device has a blob, and its bytes. */
static int find_blob(const struct hbp *h, uint8_t id, uint32_t *total)
{
    const struct hbp_config *config = h->config;
    *total = 0;
    switch (id) {
    case DESCRIPTOR: *total = RECORD * ((uint32_t)config->n_channels + config->n_parameters); return 1;
#if HBP_CAPTURE
    case CAPTURED: *total = h->capture ? hbp_capture_blob_bytes(h) : 0; return *total != 0;
#endif
    case MEANINGS: *total = (uint32_t)text_length(config->meanings); return config->meanings != NULL;
#if HBP_WAVEFORM
    case WAVEFORM: *total = 2u * config->waveform_length; return config->waveform != NULL;
#endif
    default: return 0;
    }
}

/* Bytes of a blob from `offset` on, *n at most, which becomes how many; some of them are made in `made`. */
static const uint8_t *blob_part(const struct hbp *h, uint8_t id, uint32_t offset, uint32_t *n, uint8_t made[RECORD])
{
    uint32_t at = offset % RECORD;
    switch (id) {
    case DESCRIPTOR:
        record_bytes(h->config, offset / RECORD, made);
        if (*n > RECORD - at) *n = RECORD - at;
        return made + at;
#if HBP_CAPTURE
    case CAPTURED: return hbp_capture_blob(h, offset, n);
#endif
#if HBP_WAVEFORM
    case WAVEFORM:
#if HBP_LITTLE_ENDIAN
        return (const uint8_t *)h->config->waveform + offset;
#else
        (void)hbp_put16(made, (uint16_t)h->config->waveform[offset / 2u]);
        *n = 1;
        return made + offset % 2u;
#endif
#endif
    default: return (const uint8_t *)h->config->meanings + offset;
    }
}

static uint16_t blob_reply(struct hbp *h, uint8_t id, uint32_t offset, uint32_t length, uint32_t total)
{
    uint8_t *to = h->link->work, made[RECORD];
    *to++ = id;
    *to++ = 0;
    to = hbp_put32(hbp_put32(hbp_put16(to, length), offset), total);
    while (length) {
        uint32_t n = length;
        const uint8_t *from = blob_part(h, id, offset, &n, made);
        memcpy(to, from, n);
        to += n, offset += n, length -= n;
    }
    return hbp_finish(h, to);
}

static uint16_t blob_read(struct hbp *h, const uint8_t *in)
{
    uint32_t wanted = hbp_get16(in + 2), offset = hbp_get32(in + 4), total, room = h->peer->tx_max - 12u;
    if (!find_blob(h, in[0], &total)) return hbp_refuse(h, HBP_ERROR_UNKNOWN_ID, in[0]);
    if (offset > total) return hbp_refuse(h, HBP_ERROR_OUT_OF_RANGE, total);
    if (wanted > room) wanted = room;
    if (wanted > total - offset) wanted = total - offset;
    return blob_reply(h, in[0], offset, wanted, total);
}

#if HBP_WAVEFORM
static uint16_t blob_write(struct hbp *h, const uint8_t *in)
{
    uint32_t more = hbp_get16(in + 2), offset = hbp_get32(in + 4), total;
    if (!find_blob(h, in[0], &total)) return hbp_refuse(h, HBP_ERROR_UNKNOWN_ID, in[0]);
    if (in[0] != WAVEFORM) return hbp_refuse(h, HBP_ERROR_READ_ONLY, in[0]);
    if (offset > total || more > total - offset) return hbp_refuse(h, HBP_ERROR_OUT_OF_RANGE, total);
    if (h->test != HBP_NONE && (parameter_value(h, h->test) < 0.0f || parameter_value(h, h->test) > 0.0f))
        return hbp_refuse(h, HBP_ERROR_BUSY, in[0]);
#if HBP_LITTLE_ENDIAN
    memcpy((uint8_t *)h->config->waveform + offset, in + 8, more);
#else
    for (in += 8; more--; offset++) {
        uint8_t both[2];
        int16_t *sample = &h->config->waveform[offset / 2u];
        (void)hbp_put16(both, (uint16_t)*sample);
        both[offset % 2u] = *in++;
        *sample = (int16_t)hbp_get16(both);
    }
#endif
    return 0;
}
#endif

static uint16_t parameter(struct hbp *h, const uint8_t *in, uint16_t *k)
{
    uint16_t id = hbp_get16(in);
    for (*k = 0; *k < h->config->n_parameters; ++*k)
        if (h->config->parameters[*k].id == id) return 0;
    return hbp_refuse(h, HBP_ERROR_UNKNOWN_ID, id);
}

static uint16_t param_get(struct hbp *h, const uint8_t *in)
{
    uint16_t k, code = parameter(h, in, &k);
    const struct hbp_parameter *p;
    uint8_t *to;
    if (code) return code;
    p = &h->config->parameters[k];
    to = hbp_put16(hbp_put16(h->link->work, p->id), 0);
    to = put_float(put_float(to, parameter_value(h, k)), p->lo);
    return hbp_finish(h, put_float(put_float(to, p->hi), p->initial));
}

static uint16_t param_set(struct hbp *h, const uint8_t *in)
{
    const struct hbp_config *config = h->config;
    uint16_t k, code = parameter(h, in, &k);
    const struct hbp_parameter *p;
    float value = hbp_get_float(in + 4);
    if (code) return code;
    p = &config->parameters[k];
    if (p->flags & HBP_FLAG_READ_ONLY) return hbp_refuse(h, HBP_ERROR_READ_ONLY, p->id);
    h->detail = value;
    if (!hbp_finite(value) || ((p->flags & HBP_FLAG_WHOLE) && !whole_number(value))) return HBP_ERROR_BAD_VALUE;
    h->detail = value < p->lo ? p->lo : p->hi;
    if (value < p->lo || value > p->hi) return HBP_ERROR_OUT_OF_RANGE;
    if ((p->flags & HBP_FLAG_IDLE_ONLY) && outputs_on(h)) return wrong_state(h);
    h->detail = 0.0f;
    code = store_parameter(h, k, value);
    if (code) return code;
    return hbp_finish(h, put_float(hbp_put16(hbp_put16(h->link->work, p->id), 0), parameter_value(h, k)));
}

static uint16_t param_commit(struct hbp *h, const uint8_t *in)
{
    (void)in;
    if (outputs_on(h)) return wrong_state(h);
    return h->config->commit ? h->config->commit(h->config->user, &h->detail) : HBP_ERROR_NOT_SUPPORTED;
}

static uint16_t state_cmd(struct hbp *h, const uint8_t *in)
{
    uint32_t argument = hbp_get32(in + 4);
    uint16_t code = 0;
    switch (in[0]) {
    case HBP_COMMAND_ARM: code = arm(h, argument); break;
    case HBP_COMMAND_START: code = start(h, argument); break;
    case HBP_COMMAND_STOP: hbp_stop(h); break;
    case HBP_COMMAND_FAULT_CLEAR: code = clear(h, argument); break;
    default: return hbp_refuse(h, HBP_ERROR_BAD_VALUE, in[0]);
    }
    return code ? code : hbp_finish(h, hbp_put32(h->link->work, h->state));
}

static void reject(struct hbp *h, uint16_t code)
{
    h->setpoints_rejected++;
    hbp_event(h, HBP_EVENT_SETPOINT_REJECTED, (float)code, h->detail);
}

static uint16_t use_setpoint(struct hbp *h, const uint8_t *in)
{
    float value = hbp_get_float(in + 4), value2 = hbp_get_float(in + 8);
    if (h->state != HBP_STATE_RUNNING) return wrong_state(h);
    h->detail = hbp_finite(value) ? value2 : value;
    if (!hbp_finite(h->detail)) return HBP_ERROR_BAD_VALUE;
    h->detail = 0.0f;
    return h->config->setpoint(h->config->user, in[0], value, value2, &h->detail);
}

static uint16_t setpoint(struct hbp *h, const uint8_t *in)
{
    uint16_t code = use_setpoint(h, in);
    if (code) {
        reject(h, code);
        return 0; /* there is no other answer */
    }
    h->setpoint_counter = hbp_get16(in + 2);
    feed(h);
    return 0;
}

/* ---- streams ------------------------------------------------------------------------------------------------------------- */

static struct hbp_block *block_at(const struct hbp *h, const struct hbp_stream *s, uint32_t place)
{
    return (struct hbp_block *)(uintptr_t)&h->pools[s->pool][(size_t)place * s->stride];
}

static uint8_t *records_of(struct hbp_block *block)
{
    return (uint8_t *)(block + 1);
}

uint32_t hbp_in_time(const struct hbp *h, uint32_t latency_ms, uint32_t decimation)
{
    return periods_in(latency_ms, h->config->pwm_hz) / decimation;
}

/* What waits of a stream that is no more, or never was sent, is lost. */
static void forget(struct hbp *h, struct hbp_stream *s)
{
    h->dropped += s->dropped + s->lost + (s->head - s->tail) * s->groups;
    memset(s, 0, sizeof *s);
}

static uint8_t free_pool(struct hbp *h, const struct hbp_stream *mine)
{
    for (uint8_t pool = 0; pool < HBP_POOLS; pool++) {
        struct hbp_stream *user = NULL;
        for (unsigned k = 0; k < HBP_STREAMS; k++) {
            struct hbp_stream *s = &h->streams[k];
            if (s != mine && s->pool == pool && s->stride) user = s;
        }
        if (!user) return pool;
        if (!user->configured) { /* it is only being emptied */
            forget(h, user);
            return pool;
        }
    }
    return HBP_POOLS;
}

static float load(const struct hbp *h, const struct hbp_stream *mine, float rate)
{
    if (h->link->capacity <= 0.0f) return 0.0f;
    for (const struct hbp *each = h->link->first; each; each = each->other)
        for (unsigned k = 0; k < HBP_STREAMS; k++)
            if (&each->streams[k] != mine && each->streams[k].configured) rate += each->streams[k].rate;
    return rate / h->link->capacity;
}

static uint32_t decimation_that_fits(struct hbp *h, const struct hbp_stream *mine, struct hbp_stream *wanted)
{
    uint32_t low = wanted->decimation + 1u, high = MAX_DECIMATION + 1u;
    if (wanted->event == HBP_STREAM_EDGES || load(h, mine, 0.0f) > MAX_LOAD) return 0;
    while (low < high) { /* the first one that fits lies in low … high - 1, or is none */
        uint32_t middle = (low + high) / 2u;
        wanted->decimation = (uint16_t)middle;
        h->link->way->shape(h, wanted);
        if (load(h, mine, wanted->rate) <= MAX_LOAD) high = middle;
        else low = middle + 1u;
    }
    return low <= MAX_DECIMATION ? low : 0;
}

/* The channel with this id, or null. */
const struct hbp_channel *hbp_find_channel(const struct hbp *h, uint32_t id)
{
    const struct hbp_channel *channel = h->config->channels;
    for (uint32_t left = h->config->n_channels; left--; channel++)
        if (channel->id == id) return channel;
    return NULL;
}

/* Whether n ids are of channels, each another one; the bytes of a record of them. */
uint16_t hbp_choose(struct hbp *h, const uint8_t *ids, uint32_t n, uint32_t *bytes)
{
    *bytes = 0;
    for (uint32_t k = 0; k < n; k++) {
        uint16_t id = hbp_get16(ids + 2 * k);
        const struct hbp_channel *channel = hbp_find_channel(h, id);
        if (!channel) return hbp_refuse(h, HBP_ERROR_UNKNOWN_ID, id);
        for (uint32_t before = 0; before < k; before++)
            if (hbp_get16(ids + 2 * before) == id) return hbp_refuse(h, HBP_ERROR_BAD_VALUE, id);
        *bytes += hbp_widths[channel->type];
    }
    return 0;
}

/* Positions of channels that hbp_choose has found right. */
void hbp_take_channels(const struct hbp *h, const uint8_t *ids, uint32_t n, uint16_t *take)
{
    for (; n--; ids += 2) *take++ = (uint16_t)(hbp_find_channel(h, hbp_get16(ids)) - h->config->channels);
}

static uint16_t configure(struct hbp *h, struct hbp_stream *s, const uint8_t *in)
{
    uint16_t channels = s->channels, code;
    uint32_t bytes;
    if (s->event == HBP_STREAM_EDGES && (h->config->features & HBP_FEATURE_EDGES)) {
        if (channels) return hbp_refuse(h, HBP_ERROR_BAD_VALUE, channels);
        s->record_bytes = EDGE_BYTES;
    } else {
        int means = hbp_has_means(s) && (h->features & HBP_FEATURE_MEANS);
        if (s->event != HBP_STREAM_PWM && !means) return hbp_refuse(h, HBP_ERROR_NOT_SUPPORTED, s->event);
        if (!s->decimation || !channels) return HBP_ERROR_BAD_VALUE;
        code = hbp_choose(h, in + 8, channels, &bytes);
        if (code) return code;
        hbp_take_channels(h, in + 8, channels, s->take);
        s->record_bytes = (uint16_t)(means ? 4u * channels : bytes);
        if (means) hbp_means_prepare(h, s);
    }
    return 0;
}

static uint16_t fit(struct hbp *h, struct hbp_stream *s, const struct hbp_stream *mine, float *share)
{
    uint32_t fits = h->link->way->shape(h, s);
    if (fits) return hbp_refuse(h, HBP_ERROR_DOES_NOT_FIT, fits);
    *share = load(h, mine, s->rate);
    if (*share > MAX_LOAD) return hbp_refuse(h, HBP_ERROR_DOES_NOT_FIT, decimation_that_fits(h, mine, s));
    if (s->event != HBP_STREAM_EDGES) {
        uint32_t header = sizeof(struct hbp_block), most = HBP_POOL_BYTES / 2u - header;
        if ((uint32_t)s->block * s->record_bytes > most) s->block = (uint16_t)(most / s->record_bytes);
        s->pool = s->block ? free_pool(h, mine) : HBP_POOLS;
        if (s->pool == HBP_POOLS) return HBP_ERROR_DOES_NOT_FIT;
        s->stride = (uint16_t)((header + (uint32_t)s->block * s->record_bytes + 3u) / 4u);
        s->places = HBP_POOL_BYTES / 4u / s->stride;
    }
    return 0;
}

static uint16_t stream_set(struct hbp *h, const uint8_t *in)
{
    struct hbp_stream wanted, *s = &h->streams[in[0] & 3u];
    float share = 0.0f;
    uint16_t code;
    uint8_t *to = h->link->work;
    if (in[0] >= HBP_STREAMS) return hbp_refuse(h, HBP_ERROR_OUT_OF_RANGE, HBP_STREAMS - 1);
    memset(&wanted, 0, sizeof wanted);
    wanted.number = in[0];
    wanted.event = in[1];
    wanted.decimation = hbp_get16(in + 2);
    wanted.latency_ms = hbp_get16(in + 4);
    wanted.channels = hbp_get16(in + 6);
    wanted.groups = 1;
    wanted.counts_samples = h->link->way->counts_samples;
    code = configure(h, &wanted, in);
    if (code) return code;
    if (s->running) return hbp_refuse(h, HBP_ERROR_BUSY, in[0]);
    code = fit(h, &wanted, s, &share);
    if (!code) code = h->link->way->open(h, &wanted);
    if (code) return code;
    forget(h, s);
    wanted.cfg_id = h->cfg_id = hbp_next_number(h->cfg_id);
    wanted.configured = 1;
    *s = wanted;
    *to++ = s->number;
    *to++ = 0;
    to = hbp_put16(hbp_put16(hbp_put16(to, s->cfg_id), s->record_bytes), s->block);
    to = put_float(to, share);
    *to++ = s->slot;
    memset(to, 0, 3);
    return hbp_finish(h, put64(to + 3, h->config->tick0));
}

static uint16_t stream_get(struct hbp *h, const uint8_t *in)
{
    const struct hbp_stream *s = &h->streams[in[0] & 3u];
    uint16_t channels = s->channels, most = (uint16_t)((h->peer->tx_max - 26u) / 2u);
    uint8_t *to = h->link->work;
    if (channels > most) channels = most;
    if (in[0] >= HBP_STREAMS) return hbp_refuse(h, HBP_ERROR_OUT_OF_RANGE, HBP_STREAMS - 1);
    if (!s->configured) return hbp_refuse(h, HBP_ERROR_UNKNOWN_ID, in[0]);
    *to++ = s->number;
    *to++ = s->running;
    *to++ = s->event;
    *to++ = s->slot;
    to = hbp_put16(hbp_put16(hbp_put16(to, s->decimation), s->latency_ms), s->cfg_id);
    to = hbp_put16(hbp_put16(hbp_put16(to, s->record_bytes), s->block), 0);
    to = hbp_put16(put64(to, h->config->tick0), channels);
    for (unsigned k = 0; k < channels; k++) to = hbp_put16(to, h->config->channels[s->take[k]].id);
    return hbp_finish(h, to);
}

static uint16_t stream_start(struct hbp *h, const uint8_t *in)
{
    uint32_t mask = hbp_get32(in);
    for (unsigned k = 0; k < 32; k++)
        if ((mask >> k & 1u) && (k >= HBP_STREAMS || !h->streams[k].configured)) return hbp_refuse(h, HBP_ERROR_UNKNOWN_ID, k);
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        struct hbp_stream *s = &h->streams[k];
        if (!(mask >> k & 1u) || s->running) continue;
        do {
            s->edge = h->edge_head;
            HBP_BARRIER();
            s->edge_index = h->edges;
        } while (s->edge != h->edge_head);
        HBP_BARRIER();
        s->running = 1;
    }
    return 0;
}

static int send_edges(struct hbp *h);
static int send_blocks(struct hbp *h);

static uint16_t stream_stop(struct hbp *h, const uint8_t *in)
{
    uint32_t mask = hbp_get32(in);
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        struct hbp_stream *s = &h->streams[k];
        if (!(mask >> k & 1u) || s->event == HBP_STREAM_EDGES) continue;
        s->running = 0;
        HBP_BARRIER();
        if (!s->filled || s->counts_samples) continue; /* on CAN, less than a frame is not sent */
        if (s->dropping) {
            s->dropped++;
        } else { /* the interrupt is out of it: what it has begun is sent */
            block_at(h, s, s->write)->n = s->filled;
            s->head++;
        }
        s->filled = 0;
    }
    if (send_edges(h)) send_blocks(h);
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        struct hbp_stream *s = &h->streams[k];
        if (!(mask >> k & 1u) || !s->configured) continue;
        s->configured = 0;
        s->running = 0;
        if (s->event == HBP_STREAM_EDGES && s->waits) s->lost++; /* those that come meanwhile are not its own any more */
    }
    return 0;
}

/* ---- what the interrupts do ---------------------------------------------------------------------------------------------- */

static void begin_block(struct hbp *h, struct hbp_stream *s, uint32_t index)
{
    struct hbp_block *block = block_at(h, s, s->write);
    s->dropping = s->head - s->tail >= s->places;
    if (s->dropping) return;
    block->index = index;
    block->seq = s->seq;
    block->n = s->block;
    block->flags = s->flags;
}

static void end_block(struct hbp_stream *s)
{
    s->filled = 0;
    s->seq = (uint16_t)(s->seq + (s->counts_samples ? s->block : 1u));
    if (s->dropping) {
        s->dropped += s->groups;
        s->flags = OVERRUN;
        return;
    }
    s->flags = 0;
    s->write = s->write + 1u < s->places ? s->write + 1u : 0u;
    HBP_BARRIER();
    s->head++;
}

void hbp_copy_sample(const struct hbp *h, const uint16_t *take, uint32_t n, const uint8_t *sample, uint8_t *to)
{
    for (uint32_t k = 0; k < n; k++) {
        const struct hbp_channel *channel = &h->config->channels[take[k]];
        const uint8_t *from = sample + channel->at;
        uint16_t half;
        uint32_t word;
        switch (hbp_widths[channel->type]) {
        case 1:
            *to++ = *from;
            break;
        case 2:
            memcpy(&half, from, sizeof half);
            to = hbp_put16(to, half);
            break;
        default:
            memcpy(&word, from, sizeof word);
            to = hbp_put32(to, word);
        }
    }
}

static HBP_APART void take(struct hbp *h, struct hbp_stream *s, uint32_t index, const uint8_t *sample)
{
    if (!s->filled) begin_block(h, s, index);
    if (!s->dropping) {
        uint8_t *to = records_of(block_at(h, s, s->write)) + (size_t)s->filled * s->record_bytes;
        if (hbp_has_means(s)) hbp_means_put(h, s, sample, to);
        else hbp_copy_sample(h, s->take, s->channels, sample, to);
    }
    if (++s->filled == s->block) end_block(s);
}

/* The lower 32 bits of index / decimation, rounded up: by 16 bits at a time, which a core divides at once. */
uint32_t hbp_rounded_up(uint64_t index, uint16_t decimation)
{
    uint32_t number = 0, rest = 0;
    index += decimation - 1u;
    for (int shift = 48; shift >= 0; shift -= 16) {
        uint32_t part = rest << 16 | (uint32_t)(index >> shift & 0xFFFFu);
        number = number << 16 | part / decimation;
        rest = part % decimation;
    }
    return number;
}

void hbp_tick(struct hbp *h, const void *sample)
{
    uint32_t index = (uint32_t)h->index;
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        struct hbp_stream *s = &h->streams[k];
        if (!s->running || s->event == HBP_STREAM_EDGES) continue;
        if (!s->aligned) { /* of means, all periods must come */
            uint32_t number = hbp_rounded_up(h->index + (hbp_has_means(s) ? s->decimation - 1u : 0u), s->decimation);
            s->next = number * s->decimation;
            if (s->counts_samples) s->seq = (uint16_t)number;
            s->aligned = 1;
        }
        if (hbp_has_means(s)) hbp_means_add(h, s, sample, s->next - index);
        if (index != s->next) continue;
        s->next += s->decimation;
        take(h, s, index, sample);
    }
#if HBP_CAPTURE
    if (h->captured.running) hbp_capture_tick(h, sample);
#endif
    h->index++;
    h->periods = (uint32_t)h->index;
}

static int illegal(uint8_t before, uint8_t after)
{
    unsigned changed = (before ^ after) & 7u;
    return !(after & 7u) || (after & 7u) == 7u || (changed & (changed - 1u));
}

void hbp_edge(struct hbp *h, uint32_t tick, uint8_t before, uint8_t after, uint16_t encoder)
{
    uint16_t head = h->edge_head;
    uint8_t codes = (uint8_t)((before & 7u) | (after & 7u) << 3 | (illegal(before, after) ? 0x40u : 0));
    if ((uint16_t)(head - h->edge_tail) < HBP_EDGES) {
        struct hbp_hall_edge *edge = &h->ring[head & (HBP_EDGES - 1u)];
        edge->index = h->edges;
        edge->tick = tick;
        edge->encoder = encoder;
        edge->codes = codes;
        HBP_BARRIER();
        h->edge_head = (uint16_t)(head + 1u);
    }
#if HBP_CAPTURE
    if (h->captured.running) hbp_capture_edge(h, tick, codes, encoder);
#endif
    h->edges++;
}

/* ---- streams to the host ------------------------------------------------------------------------------------------------- */

static void let_go_of_edges(struct hbp *h)
{
    uint16_t head = h->edge_head, most = 0;
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        const struct hbp_stream *s = &h->streams[k];
        uint16_t left = (uint16_t)(head - s->edge);
        if (s->running && s->event == HBP_STREAM_EDGES && left > most) most = left;
    }
    HBP_BARRIER();
    h->edge_tail = (uint16_t)(head - most);
}

/* All edges that wait, into all streams of edges; 0 if there is no room. */
static int send_edges(struct hbp *h)
{
    int room = 1;
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        struct hbp_stream *s = &h->streams[k];
        if (!s->running || s->event != HBP_STREAM_EDGES) continue;
        s->waits = 0;
        while (s->edge != h->edge_head) {
            uint16_t most = (uint16_t)(h->edge_head - s->edge), n = 1;
            const struct hbp_hall_edge *first = &h->ring[s->edge & (HBP_EDGES - 1u)];
            HBP_BARRIER();
            if (first->index != s->edge_index) { /* the ring was full */
                s->edge_seq++;
                s->lost++;
                s->edge_flags = OVERRUN;
                s->edge_index = first->index;
            }
            if (most > s->block) most = s->block;
            while (n < most && h->ring[(s->edge + n) & (HBP_EDGES - 1u)].index == first->index + n) n++;
            if (!h->link->way->edges(h, s, n)) {
                s->waits = 1;
                room = 0;
                break;
            }
            s->edge = (uint16_t)(s->edge + n);
            s->edge_index += n;
            s->edge_seq++;
            s->edge_flags = 0;
        }
    }
    let_go_of_edges(h);
    return room;
}

/* All whole blocks, each after the edges that it covers; 0 if there is no room. */
static int send_blocks(struct hbp *h)
{
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        struct hbp_stream *s = &h->streams[k];
        while (s->head != s->tail) {
            struct hbp_block *block = block_at(h, s, s->read);
            HBP_BARRIER(); /* edges given before this block was made are seen after it */
            if (!send_edges(h) || !h->link->way->samples(h, s, block, records_of(block))) return 0;
            s->read = s->read + 1u < s->places ? s->read + 1u : 0u;
            HBP_BARRIER();
            s->tail++;
        }
    }
    return 1;
}

static int edges_are_late(struct hbp *h)
{
    int late = (uint16_t)(h->edge_head - h->edge_tail) > HBP_EDGES / 2u;
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        struct hbp_stream *s = &h->streams[k];
        if (!s->running || s->event != HBP_STREAM_EDGES || s->edge == h->edge_head) continue;
        if (!s->waits) s->since = (uint32_t)h->now;
        s->waits = 1;
        if ((uint32_t)h->now - s->since >= periods_in(s->latency_ms, h->config->tick_hz)) late = 1;
    }
    return late;
}

/* ---- heartbeat ----------------------------------------------------------------------------------------------------------- */

static uint32_t edges_up_to_now(const struct hbp *h)
{
    uint32_t edges;
    uint16_t head;
    do {
        head = h->edge_head;
        HBP_BARRIER();
        edges = h->edges;
        HBP_BARRIER();
    } while (head != h->edge_head);
    for (unsigned k = 1; k <= HBP_EDGES && k <= edges; k++, edges--) {
        const struct hbp_hall_edge *edge = &h->ring[(head - k) & (HBP_EDGES - 1u)];
        if ((int32_t)(edge->tick - (uint32_t)h->now) <= 0) break;
    }
    return edges;
}

uint16_t hbp_watchdog_ms(const struct hbp *h)
{
    uint32_t ticks = watchdog_ticks(h), ms = 0;
    uint64_t since = h->now - h->fed, left = since < ticks ? (ticks - since) * 1000u : 0;
    if (!live(h)) return WATCHDOG_OFF;
    for (uint32_t bit = 0x8000u; bit; bit >>= 1) /* the most that is not longer than what is left */
        if ((uint64_t)(ms + bit) * h->config->tick_hz <= left) ms += bit;
    return (uint16_t)(ms < WATCHDOG_OFF ? ms : WATCHDOG_OFF - 1u);
}

uint32_t hbp_dropped(const struct hbp *h)
{
    uint32_t dropped = h->dropped + h->link->expired;
    for (unsigned k = 0; k < HBP_STREAMS; k++) dropped += h->streams[k].dropped + h->streams[k].lost;
    return dropped;
}

static void heartbeat(struct hbp *h)
{
    uint32_t period = h->config->tick_hz / 10u;
    uint8_t *to = put64(h->link->work, h->now);
    if (h->now < h->next_heartbeat || h->link->way->beats(h)) return;
    to = hbp_put32(hbp_put32(hbp_put32(to, h->boot_id), h->faults), h->first_fault);
    to = hbp_put32(hbp_put32(to, hbp_dropped(h)), h->link->bad);
    to = hbp_put16(hbp_put16(to, h->setpoint_counter), h->setpoints_rejected);
    to = hbp_put16(hbp_put16(to, h->last_tid), hbp_watchdog_ms(h));
    *to++ = h->state;
    *to++ = (uint8_t)outputs_on(h);
    to = hbp_put32(hbp_put16(to, 0), edges_up_to_now(h));
    if (!send(h, HBP_RANK_BEAT, HBP_TYPE_HEARTBEAT, (size_t)(to - h->link->work))) return;
    h->next_heartbeat = h->now - remainder_of(h->now, period) + period;
}

void hbp_advance(struct hbp *h, uint64_t now)
{
    hbp_pass_time(h, now);
    if (edges_are_late(h)) send_edges(h);
    send_blocks(h);
    let_go_of_edges(h);
#if HBP_CAPTURE
    if (h->capture) hbp_capture_poll(h);
#endif
    heartbeat(h);
}

/* ---- the order of checks ------------------------------------------------------------------------------------------------- */

#define FOLLOWED(count, bytes) ((bytes) << 5 | (count)) /* by as many things as stands at `count`, each of so many bytes */

static const struct kind {
    uint8_t type, length, followed;
    uint8_t feature; /* without it the type is unknown */
    answer *answer;
} kinds[] = {
    {HBP_TYPE_HELLO, 8, 0, 0, hello},
    {HBP_TYPE_TIME_SYNC, 0, 0, 0, time_sync},
    {HBP_TYPE_ALIVE, 4, 0, 0, alive},
    {HBP_TYPE_BLOB_READ, 8, 0, 0, blob_read},
#if HBP_WAVEFORM
    {HBP_TYPE_BLOB_WRITE, 8, FOLLOWED(2, 1), HBP_FEATURE_WAVEFORM, blob_write},
#endif
    {HBP_TYPE_PARAM_GET, 4, 0, 0, param_get},
    {HBP_TYPE_PARAM_SET, 8, 0, 0, param_set},
    {HBP_TYPE_PARAM_COMMIT, 0, 0, 0, param_commit},
    {HBP_TYPE_STATE_CMD, 8, 0, 0, state_cmd},
    {HBP_TYPE_SETPOINT, 12, 0, 0, setpoint},
    {HBP_TYPE_STREAM_SET, 8, FOLLOWED(6, 2), 0, stream_set},
    {HBP_TYPE_STREAM_START, 4, 0, 0, stream_start},
    {HBP_TYPE_STREAM_STOP, 4, 0, 0, stream_stop},
    {HBP_TYPE_STREAM_GET, 4, 0, 0, stream_get},
#if HBP_CAPTURE
    {HBP_TYPE_CAPTURE_ARM, 22, FOLLOWED(20, 2), HBP_FEATURE_CAPTURE, hbp_capture_arm},
    {HBP_TYPE_CAPTURE_STATUS, 0, 0, HBP_FEATURE_CAPTURE, hbp_capture_status},
#endif
};

struct request {
    uint8_t type, flags;
    uint16_t tid, length;
    const uint8_t *payload;
};

/* `answered` bytes of `work`; which transfer they are. */
static uint8_t reply(struct hbp *h, const struct request *request, uint8_t flags, uint8_t transfer)
{
    struct hbp_message message = {request->type, (uint8_t)(HBP_MAJOR | flags), request->tid, h->answered, HBP_RANK_REPLY, transfer};
    h->link->way->send(h, &message);
    return message.transfer;
}

static const struct kind *kind_of(const struct hbp *h, uint8_t type)
{
    for (unsigned k = 0; k < sizeof kinds / sizeof kinds[0]; k++)
        if (kinds[k].type == type) return kinds[k].feature & ~h->features ? NULL : &kinds[k];
    return NULL;
}

static int is_one_way(uint8_t type)
{
    return type == HBP_TYPE_ALIVE || type == HBP_TYPE_SETPOINT;
}

/* Checks 3 to 5. */
static uint16_t check(struct hbp *h, const struct request *request, const struct kind *kind)
{
    if (request->type != HBP_TYPE_HELLO && (request->flags & MAJOR_MASK) != HBP_MAJOR)
        return hbp_refuse(h, HBP_ERROR_BAD_VERSION, HBP_MAJOR);
    if (!kind) return hbp_refuse(h, HBP_ERROR_UNKNOWN_TYPE, request->type);
    if ((request->tid == 0) != is_one_way(request->type)) return hbp_refuse(h, HBP_ERROR_BAD_VALUE, request->tid);
    return 0;
}

/* Checks 7 and 8, and what the request is for. */
static uint16_t execute(struct hbp *h, const struct request *request, const struct kind *kind)
{
    uint32_t whole = kind->length, more = kind->followed;
    uint16_t code;
    if (request->type == HBP_TYPE_HELLO && request->length > whole) whole = request->length;
    if (more && request->length >= whole) whole += (more >> 5) * hbp_get16(request->payload + (more & 31u));
    if (request->length == whole) return kind->answer(h, request->payload);
    code = hbp_refuse(h, HBP_ERROR_BAD_LENGTH, request->length);
    if (request->type == HBP_TYPE_SETPOINT) reject(h, code);
    return code;
}

/* The reply, or where there is a `code` the refusal; where `kept` is not null, it is kept there. */
static void conclude(struct hbp *h, const struct request *request, uint16_t code, struct hbp_reply *kept)
{
    uint8_t flags = REPLY, transfer;
    if (code) {
        uint8_t *to = hbp_put16(h->link->work, code);
        *to++ = request->type;
        *to++ = 0;
        (void)hbp_finish(h, put_float(to, h->detail));
        flags |= ERROR_FLAG;
    } else {
        h->last_tid = request->tid;
    }
    transfer = reply(h, request, flags, HBP_NEXT_TRANSFER);
    if (!kept) return;
    kept->there = 1;
    kept->type = request->type;
    kept->tid = request->tid;
    kept->flags = flags;
    kept->transfer = transfer;
    kept->length = h->answered;
    /* a part of a blob is not kept, but which part it was */
    memcpy(kept->payload, h->link->work, !code && kept->type == HBP_TYPE_BLOB_READ ? 12 : kept->length);
}

static int answered_before(struct hbp *h, const struct request *request, uint32_t crc)
{
    uint32_t total;
    for (unsigned k = 0; k < HBP_KEPT; k++) {
        struct hbp_reply *kept = &h->peer->kept[k];
        if (!kept->there || kept->request != crc || kept->tid != request->tid || kept->type != request->type) continue;
        if (kept->type == HBP_TYPE_BLOB_READ && !(kept->flags & ERROR_FLAG)) {
            if (!find_blob(h, kept->payload[0], &total) || total != hbp_get32(kept->payload + 8)) return 0; /* another capture */
            (void)blob_reply(h, kept->payload[0], hbp_get32(kept->payload + 4), hbp_get16(kept->payload + 2), total);
        } else {
            memcpy(h->link->work, kept->payload, kept->length);
            h->answered = kept->length;
        }
        (void)reply(h, request, kept->flags, kept->transfer);
        return 1;
    }
    return 0;
}

static struct hbp_peer *peer_of(struct hbp *h, uint8_t number)
{
    struct hbp_peer *oldest = h->peers;
    for (unsigned k = 0; k < HBP_HOSTS; k++) {
        struct hbp_peer *each = &h->peers[k];
        if (each->number == number && each->used) return each;
        if (each->used < oldest->used) oldest = each;
    }
    memset(oldest, 0, sizeof *oldest);
    oldest->number = number;
    oldest->tx_max = h->link->most;
    return oldest;
}

static int always_afresh(const struct request *request)
{
    if (request->type == HBP_TYPE_HELLO || request->type == HBP_TYPE_TIME_SYNC) return 1;
    return request->type == HBP_TYPE_STATE_CMD && request->length && request->payload[0] == HBP_COMMAND_STOP;
}

void hbp_receive(struct hbp *h, const uint8_t *raw, uint8_t host, int mine)
{
    struct request request;
    struct hbp_reply *kept = NULL;
    const struct kind *kind;
    uint32_t newest = 0;
    uint16_t code;
    request.type = raw[0];
    request.flags = raw[1];
    request.tid = hbp_get16(raw + 2);
    request.length = hbp_get16(raw + 4);
    request.payload = raw + HEADER;
    if (request.flags & (REPLY | ERROR_FLAG)) {
        h->link->ignored++;
        return;
    }
    h->peer = peer_of(h, host);
    for (unsigned i = 0; i < HBP_HOSTS; i++)
        if (h->peers[i].used > newest) newest = h->peers[i].used;
    h->peer->used = newest + 1u;
    h->detail = 0.0f;
    h->answered = 0;
    kind = kind_of(h, request.type);
    code = mine ? check(h, &request, kind) : hbp_refuse(h, HBP_ERROR_UNKNOWN_NODE, raw[6]);
    if (!code && request.tid && !always_afresh(&request)) {
        uint32_t crc = hbp_crc(0xFFFFFFFFu, raw, (size_t)HEADER + request.length);
        if (answered_before(h, &request, crc)) return;
        kept = &h->peer->kept[h->peer->oldest];
        h->peer->oldest = (uint8_t)((h->peer->oldest + 1u) % HBP_KEPT);
        kept->request = crc;
    }
    if (!code) {
        code = execute(h, &request, kind);
        if (!code && !request.tid) return;
    }
    conclude(h, &request, code, kept);
}

/* ---- a device joins a link ----------------------------------------------------------------------------------------------- */

static int fits(const char *text, size_t least, size_t most)
{
    size_t n = text_length(text);
    for (size_t k = 0; k < n; k++)
        if (control(text[k])) return 0;
    return n >= least && n <= most;
}

static uint32_t wrong_channel(const struct hbp_config *config, uint32_t k)
{
    const struct hbp_channel *c = &config->channels[k];
    if (!fits(c->name, 1, 16)) return HBP_WRONG_CHANNEL_NAME;
    if (c->type < HBP_RAW_U8 || c->type > HBP_RAW_F32) return HBP_WRONG_CHANNEL_TYPE;
    if (!hbp_finite(c->scale) || c->scale == 0.0f || !hbp_finite(c->offset)) return HBP_WRONG_CHANNEL_SCALE;
    if ((uint32_t)c->at + hbp_widths[c->type] > config->sample_bytes) return HBP_WRONG_CHANNEL_PLACE;
    for (uint32_t j = 0; j < k; j++)
        if (config->channels[j].id == c->id || same_text(config->channels[j].name, c->name)) return HBP_WRONG_CHANNEL_TWICE;
    return 0;
}

static uint32_t wrong_parameter(const struct hbp_config *config, uint32_t k)
{
    const struct hbp_parameter *p = &config->parameters[k];
    if (!fits(p->name, 1, 16)) return HBP_WRONG_PARAMETER_NAME;
    if (!(p->lo <= p->initial && p->initial <= p->hi)) return HBP_WRONG_PARAMETER_RANGE;
    if (!p->value && !config->get) return HBP_WRONG_PARAMETER_VALUE;
    for (uint32_t j = 0; j < k; j++)
        if (config->parameters[j].id == p->id || same_text(config->parameters[j].name, p->name)) return HBP_WRONG_PARAMETER_TWICE;
    return 0;
}

static uint32_t wrong(const struct hbp_config *config)
{
    uint32_t code = 0, k;
    if (!config->node || !config->role) return HBP_WRONG_NODE;
    if (!config->pwm_hz || !config->tick_hz || config->tick_hz % config->pwm_hz) return HBP_WRONG_RATE;
    if (!config->enter || !config->setpoint || !config->outputs_on) return HBP_WRONG_FUNCTION;
    if (!fits(config->name, 1, 16) || !fits(config->firmware, 0, 16)) return HBP_WRONG_TEXT;
    if (!fits(config->serial, 0, 24) || !fits(config->build, 0, 24)) return HBP_WRONG_TEXT;
    if (config->n_channels > HBP_CHANNELS) return HBP_WRONG_COUNT;
    if (HBP_WAVEFORM && config->waveform && config->waveform_length < 256u) return HBP_WRONG_WAVEFORM;
    for (k = 0; k < config->n_channels && !code; k++) code = wrong_channel(config, k);
    if (code) return code | (k - 1u);
    for (k = 0; k < config->n_parameters && !code; k++) code = wrong_parameter(config, k);
    return code ? code | (k - 1u) : 0;
}

static uint16_t find_parameter(const struct hbp_config *config, const char *name)
{
    for (uint16_t k = 0; k < config->n_parameters; k++)
        if (same_text(config->parameters[k].name, name)) return k;
    return HBP_NONE;
}

uint32_t hbp_join(struct hbp_link_base *link, struct hbp *h, const struct hbp_config *config, uint32_t boot_id)
{
    uint8_t record[RECORD];
    struct hbp **last = &link->first;
    uint32_t code = wrong(config);
    if (code) return code;
    for (; *last; last = &(*last)->other)
        if ((*last)->config->node == config->node) return HBP_WRONG_NODE;
    memset(h, 0, sizeof *h);
    h->config = config;
    h->link = link;
    h->boot_id = boot_id;
    h->cfg_id = (uint16_t)boot_id;
    h->period = config->tick_hz / config->pwm_hz;
    h->watchdog = find_parameter(config, "watchdog");
    h->schema_crc = 0xFFFFFFFFu;
    for (uint32_t k = 0; k < (uint32_t)config->n_channels + config->n_parameters; k++) {
        record_bytes(config, k, record);
        h->schema_crc = hbp_crc(h->schema_crc, record, RECORD);
    }
    h->schema_crc ^= 0xFFFFFFFFu;
    h->peer = peer_of(h, 0);
    h->features = config->features & ~(uint32_t)(GIVEN | LACKING);
    if (config->meanings) h->features |= HBP_FEATURE_MEANINGS;
#if HBP_WAVEFORM
    h->test = find_parameter(config, "test");
    if (config->waveform) {
        h->features |= HBP_FEATURE_WAVEFORM;
        memset(config->waveform, 0, 2u * (size_t)config->waveform_length);
    }
#endif
#if HBP_CAPTURE
    code = hbp_capture_init(h);
    if (code) return code;
#endif
    *last = h;
    link->nodes++;
    return 0;
}

/* ---- the byte link ------------------------------------------------------------------------------------------------------- */

struct encoder { /* COBS into the transmit queue, of which nothing is sent before it is whole */
    struct hbp_link *link;
    uint32_t at, code_at;
    unsigned code;
};

static void put_raw(struct encoder *e, uint8_t byte)
{
    e->link->tx[e->at++ & (HBP_TX_BYTES - 1u)] = byte;
}

static void begin_group(struct encoder *e)
{
    e->code_at = e->at++;
    e->code = 1;
}

static void end_group(struct encoder *e)
{
    e->link->tx[e->code_at & (HBP_TX_BYTES - 1u)] = (uint8_t)e->code;
}

static void put_encoded(struct encoder *e, const uint8_t *data, size_t n)
{
    for (; n--; data++) {
        if (e->code == 0xFFu) { /* a full group has no zero behind it */
            end_group(e);
            begin_group(e);
        }
        if (*data) {
            put_raw(e, *data);
            e->code++;
        } else {
            end_group(e);
            begin_group(e);
        }
    }
}

static uint32_t encoded_length(uint32_t payload)
{
    uint32_t body = HEADER + payload + CRC_BYTES;
    return body + (body + 253u) / 254u + 2u;
}

#define REPLY_ROOM (HBP_TX_MAX + 20u) /* bytes of the queue that streams leave to replies */
#define WAIT 0.05f                    /* s that streams may let a reply wait, and a frame, where the rate is known */

static int byte_send(struct hbp *h, struct hbp_message *message)
{
    struct hbp_link *link = (struct hbp_link *)(void *)h->link;
    struct encoder e;
    size_t n = HEADER + message->n;
    uint8_t *raw = hbp_put_header(h, message);
    uint32_t used = link->head - link->tail, needed = encoded_length(message->n);
    if (message->rank == HBP_RANK_STREAM) needed += REPLY_ROOM;
    else if (message->rank != HBP_RANK_REPLY) needed += REPLY_ROOM / 2u;
    if (used + needed > HBP_TX_BYTES) return 0;
    if (message->rank == HBP_RANK_STREAM && link->base.capacity > 0.0f && (float)used > WAIT * link->base.capacity) return 0;
    HBP_BARRIER();
    hbp_put32(raw + n, hbp_crc(0xFFFFFFFFu, raw, n) ^ 0xFFFFFFFFu);
    e.link = link;
    e.at = link->head;
    put_raw(&e, 0);
    begin_group(&e);
    put_encoded(&e, raw, n + CRC_BYTES);
    end_group(&e);
    put_raw(&e, 0);
    HBP_BARRIER();
    link->head = e.at;
    if (message->rank == HBP_RANK_BEAT) h->beat = link->head;
    return 1;
}

static int byte_beats(const struct hbp *h)
{
    const struct hbp_link *link = (const struct hbp_link *)(const void *)h->link;
    return (int32_t)(h->beat - link->tail) > 0;
}

static uint32_t byte_shape(struct hbp *h, struct hbp_stream *s)
{
    uint32_t room = h->peer->tx_max - STREAM_HEADER, size = s->record_bytes, block = room / size;
    if (size > room) return room;
    if (s->event == HBP_STREAM_EDGES) {
        s->rate = (float)(encoded_length(STREAM_HEADER + size) * 1000u) / (float)(s->latency_ms ? s->latency_ms : 1u);
    } else {
        uint32_t most = hbp_in_time(h, s->latency_ms, s->decimation);
        if (block > most) block = most ? most : 1u;
        s->rate = (float)encoded_length(STREAM_HEADER + block * size) * (float)h->config->pwm_hz /
                  ((float)s->decimation * (float)block);
    }
    s->block = (uint16_t)block;
    return 0;
}

static uint16_t byte_open(struct hbp *h, struct hbp_stream *s)
{
    (void)h, (void)s;
    return 0;
}

/* Records stand behind the header of a stream frame. */
static int send_records(struct hbp *h, const struct hbp_stream *s, uint8_t type, const struct hbp_block *block, uint32_t tick)
{
    uint8_t *to = h->link->work;
    *to++ = s->number;
    *to++ = (uint8_t)block->flags;
    to = hbp_put16(hbp_put16(hbp_put16(to, block->n), s->cfg_id), block->seq);
    hbp_put32(hbp_put32(to, block->index), tick);
    return send(h, HBP_RANK_STREAM, type, STREAM_HEADER + (size_t)block->n * s->record_bytes);
}

static int byte_samples(struct hbp *h, struct hbp_stream *s, const struct hbp_block *block, const uint8_t *records)
{
    memcpy(h->link->work + STREAM_HEADER, records, (size_t)block->n * s->record_bytes);
    return send_records(h, s, HBP_TYPE_DATA, block, (uint32_t)h->config->tick0 + block->index * h->period);
}

static int byte_edges(struct hbp *h, struct hbp_stream *s, uint16_t n)
{
    const struct hbp_hall_edge *first = &h->ring[s->edge & (HBP_EDGES - 1u)];
    struct hbp_block block = {first->index, s->edge_seq, n, s->edge_flags};
    uint8_t *to = h->link->work + STREAM_HEADER;
    for (unsigned k = 0; k < n; k++) to = hbp_put_edge(to, &h->ring[(s->edge + k) & (HBP_EDGES - 1u)], 0);
    return send_records(h, s, HBP_TYPE_EDGES, &block, first->tick);
}

uint8_t *hbp_put_edge(uint8_t *to, const struct hbp_hall_edge *edge, uint8_t flags)
{
    to = hbp_put32(to, edge->tick);
    *to++ = edge->codes;
    *to++ = flags;
    return hbp_put16(to, edge->encoder);
}

static const struct hbp_way byte_way = {
    byte_send, byte_beats, byte_shape, byte_open, byte_samples, byte_edges, 0,
};

void hbp_link_init_sized(struct hbp_link *link, float bytes_per_s, size_t size)
{
    if (size != sizeof *link) return; /* hbp_add tells it */
    memset(link, 0, sizeof *link);
    link->base.way = &byte_way;
    link->base.work = link->made + HEADER;
    link->base.capacity = bytes_per_s;
    link->base.most = link->base.most_news = HBP_TX_MAX;
    link->skipping = 1;
}

uint32_t hbp_add_sized(struct hbp_link *link, struct hbp *device, const struct hbp_config *config, uint32_t boot_id, size_t size)
{
    if (size != sizeof *link + sizeof *device) return HBP_WRONG_OPTIONS;
    return hbp_join(&link->base, device, config, boot_id);
}

static void frame_came(struct hbp_link *link)
{
    struct hbp *h = link->base.first;
    uint8_t node = link->rx[6];
    while (h && node && h->config->node != node) h = h->other;
    if (link->base.first) hbp_receive(h ? h : link->base.first, link->rx, 0, h != NULL);
}

static void delimiter(struct hbp_link *link)
{
    uint32_t n = link->decoded;
    int skipped = link->skipping, empty = !link->encoded;
    int damaged = link->broken || link->left || n < HEADER + CRC_BYTES;
    link->skipping = link->broken = link->code = link->left = 0;
    link->decoded = link->encoded = 0;
    if (skipped || empty) return;
    if (damaged || hbp_crc(0xFFFFFFFFu, link->rx, n) != 0xDEBB20E3u || hbp_get16(link->rx + 4) != n - HEADER - CRC_BYTES)
        link->base.bad++;
    else
        frame_came(link);
}

static void decoded_byte(struct hbp_link *link, uint8_t byte)
{
    if (link->decoded < sizeof link->rx) link->rx[link->decoded++] = byte;
    else link->broken = 1;
}

static void frame_byte(struct hbp_link *link, uint8_t byte)
{
    if (link->skipping) return;
    if (++link->encoded > MAX_ENCODED) {
        link->base.bad++;
        link->skipping = 1;
        return;
    }
    if (link->left) {
        link->left--;
        decoded_byte(link, byte);
    } else {
        if (link->code && link->code < 0xFFu) decoded_byte(link, 0);
        link->code = byte;
        link->left = (uint8_t)(byte - 1u);
    }
}

void hbp_rx(struct hbp_link *link, uint64_t now, const uint8_t *data, size_t n)
{
    for (struct hbp *h = link->base.first; h; h = h->other) hbp_pass_time(h, now);
    for (; n--; data++) {
        if (*data) frame_byte(link, *data);
        else delimiter(link);
    }
}

void hbp_poll(struct hbp_link *link, uint64_t now)
{
    for (struct hbp *h = link->base.first; h; h = h->other) hbp_advance(h, now);
}

size_t hbp_tx_peek(const struct hbp_link *link, const uint8_t **bytes)
{
    uint32_t at = link->tail & (HBP_TX_BYTES - 1u), n = link->head - link->tail;
    HBP_BARRIER();
    *bytes = link->tx + at;
    return n < HBP_TX_BYTES - at ? n : HBP_TX_BYTES - at;
}

void hbp_tx_advance(struct hbp_link *link, size_t n)
{
    HBP_BARRIER();
    link->tail += (uint32_t)n;
}
