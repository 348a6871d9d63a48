/* fuzz.c: random, wrong and damaged frames into hbp.c, and what must hold whatever comes.
 *
 *     fuzz byte 1000000 1      frames, seed: over a byte link, two devices
 *     fuzz can 1000000 1       over CAN; CAN FD if it was compiled with HBP_CAN_BYTES=64
 *
 * With -DLIBFUZZER it is a target of libFuzzer, over the byte link. It ends by abort() where something does not hold.
 */
#include "requests.h"

#include "../../../protocol/c/hbp_can.h"

#define KEPT 1024u /* edges and periods that are remembered, a power of two */

struct config_told { /* how a stream was configured, by its cfg_id */
    uint8_t known, missed, event, channels, begun; /* missed: its reply found no room */
    uint8_t ids[MANY];
    uint16_t decimation, block, seq;
    uint32_t next;
};

struct asked {
    uint8_t type, node;
    uint16_t tid, n;
    uint8_t payload[HBP_RX_MAX];
};

static struct node {
    struct hbp *device;
    uint8_t *memory; /* for captures, as large as it is told to be */
    int16_t *waveform;
    struct app app;
    struct hbp_parameter parameters[4];
    struct hbp_config config;
    struct config_told *told; /* 65536 */
    uint32_t edges, edge_ticks[KEPT], edges_up_to[KEPT], dropped;
    uint8_t code, overrun; /* edges found the ring full */
} nodes[2];

static unsigned n_nodes;
static struct hbp_link *link_;
static struct hbp_can *can;
static uint64_t period, now;
static int slow;                      /* the link takes less than there is: what is not sent may be lost */
static struct asked queue[64];        /* what must be answered, in this order */
static uint32_t queue_head, queue_tail;
static unsigned long n_captures, n_frames, n_replies, n_samples, n_edges, n_damaged, n_running;

/* ---- what must hold at any time ------------------------------------------------------------------------------------------- */

static void check_node(const struct node *node)
{
    const struct hbp *h = node->device;
    REQUIRE(h->state == node->app.state);
    REQUIRE(node->app.on == (node->app.state == HBP_STATE_RUNNING));
    REQUIRE(!h->permit || h->state == HBP_STATE_RUNNING);
    REQUIRE((uint16_t)(h->edge_head - h->edge_tail) <= HBP_EDGES);
    REQUIRE((h->state == HBP_STATE_FAULT) == (h->faults != 0));
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        const struct hbp_stream *s = &h->streams[k];
        REQUIRE(s->channels <= HBP_CHANNELS && s->head - s->tail <= s->places);
        REQUIRE(s->places * s->stride * 4u <= HBP_POOL_BYTES);
        REQUIRE(s->filled < s->block || !s->filled);
        REQUIRE(!s->running || s->configured);
        REQUIRE((uint32_t)s->block * s->record_bytes + 8u <= s->stride * 4u || !s->stride);
        for (unsigned j = 0; j < k; j++)
            REQUIRE(!s->stride || !h->streams[j].stride || s->pool != h->streams[j].pool);
    }
}

static void check_all(void)
{
    for (unsigned k = 0; k < n_nodes; k++) check_node(&nodes[k]);
    if (link_) {
        REQUIRE(link_->head - link_->tail <= HBP_TX_BYTES);
        REQUIRE(link_->decoded <= sizeof link_->rx);
    } else {
        REQUIRE((uint16_t)(can->head[0] - can->tail[0]) <= HBP_CAN_MESSAGES);
        REQUIRE((uint16_t)(can->head[1] - can->tail[1]) <= HBP_CAN_STREAMED);
    }
}

/* ---- what the devices say ------------------------------------------------------------------------------------------------- */

static unsigned record_bytes(const struct config_told *told)
{
    unsigned bytes = 0;
    for (unsigned k = 0; k < told->channels; k++) bytes += bytes_in(told->event, told->ids[k]);
    return bytes;
}

static const uint8_t *check_record(const struct config_told *told, const uint8_t *at, uint32_t index)
{
    for (unsigned k = 0; k < told->channels; k++) at = check_value(at, told->event, told->ids[k], index, told->decimation);
    return at;
}

