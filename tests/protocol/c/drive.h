/* drive.h: a small but whole drive for the tests in C, the one of tests/protocol/small_drive.py; frames as a host makes and reads them,
 * written from SPEC and not from hbp.c; random numbers. */
#ifndef DRIVE_H
#define DRIVE_H

#include "../../../protocol/c/hbp_way.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TICKS 1250u /* in a PWM period */
#define BOOT 0xB0071Du

#define REQUIRE(condition) \
    do { \
        if (!(condition)) { \
            fprintf(stderr, "%s:%d: not so: %s\n", __FILE__, __LINE__, #condition); \
            abort(); \
        } \
    } while (0)

/* ---- the drive ---------------------------------------------------------------------------------------------------------- */

#define FEW 5u   /* channels, as in small_drive.py */
#define MANY 45u /* for streams that do not fit, where HBP_CHANNELS allows that */

struct sample {
    uint32_t count, more[MANY - FEW];
    int16_t theta, i_a;
    uint8_t hall, status;
};

struct app {
    uint8_t state, on, moody; /* moody: now and then it refuses, or cannot clear a fault */
    uint32_t entered, setpoints, persisting;
    float gain, n_p, serial, watchdog;
};

static struct hbp_channel channels[MANY] = {
    {1, HBP_RAW_U8, HBP_UNIT_NONE, 0, offsetof(struct sample, hall), 1.0f, 0.0f, "hall"},
    {2, HBP_RAW_U8, HBP_UNIT_NONE, 0, offsetof(struct sample, status), 1.0f, 0.0f, "status"},
    {3, HBP_RAW_I16, HBP_UNIT_RAD, HBP_FLAG_WRAPS, offsetof(struct sample, theta), 3.14159265f / 32768, 0.0f, "theta"},
    {4, HBP_RAW_I16, HBP_UNIT_A, 0, offsetof(struct sample, i_a), 1.0f / 1024, 0.0f, "i_a"},
    {5, HBP_RAW_U32, HBP_UNIT_COUNT, 0, offsetof(struct sample, count), 1.0f, 0.0f, "count"},
};
static unsigned n_channels = FEW;

static inline unsigned channel_bytes(unsigned id)
{
    static const uint8_t bytes[] = {0, 1, 1, 2, 2, 4};
    return id <= FEW ? bytes[id] : 4;
}

static inline void with_many_channels(void)
{
    static char names[MANY][4];
    for (n_channels = FEW; n_channels < MANY && n_channels < HBP_CHANNELS; n_channels++) {
        struct hbp_channel *c = &channels[n_channels];
        snprintf(names[n_channels], sizeof names[0], "m%u", n_channels % 100u);
        c->id = (uint16_t)(n_channels + 1u);
        c->type = HBP_RAW_U32;
        c->at = (uint16_t)(offsetof(struct sample, more) + 4u * (n_channels - FEW));
        c->scale = 1.0f;
        c->name = names[n_channels];
    }
}

#define PARAMETERS(app) \
    { \
        {101, HBP_UNIT_NONE, 0, 1e-4f, 1e5f, 2.5f, &(app).gain, "gain"}, \
        {102, HBP_UNIT_NONE, HBP_FLAG_IDLE_ONLY | HBP_FLAG_WHOLE, 1.0f, 64.0f, 6.0f, &(app).n_p, "n_p"}, \
        {103, HBP_UNIT_NONE, HBP_FLAG_READ_ONLY, 0.0f, 1e6f, 42.0f, &(app).serial, "serial"}, \
        {104, HBP_UNIT_S, HBP_FLAG_IDLE_ONLY, 0.05f, 1.0f, 0.2f, &(app).watchdog, "watchdog"}, \
    }

static inline uint32_t below(uint32_t n);

/* What SPEC allows, and nothing else. */
static uint16_t app_enter(void *user, uint8_t state, float *detail)
{
    static const uint8_t from[] = {0, 1u << HBP_STATE_BOOT | 1u << HBP_STATE_ARMED | 1u << HBP_STATE_RUNNING | 1u << HBP_STATE_FAULT,
                                   1u << HBP_STATE_IDLE, 1u << HBP_STATE_ARMED, 0xFFu};
    struct app *app = user;
    if (app->moody && below(8) == 0 && (state == HBP_STATE_ARMED || state == HBP_STATE_RUNNING)) {
        *detail = 7.0f;
        return HBP_ERROR_NOT_SUPPORTED;
    }
    REQUIRE(state >= HBP_STATE_IDLE && state <= HBP_STATE_FAULT);
    REQUIRE(from[state] >> app->state & 1u);
    app->state = state;
    app->on = state == HBP_STATE_RUNNING;
    app->entered++;
    return 0;
}

static uint16_t app_setpoint(void *user, uint8_t mode, float value, float value2, float *detail)
{
    struct app *app = user;
    (void)value2;
    REQUIRE(app->state == HBP_STATE_RUNNING);
    *detail = (float)mode;
    if (mode != HBP_MODE_SPEED) return HBP_ERROR_NOT_SUPPORTED;
    *detail = 300.0f;
    if (value > 300.0f || value < -300.0f) return HBP_ERROR_OUT_OF_RANGE;
    app->setpoints++;
    return 0;
}

static uint8_t app_outputs_on(void *user)
{
    return ((const struct app *)user)->on;
}

static uint32_t app_clear(void *user, uint32_t faults)
{
    const struct app *app = user;
    return faults & (app->moody && below(4) == 0 ? 1u << below(24) : app->persisting);
}

static uint16_t app_commit(void *user, float *detail)
{
    (void)user, (void)detail;
    return 0;
}

static void configure_drive(struct hbp_config *config, struct hbp_parameter parameters[4], struct app *app, uint8_t node,
                            uint32_t features)
{
    const struct app fresh = {0, 0, 0, 0, 0, 0, 2.5f, 6.0f, 42.0f, 0.2f};
    const struct hbp_parameter table[] = PARAMETERS(*app);
    memcpy(parameters, table, sizeof table);
    *app = fresh;
    memset(config, 0, sizeof *config);
    config->node = node;
    config->role = HBP_ROLE_DRIVE;
    config->features = features;
    config->tick_hz = 20000000;
    config->pwm_hz = 16000;
    config->name = "small";
    config->firmware = "1.0";
    config->channels = channels;
    config->n_channels = (uint16_t)n_channels;
    config->sample_bytes = sizeof(struct sample);
    config->parameters = parameters;
    config->n_parameters = 4;
    config->user = app;
    config->enter = app_enter;
    config->setpoint = app_setpoint;
    config->outputs_on = app_outputs_on;
    config->clear = app_clear;
    config->commit = app_commit;
}

/* A sample in which every value is a function of the index. */
static inline void sample_at(struct sample *s, uint32_t index)
{
    s->count = index;
    s->theta = (int16_t)(uint16_t)(index * 7u);
    s->i_a = (int16_t)(index % 2001u - 1000u);
    s->hall = (uint8_t)(1u + index % 6u);
    s->status = 3;
    for (unsigned k = FEW; k < n_channels; k++) s->more[k - FEW] = index * (k + 1u);
}

/* The same as it stands in a record. */
static inline uint32_t value_at(uint16_t id, uint32_t index)
{
    switch (id) {
    case 1: return 1u + index % 6u;
    case 2: return 3;
    case 3: return (uint16_t)(index * 7u);
    case 4: return (uint16_t)(index % 2001u - 1000u);
    case 5: return index;
    default: return index * id;
    }
}

/* The value that it stands for. */
static inline double number_at(uint16_t id, uint32_t index)
{
    return id == 3 || id == 4 ? (double)(int16_t)value_at(id, index) : (double)value_at(id, index);
}

/* The mean of the `n` periods up to `index`; of `theta`, which wraps, by its differences from the first; of those without unit the last. */
static inline double mean_at(uint16_t id, uint32_t index, uint32_t n)
{
    double first = id == 3 ? number_at(id, index - (n - 1u)) : 0.0, total = 0.0, mean;
    if (id < 3 || id > 5) return number_at(id, index);
    for (uint32_t ago = 0; ago < n; ago++) {
        double away = number_at(id, index - ago) - first;
        if (id == 3) away += away < -32768.0 ? 65536.0 : away >= 32768.0 ? -65536.0 : 0.0;
        total += away;
    }
    mean = first + total / n;
    if (id == 3) mean += mean < -32768.0 ? 65536.0 : mean >= 32768.0 ? -65536.0 : 0.0;
    return mean;
}

/* ---- frames ------------------------------------------------------------------------------------------------------------- */

static inline uint32_t get(const uint8_t *from, unsigned bytes)
{
    uint32_t value = 0;
    while (bytes--) value = value << 8 | from[bytes];
    return value;
}

static inline void put(uint8_t *to, uint32_t value, unsigned bytes)
{
    for (; bytes--; value >>= 8) *to++ = (uint8_t)value;
}

static inline uint32_t crc32(const uint8_t *data, size_t n)
{
    static uint32_t table[256];
    uint32_t crc = 0xFFFFFFFFu;
    if (!table[255])
        for (uint32_t k = 0; k < 256; k++) {
            table[k] = k;
            for (int bit = 0; bit < 8; bit++) table[k] = table[k] & 1u ? table[k] >> 1 ^ 0xEDB88320u : table[k] >> 1;
        }
    while (n--) crc = table[(crc ^ *data++) & 255u] ^ crc >> 8;
    return ~crc;
}

/* What blob 1 must hold, by what the reply to CAPTURE_STATUS says: the values of its records, edges in order, and the CRC of all.
 * `edge_ticks`: of the newest `kept` of the `edges` that there have been, each at its number modulo `kept`. */
static inline void check_blob(const uint8_t *reply, const uint8_t *blob, const uint32_t *edge_ticks, uint32_t kept, uint32_t edges)
{
    uint32_t step = get(reply + 4, 2), bytes = get(reply + 6, 2), first = get(reply + 16, 4), records = get(reply + 20, 4);
    uint32_t held = get(reply + 24, 4), number = get(reply + 32, 4), size = get(reply + 36, 4), ids = get(reply + 64, 2);
    uint32_t index = get(reply + 56, 4) - first * step, last = index + (records - 1u) * step, sum = 0;
    const uint8_t *at = blob;
    for (uint32_t c = 0; c < ids; c++) sum += channel_bytes(get(reply + 66 + 2 * c, 2));
    REQUIRE(bytes == sum && size == records * bytes + 8u * held);
    REQUIRE(first <= get(reply + 8, 4) && records == first + get(reply + 12, 4));
    REQUIRE(get(reply + 48, 4) == get(reply + 56, 4) * TICKS && get(reply + 40, 4) == crc32(blob, size));
    for (uint32_t k = 0; k < records; k++)
        for (uint32_t c = 0; c < ids; c++) {
            uint16_t id = (uint16_t)get(reply + 66 + 2 * c, 2);
            REQUIRE(get(at, channel_bytes(id)) == value_at(id, index + k * step));
            at += channel_bytes(id);
        }
    for (uint32_t k = 0; k < held; k++, number++, at += 8) {
        uint32_t tick = get(at, 4);
        REQUIRE((int32_t)(tick - index * TICKS) >= 0 && (int32_t)(last * TICKS - tick) >= 0);
        REQUIRE(edges - number >= kept || tick == edge_ticks[number % kept]);
    }
}

static inline unsigned bytes_in(uint8_t event, uint16_t id)
{
    return event == HBP_STREAM_MEAN ? 4u : channel_bytes(id);
}

/* A channel in a record of a stream; what is behind it. */
static inline const uint8_t *check_value(const uint8_t *at, uint8_t event, uint16_t id, uint32_t index, uint16_t decimation)
{
    unsigned bytes = bytes_in(event, id);
    uint32_t raw = get(at, bytes);
    if (event == HBP_STREAM_MEAN) {
        double mean = mean_at(id, index, decimation), off, allowed = (mean < 0.0 ? -mean : mean) / 8388608.0 + 1e-9;
        float told;
        memcpy(&told, &raw, sizeof told);
        off = (double)told - mean;
        if (id == 3 && off < -65535.0) off += 65536.0; /* rounded up to a whole turn */
        REQUIRE(off <= allowed && -off <= allowed);
    } else {
        REQUIRE(raw == value_at(id, index));
    }
    return at + bytes;
}

/* Header, payload and CRC of a frame, at `to`; its length. */
static inline size_t make_body(uint8_t *to, uint8_t type, uint8_t flags, uint16_t tid, uint8_t node, const uint8_t *payload, size_t n)
{
    const uint8_t header[8] = {type, flags, (uint8_t)tid, (uint8_t)(tid >> 8), (uint8_t)n, (uint8_t)(n >> 8), node, 0};
    memcpy(to, header, 8);
    if (n) memcpy(to + 8, payload, n);
    put(to + 8 + n, crc32(to, 8 + n), 4);
    return n + 12;
}

/* A body between delimiters: each zero becomes the distance to the next. */
static inline size_t stuff(uint8_t *to, const uint8_t *body, size_t n)
{
    size_t at = 0, code;
    to[at++] = 0;
    for (size_t k = 0, open = 1; open;) {
        size_t run = 0;
        while (k + run < n && body[k + run] && run < 254) run++;
        code = at++;
        to[code] = (uint8_t)(run + 1);
        memcpy(to + at, body + k, run);
        at += run;
        k += run;
        if (run == 254) open = k < n;
        else if (k < n) k++; /* the zero is in the code */
        else open = 0;
    }
    to[at++] = 0;
    return at;
}

/* What stands between two delimiters: the body's length, or 0 for a frame that is none. `room` bounds the body. */
static inline size_t unstuff(uint8_t *to, size_t room, const uint8_t *from, size_t n)
{
    size_t length = 0;
    if (n > 1041) return 0;
    for (size_t k = 0; k < n;) {
        size_t code = from[k++];
        if (k + code - 1 > n || length + code > room + 1) return 0;
        memcpy(to + length, from + k, code - 1);
        length += code - 1;
        k += code - 1;
        if (code < 255 && k < n) {
            if (length == room) return 0;
            to[length++] = 0;
        }
    }
    if (length < 12 || crc32(to, length - 4) != get(to + length - 4, 4) || get(to + 4, 2) != length - 12) return 0;
    return length;
}

/* ---- random numbers ----------------------------------------------------------------------------------------------------- */

static uint64_t random_state = 1;
static const uint8_t *given; /* or those of a fuzzer, as long as they last */
static size_t given_bytes;

static inline uint32_t draw(void)
{
    if (given) {
        uint32_t value = 0;
        for (unsigned k = 0; k < 2 && given_bytes; k++, given_bytes--) value = value << 8 | *given++;
        return value << 16 | value;
    }
    random_state ^= random_state >> 12;
    random_state ^= random_state << 25;
    random_state ^= random_state >> 27;
    return (uint32_t)((random_state * 0x2545F4914F6CDD1Du) >> 32);
}

static inline uint32_t below(uint32_t n)
{
    return (uint32_t)((uint64_t)draw() * n >> 32);
}

#endif
