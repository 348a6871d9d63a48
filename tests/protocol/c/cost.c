/* cost.c: instructions of what interrupts and main loop call, counted on QEMU's Cortex-M4F (board mps2-an386).
 *
 * It runs with `-icount shift=10`: an instruction takes 1024 ns, which SysTick, at 25 MHz, sees as 25.6 counts. Each line that it prints by
 * semihosting is a name, the mean and the most of some calls. sizes.py compiles and starts it.
 */
#include "../../../protocol/c/examples/mps2-an386/mps2.h"

#define MOTOR_TICK_HZ 16000000u
#define MOTOR_PWM_HZ 16000u
#define MOTOR_NAME "cost"
#include "../../../protocol/c/examples/motor.h"
#include "../../../protocol/c/hbp_can.h"

static struct hbp_link link;
static struct hbp_can can;
static struct hbp drive;
static struct hbp_config bare; /* without memory for captures */
static const struct hbp_can_bus bus = {.bitrate = 1000000};
static uint64_t now;
static uint32_t calls, total, most, empty;

static void host(uint32_t operation, const void *what)
{
    register uint32_t r0 __asm("r0") = operation;
    register const void *r1 __asm("r1") = what;
    __asm volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory", "cc");
}

static char *number(char *to, uint32_t value)
{
    char digits[12];
    int n = 0;
    do digits[n++] = (char)('0' + value % 10u);
    while (value /= 10u);
    while (n) *to++ = digits[--n];
    return to;
}

static void report(const char *name)
{
    char line[96], *to = line;
    while (*name) *to++ = *name++;
    *to++ = '\t';
    to = number(to, calls ? (total + calls / 2u) / calls : 0);
    *to++ = '\t';
    to = number(to, most);
    *to++ = '\n';
    *to = 0;
    host(4, line);
    calls = total = most = 0;
}

static void count(uint32_t from, uint32_t to)
{
    uint32_t n = (((from - to) & 0xFFFFFFu) * 10u + 128u) / 256u - empty;
    calls++;
    total += n;
    if (n > most) most = n;
}

#define COUNT(call) \
    do { \
        uint32_t from_ = SYSTICK_VALUE; \
        call; \
        count(from_, SYSTICK_VALUE); \
    } while (0)

static uint32_t crc32(const uint8_t *data, size_t n)
{
    uint32_t crc = 0xFFFFFFFFu;
    while (n--) {
        crc ^= *data++;
        for (int bit = 0; bit < 8; bit++) crc = crc & 1u ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
    }
    return ~crc;
}

/* A request on the byte link; its payload is short, so that one COBS block holds it. */
static size_t request(uint8_t *to, uint8_t type, const uint8_t *payload, size_t n)
{
    static uint8_t tid;
    uint8_t body[64] = {type, 1, ++tid, 0, (uint8_t)n, 0, 1, 0};
    size_t code = 1, at = 2;
    uint32_t crc;
    memcpy(body + 8, payload, n);
    crc = crc32(body, 8 + n);
    for (unsigned k = 0; k < 4; k++) body[8 + n + k] = (uint8_t)(crc >> 8 * k);
    to[0] = 0;
    for (size_t k = 0; k < n + 12; k++) {
        if (body[k]) {
            to[at++] = body[k];
        } else {
            to[code] = (uint8_t)(at - code);
            code = at++;
        }
    }
    to[code] = (uint8_t)(at - code);
    to[at++] = 0;
    return at;
}

static void drain(void)
{
    const uint8_t *bytes;
    size_t n;
    while ((n = hbp_tx_peek(&link, &bytes)) > 0) hbp_tx_advance(&link, n);
    while (hbp_can_peek(&can)) hbp_can_advance(&can);
}