static void check_samples(struct node *node, struct config_told *told, const uint8_t *payload, size_t n)
{
    uint32_t records = get(payload + 2, 2), index = get(payload + 8, 4), step = told->decimation;
    uint16_t gap = (uint16_t)(get(payload + 6, 2) - told->seq);
    const uint8_t *at = payload + 16;
    REQUIRE(told->event != HBP_STREAM_EDGES && records && records <= told->block);
    REQUIRE(n == 16u + records * record_bytes(told));
    REQUIRE(index % step == 0 && get(payload + 12, 4) == (uint32_t)(index * TICKS));
    REQUIRE((gap != 0) == (payload[1] & 1u));
    if (told->begun) REQUIRE(index == told->next + gap * told->block * step);
    for (unsigned k = 0; k < records; k++) at = check_record(told, at, index + k * step);
    told->begun = 1;
    told->seq = (uint16_t)(told->seq + gap + 1u);
    told->next = index + records * step;
    n_samples += records;
    if (slow || node->dropped || node->overrun || (uint32_t)period - index >= KEPT) return;
    for (unsigned k = 0; k < HBP_STREAMS; k++) { /* all edges up to the last of them were told before */
        const struct hbp_stream *s = &node->device->streams[k];
        const struct config_told *edges = &node->told[s->cfg_id];
        if (s->running && s->event == HBP_STREAM_EDGES && edges->begun)
            REQUIRE((int32_t)(edges->next - node->edges_up_to[(told->next - step) % KEPT]) >= 0);
    }
}

static void check_edges(const struct node *node, struct config_told *told, const uint8_t *payload, size_t n)
{
    uint32_t records = get(payload + 2, 2), index = get(payload + 8, 4);
    uint16_t gap = (uint16_t)(get(payload + 6, 2) - told->seq);
    REQUIRE(told->event == HBP_STREAM_EDGES && records && records <= told->block && n == 16u + 8u * records);
    REQUIRE((gap != 0) == (payload[1] & 1u));
    if (told->begun) REQUIRE(gap ? (int32_t)(index - told->next) > 0 : index == told->next);
    for (unsigned k = 0; k < records; k++) {
        const uint8_t *r = payload + 16 + 8 * k;
        uint32_t tick = node->edge_ticks[(index + k) % KEPT];
        if (node->edges - (index + k) < KEPT) REQUIRE(get(r, 4) == tick && get(r + 6, 2) == (tick & 0xFFFFu) && !r[5]);
        if (!k) REQUIRE(get(payload + 12, 4) == get(r, 4));
    }
    told->begun = 1;
    told->seq = (uint16_t)(told->seq + gap + 1u);
    told->next = index + records;
    n_edges += records;
}

static void remember_stream(struct node *node, const struct asked *asked, const uint8_t *payload)
{
    struct config_told *told = &node->told[get(payload + 2, 2)];
    uint32_t block = get(payload + 6, 2);
    REQUIRE(get(payload + 2, 2) && block);
    if (told->known && told->block == block && told->event == asked->payload[1]) return; /* asked once more */
    memset(told, 0, sizeof *told);
    told->known = 1;
    told->event = asked->payload[1];
    told->decimation = (uint16_t)get(asked->payload + 2, 2);
    told->channels = (uint8_t)get(asked->payload + 6, 2);
    told->block = (uint16_t)block;
    for (unsigned k = 0; k < told->channels; k++) told->ids[k] = (uint8_t)get(asked->payload + 8 + 2 * k, 2);
    REQUIRE(told->event == HBP_STREAM_EDGES || get(payload + 4, 2) == record_bytes(told));
    REQUIRE(HBP_MEANS || told->event != HBP_STREAM_MEAN);
}

static void check_heartbeat(struct node *node, const uint8_t *payload, size_t n)
{
    REQUIRE(n == 44 && payload[36] <= HBP_STATE_FAULT && payload[37] == (payload[36] == HBP_STATE_RUNNING));
    REQUIRE((get(payload + 34, 2) == 0xFFFFu) == (payload[36] != HBP_STATE_ARMED && payload[36] != HBP_STATE_RUNNING));
    REQUIRE(get(payload + 20, 4) >= node->dropped);
    node->dropped = get(payload + 20, 4);
}

