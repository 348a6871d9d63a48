/* hbp_way.h: what the sources of the device side share. Not for applications. */
#ifndef HBP_WAY_H
#define HBP_WAY_H

#include "hbp.h"

#include <string.h>

enum hbp_rank { HBP_RANK_REPLY, HBP_RANK_NEWS, HBP_RANK_BEAT, HBP_RANK_STREAM }; /* how much room it must leave to others */

#define HBP_NEXT_TRANSFER 0xFFu

#define HBP_HEADER 8u    /* bytes in front of the link's `work` */
#define HBP_CRC_BYTES 4u /* and behind it */

struct hbp_message { /* its payload stands in the link's `work` */
    uint8_t type, flags;
    uint16_t tid, n;
    enum hbp_rank rank;
    uint8_t transfer; /* on CAN: that of a kept reply, or HBP_NEXT_TRANSFER; then the one that it got */
};

struct hbp_way { /* how a device's messages and streams get onto its link */
    int (*send)(struct hbp *h, struct hbp_message *message);       /* 0: no room, nothing is sent */
    int (*beats)(const struct hbp *h);                             /* the last heartbeat still waits */
    uint32_t (*shape)(struct hbp *h, struct hbp_stream *s);        /* sets block, rate, groups; bytes that fit if it does not, else 0 */
    uint16_t (*open)(struct hbp *h, struct hbp_stream *s);         /* sets the slot, or refuses */
    int (*samples)(struct hbp *h, struct hbp_stream *s, const struct hbp_block *block, const uint8_t *records); /* 0: no room */
    int (*edges)(struct hbp *h, struct hbp_stream *s, uint16_t n); /* the n next ones, without a gap; 0: no room */
    uint8_t counts_samples; /* 1: `seq` is the number of a block's first sample; 0: it counts blocks */
};

#if defined(__GNUC__)
#define HBP_APART __attribute__((noinline)) /* compiled for size, gcc would copy the function into its callers, and the code would grow */
#else
#define HBP_APART
#endif

extern const uint8_t hbp_widths[]; /* bytes of each raw type */

#if defined(__BYTE_ORDER__) && defined(__ORDER_LITTLE_ENDIAN__) && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__ && !defined(HBP_PORTABLE)
#define HBP_LITTLE_ENDIAN 1 /* values stand in memory as they do on the wire */
#else
#define HBP_LITTLE_ENDIAN 0
#endif

/* Numbers on the wire; each put returns where the next one goes. In memory that a core reaches at any address they are one instruction. */
#if HBP_LITTLE_ENDIAN && (!defined(__ARM_ARCH) || defined(__ARM_FEATURE_UNALIGNED))
static inline uint8_t *hbp_put16(uint8_t *to, uint32_t value)
{
    uint16_t half = (uint16_t)value;
    memcpy(to, &half, sizeof half);
    return to + sizeof half;
}

static inline uint8_t *hbp_put32(uint8_t *to, uint32_t value)
{
    memcpy(to, &value, sizeof value);
    return to + sizeof value;
}

static inline uint16_t hbp_get16(const uint8_t *from)
{
    uint16_t half;
    memcpy(&half, from, sizeof half);
    return half;
}

