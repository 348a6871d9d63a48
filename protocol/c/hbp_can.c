/* hbp_can.c: see hbp_can.h. */
#include "hbp_can.h"

#include <string.h>

#include "hbp_way.h"

#define STOP_CLASS 0u
#define STATUS 1u
#define TO_DEVICE 2u
#define TO_HOST 3u
#define EDGE_CLASS 4u
#define SAMPLE_CLASS 5u
#define PREFIX 0x02421000u
#define START_BIT 0x80u
#define END_BIT 0x40u
#define TOGGLE 0x20u
#define ID_MASK 0x1Fu
#define NOTHING 0xFFu /* no frame is expected */
#define HEADER 6u
#define CRC_BYTES 4u
#define MAX_GROUPS 16u
#define HEARTBEAT_FRAMES 8u /* at most: on a classic bus */
#define MESSAGES 0u
#define STREAMED 1u

#define CHECK(name, condition) typedef char hbp_can_check_##name[(condition) ? 1 : -1]
CHECK(bytes, HBP_CAN_BYTES == 8 || HBP_CAN_BYTES == 64);
CHECK(messages, (HBP_CAN_MESSAGES & (HBP_CAN_MESSAGES - 1)) == 0 && HBP_CAN_MESSAGES >= 32 && HBP_CAN_MESSAGES <= 32768);
CHECK(streamed, (HBP_CAN_STREAMED & (HBP_CAN_STREAMED - 1)) == 0 && HBP_CAN_STREAMED >= 16 && HBP_CAN_STREAMED <= 32768);
CHECK(transfers, HBP_CAN_TRANSFERS >= 2);

static struct hbp_can *can_of(const struct hbp *h)
{
    return (struct hbp_can *)(void *)h->link;
}

/* Time in units that last for days: of a quarter to half a millisecond. */
static HBP_APART void set_clock(struct hbp_can *can, uint64_t now)
{
    can->now = (uint32_t)(now >> can->shift);
}

static int is_fd(const struct hbp_can *can)
{
    return HBP_CAN_BYTES > 8 && can->bus->data_bitrate != 0;
}

/* Bytes of a message that a frame has. */
static uint32_t part_of(const struct hbp_can *can)
{
    return is_fd(can) ? 63u : 7u;
}

/* Bytes of the longest payload that so many frames carry, and that the device makes. */
static uint16_t payload_in(const struct hbp_can *can, uint32_t frames)
{
    uint32_t bytes = frames * part_of(can) - HEADER - CRC_BYTES;
    return (uint16_t)(bytes < HBP_TX_MAX ? bytes : HBP_TX_MAX);
}

static uint32_t padded(uint32_t n)
{
    if (n <= 8) return n;
    if (n <= 24) return (n + 3u) & ~3u;
    return n <= 32 ? 32 : n <= 48 ? 48 : 64;
}

static uint32_t id_of(const struct hbp *h, uint32_t class, uint32_t slot)
{
    uint32_t id = class << 8 | (uint32_t)h->config->node << 4 | slot;
    return can_of(h)->bus->extended ? id | PREFIX | HBP_CAN_EXTENDED : id;
}

/* ---- queues: frames that wait ---------------------------------------------------------------------------------------------- */

static uint32_t size_of(unsigned queue)
{
    return queue == MESSAGES ? HBP_CAN_MESSAGES : HBP_CAN_STREAMED;
}

static struct hbp_can_frame *frame_at(struct hbp_can *can, unsigned queue, uint32_t at)
{
    return queue == MESSAGES ? &can->messages[at & (HBP_CAN_MESSAGES - 1u)] : &can->streamed[at & (HBP_CAN_STREAMED - 1u)];
}

static uint32_t room(const struct hbp_can *can, unsigned queue)
{
    return size_of(queue) - (uint16_t)(can->head[queue] - can->tail[queue]);
}

/* A frame with `n` bytes of data, filled up on an FD bus, `ahead` of those that are to be sent. */
static struct hbp_can_frame *new_frame(struct hbp_can *can, unsigned queue, uint32_t ahead, uint32_t id, uint32_t n)
{
    struct hbp_can_frame *frame = frame_at(can, queue, can->head[queue] + ahead);
    if (is_fd(can)) n = padded(n);
    frame->id = id;
    frame->stamp = can->now;
    frame->streamed = (uint8_t)queue;
    frame->length = (uint8_t)n;
    memset(frame->data, 0, n);
    return frame;
}