/* What a capture says of itself, and what it holds once it is frozen. */
static void check_capture(const struct node *node, const uint8_t *reply, size_t n)
{
    static uint8_t blob[1u << 13];
    uint32_t size = get(reply + 36, 4);
    REQUIRE(n == 66u + 2u * get(reply + 64, 2) && reply[0] <= HBP_CAPTURE_FROZEN && reply[1] <= HBP_TRIGGER_PULSE && get(reply + 2, 2));
    REQUIRE(get(reply + 8, 4) + get(reply + 12, 4) >= 1u && get(reply + 4, 2) && get(reply + 44, 4) == node->config.capture_bytes);
    if (reply[0] != HBP_CAPTURE_FROZEN) {
        REQUIRE(!size && !get(reply + 20, 4) && !get(reply + 24, 4));
        return;
    }
    if (get(reply + 2, 2) != node->device->capture->number) return; /* a kept answer, of one that has been given up */
    n_captures++;
    REQUIRE(size <= sizeof blob);
    for (uint32_t offset = 0, part; offset < size; offset += part) {
        const uint8_t *from;
        part = size - offset;
        from = hbp_capture_blob(node->device, offset, &part);
        memcpy(blob + offset, from, part);
    }
    check_blob(reply, blob, node->edge_ticks, KEPT, node->edges);
}

/* Whether a reply to HELLO has the nonce of another. */
static int other_hello(const struct asked *asked, const uint8_t *body)
{
    return body[0] == HBP_TYPE_HELLO && !(body[1] & 0x20u) && get(body + 8, 4) != get(asked->payload, 4);
}

static void check_reply(struct node *node, const uint8_t *body, size_t n)
{
    const struct asked *asked = &queue[queue_tail % 64u];
    for (;; asked = &queue[queue_tail % 64u]) {
        REQUIRE(queue_head != queue_tail); /* nobody asked: an answer to damage, say */
        queue_tail++;
        if (asked->type == body[0] && asked->tid == get(body + 2, 2) && asked->node == body[6] && !(slow && other_hello(asked, body)))
            break;
        REQUIRE(slow); /* the reply to this one found no room */
    }
    n_replies++;
    if (body[1] & 0x20u) {
        REQUIRE(n == 8 && get(body + 8, 2) >= 1 && get(body + 8, 2) <= 16 && body[10] == body[0]);
        return;
    }
    if (body[0] == HBP_TYPE_HELLO) REQUIRE(n == 116 && get(body + 8, 4) == get(asked->payload, 4));
    if (body[0] == HBP_TYPE_STREAM_SET && !can) remember_stream(node, asked, body + 8);
    if (body[0] == HBP_TYPE_CAPTURE_ARM || body[0] == HBP_TYPE_CAPTURE_STATUS) check_capture(node, body + 8, n);
    if (body[0] == HBP_TYPE_STATE_CMD) REQUIRE(n == 4 && body[8] >= HBP_STATE_IDLE && body[8] <= HBP_STATE_FAULT);
}

/* Header and payload of a message. */
static void told(const uint8_t *body, size_t n)
{
    struct node *node;
    REQUIRE(n <= HBP_TX_MAX && body[6] >= 1 && body[6] <= n_nodes && !body[7] && (body[1] & 15u) == 1);
    node = &nodes[body[6] - 1];
    if (body[1] & 0x10u) {
        check_reply(node, body, n);
        return;
    }
    REQUIRE(body[1] == 1 && get(body + 2, 2) == 0);
    switch (body[0]) {
    case HBP_TYPE_HEARTBEAT: check_heartbeat(node, body + 8, n); break;
    case HBP_TYPE_EVENT: REQUIRE(n == 20 && body[18] == body[6]); break;
    case HBP_TYPE_LOG: REQUIRE(n >= 1); break;
    case HBP_TYPE_DATA:
    case HBP_TYPE_EDGES: {
        struct config_told *config = &node->told[get(body + 12, 2)];
        REQUIRE(!can && n > 16 && (config->known || config->missed || slow));
        if (!config->known) break;
        if (body[0] == HBP_TYPE_DATA) check_samples(node, config, body + 8, n);
        else check_edges(node, config, body + 8, n);
        break;
    }
    default: REQUIRE(!"a known type");
    }
}

