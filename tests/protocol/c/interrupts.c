/* interrupts.c: the PWM interrupt between any two instructions of the main loop.
 *
 *     interrupts timer 2 1           seconds, seed: a timer's signal is the interrupt, some thousand times a second
 *     interrupts step 1000000 1      instructions, seed: the processor stops after each instruction of hbp.c, and every now and then the
 *                                    interrupt comes there (x86-64; elsewhere it ends with 77)
 *
 * A host configures, starts and stops streams meanwhile, and looks at all that comes: every record has the right index and value, edges come
 * before the samples that they precede, and what is lost is what is counted. In some sessions an interrupt takes the bytes away, as that of
 * a DMA does.
 */
#define _XOPEN_SOURCE 700
#define _DEFAULT_SOURCE
#define _GNU_SOURCE
#include "drive.h"

#include <signal.h>
#include <time.h>
#ifdef __x86_64__
#include <ucontext.h>
#endif

#define KEPT 4096u /* periods and edges that are remembered, a power of two */

static struct hbp_link link_;
static struct hbp device;
static struct hbp_config config;
static struct hbp_parameter parameters[4];
static struct app app;
static uint8_t memory[700]; /* for captures */

static volatile uint64_t period; /* the interrupt's: periods that are done */
static volatile uint32_t edges;
static uint32_t edge_ticks[KEPT], edges_up_to[KEPT];
static uint8_t code = 1;
static uint32_t chance = 12345; /* the interrupt has random numbers of its own */

static uint8_t wire[1 << 16];
static volatile uint32_t wire_head;
static uint32_t wire_tail;
static volatile unsigned dma; /* bytes that an interrupt takes */

static uint32_t chance_below(uint32_t n)
{
    chance = chance * 1664525u + 1013904223u;
    return (uint32_t)((uint64_t)chance * n >> 32);
}

static void take_bytes(size_t most)
{
    const uint8_t *bytes;
    size_t n = hbp_tx_peek(&link_, &bytes), room = sizeof wire - (wire_head - wire_tail);
    if (n > most) n = most;
    if (n > room) n = room;
    for (size_t k = 0; k < n; k++) wire[(wire_head + k) % sizeof wire] = bytes[k];
    wire_head = wire_head + (uint32_t)n;
    hbp_tx_advance(&link_, n);
}

static void interrupt(void)
{
    struct sample sample;
    uint64_t tick = period * TICKS;
    uint32_t n = chance_below(3) ? 0 : 1u + chance_below(2), at = (uint32_t)tick - TICKS + 1u;
    for (; n--; at += 1u + chance_below(TICKS / 2u - 1u)) {
        uint8_t next = (uint8_t)chance_below(8);
        edge_ticks[edges % KEPT] = at;
        hbp_edge(&device, at, code, next, (uint16_t)at);
        code = next;
        edges = edges + 1u;
    }
    edges_up_to[period % KEPT] = edges;
    if (hbp_may_run(&device, (uint32_t)tick)) REQUIRE(device.state == HBP_STATE_RUNNING || device.permit);
    sample_at(&sample, (uint32_t)period);
    hbp_tick(&device, &sample);
    if (dma) take_bytes(dma);
    period = period + 1u;
}

static uint64_t now(void)
{
    uint64_t done = period;
    return done ? (done - 1u) * TICKS : 0;
}

/* ---- when the interrupt comes --------------------------------------------------------------------------------------------- */

static long steps = -1; /* still to be done, or -1: a timer's interrupts */
static int quick;       /* for now the interrupt comes between two calls only */
static unsigned until_next = 1;

#ifdef __x86_64__
#define TRAP 0x100

static void on_trap(int number, siginfo_t *info, void *context)
{
    (void)number, (void)info, (void)context;
    if (steps > 0) steps--;
    if (--until_next == 0) {
        until_next = 1u + chance_below(1u << chance_below(14)); /* few, then many */
        interrupt();
    }
}

static void stepping(int on)
{
    if (on) __asm__ volatile("subq $128, %%rsp; pushfq; orq $0x100, (%%rsp); popfq; addq $128, %%rsp" ::: "memory", "cc");
    else __asm__ volatile("subq $128, %%rsp; pushfq; andq $~0x100, (%%rsp); popfq; addq $128, %%rsp" ::: "memory", "cc");
}
#else
static void stepping(int on)
{
    (void)on;
}
#endif

