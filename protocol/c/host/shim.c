/* shim.c: what a host program needs beside hbp.h to put the device side behind a drive of its own. No firmware needs it. */
#include "../hbp_can.h"
#include "../hbp_way.h"

/* Bytes of the structures, as compiled. */
size_t shim_link_bytes(void) { return sizeof(struct hbp_link); }
size_t shim_can_bytes(void) { return sizeof(struct hbp_can); }
size_t shim_device_bytes(void) { return sizeof(struct hbp); }

/* What the header has as inline functions. */
void shim_link_init(struct hbp_link *link, float bytes_per_s) { hbp_link_init(link, bytes_per_s); }
uint32_t shim_can_init(struct hbp_can *can, const struct hbp_can_bus *bus) { return hbp_can_init(can, bus); }

uint32_t shim_add(struct hbp_link *link, struct hbp *device, const struct hbp_config *config, uint32_t boot_id)
{
    return hbp_add(link, device, config, boot_id);
}

uint32_t shim_can_add(struct hbp_can *can, struct hbp *device, const struct hbp_config *config, uint32_t boot_id)
{
    return hbp_can_add(can, device, config, boot_id);
}

/* An edge as a record of EDGES. */
static void give_edge(struct hbp *h, const uint8_t *r)
{
    hbp_edge(h, hbp_get32(r), r[4] & 7u, r[4] >> 3 & 7u, hbp_get16(r + 6));
}

/* `n` samples from PWM period `index` on, `stride` bytes from one to the next, and edges, records of EDGES, each before the first sample
 * that does not come before it. While no stream runs and no capture waits, periods may be left out. */
void shim_ticks(struct hbp *h, uint64_t index, const uint8_t *samples, size_t stride, size_t n, const uint8_t *edges, size_t n_edges)
{
    h->index = index;
    for (size_t k = 0; k < n; k++) {
        uint32_t tick = (uint32_t)h->config->tick0 + (uint32_t)h->index * h->period;
        for (; n_edges && (int32_t)(hbp_get32(edges) - tick) <= 0; n_edges--, edges += 8) give_edge(h, edges);
        hbp_tick(h, samples + k * stride);
    }
    for (; n_edges; n_edges--, edges += 8) give_edge(h, edges);
}

uint64_t shim_periods(const struct hbp *h) { return h->index; }

/* Bits of the streams that run. */
uint32_t shim_running(const struct hbp *h)
{
    uint32_t mask = 0;
    for (unsigned k = 0; k < HBP_STREAMS; k++) mask |= h->streams[k].running ? 1u << k : 0u;
    return mask;
}

/* 1 while a capture takes samples. */
int shim_capturing(const struct hbp *h)
{
    return h->capture && h->capture->running;
}

/* 1 at the position of each channel that a stream is configured with, or that a capture needs. */
void shim_channels(const struct hbp *h, uint8_t *used)
{
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        const struct hbp_stream *s = &h->streams[k];
        for (unsigned i = 0; s->configured && i < s->channels; i++) used[s->take[i]] = 1;
    }
    if (!shim_capturing(h)) return;
    for (unsigned i = 0; i < h->capture->channels; i++) used[h->capture->take[i]] = 1;
    if (h->capture->trigger < HBP_TRIGGER_ABOVE || h->capture->trigger > HBP_TRIGGER_CHANGES) return;
    for (unsigned i = 0; i < h->config->n_channels; i++)
        if (h->config->channels[i].at == h->capture->at) used[i] = 1;
}

uint32_t shim_dropped(const struct hbp *h) { return hbp_dropped(h); }
uint32_t shim_faults(const struct hbp *h) { return h->faults; }
uint32_t shim_bad(const struct hbp *h) { return h->link->bad; }
uint8_t shim_state(const struct hbp *h) { return h->state; }
uint16_t shim_watchdog_ms(const struct hbp *h) { return hbp_watchdog_ms(h); }

/* The next frame of a CAN device: its data and identifier; -1 if there is none. */
int shim_can_take(struct hbp_can *can, uint32_t *id, uint8_t *data)
{
    const struct hbp_can_frame *frame = hbp_can_peek(can);
    int length;
    if (!frame) return -1;
    length = frame->length;
    *id = frame->id;
    for (int k = 0; k < length; k++) data[k] = frame->data[k];
    hbp_can_advance(can);
    return length;
}