/* ---- time, as interrupts make it -------------------------------------------------------------------------------------------- */

static void pass_period(void)
{
    struct sample sample;
    uint32_t before = (uint32_t)now;
    now = period * TICKS;
    for (unsigned k = 0; k < n_nodes; k++) {
        struct node *node = &nodes[k];
        if (below(4) == 0) {
            uint32_t tick = before + 1u + below(TICKS);
            uint8_t code = (uint8_t)(draw() & 7u);
            if ((uint16_t)(node->device->edge_head - node->device->edge_tail) >= HBP_EDGES) node->overrun = 1;
            node->edge_ticks[node->edges++ % KEPT] = tick;
            hbp_edge(node->device, tick, node->code, code, (uint16_t)tick);
            node->code = code;
        }
        node->edges_up_to[period % KEPT] = node->edges;
        if (hbp_may_run(node->device, (uint32_t)now)) {
            REQUIRE(node->app.state == HBP_STATE_RUNNING);
            n_running++;
        }
        if (below(20000) == 0) hbp_raise(node->device, 1u << below(24));
        sample_at(&sample, (uint32_t)period);
        hbp_tick(node->device, &sample);
    }
    period++;
}

static void begin(uint32_t features)
{
    n_nodes = 0;
    period = now = 0;
    slow = 0;
    queue_head = queue_tail = 0;
    for (unsigned k = 0; k < (can ? 1u : 2u); k++) {
        struct node *node = &nodes[k];
        configure_drive(&node->config, node->parameters, &node->app, (uint8_t)(k + 1u), features);
        node->app.moody = 1;
        free(node->memory);
        node->memory = NULL;
        node->config.capture_bytes = below(4) ? 200u + below(3000) : 0;
        if (node->config.capture_bytes) node->config.capture = node->memory = malloc(node->config.capture_bytes);
        if (below(2)) node->config.meanings = "hall what the sensors say\ni_a a current\n";
        if (below(4)) {
            node->config.waveform = node->waveform;
            node->config.waveform_length = 256;
        }
        node->edges = node->dropped = node->overrun = 0;
        node->code = 1;
        memset(node->told, 0, 65536 * sizeof *node->told);
        if (can) REQUIRE(!hbp_can_add(can, node->device, &node->config, BOOT));
        else REQUIRE(!hbp_add(link_, node->device, &node->config, BOOT));
        n_nodes++;
    }
}

static void expect(const uint8_t *body, size_t n)
{
    struct asked *asked = &queue[queue_head % 64u];
    REQUIRE(queue_head - queue_tail < 64u);
    asked->type = body[0];
    asked->tid = (uint16_t)get(body + 2, 2);
    asked->node = (uint8_t)(body[6] >= 1 && body[6] <= n_nodes ? body[6] : 1);
    asked->n = (uint16_t)(n - 12);
    memcpy(asked->payload, body + 8, asked->n);
    queue_head++;
}

/* ---- the byte link ---------------------------------------------------------------------------------------------------------- */

static struct {
    uint8_t bytes[1042];
    size_t n;
    int skipping;
    uint32_t bad, ignored;
} came; /* as a receiver sees it that was written from SPEC */

static void frame_came(void)
{
    uint8_t body[8 + HBP_RX_MAX + 4];
    size_t n = unstuff(body, sizeof body, came.bytes, came.n);
    int silent;
    if (!n) {
        came.bad++;
        return;
    }
    if (body[1] & 0x30u) {
        came.ignored++;
        return;
    }
    silent = body[6] <= n_nodes && (body[1] & 15u) == 1 && get(body + 2, 2) == 0 &&
             ((body[0] == HBP_TYPE_ALIVE && n == 16) || (body[0] == HBP_TYPE_SETPOINT && n == 24));
    if (!silent) expect(body, n);
}