static void queue_frames(struct hbp_can *can, unsigned queue, uint32_t n)
{
    HBP_BARRIER();
    can->head[queue] = (uint16_t)(can->head[queue] + n);
}

const struct hbp_can_frame *hbp_can_peek(struct hbp_can *can)
{
    for (unsigned queue = MESSAGES; queue <= STREAMED; queue++) {
        while (can->head[queue] != can->tail[queue]) {
            const struct hbp_can_frame *frame = frame_at(can, queue, can->tail[queue]);
            HBP_BARRIER();
            can->from = (uint8_t)queue;
            if (queue == MESSAGES || can->now - frame->stamp <= can->most_age) return frame;
            hbp_can_gave_up(can);
            hbp_can_advance(can);
        }
    }
    return NULL;
}

void hbp_can_advance(struct hbp_can *can)
{
    HBP_BARRIER();
    can->tail[can->from] = (uint16_t)(can->tail[can->from] + 1u);
}

void hbp_can_gave_up(struct hbp_can *can)
{
    can->base.expired = can->base.expired + 1u;
}

/* ---- messages to the host -------------------------------------------------------------------------------------------------- */

static int can_send(struct hbp *h, struct hbp_message *message)
{
    struct hbp_can *can = can_of(h);
    int is_reply = message->rank == HBP_RANK_REPLY, fresh = message->transfer == HBP_NEXT_TRANSFER, fits;
    uint32_t slot = is_reply ? can->host : message->type & 15u, id = id_of(h, is_reply ? TO_HOST : STATUS, slot);
    uint8_t *next = &can->next[is_reply ? slot : 14u + slot]; /* 2, 3, 4 come behind the hosts */
    uint8_t *raw = hbp_put_header(h, message), *from = raw + HBP_HEADER - HEADER, header[HEADER], tail = START_BIT | TOGGLE;
    uint32_t part = part_of(can), left = HEADER + message->n, frames;
    if (left > part) {
        hbp_put32(from + left, hbp_crc(0xFFFFFFFFu, raw, HBP_HEADER + message->n) ^ 0xFFFFFFFFu);
        left += CRC_BYTES;
    }
    memcpy(header, raw, HEADER); /* without the node */
    memcpy(from, header, HEADER);
    frames = (left + part - 1u) / part;
    fits = frames + (is_reply ? 0 : HBP_CAN_MESSAGES / 2u) <= room(can, MESSAGES);
    if (fresh) message->transfer = *next;
    if (fresh && (fits || is_reply)) *next = (uint8_t)((*next + 1u) & ID_MASK); /* a reply that is kept has its id, sent or not */
    if (!fits) return 0;
    for (uint32_t k = 0; k < frames; k++) {
        uint32_t n = left < part ? left : part;
        struct hbp_can_frame *frame = new_frame(can, MESSAGES, k, id, n + 1u);
        memcpy(frame->data, from, n);
        from += n, left -= n;
        frame->data[frame->length - 1u] = (uint8_t)(tail | (left ? 0 : END_BIT) | message->transfer);
        tail = (tail ^ TOGGLE) & TOGGLE;
    }
    queue_frames(can, MESSAGES, frames);
    if (message->rank == HBP_RANK_BEAT) h->beat = can->head[MESSAGES];
    return 1;
}

static int can_beats(const struct hbp *h)
{
    return (int16_t)(uint16_t)(h->beat - can_of(h)->tail[MESSAGES]) > 0;
}

/* ---- what streams come to -------------------------------------------------------------------------------------------------- */

static float seconds(const struct hbp_can *can, uint32_t n)
{
    const struct hbp_can_bus *bus = can->bus;
    uint32_t a, d;
    if (!is_fd(can)) {
        a = (bus->extended ? 54u : 34u) + 8u * n;
        return (float)(a + (a - 1u) / 4u + 13u) / (float)bus->bitrate;
    }
    a = bus->extended ? 36u : 17u;
    d = 5u + 8u * n;
    return (float)(a + (a - 1u) / 4u + 13u) / (float)bus->bitrate +
           (float)(d + d / 4u + (n > 16 ? 32u : 27u)) / (float)bus->data_bitrate;
}

