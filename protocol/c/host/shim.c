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

/* `n` samples from PWM period `index` on, `stride` bytes from one to the next. While no stream runs, periods may be left out. */
void shim_ticks(struct hbp *h, uint64_t index, const uint8_t *samples, size_t stride, size_t n)
{
    h->index = index;
    for (size_t k = 0; k < n; k++) hbp_tick(h, samples + k * stride);
}

/* `n` edges as records of EDGES. */
void shim_edges(struct hbp *h, const uint8_t *records, size_t n)
{
    for (const uint8_t *r = records; n--; r += 8)
        hbp_edge(h, hbp_get32(r), r[4] & 7u, r[4] >> 3 & 7u, (uint16_t)(r[6] | r[7] << 8));
}

/* Bits of the streams that run. */
uint32_t shim_running(const struct hbp *h)
{
    uint32_t mask = 0;
    for (unsigned k = 0; k < HBP_STREAMS; k++) mask |= h->streams[k].running ? 1u << k : 0u;
    return mask;
}

/* 1 at the position of each channel that a stream is configured with. */
void shim_channels(const struct hbp *h, uint8_t *used)
{
    for (unsigned k = 0; k < HBP_STREAMS; k++) {
        const struct hbp_stream *s = &h->streams[k];
        for (unsigned i = 0; s->configured && i < s->channels; i++) used[s->take[i]] = 1;
    }
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