static const uint8_t hello[8] = {1, 2, 3, 4, 1, 1, 0, 4};
static const uint8_t set_stream[24] = {0, 0, 1, 0, 100, 0, 8, 0, 1, 0, 2, 0, 3, 0, 4, 0, 12, 0, 15, 0, 16, 0, 17, 0};
static const uint8_t set_edges[8] = {1, 2, 1, 0, 100, 0, 0, 0};
static const uint8_t set_one[10] = {0, 0, 1, 0, 100, 0, 1, 0, 3, 0};
static const uint8_t both[4] = {3}, first[4] = {1};

static void measure(const char *name, uint8_t type, const uint8_t *payload, size_t n)
{
    uint8_t wire[80];
    size_t length = request(wire, type, payload, n);
    COUNT(hbp_rx(&link, now, wire, length));
    drain();
    if (name) report(name);
    else calls = total = most = 0;
}

/* The interrupt while samples are streamed, sent every now and then. */
static void measure_ticks(const char *name)
{
    struct sample sample = {0};
    for (unsigned k = 0; k < 200; k++) {
        COUNT(hbp_tick(&drive, &sample));
        now += MOTOR_PERIOD;
        if (k % 8u == 0) {
            hbp_poll(&link, now);
            drain();
        }
    }
    report(name);
}

/* The interrupts while a capture waits, and the main loop when it is complete. */
static void capture(void)
{
    static const uint8_t status[1] = {0}, off[22] = {0};
    static const uint8_t channels[16] = {1, 0, 2, 0, 3, 0, 4, 0, 12, 0, 15, 0, 16, 0, 17, 0};
    uint8_t arm[38] = {HBP_TRIGGER_ABOVE, 0, 1, 0, 200, 0, 0, 0, 64, 0, 0, 0, 0, 0, 0x80, 0x41, 12, 0, 50, 0, 8, 0}; /* above 16 A */
    struct sample sample = {0};
    hbp_link_init(&link, 1e6f);
    if (hbp_add(&link, &drive, &motor_config, 1)) return;
    hbp_tick(&drive, &sample);
    for (unsigned k = 0; k < 3000; k++) COUNT(hbp_tick(&drive, &sample));
    report("hbp_tick, a capture of 4 channels that waits for a fault");
    memcpy(arm + 22, channels, sizeof channels);
    arm[2] = arm[3] = 0xFF; /* a record in so many periods, for now */
    measure("hbp_rx: CAPTURE_ARM of 8 channels and its reply", HBP_TYPE_CAPTURE_ARM, arm, sizeof arm);
    COUNT(hbp_tick(&drive, &sample));
    report("hbp_tick, the first one of a capture");
    for (unsigned k = 0; k < 200; k++) COUNT(hbp_tick(&drive, &sample));
    report("hbp_tick, a capture that waits for a channel, without a record");
    for (unsigned k = 0; k < 200; k++) COUNT(hbp_edge(&drive, 1000u * k, 1, 3, 0));
    report("hbp_edge, a capture waits");
    arm[2] = 1, arm[3] = 0;
    measure(NULL, HBP_TYPE_CAPTURE_ARM, arm, sizeof arm);
    hbp_tick(&drive, &sample);
    for (unsigned k = 0; k < 1000; k++) COUNT(hbp_tick(&drive, &sample));
    report("hbp_tick, a capture of 8 channels that waits for a channel");
    arm[0] = HBP_TRIGGER_NOW;
    measure(NULL, HBP_TYPE_CAPTURE_ARM, arm, sizeof arm);
    for (unsigned k = 0; k < 100; k++) COUNT(hbp_tick(&drive, &sample));
    report("hbp_tick, while the trigger comes and the capture ends");
    COUNT(hbp_poll(&link, now));
    report("hbp_poll, the capture has ended");
    measure("hbp_rx: CAPTURE_STATUS and its reply", HBP_TYPE_CAPTURE_STATUS, status, 0);
    measure(NULL, HBP_TYPE_CAPTURE_ARM, off, sizeof off);
}