static void byte_came(uint8_t byte)
{
    if (byte) {
        if (came.skipping) return;
        if (came.n < sizeof came.bytes) came.bytes[came.n++] = byte;
        if (came.n > 1041) {
            came.bad++;
            came.skipping = 1;
        }
    } else {
        if (!came.skipping && came.n) frame_came();
        came.skipping = 0;
        came.n = 0;
    }
}

/* Bytes go in at the end of their memory, in pieces, so that a look beyond them is seen. */
static void feed(const uint8_t *bytes, size_t n)
{
    static uint8_t *memory, *end;
    if (!memory) memory = malloc(4096);
    end = memory + 4096;
    while (n) {
        size_t part = below(3) ? n : 1u + below((uint32_t)n);
        memcpy(end - part, bytes, part);
        for (size_t k = 0; k < part; k++) byte_came(bytes[k]);
        hbp_rx(link_, now, end - part, part);
        bytes += part;
        n -= part;
    }
    REQUIRE(link_->base.bad == came.bad && link_->base.ignored == came.ignored);
}

static void drain(size_t most)
{
    static uint8_t frame[2048], body[HBP_TX_MAX + 12];
    static size_t n;
    const uint8_t *bytes;
    size_t length;
    if (!link_->tail) n = 0; /* a new link */
    for (; most && (length = hbp_tx_peek(link_, &bytes)) > 0; most -= length) {
        if (length > most) length = most;
        for (size_t k = 0; k < length; k++) {
            if (bytes[k]) {
                REQUIRE(n < sizeof frame);
                frame[n++] = bytes[k];
            } else if (n) {
                size_t whole = unstuff(body, sizeof body, frame, n);
                REQUIRE(whole);
                told(body, whole - 12);
                n = 0;
            }
        }
        hbp_tx_advance(link_, length);
        hbp_poll(link_, now);
    }
}

static void damage(uint8_t *wire, size_t *n)
{
    size_t at = below((uint32_t)*n);
    n_damaged++;
    switch (below(5)) {
    case 0: wire[at] ^= (uint8_t)(1u << below(8)); break;
    case 1: wire[at] = (uint8_t)draw(); break;
    case 2: *n = at ? at : 1; break;
    case 3:
        memmove(wire + at, wire + at + 1, *n - at - 1);
        --*n;
        break;
    default:
        memmove(wire + at + 1, wire + at, *n - at);
        wire[at] = (uint8_t)draw();
        ++*n;
        break;
    }
}

static void byte_step(void)
{
    static uint8_t wire[2 * HBP_RX_MAX + 64];
    static size_t n;
    uint8_t body[HBP_RX_MAX + 40];
    struct made m;
    if (!n || below(16)) { /* else the last one again */
        make_request(&m, nodes[0].app.state, nodes[0].device->faults);
        n = stuff(wire, body, make_body(body, m.type, m.flags, m.tid, m.node, m.payload, m.n));
        if (below(5) == 0) damage(wire, &n);
    }
    if (below(64) == 0) {
        for (n = 0; n < 20; n++) wire[n] = (uint8_t)draw();
    }
    if (below(512) == 0)
        for (unsigned k = 0; k < 1200; k += 20) { /* much without a delimiter */
            uint8_t noise[20];
            memset(noise, (int)(1u + below(255)), sizeof noise);
            feed(noise, sizeof noise);
        }
    feed(wire, n);
    n_frames++;
    for (unsigned k = below(4) ? below(4) : below(40); k--;) {
        pass_period();
        if (below(4) == 0) hbp_poll(link_, now);
    }
    if (below(2000) == 0) hbp_fault(nodes[0].device, 1u << below(24));
    if (below(256) == 0) hbp_log(nodes[0].device, 6, "a line");
    if (below(1024) == 0) slow = 1;
    check_all();
    if (slow) {
        hbp_poll(link_, now);
        check_all();
        drain(below(60));
        if (queue_head - queue_tail > 32u || below(200) == 0) {
            drain(1u << 20);
            REQUIRE(link_->head == link_->tail);
            queue_tail = queue_head; /* replies that found no room */
            for (unsigned k = 0; k < n_nodes; k++)
                for (unsigned j = 0; j < HBP_STREAMS; j++)
                    if (nodes[k].device->streams[j].configured) nodes[k].told[nodes[k].device->streams[j].cfg_id].missed = 1;
            slow = 0;
        }
    } else {
        hbp_poll(link_, now);
        drain(1u << 20);
        REQUIRE(queue_head == queue_tail); /* each request has its answer */
    }
    check_all();
}