/* Bytes of the group that begins with channel *k, which becomes that of the next group. */
static uint32_t group(const struct hbp *h, const struct hbp_stream *s, unsigned *k)
{
    uint32_t most = is_fd(can_of(h)) ? 60u : 6u, bytes = 0;
    while (*k < s->channels) {
        uint32_t width = hbp_width_in(s, &h->config->channels[s->take[*k]]);
        if (bytes + width > most) break;
        bytes += width;
        ++*k;
    }
    return bytes;
}

static uint32_t can_shape(struct hbp *h, struct hbp_stream *s)
{
    const struct hbp_can *can = can_of(h);
    uint32_t counter = is_fd(can) ? 4u : 2u, most = is_fd(can) ? 60u : 6u, fits = 0, groups = 0;
    float busy = 0.0f;
    s->groups = 1;
    s->block = 1;
    if (s->event == HBP_STREAM_EDGES) {
        s->rate = 1000.0f * seconds(can, 8u);
        return 0;
    }
    for (unsigned k = 0; k < s->channels; groups++) {
        uint32_t bytes = group(h, s, &k);
        if (groups < MAX_GROUPS) fits += bytes;
        if (groups == 0 && k == s->channels) { /* all in one frame, which may hold several samples */
            uint32_t in_time = hbp_in_time(h, s->latency_ms, s->decimation), n = most / bytes;
            if (n > in_time) n = in_time ? in_time : 1u;
            s->block = (uint16_t)n;
            bytes *= n;
        }
        busy += seconds(can, is_fd(can) ? padded(counter + bytes) : counter + bytes);
    }
    if (groups > MAX_GROUPS) return fits;
    s->groups = (uint8_t)groups;
    s->rate = busy * (float)h->config->pwm_hz / ((float)s->decimation * (float)s->block);
    return 0;
}

/* ---- slots, handed out in circles of 16 for edges and 32 for samples -------------------------------------------------------- */

/* The last of the slots that edges have among them, or samples. */
static uint32_t circle_of(const struct hbp_stream *s)
{
    return s->event == HBP_STREAM_EDGES ? 15u : 31u;
}

static int is_taken(const struct hbp *h, const struct hbp_stream *wanted, uint32_t slot, int its_own)
{
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        const struct hbp_stream *s = &h->streams[k];
        if (!s->configured || circle_of(s) != circle_of(wanted) || (k == wanted->number && !its_own)) continue;
        if (((slot - s->slot) & circle_of(wanted)) < s->groups) return 1;
    }
    return 0;
}

static uint16_t can_open(struct hbp *h, struct hbp_stream *wanted)
{
    uint32_t circle = circle_of(wanted);
    uint8_t *next = &can_of(h)->slots[wanted->event == HBP_STREAM_EDGES];
    for (int its_own = 1; its_own >= 0; its_own--) {
        for (uint32_t start = 0; start <= circle; start++) {
            uint32_t first = *next + start, n = 0;
            while (n < wanted->groups && !is_taken(h, wanted, first + n, its_own)) n++;
            if (n < wanted->groups) continue;
            wanted->slot = (uint8_t)(first & circle);
            *next = (uint8_t)((first + n) & circle);
            return 0;
        }
    }
    return HBP_ERROR_DOES_NOT_FIT;
}

/* ---- streams to the host --------------------------------------------------------------------------------------------------- */