#if HBP_MEANS
/* The interrupt while means over 20 periods are streamed. */
static void means(const struct hbp_channel *table, uint16_t channels, const void *sample, const char *adds, const char *ends)
{
    uint8_t set_means[24] = {0, HBP_STREAM_MEAN, 20, 0, 100, 0, (uint8_t)channels};
    for (unsigned k = 0; k < channels; k++) set_means[8 + 2 * k] = (uint8_t)table[k].id;
    bare = motor_config;
    bare.capture = NULL;
    bare.features |= HBP_FEATURE_MEANS;
    bare.channels = table;
    bare.n_channels = channels;
    hbp_link_init(&link, 1e6f);
    if (hbp_add(&link, &drive, &bare, 1)) return;
    measure(NULL, HBP_TYPE_STREAM_SET, set_means, 8u + 2u * channels);
    measure(NULL, HBP_TYPE_STREAM_START, first, 4);
    hbp_tick(&drive, sample);
    for (unsigned of = 0; of < 2; of++) { /* those with a record, the others */
        for (unsigned k = 0; k < 200; k++) {
            int ended = drive.index % 20u == 0;
            if (ended == (of == 0)) COUNT(hbp_tick(&drive, sample));
            else hbp_tick(&drive, sample);
            hbp_poll(&link, now += MOTOR_PERIOD);
            drain();
        }
        report(of ? adds : ends);
    }
}

static void all_means(void)
{
    static const struct hbp_channel real[1] = {{1, HBP_RAW_F32, HBP_UNIT_A, 0, 0, 1.0f, 0.0f, "i_q"}};
    static const struct sample sample = {
        .hall = 5, .theta_enc = -30000, .omega_enc = 1234, .i_q = 2047, .omega_ref = 1200, .theta_avg = 31000, .omega_avg = 7,
    };
    static const float current = 3.7f;
    means(motor_config.channels, 8, &sample, "hbp_tick, means of 8 channels", "hbp_tick, means of 8 channels, with a record");
    means(real, 1, &current, "hbp_tick, means of an f32", "hbp_tick, means of an f32, with a record");
}
#endif

static void byte_link(void)
{
    struct sample sample = {0};
    bare = motor_config;
    bare.capture = NULL;
    hbp_link_init(&link, 1e6f);
    if (hbp_add(&link, &drive, &bare, 1)) return;
    for (unsigned k = 0; k < 100; k++) COUNT(hbp_tick(&drive, &sample));
    report("hbp_tick, no stream");
    hbp_poll(&link, now);
    drain();
    measure("hbp_rx: HELLO and its reply", HBP_TYPE_HELLO, hello, sizeof hello);
    measure("hbp_rx: STREAM_SET of 8 channels and its reply", HBP_TYPE_STREAM_SET, set_stream, sizeof set_stream);
    measure(NULL, HBP_TYPE_STREAM_SET, set_edges, sizeof set_edges);
    measure(NULL, HBP_TYPE_STREAM_SET, set_one, sizeof set_one);
    measure(NULL, HBP_TYPE_STREAM_START, first, 4);
    hbp_tick(&drive, &sample);
    measure_ticks("hbp_tick, 1 channel");
    measure(NULL, HBP_TYPE_STREAM_STOP, first, 4);
    measure(NULL, HBP_TYPE_STREAM_SET, set_stream, sizeof set_stream);
    measure(NULL, HBP_TYPE_STREAM_SET, set_edges, sizeof set_edges);
    measure(NULL, HBP_TYPE_STREAM_START, both, 4);
    COUNT(hbp_tick(&drive, &sample));
    report("hbp_tick, the first one of a stream");
    measure_ticks("hbp_tick, 8 channels");
    for (unsigned k = 0; k < 100; k++) {
        COUNT(hbp_edge(&drive, (uint32_t)now - 1u, 1, 3, 0));
        hbp_poll(&link, now += MOTOR_TICK_HZ / 9u);
        drain();
    }
    report("hbp_edge");
    for (unsigned k = 0; k < 100; k++) COUNT(hbp_may_run(&drive, (uint32_t)now));
    report("hbp_may_run, outputs off");
    drive.permit = 1, drive.runs = 1, drive.leash = (uint32_t)now, drive.leash_ticks = 1000;
    for (unsigned k = 0; k < 100; k++) COUNT(hbp_may_run(&drive, (uint32_t)now));
    report("hbp_may_run, outputs on");
    drive.permit = 0;
    for (unsigned k = 0; k < 100; k++) COUNT(hbp_raise(&drive, HBP_FAULT_HALL));
    report("hbp_raise");
    hbp_poll(&link, now);
    drain();
    for (unsigned k = 0; k < 100; k++) COUNT(hbp_poll(&link, now));
    report("hbp_poll, nothing to do");
    for (unsigned k = 0; k < 20; k++) {
        uint32_t waits = drive.streams[0].head;
        for (unsigned n = 0; n < 100 && drive.streams[0].head == waits; n++) hbp_tick(&drive, &sample);
        COUNT(hbp_poll(&link, now));
        drain();
    }
    report("hbp_poll, one full frame of samples");
}