static void begin_byte(void)
{
    if (!link_) link_ = malloc(sizeof *link_);
    hbp_link_init(link_, below(2) ? 0.0f : 100000.0f);
    memset(&came, 0, sizeof came);
    came.skipping = 1;
    begin(below(4) ? HBP_FEATURE_EDGES | HBP_FEATURE_MEANS : 0);
}

/* ---- CAN ---------------------------------------------------------------------------------------------------------------- */

struct can_frame {
    uint32_t id;
    uint8_t n, data[64];
};

static struct hbp_can_bus bus = {1000000, HBP_CAN_BYTES == 64 ? 5000000 : 0, 0};
static uint8_t transfers[2048]; /* the next transfer id of each identifier */

static unsigned fd_length(unsigned n)
{
    static const uint8_t lengths[] = {8, 12, 16, 20, 24, 32, 48, 64};
    unsigned k = 0;
    if (n <= 8) return n;
    while (lengths[k] < n) k++;
    return lengths[k];
}

/* The frames of a message from host `host`; how many. */
static unsigned cut(struct can_frame *frames, const struct made *m, uint32_t id)
{
    uint8_t body[HBP_RX_MAX + 40], raw[HBP_RX_MAX + 40];
    unsigned part = bus.data_bitrate ? 63u : 7u, count = 0;
    size_t length = make_body(body, m->type, m->flags, m->tid, (uint8_t)(id >> 4 & 15u), m->payload, m->n) - 12 + 6;
    memcpy(raw, body, 6);
    memcpy(raw + 6, body + 8, m->n);
    if (length > part) {
        memcpy(raw + length, body + 8 + m->n, 4);
        length += 4;
    }
    for (size_t at = 0; at < length; count++) {
        struct can_frame *f = &frames[count];
        unsigned n = (unsigned)(length - at < part ? length - at : part);
        memset(f, 0, sizeof *f);
        f->id = id | (bus.extended ? 0x82421000u : 0u);
        f->n = (uint8_t)(bus.data_bitrate ? fd_length(n + 1u) : n + 1u);
        memcpy(f->data, raw + at, n);
        at += n;
        f->data[f->n - 1] = (uint8_t)((count ? 0 : 0x80u) | (at == length ? 0x40u : 0) | (count & 1u ? 0 : 0x20u) | transfers[id]);
    }
    transfers[id] = (uint8_t)((transfers[id] + 1u) & 31u);
    return count;
}

static void check_can_samples(const struct hbp_can_frame *f)
{
    const struct node *node = &nodes[0];
    uint32_t slot = (((f->id >> 8 & 7u) - 5u) << 4) | (f->id & 15u), most = bus.data_bitrate ? 60u : 6u;
    unsigned counter = bus.data_bitrate ? 4u : 2u;
    for (unsigned k = 0; k < 2 * HBP_STREAMS; k++) { /* one that is configured, else one that was: its slots may be another's */
        const struct hbp_stream *s = &node->device->streams[k % HBP_STREAMS];
        const uint8_t *at = f->data + counter;
        uint32_t number, index;
        unsigned from = 0, to = 0, groups = (slot - s->slot) & 31u;
        if (s->configured != (k < HBP_STREAMS)) continue;
        if (!s->decimation || s->event == HBP_STREAM_EDGES || groups >= s->groups) continue;
        for (unsigned g = 0; g <= groups; g++) {
            unsigned bytes = 0;
            for (from = to; to < s->channels && bytes + bytes_in(s->event, (uint16_t)(s->take[to] + 1u)) <= most; to++)
                bytes += bytes_in(s->event, (uint16_t)(s->take[to] + 1u));
        }
        if (bus.data_bitrate) {
            index = get(f->data, 4);
        } else {
            number = (uint32_t)(period / s->decimation);
            number += (uint32_t)(int16_t)(uint16_t)(get(f->data, 2) - number);
            index = number * s->decimation;
        }
        REQUIRE(index % s->decimation == 0 && index < period);
        for (unsigned n = 0; n < s->block; n++, index += s->decimation)
            for (unsigned c = from; c < to; c++) at = check_value(at, s->event, (uint16_t)(s->take[c] + 1u), index, s->decimation);
        while (at < f->data + f->length) REQUIRE(!*at++);
        n_samples += s->block;
        return;
    }
    REQUIRE(!"a stream has this slot");
}