static inline uint32_t hbp_get32(const uint8_t *from)
{
    uint32_t value;
    memcpy(&value, from, sizeof value);
    return value;
}
#else
#define HBP_BYTE_BY_BYTE
uint8_t *hbp_put16(uint8_t *to, uint32_t value);
uint8_t *hbp_put32(uint8_t *to, uint32_t value);
uint32_t hbp_get32(const uint8_t *from);
uint16_t hbp_get16(const uint8_t *from);
#endif
float hbp_get_float(const uint8_t *from);
uint8_t *hbp_put_header(struct hbp *h, const struct hbp_message *message); /* in front of the payload; where it begins */
uint8_t *hbp_put_edge(uint8_t *to, const struct hbp_hall_edge *edge, uint8_t flags);
int hbp_finite(float value);
HBP_APART uint16_t hbp_refuse(struct hbp *h, uint16_t code, uint32_t number); /* a code, and its detail */
uint16_t hbp_finish(struct hbp *h, const uint8_t *end); /* the reply ends there; returns 0 */
void hbp_event(struct hbp *h, uint32_t code, float arg, float detail);
uint16_t hbp_next_number(uint16_t number); /* 1 … 65535, 1, … */
uint32_t hbp_rounded_up(uint64_t index, uint16_t decimation);
const struct hbp_channel *hbp_find_channel(const struct hbp *h, uint32_t id);
uint16_t hbp_choose(struct hbp *h, const uint8_t *ids, uint32_t n, uint32_t *bytes);
void hbp_take_channels(const struct hbp *h, const uint8_t *ids, uint32_t n, uint16_t *take);
void hbp_copy_sample(const struct hbp *h, const uint16_t *take, uint32_t n, const uint8_t *sample, uint8_t *to);
uint32_t hbp_crc(uint32_t crc, const uint8_t *data, size_t n);
uint32_t hbp_in_time(const struct hbp *h, uint32_t latency_ms, uint32_t decimation);
uint32_t hbp_join(struct hbp_link_base *link, struct hbp *h, const struct hbp_config *config, uint32_t boot_id);
void hbp_receive(struct hbp *h, const uint8_t *raw, uint8_t host, int mine); /* header + payload */
void hbp_pass_time(struct hbp *h, uint64_t now);
void hbp_advance(struct hbp *h, uint64_t now);
void hbp_stop(struct hbp *h);
uint32_t hbp_dropped(const struct hbp *h);
uint16_t hbp_watchdog_ms(const struct hbp *h);

/* Whether records of a stream are means: f32, each. */
static inline int hbp_has_means(const struct hbp_stream *s)
{
    return HBP_MEANS && s->event == HBP_STREAM_MEAN;
}

static inline uint32_t hbp_width_in(const struct hbp_stream *s, const struct hbp_channel *channel)
{
    return hbp_has_means(s) ? 4u : hbp_widths[channel->type];
}

#if HBP_MEANS
void hbp_means_prepare(const struct hbp *h, struct hbp_stream *s);    /* main loop: its channels are known */
void hbp_means_add(const struct hbp *h, struct hbp_stream *s, const uint8_t *sample, uint32_t left); /* interrupt: periods to the record */
void hbp_means_put(const struct hbp *h, const struct hbp_stream *s, const uint8_t *sample, uint8_t *to); /* interrupt: the record */
#else /* no stream has means */
static inline void hbp_means_prepare(const struct hbp *h, struct hbp_stream *s)
{
    (void)h, (void)s;
}

static inline void hbp_means_add(const struct hbp *h, struct hbp_stream *s, const uint8_t *sample, uint32_t left)
{
    (void)h, (void)s, (void)sample, (void)left;
}

static inline void hbp_means_put(const struct hbp *h, const struct hbp_stream *s, const uint8_t *sample, uint8_t *to)
{
    (void)h, (void)s, (void)sample, (void)to;
}
#endif

#if HBP_CAPTURE
uint32_t hbp_capture_init(struct hbp *h);
void hbp_capture_ask(struct hbp *h, uint8_t trigger);                 /* main loop: the trigger, if it is armed with that one */
void hbp_capture_tick(struct hbp *h, const uint8_t *sample);          /* interrupt, before the period is counted */
void hbp_capture_edge(struct hbp *h, uint32_t tick, uint8_t codes, uint16_t encoder); /* interrupt, before the edge is counted */
void hbp_capture_poll(struct hbp *h);
uint16_t hbp_capture_arm(struct hbp *h, const uint8_t *in);
uint16_t hbp_capture_status(struct hbp *h, const uint8_t *in);
uint32_t hbp_capture_blob_bytes(const struct hbp *h);                 /* 0: none is frozen */
const uint8_t *hbp_capture_blob(const struct hbp *h, uint32_t offset, uint32_t *n); /* bytes there, at most *n */
#endif

#endif