static int can_samples(struct hbp *h, struct hbp_stream *s, const struct hbp_block *block, const uint8_t *records)
{
    struct hbp_can *can = can_of(h);
    uint32_t counter = is_fd(can) ? 4u : 2u, frames = 0;
    if (h->periods - block->index > h->config->pwm_hz / 2u) { /* too old */
        s->lost += s->groups;
        return 1;
    }
    if (room(can, STREAMED) < s->groups) return 0;
    for (unsigned k = 0; k < s->channels; frames++) {
        uint32_t bytes = group(h, s, &k) * (s->groups == 1 ? block->n : 1u);
        uint32_t slot = (s->slot + frames) % 32u;
        uint8_t *data = new_frame(can, STREAMED, frames, id_of(h, SAMPLE_CLASS + slot / 16u, slot % 16u), counter + bytes)->data;
        if (is_fd(can)) hbp_put32(data, block->index);
        else hbp_put16(data, block->seq);
        memcpy(data + counter, records, bytes);
        records += bytes;
    }
    queue_frames(can, STREAMED, frames);
    return 1;
}

static int can_edges(struct hbp *h, struct hbp_stream *s, uint16_t n)
{
    struct hbp_can *can = can_of(h);
    const struct hbp_hall_edge *edge = &h->ring[s->edge & (HBP_EDGES - 1u)];
    (void)n; /* a block is one edge */
    if ((uint32_t)h->now - edge->tick > h->config->tick_hz / 2u && (int32_t)((uint32_t)h->now - edge->tick) > 0) {
        s->lost++;
        return 1;
    }
    if (!room(can, STREAMED)) return 0;
    hbp_put_edge(new_frame(can, STREAMED, 0, id_of(h, EDGE_CLASS, s->slot), 8u)->data, edge, (uint8_t)edge->index);
    queue_frames(can, STREAMED, 1u);
    return 1;
}

/* ---- from the host --------------------------------------------------------------------------------------------------------- */

static struct hbp_transfer *transfer_of(struct hbp_can *can, uint16_t key)
{
    struct hbp_transfer *oldest = can->transfers;
    for (unsigned k = 0; k < HBP_CAN_TRANSFERS; k++) {
        struct hbp_transfer *each = &can->transfers[k];
        if (each->used && each->key == key) return each;
        if (each->used < oldest->used) oldest = each;
    }
    memset(oldest, 0, sizeof *oldest);
    oldest->key = key;
    oldest->expected = NOTHING;
    return oldest;
}

/* Whether what has come is a message; then header and payload, as on a byte link, stand at `buffer`. */
static int is_whole(struct hbp_transfer *t, int single)
{
    uint8_t *body = t->buffer + 2, header[HEADER];
    uint32_t length = t->n < HEADER ? 0 : body[4] | (uint32_t)body[5] << 8;
    uint32_t needed = HEADER + length + (single ? 0 : CRC_BYTES), last = needed % 63u ? needed % 63u : 63u;
    if (t->n < needed || t->n > needed - last + padded(last + 1u) - 1u || length > HBP_RX_MAX) return 0;
    memcpy(header, body, HEADER);
    memcpy(t->buffer, header, HEADER);
    t->buffer[6] = (uint8_t)(t->key >> 4 & 15u); /* the identifier's node, which is 0 in a HELLO to all */
    t->buffer[7] = 0;
    return single || (hbp_crc(0xFFFFFFFFu, t->buffer, 8u + length) ^ 0xFFFFFFFFu) == hbp_get32(t->buffer + 8 + length);
}

static int came_before(const struct hbp_transfer *t, const uint8_t *data, size_t n)
{
    if (n != t->last_length) return 0;
    while (n && data[n - 1u] == t->last[n - 1u]) n--;
    return !n;
}

/* Take a frame; whether a message is whole with it. */
static int feed(struct hbp_can *can, struct hbp_transfer *t, const uint8_t *data, size_t n)
{
    uint8_t expected = t->expected, tail, order;
    if (!n || n > HBP_CAN_BYTES) {
        can->orphans++;
        return 0;
    }
    if (came_before(t, data, n)) {
        can->duplicates++;
        return 0;
    }
    memcpy(t->last, data, n);
    t->last_length = (uint8_t)n;
    t->expected = NOTHING;
    tail = data[--n];
    order = tail & (TOGGLE | ID_MASK);
    if (tail & START_BIT) {
        if (expected != NOTHING) can->base.bad++;
        expected = tail & TOGGLE ? order : NOTHING;
        t->n = 0;
    }
    if (expected == NOTHING) {
        can->orphans++;
        return 0;
    }
    if (order == expected && t->n <= HEADER + HBP_RX_MAX + CRC_BYTES) {
        memcpy(t->buffer + 2 + t->n, data, n);
        t->n = (uint16_t)(t->n + n);
        if (!(tail & END_BIT)) {
            t->expected = order ^ TOGGLE;
            return 0;
        }
        if (is_whole(t, tail & START_BIT)) return 1;
    }
    can->base.bad++;
    return 0;
}