static void on_alarm(int number)
{
    (void)number;
    interrupt();
}

#define INTERRUPTED(call) \
    do { \
        int each = steps > 0 && !quick; \
        if (each) stepping(1); \
        call; \
        if (each) stepping(0); \
    } while (0)

/* ---- the host ------------------------------------------------------------------------------------------------------------- */

struct stream {
    uint8_t event, channels, ids[5], begun;
    uint16_t decimation, cfg_id, block, seq;
    uint32_t next, after; /* index that is next; edges that there were when it had started */
};

static struct stream streams[HBP_STREAMS];
static int answered;
static uint32_t lost, losing; /* frames that gaps tell of; whether this session had any */
static unsigned long n_samples, n_edges, n_sessions, n_lost, n_captures;
static uint8_t reply[HBP_TX_MAX]; /* to the last request */
static uint16_t tid;

static void check_samples(const uint8_t *payload, struct stream *s)
{
    uint32_t n = get(payload + 2, 2), index = get(payload + 8, 4), last = index + (n - 1u) * s->decimation;
    uint16_t gap = (uint16_t)(get(payload + 6, 2) - s->seq);
    const uint8_t *at = payload + 16;
    REQUIRE(index % s->decimation == 0 && get(payload + 12, 4) == index * TICKS && n && n <= s->block && last < period);
    REQUIRE((gap != 0) == (payload[1] & 1u));
    if (s->begun) REQUIRE(index == s->next + (uint32_t)gap * s->block * s->decimation);
    for (unsigned k = 0; k < n; k++)
        for (unsigned c = 0; c < s->channels; c++) {
            REQUIRE(get(at, channel_bytes(s->ids[c])) == value_at(s->ids[c], index + k * s->decimation));
            at += channel_bytes(s->ids[c]);
        }
    lost += gap;
    s->begun = 1;
    s->seq = (uint16_t)(s->seq + gap + 1u);
    s->next = last + s->decimation;
    n_samples += n;
    if (losing || hbp_dropped(&device) || period - last >= KEPT) return;
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        const struct stream *e = &streams[k];
        if (!e->cfg_id || e->event != HBP_STREAM_EDGES) continue;
        REQUIRE((int32_t)((e->begun ? e->next : e->after) - edges_up_to[last % KEPT]) >= 0);
    }
}

static void check_edges(const uint8_t *payload, struct stream *s)
{
    uint32_t n = get(payload + 2, 2), index = get(payload + 8, 4);
    uint16_t gap = (uint16_t)(get(payload + 6, 2) - s->seq);
    REQUIRE(n && n <= s->block && (gap != 0) == (payload[1] & 1u));
    if (s->begun) REQUIRE(gap ? (int32_t)(index - s->next) > 0 : index == s->next);
    else REQUIRE((int32_t)(s->after - index) >= 0);
    for (unsigned k = 0; k < n; k++)
        if (edges - (index + k) < KEPT - 64u) REQUIRE(get(payload + 16 + 8 * k, 4) == edge_ticks[(index + k) % KEPT]);
    lost += gap;
    s->begun = 1;
    s->seq = (uint16_t)(s->seq + gap + 1u);
    s->next = index + n;
    n_edges += n;
}

static void frame(const uint8_t *body)
{
    const uint8_t *payload = body + 8;
    if (body[1] & 0x10u) {
        REQUIRE(!(body[1] & 0x20u) && get(body + 2, 2) == tid);
        answered = 1;
        memcpy(reply, payload, get(body + 4, 2));
        if (body[0] != HBP_TYPE_STREAM_SET) return;
        streams[payload[0]].cfg_id = (uint16_t)get(payload + 2, 2);
        streams[payload[0]].block = (uint16_t)get(payload + 6, 2);
    } else if (body[0] == HBP_TYPE_DATA || body[0] == HBP_TYPE_EDGES) {
        struct stream *s = &streams[payload[0]];
        if (!s->cfg_id || get(payload + 4, 2) != s->cfg_id) return; /* of the session before */
        if (body[0] == HBP_TYPE_DATA) check_samples(payload, s);
        else check_edges(payload, s);
    }
}

static void look(void)
{
    static uint8_t stuffed[2048], body[HBP_TX_MAX + 12];
    static size_t n;
    while (wire_tail != wire_head) {
        uint8_t byte = wire[wire_tail % sizeof wire];
        wire_tail++;
        if (byte) {
            REQUIRE(n < sizeof stuffed);
            stuffed[n++] = byte;
        } else if (n) {
            REQUIRE(unstuff(body, sizeof body, stuffed, n));
            frame(body);
            n = 0;
        }
    }
}