static void message_frame(const struct hbp_can_frame *f)
{
    static struct {
        uint8_t bytes[8 + HBP_TX_MAX + 4 + 64], next, id;
        size_t n;
    } parts[2048];
    unsigned at = f->id & 0x7FFu, n = f->length - 1u, tail = f->data[n];
    uint8_t *bytes = parts[at].bytes;
    if (tail & 0x80u) {
        parts[at].n = 2; /* room for node and zero */
        parts[at].next = 0x20u | (tail & 31u);
    }
    REQUIRE((tail & 0x3Fu) == parts[at].next);
    parts[at].next = (uint8_t)(parts[at].next ^ 0x20u);
    memcpy(bytes + parts[at].n, f->data, n);
    parts[at].n += n;
    if (!(tail & 0x40u)) return;
    memmove(bytes, bytes + 2, 6);
    bytes[6] = (uint8_t)(f->id >> 4 & 15u);
    bytes[7] = 0;
    n = get(bytes + 4, 2);
    REQUIRE(parts[at].n >= 8u + n && n <= HBP_TX_MAX);
    if (!(tail & 0x80u)) REQUIRE(crc32(bytes, 8u + n) == get(bytes + 8 + n, 4));
    told(bytes, n);
}

static void drain_can(unsigned most)
{
    const struct hbp_can_frame *f;
    while (most-- && (f = hbp_can_peek(can)) != NULL) {
        unsigned class = f->id >> 8 & 7u;
        REQUIRE((f->id & ~0x7FFu) == (bus.extended ? 0x82421000u : 0u) && (f->id >> 4 & 15u) == 1);
        REQUIRE(f->length <= HBP_CAN_BYTES && f->length == (bus.data_bitrate ? fd_length(f->length) : f->length));
        REQUIRE(f->streamed == (class >= 4));
        if (class == 1 || class == 3) message_frame(f);
        else if (class == 4) n_edges++;
        else check_can_samples(f);
        hbp_can_advance(can);
        hbp_can_poll(can, now);
    }
}

static void can_feed(const struct can_frame *f)
{
    static uint8_t *memory, *end;
    if (!memory) memory = malloc(64);
    end = memory + 64;
    memcpy(end - f->n, f->data, f->n);
    hbp_can_rx(can, now, f->id, end - f->n, f->n);
}