static int belongs(uint32_t class, uint32_t slot, int to_all, uint8_t type)
{
    if (class == STATUS) return (type == HBP_TYPE_ALIVE || type == HBP_TYPE_SETPOINT) && (type & 15u) == slot;
    if (to_all) return type == HBP_TYPE_HELLO;
    return type != HBP_TYPE_ALIVE && type != HBP_TYPE_SETPOINT && type != HBP_TYPE_HEARTBEAT && type != HBP_TYPE_EVENT &&
           type != HBP_TYPE_LOG;
}

static int is_for(const struct hbp *h, uint32_t class, uint32_t node, uint32_t slot)
{
    int mine = node == h->config->node;
    if (class == STATUS) return mine && (slot == (HBP_TYPE_ALIVE & 15u) || slot == (HBP_TYPE_SETPOINT & 15u));
    return (class == STOP_CLASS || class == TO_DEVICE) && (mine || !node);
}

void hbp_can_rx(struct hbp_can *can, uint64_t now, uint32_t id, const uint8_t *data, size_t n)
{
    struct hbp *h = can->base.first;
    uint32_t class = id >> 8 & 7u, node = id >> 4 & 15u, slot = id & 15u;
    uint32_t form = can->bus->extended ? PREFIX | HBP_CAN_EXTENDED : 0u;
    struct hbp_transfer *t;
    if (!h) return;
    if ((id & ~0x7FFu) != form || !is_for(h, class, node, slot)) {
        can->foreign++;
        return;
    }
    set_clock(can, now);
    hbp_pass_time(h, now);
    if (class == STOP_CLASS) {
        hbp_stop(h);
        return;
    }
    t = transfer_of(can, (uint16_t)(id & 0x7FFu));
    t->used = ++can->clock;
    if (!feed(can, t, data, n)) return;
    if (belongs(class, slot, !node, t->buffer[0])) {
        can->host = class == TO_DEVICE ? (uint8_t)slot : 0;
        hbp_receive(h, t->buffer, can->host, 1);
    } else {
        can->foreign++;
    }
}

void hbp_can_poll(struct hbp_can *can, uint64_t now)
{
    set_clock(can, now);
    if (can->base.first) hbp_advance(can->base.first, now);
}

static const struct hbp_way can_way = {
    can_send, can_beats, can_shape, can_open, can_samples, can_edges, 1,
};

uint32_t hbp_can_init_sized(struct hbp_can *can, const struct hbp_can_bus *bus, size_t size)
{
    if (size != sizeof *can) return HBP_WRONG_OPTIONS;
    if (!bus->bitrate || (bus->data_bitrate && HBP_CAN_BYTES < 64)) return HBP_WRONG_BUS;
    memset(can, 0, sizeof *can);
    can->base.way = &can_way;
    can->base.work = can->made + HBP_HEADER;
    can->base.capacity = 1.0f;
    can->bus = bus;
    can->base.most = payload_in(can, HBP_CAN_MESSAGES - HEARTBEAT_FRAMES);
    can->base.most_news = payload_in(can, HBP_CAN_MESSAGES / 2u); /* the rest is left to replies */
    return 0;
}

uint32_t hbp_can_add_sized(struct hbp_can *can, struct hbp *device, const struct hbp_config *config, uint32_t boot_id, size_t size)
{
    if (size != sizeof *can + sizeof *device) return HBP_WRONG_OPTIONS;
    if (can->base.first || config->node > 15) return HBP_WRONG_NODE;
    can->slots[0] = (uint8_t)(boot_id % 32u);
    can->slots[1] = (uint8_t)(boot_id % 16u);
    while (config->tick_hz >> can->shift > 4096u) can->shift++;
    can->most_age = (config->tick_hz / 2u) >> can->shift;
    return hbp_join(&can->base, device, config, boot_id);
}