static void turn(size_t most)
{
    INTERRUPTED(hbp_poll(&link_, now()));
    if (!dma || steps == 0) INTERRUPTED(take_bytes(most)); /* no interrupt comes any more once all steps are done */
    look();
}

static void ask(uint8_t type, const uint8_t *payload, size_t n)
{
    uint8_t body[HBP_RX_MAX + 12], bytes[2 * HBP_RX_MAX];
    size_t length;
    tid = (uint16_t)(tid % 0xFFFFu + 1u);
    answered = 0;
    length = stuff(bytes, body, make_body(body, type, 1, tid, 1, payload, n));
    INTERRUPTED(hbp_rx(&link_, now(), bytes, length));
    for (unsigned k = 0; !answered; k++) {
        REQUIRE(k < 10000000u);
        turn(1000);
    }
}

static void set_stream(uint8_t number, struct stream *s)
{
    uint8_t payload[18] = {number, s->event};
    put(payload + 2, s->decimation, 2);
    put(payload + 4, 1u + below(8), 2);
    put(payload + 6, s->channels, 2);
    for (unsigned k = 0; k < s->channels; k++) put(payload + 8 + 2 * k, s->ids[k], 2);
    ask(HBP_TYPE_STREAM_SET, payload, 8u + 2u * s->channels);
}

/* A capture that was armed before, whatever has come meanwhile: its records are the right ones, without a gap, and so are its edges. */
static void look_at_capture(void)
{
    static uint8_t blob[sizeof memory], told[sizeof reply];
    uint8_t part[8] = {1, 0, 0xFF};
    for (unsigned k = 0; k < 400; k++) {
        ask(HBP_TYPE_CAPTURE_STATUS, NULL, 0);
        if (reply[0] != HBP_CAPTURE_TRIGGERED) break;
        if (steps >= 0) interrupt(); /* else they come by themselves */
        turn(1000);
    }
    if (reply[0] != HBP_CAPTURE_FROZEN) return;
    memcpy(told, reply, sizeof told);
    n_captures++;
    for (uint32_t offset = 0; offset < get(told + 36, 4); offset += get(reply + 2, 2)) {
        put(part + 4, offset, 4);
        ask(HBP_TYPE_BLOB_READ, part, 8);
        REQUIRE(offset + get(reply + 2, 2) <= sizeof blob);
        memcpy(blob + offset, reply + 12, get(reply + 2, 2));
    }
    check_blob(told, blob, edge_ticks, KEPT, edges);
}

static void arm_capture(void)
{
    uint8_t arm[32] = {0};
    ask(HBP_TYPE_CAPTURE_ARM, arm, 22); /* what was held is given up */
    REQUIRE(reply[0] == HBP_CAPTURE_ARMED || reply[0] == HBP_CAPTURE_TRIGGERED);
    if (below(4) == 0) return;
    arm[0] = (uint8_t)(below(2) ? HBP_TRIGGER_NOW : HBP_TRIGGER_ABOVE + below(10));
    arm[2] = (uint8_t)(1u + below(3));
    arm[4] = (uint8_t)below(20);
    arm[8] = (uint8_t)(1u + below(20));
    put(arm + 12, 0x3F000000u, 4); /* 0.5 */
    arm[16] = (uint8_t)(1u + below(5));
    arm[18] = (uint8_t)below(20);
    arm[20] = 5;
    for (unsigned k = 0; k < 5; k++) arm[22 + 2 * k] = (uint8_t)(1u + k);
    if (arm[0] > HBP_TRIGGER_PULSE) arm[0] = HBP_TRIGGER_FAULT;
    ask(HBP_TYPE_CAPTURE_ARM, arm, sizeof arm);
}