/* A message of a host on a classic bus; each of its frames is counted. */
static void can_request(uint32_t id, uint8_t type, const uint8_t *payload, size_t n)
{
    static uint8_t transfer, tid;
    uint8_t body[64] = {type, 1, 0, 0, (uint8_t)n, 0, 1, 0}, data[8];
    size_t length = 6 + n, at = 0;
    uint32_t crc;
    if (id == 0x210) body[2] = ++tid;
    memcpy(body + 8, payload, n);
    crc = crc32(body, 8 + n);
    memmove(body + 6, body + 8, n);
    if (length > 7)
        for (unsigned k = 0; k < 4; k++) body[length++] = (uint8_t)(crc >> 8 * k);
    for (unsigned k = 0; at < length; k++) {
        size_t part = length - at < 7 ? length - at : 7;
        memcpy(data, body + at, part);
        at += part;
        data[part] = (uint8_t)((k ? 0 : 0x80) | (at == length ? 0x40 : 0) | (k & 1 ? 0 : 0x20) | (transfer & 31));
        COUNT(hbp_can_rx(&can, now, id, data, part + 1));
    }
    transfer++;
    drain();
}

static void can_link(void)
{
    static const uint8_t two[12] = {0, 0, 4, 0, 100, 0, 2, 0, 3, 0, 4, 0}, setpoint[12] = {1};
    struct sample sample = {0};
    if (hbp_can_init(&can, &bus) || hbp_can_add(&can, &drive, &bare, 1)) return;
    hbp_can_poll(&can, now);
    drain();
    for (unsigned k = 0; k < 8; k++) can_request(0x111, HBP_TYPE_SETPOINT, setpoint, sizeof setpoint);
    report("hbp_can_rx, a frame of a SETPOINT");
    can_request(0x210, HBP_TYPE_HELLO, hello, sizeof hello);
    report("hbp_can_rx, a frame of HELLO; with the reply");
    for (unsigned k = 0; k < 20; k++) COUNT(hbp_can_poll(&can, now));
    report("hbp_can_poll, nothing to do");
    can_request(0x210, HBP_TYPE_STREAM_SET, two, sizeof two);
    can_request(0x210, HBP_TYPE_STREAM_START, first, sizeof first);
    calls = total = most = 0;
    for (unsigned k = 0; k < 20; k++) {
        for (unsigned n = 0; n < 4; n++) hbp_tick(&drive, &sample);
        COUNT(hbp_can_poll(&can, now += 4 * MOTOR_PERIOD));
        drain();
    }
    report("hbp_can_poll, a sample of 2 channels");
}

int main(void)
{
    static const uint32_t end[2] = {0x20026u, 0};
    SYSTICK_RELOAD = 0xFFFFFFu;
    SYSTICK_VALUE = 0;
    SYSTICK_CONTROL = 5;
    for (unsigned k = 0; k < 10; k++) COUNT((void)0);
    empty = most;
    calls = total = most = 0;
#if HBP_MEANS
    all_means();
#else
    byte_link();
    can_link();
    capture();
#endif
    host(0x20, end);
    host(0x18, (const void *)0x20026u);
    return 0;
}