static void can_step(void)
{
    struct can_frame frames[(HBP_RX_MAX + 40) / 7 + 1];
    struct made m;
    uint8_t body[HBP_RX_MAX + 40];
    unsigned n, at, spoilt = 0, host = below(HBP_HOSTS);
    uint32_t id;
    make_request(&m, nodes[0].app.state, nodes[0].device->faults);
    if (m.type == HBP_TYPE_ALIVE || m.type == HBP_TYPE_SETPOINT) id = 0x100u | (m.type & 15u);
    else id = 0x200u | host;
    id |= (uint32_t)(m.node <= 1 ? m.node : 1) << 4;
    n = cut(frames, &m, id);
    at = below(n);
    switch (below(12)) {
    case 0:
        if (n == 1) break;
        memmove(frames + at, frames + at + 1, (n - at - 1) * sizeof *frames);
        n--;
        spoilt = 1;
        break;
    case 1:
        if (n == 1) break;
        frames[at].data[below(frames[at].n)] ^= (uint8_t)(1u << below(7)); /* not the mark of a first frame */
        spoilt = bus.data_bitrate ? 2 : 1; /* what fills an FD frame up is not looked at */
        break;
    case 2: frames[at].id ^= 1u << below(11); spoilt = 2; break;
    case 3: frames[at].id ^= 0x80000000u; spoilt = n > 1 ? 1 : 2; break;
    case 4: can_feed(&frames[0]); break; /* twice */
    case 5: /* not a frame of HBP's at all */
        n = 1;
        frames[0].n = (uint8_t)below(65);
        for (unsigned k = 0; k < frames[0].n; k++) frames[0].data[k] = (uint8_t)draw();
        spoilt = 2;
        break;
    case 6: /* a message without an end */
        if (n == 1) break;
        can_feed(&frames[0]);
        frames[1].n = HBP_CAN_BYTES;
        for (unsigned k = 1; k < 400; k++) {
            frames[1].data[0] = (uint8_t)k;
            frames[1].data[HBP_CAN_BYTES - 1] = (uint8_t)((frames[0].data[frames[0].n - 1] & 31u) | (k & 1u ? 0 : 0x20u));
            can_feed(&frames[1]);
        }
        n = 0;
        spoilt = 1;
        break;
    default: break;
    }
    n_damaged += spoilt != 0;
    for (unsigned k = 0; k < n; k++) can_feed(&frames[k]);
    n_frames++;
    make_body(body, m.type, m.flags, m.tid, 1, m.payload, m.n);
    if (!spoilt && m.n <= HBP_RX_MAX) expect(body, m.n + 12u);
    if (!slow) drain_can(spoilt == 2 ? 0 : 1u << 20);
    if (spoilt == 2) { /* another message, perhaps: answered or not */
        slow = 1;
        while (hbp_can_peek(can)) hbp_can_advance(can), hbp_can_poll(can, now);
        slow = 0;
    }
    queue_tail = queue_head; /* whatever stands in the queue had its chance: no answer is due to it later */
    for (unsigned k = below(4) ? below(4) : below(40); k--;) {
        pass_period();
        if (below(2) == 0) {
            hbp_can_poll(can, now);
            drain_can(1u << 20);
        }
    }
    if (below(2000) == 0) hbp_fault(nodes[0].device, 1u << below(24));
    check_all();
    hbp_can_poll(can, now);
    if (below(2000) == 0) { /* the bus is lost for a while */
        for (unsigned k = 0; k < 9000; k++) {
            pass_period();
            if (k % 16u == 0) hbp_can_poll(can, now);
        }
        check_all();
    }
    drain_can(1u << 20);
    check_all();
}

static void begin_can(void)
{
    if (!can) can = malloc(sizeof *can);
    bus.extended = (uint8_t)below(2);
    REQUIRE(!hbp_can_init(can, &bus));
    begin(below(4) ? HBP_FEATURE_EDGES | HBP_FEATURE_MEANS : 0);
}

/* ------------------------------------------------------------------------------------------------------------------------- */

static void prepare(void)
{
    with_many_channels();
    for (unsigned k = 0; k < 2; k++) {
        if (nodes[k].device) return;
        nodes[k].device = malloc(sizeof *nodes[k].device);
        nodes[k].told = calloc(65536, sizeof *nodes[k].told);
        nodes[k].waveform = malloc(512);
    }
}

#ifdef LIBFUZZER
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    prepare();
    given = data;
    given_bytes = size;
    begin_byte();
    while (given_bytes) byte_step();
    return 0;
}
#else
int main(int argc, char **argv)
{
    unsigned long frames = argc > 2 ? strtoul(argv[2], NULL, 10) : 100000;
    int on_can = argc > 1 && !strcmp(argv[1], "can");
    random_state = argc > 3 ? strtoull(argv[3], NULL, 10) : 1;
    prepare();
    while (n_frames < frames) {
        unsigned long until = n_frames + 20000;
        if (until > frames) until = frames;
        if (on_can) begin_can();
        else begin_byte();
        while (n_frames < until) {
            if (on_can) can_step();
            else byte_step();
        }
    }
    printf("%lu frames, %lu damaged, %lu replies, %lu samples, %lu edges, %lu captures, %lu periods with outputs on\n", n_frames,
           n_damaged, n_replies, n_samples, n_edges, n_captures, n_running);
    fflush(stdout);
    REQUIRE(n_replies > frames / 4 && n_samples > frames / 20 && n_edges > frames / 100 && n_running > frames / 100);
    REQUIRE(n_captures > frames / 1000);
    return 0;
}
#endif