/* Streams from their configuration to their end. */
static void session(void)
{
    uint8_t mask[4] = {7};
    uint32_t before, turns = steps < 0 ? 20u + below(60) : below(20);
    memset(streams, 0, sizeof streams);
    lost = losing = 0;
    dma = below(3) ? 0 : 20u + below(200);
    for (uint8_t k = 0; k < 3; k++) {
        struct stream *s = &streams[k];
        s->event = k == 1 ? HBP_STREAM_EDGES : HBP_STREAM_PWM;
        s->decimation = (uint16_t)(1u + below(k ? 5 : 2));
        if (k != 1) s->channels = (uint8_t)(1u + below(5));
        for (unsigned c = 0; c < s->channels; c++) s->ids[c] = (uint8_t)(1u + (c + k) % 5u);
        set_stream(k, s);
    }
    arm_capture();
    if (below(4) == 0) hbp_fault(&device, HBP_FAULT_HALL << below(2));
    before = hbp_dropped(&device);
    for (unsigned k = 0; k < HBP_STREAMS; k++) streams[k].after = 0xFFFFFFFFu / 2u + edges; /* any, until it is known */
    ask(HBP_TYPE_STREAM_START, mask, 4);
    streams[1].after = edges;
    for (unsigned k = 0; k < turns; k++) {
        if (below(32) == 0) {
            uint64_t until = period + 40u + below(200); /* the main loop hangs */
            losing = 1;
            while (steps > 0 && period < until) interrupt();
            while (steps < 0 && period < until) {}
        }
        turn(below(4) ? 1000 : 1u + below(100));
    }
    dma = 0;
    if (below(2)) { /* a later frame of each stream, so that gaps tell all that was lost */
        const uint32_t far = (uint32_t)period + 300u, far_edges = edges + 100u;
        quick = 1;
        for (unsigned k = 0; k < 3; k++)
            for (unsigned n = 0; !streams[k].begun || (int32_t)(streams[k].next - (k == 1 ? far_edges : far)) < 0; n++) {
                REQUIRE(n < 10000000u);
                if (steps >= 0) interrupt();
                turn(100000);
            }
        for (unsigned k = 0; k < 20; k++) turn(100000);
        quick = 0;
        ask(HBP_TYPE_STREAM_STOP, mask, 4);
        for (unsigned k = 0; k < 20; k++) turn(100000);
        REQUIRE(lost == hbp_dropped(&device) - before);
    } else {
        ask(HBP_TYPE_STREAM_STOP, mask, 4);
        for (unsigned k = 0; k < 20; k++) turn(100000);
        REQUIRE(lost <= hbp_dropped(&device) - before);
    }
    n_lost += lost;
    look_at_capture();
    for (unsigned k = 0; k < HBP_STREAMS; k++) REQUIRE(!device.streams[k].running && device.streams[k].head == device.streams[k].tail);
    n_sessions++;
}

int main(int argc, char **argv)
{
    static const uint8_t hello[8] = {1, 2, 3, 4, 1, 1, 0, 4};
    int step = argc > 1 && !strcmp(argv[1], "step");
    long amount = argc > 2 ? strtol(argv[2], NULL, 10) : 1;
    struct timespec began, at;
    if (argc > 3) random_state = strtoull(argv[3], NULL, 10), chance += (uint32_t)random_state;
    configure_drive(&config, parameters, &app, 1, HBP_FEATURE_EDGES);
    config.capture = memory;
    config.capture_bytes = sizeof memory;
    hbp_link_init(&link_, 0.0f);
    REQUIRE(!hbp_add(&link_, &device, &config, BOOT));
    clock_gettime(CLOCK_MONOTONIC, &began);
    if (step) {
#ifdef __x86_64__
        struct sigaction action = {.sa_sigaction = on_trap, .sa_flags = SA_SIGINFO};
        sigaction(SIGTRAP, &action, NULL);
        steps = amount;
#else
        return 77;
#endif
    } else {
        struct sigaction action = {.sa_handler = on_alarm, .sa_flags = SA_RESTART};
        struct itimerspec every = {{0, 50000}, {0, 50000}};
        timer_t timer;
        sigaction(SIGALRM, &action, NULL);
        REQUIRE(!timer_create(CLOCK_MONOTONIC, NULL, &timer) && !timer_settime(timer, 0, &every, NULL));
    }
    ask(HBP_TYPE_HELLO, hello, sizeof hello);
    do {
        session();
        clock_gettime(CLOCK_MONOTONIC, &at);
    } while (step ? steps > 0 : at.tv_sec - began.tv_sec < amount);
    printf("%lu sessions, %lu periods, %lu samples, %lu edges, %lu frames lost and counted, %lu captures\n", n_sessions, (unsigned long)period,
           n_samples, n_edges, n_lost, n_captures);
    return 0;
}
